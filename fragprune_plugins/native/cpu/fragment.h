// The mathematics of one fragment, over any number type V: a float, or a register of lanes.
#pragma once

#include "../include/fragprune.h"
#ifndef FP_NUMBERS  // a CUDA build brings its own, and __host__ __device__ for FP_HD
#include "simd.h"  // fma, exp2, min, abs and broadcast for V
#define FP_HD
#endif

namespace fp {

constexpr float kLog2E = 1.44269504088896341f;
constexpr float kTransmittanceMin = static_cast<float>(FRAGPRUNE_TRANSMITTANCE_MIN);
constexpr float kFaintest = -7.99435343685885793f;  // log2(1/255): no fragment has less

// What blending reads of one Gaussian in one view, and nothing else.
//
// The squared Mahalanobis distance is kept as a completed square,
//     q = (dx - slope dy)^2 / var_along + dy^2 / var_down,
// a sum of two positive terms: the expanded form a dx^2 + 2 b dx dy + c dy^2 loses all digits far
// out on a long thin splat. With u = scale (dx - slope dy) and v = down dy, scaled so that
// u^2 + v^2 = q log2(e) / 2, alpha before the cap is 2^(log_opacity - u^2 - v^2).
template <class V>
struct Brush {
  V x, y;                 // mean, pixels
  V scale;                // sqrt(log2(e) / 2 / var_along)
  V skew;                 // -scale * slope
  V down;                 // sqrt(log2(e) / 2 / var_down)
  V log_opacity;          // log2 of the compensated opacity
  V cut;                  // drawn iff the exponent is at least this; with a soft rim, the rim's
  V list_cut;             // lists reach to here: cut, or farther for the rim's sake
  V r, g, b, inv_z;
};

// A brush seen from a tile: u = scale px + skew py + u0, v = down py + v0.
template <class V>
struct LocalBrush {
  V scale, skew, u0, down, v0;
  V log_opacity, cut;
  V r, g, b, inv_z;
};

template <class V>
FP_HD inline LocalBrush<V> localize(const Brush<V>& b, V tile_x, V tile_y) {
  const V x = b.x - tile_x, y = b.y - tile_y;
  return {b.scale,       b.skew, -(b.scale * x + b.skew * y), b.down, -b.down * y,
          b.log_opacity, b.cut,  b.r, b.g, b.b, b.inv_z};
}

// One Gaussian at the pixels px, py of the tile.
template <class V>
struct Meeting {
  V u, v;
  V exponent;  // log2 of alpha before the cap
};

template <class V>
FP_HD inline Meeting<V> meet(const LocalBrush<float>& b, V px, V py) {
  Meeting<V> m;
  m.u = fma(broadcast<V>(b.scale), px, fma(broadcast<V>(b.skew), py, broadcast<V>(b.u0)));
  m.v = fma(broadcast<V>(b.down), py, broadcast<V>(b.v0));
  m.exponent = fnma(m.u, m.u, fnma(m.v, m.v, broadcast<V>(b.log_opacity)));
  return m;
}

template <class V>
FP_HD inline V capped(V alpha, float alpha_max) {
  return min(alpha, broadcast<V>(alpha_max));
}

// How far a soft rim covers a pixel: by the distance of its centre, to first order.
template <class V>
struct Coverage {
  V along, down;  // half the exponent's gradient on the image, with the sign turned
  V per_pixel;    // 1 / the length of the exponent's gradient
  V share;        // of the pixel, 0 to 1
};

template <class V>
FP_HD inline Coverage<V> coverage_of(const LocalBrush<float>& b, const Meeting<V>& m) {
  Coverage<V> c;
  c.along = m.u * broadcast<V>(b.scale);
  c.down = fma(m.u, broadcast<V>(b.skew), m.v * broadcast<V>(b.down));
  const V square = fma(c.along, c.along, c.down * c.down);
  c.per_pixel = 0.5f * inverse_root(max(square, broadcast<V>(1e-12f)));
  c.share = fma(m.exponent - broadcast<V>(b.cut), c.per_pixel, broadcast<V>(0.5f));
  c.share = min(max(c.share, broadcast<V>(0.f)), broadcast<V>(1.f));
  return c;
}

// Density of the logistic at the rim, s(1-s)/w with s = sigmoid(away/w), away = |falloff - tau|.
template <class V>
FP_HD inline V rim_density(V away) {
  constexpr float scale = static_cast<float>(1.0 / FRAGPRUNE_RIM_WIDTH);
  const V e = exp2(away * broadcast<V>(-kLog2E * scale));
  const V one_e = broadcast<V>(1.0f) + e;
  return e * broadcast<V>(scale) * reciprocal(one_e * one_e);
}

// Beyond this distance from the threshold the density is below 2e-9 of its peak and left out.
constexpr float kRimHorizon = static_cast<float>(20.0 * FRAGPRUNE_RIM_WIDTH);

}  // namespace fp
