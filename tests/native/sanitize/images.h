// Random pairs of images for the photometric loss, legal and not, and what must hold after each.
#pragma once

#include "calls.h"

namespace calls {

struct Pair {
  fragprune_photometric in{};
  Floats image, target, gradient;
  bool tame = true;
};

// Of a pixel or a few, of several panels across, or of several strips down.
inline Pair make_pair(Source& from) {
  Pair p;
  p.in.size = sizeof p.in;
  p.in.channels = 1 + from.below(3);
  const bool wide = from.one_in(4), high = !wide && from.one_in(4);
  p.in.width = 1 + from.below(wide ? 600 : 30), p.in.height = 1 + from.below(high ? 300 : 30);
  p.in.l1_weight = from.uniform(0, 1), p.in.ssim_weight = from.uniform(0, 1);
  const size_t size = static_cast<size_t>(p.in.channels) * p.in.width * p.in.height;
  fill(p.image, size, from, 0, 1);
  fill(p.target, size, from, 0, 1);
  p.tame = !from.one_in(4);
  if (!p.tame) p.image[from.next() % size] = from.poison();
  if (!from.one_in(3)) p.gradient.make(size);
  p.in.image = p.image.get(), p.in.target = p.target.get(), p.in.gradient = p.gradient.get();
  if (from.one_in(2)) p.in.workspace = shared_workspace();
  return p;
}

inline void try_illegal_pair(fragprune_photometric in, Tally& tally, Source& from) {
  const int32_t bad = from.one_in(2) ? -from.below(3) : 65537 + from.below(1 << 30);
  switch (from.below(7)) {
    case 0: in.size--; break;
    case 1: in.channels = bad; break;
    case 2: in.height = bad; break;
    case 3: in.width = bad; break;
    case 4: in.threads = bad; break;
    case 5: in.image = nullptr; break;
    default: in.target = nullptr;
  }
  fragprune_error error;
  CALLS_CHECK(fragprune_photometric_loss(&in, &error) == FRAGPRUNE_BAD_INPUT && error.message[0]);
  tally.refused++;
}

inline void run_loss(Source& from, Tally& tally) {
  Pair p = make_pair(from);
  p.in.threads = 1 + from.below(4);
  if (from.one_in(4)) try_illegal_pair(p.in, tally, from);
  CALLS_CHECK(fragprune_photometric_loss(&p.in, nullptr) == FRAGPRUNE_OK);
  CALLS_CHECK(p.gradient.written());
  CALLS_CHECK(!p.tame || (p.gradient.finite() && p.in.l1 >= 0 && p.in.dissimilarity <= 2));
  Floats again;
  again.make(p.gradient.size());
  fragprune_photometric in = p.in;
  in.threads = 1 + from.below(4), in.gradient = p.gradient.get() ? again.get() : nullptr;
  CALLS_CHECK(fragprune_photometric_loss(&in, nullptr) == FRAGPRUNE_OK);
  CALLS_CHECK(p.gradient.same_bits(again));
  CALLS_CHECK(!std::memcmp(&p.in.l1, &in.l1, 2 * sizeof in.l1));
  tally.losses++;
}

}  // namespace calls
