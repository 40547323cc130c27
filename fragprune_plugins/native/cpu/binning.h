// From Gaussians to lists of Gaussians per tile, front to back: one depth sort of the Gaussians,
// then a stable distribution to the tiles that their ellipses reach.
#pragma once

#include <algorithm>
#include <cstring>
#include <memory>
#include <utility>
#include <vector>

#include "gaussian.h"
#include "threads.h"

namespace fp {

constexpr int kTile = FRAGPRUNE_TILE;

// An array that is not filled on allocation.
template <class T>
class Buffer {
 public:
  Buffer() = default;
  explicit Buffer(size_t n) : data_(new T[n]), size_(n) {}
  T& operator[](size_t i) { return data_[i]; }
  const T& operator[](size_t i) const { return data_[i]; }
  T* data() { return data_.get(); }
  const T* data() const { return data_.get(); }
  size_t size() const { return size_; }

 private:
  std::unique_ptr<T[]> data_;
  size_t size_ = 0;
};

// One cache line, for blending reads splats in no order at all.
struct alignas(64) Splat {
  Brush brush;
  uint32_t id;  // row of the inputs
};

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
};

// `power` is how far the exponent may fall from its peak; see Brush for the others.
template <class V>
inline Ellipse<V> ellipse_of(V scale, V skew, V down, V power) {
  const V unit = broadcast<V>(0.5f * kLog2E), slope = -skew / scale;
  const V var_down = unit / (down * down), cov = slope * var_down;
  Ellipse<V> e;
  e.slope = slope;
  e.reach = power * broadcast<V>(2 / kLog2E * kReachMargin) + broadcast<V>(kReachFloor);
  e.var_along = unit / (scale * scale);
  e.inv_down = down * down / unit;
  e.half_height = sqrt(e.reach * var_down) + broadcast<V>(kSpanMargin);
  e.rightmost = cov * sqrt(e.reach / (e.var_along + slope * cov));
  return e;
}

// Where an ellipse's span ends, right (side 1) or left (side -1) of its mean, over rows low..high.
template <class V>
inline V span_end(const Ellipse<V>& e, V low, V high, V side) {
  const V at = min(max(e.rightmost * side, low), high);
  const V inside = e.var_along * (e.reach - at * at * e.inv_down);
  return e.slope * at + side * (sqrt(max(inside, broadcast<V>(0.f))) + broadcast<V>(kSpanMargin));
}

// Tiles x0..x1, both included, of one row of tiles.
struct Run {
  uint16_t row, x0, x1;
};

// The runs of tiles that a splat's ellipse reaches within the host's rectangle.
template <class Emit>
inline void reached_tiles(const Camera& c, const Projection& p, const Brush& b, Emit emit) {
  const Ellipse<float> e = ellipse_of(b.scale, b.skew, b.down, b.log_opacity - b.list_cut);
  const float tile = kTile;
  const float top = std::max(std::ceil(b.y - e.half_height), p.tile_y0 * tile);
  const float bottom =
      std::min({std::floor(b.y + e.half_height), c.height - 1, p.tile_y1 * tile - 1});
  if (!(top <= bottom)) return;
  const float left = p.tile_x0 * tile, right = std::min(c.width, p.tile_x1 * tile) - 1;
  const int last = static_cast<int>(bottom) / kTile;
  for (int row = static_cast<int>(top) / kTile; row <= last; row++) {
    const float low = std::max(row * tile, top) - b.y;
    const float high = std::min(row * tile + tile - 1, bottom) - b.y;
    const float x0 = std::max(left, std::ceil(b.x + span_end(e, low, high, -1.f)));
    const float x1 = std::min(right, std::floor(b.x + span_end(e, low, high, 1.f)));
    if (x0 <= x1)
      emit(Run{static_cast<uint16_t>(row), static_cast<uint16_t>(static_cast<int>(x0) / kTile),
               static_cast<uint16_t>(static_cast<int>(x1) / kTile)});
  }
}

// Stable radix sort of positions by the bits of positive floats.
inline Buffer<uint32_t> order_by_depth(Team& team, const Buffer<float>& depth, size_t n) {
  constexpr int bits = 11, buckets = 1 << bits;
  struct Item {
    uint32_t key, index;
  };
  Buffer<Item> a(n), b(n);
  Buffer<uint32_t> order(n);
  const size_t parts = n < 1u << 14 ? 1 : static_cast<size_t>(std::min(team.size(), 16));
  const size_t grain = n / parts + 1;
  std::vector<uint32_t> count(parts * buckets);
  for (int pass = 0; pass < 3; pass++) {
    const int shift = pass * bits;
    std::fill(count.begin(), count.end(), 0);
    team.each(n, grain, [&](size_t begin, size_t end) {
      uint32_t* mine = &count[begin / grain * buckets];
      for (size_t i = begin; i < end; i++) {
        if (pass == 0) {
          std::memcpy(&a[i].key, &depth[i], 4);
          a[i].index = static_cast<uint32_t>(i);
        }
        mine[a[i].key >> shift & (buckets - 1)]++;
      }
    });
    uint32_t total = 0;
    for (int k = 0; k < buckets; k++)
      for (size_t part = 0; part < parts; part++) {
        const uint32_t c = count[part * buckets + k];
        count[part * buckets + k] = total;
        total += c;
      }
    team.each(n, grain, [&](size_t begin, size_t end) {
      uint32_t* mine = &count[begin / grain * buckets];
      for (size_t i = begin; i < end; i++) {
        const uint32_t to = mine[a[i].key >> shift & (buckets - 1)]++;
        if (pass == 2)
          order[to] = a[i].index;
        else
          b[to] = a[i];
      }
    });
    std::swap(a, b);
  }
  return order;
}

// Tile t holds entries [first[t], first[t + 1]) of `splat`, front to back. Each entry also has a
// slot: those of splat k are slot_begin[k] to slot_begin[k + 1], so that what the tiles find out
// about it can be gathered in a fixed order, from memory in order, without atomics.
struct TileLists {
  std::vector<uint32_t> first;   // per tile, one more at the end
  Buffer<uint32_t> splat;        // per entry
  Buffer<uint32_t> slot;         // per entry; empty unless asked for
};

// What projection leaves: splats that can draw, in the order of the inputs.
struct Scene {
  Buffer<Splat> splats;
  Buffer<float> depth;         // per splat
  Buffer<uint32_t> run_begin;   // per splat, one more at the end
  Buffer<uint32_t> slot_begin;  // the same for its tiles
  Buffer<Run> runs;
};

inline TileLists distribute(Team& team, const Camera& c, const Scene& scene,
                            const Buffer<uint32_t>& order, bool with_slots) {
  const size_t n = order.size(), across = static_cast<size_t>(c.tiles_x);
  const size_t tiles = across * c.tiles_y;
  const size_t parts = n < 1u << 12 ? 1 : static_cast<size_t>(std::min(team.size(), 16));
  const size_t grain = n / parts + 1;
  const auto each_tile = [&](uint32_t splat, auto visit) {
    for (uint32_t r = scene.run_begin[splat]; r < scene.run_begin[splat + 1]; r++) {
      const Run run = scene.runs[r];
      for (size_t t = run.row * across + run.x0; t <= run.row * across + run.x1; t++) visit(t);
    }
  };
  Buffer<uint32_t> cursor(parts * tiles);
  TileLists lists;
  team.each(parts, 1, [&](size_t part, size_t) {
    uint32_t* mine = &cursor[part * tiles];
    std::memset(mine, 0, tiles * sizeof *mine);
    for (size_t i = part * grain; i < std::min(n, (part + 1) * grain); i++)
      each_tile(order[i], [&](size_t t) { mine[t]++; });
  });
  lists.first.resize(tiles + 1);
  uint32_t position = 0;
  for (size_t t = 0; t < tiles; t++) {
    lists.first[t] = position;
    for (size_t part = 0; part < parts; part++)
      position += std::exchange(cursor[part * tiles + t], position);
  }
  lists.first[tiles] = position;
  lists.splat = Buffer<uint32_t>(position);
  if (with_slots) lists.slot = Buffer<uint32_t>(position);
  team.each(parts, 1, [&](size_t part, size_t) {
    uint32_t* mine = &cursor[part * tiles];
    for (size_t i = part * grain; i < std::min(n, (part + 1) * grain); i++) {
      const uint32_t k = order[i];
      uint32_t slot = scene.slot_begin[k];
      if (with_slots)
        each_tile(k, [&](size_t t) {
          lists.splat[mine[t]] = k;
          lists.slot[mine[t]++] = slot++;
        });
      else
        each_tile(k, [&](size_t t) { lists.splat[mine[t]++] = k; });
    }
  });
  return lists;
}

}  // namespace fp
