// Which tiles a Gaussian's ellipse reaches. Over any number type V, as gaussian.h.
#pragma once

#include "gaussian.h"

namespace fp {

constexpr int kTile = FRAGPRUNE_TILE;

// Spans only preselect, the fragment test decides. This much is added to every reach so that their
// rounding never loses a fragment: relative, and absolute for splats of a pixel or less.
constexpr float kReachMargin = 1.0002f, kReachFloor = 1e-3f;
constexpr float kSpanMargin = 0.01f;  // pixels

// The ellipse {q <= reach} by rows: where it begins and ends in x for an interval of y.
template <class V>
struct Ellipse {
  V slope;        // dx/dy of the line on which x is most likely given y
  V reach;        // squared radius, a little more than the cutoff
  V half_height;  // pixels
  V rightmost;    // dy at which x is largest; -rightmost for the smallest
  V var_along;    // variance of x given y, pixels^2
  V inv_down;     // 1 / variance of y
  V margin;       // pixels, added on all sides
};

// `power` is how far the exponent may fall from its peak; see Brush for the others. Pixels are
// sampled up to `spread` from their centres.
template <class V>
FP_HD inline Ellipse<V> ellipse_of(V scale, V skew, V down, V power, V spread) {
  const V unit = broadcast<V>(0.5f * kLog2E), slope = -skew / scale;
  const V var_down = unit / (down * down), cov = slope * var_down;
  Ellipse<V> e;
  e.slope = slope;
  e.reach = power * broadcast<V>(2 / kLog2E * kReachMargin) + broadcast<V>(kReachFloor);
  e.var_along = unit / (scale * scale);
  e.inv_down = down * down * broadcast<V>(2 / kLog2E);
  e.margin = spread + kSpanMargin;
  e.half_height = root(e.reach * var_down) + e.margin;
  e.rightmost = cov * root(e.reach / (e.var_along + slope * cov));
  return e;
}

// Where an ellipse's span ends, right (side 1) or left (side -1) of its mean, over samples of
// low..high.
template <class V>
FP_HD inline V span_end(const Ellipse<V>& e, V low, V high, V side) {
  const V at = min(max(e.rightmost * side, low), high);
  const V inside = e.var_along * (e.reach - at * at * e.inv_down);
  return e.slope * at + side * (root(max(inside, broadcast<V>(0.f))) + e.margin);
}

// The pixels that may matter of one splat: its ellipse within the host's rectangle of tiles and the
// image. All bounds are whole numbers, of pixel centres; top > bottom: none.
template <class V>
struct Bounds {
  Ellipse<V> ellipse;
  V x, top, bottom, left, right;
  V above, below;  // the mean's y less the spread, and more
};

template <class V>
FP_HD inline Bounds<V> bounds_of(const Camera<V>& c, const Projection<V>& p, const Brush<V>& b) {
  constexpr float tile = kTile;
  Bounds<V> o;
  o.ellipse = ellipse_of(b.scale, b.skew, b.down, b.log_opacity - b.list_cut, c.spread);
  o.x = b.x, o.above = b.y - c.spread, o.below = b.y + c.spread;
  o.top = max(ceil(b.y - o.ellipse.half_height), p.tile_y0 * tile);
  o.bottom = min(min(floor(b.y + o.ellipse.half_height), c.height - 1.f), p.tile_y1 * tile - 1.f);
  o.left = p.tile_x0 * tile;
  o.right = min(c.width, p.tile_x1 * tile) - 1.f;
  return o;
}

// Columns of tiles reached in a row of tiles: first and last, whole numbers; none if first > last.
template <class V>
FP_HD inline void span_of(const Bounds<V>& o, V row, V& first, V& last) {
  constexpr float tile = kTile;
  const V low = max(row * tile, o.top) - o.below;
  const V high = min(row * tile + (tile - 1), o.bottom) - o.above;
  const V side = broadcast<V>(1.f), none = broadcast<V>(1.f);
  const V x0 = max(o.left, ceil(o.x + span_end(o.ellipse, low, high, -side)));
  const V x1 = min(o.right, floor(o.x + span_end(o.ellipse, low, high, side)));
  const MaskOf<V> some = ge(x1, x0);
  first = select(some, floor(x0 * (1 / tile)), none);
  last = select(some, floor(x1 * (1 / tile)), broadcast<V>(0.f));
}

}  // namespace fp
