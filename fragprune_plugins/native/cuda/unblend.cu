// The way back: from gradients of the image to sums over each Gaussian's fragments, then through
// projection to the inputs.
//
// A block takes a tile, a warp its sub-tile, back to front. The sums of one Gaussian over a warp's
// pixels are folded by a butterfly that halves how many there are at each step; those of the block's
// warps are added in shared memory, in order, and leave it as one number each. What becomes of them
// is the caller's choice: added up where they belong (fast), or put in the slot of the Gaussian's
// entry, to be added up in order later on (the same to the bit in each run).

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

namespace fp {

// Where a Gaussian's sums lie.
constexpr int kThresholdAt = 1, kGeometryAt = kThresholdAt + FP_THRESHOLD,
              kColourAt = kGeometryAt + 5 * FP_GEOMETRY, kDepthAt = kColourAt + 3 * FP_COLOUR,
              kAbsoluteAt = kDepthAt + FP_DEPTH, kFeaturesAt = kAbsoluteAt + FP_ABSOLUTE,
              kSums = kFeaturesAt + FP_FEATURES;

constexpr int padded(int n) {
  int p = 1;
  while (p < n) p *= 2;
  return p;
}
constexpr int kPadded = padded(kSums);

struct Undraw {
  Frame frame;
  fragprune_output_grads by;
  fragprune_input_grads to;
  const float* by_fragments;  // (1) by fragments_per_pixel, which `by` has no use for; or NULL
  float* background;          // (T, 3) tile by tile; or NULL
  float* sums;                // (N, kSums), or by slot (E, kSums), zero at first; or NULL
};

#ifdef FP_UNDRAW_SIZE
static_assert(sizeof(Undraw) == FP_UNDRAW_SIZE, "engines/cuda.py has other fields in Undraw");
#endif

// Folds the first 2 kHalf numbers of each of 32 lanes to kHalf, then those, and so on.
template <int kHalf>
__device__ inline void halve(float (&v)[kPadded]) {
  constexpr int width = 32 * kHalf / kPadded;
  const bool upper = (lane_of() & width) != 0;
#pragma unroll
  for (int i = 0; i < kHalf; i++) {
    const float low = v[i], high = v[i + kHalf];
    v[i] = (upper ? high : low) + __shfl_xor_sync(kAll, upper ? low : high, width);
  }
  if constexpr (kHalf > 1) halve<kHalf / 2>(v);
}

// Returns the sum over all lanes of number lane / (32 / kPadded).
__device__ inline float fold(float (&v)[kPadded]) {
  if constexpr (kPadded > 1) halve<kPadded / 2>(v);
  float sum = v[0];
#pragma unroll
  for (int width = 16 / kPadded; width >= 1; width /= 2)
    sum += __shfl_xor_sync(kAll, sum, width);
  return sum;
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

struct Rim {
  float threshold, inv_opacity;
};

// Adds nothing to `v`: fills it in, for one fragment before its pixel's stop.
__device__ inline void unblend(const Frame& f, const LocalBrush<float>& b, const Rim& rim,
                               const float* features, float per_fragment, const Meeting<float>& m,
                               LossPixel& p, float (&v)[kPadded]) {
  const bool drawn = m.exponent >= b.cut;
  const float uncapped = exp2(m.exponent), full = min(uncapped, f.in.alpha_max);
  const float alpha = drawn ? full : 0.f;
  const float inv = reciprocal(1.f - alpha);
  const float light = p.light * inv;
  float shade = fma(p.b, b.b, fma(p.g, b.g, p.r * b.r));
#if FP_DEPTH
  shade = fma(p.inv_z, b.inv_z, shade);
#endif
#if FP_FEATURES
#pragma unroll
  for (int k = 0; k < FP_FEATURES; k++) shade = fma(p.features[k], features[k], shade);
#endif
  const float weight = alpha * light;
  const float by_alpha = fnma(p.behind, inv, light * shade);
  p.light = light;
  p.behind = fma(weight, shade, p.behind);
  const bool passes = drawn && (f.in.cap_gradient || uncapped <= f.in.alpha_max);
  const float w = passes ? uncapped * by_alpha : 0.f;
  v[0] = w;
#if FP_THRESHOLD
  const float away = abs(uncapped * rim.inv_opacity - rim.threshold);
  if (away <= kRimHorizon)
    v[kThresholdAt] = -fma(full, by_alpha, per_fragment) * rim_density(away);
#endif
#if FP_GEOMETRY
  const float wu = w * m.u, wv = w * m.v;
  v[kGeometryAt] = wu;
  v[kGeometryAt + 1] = wv;
  v[kGeometryAt + 2] = wu * m.u;
  v[kGeometryAt + 3] = wu * m.v;
  v[kGeometryAt + 4] = wv * m.v;
#endif
#if FP_ABSOLUTE
  // the exponent by the mean: 2 u scale, 2 (u skew + v down)
  constexpr float ln2 = 0.69314718f;
  v[kAbsoluteAt] =
      ln2 * (static_cast<float>(f.in.width) * abs(w * m.u * b.scale) +
             static_cast<float>(f.in.height) * abs(w * (m.u * b.skew + m.v * b.down)));
#endif
#if FP_COLOUR
  v[kColourAt] = weight * p.r;
  v[kColourAt + 1] = weight * p.g;
  v[kColourAt + 2] = weight * p.b;
#endif
#if FP_DEPTH
  v[kDepthAt] = weight * p.inv_z;
#endif
#if FP_FEATURES
#pragma unroll
  for (int k = 0; k < FP_FEATURES; k++) v[kFeaturesAt + k] = weight * p.features[k];
#endif
}

__device__ inline LossPixel load_loss(const Undraw& u, const Pixel& p) {
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
  l.behind = l.light * (l.r * back[0] + l.g * back[1] + l.b * back[2] - at(u.by.alpha, 0));
  return l;
}

// ---- the chain -------------------------------------------------------------------------------

__device__ inline void write3(float* to, size_t i, const Vec3& v) {
  if (to) to[3 * i] = v.x, to[3 * i + 1] = v.y, to[3 * i + 2] = v.z;
}

// Writes dL/dsh, returns dL/dmean through the direction.
template <int kDegree>
__device__ inline Vec3 unshade(const Undraw& u, const Camera<float>& c, const Vec3& mean, size_t i,
                               const PixelSums<float>& sums) {
  const fragprune_inputs& in = u.frame.in;
  float inv_length;
  const Vec3 direction = direction_to(c, mean, inv_length);
  Harmonics<float> h;
  const int terms = harmonics(kDegree, direction, h, kDegree > 0);
  const size_t row = 3 * static_cast<size_t>(in.sh_coefficients) * i;
  const auto coefficient = [&](int k) { return read3(in.sh + row + 3 * k); };
  const Vec3 g = through_clamp(raw_colour(h, terms, coefficient), sums);
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

// ---- kernels ---------------------------------------------------------------------------------

FP_KERNEL(fp_unblend, Undraw, 2) {
  const Frame& frame = f.frame;
  __shared__ Staged staged;
  __shared__ Rim rims[kThreads];
  __shared__ uint32_t to[kThreads];
  __shared__ float sums[kWarps][32][kSums];
  __shared__ uint32_t written[kWarps];  // bit j: the warp has sums of the j-th
  __shared__ float light_by[kWarps][3];
  __shared__ int32_t last[kWarps];
  const Pixel p = pixel_of(frame);
  const Range range = frame.ranges[blockIdx.x];
  LossPixel loss = load_loss(f, p);
  const int32_t stop = p.inside ? frame.stop[p.at] : 0;
  const float per_fragment =
      f.by_fragments ? *f.by_fragments / (static_cast<float>(frame.in.width) *
                                          static_cast<float>(frame.in.height))
                     : 0.f;
  const float seen = p.inside ? loss.light : 0.f;
  const float by[3] = {warp_sum(seen * loss.r), warp_sum(seen * loss.g), warp_sum(seen * loss.b)};
  int32_t furthest = stop;
  for (int step = 16; step > 0; step >>= 1) {
    const int32_t other = __shfl_xor_sync(kAll, furthest, step);
    furthest = furthest > other ? furthest : other;
  }
  if (lane_of() == 0) {
    for (int k = 0; k < 3; k++) light_by[warp_of()][k] = by[k];
    last[warp_of()] = furthest;
  }
  __syncthreads();
  if (f.background && threadIdx.x < 3) {
    float total = 0.f;
    for (int w = 0; w < kWarps; w++) total += light_by[w][threadIdx.x];
    f.background[size_t{3} * blockIdx.x + threadIdx.x] = total;
  }
  if (!f.sums) return;
  int32_t end = 0;
  for (int w = 0; w < kWarps; w++) end = end > last[w] ? end : last[w];
  for (int32_t first = (end - 1) / kThreads * kThreads; end > 0 && first >= 0; first -= kThreads) {
    const int32_t mine = first + static_cast<int32_t>(threadIdx.x);
    staged.reached[threadIdx.x] = 0;
    if (mine < end) {
      const uint32_t value = frame.entry_values[range.first + mine];
      const uint32_t row = frame.owners ? frame.owners[value] : value;
      const Brush<float> brush = load_brush(frame.brushes, row);
      staged.put(frame, threadIdx.x, brush, row, p);
      rims[threadIdx.x] = {frame.in.thresholds ? frame.in.thresholds[row] : 0.f,
                           exp2(-brush.log_opacity)};
      to[threadIdx.x] = value;
    }
    __syncthreads();
    for (int base = kThreads - 32; base >= 0; base -= 32) {
      if (first + base >= end) continue;
      uint32_t done = 0;
      for (uint32_t todo = staged.word(base); todo;) {
        const int bit = 31 - __clz(static_cast<int>(todo)), j = base + bit;
        todo &= ~(1u << bit);
        const LocalBrush<float> b = staged.get(j);
        const Meeting<float> m = meet(b, p.px, p.py);
        const bool reached = m.exponent >= staged.c[j].w && first + j < stop;
        if (!__any_sync(kAll, reached)) continue;
        float v[kPadded];
#pragma unroll
        for (int k = 0; k < kPadded; k++) v[k] = 0.f;
#if FP_FEATURES
        const float* its_features = staged.features[j];
#else
        const float* its_features = nullptr;
#endif
        if (reached) unblend(frame, b, rims[j], its_features, per_fragment, m, loss, v);
        const float total = fold(v);
        constexpr int lanes = 32 / kPadded;  // that have the same sum
        const int which = lane_of() / lanes;
        if (lane_of() % lanes == 0 && which < kSums) sums[warp_of()][bit][which] = total;
        done |= 1u << bit;
      }
      if (lane_of() == 0) written[warp_of()] = done;
      __syncthreads();
      for (int k = threadIdx.x; k < 32 * kSums; k += kThreads) {
        const int j = k / kSums, which = k % kSums;
        float total = 0.f;
        bool any = false;
        for (int w = 0; w < kWarps; w++)
          if (written[w] >> j & 1) total += sums[w][j][which], any = true;
        if (!any) continue;
        if (frame.owners)
          f.sums[size_t{kSums} * to[base + j] + which] = total;
        else
          atomicAdd(f.sums + size_t{kSums} * to[base + j] + which, total);
      }
      __syncthreads();
    }
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
