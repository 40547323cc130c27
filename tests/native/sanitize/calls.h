// Random calls of the C interface, legal and not, and what must hold after each.
//
// Every array is a heap block of exactly the length that fragprune.h names, so that
// AddressSanitizer sees one element too many.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <initializer_list>
#include <limits>
#include <memory>
#include <utility>
#include <vector>

#include "fragprune.h"

// Of the sanitizers' runtime; absent in a build without them.
extern "C" void __sanitizer_set_death_callback(void (*)()) __attribute__((weak));

namespace calls {

// Where random numbers come from: first the bytes given, then a generator seeded with them.
class Source {
 public:
  explicit Source(uint64_t seed) : state_(seed) {}
  Source(const uint8_t* bytes, size_t size) : bytes_(bytes), left_(size) {
    for (size_t i = 0; i < size; i++) state_ = (state_ ^ bytes[i]) * 0x100000001b3ull;
  }

  uint32_t next() {
    if (left_ >= 4) {
      uint32_t word;
      std::memcpy(&word, bytes_, 4);
      bytes_ += 4;
      left_ -= 4;
      return word;
    }
    state_ += 0x9e3779b97f4a7c15ull;  // splitmix64
    uint64_t z = state_;
    z = (z ^ (z >> 30)) * 0xbf58476d1ce4e5b9ull;
    z = (z ^ (z >> 27)) * 0x94d049bb133111ebull;
    return static_cast<uint32_t>(z >> 32);
  }
  int below(int n) { return static_cast<int>(next() % static_cast<uint32_t>(n)); }
  bool one_in(int n) { return below(n) == 0; }
  float uniform(float low, float high) {
    return low + (high - low) * static_cast<float>(next() >> 8) * 0x1p-24f;
  }
  float log_uniform(float low, float high) {
    return std::exp(uniform(std::log(low), std::log(high)));
  }
  // A number that nobody should pass in, but somebody will; any bit pattern now and then.
  float poison() {
    constexpr float infinity = std::numeric_limits<float>::infinity();
    const float bad[] = {std::nanf(""), infinity, -infinity, 0.f,    -0.f,   1e-44f,
                         1e38f,         -1e38f,   3e9f,      -1e-9f, 65536.f};
    const size_t choice = next() % (std::size(bad) + 2);
    if (choice < std::size(bad)) return bad[choice];
    const uint32_t word = next();
    float any;
    std::memcpy(&any, &word, sizeof any);
    return any;
  }

 private:
  const uint8_t* bytes_ = nullptr;
  size_t left_ = 0;
  uint64_t state_ = 0xcbf29ce484222325ull;
};

// Which random call is being made, to repeat it alone.
inline thread_local uint64_t seed_in_hand = 0;
inline void name_the_seed() {
  std::fprintf(stderr, "seed in hand: %llu\n", static_cast<unsigned long long>(seed_in_hand));
}
inline void name_the_seed_on_death() {
  if (__sanitizer_set_death_callback) __sanitizer_set_death_callback(name_the_seed);
}

[[noreturn]] inline void fail(const char* what, const char* file, int line) {
  std::fprintf(stderr, "%s:%d: does not hold: %s\n", file, line, what);
  name_the_seed();
  std::abort();
}
#define CALLS_CHECK(condition) \
  ((condition) ? void() : ::calls::fail(#condition, __FILE__, __LINE__))

// An array that may be absent. Fresh ones hold a pattern that no result has, to see what is written.
template <class T>
class Array {
 public:
  static constexpr int kPattern = 0xab;

  void make(size_t size) {
    size_ = size;
    data_.reset(new T[size]);
    std::memset(data_.get(), kPattern, size * sizeof(T));
  }
  T* get() const { return data_.get(); }
  size_t size() const { return data_ ? size_ : 0; }
  int64_t length() const { return static_cast<int64_t>(size()); }
  T& operator[](size_t i) const { return data_[i]; }
  bool written() const {
    T pattern;
    std::memset(&pattern, kPattern, sizeof pattern);
    for (size_t i = 0; i < size(); i++)
      if (!std::memcmp(&data_[i], &pattern, sizeof pattern)) return false;
    return true;
  }
  bool finite() const {
    return std::all_of(get(), get() + size(), [](T x) { return std::isfinite(x); });
  }
  bool same_bits(const Array& other) const {
    if (size() != other.size()) return false;
    return size() == 0 || !std::memcmp(get(), other.get(), size() * sizeof(T));
  }

 private:
  std::unique_ptr<T[]> data_;
  size_t size_ = 0;
};

using Floats = Array<float>;
using Integers = Array<int32_t>;

inline void fill(Floats& array, size_t size, Source& from, float low, float high) {
  array.make(size);
  for (size_t i = 0; i < size; i++) array[i] = from.uniform(low, high);
}

struct Limits {
  int gaussians = 200;
  int pixels = 70;  // width and height
};

struct Scene {
  fragprune_inputs in{};
  Floats viewmatrix, projmatrix, campos, background;
  Floats means, opacities, scales, rotations, cov3d, sh, colors, features, thresholds, offsets;
  Floats means2d, conics, depths;
  Integers tiles;
  bool tame = true;  // nothing poisoned: results must be finite

  size_t count() const { return static_cast<size_t>(in.count); }
  size_t pixels() const { return static_cast<size_t>(in.width) * in.height; }
  void point() {
    in.viewmatrix = viewmatrix.get(), in.projmatrix = projmatrix.get();
    in.campos = campos.get(), in.background = background.get();
    in.means = means.get(), in.opacities = opacities.get(), in.scales = scales.get();
    in.rotations = rotations.get(), in.cov3d = cov3d.get(), in.sh = sh.get();
    in.colors = colors.get(), in.thresholds = thresholds.get();
    in.features = features.get(), in.sample_offsets = offsets.get();
    in.means2d = means2d.get(), in.conics = conics.get();
    in.depths = depths.get(), in.tiles = tiles.get();
    fragprune_lengths& held = in.lengths;
    held.viewmatrix = viewmatrix.length(), held.projmatrix = projmatrix.length();
    held.campos = campos.length(), held.background = background.length();
    held.means = means.length(), held.opacities = opacities.length();
    held.scales = scales.length(), held.rotations = rotations.length();
    held.cov3d = cov3d.length(), held.sh = sh.length(), held.colors = colors.length();
    held.features = features.length(), held.thresholds = thresholds.length();
    held.sample_offsets = offsets.length(), held.means2d = means2d.length();
    held.conics = conics.length(), held.depths = depths.length(), held.tiles = tiles.length();
  }
};

inline void unit_quaternion(Source& from, float* q) {
  float length = 0;
  for (int k = 0; k < 4; k++) q[k] = from.uniform(-1, 1), length += q[k] * q[k];
  length = std::sqrt(length);
  if (length < 1e-3f) q[0] = length = 1, q[1] = q[2] = q[3] = 0;
  for (int k = 0; k < 4; k++) q[k] /= length;
}

inline void rotation_matrix(const float* q, float m[3][3]) {
  const float cross[3][3] = {{0, -q[3], q[2]}, {q[3], 0, -q[1]}, {-q[2], q[1], 0}};
  for (int i = 0; i < 3; i++)
    for (int j = 0; j < 3; j++) {
      float square = 0;
      for (int k = 0; k < 3; k++) square += cross[i][k] * cross[k][j];
      m[i][j] = (i == j) + 2 * (q[0] * cross[i][j] + square);
    }
}

// A camera turned and moved at random; matrices act on row vectors.
inline void make_camera(Scene& s, Source& from, float turn[3][3], float shift[3]) {
  float q[4];
  unit_quaternion(from, q);
  rotation_matrix(q, turn);
  for (int k = 0; k < 3; k++) shift[k] = from.uniform(-2, 2);
  s.in.tan_fov_x = from.uniform(0.2f, 1.5f);
  s.in.tan_fov_y = from.uniform(0.2f, 1.5f);
  float view[4][4] = {}, lens[4][4] = {};
  for (int i = 0; i < 3; i++) {
    for (int j = 0; j < 3; j++) view[i][j] = turn[j][i];
    view[3][i] = shift[i];
  }
  view[3][3] = 1;
  lens[0][0] = 1 / s.in.tan_fov_x, lens[1][1] = 1 / s.in.tan_fov_y;
  lens[2][2] = 1, lens[2][3] = 1, lens[3][2] = -0.01f;
  s.viewmatrix.make(16), s.projmatrix.make(16), s.campos.make(3);
  std::memcpy(s.viewmatrix.get(), view, sizeof view);
  for (int i = 0; i < 4; i++)
    for (int j = 0; j < 4; j++) {
      float sum = 0;
      for (int k = 0; k < 4; k++) sum += view[i][k] * lens[k][j];
      s.projmatrix[i * 4 + j] = sum;
    }
  for (int k = 0; k < 3; k++)
    s.campos[k] = -(turn[0][k] * shift[0] + turn[1][k] * shift[1] + turn[2][k] * shift[2]);
}

// Where a Gaussian is and how large: on the image, beside it, on a tile's border, behind the camera;
// of 1/1000 of a pixel to thousands, some flat, some of no size at all.
inline void place(Scene& s, Source& from, size_t i, const float turn[3][3], const float* shift,
                  float* sizes) {
  const float width = static_cast<float>(s.in.width), height = static_cast<float>(s.in.height);
  float x = from.uniform(-0.1f, 1.1f) * width, y = from.uniform(-0.1f, 1.1f) * height;
  float z = from.uniform(0.25f, 9);
  const int kind = from.below(12);
  if (kind == 0) x = x * 5 - 2 * width, y = y * 5 - 2 * height;
  if (kind == 1) x = std::round(x / FRAGPRUNE_TILE) * FRAGPRUNE_TILE - 0.5f;
  if (kind == 2) z = from.uniform(-4, 0.21f);
  if (kind == 3 && i > 0) z = 2;  // ties in depth
  const float tan_x = s.in.tan_fov_x, tan_y = s.in.tan_fov_y;
  const float seen[3] = {((2 * x + 1) / width - 1) * tan_x * z - shift[0],
                         ((2 * y + 1) / height - 1) * tan_y * z - shift[1], z - shift[2]};
  for (int k = 0; k < 3; k++)
    s.means[3 * i + k] = turn[0][k] * seen[0] + turn[1][k] * seen[1] + turn[2][k] * seen[2];
  const float pixel = std::fabs(z) * 2 * tan_x / width;
  const float base = from.one_in(4) ? from.log_uniform(1e-3f, 5e3f) : from.log_uniform(0.3f, 10);
  for (int k = 0; k < 3; k++) sizes[k] = pixel * base * from.log_uniform(0.05f, 1);
  if (from.one_in(8)) sizes[from.below(3)] = 0;
  if (from.one_in(30)) sizes[0] = sizes[1] = sizes[2] = 0;
}

inline float threshold(Source& from) {
  switch (from.below(8)) {
    case 0: return 9.4e-14f;  // neutral
    case 1: return 0.98f;
    case 2: return 0;
    default: return from.log_uniform(1e-5f, 0.9f);
  }
}

// A covariance of the sizes (n) along axes, as its upper triangle.
inline void covariance(const float axes[3][3], const float* sizes, int n, float* entry) {
  for (int a = 0; a < n; a++)
    for (int b = a; b < n; b++) {
      float sum = 0;
      for (int k = 0; k < n; k++) sum += axes[a][k] * axes[b][k] * sizes[k] * sizes[k];
      *entry++ = sum;
    }
}

inline void make_gaussians(Scene& s, Source& from) {
  fragprune_inputs& in = s.in;
  const size_t n = s.count();
  float turn[3][3], shift[3];
  make_camera(s, from, turn, shift);
  s.means.make(3 * n);
  const bool by_covariance = from.one_in(3);
  in.flat = !by_covariance && from.one_in(3);
  const size_t scales = in.flat ? 2 : 3;
  if (by_covariance) s.cov3d.make(6 * n);
  if (!by_covariance) s.scales.make(scales * n), s.rotations.make(4 * n);
  for (size_t i = 0; i < n; i++) {
    float sizes[3], q[4], axes[3][3];
    place(s, from, i, turn, shift, sizes);
    unit_quaternion(from, q);
    if (!by_covariance) {
      std::memcpy(&s.scales[scales * i], sizes, scales * sizeof *sizes);
      std::memcpy(&s.rotations[4 * i], q, sizeof q);
      continue;
    }
    rotation_matrix(q, axes);
    covariance(axes, sizes, 3, &s.cov3d[6 * i]);
  }
  in.sh_degree = from.below(4);
  const int least = (in.sh_degree + 1) * (in.sh_degree + 1);
  in.sh_coefficients = least + (from.one_in(2) ? 0 : from.below(4));
  if (from.one_in(3))
    fill(s.colors, 3 * n, from, -0.2f, 1.3f);
  else
    fill(s.sh, 3 * n * in.sh_coefficients, from, -1, 1);
}

// The same on the image: no camera, tiles in the grid, beside it, reversed.
inline void make_footprints(Scene& s, Source& from) {
  const size_t n = s.count();
  s.means2d.make(2 * n), s.conics.make(3 * n), s.tiles.make(4 * n);
  fill(s.depths, n, from, -0.3f, 8);
  fill(s.colors, 3 * n, from, -0.2f, 1.3f);
  for (size_t i = 0; i < n; i++) {
    s.means2d[2 * i] = from.uniform(-0.2f, 1.2f) * s.in.width;
    s.means2d[2 * i + 1] = from.uniform(-0.2f, 1.2f) * s.in.height;
    const float angle = from.uniform(0, 3), size[2] = {1 / from.log_uniform(0.3f, 20),
                                                       1 / from.log_uniform(0.3f, 20)};
    const float axes[3][3] = {{std::cos(angle), -std::sin(angle)},
                              {std::sin(angle), std::cos(angle)}};
    covariance(axes, size, 2, &s.conics[3 * i]);
    const int size_of_grid[2] = {s.in.width / FRAGPRUNE_TILE + 1, s.in.height / FRAGPRUNE_TILE + 1};
    for (int k = 0; k < 2; k++) {
      s.tiles[4 * i + k] = from.one_in(2) ? 0 : from.below(size_of_grid[k] + 2) - 1;
      s.tiles[4 * i + 2 + k] = from.one_in(2) ? size_of_grid[k] : from.below(size_of_grid[k] + 2);
    }
  }
}

inline Scene make_scene(Source& from, Limits limits) {
  Scene s;
  fragprune_inputs& in = s.in;
  in.size = sizeof in;
  in.threads = 1 + from.below(from.one_in(8) ? 18 : 4);
  in.width = from.one_in(5) ? 1 : 1 + from.below(limits.pixels);
  in.height = from.one_in(5) ? 16 : 1 + from.below(limits.pixels);
  const bool strip = from.one_in(80);  // as long as an image may be
  if (strip) in.width = (1 << 16) - from.below(20), in.height = 1 + from.below(3);
  if (strip && from.one_in(2)) std::swap(in.width, in.height);
  in.scale_modifier = from.one_in(3) ? from.uniform(0.1f, 2) : 1;
  in.dilation = from.one_in(4) ? from.uniform(0, 0.5f) : 0.3f;
  in.compensation = from.below(3);
  in.near = from.one_in(3) ? from.uniform(0, 2) : 0.2f;
  in.alpha_max = from.one_in(3) ? from.uniform(0.1f, 1) : 0.99f;
  in.soft = from.one_in(3);
  in.stop = from.one_in(3) ? from.log_uniform(1e-4f, 1) : 0;
  if (in.stop > 0) in.alpha_max = std::min(in.alpha_max, (float)FRAGPRUNE_STOPPED_ALPHA_MAX);
  in.cap_gradient = from.below(2);
  in.absolute_gradient = from.below(2);
  in.widen = from.below(2);
  const int few = from.below(4);  // 0, 1, 2 or many
  in.count = few < 3 && from.one_in(3) ? few : from.below(limits.gaussians + 1);
  if (strip) in.count %= 8;
  const size_t n = s.count();

  fill(s.background, 3, from, 0, 1);
  fill(s.opacities, n, from, 0.002f, 1);
  if (from.one_in(4))
    make_footprints(s, from);
  else
    make_gaussians(s, from);
  in.feature_count = from.one_in(2) || in.flat ? 0 : 1 + from.below(FRAGPRUNE_FEATURES_MAX);
  if (in.feature_count) fill(s.features, n * in.feature_count, from, -1, 2);
  if (from.one_in(3) && !in.flat) fill(s.offsets, 2 * s.pixels(), from, -0.5f, 0.5f);
  if (in.flat) in.compensation = FRAGPRUNE_NO_COMPENSATION, in.absolute_gradient = in.soft = 0;
  if (!from.one_in(3)) {
    s.thresholds.make(n);
    for (size_t i = 0; i < n; i++) s.thresholds[i] = threshold(from);
  }
  s.point();
  return s;
}

// Puts numbers that nobody should pass in here and there: into Gaussians, and rarely the camera.
inline void poison(Scene& s, Source& from) {
  s.tame = false;
  Floats* arrays[] = {&s.means,  &s.opacities, &s.scales,     &s.rotations, &s.cov3d,  &s.sh,
                      &s.colors, &s.features,  &s.thresholds, &s.means2d,   &s.conics, &s.depths};
  for (Floats* array : arrays)
    for (int k = from.below(4); array->size() && k > 0; k--)
      (*array)[from.next() % array->size()] = from.poison();
  if (!from.one_in(3)) return;
  Floats* camera[] = {&s.viewmatrix, &s.projmatrix, &s.campos, &s.background};
  Floats& array = *camera[from.below(4)];
  if (array.size()) array[from.next() % array.size()] = from.poison();
  float* options[] = {&s.in.tan_fov_x, &s.in.tan_fov_y, &s.in.scale_modifier, &s.in.dilation};
  if (from.one_in(2)) *options[from.below(4)] = from.poison();
}

struct Picture {
  fragprune_outputs out{};
  Floats image, invdepth, alpha, features, weights, surface;
  Integers radii, fragments, per_gaussian, wins, winners;
};

// Of kinds that Picture may lack, in bits.
constexpr int kOptional = 1 << 9;

// Outputs that are optional are there or not by the bits of `absent`.
inline Picture make_picture(const Scene& s, int absent) {
  Picture p;
  p.out.size = sizeof p.out;
  p.image.make(3 * s.pixels()), p.radii.make(s.count());
  if (!(absent & 1)) p.invdepth.make(s.pixels());
  if (!(absent & 2)) p.alpha.make(s.pixels());
  if (!(absent & 4)) p.fragments.make(s.pixels());
  if (!(absent & 8)) p.per_gaussian.make(s.count());
  if (!(absent & 16) && s.in.feature_count) p.features.make(s.pixels() * s.in.feature_count);
  if (!(absent & 32)) p.weights.make(s.count());
  if (!(absent & 64)) p.wins.make(s.count());
  if (!(absent & 128)) p.winners.make(s.pixels());
  if (!(absent & 256) && s.in.flat) p.surface.make(6 * s.pixels());
  p.out.surface = p.surface.get();
  p.out.features = p.features.get(), p.out.weights_per_gaussian = p.weights.get();
  p.out.wins_per_gaussian = p.wins.get(), p.out.winners = p.winners.get();
  p.out.image = p.image.get(), p.out.radii = p.radii.get();
  p.out.invdepth = p.invdepth.get(), p.out.alpha = p.alpha.get();
  p.out.fragments = p.fragments.get(), p.out.fragments_per_gaussian = p.per_gaussian.get();
  return p;
}

inline void check(const Scene& s, const Picture& p) {
  CALLS_CHECK(p.image.written() && p.invdepth.written() && p.alpha.written());
  CALLS_CHECK(p.radii.written() && p.fragments.written() && p.per_gaussian.written());
  CALLS_CHECK(p.features.written() && p.weights.written() && p.surface.written());
  CALLS_CHECK(p.wins.written() && p.winners.written());
  CALLS_CHECK(p.out.drawn >= 0 && p.out.evaluated >= p.out.drawn);
  for (const Integers* counts : {&p.fragments, &p.per_gaussian})
    if (counts->get()) {
      int64_t sum = 0;
      for (size_t i = 0; i < counts->size(); i++) sum += (*counts)[i];
      CALLS_CHECK(sum == p.out.drawn);
    }
  for (size_t i = 0; i < p.radii.size(); i++) CALLS_CHECK(p.radii[i] >= 0);
  // A broken Gaussian is left out: whatever is passed in, only the background can break a picture.
  if (s.background.finite()) CALLS_CHECK(p.image.finite());
  CALLS_CHECK(p.invdepth.finite() && p.features.finite() && p.weights.finite());
  int64_t won = 0, wins = 0;
  for (size_t i = 0; i < p.winners.size(); i++) {
    CALLS_CHECK(p.winners[i] >= -1 && p.winners[i] < s.in.count);
    won += p.winners[i] >= 0;
  }
  for (size_t i = 0; i < p.wins.size(); i++) wins += p.wins[i];
  if (p.wins.get() && p.winners.get()) CALLS_CHECK(wins == won);
  for (size_t i = 0; i < p.weights.size(); i++) CALLS_CHECK(p.weights[i] >= 0);
  const float least = s.in.stop > 0 ? s.in.stop * (1 - s.in.alpha_max)
                                    : (float)FRAGPRUNE_TRANSMITTANCE_MIN;  // light left
  for (size_t i = 0; i < p.alpha.size(); i++)
    CALLS_CHECK(p.alpha[i] >= 0 && p.alpha[i] <= 1 - 0.99f * least);
}

struct Loss {
  fragprune_output_grads grads{};
  Floats image, invdepth, alpha, features, surface;
};

inline Loss make_loss(const Scene& s, Source& from, int absent) {
  Loss loss;
  loss.grads.size = sizeof loss.grads;
  loss.grads.fragments_per_pixel = from.one_in(2) ? 0 : from.uniform(-2, 2);
  if (!(absent & 1)) fill(loss.image, 3 * s.pixels(), from, -1, 1);
  if (!(absent & 2)) fill(loss.invdepth, s.pixels(), from, -1, 1);
  if (!(absent & 4)) fill(loss.alpha, s.pixels(), from, -1, 1);
  if (!(absent & 8)) fill(loss.features, s.pixels() * s.in.feature_count, from, -1, 1);
  if (!(absent & 16) && s.in.flat) fill(loss.surface, 6 * s.pixels(), from, -1, 1);
  loss.grads.surface = loss.surface.get();
  loss.grads.features = loss.features.get();
  loss.grads.image = loss.image.get();
  loss.grads.invdepth = loss.invdepth.get();
  loss.grads.alpha = loss.alpha.get();
  return loss;
}

struct Gradients {
  fragprune_input_grads to{};
  Floats means, hook, opacities, scales, rotations, cov3d, sh, colors, features, thresholds;
  Floats means2d, conics, depths, background;

  std::vector<const Floats*> all() const {
    return {&means,  &hook,     &opacities,  &scales,  &rotations, &cov3d,  &sh,
            &colors, &features, &thresholds, &means2d, &conics,    &depths, &background};
  }
};
constexpr int kGradients = 14;

inline Gradients make_gradients(const Scene& s, int absent) {
  Gradients g;
  const size_t n = s.count();
  const auto want = [&](int bit, bool given, Floats& array, size_t size) {
    if (given && !(absent >> bit & 1)) array.make(size);
    return array.get();
  };
  g.to.size = sizeof g.to;
  g.to.means = want(0, s.means.get(), g.means, 3 * n);
  g.to.hook = want(1, true, g.hook, 3 * n);
  g.to.opacities = want(2, true, g.opacities, n);
  g.to.scales = want(3, s.scales.get(), g.scales, (s.in.flat ? 2 : 3) * n);
  g.to.rotations = want(4, s.rotations.get(), g.rotations, 4 * n);
  g.to.cov3d = want(5, s.cov3d.get(), g.cov3d, 6 * n);
  g.to.sh = want(6, s.sh.get(), g.sh, 3 * n * s.in.sh_coefficients);
  g.to.colors = want(7, s.colors.get(), g.colors, 3 * n);
  g.to.thresholds = want(8, s.thresholds.get() && s.in.widen, g.thresholds, n);
  g.to.background = want(9, true, g.background, 3);
  g.to.features = want(10, s.features.get(), g.features, n * s.in.feature_count);
  g.to.means2d = want(11, s.means2d.get(), g.means2d, 2 * n);
  g.to.conics = want(12, s.conics.get(), g.conics, 3 * n);
  g.to.depths = want(13, s.depths.get(), g.depths, n);
  return g;
}

// Memory that calls hand on: none, one for all calls of the process, or one of this call's own that
// is gone before the backward pass.
using Workspace = std::unique_ptr<fragprune_workspace, void (*)(fragprune_workspace*)>;

inline Workspace new_workspace() { return {fragprune_workspace_new(), fragprune_workspace_free}; }

inline fragprune_workspace* shared_workspace() {
  static const Workspace workspace = new_workspace();
  return workspace.get();
}

// Takes an array for a caller, uses all of it, and gives it back.
inline void borrow(fragprune_workspace* workspace, Source& from) {
  const uint64_t bytes = from.one_in(9) ? 0 : from.next() % 70'000;
  void* memory = fragprune_workspace_take(workspace, bytes);
  CALLS_CHECK(memory && reinterpret_cast<uintptr_t>(memory) % 64 == 0);
  std::memset(memory, 0x55, bytes);
  fragprune_workspace_give(workspace, memory, bytes);
}

// What a run of calls went through; a test sees that the dice left nothing out.
struct Tally {
  int64_t calls = 0, drew = 0, poisoned = 0, backward = 0, refused = 0, empty = 0;
  int64_t cut = 0, present = 0;  // of slices.h
  int64_t losses = 0;            // of images.h

  void print() const {
    std::printf("calls %lld drew %lld poisoned %lld backward %lld refused %lld empty %lld ",
                (long long)calls, (long long)drew, (long long)poisoned, (long long)backward,
                (long long)refused, (long long)empty);
    std::printf("cut %lld present %lld losses %lld\n", (long long)cut, (long long)present,
                (long long)losses);
  }
  void operator+=(const Tally& t) {
    calls += t.calls, drew += t.drew, poisoned += t.poisoned, backward += t.backward;
    refused += t.refused, empty += t.empty, cut += t.cut, present += t.present;
    losses += t.losses;
  }
};

// Says that one of the arrays holds more or less than it does.
inline void misstate(std::initializer_list<int64_t*> held, Source& from) {
  int64_t& one = **(held.begin() + from.next() % held.size());
  one += from.one_in(2) ? -1 - from.below(9) : int64_t{1} << from.below(62);
}

inline void misstate(fragprune_lengths& held, Source& from) {
  misstate({&held.viewmatrix, &held.projmatrix, &held.campos,         &held.background,
            &held.means,      &held.opacities,  &held.scales,         &held.rotations,
            &held.cov3d,      &held.sh,         &held.colors,         &held.features,
            &held.thresholds, &held.means2d,    &held.sample_offsets, &held.conics,
            &held.depths,     &held.tiles},
           from);
}

// Breaks the contract in one way; the call must be refused before anything is read or written.
inline void try_illegal(const Scene& s, Source& from, Tally& tally) {
  Picture p = make_picture(s, 0);
  fragprune_inputs in = s.in;
  switch (from.below(24)) {
    case 0: in.size--; break;
    case 1: p.out.size = 0; break;
    case 2: in.width = -from.below(3); break;
    case 3: in.height = (1 << 16) + 1 + from.below(1 << 20); break;
    case 4: in.count = -1 - from.below(3); break;
    case 5: in.count = int64_t{INT32_MAX} + 1 + from.below(9); break;
    case 6: in.background = nullptr; break;
    case 7: p.out.image = nullptr; break;
    case 8: in.near = -0.1f; break;
    case 9: in.near = std::nanf(""); break;
    case 10: in.alpha_max = 1.01f; break;
    case 11: in.alpha_max = std::nanf(""); break;
    case 12: in.alpha_max = 0; break;
    case 13: in.compensation = from.one_in(2) ? 3 : -1; break;
    case 14: in.feature_count = from.one_in(2) ? FRAGPRUNE_FEATURES_MAX + 1 : -1; break;
    case 15: in.threads = from.one_in(2) ? -from.below(3) : 1025 + from.below(1 << 30); break;
    case 16: in.sh_coefficients = from.one_in(2) ? -1 - from.below(3) : 1025; break;
    case 17: case 18: case 19: misstate(in.lengths, from); break;
    default:
      if (in.means2d)
        in.means = in.means2d;
      else if (from.one_in(2))
        in.campos = nullptr;
      else
        in.viewmatrix = nullptr;
  }
  fragprune_error error;
  fragprune_state* state = nullptr;
  CALLS_CHECK(fragprune_forward(&in, &p.out, &state, &error) == FRAGPRUNE_BAD_INPUT);
  CALLS_CHECK(!state && error.message[0]);
  if (s.count()) {
    in = s.in;
    fragprune_outputs out = make_picture(s, 0).out;
    float wild[2] = {0.f, from.one_in(2) ? 2e6f : std::nanf("")};
    const int choice = from.below(9);
    if (choice == 0) in.opacities = nullptr;
    if (choice == 1) in.feature_count = 0, in.features = in.opacities;
    if (choice == 2) in.feature_count = 1, in.features = nullptr, out.features = nullptr;
    if (choice == 3) in.width = in.height = 1, in.sample_offsets = wild;
    if (choice == 3) in.lengths.sample_offsets = 2;
    Floats fewer;  // in truth, so that reading on is seen
    fewer.make(s.count() - 1);
    if (choice == 8) in.thresholds = fewer.get(), in.lengths.thresholds = fewer.length();
    if (in.means2d) {
      if (choice == 4) in.conics = nullptr;
      if (choice == 5) in.depths = nullptr;
      if (choice == 6) in.tiles = nullptr;
      if (choice == 7) in.colors = nullptr;
    } else {
      if (choice == 4) in.means = nullptr;
      if (choice == 5) in.scales = in.cov3d = nullptr;
      if (choice == 6) in.scales = in.rotations = in.cov3d = in.means;
      if (choice == 7 && from.one_in(2)) in.sh = in.colors = nullptr;
      if (choice == 7 && !in.colors) in.sh = in.means, in.sh_coefficients = 1025;
      if (choice == 7 && in.colors) in.sh = in.colors;
    }
    CALLS_CHECK(fragprune_forward(&in, &out, nullptr, nullptr) == FRAGPRUNE_BAD_INPUT);
  }
  tally.refused++;
}

// Backward must refuse what forward did not prepare.
inline void try_illegal_backward(const Scene& s, const fragprune_state* state, Tally& tally) {
  Source none(uint64_t{0});
  const Loss loss = make_loss(s, none, 0);
  Gradients g = make_gradients(s, ~0);
  float nowhere;
  if (!(s.thresholds.get() && s.in.widen)) {
    g.to.thresholds = &nowhere;
  } else if (s.cov3d.get()) {
    g.to.rotations = &nowhere;
  } else {
    g.to.cov3d = &nowhere;
  }
  fragprune_error error;
  CALLS_CHECK(fragprune_backward(state, &loss.grads, &g.to, 1, &error) == FRAGPRUNE_BAD_INPUT);
  CALLS_CHECK(error.message[0]);
  g = make_gradients(s, ~0);
  for (const int32_t threads : {-1, 0, 1025})
    CALLS_CHECK(fragprune_backward(state, &loss.grads, &g.to, threads, &error) ==
                FRAGPRUNE_BAD_INPUT);
  g.to.size++;
  CALLS_CHECK(fragprune_backward(state, &loss.grads, &g.to, 1, nullptr) == FRAGPRUNE_BAD_INPUT);
  tally.refused++;
}

inline Gradients differentiate(const Scene& s, const fragprune_state* state, const Loss& loss,
                               int absent, int threads) {
  Gradients g = make_gradients(s, absent);
  CALLS_CHECK(fragprune_backward(state, &loss.grads, &g.to, threads, nullptr) == FRAGPRUNE_OK);
  for (const Floats* array : g.all()) CALLS_CHECK(array->written());
  return g;
}

// Draws a scene, and mostly differentiates it.
inline void run(Scene s, Source& from, Tally& tally) {
  tally.calls++;
  if (from.one_in(12)) try_illegal(s, from, tally);
  tally.poisoned += !s.tame;
  tally.empty += s.count() == 0;

  const bool keep = !from.one_in(4);
  Workspace own(nullptr, fragprune_workspace_free);
  if (from.one_in(3)) own = new_workspace();
  s.in.workspace = own ? own.get() : from.one_in(2) ? shared_workspace() : nullptr;
  if (s.in.workspace && from.one_in(4)) borrow(s.in.workspace, from);
  Picture p = make_picture(s, from.one_in(3) ? from.below(kOptional) : from.one_in(2) ? 0 : 0xf8);
  fragprune_state* state = nullptr;
  fragprune_error error;
  const int status = fragprune_forward(&s.in, &p.out, keep ? &state : nullptr, &error);
  CALLS_CHECK(status == FRAGPRUNE_OK && !error.message[0] && !state == !keep);
  check(s, p);
  tally.drew += p.out.drawn > 0;
  if (from.one_in(3)) {  // the number of threads changes nothing, nor do outputs not asked for
    s.in.threads = 1 + s.in.threads % 3;
    Picture again = make_picture(s, from.below(kOptional));
    CALLS_CHECK(fragprune_forward(&s.in, &again.out, nullptr, nullptr) == FRAGPRUNE_OK);
    CALLS_CHECK(again.image.same_bits(p.image) && again.out.drawn == p.out.drawn);
    if (again.weights.get() && p.weights.get()) CALLS_CHECK(again.weights.same_bits(p.weights));
    if (again.winners.get() && p.winners.get()) CALLS_CHECK(again.winners.same_bits(p.winners));
    if (again.features.get() && p.features.get()) CALLS_CHECK(again.features.same_bits(p.features));
    if (again.surface.get() && p.surface.get()) CALLS_CHECK(again.surface.same_bits(p.surface));
  }
  s.in.workspace = nullptr;
  own.reset();
  if (!keep) return;
  const std::unique_ptr<fragprune_state, void (*)(fragprune_state*)> owner(state, fragprune_free);
  if (from.one_in(8) && s.count()) try_illegal_backward(s, state, tally);
  const Loss loss = make_loss(s, from, from.below(32));
  const int absent = from.one_in(2) ? 0 : from.below(1 << kGradients);
  const Gradients g = differentiate(s, state, loss, absent, 1 + from.below(4));
  if (s.tame)
    for (const Floats* array : g.all()) CALLS_CHECK(array->finite());
  tally.backward++;
  if (!from.one_in(3)) return;
  const Gradients again = differentiate(s, state, loss, absent, 1 + from.below(4));
  for (size_t k = 0; k < g.all().size(); k++) CALLS_CHECK(g.all()[k]->same_bits(*again.all()[k]));
}

// One random call, its inputs sensible or poisoned.
inline void run(Source& from, Limits limits, Tally& tally) {
  Scene s = make_scene(from, limits);
  if (from.one_in(2)) poison(s, from);
  run(std::move(s), from, tally);
}

}  // namespace calls
