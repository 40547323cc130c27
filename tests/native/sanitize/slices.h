// Random cuts of Gaussians in space and time, legal and not, and what must hold after each.
#pragma once

#include "calls.h"

namespace calls {

using Bytes = Array<uint8_t>;

struct Recording {
  fragprune_spacetime in{};
  Floats campos, means, opacities, times, scales, scales_t, rotations, rotations_r, cov3d, sh;
  bool tame = true;

  size_t count() const { return static_cast<size_t>(in.count); }
  void point() {
    in.campos = campos.get(), in.means = means.get(), in.opacities = opacities.get();
    in.times = times.get(), in.scales = scales.get(), in.scales_t = scales_t.get();
    in.rotations = rotations.get(), in.rotations_r = rotations_r.get();
    in.cov3d = cov3d.get(), in.sh = sh.get();
    fragprune_lengths& held = in.lengths;
    held.campos = campos.length(), held.means = means.length();
    held.opacities = opacities.length(), held.times = times.length();
    held.scales = scales.length(), held.scales_t = scales_t.length();
    held.rotations = rotations.length(), held.rotations_r = rotations_r.length();
    held.cov3d = cov3d.length(), held.sh = sh.length();
  }
};

// Of each kind; some are pieces of work long, and of those with a time some are not there.
inline Recording make_recording(Source& from) {
  Recording r;
  fragprune_spacetime& in = r.in;
  in.size = sizeof in;
  in.threads = 1 + from.below(4);
  in.timestamp = from.uniform(-1, 1);
  in.duration = from.uniform(0.1f, 3);
  in.prefilter_var = from.uniform(-1, 1);
  in.scale_modifier = from.one_in(3) ? from.uniform(0.1f, 2) : 1;
  in.sh_degree = from.below(4);
  in.sh_degree_t = from.below(4) - 1;
  const int orders = in.sh_degree == 3 ? std::max(in.sh_degree_t, 0) : 0;
  in.sh_coefficients = (in.sh_degree + 1) * (in.sh_degree + 1) + 16 * orders + from.below(3);
  in.count = from.one_in(4) ? from.below(3) : from.one_in(4) ? from.below(2500) : from.below(100);
  const size_t n = r.count();
  const auto shape = [&](Floats& array, size_t size) {
    array.make(size);
    for (size_t i = 0; i < size; i++) array[i] = from.log_uniform(0.03f, 1);
  };
  fill(r.campos, 3, from, 4, 9);
  fill(r.means, 3 * n, from, -2, 2);
  fill(r.opacities, n, from, 0.002f, 1);
  const int kind = from.below(4);
  if (kind == 0) fill(r.cov3d, 6 * n, from, -1, 1);
  if (kind > 0) shape(r.scales, 3 * n), fill(r.rotations, 4 * n, from, -1, 1);
  if (kind > 1) shape(r.scales_t, n);
  if (kind > 2) fill(r.rotations_r, 4 * n, from, -1, 1);
  if (kind > 1 || orders) fill(r.times, n, from, in.timestamp - 1, in.timestamp + 1);
  if (!from.one_in(4)) fill(r.sh, 3 * n * static_cast<size_t>(in.sh_coefficients), from, -1, 1);
  if (from.one_in(2)) {
    r.tame = false;
    Floats* arrays[] = {&r.campos, &r.means,     &r.opacities,   &r.times, &r.scales,
                        &r.scales_t, &r.rotations, &r.rotations_r, &r.cov3d, &r.sh};
    for (Floats* array : arrays)
      for (int k = from.below(3); array->size() && k > 0; k--)
        (*array)[from.next() % array->size()] = from.poison();
  }
  r.point();
  return r;
}

struct Cut {
  fragprune_sliced out{};
  Floats means, cov3d, opacities, colors;
  Bytes present;

  std::vector<const Floats*> all() const { return {&means, &cov3d, &opacities, &colors}; }
  void point() {
    out.size = sizeof out;
    out.means = means.get(), out.cov3d = cov3d.get(), out.opacities = opacities.get();
    out.colors = colors.get(), out.present = present.get();
  }
};

inline Cut make_cut(const Recording& r) {
  Cut c;
  const size_t n = r.count();
  c.means.make(3 * n), c.cov3d.make(6 * n), c.opacities.make(n), c.present.make(n);
  if (r.sh.get()) c.colors.make(3 * n);
  c.point();
  return c;
}

inline Cut make_cut(Recording& r, int threads) {
  Cut c = make_cut(r);
  r.in.threads = threads;
  fragprune_error error;
  CALLS_CHECK(fragprune_slice(&r.in, &c.out, &error) == FRAGPRUNE_OK && !error.message[0]);
  for (const Floats* array : c.all()) CALLS_CHECK(array->written());
  return c;
}

struct RecordingGradients {
  fragprune_spacetime_grads to{};
  Floats means, opacities, times, scales, scales_t, rotations, rotations_r, cov3d, sh;

  std::vector<const Floats*> all() const {
    return {&means,     &opacities,   &times, &scales, &scales_t,
            &rotations, &rotations_r, &cov3d, &sh};
  }
};

inline RecordingGradients differentiate(Recording& r, const Cut& by, int absent, int threads) {
  RecordingGradients g;
  const auto want = [&](int bit, const Floats& given, Floats& array) {
    if (given.get() && !(absent >> bit & 1)) array.make(given.size());
    return array.get();
  };
  g.to.size = sizeof g.to;
  g.to.means = want(0, r.means, g.means), g.to.opacities = want(1, r.opacities, g.opacities);
  g.to.times = want(2, r.times, g.times), g.to.scales = want(3, r.scales, g.scales);
  g.to.scales_t = want(4, r.scales_t, g.scales_t);
  g.to.rotations = want(5, r.rotations, g.rotations);
  g.to.rotations_r = want(6, r.rotations_r, g.rotations_r);
  g.to.cov3d = want(7, r.cov3d, g.cov3d), g.to.sh = want(8, r.sh, g.sh);
  r.in.threads = threads;
  CALLS_CHECK(fragprune_unslice(&r.in, &by.out, &g.to, nullptr) == FRAGPRUNE_OK);
  for (const Floats* array : g.all()) CALLS_CHECK(array->written());
  return g;
}

inline void misstate_cut(fragprune_lengths& held, Source& from) {
  misstate({&held.campos, &held.means, &held.opacities, &held.times, &held.scales, &held.scales_t,
            &held.rotations, &held.rotations_r, &held.cov3d, &held.sh},
           from);
}

inline void try_illegal_cut(const Recording& r, Source& from, Tally& tally) {
  fragprune_spacetime in = r.in;
  Cut c = make_cut(r);
  const float some[3] = {};
  switch (from.below(in.count ? 18 : 8)) {
    case 0: in.size--; break;
    case 1: c.out.size = 0; break;
    case 2: in.count = -1 - from.below(3); break;
    case 3: in.count = int64_t{INT32_MAX} + 1; break;
    case 4: in.threads = from.one_in(2) ? -from.below(3) : 1025 + from.below(1 << 30); break;
    case 5: in.campos = nullptr; break;
    case 6: in.sh_coefficients = from.one_in(2) ? 1025 : -1; break;
    case 7: misstate_cut(in.lengths, from); break;
    case 8: in.means = nullptr; break;
    case 9: in.opacities = nullptr; break;
    case 10: in.cov3d = in.scales = nullptr; break;
    case 11: in.cov3d = in.scales = some; break;
    case 12: c.out.present = nullptr; break;
    case 13: c.out.cov3d = nullptr; break;
    case 14: in.sh = in.sh ? nullptr : some; break;  // colours without, or none with
    case 15: in.sh = some, in.sh_degree = from.one_in(2) ? INT32_MAX : -1; break;
    case 16: in.sh = some, in.sh_degree_t = from.one_in(2) ? 3 : -2; break;
    default: in.sh = some, in.sh_coefficients = from.one_in(2) ? 1025 : 0;
  }
  fragprune_error error;
  CALLS_CHECK(fragprune_slice(&in, &c.out, &error) == FRAGPRUNE_BAD_INPUT && error.message[0]);
  c = make_cut(r);
  fragprune_spacetime_grads to{};
  float nowhere;
  to.size = sizeof to;
  if (!r.count() || from.one_in(3))
    to.size++;
  else if (r.in.cov3d)
    to.scales = &nowhere;
  else
    to.cov3d = &nowhere;
  CALLS_CHECK(fragprune_unslice(&r.in, &c.out, &to, &error) == FRAGPRUNE_BAD_INPUT);
  tally.refused++;
}

// Cuts, and goes back.
inline void run_cut(Source& from, Tally& tally) {
  Recording r = make_recording(from);
  tally.cut++;
  if (from.one_in(4)) try_illegal_cut(r, from, tally);
  Cut c = make_cut(r, 1 + from.below(4));
  for (size_t i = 0; i < r.count(); i++) {
    CALLS_CHECK(c.present[i] <= 1);
    tally.present += c.present[i];
    if (!c.present[i]) CALLS_CHECK(c.opacities[i] == 0 && c.cov3d[6 * i] == 0);
  }
  const Cut again = make_cut(r, 1 + from.below(4));
  for (size_t k = 0; k < c.all().size(); k++) CALLS_CHECK(c.all()[k]->same_bits(*again.all()[k]));
  for (const Floats* array : c.all()) CALLS_CHECK(!r.tame || array->finite());
  const int felt = from.below(16), absent = from.one_in(2) ? 0 : from.below(1 << 9);
  for (int k = 0; k < 4; k++) {
    Floats* array[] = {&c.means, &c.cov3d, &c.opacities, &c.colors};
    if (felt >> k & 1)
      *array[k] = Floats();
    else if (array[k]->get())
      fill(*array[k], array[k]->size(), from, -1, 1);
  }
  c.point();
  const RecordingGradients g = differentiate(r, c, absent, 1 + from.below(4));
  const RecordingGradients same = differentiate(r, c, absent, 1 + from.below(4));
  for (size_t k = 0; k < g.all().size(); k++) {
    CALLS_CHECK(g.all()[k]->same_bits(*same.all()[k]));
    CALLS_CHECK(!r.tame || g.all()[k]->finite());
  }
}

}  // namespace calls
