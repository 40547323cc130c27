// What kernels are handed: one struct by value, filled in by engines/cuda.py, which keeps the same
// fields in the same order (FP_*_SIZE, which it defines, catches the rest).
#pragma once

#include "numbers.cuh"

#include "../cpu/ellipse.h"

#ifndef FP_FEATURES  // channels blended beside colour, 0 to 8
#define FP_FEATURES 0
#endif

namespace fp {

constexpr int kThreads = 256;  // of every block of every kernel
constexpr int kWarps = kThreads / 32;
constexpr int kDigits = 256;     // buckets of one pass of sorting
constexpr int kSortItems = 16;   // of each thread
constexpr int kPasses = 4;       // at most, 8 bits each
constexpr int kBrush = 12;       // floats of a Brush in memory

// Zero when a frame begins.
struct Counters {
  uint64_t visible;    // Gaussians that reach a tile
  uint64_t entries;    // of all tiles' lists; more than the capacity: the frame is void
  uint64_t drawn;      // fragments
  uint64_t evaluated;  // lanes spent on (Gaussian, pixel) pairs
  uint32_t tickets[2 + 2 * kPasses];  // blocks that wait for others are numbered as they start
};

struct Rect {  // tiles, half open
  uint16_t x0, x1, y0, y1;
};

struct Range {  // of a tile in the list of entries
  uint32_t first, end;
};

// One forward pass. N Gaussians, E entries at most, T tiles, H x W pixels.
struct Frame {
  fragprune_inputs in;    // pointers into device memory, here as everywhere
  fragprune_outputs out;  // counts and scores zero when a frame begins
  const float* spread;    // (1) the largest of |sample_offsets|; or NULL: none

  // sizes
  uint32_t capacity;  // E
  int32_t tiles_x, tiles_y;
  int32_t tile_passes;

  // zero when a frame begins
  Counters* counters;
  uint64_t* project_words;    // per block of fp_project
  uint64_t* emit_words;       // per block of fp_emit
  uint32_t* depth_histogram;  // (kPasses, kDigits)
  uint32_t* tile_histogram;   // (kPasses, kDigits)
  Range* ranges;              // (T)

  // filled in by one kernel, read by others
  float* brushes;           // (N, kBrush)
  Rect* rects;              // (N)
  uint32_t* tiles;          // (N) tiles reached
  uint32_t* first_slot;     // (N) of those that reach a tile; or NULL
  uint32_t* depth_keys;     // (N) bits of view depths, of those that reach a tile
  uint32_t* depth_ids;      // (N) their rows; sorted front to back later on
  uint32_t* entry_keys;     // (E) tiles
  uint32_t* entry_values;   // (E) rows, or slots where slots are kept; sorted by tile later on
  uint32_t* owners;         // (E) rows by slot; or NULL: no slots
  uint8_t* reached;         // (E) the sub-tiles that it reaches; or NULL, as transmittance
  float* transmittance;     // (H, W) final; or NULL: no backward pass will come
  int32_t* stop;            // (H, W) fragments at this place of the list or later are not alive
  uint64_t* weights;        // (N) sums of alpha T in units of 2^-32, zero when a frame begins
};

// One pass of the stable radix sort, by 8 bits of the keys.
struct Sort {
  const uint64_t* count;
  uint32_t capacity;
  int32_t shift;
  const uint32_t* histogram;  // (kDigits)
  uint32_t* words;            // (blocks, kDigits), zero
  uint32_t* ticket;           // zero
  const uint32_t *keys, *values;
  uint32_t *sorted_keys, *sorted_values;
};

#ifdef FP_FRAME_SIZE
static_assert(sizeof(Frame) == FP_FRAME_SIZE, "engines/cuda.py has other fields in Frame");
static_assert(sizeof(Sort) == FP_SORT_SIZE, "engines/cuda.py has other fields in Sort");
#endif

__device__ inline Given<float> load_given(const fragprune_inputs& in, size_t i) {
  Given<float> g;
  g.mean = read3(in.means + 3 * i);
  g.factored = in.cov3d == nullptr;
  if (g.factored) {
    g.scale = read3(in.scales + 3 * i);
    for (int k = 0; k < 4; k++) g.rotation[k] = in.rotations[4 * i + k];
  } else {
    for (int k = 0; k < 6; k++) g.cov3d[k] = in.cov3d[6 * i + k];
  }
  return g;
}

__device__ inline void write3(float* to, size_t i, const Vec3& v) {
  if (to) to[3 * i] = v.x, to[3 * i + 1] = v.y, to[3 * i + 2] = v.z;
}

__device__ inline Camera<float> camera_of(const Frame& f) {
  return unpack_camera(f.in, f.spread ? *f.spread : 0.f);
}

__device__ inline void store_brush(float* brushes, size_t row, const Brush<float>& b) {
  float4* to = reinterpret_cast<float4*>(brushes + kBrush * row);
  to[0] = make_float4(b.x, b.y, b.scale, b.skew);
  to[1] = make_float4(b.down, b.log_opacity, b.cut, b.list_cut);
  to[2] = make_float4(b.r, b.g, b.b, b.inv_z);
}

__device__ inline Brush<float> load_brush(const float* brushes, size_t row) {
  const float4* from = reinterpret_cast<const float4*>(brushes + kBrush * row);
  const float4 p = from[0], q = from[1], r = from[2];
  return {p.x, p.y, p.z, p.w, q.x, q.y, q.z, q.w, r.x, r.y, r.z, r.w};
}

// Whose entry it is, from entry_values.
__device__ inline uint32_t row_of(const Frame& f, uint32_t entry) {
  return f.owners ? f.owners[entry] : entry;
}

}  // namespace fp

// Kernels are named, not mangled, and take one struct. A multiprocessor shall have room for so many
// blocks of them at least, as far as registers go.
#ifndef FP_KERNEL
#define FP_KERNEL(name, Arguments, blocks) \
  extern "C" __global__ void __launch_bounds__(fp::kThreads, blocks) name(const Arguments f)
#endif
