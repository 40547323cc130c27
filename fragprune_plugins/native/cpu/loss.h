// The photometric loss of two images: L1 and structural similarity, and the gradient by the first.
//
// With s = x + y and d = x - y, and their means m and variances v under a Gaussian window,
//
//     1 - SSIM = P + Q - P Q,   P = m_d^2 / (m_x^2 + m_y^2 + C1),   Q = v_d / (v_x + v_y + C2)
//
// which is the usual product of two fractions, but loses no digits where the images are close. For
// the same reason v_s is summed around the pixel in the middle, across and then down.
//
// A panel of columns goes down a strip of rows and keeps the last eleven of each map, so that all of
// it stays in a core's own cache.
#pragma once

#include <algorithm>
#include <cstddef>

#include "../include/fragprune.h"
#include "simd.h"
#include "threads.h"
#include "workspace.h"

namespace fp {

constexpr int kReach = 5;  // pixels from the middle of the window to its rim
constexpr int kRing = 2 * kReach + 1;
constexpr float kTaps[kReach + 1] = {0.2660117249f,   0.2130055377f,   0.1093606895f,
                                     0.03600077213f,  0.007598758135f, 0.001028380084f};
constexpr float kC1 = 1e-4f, kC2 = 9e-4f;

constexpr int kPanel = 256;  // columns at most
constexpr int kStrip = 128;  // rows at most
constexpr int kStride = kPanel + 2 * 16;  // of a row in a panel: a border of 2 kReach, in registers
static_assert(kPanel % kLanes == 0 && kStride >= kPanel + 4 * kReach && kStride % kLanes == 0, "");

inline int divide_up(int n, int by) { return (n + by - 1) / by; }
inline int round_up(int n, int unit) { return divide_up(n, unit) * unit; }

// Cuts a length into pieces of about the same size, in whole units.
struct Pieces {
  Pieces(int length, int most, int unit)
      : size(round_up(divide_up(length, divide_up(length, most)), unit)),
        count(divide_up(length, size)) {}
  int size, count;
};

// Rows of a panel by what they hold; a ring has eleven of each kind, a number of rows apart.
enum LossRow {
  kSum = 0,  // s and d, rings
  kDifference = kSum + kRing,
  kMeanS = kDifference + kRing,  // their maps, blurred across, rings
  kVarS = kMeanS + kRing,
  kMeanD = kVarS + kRing,
  kSquareD = kMeanD + kRing,
  kByMean = kSquareD + kRing,  // the loss's gradients by blurred maps, blurred across again, rings
  kByD = kByMean + kRing,
  kByS = kByD + kRing,
  kFresh = kByS + kRing,  // the three before they are blurred
  kInside = kFresh + 3,   // 1 for columns of the image
  kOwn,                   // 1 for columns that are this panel's
  kResult,
  kLossRows
};

class LossPanel {
 public:
  struct Sums {
    double l1 = 0, dissimilarity = 0;
  };

  // rows: kLossRows * kStride floats.
  LossPanel(const fragprune_photometric& in, int channel, int x0, int x1, int y0, int y1,
            float* rows)
      : rows_(rows), plane_(static_cast<size_t>(channel) * in.height * in.width),
        image_(in.image + plane_), target_(in.target + plane_),
        gradient_(in.gradient ? in.gradient + plane_ : nullptr), width_(in.width),
        height_(in.height), x0_(x0), x1_(x1), y0_(y0), y1_(y1),
        wide_(round_up(x1 - x0, kLanes)), wider_(round_up(x1 - x0 + 2 * kReach, kLanes)) {
    const double count = static_cast<double>(in.channels) * in.height * in.width;
    by_l1_ = static_cast<float>(in.l1_weight / count);
    by_ssim_ = static_cast<float>(in.ssim_weight / count);
    float *inside = row(kInside), *own = row(kOwn);
    for (int j = 0; j < wider_; j++) {
      const int x = x0 - kReach + j;
      inside[j] = x >= 0 && x < width_;
      own[j] = x >= x0 && x < x1;
    }
  }

  Sums run() {
    const int ahead = gradient_ ? 2 * kReach : kReach;
    for (int y = y0_ - ahead; y < y1_ + ahead; y++) {
      load_row(y);
      blur_across(y);
      if (y - kReach < y0_ - ahead + kReach) continue;  // fewer than eleven rows so far
      if (!gradient_) {
        compare<false>(y - kReach);
        continue;
      }
      compare<true>(y - kReach);
      if (y - 2 * kReach >= y0_) write(y - 2 * kReach);
    }
    return sums_;
  }

 private:
  float* row(int kind) { return rows_ + kind * kStride; }
  float* row(int ring, int y) { return row(ring + (y + kRing) % kRing); }
  bool outside(int y) const { return y < 0 || y >= height_; }
  void clear(int ring, int y, int count) { std::fill_n(row(ring, y), count, 0.f); }

  // s and d of a row, zero outside the image.
  void load_row(int y) {
    const int first = x0_ - 2 * kReach, columns = wider_ + 2 * kReach;
    if (outside(y)) {
      clear(kSum, y, columns);
      clear(kDifference, y, columns);
      return;
    }
    float *s = row(kSum, y), *d = row(kDifference, y);
    const float* a = image_ + static_cast<size_t>(y) * width_;
    const float* b = target_ + static_cast<size_t>(y) * width_;
    const int begin = std::max(first, 0), end = std::min(first + columns, width_);
    std::fill(s, s + (begin - first), 0.f);
    std::fill(d, d + (begin - first), 0.f);
    int x = begin;
    for (; x + kLanes <= end; x += kLanes) {
      store(s + (x - first), load(a + x) + load(b + x));
      store(d + (x - first), load(a + x) - load(b + x));
    }
    for (; x < end; x++) s[x - first] = a[x] + b[x], d[x - first] = a[x] - b[x];
    std::fill(s + (x - first), s + columns, 0.f);
    std::fill(d + (x - first), d + columns, 0.f);
  }

  // Mean and variance of s, mean of d and of its square, in a row.
  void blur_across(int y) {
    if (outside(y)) {
      for (int ring : {kMeanS, kVarS, kMeanD, kSquareD}) clear(ring, y, wider_);
      return;
    }
    const float *s = row(kSum, y) + kReach, *d = row(kDifference, y) + kReach;
    float *mean_s = row(kMeanS, y), *var_s = row(kVarS, y);
    float *mean_d = row(kMeanD, y), *square_d = row(kSquareD, y);
    for (int j = 0; j < wider_; j += kLanes) {
      const Lanes middle = load(s + j), difference = load(d + j);
      Lanes shift = broadcast<Lanes>(0.f), spread = shift;
      Lanes mean = broadcast<Lanes>(kTaps[0]) * difference, square = mean * difference;
      for (int k = 1; k <= kReach; k++) {
        const Lanes tap = broadcast<Lanes>(kTaps[k]);
        const Lanes a = load(s + j - k) - middle, b = load(s + j + k) - middle;
        const Lanes e = load(d + j - k), f = load(d + j + k);
        shift = fma(tap, a + b, shift);
        spread = fma(tap, fma(a, a, b * b), spread);
        mean = fma(tap, e + f, mean);
        square = fma(tap, fma(e, e, f * f), square);
      }
      store(mean_s + j, middle + shift);
      store(var_s + j, fnma(shift, shift, spread));
      store(mean_d + j, mean);
      store(square_d + j, square);
    }
  }

  // The eleven rows of a ring around a row.
  struct Around {
    const float* middle;
    const float *above[kReach + 1], *below[kReach + 1];
  };
  Around around(int ring, int y) {
    Around to;
    to.middle = row(ring, y);
    for (int k = 1; k <= kReach; k++) to.above[k] = row(ring, y - k), to.below[k] = row(ring, y + k);
    return to;
  }

  static Lanes down(const Around& a, int j) {
    Lanes mean = broadcast<Lanes>(kTaps[0]) * load(a.middle + j);
    for (int k = 1; k <= kReach; k++)
      mean = fma(broadcast<Lanes>(kTaps[k]), load(a.above[k] + j) + load(a.below[k] + j), mean);
    return mean;
  }

  // What a row of pixels adds to the loss; and the loss's gradient by the blurred maps there, blurred
  // across.
  template <bool kGradient>
  void compare(int y) {
    if (outside(y)) {
      if (kGradient)
        for (int ring : {kByMean, kByD, kByS}) clear(ring, y, wide_);
      return;
    }
    const Around mean_s = around(kMeanS, y), var_s = around(kVarS, y);
    const Around mean_d = around(kMeanD, y), square_d = around(kSquareD, y);
    const float *inside = row(kInside), *own = row(kOwn), *d = row(kDifference, y) + kReach;
    float *by_mean = row(kFresh), *by_d = row(kFresh + 1), *by_s = row(kFresh + 2);
    const Lanes half = broadcast<Lanes>(0.5f), one = broadcast<Lanes>(1.f);
    Lanes l1 = broadcast<Lanes>(0.f), dissimilarity = l1;
    for (int j = 0; j < wider_; j += kLanes) {
      const Lanes middle = load(mean_s.middle + j);
      Lanes shift = broadcast<Lanes>(0.f);
      Lanes spread = broadcast<Lanes>(kTaps[0]) * load(var_s.middle + j);
      for (int k = 1; k <= kReach; k++) {
        const Lanes tap = broadcast<Lanes>(kTaps[k]);
        const Lanes a = load(mean_s.above[k] + j) - middle, b = load(mean_s.below[k] + j) - middle;
        const Lanes within = load(var_s.above[k] + j) + load(var_s.below[k] + j);
        shift = fma(tap, a + b, shift);
        spread = fma(tap, fma(a, a, fma(b, b, within)), spread);
      }
      const Lanes ms = middle + shift, vs = fnma(shift, shift, spread);
      const Lanes md = down(mean_d, j), vd = fnma(md, md, down(square_d, j));
      const Lanes light = fma(half, fma(ms, ms, md * md), broadcast<Lanes>(kC1));
      const Lanes structure = fma(half, vs + vd, broadcast<Lanes>(kC2));
      const Lanes both = load(inside + j) / (light * structure);
      const Lanes per_light = both * structure, per_structure = both * light;
      const Lanes p = md * md * per_light, q = vd * per_structure;
      const Lanes rest = one - p;
      dissimilarity = fma(fma(q, rest, p), load(own + j), dissimilarity);
      l1 = fma(abs(load(d + j)), load(own + j), l1);
      if (!kGradient) continue;
      const Lanes h = rest * per_structure, t = h * q * half;
      const Lanes kd = h - t;
      const Lanes direct = (one - q) * per_light * (md + fnma(p, ms + md, md));
      store(by_mean + j, fma(broadcast<Lanes>(2.f), fnma(md, kd, ms * t), direct));
      store(by_d + j, kd);
      store(by_s + j, -t);
    }
    if (y >= y0_ && y < y1_) {
      sums_.l1 += sum(l1);
      sums_.dissimilarity += sum(dissimilarity);
    }
    if (!kGradient) return;
    for (int i = 0; i < 3; i++) {
      const float* from = row(kFresh + i) + kReach;
      float* to = row(kByMean + i * kRing, y);
      for (int j = 0; j < wide_; j += kLanes) {
        Lanes blurred = broadcast<Lanes>(kTaps[0]) * load(from + j);
        for (int k = 1; k <= kReach; k++)
          blurred = fma(broadcast<Lanes>(kTaps[k]), load(from + j - k) + load(from + j + k), blurred);
        store(to + j, blurred);
      }
    }
  }

  // A row of the gradient.
  void write(int y) {
    const Around by_mean = around(kByMean, y), by_d = around(kByD, y), by_s = around(kByS, y);
    const float *s = row(kSum, y) + 2 * kReach, *d = row(kDifference, y) + 2 * kReach;
    const Lanes by_ssim = broadcast<Lanes>(by_ssim_), by_l1 = broadcast<Lanes>(by_l1_);
    const Lanes zero = broadcast<Lanes>(0.f), two = broadcast<Lanes>(2.f);
    float* result = row(kResult);
    for (int j = 0; j < wide_; j += kLanes) {
      const Lanes x = load(d + j);
      const Lanes squares = fma(x, down(by_d, j), load(s + j) * down(by_s, j));
      const Lanes by_dissimilarity = fma(two, squares, down(by_mean, j));
      const Lanes sign = where(gt(x, zero), by_l1) - where(gt(zero, x), by_l1);
      store(result + j, fma(by_ssim, by_dissimilarity, sign));
    }
    std::copy_n(result, x1_ - x0_, gradient_ + static_cast<size_t>(y) * width_ + x0_);
  }

  float* rows_;
  const size_t plane_;
  const float *image_, *target_;
  float* gradient_;
  const int width_, height_, x0_, x1_, y0_, y1_;
  const int wide_;   // columns of its own, in whole registers
  const int wider_;  // and the border that its gradient needs
  float by_l1_, by_ssim_;
  Sums sums_;
};

FP_STAGE inline void photometric_loss(fragprune_photometric& in, const Memory& memory) {
  const Pieces across(in.width, kPanel, kLanes), down(in.height, kStrip, 1);
  const size_t per_channel = static_cast<size_t>(across.count) * down.count;
  std::vector<LossPanel::Sums> sums(per_channel * in.channels);
  Team(in.threads).each(sums.size(), 1, [&](size_t i, size_t) {
    const int channel = static_cast<int>(i / per_channel);
    const int column = static_cast<int>(i % per_channel % across.count);
    const int strip = static_cast<int>(i % per_channel / across.count);
    const int x = column * across.size, y = strip * down.size;
    Buffer<float> rows(memory, size_t{kLossRows} * kStride);
    sums[i] = LossPanel(in, channel, x, std::min(x + across.size, in.width), y,
                        std::min(y + down.size, in.height), rows.data())
                  .run();
  });
  LossPanel::Sums all;
  for (const LossPanel::Sums& each : sums) {  // in the same order whatever the threads
    all.l1 += each.l1;
    all.dissimilarity += each.dissimilarity;
  }
  const double count = static_cast<double>(in.channels) * in.height * in.width;
  in.l1 = all.l1 / count;
  in.dissimilarity = all.dissimilarity / count;
}

}  // namespace fp
