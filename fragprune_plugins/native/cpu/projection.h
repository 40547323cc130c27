// From Gaussians to splats: all that blending and binning need of those that can draw.
//
// Gaussians go kLanes at a time through the mathematics of gaussian.h. Those that are left are
// packed per piece of kPiece rows; colours come last, for them alone.
#pragma once

#include <algorithm>
#include <array>
#include <cstring>
#include <vector>

#include "ellipse.h"
#include "threads.h"
#include "workspace.h"

namespace fp {

constexpr size_t kPiece = 1024;  // Gaussians per piece of work

// One cache line, for blending reads splats in no order at all.
struct alignas(64) Splat {
  Brush<float> brush;
  uint32_t id;         // row of the inputs
  float threshold;     // 0 for none
  float inv_opacity;   // of the compensated opacity
  float unused;
};
static_assert(sizeof(Splat) == 64, "four columns of four");

// Tiles x0..x1, both included, of one row of tiles; none when x0 > x1.
struct Span {
  uint16_t x0, x1;
  uint32_t tiles() const { return static_cast<uint32_t>(x1 - x0 + 1); }
};

// The tiles that a splat reaches: spans[first] is of row `row`, and so on down.
struct Reach {
  uint32_t first;  // within the piece
  uint16_t row, rows;
};

// What projection leaves. Splats of piece k begin at kPiece * k, in the order of the inputs.
struct Scene {
  Buffer<Splat> splats;
  Buffer<float> depth;
  Buffer<Reach> reach;
  Buffer<uint32_t> slot;            // per splat: tiles of its piece's splats before it
  std::vector<Heap<Span>> spans;    // per piece
  std::vector<uint32_t> count;      // per piece: splats
  std::vector<uint32_t> slot_base;  // per piece: tiles of the splats before it; one more at the end
  struct RowTotal {
    uint32_t spans, tiles;
  };
  std::vector<RowTotal> rows;       // per row of tiles: what reaches it
  size_t total = 0;                 // splats

  size_t pieces() const { return count.size(); }
  // Gives up what only binning reads.
  void drop_reach() {
    depth = Buffer<float>();
    reach = Buffer<Reach>();
    spans.clear();
  }
  // A splat's slots, from its own first to the next one's.
  uint32_t slot_begin(size_t k) const { return slot_base[k / kPiece] + slot[k]; }
  uint32_t slot_end(size_t k) const {
    return k % kPiece + 1 < count[k / kPiece] ? slot_begin(k + 1) : slot_base[k / kPiece + 1];
  }
};

// ---- reading ---------------------------------------------------------------------------------

// Rows of the inputs; for the last few, of copies with room behind them, for whole registers read
// beyond a row's end.
struct Rows {
  const float *means, *scales, *rotations, *cov3d, *opacities, *thresholds;
};

// Copies of up to kLanes rows.
struct Tail {
  float means[3 * kLanes + 1], scales[3 * kLanes + 1], rotations[4 * kLanes], cov3d[6 * kLanes],
      opacities[kLanes], thresholds[kLanes];
};

inline Rows rows_at(const fragprune_inputs& in, size_t i, size_t count, Tail& tail) {
  if (i + kLanes < static_cast<size_t>(in.count)) {
    const auto at = [i](const float* p, size_t width) { return p ? p + i * width : nullptr; };
    return {at(in.means, 3), at(in.scales, 3),    at(in.rotations, 4),
            at(in.cov3d, 6), at(in.opacities, 1), at(in.thresholds, 1)};
  }
  std::memset(&tail, 0, sizeof tail);  // a mean of 0 may be in view, but its opacity is 0
  const auto copy = [&](const float* p, size_t width, float* to) -> const float* {
    return p ? (std::copy(p + i * width, p + (i + count) * width, to), to) : nullptr;
  };
  return {copy(in.means, 3, tail.means),         copy(in.scales, 3, tail.scales),
          copy(in.rotations, 4, tail.rotations), copy(in.cov3d, 6, tail.cov3d),
          copy(in.opacities, 1, tail.opacities), copy(in.thresholds, 1, tail.thresholds)};
}

inline Vec<Lanes> load_vec(const float* rows) {
  Lanes v[4];
  load_columns([&](int i) { return rows + 3 * i; }, v);
  return {v[0], v[1], v[2]};
}

// All but the mean.
inline void load_shape(const Rows& rows, Given<Lanes>& g) {
  g.factored = rows.cov3d == nullptr;
  if (g.factored) {
    g.scale = load_vec(rows.scales);
    load_columns([&](int i) { return rows.rotations + 4 * i; }, g.rotation);
  } else {
    load_columns([&](int i) { return rows.cov3d + 6 * i; }, g.cov3d);
    load_columns([&](int i) { return rows.cov3d + 6 * i + 2; }, g.cov3d + 2);
  }
}

// Rows of 3 numbers picked by id, for registers that read a fourth: the array's last row is copied.
class Triples {
 public:
  Triples(const float* data, int64_t count) : data_(data), last_(static_cast<uint32_t>(count - 1)) {
    if (data && count > 0) std::copy(data + 3 * size_t{last_}, data + 3 * size_t{last_} + 3, copy_);
  }
  Vec<Lanes> load(const uint32_t* ids) const {
    Lanes v[4];
    const auto row = [&](int i) { return ids[i] == last_ ? copy_ : data_ + size_t{3} * ids[i]; };
    load_columns(row, v);
    return {v[0], v[1], v[2]};
  }

 private:
  const float* data_;
  uint32_t last_;
  float copy_[4] = {};
};

// The spherical harmonics' coefficients of kLanes Gaussians as columns, 3 k + channel.
struct Coefficients {
  Lanes column[48];
  Vec<Lanes> operator()(int k) const {
    return {column[3 * k], column[3 * k + 1], column[3 * k + 2]};
  }
};

inline void load_coefficients(const fragprune_inputs& in, const uint32_t* ids, int terms,
                              Coefficients& to) {
  const size_t width = 3 * static_cast<size_t>(in.sh_coefficients);
  const int used = 3 * terms;
  if (used < 4) {  // degree 0, and perhaps rows of 3
    for (int k = 0; k < used; k++)
      for (int i = 0; i < kLanes; i++) to.column[k][i] = in.sh[ids[i] * width + k];
    return;
  }
  for (int k = 0; k < used; k += 4) {
    const int from = std::min(k, used - 4);
    load_columns([&](int i) { return in.sh + ids[i] * width + from; }, to.column + from);
  }
}

// ---- a piece ---------------------------------------------------------------------------------

// Projects one piece.
class Projector {
 public:
  Projector(const Camera<float>& camera, const fragprune_inputs& in, int32_t* radii)
      : c_(lift<Lanes>(camera)), in_(in), radii_(radii), means_(in.means, in.count),
        colors_(in.colors, in.count) {}

  // Fills piece k of the scene; returns how many tiles its splats reach.
  uint64_t run(const Memory& scratch, Scene& scene, size_t k) const {
    const size_t begin = k * kPiece;
    const size_t end = std::min(begin + kPiece, static_cast<size_t>(in_.count));
    Place to{&scene.splats[begin], &scene.depth[begin], &scene.reach[begin], &scene.slot[begin],
             Heap<Span>(scratch, 4 * kPiece), 0};
    for (size_t i = begin; i < end; i += kLanes)
      shape(i, std::min<size_t>(kLanes, end - i), to);
    colour(to);
    uint64_t slots = 0;
    for (uint32_t j = 0; j < to.count; j++) {
      const uint32_t mine = to.slot[j];
      to.slot[j] = static_cast<uint32_t>(slots);
      slots += mine;
    }
    add_rows(to, scene);
    scene.count[k] = to.count;
    scene.spans[k] = std::move(to.spans);
    return slots;
  }

 private:
  struct Place {
    Splat* splats;
    float* depth;
    Reach* reach;
    uint32_t* slot;  // tiles of each splat, until run adds them up
    Heap<Span> spans;
    uint32_t count;
  };

  // Adds a piece's spans to the totals of the rows, which all pieces share.
  static void add_rows(const Place& from, Scene& scene) {
    std::vector<Scene::RowTotal> mine(scene.rows.size(), Scene::RowTotal{0, 0});
    for (uint32_t j = 0; j < from.count; j++) {
      const Reach& reach = from.reach[j];
      for (uint32_t r = 0; r < reach.rows; r++) {
        Scene::RowTotal& total = mine[reach.row + r];
        total.spans++, total.tiles += from.spans.data()[reach.first + r].tiles();
      }
    }
    for (size_t r = 0; r < mine.size(); r++) {
      if (!mine[r].spans) continue;
      __atomic_fetch_add(&scene.rows[r].spans, mine[r].spans, __ATOMIC_RELAXED);
      __atomic_fetch_add(&scene.rows[r].tiles, mine[r].tiles, __ATOMIC_RELAXED);
    }
  }

  // Everything but colour, for `count` Gaussians from row i.
  void shape(size_t i, size_t count, Place& to) const {
    if (in_.means2d) return footprint(i, count, to);
    Tail tail;
    const Rows rows = rows_at(in_, i, count, tail);
    Given<Lanes> given;
    given.mean = load_vec(rows.means);
    if (!bits(in_front(c_, given.mean))) {
      std::fill_n(radii_ + i, count, 0);
      return;
    }
    load_shape(rows, given);
    Projection<Lanes> p;
    const Mask seen = project(c_, given, p);
    write_radii(select(seen, p.radius, broadcast<Lanes>(0.f)), i, count);
    const Lanes none = broadcast<Lanes>(0.f);
    const Lanes opacity = load(rows.opacities) * compensation(c_, p);
    const Lanes threshold = rows.thresholds ? load(rows.thresholds) : none;
    Brush<Lanes> b;
    const uint32_t living = bits(both(seen, cut(opacity, threshold, b))) & first_lanes(count);
    if (!living) return;
    b.x = p.x;
    b.y = p.y;
    b.scale = sqrt(0.5f * kLog2E * (p.var_y / p.det));
    b.skew = -b.scale * (p.cov / p.var_y);
    b.down = sqrt(0.5f * kLog2E / p.var_y);
    const Bounds<Lanes> bounds = bounds_of(c_, p, b);
    pack(i, living, b, threshold, 1.f / opacity, p.view.z, bounds, to);
  }

  // The same for Gaussians that are given on the image.
  void footprint(size_t i, size_t count, Place& to) const {
    std::fill_n(radii_ + i, count, 0);
    const auto column = [&](const float* rows, size_t width, size_t k) {
      Lanes v = {};
      for (size_t lane = 0; rows && lane < count; lane++) v[lane] = rows[(i + lane) * width + k];
      return v;
    };
    const auto edge = [&](size_t k, Lanes most) {
      Lanes v = {};
      for (size_t lane = 0; lane < count; lane++)
        v[lane] = static_cast<float>(in_.tiles[(i + lane) * 4 + k]);
      return clamp(v, broadcast<Lanes>(0.f), most);
    };
    Projection<Lanes> p;
    p.tile_x0 = edge(0, c_.tiles_x), p.tile_y0 = edge(1, c_.tiles_y);
    p.tile_x1 = edge(2, c_.tiles_x), p.tile_y1 = edge(3, c_.tiles_y);
    const Lanes z = column(in_.depths, 1, 0), opacity = column(in_.opacities, 1, 0);
    const Lanes threshold = column(in_.thresholds, 1, 0);
    const Square<Lanes> square = square_of(column(in_.conics, 3, 0), column(in_.conics, 3, 1),
                                           column(in_.conics, 3, 2));
    Brush<Lanes> b;
    b.x = column(in_.means2d, 2, 0), b.y = column(in_.means2d, 2, 1);
    b.scale = square.scale, b.skew = square.skew, b.down = square.down;
    const Lanes far = broadcast<Lanes>(1e9f), deep = broadcast<Lanes>(1e30f);
    const Mask near_image = both(ge(far, abs(b.x)), ge(far, abs(b.y)));
    const Mask has_depth = both(gt(z, broadcast<Lanes>(1e-30f)), gt(deep, z));
    const Mask has_tiles = both(gt(p.tile_x1, p.tile_x0), gt(p.tile_y1, p.tile_y0));
    const Mask seen = both(both(near_image, square.exists), both(has_depth, has_tiles));
    const uint32_t living = bits(both(seen, cut(opacity, threshold, b))) & first_lanes(count);
    if (living)
      pack(i, living, b, threshold, 1.f / opacity, z, bounds_of(c_, p, b), to);
  }

  static uint32_t first_lanes(size_t count) {
    return static_cast<uint32_t>((uint64_t{1} << count) - 1);
  }

  // Fills in what decides on fragments; false: there are none.
  Mask cut(Lanes opacity, Lanes threshold, Brush<Lanes>& b) const {
    const Lanes none = broadcast<Lanes>(0.f);
    b.log_opacity = log2(opacity);
    b.cut = cut_of(b.log_opacity, threshold);
    b.list_cut = in_.widen ? cut_of(b.log_opacity, rim_reach(threshold)) : b.cut;
    return both(both(gt(opacity, none), gt(broadcast<Lanes>(1e30f), opacity)),
                both(ge(threshold, none), ge(b.log_opacity, b.list_cut)));
  }

  void write_radii(Lanes radius, size_t i, size_t count) const {
    const IntLanes whole = to_int(radius);
    if (count == kLanes) return store(radii_ + i, whole);
    int32_t values[kLanes];
    store(values, whole);
    std::copy(values, values + count, radii_ + i);
  }

  // Appends those of the lanes that live and reach a tile.
  void pack(size_t i, uint32_t living, const Brush<Lanes>& b, Lanes threshold, Lanes inv_opacity,
            Lanes z, const Bounds<Lanes>& bounds, Place& to) const {
    alignas(64) float quads[3][kLanes][4];
    const Lanes columns[3][4] = {{b.x, b.y, b.scale, b.skew},
                                 {b.down, b.log_opacity, b.cut, b.list_cut},
                                 {threshold, inv_opacity, z, z}};
    for (int k = 0; k < 3; k++) store_rows(columns[k], [&](int lane) { return quads[k][lane]; });
    constexpr float tile = 1.f / kTile;
    const Lanes first_row = floor(bounds.top * tile);
    const Lanes rows = floor(bounds.bottom * tile) - first_row + 1.f;
    alignas(64) int32_t row[kLanes], height[kLanes];
    store(row, to_int(first_row));
    store(height, to_int(select(ge(bounds.bottom, bounds.top), rows, broadcast<Lanes>(0.f))));
    int highest = 0;
    for (uint32_t todo = living; todo; todo &= todo - 1)
      highest = std::max(highest, height[__builtin_ctz(todo)]);
    constexpr int kAtOnce = 32;  // rows of tiles; higher splats take theirs one by one
    alignas(64) int32_t from[kAtOnce][kLanes], last[kAtOnce][kLanes];
    for (int r = 0; r < std::min(highest, kAtOnce); r++) {
      Lanes x0, x1;
      span_of(bounds, first_row + static_cast<float>(r), x0, x1);
      store(from[r], to_int(x0)), store(last[r], to_int(x1));
    }
    for (uint32_t todo = living; todo; todo &= todo - 1) {
      const int lane = __builtin_ctz(todo);
      const size_t before = to.spans.size();
      uint32_t tiles = 0;
      const auto push = [&](int x0, int x1) {
        const Span span{static_cast<uint16_t>(x0), static_cast<uint16_t>(x1)};
        to.spans.push(span);
        tiles += span.tiles();
      };
      for (int r = 0; r < std::min(height[lane], kAtOnce); r++) push(from[r][lane], last[r][lane]);
      if (height[lane] > kAtOnce) {
        const Bounds<float> mine = lane_of(bounds, lane);
        for (int r = kAtOnce; r < height[lane]; r++) {
          float x0, x1;
          span_of(mine, static_cast<float>(row[lane] + r), x0, x1);
          push(static_cast<int>(x0), static_cast<int>(x1));
        }
      }
      if (!tiles) {
        to.spans.shrink(before);
        continue;
      }
      const uint32_t j = to.count++;
      float* splat = reinterpret_cast<float*>(to.splats + j);
      std::memcpy(splat, quads[0][lane], 16);
      std::memcpy(splat + 4, quads[1][lane], 16);
      to.splats[j].id = static_cast<uint32_t>(i) + lane;
      prefetch_colour(i + lane);
      to.splats[j].threshold = quads[2][lane][0];
      to.splats[j].inv_opacity = quads[2][lane][1];
      to.depth[j] = quads[2][lane][2];
      to.reach[j] = {static_cast<uint32_t>(before), static_cast<uint16_t>(row[lane]),
                     static_cast<uint16_t>(height[lane])};
      to.slot[j] = tiles;
    }
  }

  static Bounds<float> lane_of(const Bounds<Lanes>& v, int lane) {
    static_assert(sizeof(Bounds<Lanes>) == kLanes * sizeof(Bounds<float>), "numbers only");
    Bounds<float> one;
    float all[sizeof(Bounds<Lanes>) / sizeof(float)], *to = reinterpret_cast<float*>(&one);
    std::memcpy(all, &v, sizeof v);
    for (size_t k = 0; k < sizeof one / sizeof(float); k++) to[k] = all[k * kLanes + lane];
    return one;
  }

  // Colour and 1/z of a piece's splats; those of no finite colour, or of features that are not,
  // reach no tile any more.
  void colour(Place& to) const {
    for (uint32_t j = 0; j < to.count; j += kLanes) {
      const int count = static_cast<int>(std::min<uint32_t>(kLanes, to.count - j));
      uint32_t ids[kLanes];
      float depth[kLanes];
      for (int lane = 0; lane < kLanes; lane++) {
        const uint32_t from = j + std::min(lane, count - 1);
        ids[lane] = to.splats[from].id;
        depth[lane] = to.depth[from];
      }
      const Lanes none = broadcast<Lanes>(0.f);
      Vec<Lanes> colour;
      if (in_.colors) {
        colour = colors_.load(ids);
      } else {
        Lanes inv_length;
        Harmonics<Lanes> h;
        const int terms = harmonics(
            in_.sh_degree, direction_to(c_, means_.load(ids), inv_length), h, false);
        Coefficients coefficients;
        load_coefficients(in_, ids, terms, coefficients);
        colour = raw_colour(h, terms, coefficients);
      }
      const Lanes size = abs(colour.x) + abs(colour.y) + abs(colour.z);
      uint32_t broken = ~bits(gt(broadcast<Lanes>(1e30f), size));
      for (int lane = 0; in_.features && lane < count; lane++) broken |= has_wild(ids[lane]) << lane;
      if (!in_.colors)
        colour = {max(colour.x, none), max(colour.y, none), max(colour.z, none)};
      const Lanes columns[4] = {colour.x, colour.y, colour.z, 1.f / load(depth)};
      alignas(64) float quads[kLanes][4];
      store_rows(columns, [&](int lane) { return quads[lane]; });
      for (int lane = 0; lane < count; lane++) {
        std::memcpy(reinterpret_cast<float*>(&to.splats[j + lane]) + 8, quads[lane], 16);
        if (broken >> lane & 1) to.reach[j + lane].rows = 0, to.slot[j + lane] = 0;
      }
    }
  }

  // Whether a Gaussian's features are beyond all bounds.
  uint32_t has_wild(uint32_t id) const {
    const float* row = in_.features + size_t{id} * in_.feature_count;
    return !std::all_of(row, row + in_.feature_count, [](float v) { return abs(v) < 1e30f; });
  }

  // Asks for what colour() will read of a splat: it comes while the piece's others are projected.
  void prefetch_colour(size_t id) const {
    if (!in_.sh) return;
    const size_t width = 3 * static_cast<size_t>(in_.sh_coefficients);
    for (size_t k = 0; k < width; k += 16) __builtin_prefetch(in_.sh + id * width + k, 0, 2);
  }

  const Camera<Lanes> c_;
  const fragprune_inputs& in_;
  int32_t* radii_;
  const Triples means_, colors_;
};

// What only binning reads lies in `scratch`.
inline Scene project_all(Team& team, const Memory& memory, const Memory& scratch,
                         const Camera<float>& c, const fragprune_inputs& in, int32_t* radii) {
  const size_t n = static_cast<size_t>(in.count), pieces = (n + kPiece - 1) / kPiece;
  Scene scene;
  scene.splats = Buffer<Splat>(memory, n);
  scene.depth = Buffer<float>(scratch, n);
  scene.reach = Buffer<Reach>(scratch, n);
  scene.slot = Buffer<uint32_t>(memory, n);
  scene.spans.resize(pieces);
  scene.count.resize(pieces);
  scene.slot_base.resize(pieces + 1);
  scene.rows.resize(static_cast<size_t>(c.tiles_y));
  std::vector<uint64_t> slots(pieces);
  const Projector projector(c, in, radii);
  team.each(pieces, 1, [&](size_t k, size_t) { slots[k] = projector.run(scratch, scene, k); });
  uint64_t total = 0;
  for (size_t k = 0; k < pieces; k++) {
    scene.slot_base[k] = static_cast<uint32_t>(total);
    scene.total += scene.count[k];
    total += slots[k];
    if (total > UINT32_MAX) throw std::length_error("tile lists");
  }
  scene.slot_base[pieces] = static_cast<uint32_t>(total);
  return scene;
}

}  // namespace fp
