// Gaussians in space and time, cut at a moment, and back. One thread per Gaussian.

#include "frame.h"

#include "../cpu/moment.h"

namespace fp {

// Gaussians in space and time cut at a moment, or gradients on their way back through the cut.
struct Slicing {
  fragprune_spacetime in;
  fragprune_sliced sliced;       // filled in; or gradients by it
  fragprune_spacetime_grads to;  // of the way back
};

#ifdef FP_SLICING_SIZE
static_assert(sizeof(Slicing) == FP_SLICING_SIZE, "slicing/structs.py has other fields in Slicing");
#endif

__device__ inline void read4(const float* from, size_t i, float* to) {
  for (int k = 0; k < 4; k++) to[k] = from[4 * i + k];
}
__device__ inline void write4(float* to, size_t i, const float* from) {
  for (int k = 0; to && k < 4; k++) to[4 * i + k] = from[k];
}

__device__ inline Spacetime<float> load_spacetime(const fragprune_spacetime& in,
                                                  const Moment<float>& m, size_t i) {
  Spacetime<float> g = Spacetime<float>();
  g.mean = read3(in.means + 3 * i);
  g.opacity = in.opacities[i];
  if (m.kind == kSliced) {
    for (int k = 0; k < 6; k++) g.cov3d[k] = in.cov3d[6 * i + k];
    return g;
  }
  const Vec3 scale = read3(in.scales + 3 * i);
  g.scale[0] = scale.x, g.scale[1] = scale.y, g.scale[2] = scale.z;
  read4(in.rotations, i, g.left);
  if (m.kind == kStill) return g;
  g.scale[3] = in.scales_t[i];
  g.time = in.times[i];
  if (m.kind == kJoint) read4(in.rotations_r, i, g.right);
  return g;
}

// The coefficients of what one Gaussian's cosines add up to.
struct Blend {
  const float* sh;
  int32_t orders;
  Waves<float> w;

  __device__ Vec3 of(int order, int k) const { return read3(sh + 3 * (kBands * order + k)); }
  __device__ Vec3 operator()(int k) const {
    Vec3 v = of(0, k);
    if (orders >= 1) v = add_scaled(v, w.first, of(1, k));
    if (orders >= 2) v = add_scaled(v, w.second, of(2, k));
    return v;
  }
};

__device__ inline Blend blend_of(const fragprune_spacetime& in, const Moment<float>& m, size_t i) {
  const float* row = in.sh + 3 * static_cast<size_t>(in.sh_coefficients) * i;
  return {row, m.orders, waves_of(m, m.orders ? in.times[i] : 0.f)};
}

// Calls work with the degree as a constant, so that the harmonics stay in registers.
template <template <int> class Work, class... Arguments>
__device__ inline auto of_degree(int degree, const Arguments&... with) {
  switch (degree) {
    case 0: return Work<0>::run(with...);
    case 1: return Work<1>::run(with...);
    case 2: return Work<2>::run(with...);
    default: return Work<3>::run(with...);
  }
}

template <int kDegree>
struct Shade {
  static __device__ Vec3 run(const Moment<float>& m, const Blend& blend, const Vec3& mean) {
    float inv_length;
    Harmonics<float> h;
    const int terms = harmonics(kDegree, direction_to(m.centre, mean, inv_length), h, false);
    return raw_colour(h, terms, blend);
  }
};

// What colour says about the moved mean and the time.
struct ByColour {
  Vec3 mean;
  float time;
};

// Writes dL/dsh too. The host differentiates colours as if they had been seen where the moment has
// moved the means.
template <int kDegree>
struct Unshade {
  static __device__ ByColour run(const Slicing& f, const Moment<float>& m, const Blend& blend,
                                 const Vec3& moved, const Vec3& g, size_t i) {
    float inv_length;
    Harmonics<float> h;
    const Vec3 direction = direction_to(m.centre, moved, inv_length);
    const int terms = harmonics(kDegree, direction, h, kDegree > 0);
    if (f.to.sh) {
      const int width = f.in.sh_coefficients;
      float* row = f.to.sh + 3 * static_cast<size_t>(width) * i;
#pragma unroll
      for (int k = 0; k < terms; k++) {
        write3(row, k, given_harmonic(m, h, k) * g);
        if (m.orders >= 1) write3(row, kBands + k, (blend.w.first * h.value[k]) * g);
        if (m.orders >= 2) write3(row, 2 * kBands + k, (blend.w.second * h.value[k]) * g);
      }
      for (int k = m.orders ? kBands * (m.orders + 1) : terms; k < width; k++)
        write3(row, k, {0.f, 0.f, 0.f});
    }
    ByColour by = {{0.f, 0.f, 0.f}, 0.f};
    if (kDegree > 0) by.mean = direction_gradient(h, terms, direction, inv_length, g, blend);
    if (m.orders) {
      Vec3 wave = {0.f, 0.f, 0.f};
#pragma unroll
      for (int k = 0; k < terms; k++) wave = add_scaled(wave, h.value[k], blend.of(m.orders, k));
      by.time = dot(g, wave) * blend.w.slope;
    }
    return by;
  }
};

FP_KERNEL(fp_slice, Slicing, 2) {
  const size_t i = size_t{blockIdx.x} * kThreads + threadIdx.x;
  if (i >= static_cast<size_t>(f.in.count)) return;
  const Moment<float> m = unpack_moment(f.in);
  const Spacetime<float> given = load_spacetime(f.in, m, i);
  Sliced<float> s;
  const bool present = slice(m, given, s);
  f.sliced.present[i] = present;
  write3(f.sliced.means, i, present ? s.mean : m.centre);
  for (int k = 0; k < 6; k++) f.sliced.cov3d[6 * i + k] = present ? s.cov3d[k] : 0.f;
  f.sliced.opacities[i] = present ? s.opacity : 0.f;
  if (!f.in.sh) return;
  Vec3 c = {0.f, 0.f, 0.f};
  if (present) c = of_degree<Shade>(f.in.sh_degree, m, blend_of(f.in, m, i), given.mean);
  write3(f.sliced.colors, i, {lit(c.x), lit(c.y), lit(c.z)});
}

FP_KERNEL(fp_unslice, Slicing, 2) {
  const size_t i = size_t{blockIdx.x} * kThreads + threadIdx.x;
  if (i >= static_cast<size_t>(f.in.count)) return;
  const Moment<float> m = unpack_moment(f.in);
  const bool present = f.sliced.present[i];
  Spacetime<float> to = Spacetime<float>();
  if (present) {
    const Spacetime<float> given = load_spacetime(f.in, m, i);
    Sliced<float> by = Sliced<float>();
    if (f.sliced.means) by.mean = read3(f.sliced.means + 3 * i);
    if (f.sliced.opacities) by.opacity = f.sliced.opacities[i];
    for (int k = 0; f.sliced.cov3d && k < 6; k++) by.cov3d[k] = f.sliced.cov3d[6 * i + k];
    float by_time = 0.f;
    const fragprune_spacetime_grads& t = f.to;
    const bool moves = t.means || t.times || t.scales || t.scales_t || t.rotations || t.rotations_r;
    if (f.in.sh && (t.sh || (f.sliced.colors && moves))) {
      const Blend blend = blend_of(f.in, m, i);
      Vec3 g = {0.f, 0.f, 0.f};
      if (f.sliced.colors)
        g = through_clamp(of_degree<Shade>(f.in.sh_degree, m, blend, given.mean),
                          read3(f.sliced.colors + 3 * i));
      Sliced<float> at;
      slice(m, given, at);
      const ByColour found = of_degree<Unshade>(f.in.sh_degree, f, m, blend, at.mean, g, i);
      by.mean = by.mean + found.mean;
      by_time = found.time;
    }
    to = slice_gradient(m, given, by);
    to.time = to.time + by_time;
  } else if (f.to.sh) {
    float* row = f.to.sh + 3 * static_cast<size_t>(f.in.sh_coefficients) * i;
    for (int k = 0; k < 3 * f.in.sh_coefficients; k++) row[k] = 0.f;
  }
  write3(f.to.means, i, to.mean);
  if (f.to.opacities) f.to.opacities[i] = to.opacity;
  if (f.to.times) f.to.times[i] = to.time;
  write3(f.to.scales, i, {to.scale[0], to.scale[1], to.scale[2]});
  if (f.to.scales_t) f.to.scales_t[i] = to.scale[3];
  write4(f.to.rotations, i, to.left);
  write4(f.to.rotations_r, i, to.right);
  for (int k = 0; f.to.cov3d && k < 6; k++) f.to.cov3d[6 * i + k] = to.cov3d[k];
}

}  // namespace fp
