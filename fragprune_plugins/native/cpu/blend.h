// Blending one tile, forwards and backwards.
//
// A tile is cut into blocks of 4 columns by kLanes / 4 rows, one pixel per lane. Which Gaussians of
// the tile's list reach which block is found for kLanes Gaussians at once and kept as one bit each.
// Forward goes block by block and keeps the pixels in registers; backward goes Gaussian by Gaussian
// and keeps the Gaussian's sums in registers.
#pragma once

#include "binning.h"

namespace fp {

constexpr int kBlockWidth = 4, kBlockHeight = kLanes / kBlockWidth;
constexpr int kBlockRows = kTile / kBlockHeight, kBlocks = kBlockRows * 4;
constexpr int kPixels = kTile * kTile;
constexpr int kWord = 64;  // Gaussians per word of bits

// What the forward pass leaves for the backward pass, pixels in block order.
struct TilePixels {
  float transmittance[kPixels];  // final
  int32_t stop[kPixels];         // fragments at this place of the list or later are not alive
};

struct Tile {
  int x, y;  // of the first pixel
  const uint32_t* list;
  int length;
};

inline Lanes lane_x() {
  float a[kLanes];
  for (int i = 0; i < kLanes; i++) a[i] = static_cast<float>(i % kBlockWidth);
  return load(a);
}
inline Lanes lane_y() {
  float a[kLanes];
  for (int i = 0; i < kLanes; i++) a[i] = static_cast<float>(i / kBlockWidth);
  return load(a);
}
inline int block_x(int block) { return block % 4 * kBlockWidth; }
inline int block_y(int block) { return block / 4 * kBlockHeight; }

// Ellipses of up to kWord Gaussians, one array per number.
struct EllipseRows {
  alignas(64) float x[kWord], y[kWord], slope[kWord], reach[kWord], half_height[kWord],
      rightmost[kWord], var_along[kWord], inv_down[kWord];
};

// For each block, the bits of the Gaussians that reach it; only the first `count` are meant.
inline void find_blocks(const EllipseRows& e, int count, uint64_t* reached) {
  const Lanes zero = broadcast<Lanes>(0.f), margin = broadcast<Lanes>(kSpanMargin);
  std::memset(reached, 0, kBlocks * sizeof *reached);
  for (int i = 0; i < count; i += kLanes) {
    const Lanes y = load(e.y + i), x = load(e.x + i), slope = load(e.slope + i);
    const Lanes height = load(e.half_height + i), rightmost = load(e.rightmost + i);
    const Lanes reach = load(e.reach + i), var = load(e.var_along + i);
    const Lanes inv_down = load(e.inv_down + i);
    for (int row = 0; row < kBlockRows; row++) {
      const float first = static_cast<float>(row * kBlockHeight);
      const Lanes low = max(broadcast<Lanes>(first) - y, -height);
      const Lanes high = min(broadcast<Lanes>(first + (kBlockHeight - 1)) - y, height);
      const Mask crosses = ge(high, low);
      if (!bits(crosses)) continue;
      const Lanes at_right = min(max(rightmost, low), high);
      const Lanes at_left = min(max(-rightmost, low), high);
      const Lanes in_right = sqrt(max(var * (reach - at_right * at_right * inv_down), zero));
      const Lanes in_left = sqrt(max(var * (reach - at_left * at_left * inv_down), zero));
      const Lanes right = fma(slope, at_right, x) + in_right + margin;
      const Lanes left = fma(slope, at_left, x) - in_left - margin;
      for (int column = 0; column < 4; column++) {
        const float from = static_cast<float>(column * kBlockWidth);
        const Mask hit = both(crosses, both(ge(right, broadcast<Lanes>(from)),
                                            ge(broadcast<Lanes>(from + kBlockWidth - 1), left)));
        reached[row * 4 + column] |= static_cast<uint64_t>(bits(hit)) << i;
      }
    }
  }
  if (count < kWord)
    for (int b = 0; b < kBlocks; b++) reached[b] &= (uint64_t{1} << count) - 1;
}

// Copies a word's worth of Gaussians out of the scene, in coordinates of the tile.
inline void stage(const Splat* splats, const Tile& tile, int first, int count, EllipseRows& e,
                  Brush* brushes) {
  for (int j = 0; j < count; j++) {
    const Splat& s = splats[tile.list[first + j]];
    Brush b = s.brush;
    b.x -= tile.x;
    b.y -= tile.y;
    brushes[j] = b;
    e.x[j] = b.x;
    e.y[j] = b.y;
    e.slope[j] = b.slope;
    e.reach[j] = s.ellipse.reach;
    e.half_height[j] = s.ellipse.half_height;
    e.rightmost[j] = s.ellipse.rightmost;
    e.var_along[j] = s.ellipse.var_along;
    e.inv_down[j] = s.ellipse.inv_down;
  }
}

struct Fragments {
  Lanes u, dy, power;
};
inline Fragments meet(const Brush& b, Lanes px, Lanes py) {
  Fragments f;
  f.dy = py - broadcast<Lanes>(b.y);
  f.u = fma(broadcast<Lanes>(-b.slope), f.dy, px - broadcast<Lanes>(b.x));
  f.power = power_of(f.u, f.dy, broadcast<Lanes>(b.along), broadcast<Lanes>(b.down));
  return f;
}

// ---- forward ---------------------------------------------------------------------------------

struct BlockPixels {
  Lanes light;  // transmittance while alive, then 0
  Lanes final_light;
  Lanes r, g, b, inv_z;
  IntLanes drawn, stop;
  bool alive;
};

struct TileCounts {
  int64_t drawn = 0, evaluated = 0;
};

// Blends the Gaussians in `todo`, front to back, into one block.
template <bool kCountEach>
inline int blend_block(const Brush* brushes, uint64_t todo, int first, Lanes px, Lanes py,
                       BlockPixels& pixels, int32_t* drawn_each) {
  const Lanes floor = broadcast<Lanes>(kTransmittanceMin), one = broadcast<Lanes>(1.f);
  BlockPixels p = pixels;
  int evaluated = 0;
  while (todo) {
    const int j = __builtin_ctzll(todo);
    todo &= todo - 1;
    evaluated++;
    const Brush& b = brushes[j];
    const Fragments f = meet(b, px, py);
    const Mask inside = ge(f.power, broadcast<Lanes>(b.cut));
    const Lanes alpha = where(inside, alpha_of(exp2(f.power), broadcast<Lanes>(b.opacity)));
    const Lanes after = p.light * (one - alpha);
    const Mask alive = ge(after, floor);
    const Lanes weight = where(alive, alpha * p.light);
    p.light = where(alive, after);
    p.final_light = select(alive, after, p.final_light);
    p.stop = select(alive, broadcast_int(first + j + 1), p.stop);
    const Mask drawn = both(inside, alive);
    p.drawn = increment(drawn, p.drawn);
    p.r = fma(weight, broadcast<Lanes>(b.r), p.r);
    p.g = fma(weight, broadcast<Lanes>(b.g), p.g);
    p.b = fma(weight, broadcast<Lanes>(b.b), p.b);
    p.inv_z = fma(weight, broadcast<Lanes>(b.inv_z), p.inv_z);
    if (kCountEach) drawn_each[j] += __builtin_popcount(bits(drawn));
    if (!bits(alive)) {
      p.alive = false;
      break;
    }
  }
  pixels = p;
  return evaluated;
}

struct Canvas {
  int width, height;
  float background[3];
  float *image, *invdepth, *alpha;
  int32_t* fragments;
};

inline void paint_block(const Canvas& c, int x0, int y0, const BlockPixels& p) {
  float planes[5][kLanes];
  int32_t drawn[kLanes];
  store(planes[0], fma(p.final_light, broadcast<Lanes>(c.background[0]), p.r));
  store(planes[1], fma(p.final_light, broadcast<Lanes>(c.background[1]), p.g));
  store(planes[2], fma(p.final_light, broadcast<Lanes>(c.background[2]), p.b));
  store(planes[3], p.inv_z);
  store(planes[4], broadcast<Lanes>(1.f) - p.final_light);
  store(drawn, p.drawn);
  const int wide = std::min(kBlockWidth, c.width - x0);
  const int high = std::min(kBlockHeight, c.height - y0);
  const size_t plane = static_cast<size_t>(c.width) * c.height;
  for (int y = 0; y < high; y++) {
    const size_t at = static_cast<size_t>(y0 + y) * c.width + x0;
    const int from = y * kBlockWidth;
    for (int x = 0; x < wide; x++) {
      for (int k = 0; k < 3; k++) c.image[k * plane + at + x] = planes[k][from + x];
      if (c.invdepth) c.invdepth[at + x] = planes[3][from + x];
      if (c.alpha) c.alpha[at + x] = planes[4][from + x];
      if (c.fragments) c.fragments[at + x] = drawn[from + x];
    }
  }
}

// Lanes whose pixel lies in the image: all ones, the others 0.
inline Lanes in_image(const Canvas& c, int x0, int y0) {
  float a[kLanes];
  for (int i = 0; i < kLanes; i++)
    a[i] = x0 + i % kBlockWidth < c.width && y0 + i / kBlockWidth < c.height ? 1.f : 0.f;
  return load(a);
}

// `reached` (kept for the backward pass) and `drawn_each` (per list entry) may be NULL.
template <bool kCountEach>
inline TileCounts blend_tile(const Splat* splats, const Tile& tile, const Canvas& canvas,
                             TilePixels* keep, uint64_t* reached, int32_t* drawn_each) {
  BlockPixels blocks[kBlocks];
  const Lanes zero = broadcast<Lanes>(0.f), lx = lane_x(), ly = lane_y();
  int alive = 0;
  for (int b = 0; b < kBlocks; b++) {
    const Lanes inside = in_image(canvas, tile.x + block_x(b), tile.y + block_y(b));
    blocks[b] = {inside, inside, zero, zero, zero, zero, broadcast_int(0), broadcast_int(0),
                 bits(ge(inside, broadcast<Lanes>(1.f))) != 0};
    alive += blocks[b].alive;
  }
  TileCounts counts;
  Brush brushes[kWord];
  EllipseRows rows;
  uint64_t scratch[kBlocks];
  for (int first = 0; first < tile.length && alive; first += kWord) {
    const int count = std::min(kWord, tile.length - first);
    uint64_t* word = reached ? reached + static_cast<size_t>(first) / kWord * kBlocks : scratch;
    stage(splats, tile, first, count, rows, brushes);
    find_blocks(rows, count, word);
    for (int b = 0; b < kBlocks; b++) {
      if (!blocks[b].alive || !word[b]) continue;
      const Lanes px = lx + broadcast<Lanes>(static_cast<float>(block_x(b)));
      const Lanes py = ly + broadcast<Lanes>(static_cast<float>(block_y(b)));
      counts.evaluated +=
          kLanes * blend_block<kCountEach>(brushes, word[b], first, px, py, blocks[b],
                                           kCountEach ? drawn_each + first : nullptr);
      alive -= !blocks[b].alive;
    }
  }
  for (int b = 0; b < kBlocks; b++) {
    paint_block(canvas, tile.x + block_x(b), tile.y + block_y(b), blocks[b]);
    int32_t drawn[kLanes];
    store(drawn, blocks[b].drawn);
    for (int i = 0; i < kLanes; i++) counts.drawn += drawn[i];
    if (keep) {
      store(keep->transmittance + b * kLanes, blocks[b].final_light);
      store(keep->stop + b * kLanes, blocks[b].stop);
    }
  }
  return counts;
}

// ---- backward --------------------------------------------------------------------------------

// What is wanted of the backward pass; each part that is not costs nothing.
enum Want { kGeometry = 1, kColour = 2, kThreshold = 4, kDepth = 8 };

// Sums written per list entry, in this order, those that are wanted only.
constexpr int sums_of(int want) {
  return 1 + (want & kThreshold ? 1 : 0) + (want & kGeometry ? 5 : 0) + (want & kColour ? 3 : 0) +
         (want & kDepth && want & kGeometry ? 1 : 0);
}

struct LossPixels {  // block order
  alignas(64) float r[kPixels], g[kPixels], b[kPixels], inv_z[kPixels];
  alignas(64) float light[kPixels];   // transmittance behind the fragment in hand
  alignas(64) float behind[kPixels];  // gradient of all that lies behind it, weighted
};

struct RimLoss {
  const float* thresholds;    // per row of the inputs
  float per_fragment;         // dL/d(fragment)
};

// One fragment of each lane, back to front. Skipped fragments leave light and behind untouched.
template <int kWant>
inline void unblend_block(const Brush& brush, float threshold, float per_fragment, int position,
                          Lanes px, Lanes py, const int32_t* stops, int at, LossPixels& loss,
                          Lanes* sums) {
  const Fragments f = meet(brush, px, py);
  const Mask reached = both(ge(f.power, broadcast<Lanes>(brush.list_cut)),
                            gt(load(stops + at), broadcast_int(position)));
  if (!bits(reached)) return;
  const Mask drawn =
      kWant & kThreshold ? both(reached, ge(f.power, broadcast<Lanes>(brush.cut))) : reached;
  const Lanes opacity = broadcast<Lanes>(brush.opacity), one = broadcast<Lanes>(1.f);
  const Lanes falloff = exp2(f.power);
  const Lanes full = alpha_of(falloff, opacity);
  const Lanes alpha = where(drawn, full);
  const Lanes inv = one / (one - alpha);
  const Lanes light = load(loss.light + at) * inv;
  const Lanes behind = load(loss.behind + at);
  const Lanes gr = load(loss.r + at), gg = load(loss.g + at), gb = load(loss.b + at);
  Lanes shade = fma(gb, broadcast<Lanes>(brush.b),
                    fma(gg, broadcast<Lanes>(brush.g), gr * broadcast<Lanes>(brush.r)));
  Lanes gz;
  if (kWant & kDepth) {
    gz = load(loss.inv_z + at);
    shade = fma(gz, broadcast<Lanes>(brush.inv_z), shade);
  }
  const Lanes weight = alpha * light;
  const Lanes by_alpha = fma(light, shade, -(behind * inv));
  store(loss.light + at, light);
  store(loss.behind + at, fma(weight, shade, behind));
  const Lanes by_opacity = where(drawn, falloff * by_alpha);  // straight through the cap
  int k = 0;
  sums[k] = sums[k] + by_opacity, k++;
  if (kWant & kThreshold) {
    const Lanes away = abs(falloff - broadcast<Lanes>(threshold));
    const Mask near = both(reached, ge(broadcast<Lanes>(kRimHorizon), away));
    if (bits(near)) {
      const Lanes density = rim_density(falloff, broadcast<Lanes>(threshold));
      const Lanes gain = fma(full, by_alpha, broadcast<Lanes>(per_fragment));
      sums[k] = sums[k] - where(near, gain * density);
    }
    k++;
  }
  if (kWant & kGeometry) {
    const Lanes v = by_opacity * opacity;
    const Lanes vu = v * f.u, vy = v * f.dy;
    sums[k] = sums[k] + vu, k++;
    sums[k] = sums[k] + vy, k++;
    sums[k] = fma(vu, f.u, sums[k]), k++;
    sums[k] = fma(vu, f.dy, sums[k]), k++;
    sums[k] = fma(vy, f.dy, sums[k]), k++;
  }
  if (kWant & kColour) {
    sums[k] = fma(weight, gr, sums[k]), k++;
    sums[k] = fma(weight, gg, sums[k]), k++;
    sums[k] = fma(weight, gb, sums[k]), k++;
  }
  if (kWant & kDepth && kWant & kGeometry) sums[k] = fma(weight, gz, sums[k]), k++;
}

// Turns one word of bits per block into one word of blocks per Gaussian, leaving out what lies
// behind every pixel of its block.
inline void transpose_bits(const uint64_t* reached, const int32_t* last_stop, int first,
                           uint64_t* blocks_of) {
  std::memset(blocks_of, 0, kWord * sizeof *blocks_of);
  for (int b = 0; b < kBlocks; b++) {
    const int limit = last_stop[b] - first;
    if (limit <= 0) continue;
    uint64_t word = reached[b];
    if (limit < kWord) word &= (uint64_t{1} << limit) - 1;
    for (; word; word &= word - 1) blocks_of[__builtin_ctzll(word)] |= uint64_t{1} << b;
  }
}

// Writes sums_of(kWant) numbers per entry of the list at `out + slot * sums_of(kWant)`.
template <int kWant>
inline void unblend_tile(const Splat* splats, const Tile& tile, const TilePixels& kept,
                         const uint64_t* reached, const uint32_t* slots, const RimLoss& rim,
                         LossPixels& loss, float* out) {
  constexpr int n = sums_of(kWant);
  const Lanes lx = lane_x(), ly = lane_y();
  int32_t last_stop[kBlocks], end = 0;
  for (int b = 0; b < kBlocks; b++) {
    last_stop[b] = *std::max_element(kept.stop + b * kLanes, kept.stop + (b + 1) * kLanes);
    end = std::max(end, last_stop[b]);
  }
  const auto place = [&](int position) { return out + static_cast<size_t>(slots[position]) * n; };
  for (int i = end; i < tile.length; i++) std::fill_n(place(i), n, 0.f);
  uint64_t blocks_of[kWord];
  for (int first = (end - 1) / kWord * kWord; first >= 0 && end > 0; first -= kWord) {
    transpose_bits(reached + static_cast<size_t>(first) / kWord * kBlocks, last_stop, first,
                   blocks_of);
    for (int j = std::min(kWord, end - first) - 1; j >= 0; j--) {
      uint64_t todo = blocks_of[j];
      if (!todo) {
        std::fill_n(place(first + j), n, 0.f);
        continue;
      }
      const Splat& s = splats[tile.list[first + j]];
      Brush brush = s.brush;
      brush.x -= tile.x;
      brush.y -= tile.y;
      const float threshold = kWant & kThreshold ? rim.thresholds[s.id] : 0;
      Lanes sums[n];
      for (Lanes& v : sums) v = broadcast<Lanes>(0.f);
      for (; todo; todo &= todo - 1) {
        const int b = __builtin_ctzll(todo);
        unblend_block<kWant>(brush, threshold, rim.per_fragment, first + j,
                             lx + broadcast<Lanes>(static_cast<float>(block_x(b))),
                             ly + broadcast<Lanes>(static_cast<float>(block_y(b))), kept.stop,
                             b * kLanes, loss, sums);
      }
      float* to = place(first + j);
      for (int k = 0; k < n; k++) to[k] = sum(sums[k]);
    }
  }
}

}  // namespace fp
