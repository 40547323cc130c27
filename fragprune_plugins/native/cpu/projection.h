// From Gaussians to splats: all that blending and binning need of those that can draw.
//
// Gaussians go kLanes at a time through the mathematics of gaussian.h. Those that are left are
// packed per piece of kPiece rows. Colours come when a splat is about to be blended: most of a
// scene lies behind something.
#pragma once

#include <algorithm>
#include <array>
#include <cstring>
#include <vector>

#include "ellipse.h"
#include "rows.h"
#include "threads.h"
#include "workspace.h"

namespace fp {

constexpr size_t kPiece = 1024;  // Gaussians per piece of work
constexpr int kBatch = 256;      // splats blended, and coloured, at once
constexpr int kCell = 16;        // tiles of a cell; they lie side by side

// One cache line, for blending reads splats in no order at all.
struct alignas(64) Splat {
  Brush<float> brush;  // its colour may be unknown, see Colours
  uint32_t id;         // row of the inputs
  float threshold;     // 0 for none
  float inv_opacity;   // of the compensated opacity
  uint32_t slot;       // see Scene
};
static_assert(sizeof(Splat) == 64, "four columns of four");

// Tiles x0..x1, y0..y1, all included: none beyond them are reached.
struct Reach {
  uint16_t x0, y0, x1, y1;

  uint32_t cells_across() const { return static_cast<uint32_t>(x1 / kCell - x0 / kCell + 1); }
  uint32_t cells() const { return cells_across() * static_cast<uint32_t>(y1 - y0 + 1); }
};

// What projection leaves. Splats of piece k begin at kPiece * k, in the order of the inputs.
struct Scene {
  Buffer<Splat> splats;
  Buffer<float> depth;
  Buffer<Reach> reach;
  std::vector<uint32_t> count;      // per piece: splats
  std::vector<uint32_t> cells;      // per cell, row by row: splats that reach it
  std::vector<uint32_t> slot_base;  // per piece: slots of the splats before it
  size_t across = 0;                // cells in a row
  size_t total = 0;                 // splats

  size_t pieces() const { return count.size(); }
  // What backward finds out about a splat in one cell has a slot; a splat's slots are next to each
  // other, row by row.
  size_t slot(size_t k) const { return size_t{slot_base[k / kPiece]} + splats[k].slot; }
  size_t slot(size_t k, uint32_t row, uint32_t column) const {
    const Reach& r = reach[k];
    return slot(k) + size_t{row - r.y0} * r.cells_across() + (column - r.x0 / kCell);
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

// ---- a piece ---------------------------------------------------------------------------------

// Colours, of splats that are about to be blended. Until then inv_z is -1/z; it is 0 where colour or
// features are beyond all bounds: such a splat draws nothing.
class Colours {
 public:
  Colours(const Camera<float>& camera, const fragprune_inputs& in, Splat* splats)
      : c_(lift<Lanes>(camera)), in_(in), splats_(splats), means_(in.means, in.count),
        colors_(in.colors, in.count) {}

  // Colours those of at most kBatch splats that have none. Several threads may do so with the same
  // splat: each writes the same.
  void fill(const uint32_t* which, int count) const {
    uint32_t todo[kBatch];
    int n = 0;
    for (int i = 0; i < count; i++) {
      todo[n] = which[i];
      n += read(splats_[which[i]].brush.inv_z) < 0;
    }
    for (int i = 0; i < std::min(n, 2 * kLanes); i++) prefetch(splats_[todo[i]]);
    for (int i = 0; i < n; i += kLanes) {
      for (int k = i + 2 * kLanes; k < std::min(n, i + 3 * kLanes); k++) prefetch(splats_[todo[k]]);
      colour(todo + i, std::min(kLanes, n - i));
    }
  }

  // Colours `count` splats from the place `begin` on, none of which has one.
  void fill_all(size_t begin, uint32_t count) const {
    for (uint32_t i = 0; i < count; i += kLanes) {
      uint32_t which[kLanes];
      const uint32_t n = std::min<uint32_t>(kLanes, count - i);
      for (uint32_t k = 0; k < n; k++) which[k] = static_cast<uint32_t>(begin) + i + k;
      colour(which, static_cast<int>(n));
    }
  }

  // Asks for what fill() will read of a splat that has no colour yet.
  void prefetch(const Splat& s) const {
    if (!(read(s.brush.inv_z) < 0)) return;
    const size_t id = s.id;
    if (in_.means) __builtin_prefetch(in_.means + 3 * id);
    if (!in_.sh) return;
    for (const Part<const float>& p : coefficient_rows(in_).part)
      for (size_t k = 0; k < p.width; k += 16) __builtin_prefetch(p.rows + id * p.width + k, 0, 2);
  }

  // A splat's colour and 1/z: r, g, b, inv_z.
  static void get(const Splat& s, float* rgbz) {
    rgbz[3] = read(s.brush.inv_z);
    rgbz[0] = read(s.brush.r), rgbz[1] = read(s.brush.g), rgbz[2] = read(s.brush.b);
  }

 private:
  static float read(const float& from) {
    float v;
    __atomic_load(&from, &v, __ATOMIC_ACQUIRE);
    return v;
  }
  static void write(float& to, float v) { __atomic_store(&to, &v, __ATOMIC_RELEASE); }

  void colour(const uint32_t* which, int count) const {
    uint32_t ids[kLanes];
    float depth[kLanes];
    for (int lane = 0; lane < kLanes; lane++) {
      const Splat& s = splats_[which[std::min(lane, count - 1)]];
      ids[lane] = s.id;
      depth[lane] = read(s.brush.inv_z);
    }
    const Lanes none = broadcast<Lanes>(0.f);
    Vec<Lanes> colour;
    if (in_.colors) {
      colour = colors_.load(ids);
    } else {
      Lanes inv_length;
      Harmonics<Lanes> h;
      const int terms =
          harmonics(in_.sh_degree, direction_to(c_.centre, means_.load(ids), inv_length), h, false);
      Coefficients coefficients;
      load_coefficients(coefficient_rows(in_), ids, terms, coefficients);
      colour = raw_colour(h, terms, coefficients);
    }
    const Lanes size = abs(colour.x) + abs(colour.y) + abs(colour.z);
    uint32_t broken = ~bits(gt(broadcast<Lanes>(1e30f), size));
    for (int lane = 0; in_.features && lane < count; lane++) broken |= has_wild(ids[lane]) << lane;
    if (!in_.colors) colour = {max(colour.x, none), max(colour.y, none), max(colour.z, none)};
    float r[kLanes], g[kLanes], b[kLanes];
    store(r, colour.x), store(g, colour.y), store(b, colour.z);
    for (int lane = 0; lane < count; lane++) {
      Brush<float>& to = splats_[which[lane]].brush;
      write(to.r, r[lane]), write(to.g, g[lane]), write(to.b, b[lane]);
      write(to.inv_z, broken >> lane & 1 ? 0.f : abs(depth[lane]));
    }
  }

  // Whether a Gaussian's features are beyond all bounds.
  uint32_t has_wild(uint32_t id) const {
    const float* row = in_.features + size_t{id} * in_.feature_count;
    return !std::all_of(row, row + in_.feature_count, [](float v) { return abs(v) < 1e30f; });
  }

  const Camera<Lanes> c_;
  const fragprune_inputs& in_;
  Splat* splats_;
  const Triples means_, colors_;
};

// Whether thresholds cut with a soft rim.
inline bool softens(const fragprune_inputs& in) { return in.soft && in.thresholds; }

constexpr float kHalfPixel = 0.5f;  // that a soft rim is wide, outwards

// Projects one piece.
class Projector {
 public:
  Projector(const Camera<float>& camera, const fragprune_inputs& in, int32_t* radii,
            const Colours& colours)
      : c_(lift<Lanes>(camera)), in_(in), radii_(radii), colours_(colours),
        many_(kManyLayers * static_cast<uint64_t>(camera.tiles_x * camera.tiles_y)) {}

  // Fills piece k of the scene.
  void run(Scene& scene, size_t k) const {
    const size_t begin = k * kPiece;
    const size_t end = std::min(begin + kPiece, static_cast<size_t>(in_.count));
    Place to{&scene.splats[begin], &scene.depth[begin], &scene.reach[begin], 0};
    for (size_t i = begin; i < end; i += kLanes)
      shape(i, std::min<size_t>(kLanes, end - i), to);
    scene.count[k] = to.count;
    // Where few lie behind others they are coloured at once, in the order of the inputs: reading
    // them in the order of depth takes twice as long. The piece stands for all.
    if (count_cells(to, scene) * scene.pieces() < many_)
      colours_.fill_all(begin, to.count);
  }

 private:
  struct Place {
    Splat* splats;
    float* depth;
    Reach* reach;
    uint32_t count;
  };

  // Adds a piece's splats to the cells' counts, which all pieces share; returns how many tiles are
  // in their reach, added up.
  static uint64_t count_cells(const Place& from, Scene& scene) {
    std::vector<uint32_t> mine(scene.cells.size());
    uint64_t tiles = 0;
    for (uint32_t j = 0; j < from.count; j++) {
      const Reach reach = from.reach[j];
      tiles += uint64_t{reach.x1 - reach.x0 + 1u} * (reach.y1 - reach.y0 + 1u);
      for (size_t y = reach.y0; y <= reach.y1; y++)
        for (size_t x = reach.x0 / kCell; x <= reach.x1 / size_t{kCell}; x++)
          mine[y * scene.across + x]++;
    }
    for (size_t c = 0; c < mine.size(); c++)
      if (mine[c]) __atomic_fetch_add(&scene.cells[c], mine[c], __ATOMIC_RELAXED);
    return tiles;
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
    if (softens(in_)) soften(b, threshold);
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
    if (softens(in_)) soften(b, threshold);
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

  // Where a soft rim lies, and how far out pixels feel it. With q = d A d and the cutoff Q, those are
  // pixels with q - |A d| < Q. For some n of length 1 that is (d - n/2) A (d - n/2) < Q + n A n / 4: they
  // lie within half a pixel, which is the spread's, of the ellipse q < Q + (A's largest eigenvalue) / 4.
  static void soften(Brush<Lanes>& b, Lanes threshold) {
    b.cut = b.log_opacity + log2(threshold);
    const Lanes both = fma(b.scale, b.scale, fma(b.skew, b.skew, b.down * b.down));
    const Lanes area = 2.f * b.scale * b.down;  // twice the root of the determinant
    const Lanes largest = 0.5f * (both + sqrt(max((both - area) * (both + area), 0.f * both)));
    b.list_cut = max(b.cut - 0.25f * largest, broadcast<Lanes>(kFaintest));
  }

  void write_radii(Lanes radius, size_t i, size_t count) const {
    const IntLanes whole = to_int(radius);
    if (count == kLanes) return store(radii_ + i, whole);
    int32_t values[kLanes];
    store(values, whole);
    std::copy(values, values + count, radii_ + i);
  }

  // Appends those of the lanes that live and whose ellipse's box reaches a tile.
  void pack(size_t i, uint32_t living, const Brush<Lanes>& b, Lanes threshold, Lanes inv_opacity,
            Lanes z, const Bounds<Lanes>& bounds, Place& to) const {
    const Lanes far = broadcast<Lanes>(1e9f), none = broadcast<Lanes>(0.f);
    const Lanes half = span_end(bounds.ellipse, -far, far, broadcast<Lanes>(1.f));
    const Lanes left = max(bounds.left, ceil(b.x - half));
    const Lanes right = min(bounds.right, floor(b.x + half));
    living &= bits(both(ge(bounds.bottom, bounds.top), ge(right, left)));
    if (!living) return;
    constexpr float tile = 1.f / kTile;
    alignas(64) int32_t box[4][kLanes];
    store(box[0], to_int(left * tile)), store(box[1], to_int(bounds.top * tile));
    store(box[2], to_int(right * tile)), store(box[3], to_int(bounds.bottom * tile));
    alignas(64) float quads[4][kLanes][4];
    const Lanes columns[4][4] = {{b.x, b.y, b.scale, b.skew},
                                 {b.down, b.log_opacity, b.cut, b.list_cut},
                                 {none, none, none, -1.f / z},
                                 {threshold, threshold, inv_opacity, z}};
    for (int k = 0; k < 4; k++) store_rows(columns[k], [&](int lane) { return quads[k][lane]; });
    for (; living; living &= living - 1) {
      const int lane = __builtin_ctz(living);
      const uint32_t j = to.count++;
      float* splat = reinterpret_cast<float*>(to.splats + j);
      for (int k = 0; k < 4; k++) std::memcpy(splat + 4 * k, quads[k][lane], 16);
      to.splats[j].id = static_cast<uint32_t>(i) + lane;
      to.depth[j] = quads[3][lane][3];
      const auto edge = [&](int k) { return static_cast<uint16_t>(box[k][lane]); };
      to.reach[j] = {edge(0), edge(1), edge(2), edge(3)};
    }
  }

  static constexpr uint64_t kManyLayers = 1024;  // splats whose reach covers a tile
  const Camera<Lanes> c_;
  const fragprune_inputs& in_;
  int32_t* radii_;
  const Colours& colours_;
  const uint64_t many_;
};

// What only binning reads lies in `scratch`.
FP_STAGE inline Scene project_all(Team& team, const Memory& memory, const Memory& scratch,
                         const Camera<float>& c, const fragprune_inputs& in, int32_t* radii) {
  const size_t n = static_cast<size_t>(in.count), pieces = (n + kPiece - 1) / kPiece;
  Scene scene;
  scene.splats = Buffer<Splat>(memory, n);
  scene.depth = Buffer<float>(scratch, n);
  scene.reach = Buffer<Reach>(memory, n);
  scene.count.resize(pieces);
  scene.across = (static_cast<size_t>(c.tiles_x) + kCell - 1) / kCell;
  scene.cells.resize(scene.across * static_cast<size_t>(c.tiles_y));
  const Colours colours(c, in, scene.splats.data());
  const Projector projector(c, in, radii, colours);
  team.each(pieces, 1, [&](size_t k, size_t) { projector.run(scene, k); });
  for (uint32_t count : scene.count) scene.total += count;
  return scene;
}

// Gives every splat that was coloured its slots; returns how many there are.
inline size_t number_slots(Team& team, Scene& scene) {
  std::vector<uint32_t> slots(scene.pieces());
  team.each(scene.pieces(), 16, [&](size_t begin, size_t end) {
    for (size_t piece = begin; piece < end; piece++)
      for (size_t k = piece * kPiece; k < piece * kPiece + scene.count[piece]; k++) {
        scene.splats[k].slot = slots[piece];
        if (scene.splats[k].brush.inv_z > 0) slots[piece] += scene.reach[k].cells();
      }
  });
  size_t total = 0;
  scene.slot_base.clear();
  for (uint32_t count : slots) {
    scene.slot_base.push_back(static_cast<uint32_t>(total));
    total += count;
  }
  return total;
}

}  // namespace fp
