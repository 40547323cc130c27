// The mathematics of one Gaussian in one view, and its derivatives: projection, the covariance of
// its image, the cutoff, colour from spherical harmonics. No memory but what it is handed.
#pragma once

#include <cmath>
#include <cstdint>

#include "fragment.h"

namespace fp {

struct Vec3 {
  float x, y, z;
};
FP_HD inline Vec3 operator+(Vec3 a, Vec3 b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
FP_HD inline Vec3 operator-(Vec3 a, Vec3 b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
FP_HD inline Vec3 operator*(float s, Vec3 a) { return {s * a.x, s * a.y, s * a.z}; }
FP_HD inline Vec3 add_scaled(Vec3 a, float s, Vec3 b) {
  return {fma(s, b.x, a.x), fma(s, b.y, a.y), fma(s, b.z, a.z)};
}
FP_HD inline float dot(Vec3 a, Vec3 b) { return fma(a.x, b.x, fma(a.y, b.y, a.z * b.z)); }
FP_HD inline Vec3 cross(Vec3 a, Vec3 b) {
  return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}
FP_HD inline Vec3 read3(const float* p) { return {p[0], p[1], p[2]}; }
FP_HD inline void write3(float* p, Vec3 v) { p[0] = v.x, p[1] = v.y, p[2] = v.z; }
FP_HD inline float clamp(float x, float low, float high) {  // NaN comes out as low
  return x > low ? (x < high ? x : high) : low;
}

// A camera, unpacked once per call. Column k of a row-vector matrix is what gives coordinate k.
struct Camera {
  Vec3 to_x, to_y, to_z, shift;       // view space: to_x . p + shift.x, ...
  Vec3 clip_x, clip_y, clip_w;        // clip space, the coordinates that are used
  float clip_x0, clip_y0, clip_w0;
  Vec3 centre;
  float focal_x, focal_y;             // pixels
  float limit_x, limit_y;             // where x/z and y/z stop in the Jacobian
  float width, height;                // pixels
  int tiles_x, tiles_y;
  float scale_modifier, dilation;
  bool antialiasing;
};

FP_HD inline Camera unpack_camera(const fragprune_inputs& in) {
  const float *v = in.viewmatrix, *p = in.projmatrix;
  const float margin = static_cast<float>(FRAGPRUNE_FRUSTUM_MARGIN);
  Camera c;
  c.to_x = {v[0], v[4], v[8]};
  c.to_y = {v[1], v[5], v[9]};
  c.to_z = {v[2], v[6], v[10]};
  c.shift = {v[12], v[13], v[14]};
  c.clip_x = {p[0], p[4], p[8]};
  c.clip_y = {p[1], p[5], p[9]};
  c.clip_w = {p[3], p[7], p[11]};
  c.clip_x0 = p[12], c.clip_y0 = p[13], c.clip_w0 = p[15];
  c.centre = read3(in.campos);
  c.width = static_cast<float>(in.width);
  c.height = static_cast<float>(in.height);
  c.focal_x = c.width / (2 * in.tan_fov_x);
  c.focal_y = c.height / (2 * in.tan_fov_y);
  c.limit_x = margin * in.tan_fov_x;
  c.limit_y = margin * in.tan_fov_y;
  c.tiles_x = (in.width + FRAGPRUNE_TILE - 1) / FRAGPRUNE_TILE;
  c.tiles_y = (in.height + FRAGPRUNE_TILE - 1) / FRAGPRUNE_TILE;
  c.scale_modifier = in.scale_modifier;
  c.dilation = in.dilation;
  c.antialiasing = in.antialiasing != 0;
  return c;
}

struct Mat3 {
  Vec3 row[3];
};
FP_HD inline Vec3 operator*(const Mat3& m, Vec3 v) {
  return {dot(m.row[0], v), dot(m.row[1], v), dot(m.row[2], v)};
}
FP_HD inline Vec3 row_times(Vec3 v, const Mat3& m) {
  return add_scaled(add_scaled(v.x * m.row[0], v.y, m.row[1]), v.z, m.row[2]);
}

// Rotation matrix of a quaternion w, x, y, z, used as given (the host normalises).
FP_HD inline Mat3 rotation_of(const float* q) {
  const float w = q[0], x = q[1], y = q[2], z = q[3];
  return {{{1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)},
           {2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)},
           {2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)}}};
}

FP_HD inline void rotation_gradient(const float* q, const Mat3& g, float* out) {
  const float w = q[0], x = q[1], y = q[2], z = q[3];
  const Vec3 a = g.row[0], b = g.row[1], c = g.row[2];
  out[0] = 2 * (z * (b.x - a.y) + y * (a.z - c.x) + x * (c.y - b.z));
  out[1] = 2 * (y * (a.y + b.x) + z * (a.z + c.x) + w * (c.y - b.z)) - 4 * x * (b.y + c.z);
  out[2] = 2 * (x * (a.y + b.x) + z * (b.z + c.y) + w * (a.z - c.x)) - 4 * y * (a.x + c.z);
  out[3] = 2 * (x * (a.z + c.x) + y * (b.z + c.y) + w * (b.x - a.y)) - 4 * z * (a.x + b.y);
}

// The 3D covariance in the form it was given: a square root (rotation times scales) or itself.
struct Shape {
  bool factored;
  Mat3 matrix;  // factored: rotation * diag(scales); else the symmetric covariance
};

FP_HD inline Shape shape_of(const Camera& c, const fragprune_inputs& in, int64_t i) {
  Shape s;
  s.factored = in.cov3d == nullptr;
  if (s.factored) {
    s.matrix = rotation_of(in.rotations + 4 * i);
    const Vec3 size = c.scale_modifier * read3(in.scales + 3 * i);
    for (Vec3& r : s.matrix.row) r = {r.x * size.x, r.y * size.y, r.z * size.z};
  } else {
    const float* m = in.cov3d + 6 * i;
    s.matrix = {{{m[0], m[1], m[2]}, {m[1], m[3], m[4]}, {m[2], m[4], m[5]}}};
  }
  return s;
}

// One Gaussian's image, before its opacity is known.
struct Projection {
  Vec3 view;              // view-space mean
  float x, y;             // pixels
  Vec3 axis_x, axis_y;    // rows of the Jacobian times the view rotation
  Vec3 image_x, image_y;  // those rows times the shape's matrix
  float var_x, cov, var_y;  // pixels^2, dilated
  float det, det_before;    // with and without dilation
  bool clamped_x, clamped_y;
  int radius;                            // pixels, the host's
  int tile_x0, tile_x1, tile_y0, tile_y1;  // the host's rectangle of tiles, half open
};

// The Jacobian of perspective, evaluated where the host does: x/z and y/z clamped.
FP_HD inline void project_axes(const Camera& c, Projection& p) {
  const float inv_z = 1 / p.view.z;
  const float slope_x = p.view.x * inv_z, slope_y = p.view.y * inv_z;
  p.clamped_x = !(slope_x >= -c.limit_x && slope_x <= c.limit_x);
  p.clamped_y = !(slope_y >= -c.limit_y && slope_y <= c.limit_y);
  p.axis_x = (c.focal_x * inv_z) * (c.to_x - clamp(slope_x, -c.limit_x, c.limit_x) * c.to_z);
  p.axis_y = (c.focal_y * inv_z) * (c.to_y - clamp(slope_y, -c.limit_y, c.limit_y) * c.to_z);
}

// a . (m b) in double precision, for a symmetric m.
FP_HD inline double wide_form(Vec3 a, const Mat3& m, Vec3 b) {
  const double x = b.x, y = b.y, z = b.z;
  return a.x * (m.row[0].x * x + m.row[0].y * y + m.row[0].z * z) +
         a.y * (m.row[1].x * x + m.row[1].y * y + m.row[1].z * z) +
         a.z * (m.row[2].x * x + m.row[2].y * y + m.row[2].z * z);
}

// The image's covariance. var_x var_y - cov^2 loses every digit on a long thin splat: determinants
// of factored shapes are squared areas (Lagrange's identity), the others need double precision.
FP_HD inline void project_shape(const Camera& c, const Shape& s, Projection& p) {
  p.image_x = row_times(p.axis_x, s.matrix);
  p.image_y = row_times(p.axis_y, s.matrix);
  if (s.factored) {
    p.var_x = dot(p.image_x, p.image_x);
    p.cov = dot(p.image_x, p.image_y);
    p.var_y = dot(p.image_y, p.image_y);
    const Vec3 area = cross(p.image_x, p.image_y);
    p.det_before = dot(area, area);
  } else {
    const double xx = wide_form(p.axis_x, s.matrix, p.axis_x);
    const double xy = wide_form(p.axis_x, s.matrix, p.axis_y);
    const double yy = wide_form(p.axis_y, s.matrix, p.axis_y);
    p.var_x = static_cast<float>(xx);
    p.cov = static_cast<float>(xy);
    p.var_y = static_cast<float>(yy);
    p.det_before = static_cast<float>(xx * yy - xy * xy);
  }
  p.det = p.det_before + c.dilation * (p.var_x + p.var_y + c.dilation);
  p.var_x += c.dilation;
  p.var_y += c.dilation;
}

// The host's radius and the tiles of its 3-sigma square; false when it touches none.
FP_HD inline bool host_extent(const Camera& c, Projection& p) {
  const float mid = 0.5f * (p.var_x + p.var_y);
  const float gap = mid * mid - p.det;
  const float radius = std::ceil(3 * std::sqrt(mid + std::sqrt(gap > 0.1f ? gap : 0.1f)));
  if (!(radius <= 1e9f)) return false;  // not finite, or beyond any image
  const float tile = FRAGPRUNE_TILE, wide = static_cast<float>(c.tiles_x),
              high = static_cast<float>(c.tiles_y);
  p.radius = static_cast<int>(radius);
  p.tile_x0 = static_cast<int>(clamp((p.x - radius) / tile, 0, wide));
  p.tile_x1 = static_cast<int>(clamp((p.x + radius + tile - 1) / tile, 0, wide));
  p.tile_y0 = static_cast<int>(clamp((p.y - radius) / tile, 0, high));
  p.tile_y1 = static_cast<int>(clamp((p.y + radius + tile - 1) / tile, 0, high));
  return p.tile_x0 < p.tile_x1 && p.tile_y0 < p.tile_y1;
}

// False: the host culls it (or it is not finite). Comparisons are written so that NaN fails them.
FP_HD inline bool project(const Camera& c, const fragprune_inputs& in, int64_t i, Projection& p) {
  const Vec3 mean = read3(in.means + 3 * i);
  p.view.z = dot(c.to_z, mean) + c.shift.z;
  if (!(p.view.z > static_cast<float>(FRAGPRUNE_NEAR))) return false;
  p.view.x = dot(c.to_x, mean) + c.shift.x;
  p.view.y = dot(c.to_y, mean) + c.shift.y;
  const float inv_w = 1 / (dot(c.clip_w, mean) + c.clip_w0 + 1e-7f);
  p.x = (((dot(c.clip_x, mean) + c.clip_x0) * inv_w + 1) * c.width - 1) * 0.5f;
  p.y = (((dot(c.clip_y, mean) + c.clip_y0) * inv_w + 1) * c.height - 1) * 0.5f;
  if (!(std::fabs(p.x) < 1e9f && std::fabs(p.y) < 1e9f)) return false;
  project_axes(c, p);
  project_shape(c, shape_of(c, in, i), p);
  if (!(p.det > 0 && p.var_y > 0 && p.var_x > 0 && p.det < 1e37f)) return false;
  return host_extent(c, p);
}

// sqrt of the ratio of determinants: what antialiasing takes from the opacity.
FP_HD inline float compensation(const Camera& c, const Projection& p) {
  if (!c.antialiasing) return 1;
  const float ratio = p.det_before / p.det;
  const float floor = static_cast<float>(FRAGPRUNE_ANTIALIASING_FLOOR);
  return std::sqrt(ratio > floor ? ratio : floor);
}

// The cutoff, once for everything: a fragment is drawn iff log2 of its alpha is at least this, that
// is, iff alpha >= 1/255 and falloff >= threshold (the truncation's falloff, 0 for none).
FP_HD inline float cut_of(float log_opacity, float threshold) {
  const float host = static_cast<float>(-7.99435343685885793);  // log2(1/255)
  const float ours = log_opacity + std::log2(threshold);        // -inf for 0
  return host > ours ? host : ours;
}

// The falloff down to which the backward pass visits the rim of a threshold.
FP_HD inline float rim_reach(float threshold) {
  const float reach = static_cast<float>(FRAGPRUNE_RIM_REACH * FRAGPRUNE_RIM_WIDTH);
  const float least = static_cast<float>(FRAGPRUNE_FALLOFF_MIN);
  const float wide = threshold - reach > least ? threshold - reach : least;
  return wide < threshold ? wide : threshold;
}

// Spherical harmonics up to degree 3 in the field's order and signs: value and, when asked, slope.
struct Harmonics {
  float value[16];
  Vec3 slope[16];
};

FP_HD inline int harmonics(int degree, Vec3 d, Harmonics& h, bool with_slope) {
  constexpr float c0 = 0.28209479177387814f, c1 = 0.4886025119029199f;
  constexpr float c2[5] = {1.0925484305920792f, -1.0925484305920792f, 0.31539156525252005f,
                           -1.0925484305920792f, 0.5462742152960396f};
  constexpr float c3[7] = {-0.5900435899266435f, 2.890611442640554f, -0.4570457994644658f,
                           0.3731763325901154f,  -0.4570457994644658f, 1.445305721320277f,
                           -0.5900435899266435f};
  const float x = d.x, y = d.y, z = d.z, xx = x * x, yy = y * y, zz = z * z;
  float* v = h.value;
  v[0] = c0;
  if (degree >= 1) v[1] = -c1 * y, v[2] = c1 * z, v[3] = -c1 * x;
  if (degree >= 2) {
    v[4] = c2[0] * x * y;
    v[5] = c2[1] * y * z;
    v[6] = c2[2] * (2 * zz - xx - yy);
    v[7] = c2[3] * x * z;
    v[8] = c2[4] * (xx - yy);
  }
  if (degree >= 3) {
    v[9] = c3[0] * y * (3 * xx - yy);
    v[10] = c3[1] * x * y * z;
    v[11] = c3[2] * y * (4 * zz - xx - yy);
    v[12] = c3[3] * z * (2 * zz - 3 * xx - 3 * yy);
    v[13] = c3[4] * x * (4 * zz - xx - yy);
    v[14] = c3[5] * z * (xx - yy);
    v[15] = c3[6] * x * (xx - 3 * yy);
  }
  if (with_slope) {
    Vec3* s = h.slope;
    s[0] = {0, 0, 0};
    if (degree >= 1) s[1] = {0, -c1, 0}, s[2] = {0, 0, c1}, s[3] = {-c1, 0, 0};
    if (degree >= 2) {
      s[4] = c2[0] * Vec3{y, x, 0};
      s[5] = c2[1] * Vec3{0, z, y};
      s[6] = c2[2] * Vec3{-2 * x, -2 * y, 4 * z};
      s[7] = c2[3] * Vec3{z, 0, x};
      s[8] = c2[4] * Vec3{2 * x, -2 * y, 0};
    }
    if (degree >= 3) {
      s[9] = c3[0] * Vec3{6 * x * y, 3 * xx - 3 * yy, 0};
      s[10] = c3[1] * Vec3{y * z, x * z, x * y};
      s[11] = c3[2] * Vec3{-2 * x * y, 4 * zz - xx - 3 * yy, 8 * y * z};
      s[12] = c3[3] * Vec3{-6 * x * z, -6 * y * z, 6 * zz - 3 * xx - 3 * yy};
      s[13] = c3[4] * Vec3{4 * zz - 3 * xx - yy, -2 * x * y, 8 * x * z};
      s[14] = c3[5] * Vec3{2 * x * z, -2 * y * z, xx - yy};
      s[15] = c3[6] * Vec3{3 * xx - 3 * yy, -6 * x * y, 0};
    }
  }
  return (degree + 1) * (degree + 1);
}

// Colour before the clamp at zero, from the direction in which the camera sees the mean.
FP_HD inline Vec3 raw_colour(const float* sh, const Harmonics& h, int terms) {
  Vec3 colour = {0.5f, 0.5f, 0.5f};
  for (int k = 0; k < terms; k++) colour = add_scaled(colour, h.value[k], read3(sh + 3 * k));
  return colour;
}

FP_HD inline Vec3 colour_of(const Camera& c, const fragprune_inputs& in, int64_t i) {
  if (in.colors) return read3(in.colors + 3 * i);
  const Vec3 away = read3(in.means + 3 * i) - c.centre;
  Harmonics h;
  const int terms =
      harmonics(in.sh_degree, (1 / std::sqrt(dot(away, away))) * away, h, false);
  const Vec3 raw = raw_colour(in.sh + 3 * in.sh_coefficients * i, h, terms);
  return {raw.x > 0 ? raw.x : 0, raw.y > 0 ? raw.y : 0, raw.z > 0 ? raw.z : 0};
}

// ---- derivatives -----------------------------------------------------------------------------

// What the pixels say about one Gaussian: sums over its fragments of w, alpha before the cap times
// dL/dalpha: the weight of everything that acts through the exponent. u and v as in Brush.
struct PixelSums {
  float w;                  // sum of w
  float threshold;          // dL/dtau
  float u, v, uu, uv, vv;   // sums of w u, w v, w u^2, w u v, w v^2
  float r, g, b;            // dL/dcolour
  float inv_z;              // dL/d(1/z)
};

// dL/d of the image: its position and its dilated covariance.
struct ImageGradient {
  float x, y;               // pixels
  float var_x, cov, var_y;
};

FP_HD inline ImageGradient image_gradient(const Camera& c, const Projection& p,
                                          const PixelSums& s) {
  const float slope = p.cov / p.var_y, inv_down = 1 / p.var_y, inv_along = p.var_y / p.det;
  // u = scale (dx - slope dy), v = down dy: back to pixels
  const float per_u = 1 / std::sqrt(0.5f * kLog2E * inv_along);
  const float per_v = 1 / std::sqrt(0.5f * kLog2E * inv_down);
  ImageGradient g;
  // q = (dx - slope dy)^2 / along + dy^2 / down, dL/dq = -w/2
  g.x = per_u * s.u * inv_along;
  g.y = per_v * s.v * inv_down - slope * g.x;
  const float along = 0.5f * per_u * per_u * s.uu * inv_along * inv_along;
  const float by_slope = per_u * per_v * s.uv * inv_along;
  const float down = 0.5f * per_v * per_v * s.vv * inv_down * inv_down;
  // along = var_x - cov^2 / var_y, slope = cov / var_y, down = var_y
  g.var_x = along;
  g.cov = by_slope * inv_down - 2 * slope * along;
  g.var_y = down + slope * (slope * along - by_slope * inv_down);
  const float ratio = p.det_before / p.det;
  if (c.antialiasing && ratio > static_cast<float>(FRAGPRUNE_ANTIALIASING_FLOOR)) {
    const float by_ratio = 0.5f * s.w / (ratio * p.det);  // alpha goes with its root
    g.var_x += by_ratio * (p.var_y - c.dilation - ratio * p.var_y);
    g.var_y += by_ratio * (p.var_x - c.dilation - ratio * p.var_x);
    g.cov += by_ratio * 2 * p.cov * (ratio - 1);
  }
  return g;
}

// From the covariance of the image to the shape's matrix and to the view-space mean.
FP_HD inline Vec3 shape_gradient(const Camera& c, const Projection& p, const Shape& s,
                                 const ImageGradient& g, Mat3& by_matrix) {
  Vec3 by_axis_x, by_axis_y;
  if (s.factored) {
    const Vec3 by_image_x = (2 * g.var_x) * p.image_x + g.cov * p.image_y;
    const Vec3 by_image_y = (2 * g.var_y) * p.image_y + g.cov * p.image_x;
    by_matrix.row[0] = p.axis_x.x * by_image_x + p.axis_y.x * by_image_y;
    by_matrix.row[1] = p.axis_x.y * by_image_x + p.axis_y.y * by_image_y;
    by_matrix.row[2] = p.axis_x.z * by_image_x + p.axis_y.z * by_image_y;
    by_axis_x = s.matrix * by_image_x;
    by_axis_y = s.matrix * by_image_y;
  } else {
    const Vec3 left = g.var_x * p.axis_x + g.cov * p.axis_y;
    by_matrix.row[0] = left.x * p.axis_x + (g.var_y * p.axis_y.x) * p.axis_y;
    by_matrix.row[1] = left.y * p.axis_x + (g.var_y * p.axis_y.y) * p.axis_y;
    by_matrix.row[2] = left.z * p.axis_x + (g.var_y * p.axis_y.z) * p.axis_y;
    by_axis_x = (2 * g.var_x) * p.image_x + g.cov * p.image_y;
    by_axis_y = (2 * g.var_y) * p.image_y + g.cov * p.image_x;
  }
  // axis_x = focal/z to_x - focal t/z^2 to_z. As the host has it, t is a constant for z even where
  // it is x/z that was clamped, and where it was, x itself has no influence.
  const float inv_z = 1 / p.view.z, inv_z2 = inv_z * inv_z;
  const float tx = clamp(p.view.x * inv_z, -c.limit_x, c.limit_x) * p.view.z;
  const float ty = clamp(p.view.y * inv_z, -c.limit_y, c.limit_y) * p.view.z;
  const float x_z = dot(by_axis_x, c.to_z), y_z = dot(by_axis_y, c.to_z);
  Vec3 view;
  view.x = p.clamped_x ? 0 : -c.focal_x * inv_z2 * x_z;
  view.y = p.clamped_y ? 0 : -c.focal_y * inv_z2 * y_z;
  view.z = -c.focal_x * inv_z2 * dot(by_axis_x, c.to_x) -
           c.focal_y * inv_z2 * dot(by_axis_y, c.to_y) +
           2 * inv_z2 * inv_z * (c.focal_x * tx * x_z + c.focal_y * ty * y_z);
  return view;
}

// dL/dmean of what acts through the pixel position and the view-space point.
FP_HD inline Vec3 mean_gradient(const Camera& c, Vec3 mean, const ImageGradient& g, Vec3 view) {
  const float inv_w = 1 / (dot(c.clip_w, mean) + c.clip_w0 + 1e-7f);
  const float ndc_x = (dot(c.clip_x, mean) + c.clip_x0) * inv_w;
  const float ndc_y = (dot(c.clip_y, mean) + c.clip_y0) * inv_w;
  const float by_x = g.x * 0.5f * c.width, by_y = g.y * 0.5f * c.height;
  return (by_x * inv_w) * (c.clip_x - ndc_x * c.clip_w) +
         (by_y * inv_w) * (c.clip_y - ndc_y * c.clip_w) + view.x * c.to_x + view.y * c.to_y +
         view.z * c.to_z;
}

// Spherical harmonics: writes dL/dsh when asked (all K coefficients), returns dL/dmean.
FP_HD inline Vec3 sh_gradient(const Camera& c, const fragprune_inputs& in, int64_t i,
                              const PixelSums& s, float* by_sh, bool by_direction) {
  const int all = in.sh_coefficients;
  const float* sh = in.sh + static_cast<int64_t>(3) * all * i;
  const Vec3 away = read3(in.means + 3 * i) - c.centre;
  const float inv_length = 1 / std::sqrt(dot(away, away));
  const Vec3 direction = inv_length * away;
  Harmonics h;
  const int terms = harmonics(in.sh_degree, direction, h, by_direction);
  const Vec3 raw = raw_colour(sh, h, terms);
  // a channel clamped at zero passes nothing on
  const Vec3 g = {raw.x > 0 ? s.r : 0, raw.y > 0 ? s.g : 0, raw.z > 0 ? s.b : 0};
  if (by_sh) {
    for (int k = 0; k < terms; k++) write3(by_sh + 3 * k, h.value[k] * g);
    for (int k = terms; k < all; k++) write3(by_sh + 3 * k, {0, 0, 0});
  }
  if (!by_direction) return {0, 0, 0};
  Vec3 d = {0, 0, 0};
  for (int k = 0; k < terms; k++) d = add_scaled(d, dot(g, read3(sh + 3 * k)), h.slope[k]);
  return inv_length * (d - dot(d, direction) * direction);
}

}  // namespace fp
