// What simd.h is to lanes: the names that gaussian.h, ellipse.h and fragment.h use, for one float on
// a GPU. Kernels are compiled without contraction, so that every fused multiply-add is one that is
// spelled out: what is computed twice, in two kernels, is then the same to the bit.
#pragma once

#include <stdint.h>

#define FP_NUMBERS
#define FP_HD __device__

namespace fp {

template <class V>
struct With;
template <>
struct With<float> {
  typedef bool Mask;
  typedef double Wide;
};
template <class V>
using MaskOf = typename With<V>::Mask;
template <class V>
using WideOf = typename With<V>::Wide;

template <class V>
FP_HD inline V broadcast(float x) {
  return x;
}

// NaN for a gives b in min and max, as with lanes: fminf would keep the number of the two.
FP_HD inline float min(float a, float b) { return a < b ? a : b; }
FP_HD inline float max(float a, float b) { return a > b ? a : b; }
FP_HD inline float abs(float a) { return fabsf(a); }
FP_HD inline float sqrt(float a) { return sqrtf(a); }
FP_HD inline float root(float a) { return sqrtf(a); }
FP_HD inline float inverse_root(float a) { return 1.f / sqrtf(a); }
FP_HD inline float floor(float a) { return floorf(a); }
FP_HD inline float ceil(float a) { return ceilf(a); }
FP_HD inline float log2(float a) { return log2f(a); }
FP_HD inline bool ge(float a, float b) { return a >= b; }
FP_HD inline bool gt(float a, float b) { return a > b; }
FP_HD inline bool both(bool a, bool b) { return a && b; }
FP_HD inline float select(bool m, float a, float b) { return m ? a : b; }
FP_HD inline double widen(float a) { return a; }
FP_HD inline float narrow(double a) { return static_cast<float>(a); }
FP_HD inline float fma(float a, float b, float c) { return fmaf(a, b, c); }
FP_HD inline float fnma(float a, float b, float c) { return fmaf(-a, b, c); }

#ifdef FP_EMULATED
FP_HD inline float exp2(float a) { return emulated::rounded(exp2f(a), 2); }
FP_HD inline float reciprocal(float a) { return emulated::rounded(1.f / a, 1); }
#else
// The special function unit's: 2 and 1 units in the last place.
FP_HD inline float exp2(float a) {
  float r;
  asm("ex2.approx.ftz.f32 %0, %1;" : "=f"(r) : "f"(a));
  return r;
}
FP_HD inline float reciprocal(float a) {
  float r;
  asm("rcp.approx.ftz.f32 %0, %1;" : "=f"(r) : "f"(a));
  return r;
}
#endif

}  // namespace fp
