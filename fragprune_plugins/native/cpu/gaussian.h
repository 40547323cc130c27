// The mathematics of one Gaussian in one view, and its derivatives: projection, the covariance of
// its image, the cutoff, colour from spherical harmonics. Over any number type V: a float, or a
// register of lanes, one Gaussian each. No memory but what it is handed.
#pragma once

#include "fragment.h"

namespace fp {

template <class V>
struct Vec {
  V x, y, z;
};
using Vec3 = Vec<float>;

template <class V>
struct Same {  // names V where it shall not be deduced
  typedef V Type;
};
template <class V>
using SameAs = typename Same<V>::Type;

template <class V>
FP_HD inline Vec<V> operator+(const Vec<V>& a, const Vec<V>& b) {
  return {a.x + b.x, a.y + b.y, a.z + b.z};
}
template <class V>
FP_HD inline Vec<V> operator-(const Vec<V>& a, const Vec<V>& b) {
  return {a.x - b.x, a.y - b.y, a.z - b.z};
}
template <class V>
FP_HD inline Vec<V> operator*(SameAs<V> s, const Vec<V>& a) {
  return {s * a.x, s * a.y, s * a.z};
}
template <class V>
FP_HD inline Vec<V> times(const Vec<V>& a, const Vec<V>& b) {
  return {a.x * b.x, a.y * b.y, a.z * b.z};
}
template <class V>
FP_HD inline Vec<V> add_scaled(const Vec<V>& a, SameAs<V> s, const Vec<V>& b) {
  return {fma(s, b.x, a.x), fma(s, b.y, a.y), fma(s, b.z, a.z)};
}
template <class V>
FP_HD inline V dot(const Vec<V>& a, const Vec<V>& b) {
  return fma(a.x, b.x, fma(a.y, b.y, a.z * b.z));
}
template <class V>
FP_HD inline Vec<V> cross(const Vec<V>& a, const Vec<V>& b) {
  return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}
FP_HD inline Vec3 read3(const float* p) { return {p[0], p[1], p[2]}; }
template <class V>
FP_HD inline Vec<V> lift(const Vec3& a) {
  return {broadcast<V>(a.x), broadcast<V>(a.y), broadcast<V>(a.z)};
}
template <class V>
FP_HD inline V clamp(V x, SameAs<V> low, SameAs<V> high) {  // NaN comes out as low
  return min(max(x, low), high);
}

// A camera, unpacked once per call. Column k of a row-vector matrix is what gives coordinate k.
template <class V>
struct Camera {
  Vec<V> to_x, to_y, to_z, shift;     // view space: to_x . p + shift.x, ...
  Vec<V> clip_x, clip_y, clip_w;      // clip space, the coordinates that are used
  Vec<V> clip_0;
  Vec<V> centre;
  V focal_x, focal_y;                 // pixels
  V limit_x, limit_y;                 // where x/z and y/z stop in the Jacobian
  V width, height;                    // pixels
  V tiles_x, tiles_y;
  V scale_modifier, dilation, near;
  V spread;                           // how far from its centre a pixel is sampled at most
  int32_t compensation;               // enum fragprune_compensation
};

// `spread` is the largest of |sample_offsets|.
FP_HD inline Camera<float> unpack_camera(const fragprune_inputs& in, float spread) {
  const float *v = in.viewmatrix, *p = in.projmatrix;
  const float margin = static_cast<float>(FRAGPRUNE_FRUSTUM_MARGIN);
  Camera<float> c = Camera<float>();
  c.width = static_cast<float>(in.width);
  c.height = static_cast<float>(in.height);
  c.tiles_x = static_cast<float>((in.width + FRAGPRUNE_TILE - 1) / FRAGPRUNE_TILE);
  c.tiles_y = static_cast<float>((in.height + FRAGPRUNE_TILE - 1) / FRAGPRUNE_TILE);
  c.spread = spread;
  if (in.means2d) return c;
  c.to_x = {v[0], v[4], v[8]};
  c.to_y = {v[1], v[5], v[9]};
  c.to_z = {v[2], v[6], v[10]};
  c.shift = {v[12], v[13], v[14]};
  c.clip_x = {p[0], p[4], p[8]};
  c.clip_y = {p[1], p[5], p[9]};
  c.clip_w = {p[3], p[7], p[11]};
  c.clip_0 = {p[12], p[13], p[15]};
  c.centre = read3(in.campos);
  c.focal_x = c.width / (2 * in.tan_fov_x);
  c.focal_y = c.height / (2 * in.tan_fov_y);
  c.limit_x = margin * in.tan_fov_x;
  c.limit_y = margin * in.tan_fov_y;
  c.scale_modifier = in.scale_modifier;
  c.dilation = in.dilation;
  c.near = in.near;
  c.compensation = in.compensation;
  return c;
}

template <class V>
FP_HD inline Camera<V> lift(const Camera<float>& c) {
  const auto up = [](float x) { return broadcast<V>(x); };
  return {lift<V>(c.to_x),   lift<V>(c.to_y),   lift<V>(c.to_z),   lift<V>(c.shift),
          lift<V>(c.clip_x), lift<V>(c.clip_y), lift<V>(c.clip_w), lift<V>(c.clip_0),
          lift<V>(c.centre), up(c.focal_x),     up(c.focal_y),     up(c.limit_x),
          up(c.limit_y),     up(c.width),       up(c.height),      up(c.tiles_x),
          up(c.tiles_y),     up(c.scale_modifier), up(c.dilation), up(c.near),
          up(c.spread),      c.compensation};
}

template <class V>
struct Mat3 {
  Vec<V> row[3];
};
template <class V>
FP_HD inline Vec<V> operator*(const Mat3<V>& m, const Vec<V>& v) {
  return {dot(m.row[0], v), dot(m.row[1], v), dot(m.row[2], v)};
}
template <class V>
FP_HD inline Vec<V> row_times(const Vec<V>& v, const Mat3<V>& m) {
  return add_scaled(add_scaled(v.x * m.row[0], v.y, m.row[1]), v.z, m.row[2]);
}

// A Gaussian's own numbers, as they were given.
template <class V>
struct Given {
  Vec<V> mean;
  bool factored;   // scales and rotation are meant; else the covariance
  Vec<V> scale;
  V rotation[4];   // w x y z, used as given (the host normalises)
  V cov3d[6];      // xx xy xz yy yz zz
};

template <class V>
FP_HD inline Mat3<V> rotation_of(const V* q) {
  const V w = q[0], x = q[1], y = q[2], z = q[3];
  return {{{1.f - 2.f * (y * y + z * z), 2.f * (x * y - w * z), 2.f * (x * z + w * y)},
           {2.f * (x * y + w * z), 1.f - 2.f * (x * x + z * z), 2.f * (y * z - w * x)},
           {2.f * (x * z - w * y), 2.f * (y * z + w * x), 1.f - 2.f * (x * x + y * y)}}};
}

template <class V>
FP_HD inline void rotation_gradient(const V* q, const Mat3<V>& g, V* out) {
  const V w = q[0], x = q[1], y = q[2], z = q[3];
  const Vec<V>&a = g.row[0], &b = g.row[1], &c = g.row[2];
  out[0] = 2.f * (z * (b.x - a.y) + y * (a.z - c.x) + x * (c.y - b.z));
  out[1] = 2.f * (y * (a.y + b.x) + z * (a.z + c.x) + w * (c.y - b.z)) - 4.f * x * (b.y + c.z);
  out[2] = 2.f * (x * (a.y + b.x) + z * (b.z + c.y) + w * (a.z - c.x)) - 4.f * y * (a.x + c.z);
  out[3] = 2.f * (x * (a.z + c.x) + y * (b.z + c.y) + w * (b.x - a.y)) - 4.f * z * (a.x + b.y);
}

// The 3D covariance in the form it was given: a square root (rotation times scales) or itself.
template <class V>
struct Shape {
  bool factored;
  Mat3<V> matrix;  // factored: rotation * diag(scales); else the symmetric covariance
};

template <class V>
FP_HD inline Shape<V> shape_of(const Camera<V>& c, const Given<V>& g) {
  Shape<V> s;
  s.factored = g.factored;
  if (s.factored) {
    s.matrix = rotation_of(g.rotation);
    const Vec<V> size = c.scale_modifier * g.scale;
    for (Vec<V>& r : s.matrix.row) r = times(r, size);
  } else {
    const V* m = g.cov3d;
    s.matrix = {{{m[0], m[1], m[2]}, {m[1], m[3], m[4]}, {m[2], m[4], m[5]}}};
  }
  return s;
}

// One Gaussian's image, before its opacity is known.
template <class V>
struct Projection {
  Vec<V> view;                // view-space mean
  V x, y;                     // pixels
  Vec<V> axis_x, axis_y;      // rows of the Jacobian times the view rotation
  Vec<V> image_x, image_y;    // those rows times the shape's matrix
  V var_x, cov, var_y;        // pixels^2, dilated
  V det, det_before;          // with and without dilation
  MaskOf<V> free_x, free_y;   // not clamped in the Jacobian
  V radius;                                // pixels, a whole number, the host's
  V tile_x0, tile_x1, tile_y0, tile_y1;    // the host's rectangle of tiles, half open
};

// The Jacobian of perspective, evaluated where the host does: x/z and y/z clamped.
template <class V>
FP_HD inline void project_axes(const Camera<V>& c, Projection<V>& p) {
  const V inv_z = 1.f / p.view.z;
  const V slope_x = p.view.x * inv_z, slope_y = p.view.y * inv_z;
  p.free_x = ge(c.limit_x, abs(slope_x));
  p.free_y = ge(c.limit_y, abs(slope_y));
  p.axis_x = (c.focal_x * inv_z) * (c.to_x - clamp(slope_x, -c.limit_x, c.limit_x) * c.to_z);
  p.axis_y = (c.focal_y * inv_z) * (c.to_y - clamp(slope_y, -c.limit_y, c.limit_y) * c.to_z);
}

// a . (m b) in double precision, for a symmetric m.
template <class V>
FP_HD inline WideOf<V> wide_form(const Vec<V>& a, const Mat3<V>& m, const Vec<V>& b) {
  const WideOf<V> x = widen(b.x), y = widen(b.y), z = widen(b.z);
  const auto row = [&](const Vec<V>& r) {
    return widen(r.x) * x + widen(r.y) * y + widen(r.z) * z;
  };
  return widen(a.x) * row(m.row[0]) + widen(a.y) * row(m.row[1]) + widen(a.z) * row(m.row[2]);
}

// The image's covariance. var_x var_y - cov^2 loses every digit on a long thin splat: determinants
// of factored shapes are squared areas (Lagrange's identity), the others need double precision.
template <class V>
FP_HD inline void project_shape(const Camera<V>& c, const Shape<V>& s, Projection<V>& p) {
  p.image_x = row_times(p.axis_x, s.matrix);
  p.image_y = row_times(p.axis_y, s.matrix);
  if (s.factored) {
    p.var_x = dot(p.image_x, p.image_x);
    p.cov = dot(p.image_x, p.image_y);
    p.var_y = dot(p.image_y, p.image_y);
    const Vec<V> area = cross(p.image_x, p.image_y);
    p.det_before = dot(area, area);
  } else {
    const WideOf<V> xx = wide_form(p.axis_x, s.matrix, p.axis_x);
    const WideOf<V> xy = wide_form(p.axis_x, s.matrix, p.axis_y);
    const WideOf<V> yy = wide_form(p.axis_y, s.matrix, p.axis_y);
    p.var_x = narrow(xx);
    p.cov = narrow(xy);
    p.var_y = narrow(yy);
    p.det_before = narrow(xx * yy - xy * xy);
  }
  p.det = p.det_before + c.dilation * (p.var_x + p.var_y + c.dilation);
  p.var_x = p.var_x + c.dilation;
  p.var_y = p.var_y + c.dilation;
}

// The host's radius and the tiles of its 3-sigma square; false when it touches none.
template <class V>
FP_HD inline MaskOf<V> host_extent(const Camera<V>& c, Projection<V>& p) {
  const V mid = 0.5f * (p.var_x + p.var_y), none = broadcast<V>(0.f);
  const V gap = mid * mid - p.det;
  p.radius = ceil(3.f * sqrt(mid + sqrt(max(gap, broadcast<V>(0.1f)))));
  constexpr float per_tile = 1.f / FRAGPRUNE_TILE, more = FRAGPRUNE_TILE - 1;
  p.tile_x0 = floor(clamp((p.x - p.radius) * per_tile, none, c.tiles_x));
  p.tile_x1 = floor(clamp((p.x + p.radius + more) * per_tile, none, c.tiles_x));
  p.tile_y0 = floor(clamp((p.y - p.radius) * per_tile, none, c.tiles_y));
  p.tile_y1 = floor(clamp((p.y + p.radius + more) * per_tile, none, c.tiles_y));
  // whole numbers: at least one tile, and the radius finite and not beyond any image
  const V one = broadcast<V>(1.f);
  const MaskOf<V> touches = both(ge(p.tile_x1 - p.tile_x0, one), ge(p.tile_y1 - p.tile_y0, one));
  return both(touches, ge(broadcast<V>(1e9f), p.radius));
}

template <class V>
FP_HD inline MaskOf<V> in_front(const Camera<V>& c, const Vec<V>& mean) {
  return gt(dot(c.to_z, mean) + c.shift.z, c.near);
}

// False: the host culls it (or it is not finite). Comparisons are written so that NaN fails them.
template <class V>
FP_HD inline MaskOf<V> project(const Camera<V>& c, const Given<V>& g, Projection<V>& p) {
  p.view = {dot(c.to_x, g.mean) + c.shift.x, dot(c.to_y, g.mean) + c.shift.y,
            dot(c.to_z, g.mean) + c.shift.z};
  const V inv_w = 1.f / (dot(c.clip_w, g.mean) + c.clip_0.z + 1e-7f);
  p.x = (((dot(c.clip_x, g.mean) + c.clip_0.x) * inv_w + 1.f) * c.width - 1.f) * 0.5f;
  p.y = (((dot(c.clip_y, g.mean) + c.clip_0.y) * inv_w + 1.f) * c.height - 1.f) * 0.5f;
  const V far = broadcast<V>(1e9f), none = broadcast<V>(0.f);
  const MaskOf<V> near_image = both(ge(far, abs(p.x)), ge(far, abs(p.y)));
  project_axes(c, p);
  project_shape(c, shape_of(c, g), p);
  const MaskOf<V> has_area = both(both(gt(p.det, none), gt(broadcast<V>(1e37f), p.det)),
                                  both(gt(p.var_x, none), gt(p.var_y, none)));
  const MaskOf<V> touches = host_extent(c, p);
  return both(both(in_front(c, g.mean), near_image), both(has_area, touches));
}

// What dilation takes from the opacity: the root of a ratio of determinants, `square`, or 0.
template <class V>
struct Compensation {
  V square;        // of the factor
  V ratio, below;  // of the determinants, and what it was divided by
  MaskOf<V> free;  // the determinants move the factor
  V factor;
};

template <class V>
FP_HD inline Compensation<V> compensation_of(const Camera<V>& c, const Projection<V>& p) {
  constexpr float floor = static_cast<float>(FRAGPRUNE_ANTIALIASING_FLOOR);
  constexpr float least = static_cast<float>(FRAGPRUNE_MIP_FLOOR);
  const bool mip = c.compensation == FRAGPRUNE_MIP;
  Compensation<V> o;
  o.below = mip ? p.det + least : p.det;
  o.ratio = p.det_before / o.below;
  o.free = mip ? both(gt(p.det_before, broadcast<V>(least)), gt(p.det, broadcast<V>(least)))
               : gt(o.ratio, broadcast<V>(floor));
  o.square = mip ? o.ratio + least : max(o.ratio, broadcast<V>(floor));
  const V root = sqrt(o.square);
  o.factor = mip ? select(o.free, root, broadcast<V>(0.f)) : root;
  return o;
}

template <class V>
FP_HD inline V compensation(const Camera<V>& c, const Projection<V>& p) {
  if (c.compensation == FRAGPRUNE_NO_COMPENSATION) return broadcast<V>(1.f);
  return compensation_of(c, p).factor;
}

// The cutoff, once for everything: a fragment is drawn iff log2 of its alpha is at least this, that
// is, iff alpha >= 1/255 and falloff >= threshold (the truncation's falloff, 0 for none).
template <class V>
FP_HD inline V cut_of(V log_opacity, V threshold) {
  return max(log_opacity + log2(threshold), broadcast<V>(kFaintest));
}

// The falloff down to which the backward pass visits the rim of a threshold.
template <class V>
FP_HD inline V rim_reach(V threshold) {
  constexpr float reach = static_cast<float>(FRAGPRUNE_RIM_REACH * FRAGPRUNE_RIM_WIDTH);
  constexpr float least = static_cast<float>(FRAGPRUNE_FALLOFF_MIN);
  return min(max(threshold - reach, broadcast<V>(least)), threshold);
}

// The completed square of a Gaussian that is given on the image; see Brush.
template <class V>
struct Square {
  V scale, skew, down;
  MaskOf<V> exists;  // the conic is positive definite
};

template <class V>
FP_HD inline Square<V> square_of(V xx, V xy, V yy) {
  const V unit = broadcast<V>(0.5f * kLog2E), none = broadcast<V>(0.f);
  const V det = narrow(widen(xx) * widen(yy) - widen(xy) * widen(xy)), inv = 1.f / xx;
  Square<V> s;
  s.scale = sqrt(unit * xx);
  s.skew = s.scale * xy * inv;
  s.down = sqrt(unit * (det * inv));
  const V far = broadcast<V>(1e30f);
  s.exists = both(both(gt(xx, none), gt(det, none)), both(gt(far, xx), gt(far, det)));
  return s;
}

// Spherical harmonics up to degree 3 in the field's order and signs: values, and when asked slopes.
template <class V>
struct Harmonics {
  V value[16];
  Vec<V> slope[16];
};

template <class V>
FP_HD inline int harmonics(int degree, const Vec<V>& d, Harmonics<V>& h, bool with_slope) {
  constexpr float c0 = 0.28209479177387814f, c1 = 0.4886025119029199f;
  constexpr float c2[5] = {1.0925484305920792f, -1.0925484305920792f, 0.31539156525252005f,
                           -1.0925484305920792f, 0.5462742152960396f};
  constexpr float c3[7] = {-0.5900435899266435f, 2.890611442640554f, -0.4570457994644658f,
                           0.3731763325901154f,  -0.4570457994644658f, 1.445305721320277f,
                           -0.5900435899266435f};
  const V x = d.x, y = d.y, z = d.z, xx = x * x, yy = y * y, zz = z * z;
  V* v = h.value;
  v[0] = broadcast<V>(c0);
  if (degree >= 1) v[1] = -c1 * y, v[2] = c1 * z, v[3] = -c1 * x;
  if (degree >= 2) {
    v[4] = c2[0] * x * y;
    v[5] = c2[1] * y * z;
    v[6] = c2[2] * (2.f * zz - xx - yy);
    v[7] = c2[3] * x * z;
    v[8] = c2[4] * (xx - yy);
  }
  if (degree >= 3) {
    v[9] = c3[0] * y * (3.f * xx - yy);
    v[10] = c3[1] * x * y * z;
    v[11] = c3[2] * y * (4.f * zz - xx - yy);
    v[12] = c3[3] * z * (2.f * zz - 3.f * xx - 3.f * yy);
    v[13] = c3[4] * x * (4.f * zz - xx - yy);
    v[14] = c3[5] * z * (xx - yy);
    v[15] = c3[6] * x * (xx - 3.f * yy);
  }
  if (with_slope) {
    const V none = broadcast<V>(0.f);
    const auto scaled = [](float by, const Vec<V>& a) { return broadcast<V>(by) * a; };
    Vec<V>* s = h.slope;
    s[0] = {none, none, none};
    if (degree >= 1) {
      s[1] = {none, broadcast<V>(-c1), none};
      s[2] = {none, none, broadcast<V>(c1)};
      s[3] = {broadcast<V>(-c1), none, none};
    }
    if (degree >= 2) {
      s[4] = scaled(c2[0], {y, x, none});
      s[5] = scaled(c2[1], {none, z, y});
      s[6] = scaled(c2[2], {-2.f * x, -2.f * y, 4.f * z});
      s[7] = scaled(c2[3], {z, none, x});
      s[8] = scaled(c2[4], {2.f * x, -2.f * y, none});
    }
    if (degree >= 3) {
      s[9] = scaled(c3[0], {6.f * x * y, 3.f * xx - 3.f * yy, none});
      s[10] = scaled(c3[1], {y * z, x * z, x * y});
      s[11] = scaled(c3[2], {-2.f * x * y, 4.f * zz - xx - 3.f * yy, 8.f * y * z});
      s[12] = scaled(c3[3], {-6.f * x * z, -6.f * y * z, 6.f * zz - 3.f * xx - 3.f * yy});
      s[13] = scaled(c3[4], {4.f * zz - 3.f * xx - yy, -2.f * x * y, 8.f * x * z});
      s[14] = scaled(c3[5], {2.f * x * z, -2.f * y * z, xx - yy});
      s[15] = scaled(c3[6], {3.f * xx - 3.f * yy, -6.f * x * y, none});
    }
  }
  return (degree + 1) * (degree + 1);
}

// Colour before the clamp at zero; coefficient(k) is the k-th of the three channels.
template <class V, class CoefficientOf>
FP_HD inline Vec<V> raw_colour(const Harmonics<V>& h, int terms, CoefficientOf coefficient) {
  const V half = broadcast<V>(0.5f);
  Vec<V> colour = {half, half, half};
  for (int k = 0; k < terms; k++) colour = add_scaled(colour, h.value[k], coefficient(k));
  return colour;
}

// The direction in which a camera sees a mean, and 1 / its distance.
template <class V>
FP_HD inline Vec<V> direction_to(const Vec<V>& centre, const Vec<V>& mean, V& inv_length) {
  const Vec<V> away = mean - centre;
  inv_length = 1.f / sqrt(dot(away, away));
  return inv_length * away;
}

// ---- derivatives -----------------------------------------------------------------------------

// What the pixels say about one Gaussian: sums over its fragments of w, alpha before the cap times
// dL/dalpha: the weight of everything that acts through the exponent. u and v as in Brush.
template <class V>
struct PixelSums {
  V w;                      // sum of w
  V threshold;              // dL/dtau
  V u, v, uu, uv, vv;       // sums of w u, w v, w u^2, w u v, w v^2
  V r, g, b;                // dL/dcolour
  V inv_z;                  // dL/d(1/z)
  V absolute;               // sum over pixels of |gx| + |gy|, as in fragprune_input_grads
};

// dL/d of the image: its position and its dilated covariance.
template <class V>
struct ImageGradient {
  V x, y;  // pixels
  V var_x, cov, var_y;
};

template <class V>
FP_HD inline ImageGradient<V> image_gradient(const Camera<V>& c, const Projection<V>& p,
                                             const PixelSums<V>& s) {
  const V slope = p.cov / p.var_y, inv_down = 1.f / p.var_y, inv_along = p.var_y / p.det;
  // u = scale (dx - slope dy), v = down dy: back to pixels
  const V per_u = 1.f / sqrt(0.5f * kLog2E * inv_along);
  const V per_v = 1.f / sqrt(0.5f * kLog2E * inv_down);
  ImageGradient<V> g;
  // q = (dx - slope dy)^2 / along + dy^2 / down, dL/dq = -w/2
  g.x = per_u * s.u * inv_along;
  g.y = per_v * s.v * inv_down - slope * g.x;
  const V along = 0.5f * per_u * per_u * s.uu * inv_along * inv_along;
  const V by_slope = per_u * per_v * s.uv * inv_along;
  const V down = 0.5f * per_v * per_v * s.vv * inv_down * inv_down;
  // along = var_x - cov^2 / var_y, slope = cov / var_y, down = var_y
  g.var_x = along;
  g.cov = by_slope * inv_down - 2.f * slope * along;
  g.var_y = down + slope * (slope * along - by_slope * inv_down);
  if (c.compensation != FRAGPRUNE_NO_COMPENSATION) {
    const Compensation<V> o = compensation_of(c, p);
    const V by_ratio = select(o.free, 0.5f * s.w / (o.square * o.below),  // alpha goes with its root
                              broadcast<V>(0.f));
    g.var_x = g.var_x + by_ratio * (p.var_y - c.dilation - o.ratio * p.var_y);
    g.var_y = g.var_y + by_ratio * (p.var_x - c.dilation - o.ratio * p.var_x);
    g.cov = g.cov + by_ratio * 2.f * p.cov * (o.ratio - 1.f);
  }
  return g;
}

// dL/d of a Gaussian that is given on the image.
template <class V>
struct FootprintGradient {
  V x, y;        // pixels
  V xx, xy, yy;  // conic
};

template <class V>
FP_HD inline FootprintGradient<V> footprint_gradient(const Square<V>& b, const PixelSums<V>& s) {
  // u = scale dx + skew dy, v = down dy; dx = u along - v across, dy = v upright
  const V along = 1.f / b.scale, upright = 1.f / b.down, across = b.skew * along * upright;
  FootprintGradient<V> g;
  g.x = (2.f / kLog2E) * b.scale * s.u;
  g.y = (2.f / kLog2E) * fma(b.skew, s.u, b.down * s.v);
  g.xx = -0.5f * (along * along * s.uu - across * (2.f * along * s.uv - across * s.vv));
  g.xy = -upright * (along * s.uv - across * s.vv);
  g.yy = -0.5f * upright * upright * s.vv;
  return g;
}

// From the covariance of the image to the shape's matrix and to the view-space mean.
template <class V>
FP_HD inline Vec<V> shape_gradient(const Camera<V>& c, const Projection<V>& p, const Shape<V>& s,
                                   const ImageGradient<V>& g, Mat3<V>& by_matrix) {
  Vec<V> by_axis_x, by_axis_y;
  if (s.factored) {
    const Vec<V> by_image_x = (2.f * g.var_x) * p.image_x + g.cov * p.image_y;
    const Vec<V> by_image_y = (2.f * g.var_y) * p.image_y + g.cov * p.image_x;
    by_matrix.row[0] = p.axis_x.x * by_image_x + p.axis_y.x * by_image_y;
    by_matrix.row[1] = p.axis_x.y * by_image_x + p.axis_y.y * by_image_y;
    by_matrix.row[2] = p.axis_x.z * by_image_x + p.axis_y.z * by_image_y;
    by_axis_x = s.matrix * by_image_x;
    by_axis_y = s.matrix * by_image_y;
  } else {
    const Vec<V> left = g.var_x * p.axis_x + g.cov * p.axis_y;
    by_matrix.row[0] = left.x * p.axis_x + (g.var_y * p.axis_y.x) * p.axis_y;
    by_matrix.row[1] = left.y * p.axis_x + (g.var_y * p.axis_y.y) * p.axis_y;
    by_matrix.row[2] = left.z * p.axis_x + (g.var_y * p.axis_y.z) * p.axis_y;
    by_axis_x = (2.f * g.var_x) * p.image_x + g.cov * p.image_y;
    by_axis_y = (2.f * g.var_y) * p.image_y + g.cov * p.image_x;
  }
  // axis_x = focal/z to_x - focal t/z^2 to_z. As the host has it, t is a constant for z even where
  // it is x/z that was clamped, and where it was, x itself has no influence.
  const V inv_z = 1.f / p.view.z, inv_z2 = inv_z * inv_z;
  const V tx = clamp(p.view.x * inv_z, -c.limit_x, c.limit_x) * p.view.z;
  const V ty = clamp(p.view.y * inv_z, -c.limit_y, c.limit_y) * p.view.z;
  const V x_z = dot(by_axis_x, c.to_z), y_z = dot(by_axis_y, c.to_z);
  const V none = broadcast<V>(0.f);
  Vec<V> view;
  view.x = select(p.free_x, -c.focal_x * inv_z2 * x_z, none);
  view.y = select(p.free_y, -c.focal_y * inv_z2 * y_z, none);
  view.z = -c.focal_x * inv_z2 * dot(by_axis_x, c.to_x) -
           c.focal_y * inv_z2 * dot(by_axis_y, c.to_y) +
           2.f * inv_z2 * inv_z * (c.focal_x * tx * x_z + c.focal_y * ty * y_z);
  return view;
}

// dL/dmean of what acts through the pixel position and the view-space point.
template <class V>
FP_HD inline Vec<V> mean_gradient(const Camera<V>& c, const Vec<V>& mean,
                                  const ImageGradient<V>& g, const Vec<V>& view) {
  const V inv_w = 1.f / (dot(c.clip_w, mean) + c.clip_0.z + 1e-7f);
  const V ndc_x = (dot(c.clip_x, mean) + c.clip_0.x) * inv_w;
  const V ndc_y = (dot(c.clip_y, mean) + c.clip_0.y) * inv_w;
  const V by_x = g.x * 0.5f * c.width, by_y = g.y * 0.5f * c.height;
  return (by_x * inv_w) * (c.clip_x - ndc_x * c.clip_w) +
         (by_y * inv_w) * (c.clip_y - ndc_y * c.clip_w) + view.x * c.to_x + view.y * c.to_y +
         view.z * c.to_z;
}

// dL/d(channels) before the clamp at zero: a channel that it holds passes nothing on.
template <class V>
FP_HD inline Vec<V> through_clamp(const Vec<V>& raw, const Vec<V>& by) {
  const V none = broadcast<V>(0.f);
  return {select(gt(raw.x, none), by.x, none), select(gt(raw.y, none), by.y, none),
          select(gt(raw.z, none), by.z, none)};
}

// dL/dmean of what acts through the direction, for dL/d(channels) g.
template <class V, class CoefficientOf>
FP_HD inline Vec<V> direction_gradient(const Harmonics<V>& h, int terms, const Vec<V>& direction,
                                       V inv_length, const Vec<V>& g, CoefficientOf coefficient) {
  const V none = broadcast<V>(0.f);
  Vec<V> d = {none, none, none};
  for (int k = 1; k < terms; k++) d = add_scaled(d, dot(g, coefficient(k)), h.slope[k]);
  return inv_length * (d - dot(d, direction) * direction);
}

}  // namespace fp
