// The mathematics of one Gaussian in space and time, cut at a moment, and its derivatives. Over any
// number type V, as gaussian.h.
//
// What is left is a 3D Gaussian: the conditional mean and covariance, an opacity times how likely the
// moment is (the marginal), a colour. Gradients are the host's (RT-4DGS), which writes them by hand:
// where they are not the derivative it says so.
#pragma once

#include "gaussian.h"

namespace fp {

constexpr float kTurn = 6.28318530717958648f;
constexpr int kBands = 16;  // coefficients of one cosine: degree 3, or time has no say

// How Gaussians are given.
enum Kind {
  kSliced,  // as 3D covariances: at the moment already
  kStill,   // in space alone
  kApart,   // in space and, apart from it, in time
  kJoint    // with axes anywhere in space and time
};

// What the Gaussians of one call share.
template <class V>
struct Moment {
  Vec<V> centre;                      // of the camera
  V timestamp, per_duration;
  V more_variance;                    // that the marginal sees
  V scale_modifier;
  int32_t kind;                       // enum Kind
  int32_t orders;                     // cosines in use
  int32_t timed;                      // colours know time, if only for their gradients
};

FP_HD inline Moment<float> unpack_moment(const fragprune_spacetime& in) {
  Moment<float> m;
  m.centre = read3(in.campos);
  m.timestamp = in.timestamp;
  m.per_duration = 1.f / in.duration;
  m.more_variance = max(in.prefilter_var, 0.f);
  m.scale_modifier = in.scale_modifier;
  m.kind = in.cov3d ? kSliced : in.rotations_r ? kJoint : in.scales_t ? kApart : kStill;
  m.timed = in.sh && in.sh_degree_t >= 0;
  m.orders = m.timed && in.sh_degree == 3 ? in.sh_degree_t : 0;
  return m;
}

template <class V>
FP_HD inline Moment<V> lift(const Moment<float>& m) {
  const auto up = [](float x) { return broadcast<V>(x); };
  return {lift<V>(m.centre), up(m.timestamp), up(m.per_duration), up(m.more_variance),
          up(m.scale_modifier), m.kind, m.orders, m.timed};
}

// A Gaussian's own numbers as they were given, or gradients by them.
template <class V>
struct Spacetime {
  Vec<V> mean;
  V opacity, time;
  V scale[4];            // along the axes x, y, z, t; of kApart the last is a variance
  V left[4], right[4];   // quaternions w x y z, used as given; right of kJoint alone
  V cov3d[6];            // of kSliced: xx xy xz yy yz zz
};

// ---- rotations of space and time -------------------------------------------------------------

template <class V>
struct Quaternion {
  V w, x, y, z;
};
template <class V>
FP_HD inline Quaternion<V> quaternion(const V* q) {
  return {q[0], q[1], q[2], q[3]};
}
template <class V>
FP_HD inline Quaternion<V> operator+(const Quaternion<V>& a, const Quaternion<V>& b) {
  return {a.w + b.w, a.x + b.x, a.y + b.y, a.z + b.z};
}
template <class V>
FP_HD inline Quaternion<V> operator-(const Quaternion<V>& q) {
  return {-q.w, -q.x, -q.y, -q.z};
}
template <class V>
FP_HD inline Quaternion<V> operator*(const Quaternion<V>& a, const Quaternion<V>& b) {
  return {fma(a.w, b.w, -(a.x * b.x)) - fma(a.y, b.y, a.z * b.z),
          fma(a.w, b.x, a.x * b.w) + fma(a.y, b.z, -(a.z * b.y)),
          fma(a.w, b.y, a.y * b.w) + fma(a.z, b.x, -(a.x * b.z)),
          fma(a.w, b.z, a.z * b.w) + fma(a.x, b.y, -(a.y * b.x))};
}
template <class V>
FP_HD inline Quaternion<V> conjugate(const Quaternion<V>& q) {
  return {q.w, -q.x, -q.y, -q.z};
}
// 1, i, j or k times q.
template <class V>
FP_HD inline Quaternion<V> unit_times(int unit, const Quaternion<V>& q) {
  switch (unit) {
    case 0: return q;
    case 1: return {-q.x, q.w, -q.z, q.y};
    case 2: return {-q.y, q.z, q.w, -q.x};
    default: return {-q.z, -q.y, q.x, q.w};
  }
}

// Coordinates x, y, z, t of the turned axes, one axis a column.
template <class V>
struct Turn {
  V row[4][4];
};

// With (t, z, y, x) read as a quaternion v, the rotation is v -> left v right*.
template <class V>
FP_HD inline Turn<V> turn_of(const V* left, const V* right) {
  Turn<V> turn;
  const Quaternion<V> l = quaternion(left), r = conjugate(quaternion(right));
  for (int unit = 0; unit < 4; unit++) {
    const Quaternion<V> v = l * unit_times(unit, r);
    turn.row[3][3 - unit] = v.w, turn.row[2][3 - unit] = v.x;
    turn.row[1][3 - unit] = v.y, turn.row[0][3 - unit] = v.z;
  }
  return turn;
}

template <class V>
FP_HD inline void turn_gradient(const V* left, const V* right, const Turn<V>& g, V* by_left,
                                V* by_right) {
  const Quaternion<V> l = quaternion(left), r = conjugate(quaternion(right));
  const V none = broadcast<V>(0.f);
  Quaternion<V> by_l = {none, none, none, none}, by_r = by_l;
  for (int unit = 0; unit < 4; unit++) {
    const Quaternion<V> v = {g.row[3][3 - unit], g.row[2][3 - unit], g.row[1][3 - unit],
                             g.row[0][3 - unit]};
    by_l = by_l + v * conjugate(unit_times(unit, r));
    const Quaternion<V> by_unit_r = unit_times(unit, conjugate(l) * v);
    by_r = by_r + (unit ? -by_unit_r : by_unit_r);
  }
  by_left[0] = by_l.w, by_left[1] = by_l.x, by_left[2] = by_l.y, by_left[3] = by_l.z;
  by_right[0] = by_r.w, by_right[1] = -by_r.x, by_right[2] = -by_r.y, by_right[3] = -by_r.z;
}

// ---- the slice -------------------------------------------------------------------------------

template <class V>
FP_HD inline V dot4(const V* a, const V* b) {
  return fma(a[0], b[0], a[1] * b[1]) + fma(a[2], b[2], a[3] * b[3]);
}

// What is left of a Gaussian, or gradients by it.
template <class V>
struct Sliced {
  Vec<V> mean;
  V cov3d[6];
  V opacity;
};

// How it came about.
template <class V>
struct Section {
  Turn<V> turn;
  V size[4];                // scales along the axes, modified
  V across[3][4];           // the scaled axes' x, y and z, what goes along with t taken out
  V along[4];               // and their t
  V velocity[3];
  V inv_var;                // 1 / the variance in time
  V since;                  // the mean in time
  V inv_likely_var, marginal;
};

template <class V>
FP_HD inline Section<V> section_of(const Moment<V>& m, const Spacetime<V>& g) {
  const V none = broadcast<V>(0.f), one = broadcast<V>(1.f);
  Section<V> s;
  s.since = m.timestamp - g.time;
  for (int k = 0; k < 4; k++) s.size[k] = m.scale_modifier * g.scale[k];
  if (m.kind == kJoint) {
    s.turn = turn_of(g.left, g.right);
  } else {
    const Mat3<V> r = rotation_of(g.left);
    for (int i = 0; i < 3; i++) {
      V* row = s.turn.row[i];
      row[0] = r.row[i].x, row[1] = r.row[i].y, row[2] = r.row[i].z, row[3] = none;
    }
    for (int k = 0; k < 4; k++) s.turn.row[3][k] = none;
  }
  for (int k = 0; k < 4; k++) {
    s.along[k] = s.turn.row[3][k] * s.size[k];
    for (int i = 0; i < 3; i++) s.across[i][k] = s.turn.row[i][k] * s.size[k];
  }
  if (m.kind == kJoint) {
    const V var = dot4(s.along, s.along);
    s.inv_var = 1.f / var;
    s.inv_likely_var = 1.f / (var + m.more_variance);
    // cov_xx - cov_xt^2 / var is a difference of large numbers where a Gaussian is fast; its root,
    // the axes without what is along t, is not.
    for (int i = 0; i < 3; i++) {
      s.velocity[i] = dot4(s.across[i], s.along) * s.inv_var;
      for (int k = 0; k < 4; k++)
        s.across[i][k] = s.across[i][k] - s.velocity[i] * s.along[k];
    }
  } else {
    for (int i = 0; i < 3; i++) s.velocity[i] = none;
    s.inv_var = none;
    s.inv_likely_var = 1.f / (s.size[3] + m.more_variance);
  }
  if (m.kind == kJoint || m.kind == kApart) {
    const V power = (-0.5f * kLog2E) * (s.since * s.since * s.inv_likely_var);
    s.marginal = exp2(clamp(power, broadcast<V>(-120.f), broadcast<V>(120.f)));
  } else {
    s.marginal = one;
  }
  return s;
}

template <class V>
FP_HD inline MaskOf<V> finite(const V* cov3d) {
  const auto is = [](V v) { return ge(broadcast<V>(3.4028235e38f), abs(v)); };
  return both(both(both(is(cov3d[0]), is(cov3d[1])), both(is(cov3d[2]), is(cov3d[3]))),
              both(is(cov3d[4]), is(cov3d[5])));
}

// False: the Gaussian is not there.
template <class V>
FP_HD inline MaskOf<V> slice(const Moment<V>& m, const Spacetime<V>& g, Sliced<V>& to) {
  to.mean = g.mean;
  to.opacity = g.opacity;
  if (m.kind == kSliced) {
    for (int k = 0; k < 6; k++) to.cov3d[k] = g.cov3d[k];
  } else {
    const Section<V> s = section_of(m, g);
    to.mean = add_scaled(g.mean, s.since, Vec<V>{s.velocity[0], s.velocity[1], s.velocity[2]});
    for (int i = 0, at = 0; i < 3; i++)
      for (int j = i; j < 3; j++) to.cov3d[at++] = dot4(s.across[i], s.across[j]);
    to.opacity = g.opacity * s.marginal;
    constexpr float least = static_cast<float>(FRAGPRUNE_MARGINAL_MIN);
    return both(gt(s.marginal, broadcast<V>(least)), finite(to.cov3d));
  }
  return finite(to.cov3d);
}

// dL/d of what was given, of one that is there; colours add to `by` and to the time on their own.
template <class V>
FP_HD inline Spacetime<V> slice_gradient(const Moment<V>& m, const Spacetime<V>& g,
                                         const Sliced<V>& by) {
  const V none = broadcast<V>(0.f);
  Spacetime<V> to;
  to.mean = by.mean;
  to.opacity = by.opacity;  // of kApart too: the host leaves the marginal out altogether
  to.time = none;
  for (int k = 0; k < 4; k++) to.scale[k] = to.left[k] = to.right[k] = none;
  for (int k = 0; k < 6; k++) to.cov3d[k] = by.cov3d[k];
  if (m.kind == kSliced) return to;
  const Section<V> s = section_of(m, g);
  const V twice[3][3] = {{2.f * by.cov3d[0], by.cov3d[1], by.cov3d[2]},
                         {by.cov3d[1], 2.f * by.cov3d[3], by.cov3d[4]},
                         {by.cov3d[2], by.cov3d[4], 2.f * by.cov3d[5]}};
  Turn<V> by_axes;  // first of the scaled axes, then of the turned ones
  for (int i = 0; i < 3; i++)
    for (int k = 0; k < 4; k++)
      by_axes.row[i][k] = fma(twice[i][0], s.across[0][k],
                              fma(twice[i][1], s.across[1][k], twice[i][2] * s.across[2][k]));
  for (int k = 0; k < 4; k++) by_axes.row[3][k] = none;
  if (m.kind == kJoint) {
    const V by_mean[3] = {by.mean.x, by.mean.y, by.mean.z};
    to.opacity = by.opacity * s.marginal;
    const V by_power = to.opacity * g.opacity;  // of the marginal's logarithm
    const V slope = s.since * s.inv_likely_var;
    to.time = by_power * slope;
    for (int i = 0; i < 3; i++) {
      const V moves = by_mean[i] * s.since * s.inv_var;
      to.time = fma(-s.velocity[i], by_mean[i], to.time);
      // across is at right angles to along, and so is what acts through it
      for (int k = 0; k < 4; k++) {
        const V by_across = by_axes.row[i][k];
        by_axes.row[3][k] = by_axes.row[3][k] - s.velocity[i] * by_across +
                            moves * (s.across[i][k] - s.velocity[i] * s.along[k]);
        by_axes.row[i][k] = fma(moves, s.along[k], by_across);
      }
    }
    for (int k = 0; k < 4; k++)
      by_axes.row[3][k] = fma(by_power * slope * slope, s.along[k], by_axes.row[3][k]);
  }
  for (int k = 0; k < 4; k++) {
    V total = none;
    for (int i = 0; i < 4; i++) {
      total = fma(by_axes.row[i][k], s.turn.row[i][k], total);
      by_axes.row[i][k] = by_axes.row[i][k] * s.size[k];
    }
    to.scale[k] = m.scale_modifier * total;
  }
  if (m.kind == kJoint) {
    turn_gradient(g.left, g.right, by_axes, to.left, to.right);
  } else {
    Mat3<V> by_rotation;
    for (int i = 0; i < 3; i++)
      by_rotation.row[i] = {by_axes.row[i][0], by_axes.row[i][1], by_axes.row[i][2]};
    rotation_gradient(g.left, by_rotation, to.left);
  }
  return to;
}

// ---- colour ----------------------------------------------------------------------------------

// cos(2 pi turns) to 1e-7.
template <class V>
FP_HD inline V cosine(V turns) {
  const V some = clamp(turns, broadcast<V>(-1e6f), broadcast<V>(1e6f));
  const V a = kTurn * (0.25f - abs(some - floor(some + 0.5f)));  // cos x = sin(pi/2 - |x|)
  const V aa = a * a;
  V p = fma(broadcast<V>(-2.5052108e-8f), aa, broadcast<V>(2.7557319e-6f));
  p = fma(p, aa, broadcast<V>(-1.9841270e-4f));
  p = fma(p, aa, broadcast<V>(8.3333333e-3f));
  p = fma(p, aa, broadcast<V>(-1.6666667e-1f));
  return fma(p * aa, a, a);
}

// What the cosines weigh at one Gaussian's distance in time.
template <class V>
struct Waves {
  V first, second;
  V slope;  // of the highest in use, by the mean in time, with the sign that the host gives it
};

template <class V>
FP_HD inline Waves<V> waves_of(const Moment<V>& m, V time) {
  const V turns = (time - m.timestamp) * m.per_duration, none = broadcast<V>(0.f);
  const float top = static_cast<float>(m.orders);
  Waves<V> w = {none, none, none};
  if (m.orders >= 1) w.first = cosine(turns);
  if (m.orders >= 2) w.second = cosine(2.f * turns);
  if (m.orders >= 1) w.slope = (kTurn * top) * m.per_duration * cosine(top * turns - 0.25f);
  return w;
}

// A channel, not below 0; NaN stays, for engines to see.
template <class V>
FP_HD inline V lit(V channel) {
  const V none = broadcast<V>(0.f);
  return select(gt(none, channel), none, channel);
}

// The harmonic that the k-th coefficient's gradient goes with. The host takes the first one's for the
// second where colours know time.
template <class V>
FP_HD inline V given_harmonic(const Moment<V>& m, const Harmonics<V>& h, int k) {
  return m.timed && k == 1 ? h.value[0] : h.value[k];
}

}  // namespace fp
