// Lanes: FP_LANES floats handled by one instruction, and masks over them.
//
// Arithmetic is the compilers' vector extension; what that lacks (fused multiply-add, comparison
// into a mask, selection) is spelled out per instruction set, so that nothing is left to the
// optimiser's taste: forward and backward then agree to the bit.
#pragma once

#include <cmath>
#include <cstdint>
#include <cstring>

#if defined(__AVX2__) || defined(__SSE2__)
#include <immintrin.h>
#elif defined(__ARM_NEON)
#include <arm_neon.h>
#endif

#ifndef FP_LANES
#define FP_LANES 4
#endif

namespace fp {

constexpr int kLanes = FP_LANES;
static_assert(kLanes == 4 || kLanes == 8 || kLanes == 16, "FP_LANES is 4, 8 or 16");

typedef float Lanes __attribute__((vector_size(4 * FP_LANES)));
typedef int32_t IntLanes __attribute__((vector_size(4 * FP_LANES)));

template <class V>
inline V broadcast(float x);
template <>
inline float broadcast<float>(float x) {
  return x;
}

template <class To, class From>
inline To bits_as(From from) {
  To to;
  static_assert(sizeof to == sizeof from, "");
  std::memcpy(&to, &from, sizeof to);
  return to;
}

inline Lanes load(const float* p) {
  Lanes v;
  std::memcpy(&v, p, sizeof v);
  return v;
}
inline void store(float* p, Lanes v) { std::memcpy(p, &v, sizeof v); }
inline IntLanes load(const int32_t* p) {
  IntLanes v;
  std::memcpy(&v, p, sizeof v);
  return v;
}
inline void store(int32_t* p, IntLanes v) { std::memcpy(p, &v, sizeof v); }

#if FP_LANES == 16

typedef __mmask16 Mask;
template <>
inline Lanes broadcast<Lanes>(float x) {
  return _mm512_set1_ps(x);
}
inline IntLanes broadcast_int(int32_t x) { return (IntLanes)_mm512_set1_epi32(x); }
inline Lanes fma(Lanes a, Lanes b, Lanes c) { return _mm512_fmadd_ps(a, b, c); }
inline Lanes sqrt(Lanes a) { return _mm512_sqrt_ps(a); }
inline Lanes min(Lanes a, Lanes b) { return _mm512_min_ps(a, b); }
inline Lanes max(Lanes a, Lanes b) { return _mm512_max_ps(a, b); }
inline Lanes abs(Lanes a) { return _mm512_abs_ps(a); }
inline Mask ge(Lanes a, Lanes b) { return _mm512_cmp_ps_mask(a, b, _CMP_GE_OQ); }
inline Mask gt(IntLanes a, IntLanes b) {
  return _mm512_cmpgt_epi32_mask((__m512i)a, (__m512i)b);
}
inline Mask both(Mask a, Mask b) { return (Mask)(a & b); }
inline Lanes select(Mask m, Lanes a, Lanes b) { return _mm512_mask_blend_ps(m, b, a); }
inline IntLanes select(Mask m, IntLanes a, IntLanes b) {
  return (IntLanes)_mm512_mask_blend_epi32(m, (__m512i)b, (__m512i)a);
}
inline Lanes where(Mask m, Lanes a) { return _mm512_maskz_mov_ps(m, a); }
inline IntLanes increment(Mask m, IntLanes a) {
  return (IntLanes)_mm512_mask_add_epi32((__m512i)a, m, (__m512i)a, _mm512_set1_epi32(1));
}
inline uint32_t bits(Mask m) { return m; }

#else

typedef IntLanes Mask;  // all ones or all zeros in each lane
#if FP_LANES == 8
template <>
inline Lanes broadcast<Lanes>(float x) {
  return _mm256_set1_ps(x);
}
inline IntLanes broadcast_int(int32_t x) { return (IntLanes)_mm256_set1_epi32(x); }
inline Lanes fma(Lanes a, Lanes b, Lanes c) { return _mm256_fmadd_ps(a, b, c); }
inline Lanes sqrt(Lanes a) { return _mm256_sqrt_ps(a); }
inline Lanes min(Lanes a, Lanes b) { return _mm256_min_ps(a, b); }
inline Lanes max(Lanes a, Lanes b) { return _mm256_max_ps(a, b); }
inline Mask ge(Lanes a, Lanes b) { return (Mask)_mm256_cmp_ps(a, b, _CMP_GE_OQ); }
inline uint32_t bits(Mask m) { return (uint32_t)_mm256_movemask_ps((__m256)m); }
#else
template <>
inline Lanes broadcast<Lanes>(float x) {
  return Lanes{x, x, x, x};
}
inline IntLanes broadcast_int(int32_t x) { return IntLanes{x, x, x, x}; }
#if defined(__SSE2__)
inline Lanes fma(Lanes a, Lanes b, Lanes c) { return a * b + c; }  // no such instruction in SSE2
inline Lanes sqrt(Lanes a) { return _mm_sqrt_ps(a); }
inline Lanes min(Lanes a, Lanes b) { return _mm_min_ps(a, b); }
inline Lanes max(Lanes a, Lanes b) { return _mm_max_ps(a, b); }
inline Mask ge(Lanes a, Lanes b) { return (Mask)_mm_cmpge_ps(a, b); }
inline uint32_t bits(Mask m) { return (uint32_t)_mm_movemask_ps((__m128)m); }
#else
inline Lanes min(Lanes a, Lanes b) { return a < b ? a : b; }
inline Lanes max(Lanes a, Lanes b) { return a > b ? a : b; }
inline Mask ge(Lanes a, Lanes b) { return (Mask)(a >= b); }
inline uint32_t bits(Mask m) { return (m[0] & 1) | (m[1] & 2) | (m[2] & 4) | (m[3] & 8); }
#if defined(__ARM_NEON) && defined(__aarch64__)
inline Lanes fma(Lanes a, Lanes b, Lanes c) {
  return (Lanes)vfmaq_f32((float32x4_t)c, (float32x4_t)a, (float32x4_t)b);
}
inline Lanes sqrt(Lanes a) { return (Lanes)vsqrtq_f32((float32x4_t)a); }
#else
inline Lanes fma(Lanes a, Lanes b, Lanes c) { return a * b + c; }
inline Lanes sqrt(Lanes a) {
  for (int i = 0; i < kLanes; i++) a[i] = std::sqrt(a[i]);
  return a;
}
#endif
#endif
#endif
inline Lanes abs(Lanes a) {
  return bits_as<Lanes>(bits_as<IntLanes>(a) & broadcast_int(0x7fffffff));
}
inline Mask gt(IntLanes a, IntLanes b) { return (Mask)(a > b); }
inline Mask both(Mask a, Mask b) { return a & b; }
inline Lanes where(Mask m, Lanes a) { return bits_as<Lanes>(bits_as<IntLanes>(a) & m); }
inline IntLanes select(Mask m, IntLanes a, IntLanes b) { return (a & m) | (b & ~m); }
inline Lanes select(Mask m, Lanes a, Lanes b) {
#if FP_LANES == 8
  return _mm256_blendv_ps(b, a, (__m256)m);
#else
  return bits_as<Lanes>(select(m, bits_as<IntLanes>(a), bits_as<IntLanes>(b)));
#endif
}
inline IntLanes increment(Mask m, IntLanes a) { return a - m; }

#endif

// 2^x, relative error 1e-7, for x below 127; anything under 2^-125 comes out as that.
// Adding 1.5 * 2^23 rounds x to the nearest integer and leaves it in the low mantissa bits.
inline Lanes exp2(Lanes x) {
  const Lanes magic = broadcast<Lanes>(12582912.0f);
  x = max(x, broadcast<Lanes>(-125.0f));
  const Lanes shifted = x + magic;
  const Lanes f = x - (shifted - magic);
  Lanes p = broadcast<Lanes>(1.3264727e-3f);
  p = fma(p, f, broadcast<Lanes>(9.6715129e-3f));
  p = fma(p, f, broadcast<Lanes>(5.5507337e-2f));
  p = fma(p, f, broadcast<Lanes>(2.4022242e-1f));
  p = fma(p, f, broadcast<Lanes>(6.9314698e-1f));
  p = fma(p, f, broadcast<Lanes>(1.0f));
  return bits_as<Lanes>(bits_as<IntLanes>(p) + (bits_as<IntLanes>(shifted) << 23));
}

// In a fixed order: halves are added to halves.
inline float sum(Lanes v) {
  float a[kLanes];
  store(a, v);
  for (int half = kLanes / 2; half > 0; half /= 2)
    for (int i = 0; i < half; i++) a[i] += a[i + half];
  return a[0];
}

}  // namespace fp
