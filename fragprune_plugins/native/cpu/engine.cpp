// The C interface on a CPU: project, sort, bin, blend; and back. And the loss of what was drawn.

#include <array>
#include <chrono>
#include <cmath>
#include <cstdio>
#include <initializer_list>
#include <new>
#include <optional>
#include <stdexcept>
#include <utility>

#include "binning.h"
#include "blend.h"
#include "loss.h"
#include "slice.h"
#include "surfels.h"

namespace fp {

// The lists of a cell's tiles: tile x has entries [first[x], first[x + 1]).
struct KeptCell {
  Buffer<uint32_t> splat;
  Buffer<Blocks> reached;
  uint32_t first[kCell + 1];
};

}  // namespace fp

struct fragprune_workspace {
  fp::Memory memory = std::make_shared<fp::Pool>();
};

struct fragprune_state {
  fp::Memory memory;
  fragprune_inputs in;
  fp::Camera<float> camera;
  fp::Extras extras;
  fp::Scene scene;  // what backward needs of it
  std::vector<fp::KeptCell> cells;
  size_t slots;
  fp::Buffer<fp::TilePixels> pixels;  // per tile
  std::unique_ptr<fp::SurfelScene> surfels;  // of surfels this alone, and `in`
};

namespace fp {
namespace {

// ---- forward ---------------------------------------------------------------------------------

// Sums of weights, the same in any order: whole numbers, a pixel's whole light being `one`.
class Weights {
 public:
  Weights(const Memory& memory, const fragprune_inputs& in)
      : sums_(memory, static_cast<size_t>(in.count)),
        one_(std::ldexp(1., 62 - std::ilogb(2. * in.width * in.height))) {
    std::fill_n(sums_.data(), sums_.size(), 0);
  }
  void add(uint32_t row, float weight) {
    const auto whole = static_cast<uint64_t>(weight * one_);
    __atomic_fetch_add(&sums_[row], whole, __ATOMIC_RELAXED);
  }
  void write(float* to) const {
    for (size_t i = 0; i < sums_.size(); i++)
      to[i] = static_cast<float>(static_cast<double>(sums_[i]) / one_);
  }

 private:
  Buffer<uint64_t> sums_;
  double one_;
};

Extras extras_of(const fragprune_inputs& in, const fragprune_outputs& out) {
  const bool scores = out.weights_per_gaussian || out.wins_per_gaussian || out.winners;
  return {in.sample_offsets, in.features, out.features ? in.feature_count : 0,
          out.fragments_per_gaussian != nullptr, scores};
}

// Adds what a tile found out about each Gaussian.
void add_up(const ExtraTile& found, const TileList& list, const Splat* splats,
            const fragprune_outputs& out, Weights* weights) {
  const auto add = [](int32_t* to, uint32_t row, int32_t n) {
    __atomic_fetch_add(to + row, n, __ATOMIC_RELAXED);
  };
  for (size_t j = 0; j < list.splat.size(); j++) {
    const uint32_t row = splats[list.splat.data()[j]].id;
    if (found.extras.counts && found.each.fragments[j])
      add(out.fragments_per_gaussian, row, found.each.fragments[j]);
    if (weights && found.each.weight[j] > 0) weights->add(row, found.each.weight[j]);
  }
  for (int b = 0; out.wins_per_gaussian && b < kBlocks; b++)
    for (int i = 0; i < kLanes; i++)
      if (const int place = found.blocks[b].winner[i]; place >= 0)
        add(out.wins_per_gaussian, splats[list.splat.data()[place]].id, 1);
}

// What the cells of one picture share.
struct Picture {
  const Memory& memory;
  const Camera<float>& camera;
  const Extras& extras;
  const Scene& scene;
  const CellLists& lists;
  const Colours& colours;
  const Canvas& canvas;
  fragprune_outputs& out;
  Weights* weights;       // or NULL
  fragprune_state* keep;  // or NULL
};

// The tiles of one cell, front to back until nothing shows through.
class Cell {
 public:
  Cell(const Picture& picture, size_t cell)
      : p_(picture), splats_(picture.scene.splats.data()), cell_(cell),
        row_(static_cast<int>(cell / picture.scene.across)),
        left_(static_cast<int>(cell % picture.scene.across) * kCell),
        wide_(std::min(kCell, static_cast<int>(picture.camera.tiles_x) - left_)),
        tiles_(picture.memory, static_cast<size_t>(wide_)) {
    const bool listed = p_.keep || p_.extras.any();
    for (int x = 0; x < wide_; x++) {
      tiles_[x].open(p_.canvas, (left_ + x) * kTile, row_ * kTile);
      open_ |= 1u << x;
      if (listed) lists_.emplace_back(p_.memory);
      if (p_.extras.any()) {
        const Tile tile{tiles_[x].x, tiles_[x].y, nullptr, nullptr, 0};
        extra_.push_back(std::make_unique<ExtraTile>(p_.extras, tile, p_.canvas.width,
                                                     p_.canvas.height));
      }
    }
  }

  struct Spent {
    int64_t evaluated = 0;  // lanes
    int64_t entries = 0;    // of the tiles' lists
  };

  // Blends all of them.
  Spent blend() {
    const CellEntry* entries = p_.lists.entries.data();
    FrontToBack order(p_.memory, entries + p_.lists.first[cell_],
                      entries + p_.lists.first[cell_ + 1]);
    const CellEntry *begin, *end;
    while (open_ && order.next(begin, end)) hand_out(begin, end);
    for (int x = 0; x < wide_; x++)
      if (tiles_[x].waiting) blend_waiting(x);
    return spent_;
  }

  // Paints all of them and keeps what is to be kept; returns how many fragments were drawn.
  int64_t close() {
    int64_t drawn = 0;
    const bool watched = p_.keep || p_.extras.any();
    for (int x = 0; x < wide_; x++) {
      const int first = x;
      while (!watched && x < wide_ && !tiles_[x].begun) x++;
      if (x > first) paint_empty(p_.canvas, tiles_[first].x, tiles_[first].y, (x - first) * kTile);
      if (x == wide_) break;
      const size_t t = static_cast<size_t>(row_) * static_cast<size_t>(p_.camera.tiles_x) +
                       static_cast<size_t>(left_ + x);
      const ExtraTile* extra = extra_.empty() ? nullptr : extra_[x].get();
      const TileList* list = lists_.empty() ? nullptr : &lists_[x];
      drawn += close_tile(splats_, p_.canvas, tiles_[x], list, extra,
                          p_.keep ? &p_.keep->pixels[t] : nullptr);
      if (extra) add_up(*extra, *list, splats_, p_.out, p_.weights);
    }
    end_stream();
    if (p_.keep) keep_lists(p_.keep->cells[cell_]);
    return drawn;
  }

 private:
  template <bool... kRules>
  static constexpr decltype(&fp::blend_waiting<false, false, false, kRules...>) kBlend[] = {
      fp::blend_waiting<false, false, false, kRules...>,
      fp::blend_waiting<false, false, true, kRules...>,
      fp::blend_waiting<true, false, false, kRules...>,
      fp::blend_waiting<true, false, true, kRules...>,
      fp::blend_waiting<false, true, true, kRules...>,
      fp::blend_waiting<true, true, true, kRules...>};

  void hand_out(const CellEntry* entry, const CellEntry* end) {
    constexpr int kSome = 4 * kLanes;
    const float x = static_cast<float>(left_ * kTile), y = static_cast<float>(row_ * kTile);
    while (entry < end && open_) {
      uint32_t some[kSome + kLanes];  // of those that reach an open tile
      uint32_t inside[kSome + kLanes];
      int n = 0;
      for (; entry < end && n < kSome; entry++) {
        some[n] = entry->splat;
        inside[n] = tile_bits(entry->x0, entry->x1);
        __builtin_prefetch(&splats_[entry->splat]);
        n += (inside[n] & open_) != 0;
      }
      std::fill_n(some + n, kLanes, n ? some[n - 1] : 0);
      for (int i = 0; i < n; i += kLanes) {
        BlockSpans spans;
        find_blocks(splats_, some + i, p_.canvas.spread, x, y, spans);
        for (int lane = 0; lane < std::min(kLanes, n - i); lane++)
          hand_out(some[i + lane], spans, lane, inside[i + lane] & open_);
      }
    }
  }

  // Puts a splat on the lists of those of the open tiles `inside` that it reaches.
  void hand_out(uint32_t splat, const BlockSpans& spans, int lane, uint32_t inside) {
    if (inside) p_.colours.prefetch(splats_[splat]);
    for (; inside; inside &= inside - 1) {
      const int x = __builtin_ctz(inside);
      OpenTile& tile = tiles_[x];
      tile.splat[tile.waiting] = splat;
      tile.reached[tile.waiting] = spans.of_tile(lane, x);
      tile.waiting += tile.reached[tile.waiting] != 0;
      if (tile.waiting == kBatch) blend_waiting(x);
    }
  }

  void blend_waiting(int x) {
    const bool keep = p_.keep != nullptr, depth = p_.canvas.invdepth != nullptr;
    const bool stops = p_.canvas.stop > 0;
    const auto* const kinds = p_.canvas.soft ? (stops ? kBlend<true, true> : kBlend<false, true>)
                                             : (stops ? kBlend<true, false> : kBlend<false, false>);
    const auto blend = kinds[p_.extras.any() ? 4 + keep : 2 * keep + depth];
    spent_.entries += tiles_[x].waiting;
    spent_.evaluated += blend(splats_, p_.colours, p_.canvas, tiles_[x],
                              lists_.empty() ? nullptr : &lists_[x],
                              extra_.empty() ? nullptr : extra_[x].get());
    if (!tiles_[x].alive) open_ &= ~(1u << x);
  }

  void keep_lists(KeptCell& to) const {
    uint32_t total = 0;
    for (int x = 0; x <= kCell; x++) {
      to.first[x] = total;
      if (x < wide_) total += static_cast<uint32_t>(lists_[x].splat.size());
    }
    to.splat = Buffer<uint32_t>(p_.memory, total);
    to.reached = Buffer<Blocks>(p_.memory, total);
    for (int x = 0; x < wide_; x++) {
      const size_t n = lists_[x].splat.size();
      std::copy_n(lists_[x].splat.data(), n, to.splat.data() + to.first[x]);
      std::copy_n(lists_[x].reached.data(), n, to.reached.data() + to.first[x]);
    }
  }

  const Picture& p_;
  const Splat* splats_;
  const size_t cell_;
  const int row_, left_, wide_;  // tiles
  uint32_t open_ = 0;            // one bit for each tile where something shows through
  Spent spent_;
  Buffer<OpenTile> tiles_;
  std::vector<TileList> lists_;
  std::vector<std::unique_ptr<ExtraTile>> extra_;
};

FP_STAGE void draw(Team& team, const Memory& memory, const Camera<float>& c, const fragprune_inputs& in,
          const Extras& extras, Scene& scene, const CellLists& lists, fragprune_outputs& out,
          fragprune_state* keep) {
  const float* back = in.background;
  const Canvas canvas{in.width,     in.height,    {back[0], back[1], back[2]},
                      c.spread,     in.alpha_max, in.stop,
                      softens(in),  out.image,    out.invdepth,
                      out.alpha,    out.features, out.fragments,
                      out.winners};
  const size_t n = static_cast<size_t>(in.count);
  std::optional<Weights> weights;
  if (out.weights_per_gaussian) weights.emplace(memory, in);
  for (int32_t* counts : {out.fragments_per_gaussian, out.wins_per_gaussian})
    if (counts) std::fill_n(counts, n, 0);
  const Colours colours(c, in, scene.splats.data());
  const Picture picture{memory,  c,      extras, scene,                        lists,
                        colours, canvas, out,    weights ? &*weights : nullptr, keep};
  std::atomic<int64_t> drawn{0}, evaluated{0}, entries{0};
  team.each(scene.cells.size(), 1, [&](size_t k, size_t) {
    Cell cell(picture, k);
    const Cell::Spent spent = cell.blend();
    evaluated.fetch_add(spent.evaluated, std::memory_order_relaxed);
    entries.fetch_add(spent.entries, std::memory_order_relaxed);
    drawn.fetch_add(cell.close(), std::memory_order_relaxed);
  });
  if (weights) weights->write(out.weights_per_gaussian);
  out.drawn = drawn;
  out.evaluated = evaluated;
  out.entries = entries;
}

// Milliseconds since the last call.
class Clock {
 public:
  float lap() {
    const auto now = std::chrono::steady_clock::now();
    const std::chrono::duration<float, std::milli> spent = now - last_;
    last_ = now;
    return spent.count();
  }

 private:
  std::chrono::steady_clock::time_point last_ = std::chrono::steady_clock::now();
};

FP_STAGE void forward(const fragprune_inputs& in, float spread, fragprune_outputs& out,
             const Memory& memory, fragprune_state* keep) {
  Clock clock;
  if (in.flat) {
    std::unique_ptr<SurfelScene> surfels = draw_surfels(in, out, memory);
    out.projection_ms = out.binning_ms = 0;
    out.blend_ms = clock.lap();
    if (keep) keep->in = in, keep->surfels = std::move(surfels);
    return;
  }
  Team team(in.threads);
  const Camera<float> camera = unpack_camera(in, spread + (softens(in) ? kHalfPixel : 0.f));
  // A state holds on to its memory until the backward pass is done, which then wants more: what the
  // forward pass alone needed goes back to the system first, lest both lie idle in turns.
  const Memory scratch = keep ? std::make_shared<Pool>() : memory;
  Scene scene = project_all(team, memory, scratch, camera, in, out.radii);
  out.projection_ms = clock.lap();
  const CellLists lists = list_cells(team, scratch, scene);
  scene.depth = Buffer<float>();
  out.binning_ms = clock.lap();
  if (keep) {
    keep->cells.resize(scene.cells.size());
    keep->pixels = Buffer<TilePixels>(
        memory, static_cast<size_t>(camera.tiles_x) * static_cast<size_t>(camera.tiles_y));
  }
  const Extras extras = extras_of(in, out);
  draw(team, memory, camera, in, extras, scene, lists, out, keep);
  if (keep) {
    keep->in = in;
    keep->camera = camera;
    keep->extras = extras;
    keep->slots = number_slots(team, scene);
    keep->scene = std::move(scene);
  }
  out.blend_ms = clock.lap();
}

// ---- backward --------------------------------------------------------------------------------

struct Losses {
  const fragprune_output_grads& grads;
  float background[3];
  float stop;
  size_t plane;
  const Extras& extras;
};

// One plane of the image into block order; pixels outside the image, and a plane of NULL, are 0.
void load_plane(const Camera<float>& c, const Tile& tile, const float* plane, float* to) {
  const int width = static_cast<int>(c.width), height = static_cast<int>(c.height);
  if (!plane || tile.x + kTile > width || tile.y + kTile > height) std::fill_n(to, kPixels, 0.f);
  if (!plane) return;
  const int wide = std::min(kTile, width - tile.x), high = std::min(kTile, height - tile.y);
  for (int y = 0; y < high; y++) {
    const float* from = plane + static_cast<size_t>(tile.y + y) * width + tile.x;
    for (int x = 0; x < wide; x += kBlockWidth) {
      const int block = y / kBlockHeight * 4 + x / kBlockWidth;
      float* at = to + block * kLanes + y % kBlockHeight * kBlockWidth;
      if (x + kBlockWidth <= wide)
        std::memcpy(at, from + x, kBlockWidth * sizeof *at);
      else
        std::copy(from + x, from + wide, at);
    }
  }
}

// Brings a tile's loss gradients into block order and starts the walk from the last fragment. What
// a pixel's stop left out is taken to look like that fragment.
void load_losses(const Camera<float>& c, const Losses& from, const Splat* splats, const Tile& tile,
                 const TilePixels& kept, LossPixels& to, double* by_background) {
  const int features = from.extras.feature_count;
  const float* image = from.grads.image;
  float alpha[kPixels];
  load_plane(c, tile, image, to.r);
  load_plane(c, tile, image ? image + from.plane : nullptr, to.g);
  load_plane(c, tile, image ? image + 2 * from.plane : nullptr, to.b);
  load_plane(c, tile, from.grads.invdepth, to.inv_z);
  load_plane(c, tile, from.grads.alpha, alpha);
  for (int k = 0; k < features; k++) {
    const float* planes = from.grads.features;
    load_plane(c, tile, planes ? planes + k * from.plane : nullptr, to.features[k]);
  }
  Lanes sums[3] = {};
  for (int i = 0; i < kPixels; i += kLanes) {
    const Lanes light = load(kept.transmittance + i);
    const Lanes r = load(to.r + i), g = load(to.g + i), b = load(to.b + i);
    const Lanes seen = r * broadcast<Lanes>(from.background[0]) +
                       g * broadcast<Lanes>(from.background[1]) +
                       b * broadcast<Lanes>(from.background[2]) - load(alpha + i);
    store(to.light + i, light);
    store(to.behind + i, light * seen);
    sums[0] = sums[0] + light * r, sums[1] = sums[1] + light * g, sums[2] = sums[2] + light * b;
  }
  for (int k = 0; k < 3; k++) by_background[k] = sum(sums[k]);
  for (int i = 0; from.stop > 0 && i < kPixels; i++) {
    if (kept.transmittance[i] >= from.stop || kept.stop[i] == 0) continue;  // 0: outside the image
    const Splat& last = splats[tile.list[kept.stop[i] - 1]];
    const Brush<float>& is = last.brush;
    float shade = to.r[i] * is.r + to.g[i] * is.g + to.b[i] * is.b + to.inv_z[i] * is.inv_z;
    for (int k = 0; k < features; k++)
      shade += to.features[k][i] * from.extras.features[size_t{last.id} * features + k];
    to.behind[i] = kept.transmittance[i] * shade;
  }
}

using UnblendTile = void (*)(const Splat*, const Tile&, const TilePixels&, const CellSlots&,
                             const Asked&, LossPixels&, float*);

template <size_t... kWants>
constexpr std::array<UnblendTile, sizeof...(kWants)> unblenders(std::index_sequence<kWants...>) {
  return {unblend_tile<static_cast<int>(kWants)>...};
}

UnblendTile unblender(int want) {
  static constexpr auto table = unblenders(std::make_index_sequence<16>());
  if (want & kSoft) {
    if (want & kExtra) return unblend_tile<kWholeSoft | kWholeExtra>;
    return want & kDepth ? unblend_tile<kWholeSoft | kDepth> : unblend_tile<kWholeSoft>;
  }
  if (!(want & kExtra)) return table[want];
  return want & kThreshold ? unblend_tile<kWholeExtra | kThreshold> : unblend_tile<kWholeExtra>;
}

PixelSums<Lanes> unpack_sums(const Lanes* v, int want) {
  PixelSums<Lanes> s{};
  s.w = *v++;
  if (want & kThreshold) s.threshold = *v++;
  if (want & kGeometry) s.u = *v++, s.v = *v++, s.uu = *v++, s.uv = *v++, s.vv = *v++;
  if (want & kColour) s.r = *v++, s.g = *v++, s.b = *v++;
  if (want & kDepth && want & kGeometry) s.inv_z = *v++;
  if (want & kExtra) s.absolute = *v++;
  return s;
}

// From the sums over pixels to the inputs.
class Chain {
 public:
  Chain(const fragprune_state& state, const fragprune_input_grads& to, int want)
      : in_(state.in), to_(to), want_(want), c_(lift<Lanes>(state.camera)),
        means_(in_.means, in_.count), scales_(in_.scales, in_.count) {}

  void run(const Picked& who, const PixelSums<Lanes>& sums, const Lanes* features) const {
    who.write<1>(to_.thresholds, &sums.threshold);
    who.write(to_.features, features, in_.feature_count);
    if (to_.opacities) {  // alpha is proportional to it
      Lanes opacity;
      for (int i = 0; i < kLanes; i++) opacity[i] = in_.opacities[who.ids[i]];
      const Lanes by_opacity = sums.w / opacity;
      who.write<1>(to_.opacities, &by_opacity);
    }
    who.write(to_.colors, {sums.r, sums.g, sums.b});
    if (in_.means2d) return footprint(who, sums);
    const bool by_colour = in_.sh && want_ & kColour;
    if (!(want_ & kGeometry) && !by_colour) return;
    Given<Lanes> given;
    given.mean = means_.load(who.ids);
    Vec<Lanes> by_mean = Vec<Lanes>();
    if (by_colour) by_mean = colour(who, given.mean, sums);
    if (want_ & kGeometry) geometry(who, given, by_mean, sums);
  }

 private:
  void hook(const Picked& who, Lanes x, Lanes y, const PixelSums<Lanes>& sums) const {
    const Lanes absolute = in_.absolute_gradient ? sums.absolute : broadcast<Lanes>(0.f);
    who.write(to_.hook, {x * 0.5f * c_.width, y * 0.5f * c_.height, absolute});
  }

  // All that is left of a Gaussian that was given on the image.
  void footprint(const Picked& who, const PixelSums<Lanes>& sums) const {
    if (!(want_ & kGeometry)) return;
    Lanes conic[3], depth;
    for (int i = 0; i < kLanes; i++) {
      for (size_t k = 0; k < 3; k++) conic[k][i] = in_.conics[size_t{3} * who.ids[i] + k];
      depth[i] = in_.depths[who.ids[i]];
    }
    const Square<Lanes> square = square_of(conic[0], conic[1], conic[2]);
    const FootprintGradient<Lanes> g = footprint_gradient(square, sums);
    hook(who, g.x, g.y, sums);
    who.write<2>(to_.means2d, &g.x);
    who.write<3>(to_.conics, &g.xx);
    const Lanes by_depth = -sums.inv_z / (depth * depth);
    who.write<1>(to_.depths, &by_depth);
  }

  // Writes dL/dsh, returns dL/dmean through the direction.
  Vec<Lanes> colour(const Picked& who, const Vec<Lanes>& mean, const PixelSums<Lanes>& sums) const {
    const bool by_direction = to_.means && in_.sh_degree > 0;
    Lanes inv_length;
    const Vec<Lanes> direction = direction_to(c_.centre, mean, inv_length);
    Harmonics<Lanes> h;
    const int terms = harmonics(in_.sh_degree, direction, h, by_direction);
    Coefficients coefficients, by;
    load_coefficients(coefficient_rows(in_), who.ids, terms, coefficients);
    const Vec<Lanes> g =
        through_clamp(raw_colour(h, terms, coefficients), {sums.r, sums.g, sums.b});
    if (to_.sh || to_.sh_rest) {
      for (int k = 0; k < terms; k++) by.set(k, h.value[k] * g);
      store_coefficients(by, terms, who, coefficient_rows(in_, to_));
    }
    if (!by_direction) return Vec<Lanes>();
    return direction_gradient(h, terms, direction, inv_length, g, coefficients);
  }

  void geometry(const Picked& who, Given<Lanes>& given, const Vec<Lanes>& by_mean,
                const PixelSums<Lanes>& sums) const {
    given.factored = in_.cov3d == nullptr;
    if (given.factored) {
      given.scale = scales_.load(who.ids);
      const auto row = [&](int i) { return in_.rotations + 4 * size_t{who.ids[i]}; };
      load_columns(row, given.rotation);
    } else {
      const auto row = [&](int i) { return in_.cov3d + 6 * size_t{who.ids[i]}; };
      load_columns(row, given.cov3d);
      load_columns([&](int i) { return row(i) + 2; }, given.cov3d + 2);
    }
    Projection<Lanes> p;
    project(c_, given, p);
    const ImageGradient<Lanes> g = image_gradient(c_, p, sums);
    hook(who, g.x, g.y, sums);
    Mat3<Lanes> m;
    Vec<Lanes> view = shape_gradient(c_, p, shape_of(c_, given), g, m);
    view.z = view.z - sums.inv_z / (p.view.z * p.view.z);
    who.write(to_.means, by_mean + mean_gradient(c_, given.mean, g, view));
    if (to_.cov3d) {  // an off-diagonal entry stands for two
      const Lanes by[6] = {m.row[0].x, m.row[0].y + m.row[1].x, m.row[0].z + m.row[2].x,
                           m.row[1].y, m.row[1].z + m.row[2].y, m.row[2].z};
      who.write<6>(to_.cov3d, by);
    }
    if (to_.scales) {
      const Mat3<Lanes> r = rotation_of(given.rotation);
      const Vec<Lanes> by_size =
          times(r.row[0], m.row[0]) + times(r.row[1], m.row[1]) + times(r.row[2], m.row[2]);
      who.write(to_.scales, c_.scale_modifier * by_size);
    }
    if (to_.rotations) {
      const Vec<Lanes> size = c_.scale_modifier * given.scale;
      for (Vec<Lanes>& v : m.row) v = times(v, size);
      Lanes by[4];
      rotation_gradient(given.rotation, m, by);
      who.write<4>(to_.rotations, by);
    }
  }

  const fragprune_inputs& in_;
  const fragprune_input_grads& to_;
  const int want_;
  const Camera<Lanes> c_;
  const Triples means_, scales_;
};

// A slot's sums, and what happens to lie behind them.
typedef float Record __attribute__((vector_size(64)));
static_assert(sums_of(15) <= 16 && kMostSums <= 32, "fits a Record, or two");

Record load_record(const float* from) {
  Record r;
  std::memcpy(&r, from, sizeof r);
  return r;
}

// A gradient array and its numbers per Gaussian.
struct GradientRows {
  float* data;
  size_t width;
};

FP_STAGE void backward(const fragprune_state& state, const fragprune_output_grads& grads,
              const fragprune_input_grads& to, int threads) {
  const fragprune_inputs& in = state.in;
  const Scene& scene = state.scene;
  Team team(threads);
  int want = 0;
  if (to.means || to.hook || to.scales || to.rotations || to.cov3d || to.means2d || to.conics ||
      to.depths)
    want |= kGeometry;
  if (to.sh || to.sh_rest || to.colors || (to.means && in.sh && in.sh_degree > 0)) want |= kColour;
  if (to.thresholds) want |= kThreshold;
  if (grads.invdepth) want |= kDepth;
  Extras extras = state.extras;
  extras.feature_count = grads.features || to.features ? in.feature_count : 0;
  if (extras.feature_count || extras.offsets || !in.cap_gradient ||
      (to.hook && in.absolute_gradient))
    want |= kWholeExtra;
  if (softens(in)) want |= kWholeSoft;
  const size_t n = static_cast<size_t>(in.count);
  const ShRows<float> by_sh = coefficient_rows(in, to);
  const GradientRows arrays[] = {
      {by_sh.part[0].rows, by_sh.part[0].width},
      {by_sh.part[1].rows, by_sh.part[1].width},
      {to.means, 3},      {to.hook, 3},       {to.opacities, 1},
      {to.scales, 3},     {to.rotations, 4},  {to.cov3d, 6},
      {to.colors, 3},     {to.features, size_t(in.feature_count)},
      {to.thresholds, 1}, {to.means2d, 2},    {to.conics, 3},
      {to.depths, 1}};
  bool per_gaussian = false;
  for (const GradientRows& rows : arrays) per_gaussian |= rows.data != nullptr;
  const auto clear = [&](size_t begin, size_t end) {  // of Gaussians that draw nothing
    for (const GradientRows& rows : arrays)
      if (rows.data && begin < end)
        std::fill(rows.data + begin * rows.width, rows.data + end * rows.width, 0.f);
  };

  const UnblendTile unblend = unblender(want);
  const int size = sums_of(want) + extras.feature_count;
  const size_t tiles_x = static_cast<size_t>(state.camera.tiles_x), tiles = state.pixels.size();
  const Losses losses{grads,
                      {in.background[0], in.background[1], in.background[2]},
                      in.stop,
                      static_cast<size_t>(in.width) * in.height,
                      extras};
  const float pixels = static_cast<float>(losses.plane);
  const Asked asked{grads.fragments_per_pixel / pixels, in.alpha_max,        in.cap_gradient != 0,
                    extras,                             state.camera.width,  state.camera.height};
  Buffer<float> sums(state.memory, per_gaussian ? state.slots * size + 32 : 0);
  team.each(sums.size(), 1u << 18,
            [&](size_t begin, size_t end) { std::fill(&sums[begin], sums.data() + end, 0.f); });
  Buffer<double> by_background(state.memory, 3 * tiles);
  team.each(state.cells.size(), 1, [&](size_t cell, size_t) {
    const KeptCell& kept = state.cells[cell];
    const size_t row = cell / scene.across, column = cell % scene.across;
    const CellSlots slots{scene, static_cast<uint32_t>(row), static_cast<uint32_t>(column)};
    for (size_t x = column * kCell; x < std::min((column + 1) * kCell, tiles_x); x++) {
      const uint32_t from = kept.first[x % kCell];
      const Tile tile{static_cast<int>(x) * kTile, static_cast<int>(row) * kTile,
                      kept.splat.data() + from, kept.reached.data() + from,
                      static_cast<int>(kept.first[x % kCell + 1] - from)};
      const size_t t = row * tiles_x + x;
      LossPixels loss;
      load_losses(state.camera, losses, scene.splats.data(), tile, state.pixels[t], loss,
                  &by_background[3 * t]);
      if (per_gaussian)
        unblend(scene.splats.data(), tile, state.pixels[t], slots, asked, loss, sums.data());
    }
  });
  if (to.background)
    for (int k = 0; k < 3; k++) {
      double total = 0;
      for (size_t t = 0; t < tiles; t++) total += by_background[3 * t + k];
      to.background[k] = static_cast<float>(total);
    }
  if (!per_gaussian) return;
  const Chain chain(state, to, want);
  team.each(scene.pieces(), 1, [&](size_t piece, size_t) {
    const size_t begin = piece * kPiece, end = begin + scene.count[piece];
    size_t row = begin;  // the first whose gradients are not written yet
    Picked who;
    who.count = 0;
    Lanes total[kMostSums] = {};
    const auto flush = [&] {
      for (int lane = who.count; lane < kLanes; lane++) who.ids[lane] = who.ids[who.count - 1];
      chain.run(who, unpack_sums(total, want), total + sums_of(want));
      who.count = 0;
    };
    for (size_t k = begin; k < end; k++) {
      if (!(scene.splats[k].brush.inv_z > 0)) continue;
      const size_t i = scene.splats[k].id;
      clear(row, i);
      row = i + 1;
      const float* v = sums.data() + scene.slot(k) * size;
      const float* last = v + size_t{scene.reach[k].cells()} * size;
      Record mine = {}, more = {};
      for (; v < last; v += size) {
        mine = mine + load_record(v);
        if (size > 16) more = more + load_record(v + 16);
      }
      for (int s = 0; s < size; s++) total[s][who.count] = s < 16 ? mine[s] : more[s - 16];
      who.ids[who.count++] = static_cast<uint32_t>(i);
      if (who.count == kLanes) flush();
    }
    if (who.count) flush();
    clear(row, std::min(begin + kPiece, n));
  });
}

// ---- what the interface checks ---------------------------------------------------------------

int fail(fragprune_error* error, int status, const char* message) {
  if (error) std::snprintf(error->message, sizeof error->message, "%s", message);
  return status;
}

constexpr const char* kBadThreads = "threads must be 1 to 1024";
constexpr const char* kBadCoefficients = "sh_coefficients must be 0 to 1024";
constexpr const char* kBadCount = "count must be 0 to 2^31 - 1";
constexpr const char* kOtherVersion = "structs of another version of fragprune.h";
constexpr const char* kNotGiven = "a gradient of something that was not given";

bool is_bad_thread_count(int32_t threads) { return threads < 1 || threads > FRAGPRUNE_THREADS_MAX; }

bool is_bad_coefficient_count(int32_t count) {
  return count < 0 || count > FRAGPRUNE_COEFFICIENTS_MAX;
}

// An array that went in: the numbers that it holds and those that will be read.
struct Length {
  const char* name;
  const void* array;
  int64_t held, read;
};

// Refuses where one holds other than what will be read; else FRAGPRUNE_OK.
int check_lengths(std::initializer_list<Length> lengths, fragprune_error* error) {
  for (const Length& each : lengths) {
    const int64_t expected = each.array ? each.read : 0;
    if (each.held == expected) continue;
    char message[sizeof error->message];
    std::snprintf(message, sizeof message, "%s holds %lld numbers where %lld are read", each.name,
                  static_cast<long long>(each.held), static_cast<long long>(expected));
    return fail(error, FRAGPRUNE_BAD_INPUT, message);
  }
  return FRAGPRUNE_OK;
}

#define FP_HELD(array, read) {#array, in.array, in.lengths.array, read}

int check_lengths(const fragprune_inputs& in, fragprune_error* error) {
  const int64_t n = in.count, pixels = int64_t{in.width} * in.height;
  return check_lengths(
      {FP_HELD(viewmatrix, 16), FP_HELD(projmatrix, 16), FP_HELD(campos, 3), FP_HELD(background, 3),
       FP_HELD(means, 3 * n), FP_HELD(opacities, n), FP_HELD(scales, (in.flat ? 2 : 3) * n),
       FP_HELD(rotations, 4 * n), FP_HELD(cov3d, 6 * n),
       FP_HELD(sh, 3 * n * (in.sh_rest ? 1 : in.sh_coefficients)),
       FP_HELD(sh_rest, 3 * n * (in.sh_coefficients - 1)), FP_HELD(colors, 3 * n), FP_HELD(features, n * in.feature_count), FP_HELD(thresholds, n),
       FP_HELD(sample_offsets, 2 * pixels), FP_HELD(means2d, 2 * n), FP_HELD(conics, 3 * n),
       FP_HELD(depths, n), FP_HELD(tiles, 4 * n)},
      error);
}

int check_lengths(const fragprune_spacetime& in, fragprune_error* error) {
  const int64_t n = in.count;
  return check_lengths(
      {FP_HELD(campos, 3), FP_HELD(means, 3 * n), FP_HELD(opacities, n), FP_HELD(times, n),
       FP_HELD(scales, 3 * n), FP_HELD(scales_t, n), FP_HELD(rotations, 4 * n),
       FP_HELD(rotations_r, 4 * n), FP_HELD(cov3d, 6 * n),
       FP_HELD(sh, 3 * n * in.sh_coefficients)},
      error);
}

#undef FP_HELD

const char* footprints_fault_of(const fragprune_inputs* in) {
  if (in->means || in->scales || in->rotations || in->cov3d || in->sh || in->sh_rest)
    return "with means2d, neither means, scales, rotations, cov3d nor sh may be given";
  if (in->count == 0) return nullptr;
  if (!in->conics || !in->depths || !in->tiles || !in->opacities || !in->colors)
    return "with means2d, conics, depths, tiles, opacities and colors are needed";
  if (!in->features != !in->feature_count) return "features and feature_count do not agree";
  return nullptr;
}

const char* splats_fault_of(const fragprune_inputs* in) {
  if (!in->viewmatrix || !in->projmatrix || !in->campos)
    return "viewmatrix, projmatrix and campos are needed";
  if (in->count == 0) return nullptr;
  if (!in->means || !in->opacities) return "means and opacities are needed";
  if (!in->scales != !in->rotations || !in->scales == !in->cov3d)
    return "either scales and rotations or cov3d is needed";
  if (!in->sh == !in->colors) return "either sh or colors is needed";
  if (in->sh_rest && !in->sh) return "sh_rest goes with sh";
  if (in->sh && (in->sh_degree < 0 || in->sh_degree > 3 ||
                 in->sh_coefficients < (in->sh_degree + 1) * (in->sh_degree + 1)))
    return "sh_degree must be 0 to 3, sh_coefficients (sh_degree + 1)^2 or more";
  if (!in->features != !in->feature_count) return "features and feature_count do not agree";
  return nullptr;
}

const char* surfels_fault_of(const fragprune_inputs* in) {
  if (in->count && !in->scales) return "flat Gaussians need scales and rotations";
  if (in->means2d || in->cov3d || in->features || in->sample_offsets || in->absolute_gradient ||
      in->compensation != FRAGPRUNE_NO_COMPENSATION || in->soft)
    return "flat Gaussians take no means2d, cov3d, features, sample_offsets, absolute_gradient, "
           "compensation or soft rim";
  return splats_fault_of(in);
}

const char* fault_of(const fragprune_inputs* in, const fragprune_outputs* out) {
  if (!in || in->size != sizeof *in || !out || out->size != sizeof *out)
    return kOtherVersion;
  if (in->width < 1 || in->height < 1 || in->width > 1 << 16 || in->height > 1 << 16)
    return "width and height must be 1 to 65536 pixels";
  if (in->count < 0 || in->count > INT32_MAX) return kBadCount;
  if (is_bad_thread_count(in->threads)) return kBadThreads;
  if (is_bad_coefficient_count(in->sh_coefficients)) return kBadCoefficients;
  if (!in->background) return "background is needed";
  if (!out->image || (in->count && !out->radii)) return "image and radii are needed";
  if (!(in->near >= 0)) return "near must be 0 or more";
  if (!(in->alpha_max >= static_cast<float>(FRAGPRUNE_ALPHA_MIN) && in->alpha_max <= 1))
    return "alpha_max must be 1/255 to 1";
  if (in->stop != 0 && !(in->stop >= kTransmittanceMin && in->stop <= 1))
    return "stop must be 0, or 1e-4 to 1";
  if (in->stop != 0 && in->alpha_max > static_cast<float>(FRAGPRUNE_STOPPED_ALPHA_MAX))
    return "alpha_max must be at most 0.999 with a stop";
  if (in->compensation < FRAGPRUNE_NO_COMPENSATION || in->compensation > FRAGPRUNE_MIP)
    return "compensation must be one of enum fragprune_compensation";
  if (in->feature_count < 0 || in->feature_count > FRAGPRUNE_FEATURES_MAX)
    return "feature_count must be 0 to 8";
  if (out->features && !in->feature_count) return "features are wanted, but feature_count is 0";
  if (out->surface && !in->flat) return "a surface is wanted, but flat is 0";
  if (in->flat) return surfels_fault_of(in);
  return in->means2d ? footprints_fault_of(in) : splats_fault_of(in);
}

bool wants_absent(const fragprune_inputs& in, const fragprune_input_grads& to) {
  const std::pair<const void*, const void*> pairs[] = {
      {to.means, in.means},   {to.scales, in.scales},     {to.rotations, in.rotations},
      {to.cov3d, in.cov3d},   {to.sh, in.sh},             {to.colors, in.colors},
      {to.sh_rest, in.sh_rest}, {to.means2d, in.means2d}, {to.conics, in.conics},   {to.depths, in.depths},
      {to.features, in.features}, {to.opacities, in.opacities}};
  for (const auto& [wanted, given] : pairs)
    if (wanted && !given && in.count) return true;
  return false;
}

// The largest of |sample_offsets|; NaN where one is none.
float spread_of(const fragprune_inputs& in) {
  float most = 0;
  const size_t count = in.sample_offsets ? size_t{2} * in.width * in.height : 0;
  for (size_t i = 0; i < count; i++) {
    const float size = abs(in.sample_offsets[i]);
    if (!(size <= 1e6f)) return std::nanf("");
    most = max(most, size);
  }
  return most;
}

// Of which kind they are, with what is given for each; see fragprune_spacetime.
bool is_of_a_kind(const fragprune_spacetime& in) {
  if (in.cov3d) return !in.scales && !in.rotations && !in.scales_t && !in.rotations_r;
  if (!in.scales || !in.rotations) return false;
  return in.scales_t ? in.times != nullptr : !in.rotations_r;
}

const char* slice_fault_of(const fragprune_spacetime* in, const fragprune_sliced* sliced) {
  if (!in || in->size != sizeof *in || !sliced || sliced->size != sizeof *sliced)
    return kOtherVersion;
  if (in->count < 0 || in->count > INT32_MAX) return kBadCount;
  if (is_bad_thread_count(in->threads)) return kBadThreads;
  if (is_bad_coefficient_count(in->sh_coefficients)) return kBadCoefficients;
  if (!in->campos) return "campos is needed";
  if (in->count == 0) return nullptr;
  if (!in->means || !in->opacities) return "means and opacities are needed";
  if (!is_of_a_kind(*in))
    return "either cov3d or scales and rotations, scales_t with times, rotations_r with scales_t";
  if (!sliced->present) return "present is needed";
  if (!in->sh) return nullptr;
  if (in->sh_degree < 0 || in->sh_degree > 3 || in->sh_degree_t < -1 || in->sh_degree_t > 2)
    return "sh_degree must be 0 to 3, sh_degree_t -1 to 2";
  const int orders = in->sh_degree == 3 ? std::max(in->sh_degree_t, 0) : 0;
  const int terms = (in->sh_degree + 1) * (in->sh_degree + 1);
  if (in->sh_coefficients < terms + kBands * orders)
    return "sh_coefficients must be what the degrees take, or more";
  if (orders && (!in->times || !(in->duration > 0)))
    return "cosines in use need times and a duration above 0";
  return nullptr;
}

bool wants_absent(const fragprune_spacetime& in, const fragprune_spacetime_grads& to) {
  const std::pair<const void*, const void*> pairs[] = {
      {to.times, in.times},         {to.scales, in.scales},           {to.scales_t, in.scales_t},
      {to.rotations, in.rotations}, {to.rotations_r, in.rotations_r}, {to.cov3d, in.cov3d},
      {to.sh, in.sh}};
  for (const auto& [wanted, given] : pairs)
    if (wanted && !given && in.count) return true;
  return false;
}

const char* fault_of(const fragprune_photometric* images) {
  if (!images || images->size != sizeof *images) return kOtherVersion;
  for (int32_t side : {images->channels, images->height, images->width})
    if (side < 1 || side > 1 << 16) return "channels, height and width must be 1 to 65536";
  if (is_bad_thread_count(images->threads)) return kBadThreads;
  if (!images->image || !images->target) return "image and target are needed";
  return nullptr;
}

template <class Work>
int guarded(fragprune_error* error, Work work) {
  if (error) error->message[0] = 0;
  try {
    work();
    return FRAGPRUNE_OK;
  } catch (const std::bad_alloc&) {
    return fail(error, FRAGPRUNE_OUT_OF_MEMORY, "out of memory");
  } catch (const std::length_error&) {
    return fail(error, FRAGPRUNE_TOO_LARGE, "more than 2^32 entries in the tile lists");
  } catch (const std::exception& e) {
    return fail(error, FRAGPRUNE_FAILED, e.what());
  }
}

}  // namespace
}  // namespace fp

extern "C" {

int fragprune_forward(const fragprune_inputs* inputs, fragprune_outputs* outputs,
                      fragprune_state** state, fragprune_error* error) {
  if (state) *state = nullptr;
  if (const char* fault = fp::fault_of(inputs, outputs))
    return fp::fail(error, FRAGPRUNE_BAD_INPUT, fault);
  if (const int status = fp::check_lengths(*inputs, error)) return status;
  const float spread = fp::spread_of(*inputs);
  if (!(spread >= 0))
    return fp::fail(error, FRAGPRUNE_BAD_INPUT, "sample_offsets must be at most 10^6 pixels");
  return fp::guarded(error, [&] {
    const fp::Memory memory =
        inputs->workspace ? inputs->workspace->memory : std::make_shared<fp::Pool>();
    std::unique_ptr<fragprune_state> keep(state ? new fragprune_state : nullptr);
    if (keep) keep->memory = memory;
    fp::forward(*inputs, spread, *outputs, memory, keep.get());
    if (state) *state = keep.release();
  });
}

int fragprune_backward(const fragprune_state* state, const fragprune_output_grads* output_grads,
                       const fragprune_input_grads* input_grads, int32_t threads,
                       fragprune_error* error) {
  if (!state || !output_grads || output_grads->size != sizeof *output_grads || !input_grads ||
      input_grads->size != sizeof *input_grads)
    return fp::fail(error, FRAGPRUNE_BAD_INPUT, fp::kOtherVersion);
  if (input_grads->thresholds && !(state->in.thresholds && state->in.widen))
    return fp::fail(error, FRAGPRUNE_BAD_INPUT, "the forward pass did not widen for thresholds");
  if (fp::is_bad_thread_count(threads))
    return fp::fail(error, FRAGPRUNE_BAD_INPUT, fp::kBadThreads);
  if (fp::wants_absent(state->in, *input_grads))
    return fp::fail(error, FRAGPRUNE_BAD_INPUT, fp::kNotGiven);
  return fp::guarded(error, [&] {
    if (state->surfels)
      fp::undraw_surfels(*state->surfels, *output_grads, *input_grads, threads);
    else
      fp::backward(*state, *output_grads, *input_grads, threads);
  });
}

void fragprune_free(fragprune_state* state) { delete state; }

int fragprune_slice(const fragprune_spacetime* inputs, const fragprune_sliced* outputs,
                    fragprune_error* error) {
  if (const char* fault = fp::slice_fault_of(inputs, outputs))
    return fp::fail(error, FRAGPRUNE_BAD_INPUT, fault);
  if (const int status = fp::check_lengths(*inputs, error)) return status;
  if (inputs->count && (!outputs->means || !outputs->cov3d || !outputs->opacities ||
                        !inputs->sh != !outputs->colors))
    return fp::fail(error, FRAGPRUNE_BAD_INPUT,
                    "means, cov3d and opacities are needed, and colors where sh is given");
  return fp::guarded(error, [&] {
    const fp::SpacetimeRows rows(*inputs);
    fp::Team(inputs->threads)
        .each(static_cast<size_t>(inputs->count), fp::kPiece, [&](size_t begin, size_t end) {
          fp::slice_rows(rows, *inputs, *outputs, begin, end);
        });
  });
}

int fragprune_unslice(const fragprune_spacetime* inputs, const fragprune_sliced* output_grads,
                      const fragprune_spacetime_grads* input_grads, fragprune_error* error) {
  if (const char* fault = fp::slice_fault_of(inputs, output_grads))
    return fp::fail(error, FRAGPRUNE_BAD_INPUT, fault);
  if (const int status = fp::check_lengths(*inputs, error)) return status;
  if (!input_grads || input_grads->size != sizeof *input_grads)
    return fp::fail(error, FRAGPRUNE_BAD_INPUT, fp::kOtherVersion);
  if (fp::wants_absent(*inputs, *input_grads))
    return fp::fail(error, FRAGPRUNE_BAD_INPUT, fp::kNotGiven);
  return fp::guarded(error, [&] {
    const fp::Unslicer unslicer(*inputs, *output_grads, *input_grads);
    fp::Team(inputs->threads)
        .each(static_cast<size_t>(inputs->count), fp::kPiece,
              [&](size_t begin, size_t end) { unslicer.run(begin, end); });
  });
}

int fragprune_photometric_loss(fragprune_photometric* images, fragprune_error* error) {
  if (const char* fault = fp::fault_of(images))
    return fp::fail(error, FRAGPRUNE_BAD_INPUT, fault);
  return fp::guarded(error, [&] {
    fp::photometric_loss(*images, images->workspace ? images->workspace->memory
                                                    : std::make_shared<fp::Pool>());
  });
}

fragprune_workspace* fragprune_workspace_new(void) {
  try {
    return new fragprune_workspace;
  } catch (const std::bad_alloc&) {
    return nullptr;
  }
}

void fragprune_workspace_free(fragprune_workspace* workspace) { delete workspace; }

void* fragprune_workspace_take(fragprune_workspace* workspace, uint64_t bytes) {
  try {
    return workspace->memory->take(fp::Pool::class_of(bytes));
  } catch (const std::exception&) {
    return nullptr;
  }
}

void fragprune_workspace_give(fragprune_workspace* workspace, void* memory, uint64_t bytes) {
  if (memory) workspace->memory->put(memory, fp::Pool::class_of(bytes));
}

int fragprune_version(void) { return FRAGPRUNE_API_VERSION; }

int fragprune_lanes(void) { return fp::kLanes; }

int fragprune_cpu_features(void) {
  int features = 0;
#if defined(__x86_64__) || defined(__i386__)
  __builtin_cpu_init();
  const bool avx2 = __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") &&
                    __builtin_cpu_supports("bmi") && __builtin_cpu_supports("bmi2");
  if (avx2) features |= FRAGPRUNE_CPU_AVX2;
  if (avx2 && __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq") &&
      __builtin_cpu_supports("avx512vl") && __builtin_cpu_supports("avx512bw"))
    features |= FRAGPRUNE_CPU_AVX512;
#endif
  return features;
}

}  // extern "C"
