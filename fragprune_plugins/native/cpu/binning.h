// From Gaussians to lists of Gaussians per tile, front to back: one depth sort of the Gaussians,
// then a stable distribution to the tiles that their ellipses reach.
#pragma once

#include <algorithm>
#include <cstring>
#include <limits>
#include <memory>
#include <stdexcept>
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

// The ellipse {q <= reach} by rows: where it begins and ends in x for an interval of y.
struct Ellipse {
  float reach;            // squared radius, a little more than the cutoff
  float half_height;      // pixels
  float rightmost;        // dy at which x is largest; -rightmost for the smallest
  float var_along;        // variance of x given y, pixels^2
  float inv_down;         // 1 / variance of y
};

struct Splat {
  Brush brush;
  Ellipse ellipse;
  uint16_t tile_x0, tile_x1, tile_y0, tile_y1;  // the host's rectangle, half open
  uint32_t id;                                  // row of the inputs
};

// Spans only preselect, the fragment test decides. This much is added to every reach so that their
// rounding never loses a fragment: relative, and absolute for splats of a pixel or less.
constexpr float kReachMargin = 1.0002f, kReachFloor = 1e-3f;
constexpr float kSpanMargin = 0.01f;  // pixels

inline Ellipse ellipse_of(const Projection& p, float list_cut) {
  Ellipse e;
  e.reach = -list_cut * static_cast<float>(2 / 1.44269504088896341) * kReachMargin + kReachFloor;
  e.half_height = std::sqrt(e.reach * p.var_y) + kSpanMargin;
  e.rightmost = p.cov * std::sqrt(e.reach / p.var_x);
  e.var_along = p.det / p.var_y;
  e.inv_down = 1 / p.var_y;
  return e;
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
// slot: the entries of one splat have consecutive slots, so that what the tiles find out about it
// can be gathered in a fixed order without atomics.
struct TileLists {
  std::vector<uint32_t> first;   // per tile, one more at the end
  Buffer<uint32_t> splat;        // per entry
  Buffer<uint32_t> slot;         // per entry; empty unless asked for
  Buffer<uint32_t> slot_begin;   // per splat
  Buffer<uint32_t> slot_count;   // per splat
};

// Calls emit(tile_y, x0, x1), x1 included, for the tiles of each row that the ellipse reaches.
template <class Emit>
inline void reached_tiles(const Camera& c, const Splat& s, Emit emit) {
  const Brush& brush = s.brush;
  const Ellipse& e = s.ellipse;
  const float top = std::max(std::ceil(brush.y - e.half_height), s.tile_y0 * float(kTile));
  const float bottom = std::min({std::floor(brush.y + e.half_height), c.height - 1,
                                 s.tile_y1 * float(kTile) - 1});
  if (!(top <= bottom)) return;
  const float left = s.tile_x0 * float(kTile);
  const float right = std::min(c.width, s.tile_x1 * float(kTile)) - 1;
  const int last = static_cast<int>(bottom) / kTile;
  for (int row = static_cast<int>(top) / kTile; row <= last; row++) {
    const float low = std::max(float(row * kTile), top) - brush.y;
    const float high = std::min(float(row * kTile + kTile - 1), bottom) - brush.y;
    const float at_right = clamp(e.rightmost, low, high), at_left = clamp(-e.rightmost, low, high);
    const float in_right = e.var_along * (e.reach - at_right * at_right * e.inv_down);
    const float in_left = e.var_along * (e.reach - at_left * at_left * e.inv_down);
    const float x0 = std::max(left, std::ceil(brush.x + brush.slope * at_left -
                                              std::sqrt(std::max(in_left, 0.f)) - kSpanMargin));
    const float x1 = std::min(right, std::floor(brush.x + brush.slope * at_right +
                                                std::sqrt(std::max(in_right, 0.f)) + kSpanMargin));
    if (x0 <= x1) emit(row, static_cast<int>(x0) / kTile, static_cast<int>(x1) / kTile);
  }
}

inline TileLists distribute(Team& team, const Camera& c, const Splat* splats,
                            const Buffer<uint32_t>& order, bool with_slots) {
  struct Run {
    uint32_t splat, row;
    uint16_t x0, x1;
  };
  const size_t n = order.size();
  const size_t tiles = static_cast<size_t>(c.tiles_x) * c.tiles_y;
  const size_t parts = n < 1u << 12 ? 1 : static_cast<size_t>(std::min(team.size(), 16));
  const size_t grain = n / parts + 1;
  std::vector<std::vector<Run>> runs(parts);
  std::vector<uint64_t> part_total(parts, 0);
  Buffer<uint32_t> cursor(parts * tiles);
  TileLists lists;
  if (with_slots) {
    lists.slot_begin = Buffer<uint32_t>(n);
    lists.slot_count = Buffer<uint32_t>(n);
  }
  team.each(parts, 1, [&](size_t part, size_t) {
    uint32_t* mine = &cursor[part * tiles];
    std::memset(mine, 0, tiles * sizeof *mine);
    std::vector<Run>& out = runs[part];
    out.reserve(3 * grain);
    uint64_t total = 0;
    for (size_t i = part * grain; i < std::min(n, (part + 1) * grain); i++) {
      const uint32_t k = order[i];
      const uint64_t before = total;
      reached_tiles(c, splats[k], [&](int row, int x0, int x1) {
        out.push_back({k, static_cast<uint32_t>(row), static_cast<uint16_t>(x0),
                       static_cast<uint16_t>(x1)});
        for (int x = x0; x <= x1; x++) mine[static_cast<size_t>(row) * c.tiles_x + x]++;
        total += x1 - x0 + 1;
      });
      if (with_slots) {
        lists.slot_begin[k] = static_cast<uint32_t>(before);
        lists.slot_count[k] = static_cast<uint32_t>(total - before);
      }
    }
    part_total[part] = total;
  });
  uint64_t total = 0;
  for (uint64_t& t : part_total) {
    const uint64_t before = total;
    total += t;
    t = before;
  }
  if (total > std::numeric_limits<uint32_t>::max()) throw std::length_error("tile lists");
  lists.first.resize(tiles + 1);
  uint32_t position = 0;
  for (size_t t = 0; t < tiles; t++) {
    lists.first[t] = position;
    for (size_t part = 0; part < parts; part++) {
      const uint32_t here = cursor[part * tiles + t];
      cursor[part * tiles + t] = position;
      position += here;
    }
  }
  lists.first[tiles] = position;
  lists.splat = Buffer<uint32_t>(total);
  if (with_slots) lists.slot = Buffer<uint32_t>(total);
  team.each(parts, 1, [&](size_t part, size_t) {
    uint32_t* mine = &cursor[part * tiles];
    uint32_t slot = static_cast<uint32_t>(part_total[part]);
    for (const Run& run : runs[part])
      for (int x = run.x0; x <= run.x1; x++) {
        const uint32_t at = mine[static_cast<size_t>(run.row) * c.tiles_x + x]++;
        lists.splat[at] = run.splat;
        if (with_slots) lists.slot[at] = slot++;
      }
    if (with_slots)
      for (size_t i = part * grain; i < std::min(n, (part + 1) * grain); i++)
        lists.slot_begin[order[i]] += static_cast<uint32_t>(part_total[part]);
  });
  return lists;
}

}  // namespace fp
