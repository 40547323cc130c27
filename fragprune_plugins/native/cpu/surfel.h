// Surfels: flat Gaussians, which a pixel's ray meets in their own plane (2D Gaussian Splatting,
// Huang et al. 2024). reference_renderer/surfel.py says what is drawn. This is the mathematics of
// one surfel in one view; surfels.h draws them.
//
// A plane's point (u, v) is seen at the pixel (x, y) with x w = across . (u, v, 1), y w = down .
// (u, v, 1), w = depth . (u, v, 1). The point that a pixel sees is p.xy / p.z, where
//     p = (x depth - across) x (y depth - down)
//       = across x down + x (down x depth) + y (depth x across)
// is linear in x and y. Pixels are counted from one near the surfel's mean: far from it the terms
// would cancel.
#pragma once

#include <algorithm>
#include <cmath>

#include "blend.h"

namespace fp {

constexpr float kSurfelFilter = 2.f;  // inverse variance, pixels^-2, of the round Gaussian
constexpr double kSurfelReach = 3.0;  // standard deviations that give centre, radius and tiles
constexpr float kSurfelFar = 100.f;   // the distortion's far plane

typedef Vec<double> Wide3;
inline Wide3 wide3(const float* p) { return {p[0], p[1], p[2]}; }
inline double dot3(const Wide3& a, const Wide3& b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
inline Wide3 scaled3(double s, const Wide3& a) { return {s * a.x, s * a.y, s * a.z}; }
inline void add3(Wide3& a, double s, const Wide3& b) {
  a.x += s * b.x, a.y += s * b.y, a.z += s * b.z;
}
inline Wide3 cross3(const Wide3& a, const Wide3& b) {
  return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}
inline Vec3 narrow3(const Wide3& a) {
  return {static_cast<float>(a.x), static_cast<float>(a.y), static_cast<float>(a.z)};
}

// One surfel in one view, in double: once for the picture, and again for its derivatives.
struct SurfelView {
  double shift_x, shift_y;      // the pixel that the rows count from
  Wide3 across, down, depth;    // rows of the map from (u, v, 1)
  Wide3 to_across, to_down, to_depth;  // world to these rows, of a vector
  double add_across, add_down, add_depth;  // of a point
  Wide3 axis[3];                // columns of the rotation: u, v, normal
  double facing;                // 1 or -1: turns the normal toward the camera
  double view_z;
  double centre_x, centre_y, half_x, half_y;  // of the box at kSurfelReach
};

// A box on the image of the plane out to `reach2`, squared standard deviations; false: none.
// Numbers that are no box where that part of the plane reaches behind the camera.
inline bool surfel_box(const SurfelView& s, double reach2, double* centre, double* half) {
  const Wide3 t = {reach2, reach2, -1};
  const Wide3& w = s.depth;
  const double d = t.x * w.x * w.x + t.y * w.y * w.y + t.z * w.z * w.z;
  if (d == 0) return false;
  const Wide3* rows[2] = {&s.across, &s.down};
  for (int k = 0; k < 2; k++) {
    const Wide3& r = *rows[k];
    centre[k] = (t.x * r.x * w.x + t.y * r.y * w.y + t.z * r.z * w.z) / d;
    const double square =
        centre[k] * centre[k] - (t.x * r.x * r.x + t.y * r.y * r.y + t.z * r.z * r.z) / d;
    half[k] = std::sqrt(std::max(square, 1e-4));
  }
  return true;
}

// False: the host culls it.
inline bool view_surfel(const fragprune_inputs& in, size_t i, SurfelView& s) {
  const float *v = in.viewmatrix, *p = in.projmatrix, *q = in.rotations + 4 * i;
  const Wide3 mean = wide3(in.means + 3 * i);
  s.view_z = mean.x * v[2] + mean.y * v[6] + mean.z * v[10] + v[14];
  if (!(static_cast<float>(s.view_z) > in.near)) return false;
  const double w = q[0], x = q[1], y = q[2], z = q[3];
  s.axis[0] = {1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)};
  s.axis[1] = {2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)};
  s.axis[2] = {2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)};
  const Wide3 view = {mean.x * v[0] + mean.y * v[4] + mean.z * v[8] + v[12],
                      mean.x * v[1] + mean.y * v[5] + mean.z * v[9] + v[13], s.view_z};
  const Wide3 &n = s.axis[2];
  const Wide3 normal = {n.x * v[0] + n.y * v[4] + n.z * v[8], n.x * v[1] + n.y * v[5] + n.z * v[9],
                        n.x * v[2] + n.y * v[6] + n.z * v[10]};
  const double facing = -dot3(view, normal);
  if (!(facing != 0)) return false;
  s.facing = facing > 0 ? 1 : -1;

  const Wide3 clip_x = {p[0], p[4], p[8]}, clip_y = {p[1], p[5], p[9]};
  s.to_depth = {p[3], p[7], p[11]}, s.add_depth = p[15];
  const double mean_w = dot3(mean, s.to_depth) + s.add_depth;
  const auto row = [&](const Wide3& clip, double add, int size, Wide3& to, double& more) {
    // pixel times w: clip * size / 2 + w * (size - 1) / 2
    to = scaled3(0.5 * size, clip), more = 0.5 * size * add;
    add3(to, 0.5 * (size - 1), s.to_depth), more += 0.5 * (size - 1) * s.add_depth;
    const double at = (dot3(mean, to) + more) / mean_w;
    const double shift = std::isfinite(at) ? std::nearbyint(std::clamp(at, -1e6, 1e6)) : 0;
    add3(to, -shift, s.to_depth), more -= shift * s.add_depth;
    return shift;
  };
  s.shift_x = row(clip_x, p[12], in.width, s.to_across, s.add_across);
  s.shift_y = row(clip_y, p[13], in.height, s.to_down, s.add_down);
  const double long_side = double{in.scale_modifier} * in.scales[2 * i];
  const double wide_side = double{in.scale_modifier} * in.scales[2 * i + 1];
  const auto map = [&](const Wide3& to, double add) {
    return Wide3{long_side * dot3(s.axis[0], to), wide_side * dot3(s.axis[1], to),
                 dot3(mean, to) + add};
  };
  s.across = map(s.to_across, s.add_across);
  s.down = map(s.to_down, s.add_down);
  s.depth = map(s.to_depth, s.add_depth);
  double centre[2], half[2];
  if (!surfel_box(s, kSurfelReach * kSurfelReach, centre, half)) return false;
  s.centre_x = centre[0], s.centre_y = centre[1], s.half_x = half[0], s.half_y = half[1];
  return true;
}

// What blending reads of one surfel.
struct Surfel {
  Vec3 origin, by_x, by_y;  // p at its pixel, and its steps
  Vec3 depth;
  float shift_x, shift_y;   // its pixel
  float centre_x, centre_y; // of the round Gaussian, from its pixel
  Vec3 normal, colour;
  float inv_z, opacity, threshold;
  float cut, list_cut;      // drawn iff q is at most this; reached, for the rim's gradient
  float order;              // depth
  int32_t x0, y0, x1, y1;   // pixels that it may draw, half open
  uint32_t id;
  uint32_t slot;            // of its first tile
  int tiles_across() const { return (x1 - 1) / kTile - x0 / kTile + 1; }
  int tiles() const { return tiles_across() * ((y1 - 1) / kTile - y0 / kTile + 1); }
  uint32_t slot_of(int tile_x, int tile_y) const {
    const int place = (tile_y - y0 / kTile) * tiles_across() + tile_x - x0 / kTile;
    return slot + static_cast<uint32_t>(place);
  }
};

// The colour by spherical harmonics before it is clamped, and what its derivative needs.
struct SurfelColour {
  Harmonics<float> h;
  int terms;
  Vec3 direction, raw;
  float inv_length;

  SurfelColour(const fragprune_inputs& in, size_t i, bool with_slope) {
    direction = direction_to(read3(in.campos), read3(in.means + 3 * i), inv_length);
    terms = harmonics(in.sh_degree, direction, h, with_slope);
    const ShRows<const float> sh = coefficient_rows(in);
    raw = raw_colour(h, terms, [&](int k) { return read3(sh.at(i, k)); });
  }
};

// False: nothing of it is drawn. The radius is the host's, whatever the thresholds.
inline bool prepare_surfel(const fragprune_inputs& in, size_t i, int32_t& radius, Surfel& to) {
  radius = 0;
  SurfelView s;
  if (!view_surfel(in, i, s)) return false;
  const double round = kSurfelReach / std::sqrt(double{kSurfelFilter});
  const double reach = std::ceil(std::max({s.half_x, s.half_y, round}));
  const double at_x = s.shift_x + s.centre_x, at_y = s.shift_y + s.centre_y;
  if (!(reach < 1e9 && std::abs(at_x) < 1e9 && std::abs(at_y) < 1e9)) return false;
  const int tiles_x = (in.width + kTile - 1) / kTile, tiles_y = (in.height + kTile - 1) / kTile;
  const auto tile = [](double pixel, int most) {  // towards 0, as a cast does
    return static_cast<int>(std::clamp(pixel / kTile, 0.0, static_cast<double>(most)));
  };
  const int first_x = tile(at_x - reach, tiles_x), last_x = tile(at_x + reach + kTile - 1, tiles_x);
  const int first_y = tile(at_y - reach, tiles_y), last_y = tile(at_y + reach + kTile - 1, tiles_y);
  if (first_x >= last_x || first_y >= last_y) return false;
  radius = static_cast<int32_t>(reach);

  const float opacity = in.opacities[i], tau = in.thresholds ? in.thresholds[i] : 0.f;
  if (!(opacity > 0 && opacity < 1e30f && tau >= 0)) return false;
  const float visible = 2 * std::log(opacity * 255.f);
  const auto farthest = [&](float falloff) {
    return falloff > 0 ? std::min(-2 * std::log(falloff), visible) : visible;
  };
  to.cut = farthest(tau);
  to.list_cut = in.widen ? farthest(rim_reach(tau)) : to.cut;
  if (!(to.list_cut >= 0)) return false;

  // The pixels within the cut: those of the plane's ellipse and of the round Gaussian's disc.
  double centre[2], half[2];
  const double w_edge = to.list_cut * (s.depth.x * s.depth.x + s.depth.y * s.depth.y) -
                        s.depth.z * s.depth.z;
  to.x0 = first_x * kTile, to.y0 = first_y * kTile;
  to.x1 = std::min(last_x * kTile, in.width), to.y1 = std::min(last_y * kTile, in.height);
  if (w_edge < 0 && surfel_box(s, to.list_cut, centre, half)) {
    const double disc = std::sqrt(to.list_cut / kSurfelFilter);
    const double means[2] = {s.centre_x, s.centre_y}, shift[2] = {s.shift_x, s.shift_y};
    int32_t* low[2] = {&to.x0, &to.y0};
    int32_t* high[2] = {&to.x1, &to.y1};
    for (int k = 0; k < 2; k++) {
      if (!std::isfinite(centre[k] + half[k])) continue;
      const double spare = 0.01 + 1e-4 * half[k];
      const double from = std::min(centre[k] - half[k] - spare, means[k] - disc - spare);
      const double end = std::max(centre[k] + half[k] + spare, means[k] + disc + spare);
      *low[k] = std::max(*low[k], static_cast<int32_t>(std::ceil(std::max(from + shift[k], -1.))));
      *high[k] =
          std::min(*high[k], static_cast<int32_t>(std::floor(std::min(end + shift[k], 1e6))) + 1);
    }
  }
  if (to.x0 >= to.x1 || to.y0 >= to.y1) return false;

  Vec3 c = in.colors ? read3(in.colors + 3 * i) : SurfelColour(in, i, false).raw;
  if (!(std::abs(c.x) + std::abs(c.y) + std::abs(c.z) < 1e30f)) return false;
  if (!in.colors) c = {max(c.x, 0.f), max(c.y, 0.f), max(c.z, 0.f)};
  to.colour = c;
  to.origin = narrow3(cross3(s.across, s.down));
  to.by_x = narrow3(cross3(s.down, s.depth));
  to.by_y = narrow3(cross3(s.depth, s.across));
  to.depth = narrow3(s.depth);
  to.shift_x = static_cast<float>(s.shift_x), to.shift_y = static_cast<float>(s.shift_y);
  to.centre_x = static_cast<float>(s.centre_x), to.centre_y = static_cast<float>(s.centre_y);
  const float* v = in.viewmatrix;
  const Wide3& n = s.axis[2];
  to.normal = narrow3(scaled3(s.facing, {n.x * v[0] + n.y * v[4] + n.z * v[8],
                                         n.x * v[1] + n.y * v[5] + n.z * v[9],
                                         n.x * v[2] + n.y * v[6] + n.z * v[10]}));
  for (const Vec3& each : {to.origin, to.by_x, to.by_y, to.depth, to.normal})
    if (!(std::abs(each.x) + std::abs(each.y) + std::abs(each.z) < 1e30f)) return false;
  to.order = static_cast<float>(s.view_z);
  if (!(to.order < 1e30f)) return false;
  to.inv_z = 1 / to.order;
  to.opacity = opacity, to.threshold = tau;
  to.id = static_cast<uint32_t>(i);
  return true;
}

// ---- one fragment ----------------------------------------------------------------------------

// A surfel met by kLanes pixels.
struct SurfelMeeting {
  Lanes u, v, inv;   // the point on the plane, and 1 / p.z
  Lanes dx, dy;      // from the pixels to the round Gaussian's centre
  Lanes q, depth;
  Mask on_plane;     // else the round Gaussian is nearer
  Mask met;          // in front of the near plane, and within the list's cut
};

inline SurfelMeeting meet_surfel(const Surfel& s, Lanes px, Lanes py, float near) {
  const auto all = [](float x) { return broadcast<Lanes>(x); };
  const Lanes x = px - all(s.shift_x), y = py - all(s.shift_y);
  const auto point = [&](float at, float by_x, float by_y) {
    return fma(x, all(by_x), fma(y, all(by_y), all(at)));
  };
  const Lanes pz = point(s.origin.z, s.by_x.z, s.by_y.z);
  SurfelMeeting m;
  m.inv = all(1.f) / pz;
  m.u = point(s.origin.x, s.by_x.x, s.by_y.x) * m.inv;
  m.v = point(s.origin.y, s.by_x.y, s.by_y.y) * m.inv;
  m.dx = all(s.centre_x) - x, m.dy = all(s.centre_y) - y;
  const Lanes on_plane = fma(m.u, m.u, m.v * m.v);
  const Lanes filtered = all(kSurfelFilter) * fma(m.dx, m.dx, m.dy * m.dy);
  m.on_plane = ge(filtered, on_plane);
  m.q = select(m.on_plane, on_plane, filtered);
  m.depth = fma(m.u, all(s.depth.x), fma(m.v, all(s.depth.y), all(s.depth.z)));
  m.met = both(both(ge(m.depth, all(near)), gt(abs(pz), all(0.f))), ge(all(s.list_cut), m.q));
  return m;
}

inline Lanes surfel_falloff(Lanes q) { return exp2(q * broadcast<Lanes>(-0.5f * kLog2E)); }

// The distortion's depth m, 0 at the near plane and 1 at kSurfelFar, is a constant less
// surfel_slope / depth. Only differences count, squared; they would be lost beside the constant.
inline float surfel_slope(float near) { return kSurfelFar * near / (kSurfelFar - near); }

// Where a tile's pixel lies among them all, in block order.
inline int place_of(int x, int y) {
  const int block = y / kBlockHeight * (kTile / kBlockWidth) + x / kBlockWidth;
  return block * kLanes + y % kBlockHeight * kBlockWidth + x % kBlockWidth;
}

// Calls work(place, px, py) for the blocks of a tile that hold pixels which a surfel may draw.
template <class Work>
inline void each_block(const Surfel& s, int tile_x, int tile_y, Work work) {
  const Lanes steps_x = lane_x(), steps_y = lane_y();
  const int left = std::max(s.x0 - tile_x, 0) / kBlockWidth * kBlockWidth;
  const int top = std::max(s.y0 - tile_y, 0) / kBlockHeight * kBlockHeight;
  const int right = std::min(s.x1 - tile_x, kTile), bottom = std::min(s.y1 - tile_y, kTile);
  for (int y = top; y < bottom; y += kBlockHeight)
    for (int x = left; x < right; x += kBlockWidth)
      work(place_of(x, y), steps_x + broadcast<Lanes>(static_cast<float>(tile_x + x)),
           steps_y + broadcast<Lanes>(static_cast<float>(tile_y + y)));
}

// ---- derivatives -----------------------------------------------------------------------------

// Sums over the fragments of one surfel in one tile: dL/d of each.
enum SurfelSum {
  kByOrigin = 0,      // 3: p at its pixel
  kByX = 3, kByY = 6, // 3 each: its steps
  kByDepth = 9,       // 3: the depth's row, as it acts beside p
  kByCentre = 12,     // 2: the round Gaussian's
  kByNormal = 14,     // 3
  kByColour = 17,     // 3
  kByInvZ = 20,
  kByOpacity = 21,    // times the opacity
  kByThreshold = 22,
  kSurfelSums = 24
};

// From a surfel's sums over all its tiles to its inputs.
inline void unproject_surfel(const fragprune_inputs& in, const Surfel& surfel, const double* sums,
                             const fragprune_input_grads& to) {
  const size_t i = surfel.id;
  const auto three = [&](int k) { return Wide3{sums[k], sums[k + 1], sums[k + 2]}; };
  if (to.opacities) to.opacities[i] = static_cast<float>(sums[kByOpacity] / surfel.opacity);
  if (to.thresholds) to.thresholds[i] = static_cast<float>(sums[kByThreshold]);
  const auto write = [&](float* rows, const Wide3& v) {
    if (!rows) return;
    const Vec3 n = narrow3(v);
    rows[3 * i] = n.x, rows[3 * i + 1] = n.y, rows[3 * i + 2] = n.z;
  };
  write(to.colors, three(kByColour));
  Wide3 by_mean = {0, 0, 0};
  if (in.sh && (to.sh || to.sh_rest || to.means)) {
    const bool slope = to.means && in.sh_degree > 0;
    const SurfelColour c(in, i, slope);
    const Vec3 by = through_clamp(c.raw, narrow3(three(kByColour)));
    const ShRows<const float> sh = coefficient_rows(in);
    const ShRows<float> by_sh = coefficient_rows(in, to);
    for (int k = 0; k < c.terms; k++)
      if (float* row = by_sh.at(i, k))
        for (int j = 0; j < 3; j++) row[j] = c.h.value[k] * (&by.x)[j];
    if (slope) {
      const Vec3 d = direction_gradient(c.h, c.terms, c.direction, c.inv_length, by,
                                        [&](int k) { return read3(sh.at(i, k)); });
      by_mean = {d.x, d.y, d.z};
    }
  }
  if (!(to.means || to.hook || to.scales || to.rotations)) return;
  SurfelView s;
  if (!view_surfel(in, i, s)) return;
  // p = origin + x by_x + y by_y, each a cross product of two rows
  Wide3 across = {0, 0, 0}, down = {0, 0, 0}, depth = three(kByDepth);
  const auto through = [](const Wide3& a, const Wide3& b, const Wide3& by, Wide3& by_a,
                          Wide3& by_b) {
    add3(by_a, 1, cross3(b, by)), add3(by_b, 1, cross3(by, a));
  };
  through(s.across, s.down, three(kByOrigin), across, down);
  through(s.down, s.depth, three(kByX), down, depth);
  through(s.depth, s.across, three(kByY), depth, across);
  if (to.hook) {  // of the plane alone, as the host has it
    to.hook[3 * i] = static_cast<float>(across.z * s.view_z * 0.5 * in.width);
    to.hook[3 * i + 1] = static_cast<float>(down.z * s.view_z * 0.5 * in.height);
    to.hook[3 * i + 2] = 0.f;
  }
  // centre = sum_k t_k row_k depth_k / d, d = sum_k t_k depth_k^2
  const double t[3] = {kSurfelReach * kSurfelReach, kSurfelReach * kSurfelReach, -1};
  double *rows[2] = {&across.x, &down.x}, *by_depth = &depth.x;
  const double *given[2] = {&s.across.x, &s.down.x}, *w = &s.depth.x;
  const double d = t[0] * w[0] * w[0] + t[1] * w[1] * w[1] + t[2] * w[2] * w[2];
  const double centre[2] = {s.centre_x, s.centre_y};
  for (int axis = 0; axis < 2; axis++)
    for (int k = 0; k < 3; k++) {
      const double by = sums[kByCentre + axis] * t[k] / d;
      rows[axis][k] += by * w[k];
      by_depth[k] += by * (given[axis][k] - 2 * centre[axis] * w[k]);
    }
  // rows = (side u, side v, mean) in the world times to_*
  const auto back = [&](double a, double b, double c) {
    Wide3 v = scaled3(a, s.to_across);
    add3(v, b, s.to_down), add3(v, c, s.to_depth);
    return v;
  };
  const Wide3 by_u = back(across.x, down.x, depth.x), by_v = back(across.y, down.y, depth.y);
  add3(by_mean, 1, back(across.z, down.z, depth.z));
  const float* view = in.viewmatrix;
  add3(by_mean, -sums[kByInvZ] / (s.view_z * s.view_z), {view[2], view[6], view[10]});
  write(to.means, by_mean);
  const double modifier = in.scale_modifier;
  if (to.scales) {
    to.scales[2 * i] = static_cast<float>(modifier * dot3(by_u, s.axis[0]));
    to.scales[2 * i + 1] = static_cast<float>(modifier * dot3(by_v, s.axis[1]));
  }
  if (to.rotations) {
    const Wide3 n = scaled3(s.facing, three(kByNormal));
    const Wide3 by_n = {n.x * view[0] + n.y * view[1] + n.z * view[2],
                        n.x * view[4] + n.y * view[5] + n.z * view[6],
                        n.x * view[8] + n.y * view[9] + n.z * view[10]};
    const Vec3 a = narrow3(scaled3(modifier * in.scales[2 * i], by_u));
    const Vec3 b = narrow3(scaled3(modifier * in.scales[2 * i + 1], by_v)), c = narrow3(by_n);
    const Mat3<float> m = {{{a.x, b.x, c.x}, {a.y, b.y, c.y}, {a.z, b.z, c.z}}};
    rotation_gradient(in.rotations + 4 * i, m, to.rotations + 4 * i);
  }
}

}  // namespace fp
