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

// Functions that take lanes by value are all inline: no other compiler's calls to agree with.
#if defined(__GNUC__)
#pragma GCC diagnostic ignored "-Wpsabi"
#endif

// A stage stays a function of its own in every build, so that profilers can tell it from the others.
#if defined(__GNUC__)
#define FP_STAGE __attribute__((noinline))
#else
#define FP_STAGE
#endif

namespace fp {

constexpr int kLanes = FP_LANES;
static_assert(kLanes == 4 || kLanes == 8 || kLanes == 16, "FP_LANES is 4, 8 or 16");

typedef float Lanes __attribute__((vector_size(4 * FP_LANES)));
typedef int32_t IntLanes __attribute__((vector_size(4 * FP_LANES)));
typedef uint32_t BitLanes __attribute__((vector_size(4 * FP_LANES)));  // where overflow is meant
typedef double WideLanes __attribute__((vector_size(8 * FP_LANES)));
#if FP_LANES == 16
typedef __mmask16 Mask;
#else
typedef IntLanes Mask;  // all ones or all zeros in each lane
#endif

// What goes with a number type: the result of its comparisons, and double precision.
template <class V>
struct With;
template <>
struct With<float> {
  typedef bool Mask;
  typedef double Wide;
};
template <>
struct With<Lanes> {
  typedef fp::Mask Mask;
  typedef WideLanes Wide;
};
template <class V>
using MaskOf = typename With<V>::Mask;
template <class V>
using WideOf = typename With<V>::Wide;

template <class V>
inline V broadcast(float x);
template <>
inline float broadcast<float>(float x) {
  return x;
}

// The same names for one number as for lanes of them. NaN for a gives b in min and max.
inline float min(float a, float b) { return a < b ? a : b; }
inline float max(float a, float b) { return a > b ? a : b; }
inline float abs(float a) { return std::fabs(a); }
inline float sqrt(float a) { return std::sqrt(a); }
inline float root(float a) { return sqrt(a); }
inline float floor(float a) { return std::floor(a); }
inline float ceil(float a) { return std::ceil(a); }
inline bool ge(float a, float b) { return a >= b; }
inline bool gt(float a, float b) { return a > b; }
inline bool both(bool a, bool b) { return a && b; }
inline float select(bool m, float a, float b) { return m ? a : b; }
inline double widen(float a) { return a; }
inline float narrow(double a) { return static_cast<float>(a); }
inline WideLanes widen(Lanes a) { return __builtin_convertvector(a, WideLanes); }
inline Lanes narrow(const WideLanes& a) { return __builtin_convertvector(a, Lanes); }
inline float fma(float a, float b, float c) {
#ifdef FP_FAST_FMAF
  return __builtin_fmaf(a, b, c);
#else
  return a * b + c;  // without the instruction a true fused multiply-add is a slow library call
#endif
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

// Four numbers to an aligned place, past the caches where the machine can. Whoever did so calls
// end_stream() before another thread may look.
constexpr size_t kLine = 64;  // bytes
template <class T>
inline void stream4(T* to, const T* from) {
  static_assert(sizeof *to == 4, "");
#ifdef __SSE2__
  const __m128i four = _mm_loadu_si128(reinterpret_cast<const __m128i*>(from));
  _mm_stream_si128(reinterpret_cast<__m128i*>(to), four);
#else
  std::memcpy(to, from, 4 * sizeof *to);
#endif
}
inline void end_stream() {
#ifdef __SSE2__
  _mm_sfence();
#endif
}

#if FP_LANES == 16

template <>
inline Lanes broadcast<Lanes>(float x) {
  return _mm512_set1_ps(x);
}
inline IntLanes broadcast_int(int32_t x) { return (IntLanes)_mm512_set1_epi32(x); }
inline Lanes fma(Lanes a, Lanes b, Lanes c) { return _mm512_fmadd_ps(a, b, c); }
inline Lanes fnma(Lanes a, Lanes b, Lanes c) { return _mm512_fnmadd_ps(a, b, c); }
inline Lanes sqrt(Lanes a) { return _mm512_sqrt_ps(a); }
inline Lanes min(Lanes a, Lanes b) { return _mm512_min_ps(a, b); }
inline Lanes max(Lanes a, Lanes b) { return _mm512_max_ps(a, b); }
inline Lanes abs(Lanes a) { return _mm512_abs_ps(a); }
inline Lanes floor(Lanes a) { return _mm512_roundscale_ps(a, _MM_FROUND_TO_NEG_INF); }
inline Lanes ceil(Lanes a) { return _mm512_roundscale_ps(a, _MM_FROUND_TO_POS_INF); }
inline IntLanes to_int(Lanes a) { return (IntLanes)_mm512_cvttps_epi32(a); }
// 1 / a within rounding, where a division would hold everything up: an estimate of 14 bits, and a
// step of Newton's.
inline Lanes reciprocal(Lanes a) {
  const __m512 x = _mm512_rcp14_ps(a);
  return _mm512_fmadd_ps(x, _mm512_fnmadd_ps(a, x, _mm512_set1_ps(1.f)), x);
}
// The square root within rounding, likewise; a is not negative.
inline Lanes root(Lanes a) {
  const __m512 x = _mm512_rsqrt14_ps(_mm512_max_ps(a, _mm512_set1_ps(1e-30f)));
  const __m512 s = a * x;
  return _mm512_fmadd_ps(_mm512_fnmadd_ps(s, s, a), x * 0.5f, s);
}
// 1 / the square root within rounding, likewise; a is above 0.
inline Lanes inverse_root(Lanes a) {
  const __m512 x = _mm512_rsqrt14_ps(a);
  return x * _mm512_fnmadd_ps(a * x, x * 0.5f, _mm512_set1_ps(1.5f));
}
inline Mask ge(Lanes a, Lanes b) { return _mm512_cmp_ps_mask(a, b, _CMP_GE_OQ); }
inline Mask gt(Lanes a, Lanes b) { return _mm512_cmp_ps_mask(a, b, _CMP_GT_OQ); }
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

#if FP_LANES == 8
template <>
inline Lanes broadcast<Lanes>(float x) {
  return _mm256_set1_ps(x);
}
inline IntLanes broadcast_int(int32_t x) { return (IntLanes)_mm256_set1_epi32(x); }
inline Lanes fma(Lanes a, Lanes b, Lanes c) { return _mm256_fmadd_ps(a, b, c); }
inline Lanes fnma(Lanes a, Lanes b, Lanes c) { return _mm256_fnmadd_ps(a, b, c); }  // c - a b
inline Lanes sqrt(Lanes a) { return _mm256_sqrt_ps(a); }
inline Lanes min(Lanes a, Lanes b) { return _mm256_min_ps(a, b); }
inline Lanes max(Lanes a, Lanes b) { return _mm256_max_ps(a, b); }
inline Mask ge(Lanes a, Lanes b) { return (Mask)_mm256_cmp_ps(a, b, _CMP_GE_OQ); }
inline Mask gt(Lanes a, Lanes b) { return (Mask)_mm256_cmp_ps(a, b, _CMP_GT_OQ); }
inline uint32_t bits(Mask m) { return (uint32_t)_mm256_movemask_ps((__m256)m); }
#else
template <>
inline Lanes broadcast<Lanes>(float x) {
  return Lanes{x, x, x, x};
}
inline IntLanes broadcast_int(int32_t x) { return IntLanes{x, x, x, x}; }
#if defined(__SSE2__)
inline Lanes fma(Lanes a, Lanes b, Lanes c) { return a * b + c; }  // no such instruction in SSE2
inline Lanes fnma(Lanes a, Lanes b, Lanes c) { return c - a * b; }
inline Lanes sqrt(Lanes a) { return _mm_sqrt_ps(a); }
inline Lanes min(Lanes a, Lanes b) { return _mm_min_ps(a, b); }
inline Lanes max(Lanes a, Lanes b) { return _mm_max_ps(a, b); }
inline Mask ge(Lanes a, Lanes b) { return (Mask)_mm_cmpge_ps(a, b); }
inline Mask gt(Lanes a, Lanes b) { return (Mask)_mm_cmpgt_ps(a, b); }
inline uint32_t bits(Mask m) { return (uint32_t)_mm_movemask_ps((__m128)m); }
#else
inline Lanes min(Lanes a, Lanes b) { return a < b ? a : b; }
inline Lanes max(Lanes a, Lanes b) { return a > b ? a : b; }
inline Mask ge(Lanes a, Lanes b) { return (Mask)(a >= b); }
inline Mask gt(Lanes a, Lanes b) { return (Mask)(a > b); }
inline uint32_t bits(Mask m) { return (m[0] & 1) | (m[1] & 2) | (m[2] & 4) | (m[3] & 8); }
#if defined(__ARM_NEON) && defined(__aarch64__)
inline Lanes fma(Lanes a, Lanes b, Lanes c) {
  return (Lanes)vfmaq_f32((float32x4_t)c, (float32x4_t)a, (float32x4_t)b);
}
inline Lanes fnma(Lanes a, Lanes b, Lanes c) {
  return (Lanes)vfmsq_f32((float32x4_t)c, (float32x4_t)a, (float32x4_t)b);
}
inline Lanes sqrt(Lanes a) { return (Lanes)vsqrtq_f32((float32x4_t)a); }
#else
inline Lanes fma(Lanes a, Lanes b, Lanes c) { return a * b + c; }
inline Lanes fnma(Lanes a, Lanes b, Lanes c) { return c - a * b; }
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
inline IntLanes to_int(Lanes a) { return __builtin_convertvector(a, IntLanes); }
inline Lanes reciprocal(Lanes a) { return broadcast<Lanes>(1.f) / a; }
inline Lanes root(Lanes a) { return sqrt(a); }
inline Lanes inverse_root(Lanes a) {
#if FP_LANES == 8
  const Lanes x = _mm256_rsqrt_ps(a);
  return x * fnma(a * x, x * 0.5f, broadcast<Lanes>(1.5f));
#else
  return broadcast<Lanes>(1.f) / sqrt(a);
#endif
}
inline Mask gt(IntLanes a, IntLanes b) { return (Mask)(a > b); }
inline Mask both(Mask a, Mask b) { return a & b; }
inline Lanes where(Mask m, Lanes a) { return bits_as<Lanes>(bits_as<IntLanes>(a) & m); }
#if FP_LANES == 8
inline Lanes floor(Lanes a) { return _mm256_floor_ps(a); }
inline Lanes ceil(Lanes a) { return _mm256_ceil_ps(a); }
#else
// Through integers: right for numbers that fit one, and no others are looked at.
inline Lanes floor(Lanes a) {
  const Lanes whole = __builtin_convertvector(to_int(a), Lanes);
  return whole - where((Mask)(whole > a), broadcast<Lanes>(1.f));
}
inline Lanes ceil(Lanes a) { return -floor(-a); }
#endif
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

// Appends base + i for each bit i of the word, in order; returns the end. May write kLanes numbers
// beyond it.
inline int32_t* expand(uint64_t word, int32_t base, int32_t* end) {
#if FP_LANES == 16
  const __m512i lane = _mm512_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
  for (int i = 0; i < 64; i += 16) {
    const __mmask16 some = static_cast<__mmask16>(word >> i);
    const __m512i place = _mm512_add_epi32(_mm512_set1_epi32(base + i), lane);
    _mm512_storeu_si512(end, _mm512_maskz_compress_epi32(some, place));
    end += __builtin_popcount(some);
  }
#else
  for (; word; word &= word - 1) *end++ = base + __builtin_ctzll(word);
#endif
  return end;
}

// 2^x, relative error 1e-7, for x in -125 to 127; beyond, anything: the caller masks it.
// Adding 1.5 * 2^23 rounds x to the nearest integer and leaves it in the low mantissa bits.
inline Lanes exp2(Lanes x) {
  const Lanes magic = broadcast<Lanes>(12582912.0f);
  const Lanes shifted = x + magic;
  const Lanes f = x - (shifted - magic);
  const Lanes ff = f * f;
  const Lanes high = fma(broadcast<Lanes>(1.3264727e-3f), f, broadcast<Lanes>(9.6715129e-3f));
  const Lanes middle = fma(broadcast<Lanes>(5.5507337e-2f), f, broadcast<Lanes>(2.4022242e-1f));
  const Lanes low = fma(broadcast<Lanes>(6.9314698e-1f), f, broadcast<Lanes>(1.0f));
  const Lanes p = fma(fma(high, ff, middle), ff, low);
  return bits_as<Lanes>(bits_as<BitLanes>(p) + (bits_as<BitLanes>(shifted) << 23));
}

// log2 of a normal number above 0, absolute error 1e-7 or rounding; of 0, about -127.
// With the mantissa m in [sqrt(1/2), sqrt(2)), the series of log2((1 + s) / (1 - s)).
inline Lanes log2(Lanes x) {
  const BitLanes all = bits_as<BitLanes>(x), since_root = all - 0x3f3504f3;  // sqrt(1/2)
  const IntLanes exponent = bits_as<IntLanes>(since_root) >> 23;
  const Lanes m = bits_as<Lanes>(all - (bits_as<BitLanes>(exponent) << 23));
  const Lanes one = broadcast<Lanes>(1.f);
  const Lanes s = (m - one) / (m + one), ss = s * s;
  Lanes p = fma(broadcast<Lanes>(0.32059889f), ss, broadcast<Lanes>(0.41219858f));
  p = fma(p, ss, broadcast<Lanes>(0.57707802f));
  p = fma(p, ss, broadcast<Lanes>(0.96179669f));
  p = fma(p, ss, broadcast<Lanes>(2.88539008f));
  return fma(p, s, __builtin_convertvector(exponent, Lanes));
}

// The first four numbers of kLanes rows, row(i) pointing to row i, as four columns.
template <class RowOf>
inline void load_columns(RowOf row, Lanes* column) {
#if FP_LANES == 16
  const auto four = [&](int i) {
    __m512 v = _mm512_castps128_ps512(_mm_loadu_ps(row(i)));
    v = _mm512_insertf32x4(v, _mm_loadu_ps(row(i + 4)), 1);
    v = _mm512_insertf32x4(v, _mm_loadu_ps(row(i + 8)), 2);
    return _mm512_insertf32x4(v, _mm_loadu_ps(row(i + 12)), 3);
  };
  const __m512 a = four(0), b = four(1), c = four(2), d = four(3);
  const __m512 ab = _mm512_unpacklo_ps(a, b), cd = _mm512_unpacklo_ps(c, d);
  const __m512 ab2 = _mm512_unpackhi_ps(a, b), cd2 = _mm512_unpackhi_ps(c, d);
  column[0] = _mm512_shuffle_ps(ab, cd, 0x44), column[1] = _mm512_shuffle_ps(ab, cd, 0xee);
  column[2] = _mm512_shuffle_ps(ab2, cd2, 0x44), column[3] = _mm512_shuffle_ps(ab2, cd2, 0xee);
#elif FP_LANES == 8
  const auto two = [&](int i) {
    return _mm256_insertf128_ps(_mm256_castps128_ps256(_mm_loadu_ps(row(i))),
                                _mm_loadu_ps(row(i + 4)), 1);
  };
  const __m256 a = two(0), b = two(1), c = two(2), d = two(3);
  const __m256 ab = _mm256_unpacklo_ps(a, b), cd = _mm256_unpacklo_ps(c, d);
  const __m256 ab2 = _mm256_unpackhi_ps(a, b), cd2 = _mm256_unpackhi_ps(c, d);
  column[0] = _mm256_shuffle_ps(ab, cd, 0x44), column[1] = _mm256_shuffle_ps(ab, cd, 0xee);
  column[2] = _mm256_shuffle_ps(ab2, cd2, 0x44), column[3] = _mm256_shuffle_ps(ab2, cd2, 0xee);
#else
  for (int i = 0; i < kLanes; i++)
    for (int k = 0; k < 4; k++) column[k][i] = row(i)[k];
#endif
}

// The opposite: four columns to rows of four, row(i) pointing to where row i goes.
template <class RowOf>
inline void store_rows(const Lanes* column, RowOf row) {
#if FP_LANES == 16
  const __m512 a = column[0], b = column[1], c = column[2], d = column[3];
  const __m512 ab = _mm512_unpacklo_ps(a, b), cd = _mm512_unpacklo_ps(c, d);
  const __m512 ab2 = _mm512_unpackhi_ps(a, b), cd2 = _mm512_unpackhi_ps(c, d);
  const auto four = [&](int i, __m512 v) {
    _mm_storeu_ps(row(i), _mm512_castps512_ps128(v));
    _mm_storeu_ps(row(i + 4), _mm512_extractf32x4_ps(v, 1));
    _mm_storeu_ps(row(i + 8), _mm512_extractf32x4_ps(v, 2));
    _mm_storeu_ps(row(i + 12), _mm512_extractf32x4_ps(v, 3));
  };
  four(0, _mm512_shuffle_ps(ab, cd, 0x44)), four(1, _mm512_shuffle_ps(ab, cd, 0xee));
  four(2, _mm512_shuffle_ps(ab2, cd2, 0x44)), four(3, _mm512_shuffle_ps(ab2, cd2, 0xee));
#elif FP_LANES == 8
  const __m256 a = column[0], b = column[1], c = column[2], d = column[3];
  const __m256 ab = _mm256_unpacklo_ps(a, b), cd = _mm256_unpacklo_ps(c, d);
  const __m256 ab2 = _mm256_unpackhi_ps(a, b), cd2 = _mm256_unpackhi_ps(c, d);
  const auto two = [&](int i, __m256 v) {
    _mm_storeu_ps(row(i), _mm256_castps256_ps128(v));
    _mm_storeu_ps(row(i + 4), _mm256_extractf128_ps(v, 1));
  };
  two(0, _mm256_shuffle_ps(ab, cd, 0x44)), two(1, _mm256_shuffle_ps(ab, cd, 0xee));
  two(2, _mm256_shuffle_ps(ab2, cd2, 0x44)), two(3, _mm256_shuffle_ps(ab2, cd2, 0xee));
#else
  for (int i = 0; i < kLanes; i++)
    for (int k = 0; k < 4; k++) row(i)[k] = column[k][i];
#endif
}

// In a fixed order: halves are added to halves.
inline float sum(Lanes v) {
  float a[kLanes];
  store(a, v);
  for (int half = kLanes / 2; half > 0; half /= 2)
    for (int i = 0; i < half; i++) a[i] += a[i + half];
  return a[0];
}

// The sums of four registers' lanes at once, by interleaving: a third of the work of four sums.
inline void sum_four(Lanes a, Lanes b, Lanes c, Lanes d, float* out) {
#if FP_LANES == 16
  const __m512 ab = _mm512_unpacklo_ps(a, b) + _mm512_unpackhi_ps(a, b);
  const __m512 cd = _mm512_unpacklo_ps(c, d) + _mm512_unpackhi_ps(c, d);
  const __m512 s = _mm512_shuffle_ps(ab, cd, 0x44) + _mm512_shuffle_ps(ab, cd, 0xee);
  const __m256 half = _mm512_castps512_ps256(s) + _mm512_extractf32x8_ps(s, 1);
  _mm_storeu_ps(out, _mm256_castps256_ps128(half) + _mm256_extractf128_ps(half, 1));
#elif FP_LANES == 8
  const __m256 ab = _mm256_unpacklo_ps(a, b) + _mm256_unpackhi_ps(a, b);
  const __m256 cd = _mm256_unpacklo_ps(c, d) + _mm256_unpackhi_ps(c, d);
  const __m256 s = _mm256_shuffle_ps(ab, cd, 0x44) + _mm256_shuffle_ps(ab, cd, 0xee);
  _mm_storeu_ps(out, _mm256_castps256_ps128(s) + _mm256_extractf128_ps(s, 1));
#elif defined(__SSE2__)
  const __m128 ab = _mm_unpacklo_ps(a, b) + _mm_unpackhi_ps(a, b);
  const __m128 cd = _mm_unpacklo_ps(c, d) + _mm_unpackhi_ps(c, d);
  _mm_storeu_ps(out, _mm_shuffle_ps(ab, cd, 0x44) + _mm_shuffle_ps(ab, cd, 0xee));
#else
  out[0] = sum(a), out[1] = sum(b), out[2] = sum(c), out[3] = sum(d);
#endif
}

// out[k] = the sum of v[k]'s lanes, each added in the same order whatever kCount is.
template <int kCount>
inline void sum_each(const Lanes* v, float* out) {
  const Lanes none = broadcast<Lanes>(0.f);
  for (int k = 0; k < kCount; k += 4) {
    float four[4];
    sum_four(v[k], k + 1 < kCount ? v[k + 1] : none, k + 2 < kCount ? v[k + 2] : none,
             k + 3 < kCount ? v[k + 3] : none, four);
    for (int i = k; i < kCount && i < k + 4; i++) out[i] = four[i - k];
  }
}

}  // namespace fp
