// The mathematics of one fragment, over any number type V: a float, or a register of lanes.
#pragma once

#include "../include/fragprune.h"
#include "simd.h"  // fma, exp2, min, abs and broadcast for V

#ifndef FP_HD
#define FP_HD  // a CUDA build puts __host__ __device__ here
#endif

namespace fp {

constexpr float kLog2E = 1.44269504088896341f;
constexpr float kAlphaMax = static_cast<float>(FRAGPRUNE_ALPHA_MAX);
constexpr float kTransmittanceMin = static_cast<float>(FRAGPRUNE_TRANSMITTANCE_MIN);

// What blending reads of one Gaussian in one view, and nothing else.
//
// The squared Mahalanobis distance is kept as a completed square,
//     q = (dx - slope dy)^2 / var_x_given_y + dy^2 / var_y,
// a sum of two positive terms: the expanded form a dx^2 + 2 b dx dy + c dy^2 loses all digits far
// out on a long thin splat. Exponents are in base 2, the sign and 1/2 of exp(-q/2) included.
struct Brush {
  float x, y;         // mean, pixels
  float slope;        // cov_xy / var_y
  float along, down;  // -log2(e)/2 over var_x_given_y, and over var_y
  float opacity;      // compensated
  float r, g, b;
  float inv_z;
  float cut;       // drawn iff power >= cut
  float list_cut;  // lists reach to here: cut, or farther when the rim wants gradients
};

// A fragment's exponent: falloff = 2^power, never positive.
template <class V>
FP_HD inline V power_of(V u, V dy, V along, V down) {
  return fma(u * u, along, (dy * dy) * down);
}

template <class V>
FP_HD inline V alpha_of(V falloff, V opacity) {
  return min(falloff * opacity, broadcast<V>(kAlphaMax));
}

// Density of the logistic at the rim, s(1-s)/w with s = sigmoid((falloff - threshold)/w).
template <class V>
FP_HD inline V rim_density(V falloff, V threshold) {
  constexpr float scale = static_cast<float>(1.0 / FRAGPRUNE_RIM_WIDTH);
  const V e = exp2(abs(falloff - threshold) * broadcast<V>(-kLog2E * scale));
  const V one_e = broadcast<V>(1.0f) + e;
  return e * broadcast<V>(scale) / (one_e * one_e);
}

// Beyond this distance from the threshold the density is below 2e-9 of its peak and left out.
constexpr float kRimHorizon = static_cast<float>(20.0 * FRAGPRUNE_RIM_WIDTH);

}  // namespace fp
