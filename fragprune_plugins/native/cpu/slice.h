// Slices of Gaussians in space and time: kLanes at a time through the mathematics of moment.h.
#pragma once

#include "moment.h"
#include "rows.h"
#include "threads.h"

namespace fp {

// Rows of the inputs, and what all of them share.
class SpacetimeRows {
 public:
  explicit SpacetimeRows(const fragprune_spacetime& in)
      : m(lift<Lanes>(unpack_moment(in))), in_(in), means_(in.means, in.count),
        scales_(in.scales, in.count), width(3 * static_cast<size_t>(in.sh_coefficients)) {}

  Vec<Lanes> mean(const uint32_t* ids) const { return means_.load(ids); }
  Lanes time(const uint32_t* ids) const { return numbers(in_.times, ids); }

  Spacetime<Lanes> load(const uint32_t* ids) const {
    Spacetime<Lanes> g = Spacetime<Lanes>();
    g.mean = mean(ids);
    g.opacity = numbers(in_.opacities, ids);
    if (m.kind == kSliced) {
      const auto row = [&](int i) { return in_.cov3d + 6 * size_t{ids[i]}; };
      load_columns(row, g.cov3d);
      load_columns([&](int i) { return row(i) + 2; }, g.cov3d + 2);
      return g;
    }
    const Vec<Lanes> scale = scales_.load(ids);
    g.scale[0] = scale.x, g.scale[1] = scale.y, g.scale[2] = scale.z;
    load_columns([&](int i) { return in_.rotations + 4 * size_t{ids[i]}; }, g.left);
    if (m.kind == kStill) return g;
    g.scale[3] = numbers(in_.scales_t, ids);
    g.time = time(ids);
    if (m.kind == kJoint)
      load_columns([&](int i) { return in_.rotations_r + 4 * size_t{ids[i]}; }, g.right);
    return g;
  }

  // The coefficients of what the cosines add up to, and of the highest alone.
  void coefficients(const uint32_t* ids, int terms, const Waves<Lanes>& w, Coefficients& all,
                    Coefficients& top) const {
    const size_t used = 3 * static_cast<size_t>(terms);
    load_numbers(in_.sh, width, ids, used, all.column);
    for (int order = 1; order <= m.orders; order++) {
      load_numbers(in_.sh + 3 * kBands * order, width, ids, used, top.column);
      const Lanes wave = order == 1 ? w.first : w.second;
      for (int k = 0; k < 3 * terms; k++)
        all.column[k] = fma(wave, top.column[k], all.column[k]);
    }
  }

  Waves<Lanes> waves(const uint32_t* ids) const {
    return waves_of(m, m.orders ? time(ids) : broadcast<Lanes>(0.f));
  }

  const Moment<Lanes> m;

 private:
  static Lanes numbers(const float* from, const uint32_t* ids) {
    Lanes v;
    for (int i = 0; i < kLanes; i++) v[i] = from[ids[i]];
    return v;
  }

  const fragprune_spacetime& in_;
  const Triples means_, scales_;

 public:
  const size_t width;  // of a row of sh
};

// Calls work(who) for rows [begin, end) that `wanted` says yes to, kLanes at a time.
template <class Wanted, class Work>
inline void pick(size_t begin, size_t end, Wanted wanted, Work work) {
  Picked who;
  who.count = 0;
  for (size_t i = begin; i < end; i++) {
    if (wanted(i)) who.ids[who.count++] = static_cast<uint32_t>(i);
    if (who.count < kLanes && (i + 1 < end || !who.count)) continue;
    for (int lane = who.count; lane < kLanes; lane++) who.ids[lane] = who.ids[who.count - 1];
    work(who);
    who.count = 0;
  }
}

inline void slice_rows(const SpacetimeRows& rows, const fragprune_spacetime& in,
                       const fragprune_sliced& to, size_t begin, size_t end) {
  const Lanes none = broadcast<Lanes>(0.f);
  const auto all = [](size_t) { return true; };
  pick(begin, end, all, [&](const Picked& who) {
    Sliced<Lanes> s;
    const Mask present = slice(rows.m, rows.load(who.ids), s);
    const Vec<Lanes>& away = rows.m.centre;
    who.write(to.means, {select(present, s.mean.x, away.x), select(present, s.mean.y, away.y),
                         select(present, s.mean.z, away.z)});
    for (Lanes& v : s.cov3d) v = select(present, v, none);
    who.write<6>(to.cov3d, s.cov3d);
    s.opacity = select(present, s.opacity, none);
    who.write<1>(to.opacities, &s.opacity);
    for (int lane = 0; lane < who.count; lane++)
      to.present[who.ids[lane]] = bits(present) >> lane & 1;
  });
  if (!in.sh) return;
  std::fill(to.colors + 3 * begin, to.colors + 3 * end, 0.f);
  pick(begin, end, [&](size_t i) { return to.present[i]; }, [&](const Picked& who) {
    Lanes inv_length;
    Harmonics<Lanes> h;
    const Vec<Lanes> direction = direction_to(rows.m.centre, rows.mean(who.ids), inv_length);
    const int terms = harmonics(in.sh_degree, direction, h, false);
    Coefficients coefficients, top;
    rows.coefficients(who.ids, terms, rows.waves(who.ids), coefficients, top);
    const Vec<Lanes> c = raw_colour(h, terms, coefficients);
    who.write(to.colors, {lit(c.x), lit(c.y), lit(c.z)});
  });
}

// From gradients by the slice to gradients by what was cut.
class Unslicer {
 public:
  Unslicer(const fragprune_spacetime& in, const fragprune_sliced& by,
           const fragprune_spacetime_grads& to)
      : in_(in), by_(by), to_(to), rows_(in), by_means_(by.means, in.count),
        by_colors_(by.colors, in.count) {}

  void run(size_t begin, size_t end) const {
    const struct {
      float* data;
      size_t width;
    } arrays[] = {{to_.means, 3},    {to_.opacities, 1}, {to_.times, 1},     {to_.scales, 3},
                  {to_.scales_t, 1}, {to_.rotations, 4}, {to_.rotations_r, 4}, {to_.cov3d, 6},
                  {to_.sh, rows_.width}};
    for (size_t i = begin; i < end; i++)
      for (const auto& [data, width] : arrays)
        if (data && !by_.present[i]) std::fill_n(data + i * width, width, 0.f);
    pick(begin, end, [&](size_t i) { return by_.present[i]; },
         [&](const Picked& who) { chain(who); });
  }

 private:
  void chain(const Picked& who) const {
    const Spacetime<Lanes> given = rows_.load(who.ids);
    Sliced<Lanes> by = Sliced<Lanes>();
    if (by_.means) by.mean = by_means_.load(who.ids);
    for (int i = 0; i < kLanes; i++) {
      if (by_.opacities) by.opacity[i] = by_.opacities[who.ids[i]];
      for (int k = 0; by_.cov3d && k < 6; k++)
        by.cov3d[k][i] = by_.cov3d[6 * size_t{who.ids[i]} + static_cast<size_t>(k)];
    }
    Lanes by_time = broadcast<Lanes>(0.f);
    if (in_.sh && (to_.sh || (by_.colors && moves_))) colour(who, given, by, by_time);
    Spacetime<Lanes> g = slice_gradient(rows_.m, given, by);
    g.time = g.time + by_time;
    who.write(to_.means, g.mean);
    who.write<1>(to_.opacities, &g.opacity);
    who.write<1>(to_.times, &g.time);
    who.write(to_.scales, {g.scale[0], g.scale[1], g.scale[2]});
    who.write<1>(to_.scales_t, g.scale + 3);
    who.write<4>(to_.rotations, g.left);
    who.write<4>(to_.rotations_r, g.right);
    who.write<6>(to_.cov3d, g.cov3d);
  }

  // Writes dL/dsh, adds what acts through direction and time. The host differentiates colours as if
  // they had been seen where the moment has moved the means.
  void colour(const Picked& who, const Spacetime<Lanes>& given, Sliced<Lanes>& by,
              Lanes& by_time) const {
    const Moment<Lanes>& m = rows_.m;
    Lanes inv_length;
    Harmonics<Lanes> h;
    const int terms = harmonics(in_.sh_degree, direction_to(m.centre, given.mean, inv_length), h,
                                false);
    const Waves<Lanes> w = rows_.waves(who.ids);
    Coefficients all, top;
    rows_.coefficients(who.ids, terms, w, all, top);
    const Vec<Lanes> colour = by_.colors ? by_colors_.load(who.ids) : Vec<Lanes>();
    const Vec<Lanes> g = through_clamp(raw_colour(h, terms, all), colour);
    Sliced<Lanes> at;
    slice(m, given, at);
    const Vec<Lanes> direction = direction_to(m.centre, at.mean, inv_length);
    harmonics(in_.sh_degree, direction, h, moves_);
    if (to_.sh) {
      Coefficients by_sh;
      const size_t used = 3 * static_cast<size_t>(terms);
      for (int order = 0; order <= m.orders; order++) {
        for (int k = 0; k < terms; k++)
          by_sh.set(k, order == 0   ? given_harmonic(m, h, k) * g
                       : order == 1 ? (w.first * h.value[k]) * g
                                    : (w.second * h.value[k]) * g);
        store_numbers(by_sh.column, used, who, to_.sh + 3 * kBands * order, rows_.width);
      }
      clear_rest(who, to_.sh, m.orders ? size_t{3} * kBands * (m.orders + 1) : used, rows_.width);
    }
    if (!moves_) return;
    by.mean = by.mean + direction_gradient(h, terms, direction, inv_length, g, all);
    if (!m.orders) return;
    Vec<Lanes> wave = Vec<Lanes>();
    for (int k = 0; k < terms; k++) wave = add_scaled(wave, h.value[k], top(k));
    by_time = dot(g, wave) * w.slope;
  }

  const fragprune_spacetime& in_;
  const fragprune_sliced& by_;
  const fragprune_spacetime_grads& to_;
  const SpacetimeRows rows_;
  const Triples by_means_, by_colors_;
  // Something is wanted that moves a mean, or the time itself.
  const bool moves_ = to_.means || to_.times || to_.scales || to_.scales_t || to_.rotations ||
                      to_.rotations_r;
};

}  // namespace fp
