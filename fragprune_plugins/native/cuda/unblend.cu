// The way back: from gradients of the image to sums over each Gaussian's fragments, then through
// projection to the inputs.
//
// A block takes a tile, a warp its sub-tile, back to front, in buckets of a few Gaussians. First a
// lane is a pixel: it walks through the bucket and leaves two or three numbers of each fragment in
// shared memory. Then a lane is a Gaussian, or a part of one: it runs over pixels and keeps the
// Gaussian's sums in registers, so that nothing is folded but what the Gaussian's few lanes have.
// The sums leave once per bucket. What becomes of them is the caller's choice: added up where they
// belong (fast), or in the slot of the Gaussian's entry, warp after warp, to be added up in order
// later on (the same to the bit in each run).

#include "tile.cuh"

// What is wanted; each part that is not costs nothing.
#ifndef FP_GEOMETRY
#define FP_GEOMETRY 1
#endif
#ifndef FP_COLOUR
#define FP_COLOUR 1
#endif
#ifndef FP_THRESHOLD
#define FP_THRESHOLD 1
#endif
#ifndef FP_DEPTH  // gradients of inverse depth came
#define FP_DEPTH 1
#endif
#ifndef FP_ABSOLUTE
#define FP_ABSOLUTE 0
#endif
#ifndef FP_OFFSETS  // pixels are sampled off their places
#define FP_OFFSETS 0
#endif

namespace fp {

// Where a Gaussian's sums lie.
constexpr int kThresholdAt = 1, kGeometryAt = kThresholdAt + FP_THRESHOLD,
              kColourAt = kGeometryAt + 5 * FP_GEOMETRY, kDepthAt = kColourAt + 3 * FP_COLOUR,
              kAbsoluteAt = kDepthAt + FP_DEPTH, kFeaturesAt = kAbsoluteAt + FP_ABSOLUTE,
              kSums = kFeaturesAt + FP_FEATURES;

// What a lane leaves of a fragment: dL/d(log alpha), its rim's part of dL/d(threshold), its weight.
constexpr int kRimAt = 1, kWeightAt = kRimAt + FP_THRESHOLD,
              kParts = kWeightAt + (FP_COLOUR || FP_DEPTH || FP_FEATURES);
// What the sums read of a pixel.
constexpr int kInvDepthOf = 3 * FP_COLOUR, kFeaturesOf = kInvDepthOf + FP_DEPTH,
              kPlaceOf = kFeaturesOf + FP_FEATURES, kPlanes = kPlaceOf + 2 * FP_OFFSETS;

struct Undraw {
  Frame frame;
  fragprune_output_grads by;
  fragprune_input_grads to;
  const float* by_fragments;  // (1) by fragments_per_pixel, which `by` has no use for; or NULL
  float* background;          // (T, 3) tile by tile; or NULL
  float* sums;                // (N, kSums), or by slot (E, kSums), zero at first; or NULL
  float ceiling;              // alphas above have no gradient
};

#ifdef FP_UNDRAW_SIZE
static_assert(sizeof(Undraw) == FP_UNDRAW_SIZE, "engines/cuda.py has other fields in Undraw");
#endif

struct Rim {
  float threshold, inv_opacity;
};

// What a block shares, with buckets of so many Gaussians.
template <int kBucket>
struct RoomFor {
  static constexpr int kPitch = 32 * kParts + 4;  // lanes of two Gaussians meet in no bank
  Staged staged;
  Rim rims[FP_THRESHOLD ? kThreads : 1];
  alignas(16) float pixels[kPlanes ? kPlanes : 1][kThreads];
  alignas(16) float parts[kWarps][kBucket][kPitch];
  uint8_t met[kWarps][kThreads];  // those staged that reach the warp's sub-tile, back to front
  float light_by[kWarps][3];
  int32_t last[kWarps];
};
constexpr int kBucket = sizeof(RoomFor<8>) <= 48 << 10 ? 8 : 4;
using Room = RoomFor<kBucket>;
constexpr int kResident = kSums <= 10 ? 3 : 2;  // blocks, as many as registers allow

constexpr int kLanes = 32 / kBucket;  // that a Gaussian's pixels are shared out to, kBucket to each
constexpr int kEach = (kSums + kLanes - 1) / kLanes, kPadded = kEach * kLanes;

// Folds the first kCount numbers over the lanes of a Gaussian: then v[i] is the sum over them of
// number i kLanes + lane % kLanes.
template <int kCount, int kWidth>
__device__ inline void fold(float (&v)[kPadded]) {
  const bool upper = (lane_of() & kWidth) != 0;
#pragma unroll
  for (int i = 0; i < kCount / 2; i++) {
    const float low = v[2 * i], high = v[2 * i + 1];
    v[i] = (upper ? high : low) + __shfl_xor_sync(kAll, upper ? low : high, kWidth);
  }
  if constexpr (2 * kWidth < kLanes) fold<kCount / 2, 2 * kWidth>(v);
}

// A pixel's gradients, and its place on the way from its last fragment to its first.
struct LossPixel {
  float r, g, b, inv_z;
#if FP_FEATURES
  float features[FP_FEATURES];
#endif
  float light;   // transmittance behind the fragment in hand
  float behind;  // gradient of all that lies behind it, weighted
};

// dL/dw of a Gaussian's weight in a pixel.
template <class B>
__device__ inline float shade_of(const Frame& f, const B& b, uint32_t entry, const LossPixel& p) {
  float shade = fma(p.b, b.b, fma(p.g, b.g, p.r * b.r));
#if FP_DEPTH
  shade = fma(p.inv_z, b.inv_z, shade);
#endif
#if FP_FEATURES
  const float* features = f.in.features + size_t{FP_FEATURES} * row_of(f, entry);
#pragma unroll
  for (int k = 0; k < FP_FEATURES; k++) shade = fma(p.features[k], features[k], shade);
#endif
  return shade;
}

// Takes a pixel from behind a fragment before its stop to before it; what is left of the fragment.
__device__ inline void unblend(const Undraw& u, const LocalBrush<float>& b, const Rim& rim,
                               uint32_t entry, float per_fragment, const Meeting<float>& m,
                               LossPixel& p, float (&parts)[kParts]) {
  const Frame& f = u.frame;
  const bool drawn = m.exponent >= b.cut;
  const float uncapped = exp2(m.exponent), full = min(uncapped, f.in.alpha_max);
  const float alpha = drawn ? full : 0.f;
  const float inv = reciprocal(1.f - alpha);
  const float light = p.light * inv;
  const float shade = shade_of(f, b, entry, p), weight = alpha * light;
  const float by_alpha = fnma(p.behind, inv, light * shade);
  p.light = light;
  p.behind = fma(weight, shade, p.behind);
  parts[0] = drawn && uncapped <= u.ceiling ? uncapped * by_alpha : 0.f;
#if FP_THRESHOLD
  const float away = abs(uncapped * rim.inv_opacity - rim.threshold);
  if (away <= kRimHorizon)
    parts[kRimAt] = -fma(full, by_alpha, per_fragment) * rim_density(away);
#endif
  if constexpr (kParts > kWeightAt) parts[kWeightAt] = weight;
}

// Four numbers that lie side by side.
struct Four {
  float at[4];
};
__device__ inline Four load4(const float* from) {
  const float4 v = *reinterpret_cast<const float4*>(from);
  return {{v.x, v.y, v.z, v.w}};
}

// The sums of the Gaussian staged[j], this lane's in the bucket, over the lane's pixels.
__device__ inline void gather(const Frame& f, const Room& room, int j, float (&v)[kPadded]) {
  const int its = lane_of() / kLanes, first = lane_of() % kLanes * kBucket;  // pixel
#pragma unroll
  for (int k = 0; k < kPadded; k++) v[k] = 0.f;
#if FP_GEOMETRY
  const LocalBrush<float> b = room.staged.get(j);
  const int x = (warp_of() & 1) * kSubWidth + first % kSubWidth;
  const int y = (warp_of() >> 1) * kSubHeight + first / kSubWidth;
  const Meeting<float> start = meet(b, static_cast<float>(x), static_cast<float>(y));
#endif
#pragma unroll
  for (int i = 0; i < kBucket; i += 4) {
    const auto part = [&](int k) { return load4(&room.parts[warp_of()][its][32 * k + first + i]); };
    const auto pixel = [&](int k) { return load4(&room.pixels[k][32 * warp_of() + first + i]); };
    const auto add = [&](int to, const Four& of) {
#pragma unroll
      for (int k = 0; k < 4; k++) v[to] += of.at[k];
    };
    const auto weigh = [&](int to, const Four& of, const Four& by) {
#pragma unroll
      for (int k = 0; k < 4; k++) v[to] = fma(of.at[k], by.at[k], v[to]);
    };
    const Four w = part(0);
    add(0, w);
#if FP_THRESHOLD
    add(kThresholdAt, part(kRimAt));
#endif
#if FP_GEOMETRY
    Four us, vs, wu, wv;
#if FP_OFFSETS
    const Four px = pixel(kPlaceOf), py = pixel(kPlaceOf + 1);
#endif
#pragma unroll
    for (int k = 0; k < 4; k++) {
#if FP_OFFSETS
      const Meeting<float> m = meet(b, px.at[k], py.at[k]);
      us.at[k] = m.u, vs.at[k] = m.v;
#else
      us.at[k] = fma(b.scale, static_cast<float>(i + k), start.u), vs.at[k] = start.v;
#endif
      wu.at[k] = w.at[k] * us.at[k], wv.at[k] = w.at[k] * vs.at[k];
#if FP_ABSOLUTE
      // the exponent by the mean: 2 u scale, 2 (u skew + v down)
      constexpr float ln2 = 0.69314718f;
      v[kAbsoluteAt] +=
          ln2 * (static_cast<float>(f.in.width) * abs(wu.at[k] * b.scale) +
                 static_cast<float>(f.in.height) * abs(wu.at[k] * b.skew + wv.at[k] * b.down));
#endif
    }
    add(kGeometryAt, wu);
    weigh(kGeometryAt + 2, wu, us);
#if FP_OFFSETS
    add(kGeometryAt + 1, wv);
    weigh(kGeometryAt + 3, wu, vs);
    weigh(kGeometryAt + 4, wv, vs);
#endif
#endif
    if constexpr (kParts > kWeightAt) {
      const Four weight = part(kWeightAt);
      // where it draws alone: what a pixel asks for may be NaN
      const auto tint = [&](int to, const Four& by) {
#pragma unroll
        for (int k = 0; k < 4; k++)
          if (weight.at[k] != 0.f) v[to] = fma(weight.at[k], by.at[k], v[to]);
      };
#pragma unroll
      for (int k = 0; k < 3 * FP_COLOUR; k++) tint(kColourAt + k, pixel(k));
      if constexpr (FP_DEPTH) tint(kDepthAt, pixel(kInvDepthOf));
#pragma unroll
      for (int k = 0; k < FP_FEATURES; k++) tint(kFeaturesAt + k, pixel(kFeaturesOf + k));
    }
  }
#if FP_GEOMETRY && !FP_OFFSETS  // the lane's pixels lie in one row: their v is one
  v[kGeometryAt + 1] = start.v * v[0];
  v[kGeometryAt + 3] = start.v * v[kGeometryAt];
  v[kGeometryAt + 4] = start.v * v[kGeometryAt + 1];
#endif
}

// What a pixel's stop left out is taken to look like its last fragment.
__device__ inline LossPixel load_loss(const Undraw& u, const Pixel& p, const Range& range) {
  const Frame& f = u.frame;
  const size_t plane = static_cast<size_t>(f.in.width) * f.in.height;
  const auto at = [&](const float* of, size_t channel) {
    return of && p.inside ? of[channel * plane + p.at] : 0.f;
  };
  LossPixel l;
  l.r = at(u.by.image, 0), l.g = at(u.by.image, 1), l.b = at(u.by.image, 2);
  l.inv_z = at(u.by.invdepth, 0);
#if FP_FEATURES
#pragma unroll
  for (int k = 0; k < FP_FEATURES; k++) l.features[k] = at(u.by.features, k);
#endif
  l.light = p.inside ? f.transmittance[p.at] : 1.f;
  const float* back = f.in.background;
  float shade = l.r * back[0] + l.g * back[1] + l.b * back[2] - at(u.by.alpha, 0);
  if (l.light < f.in.stop) {
    const uint32_t last = f.entry_values[range.first + f.stop[p.at] - 1];
    shade = shade_of(f, load_brush(f.brushes, row_of(f, last)), last, l);
  }
  l.behind = l.light * shade;
  return l;
}

// What the sums will read of a pixel.
__device__ inline void share(Room& room, const Pixel& p, const LossPixel& l) {
  const auto put = [&](int plane, float v) { room.pixels[plane][threadIdx.x] = v; };
#if FP_COLOUR
  put(0, l.r), put(1, l.g), put(2, l.b);
#endif
#if FP_DEPTH
  put(kInvDepthOf, l.inv_z);
#endif
#if FP_FEATURES
#pragma unroll
  for (int k = 0; k < FP_FEATURES; k++) put(kFeaturesOf + k, l.features[k]);
#endif
#if FP_OFFSETS
  put(kPlaceOf, p.px), put(kPlaceOf + 1, p.py);
#endif
}

// ---- the chain -------------------------------------------------------------------------------

// Writes dL/dsh, returns dL/dmean through the direction.
template <int kDegree>
__device__ inline Vec3 unshade(const Undraw& u, const Camera<float>& c, const Vec3& mean, size_t i,
                               const PixelSums<float>& sums) {
  const fragprune_inputs& in = u.frame.in;
  float inv_length;
  const Vec3 direction = direction_to(c.centre, mean, inv_length);
  Harmonics<float> h;
  const int terms = harmonics(kDegree, direction, h, kDegree > 0);
  const size_t row = 3 * static_cast<size_t>(in.sh_coefficients) * i;
  const auto coefficient = [&](int k) { return read3(in.sh + row + 3 * k); };
  const Vec3 g = through_clamp(raw_colour(h, terms, coefficient), {sums.r, sums.g, sums.b});
  if (u.to.sh) {
#pragma unroll
    for (int k = 0; k < terms; k++) write3(u.to.sh + row, k, h.value[k] * g);
    for (int k = terms; k < in.sh_coefficients; k++) write3(u.to.sh + row, k, {0.f, 0.f, 0.f});
  }
  if (kDegree == 0 || !u.to.means) return {0.f, 0.f, 0.f};
  return direction_gradient(h, terms, direction, inv_length, g, coefficient);
}

__device__ inline Vec3 unshade(const Undraw& u, const Camera<float>& c, const Vec3& mean, size_t i,
                               const PixelSums<float>& sums) {
  switch (u.frame.in.sh_degree) {
    case 0: return unshade<0>(u, c, mean, i, sums);
    case 1: return unshade<1>(u, c, mean, i, sums);
    case 2: return unshade<2>(u, c, mean, i, sums);
    default: return unshade<3>(u, c, mean, i, sums);
  }
}

__device__ inline void unproject(const Undraw& u, const Camera<float>& c, size_t i, Vec3 by_mean,
                                 const PixelSums<float>& sums) {
  const Given<float> given = load_given(u.frame.in, i);
  Projection<float> p;
  project(c, given, p);
  const ImageGradient<float> g = image_gradient(c, p, sums);
  write3(u.to.hook, i, {g.x * 0.5f * c.width, g.y * 0.5f * c.height, sums.absolute});
  Mat3<float> m;
  Vec3 view = shape_gradient(c, p, shape_of(c, given), g, m);
  view.z = view.z - sums.inv_z / (p.view.z * p.view.z);
  write3(u.to.means, i, by_mean + mean_gradient(c, given.mean, g, view));
  if (u.to.cov3d) {  // an off-diagonal entry stands for two
    write3(u.to.cov3d, 2 * i, {m.row[0].x, m.row[0].y + m.row[1].x, m.row[0].z + m.row[2].x});
    write3(u.to.cov3d, 2 * i + 1, {m.row[1].y, m.row[1].z + m.row[2].y, m.row[2].z});
  }
  if (u.to.scales) {
    const Mat3<float> r = rotation_of(given.rotation);
    const Vec3 by_size =
        times(r.row[0], m.row[0]) + times(r.row[1], m.row[1]) + times(r.row[2], m.row[2]);
    write3(u.to.scales, i, c.scale_modifier * by_size);
  }
  if (u.to.rotations) {
    const Vec3 size = c.scale_modifier * given.scale;
    for (Vec3& row : m.row) row = times(row, size);
    float by[4];
    rotation_gradient(given.rotation, m, by);
    for (int k = 0; k < 4; k++) u.to.rotations[4 * i + k] = by[k];
  }
}

// The same for those that were given on the image.
__device__ inline void unproject_footprint(const Undraw& u, const Camera<float>& c, size_t i,
                                           const PixelSums<float>& sums) {
  const fragprune_inputs& in = u.frame.in;
  const FootprintGradient<float> g = footprint_gradient(
      square_of(in.conics[3 * i], in.conics[3 * i + 1], in.conics[3 * i + 2]), sums);
  write3(u.to.hook, i, {g.x * 0.5f * c.width, g.y * 0.5f * c.height, sums.absolute});
  if (u.to.means2d) u.to.means2d[2 * i] = g.x, u.to.means2d[2 * i + 1] = g.y;
  write3(u.to.conics, i, {g.xx, g.xy, g.yy});
  if (u.to.depths) u.to.depths[i] = -sums.inv_z / (in.depths[i] * in.depths[i]);
}

// Of a Gaussian that drew nothing.
__device__ inline void write_zeros(const Undraw& u, size_t i) {
  const auto clear = [i](float* to, size_t width) {
    if (to)
      for (size_t k = 0; k < width; k++) to[width * i + k] = 0.f;
  };
  clear(u.to.means, 3), clear(u.to.hook, 3), clear(u.to.opacities, 1), clear(u.to.scales, 3);
  clear(u.to.rotations, 4), clear(u.to.cov3d, 6), clear(u.to.colors, 3), clear(u.to.thresholds, 1);
  clear(u.to.means2d, 2), clear(u.to.conics, 3), clear(u.to.depths, 1);
  clear(u.to.sh, 3 * static_cast<size_t>(u.frame.in.sh_coefficients));
  clear(u.to.features, FP_FEATURES);
}

// Lists those of the staged before `end` that reach the warp's sub-tile, back to front; how many.
__device__ inline int meet_those(const Staged& staged, int32_t end, uint8_t (&met)[kThreads]) {
  int count = 0;
#pragma unroll 1
  for (int base = kThreads - 32; base >= 0; base -= 32) {
    if (base >= end) continue;
    const uint32_t word = staged.word(base), from_here = word >> lane_of();
    if (from_here & 1)
      met[count + __popc(from_here >> 1)] = static_cast<uint8_t>(base + lane_of());
    count += __popc(word);
  }
  __syncwarp();
  return count;
}

// ---- kernels ---------------------------------------------------------------------------------

FP_KERNEL(fp_unblend, Undraw, kResident) {
  const Frame& frame = f.frame;
  __shared__ Room room;
  const int warp = warp_of(), lane = lane_of();
  const Pixel p = pixel_of(frame);
  const Range range = frame.ranges[blockIdx.x];
  LossPixel loss = load_loss(f, p, range);
  const int32_t stop = p.inside ? frame.stop[p.at] : 0;
  const float per_fragment =
      f.by_fragments ? *f.by_fragments / (static_cast<float>(frame.in.width) *
                                          static_cast<float>(frame.in.height))
                     : 0.f;
  const float seen = p.inside ? loss.light : 0.f;
  const float by[3] = {warp_sum(seen * loss.r), warp_sum(seen * loss.g), warp_sum(seen * loss.b)};
  int32_t furthest = stop;  // of the warp's pixels
  for (int step = 16; step > 0; step >>= 1) {
    const int32_t other = __shfl_xor_sync(kAll, furthest, step);
    furthest = furthest > other ? furthest : other;
  }
  if (lane == 0) {
    for (int k = 0; k < 3; k++) room.light_by[warp][k] = by[k];
    room.last[warp] = furthest;
  }
  share(room, p, loss);
  __syncthreads();
  if (f.background && threadIdx.x < 3) {
    float total = 0.f;
    for (int w = 0; w < kWarps; w++) total += room.light_by[w][threadIdx.x];
    f.background[size_t{3} * blockIdx.x + threadIdx.x] = total;
  }
  if (!f.sums) return;
  int32_t end = 0;
  for (int w = 0; w < kWarps; w++) end = end > room.last[w] ? end : room.last[w];
  for (int32_t first = (end - 1) / kThreads * kThreads; end > 0 && first >= 0; first -= kThreads) {
    const int32_t mine = first + static_cast<int32_t>(threadIdx.x);
    room.staged.reached[threadIdx.x] = 0;
    if (mine < end) {
      const uint32_t value = frame.entry_values[range.first + mine];
      const uint32_t row = row_of(frame, value);
      const Brush<float> brush = load_brush(frame.brushes, row);
      room.staged.put(threadIdx.x, brush, value, p);
      room.staged.reached[threadIdx.x] = frame.reached[range.first + mine];
#if FP_THRESHOLD
      room.rims[threadIdx.x] = {frame.in.thresholds ? frame.in.thresholds[row] : 0.f,
                                exp2(-brush.log_opacity)};
#endif
    }
    __syncthreads();
    uint8_t(&met)[kThreads] = room.met[warp];
    const int count = meet_those(room.staged, furthest - first, met);
    int next = 0;
    for (bool more = count > 0 || frame.owners; more;) {
      int filled = 0, its = 0;  // Gaussians in the bucket; the one that this lane will be a part of
      float* slot = room.parts[warp][0] + lane;
      while (filled < kBucket && next < count) {
        const int j = met[next++];
        const LocalBrush<float> b = room.staged.get(j);
        const Meeting<float> m = meet(b, p.px, p.py);
        const bool reached = m.exponent >= room.staged.c[j].w && j < stop - first;
        if (!__any_sync(kAll, reached)) continue;
        float parts[kParts] = {};
        if (reached)
          unblend(f, b, room.rims[FP_THRESHOLD ? j : 0], room.staged.row[j], per_fragment, m, loss,
                  parts);
#pragma unroll
        for (int k = 0; k < kParts; k++) slot[32 * k] = parts[k];
        slot += Room::kPitch;
        if (lane / kLanes == filled) its = j;
        filled++;
      }
      __syncwarp();
      float v[kPadded];
      if (filled > 0) {
        gather(frame, room, its, v);
        fold<kPadded, 1>(v);
      }
      const auto give = [&] {
        if (lane / kLanes >= filled) return;
        float* to = f.sums + (size_t{kSums} * room.staged.row[its] + lane % kLanes);
#pragma unroll
        for (int i = 0; i < kEach; i++)
          if ((i + 1) * kLanes <= kSums || i * kLanes + lane % kLanes < kSums)
            atomicAdd(to + i * kLanes, v[i]);
      };
      more = next < count;
      if (frame.owners) {  // one warp after the other
#pragma unroll 1
        for (int turn = 0; turn < kWarps; turn++) {
          if (turn == warp) give();
          __syncthreads();
        }
        more = !__syncthreads_and(!more);
      } else {
        give();
        __syncwarp();
      }
    }
    __syncthreads();
  }
}

// One thread per Gaussian: from its sums to its inputs.
FP_KERNEL(fp_chain, Undraw, 2) {
  const Frame& frame = f.frame;
  __shared__ Camera<float> camera;
  if (threadIdx.x == 0) camera = camera_of(frame);
  __syncthreads();
  const size_t i = size_t{blockIdx.x} * kThreads + threadIdx.x;
  if (i >= static_cast<size_t>(frame.in.count)) return;
  const uint32_t tiles = frame.tiles[i];
  if (tiles == 0) return write_zeros(f, i);
  float v[kSums];
  const float* from = f.sums + size_t{kSums} * (frame.owners ? frame.first_slot[i] : i);
#pragma unroll
  for (int k = 0; k < kSums; k++) v[k] = from[k];
  if (frame.owners)
    for (uint32_t t = 1; t < tiles; t++) {
      from += kSums;
#pragma unroll
      for (int k = 0; k < kSums; k++) v[k] += from[k];
    }
  if (f.to.opacities) f.to.opacities[i] = v[0] / frame.in.opacities[i];  // alpha is proportional to it
#if FP_THRESHOLD
  if (f.to.thresholds) f.to.thresholds[i] = v[kThresholdAt];
#endif
#if FP_FEATURES
  if (f.to.features)
    for (int k = 0; k < FP_FEATURES; k++) f.to.features[size_t{FP_FEATURES} * i + k] = v[kFeaturesAt + k];
#endif
  PixelSums<float> s = {};
  s.w = v[0];
  Vec3 by_mean = {0.f, 0.f, 0.f};
#if FP_COLOUR
  s.r = v[kColourAt], s.g = v[kColourAt + 1], s.b = v[kColourAt + 2];
  write3(f.to.colors, i, {s.r, s.g, s.b});
  if (frame.in.sh) by_mean = unshade(f, camera, read3(frame.in.means + 3 * i), i, s);
#endif
#if FP_GEOMETRY
  s.u = v[kGeometryAt], s.v = v[kGeometryAt + 1];
  s.uu = v[kGeometryAt + 2], s.uv = v[kGeometryAt + 3], s.vv = v[kGeometryAt + 4];
#if FP_DEPTH
  s.inv_z = v[kDepthAt];
#endif
#if FP_ABSOLUTE
  s.absolute = v[kAbsoluteAt];
#endif
  if (frame.in.means2d)
    unproject_footprint(f, camera, i, s);
  else
    unproject(f, camera, i, by_mean, s);
#endif
}

}  // namespace fp
