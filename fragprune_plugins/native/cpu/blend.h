// Blending one tile, forwards and backwards.
//
// A tile is cut into blocks of 4 columns by kLanes / 4 rows, one pixel per lane. Which Gaussians of
// the tile's list reach which block is found for kLanes Gaussians at once and kept as one bit each.
// Forward goes block by block and keeps the pixels in registers; backward goes Gaussian by Gaussian
// and keeps the Gaussian's sums in registers.
#pragma once

#include <cstring>
#include <optional>
#include <vector>

#include "projection.h"

namespace fp {

constexpr int kBlockWidth = 4, kBlockHeight = kLanes / kBlockWidth;
constexpr int kBlockRows = kTile / kBlockHeight, kBlocks = kBlockRows * 4;
constexpr int kPixels = kTile * kTile;
constexpr int kWord = 64;    // Gaussians per word of bits
constexpr int kBatch = 256;  // Gaussians staged at once
constexpr int kAhead = 16;   // Gaussians; far enough to hide a miss of the caches

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

// Up to kBatch Gaussians in coordinates of a tile, one array per number.
struct Batch {
  alignas(64) float scale[kBatch], skew[kBatch], u0[kBatch], down[kBatch], v0[kBatch],
      log_opacity[kBatch], cut[kBatch], r[kBatch], g[kBatch], b[kBatch], inv_z[kBatch];

  LocalBrush<float> operator[](int j) const {
    return {scale[j], skew[j], u0[j], down[j], v0[j], log_opacity[j],
            cut[j],   r[j],    g[j],  b[j],    inv_z[j]};
  }
};

// Copies kLanes Gaussians of the list out of the scene; beyond its end, the last one again.
// `list_cut` is as in Brush; returns the mean in coordinates of the tile, too.
inline Brush<Lanes> stage(const Splat* splats, const Tile& tile, int first, int at, Batch& to) {
  const int last = tile.length - 1;
  const auto splat = [&](int i) {
    return reinterpret_cast<const float*>(splats + tile.list[std::min(first + i, last)]);
  };
  for (int i = 0; i < kLanes; i++) __builtin_prefetch(splat(i + kAhead));
  Lanes v[12];
  load_columns(splat, v);
  load_columns([&](int i) { return splat(i) + 4; }, v + 4);
  load_columns([&](int i) { return splat(i) + 8; }, v + 8);
  Brush<Lanes> b = {v[0], v[1], v[2], v[3], v[4], v[5], v[6], v[7], v[8], v[9], v[10], v[11]};
  const Lanes x = broadcast<Lanes>(static_cast<float>(tile.x));
  const Lanes y = broadcast<Lanes>(static_cast<float>(tile.y));
  const LocalBrush<Lanes> local = localize(b, x, y);
  store(to.scale + at, local.scale), store(to.skew + at, local.skew), store(to.u0 + at, local.u0);
  store(to.down + at, local.down), store(to.v0 + at, local.v0);
  store(to.log_opacity + at, local.log_opacity), store(to.cut + at, local.cut);
  store(to.r + at, local.r), store(to.g + at, local.g), store(to.b + at, local.b);
  store(to.inv_z + at, local.inv_z);
  b.x = b.x - x, b.y = b.y - y;
  return b;
}

// Sets bit i + lane of each block that a lane's Gaussian reaches. Pixels are sampled up to `spread`
// from their centres.
inline void find_blocks(const Brush<Lanes>& b, float spread, int i, uint64_t* reached) {
  const Lanes one = broadcast<Lanes>(1.f), away = broadcast<Lanes>(spread);
  const Ellipse<Lanes> e = ellipse_of(b.scale, b.skew, b.down, b.log_opacity - b.list_cut, away);
  const Lanes top = ceil(b.y - e.half_height), bottom = floor(b.y + e.half_height);
  const Lanes above = b.y - away, below = b.y + away;
  for (int row = 0; row < kBlockRows; row++) {
    const float first = static_cast<float>(row * kBlockHeight);
    const Lanes low = max(broadcast<Lanes>(first), top);
    const Lanes high = min(broadcast<Lanes>(first + (kBlockHeight - 1)), bottom);
    const Mask crosses = ge(high, low);
    if (!bits(crosses)) continue;
    const Lanes right = floor(b.x + span_end(e, low - below, high - above, one));
    const Lanes left = ceil(b.x + span_end(e, low - below, high - above, -one));
    const Mask some = both(crosses, ge(right, left));
    for (int column = 0; column < 4; column++) {
      const float from = static_cast<float>(column * kBlockWidth);
      const Mask hit = both(some, both(ge(right, broadcast<Lanes>(from)),
                                       ge(broadcast<Lanes>(from + kBlockWidth - 1), left)));
      reached[row * 4 + column] |= static_cast<uint64_t>(bits(hit)) << i;
    }
  }
}

// Stages a word's worth of the list and finds its blocks' bits.
inline void stage_word(const Splat* splats, const Tile& tile, float spread, int first, int at,
                       Batch& batch, uint64_t* reached) {
  std::memset(reached, 0, kBlocks * sizeof *reached);
  const int count = std::min(kWord, tile.length - first);
  for (int i = 0; i < count; i += kLanes)
    find_blocks(stage(splats, tile, first + i, at + i, batch), spread, i, reached);
  if (count < kWord)
    for (int b = 0; b < kBlocks; b++) reached[b] &= (uint64_t{1} << count) - 1;
}

// ---- forward ---------------------------------------------------------------------------------

struct BlockPixels {
  Lanes light;        // transmittance as if pixels never stopped: below the stop, it stays there
  Lanes final_light;  // transmittance at the stop
  Lanes r, g, b, inv_z;
  IntLanes drawn, stop;
  bool alive;
};

struct TileCounts {
  int64_t drawn = 0, evaluated = 0;
};

// What some dialects want beyond the picture: more channels, samples beside the centres, scores.
struct Extras {
  const float* offsets;   // (H, W, 2); or NULL
  const float* features;  // (N, feature_count)
  int feature_count;
  bool counts, scores;    // of each Gaussian

  bool any() const { return offsets || feature_count || counts || scores; }
};

// Where the pixels of each block are sampled, from the tile's first pixel.
struct Samples {
  Lanes x[kBlocks], y[kBlocks];

  Samples(const Tile& tile, int width, int height, const float* offsets) {
    for (int b = 0; b < kBlocks; b++) {
      x[b] = lane_x() + broadcast<Lanes>(static_cast<float>(block_x(b)));
      y[b] = lane_y() + broadcast<Lanes>(static_cast<float>(block_y(b)));
      for (int i = 0; offsets && i < kLanes; i++) {
        const int column = tile.x + block_x(b) + i % kBlockWidth;
        const int row = tile.y + block_y(b) + i / kBlockWidth;
        if (column >= width || row >= height) continue;
        const float* at = offsets + 2 * (static_cast<size_t>(row) * width + column);
        x[b][i] += at[0], y[b][i] += at[1];
      }
    }
  }
};

// Of each place of a tile's list: what its Gaussian drew there.
struct EachDrawn {
  std::vector<int32_t> fragments;
  std::vector<float> weight;
};

// The extras' part of a block, and what it shares with its tile.
struct ExtraPixels {
  Lanes features[FRAGPRUNE_FEATURES_MAX];
  Lanes most;       // weight
  IntLanes winner;  // place in the list

  void clear() {
    for (Lanes& v : features) v = broadcast<Lanes>(0.f);
    most = broadcast<Lanes>(0.f);
    winner = broadcast_int(-1);
  }

  // One Gaussian, `row` its features, at a place of the list.
  void blend(const Extras& extras, const float* row, int place, Lanes weight, Mask drawn,
             EachDrawn& each) {
    for (int k = 0; k < extras.feature_count; k++)
      features[k] = fma(weight, broadcast<Lanes>(row[k]), features[k]);
    if (extras.counts) each.fragments[place] += __builtin_popcount(bits(drawn));
    if (extras.scores) {
      winner = select(gt(weight, most), broadcast_int(place), winner);
      most = max(weight, most);
      each.weight[place] += sum(weight);
    }
  }
};

// A tile's extras while it is being blended.
struct ExtraTile {
  const Extras& extras;
  const Samples samples;
  ExtraPixels blocks[kBlocks];
  EachDrawn each;

  ExtraTile(const Extras& e, const Tile& tile, int width, int height)
      : extras(e), samples(tile, width, height, e.offsets) {
    for (ExtraPixels& block : blocks) block.clear();
    if (extras.counts) each.fragments.resize(tile.length);
    if (extras.scores) each.weight.resize(tile.length);
  }
  const float* row(const Splat* splats, const Tile& tile, int place) const {
    if (!extras.feature_count) return nullptr;
    return extras.features + size_t{splats[tile.list[place]].id} * extras.feature_count;
  }
};

// Blends a batch, front to back, into one block: the Gaussians whose bit is set in words[0],
// words[kBlocks], ... and each of them also by `also(j, weight, drawn)`. Returns how many it met.
// (Local copies of the pixels, one by one: a struct would be copied in small pieces, which stalls
// the loads that follow.)
template <class Also>
inline int blend_block(const Batch& batch, const uint64_t* words, int count, int first, Lanes px,
                       Lanes py, float alpha_max, BlockPixels& pixels, Also also) {
  const Lanes floor = broadcast<Lanes>(kTransmittanceMin);
  const Lanes tiny = broadcast<Lanes>(1e-30f);  // no denormal numbers: they are slow
  Lanes light = pixels.light, final_light = pixels.final_light;
  Lanes r = pixels.r, g = pixels.g, blue = pixels.b, inv_z = pixels.inv_z;
  IntLanes drawn_count = pixels.drawn, stop = pixels.stop;
  int met = 0;
  for (int base = 0; base < count && pixels.alive; base += kWord, words += kBlocks) {
    for (uint64_t todo = *words; todo; todo &= todo - 1) {
      const int j = base + __builtin_ctzll(todo);
      const LocalBrush<float> b = batch[j];
      met++;
      const Lanes exponent = meet(b, px, py).exponent;
      const Mask inside = ge(exponent, broadcast<Lanes>(b.cut));
      const Lanes alpha = where(inside, capped(exp2(exponent), alpha_max));
      const Lanes after = fnma(light, alpha, light);
      const Mask alive = ge(after, floor);
      const Lanes weight = where(alive, alpha * light);
      light = max(after, tiny);
      final_light = select(alive, after, final_light);
      stop = select(alive, broadcast_int(first + j + 1), stop);
      const Mask drawn = both(inside, alive);
      drawn_count = increment(drawn, drawn_count);
      r = fma(weight, broadcast<Lanes>(b.r), r);
      g = fma(weight, broadcast<Lanes>(b.g), g);
      blue = fma(weight, broadcast<Lanes>(b.b), blue);
      inv_z = fma(weight, broadcast<Lanes>(b.inv_z), inv_z);
      also(j, weight, drawn);
      if (!bits(alive)) {
        pixels.alive = false;
        break;
      }
    }
  }
  pixels.light = light, pixels.final_light = final_light;
  pixels.r = r, pixels.g = g, pixels.b = blue, pixels.inv_z = inv_z;
  pixels.drawn = drawn_count, pixels.stop = stop;
  return met;
}

struct Canvas {
  int width, height;
  float background[3];
  float spread, alpha_max;
  float *image, *invdepth, *alpha, *features;
  int32_t *fragments, *winners;
};

// One number per pixel of a block, from block order to rows of the image.
template <class T>
inline void paint_plane(T* plane, int width, int x0, int y0, int wide, int high, const T* from) {
  if (!plane) return;
  for (int y = 0; y < high; y++) {
    T* to = plane + static_cast<size_t>(y0 + y) * width + x0;
    if (wide == kBlockWidth)
      std::memcpy(to, from + y * kBlockWidth, kBlockWidth * sizeof *to);
    else
      for (int x = 0; x < wide; x++) to[x] = from[y * kBlockWidth + x];
  }
}

inline void paint_block(const Canvas& c, int x0, int y0, const BlockPixels& p) {
  const int wide = std::min(kBlockWidth, c.width - x0);
  const int high = std::min(kBlockHeight, c.height - y0);
  const size_t size = static_cast<size_t>(c.width) * c.height;
  const auto paint = [&](float* plane, Lanes v) {
    float values[kLanes];
    store(values, v);
    paint_plane(plane, c.width, x0, y0, wide, high, values);
  };
  paint(c.image, fma(p.final_light, broadcast<Lanes>(c.background[0]), p.r));
  paint(c.image + size, fma(p.final_light, broadcast<Lanes>(c.background[1]), p.g));
  paint(c.image + 2 * size, fma(p.final_light, broadcast<Lanes>(c.background[2]), p.b));
  paint(c.invdepth, p.inv_z);
  paint(c.alpha, broadcast<Lanes>(1.f) - p.final_light);
  int32_t drawn[kLanes];
  store(drawn, p.drawn);
  paint_plane(c.fragments, c.width, x0, y0, wide, high, drawn);
}

// `row_of` gives the row of the inputs for a place of the tile's list.
template <class RowOf>
inline void paint_extras(const Canvas& c, int x0, int y0, int features, const ExtraPixels& p,
                         RowOf row_of) {
  const int wide = std::min(kBlockWidth, c.width - x0);
  const int high = std::min(kBlockHeight, c.height - y0);
  for (int k = 0; c.features && k < features; k++) {
    float values[kLanes];
    store(values, p.features[k]);
    float* plane = c.features + static_cast<size_t>(k) * c.width * c.height;
    paint_plane(plane, c.width, x0, y0, wide, high, values);
  }
  int32_t winner[kLanes];
  store(winner, p.winner);
  for (int32_t& place : winner) place = place < 0 ? -1 : row_of(place);
  paint_plane(c.winners, c.width, x0, y0, wide, high, winner);
}

// Lanes whose pixel lies in the image: all ones, the others 0.
inline Lanes in_image(const Canvas& c, int x0, int y0) {
  float a[kLanes];
  for (int i = 0; i < kLanes; i++)
    a[i] = x0 + i % kBlockWidth < c.width && y0 + i / kBlockWidth < c.height ? 1.f : 0.f;
  return load(a);
}

// `keep` and `reached`, for the backward pass, may be NULL; `extra` is, unless kExtra.
template <bool kExtra>
inline TileCounts blend_tile(const Splat* splats, const Tile& tile, const Canvas& canvas,
                             TilePixels* keep, uint64_t* reached, ExtraTile* extra) {
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
  Batch batch;
  uint64_t scratch[kBatch / kWord * kBlocks];
  for (int first = 0; first < tile.length && alive; first += kBatch) {
    const int count = std::min(kBatch, tile.length - first);
    uint64_t* words = reached ? reached + static_cast<size_t>(first) / kWord * kBlocks : scratch;
    for (int base = 0; base < count; base += kWord)
      stage_word(splats, tile, canvas.spread, first + base, base, batch,
                 words + base / kWord * kBlocks);
    for (int b = 0; b < kBlocks; b++) {
      if (!blocks[b].alive) continue;
      int met;
      if constexpr (kExtra) {
        const auto also = [&, first](int j, Lanes weight, Mask drawn) {
          const float* row = extra->row(splats, tile, first + j);
          extra->blocks[b].blend(extra->extras, row, first + j, weight, drawn, extra->each);
        };
        met = blend_block(batch, words + b, count, first, extra->samples.x[b], extra->samples.y[b],
                          canvas.alpha_max, blocks[b], also);
      } else {
        const Lanes px = lx + broadcast<Lanes>(static_cast<float>(block_x(b)));
        const Lanes py = ly + broadcast<Lanes>(static_cast<float>(block_y(b)));
        met = blend_block(batch, words + b, count, first, px, py, canvas.alpha_max, blocks[b],
                          [](int, Lanes, Mask) {});
      }
      counts.evaluated += kLanes * met;
      alive -= !blocks[b].alive;
    }
  }
  for (int b = 0; b < kBlocks; b++) {
    paint_block(canvas, tile.x + block_x(b), tile.y + block_y(b), blocks[b]);
    if (kExtra)
      paint_extras(canvas, tile.x + block_x(b), tile.y + block_y(b), extra->extras.feature_count,
                   extra->blocks[b],
                   [&](int place) { return static_cast<int32_t>(splats[tile.list[place]].id); });
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

// What is wanted of the backward pass; each part that is not costs nothing. kExtra, what some
// dialects want, comes with all others but kThreshold.
enum Want { kGeometry = 1, kColour = 2, kThreshold = 4, kDepth = 8, kExtra = 16 };
constexpr int kWholeExtra = kExtra | kGeometry | kColour | kDepth;

// Sums written per list entry, in this order, those that are wanted only; features come after them.
constexpr int sums_of(int want) {
  return 1 + (want & kThreshold ? 1 : 0) + (want & kGeometry ? 5 : 0) + (want & kColour ? 3 : 0) +
         (want & kDepth && want & kGeometry ? 1 : 0) + (want & kExtra ? 1 : 0);
}
constexpr int kMostSums = sums_of(31) + FRAGPRUNE_FEATURES_MAX;

struct LossPixels {  // block order
  alignas(64) float r[kPixels], g[kPixels], b[kPixels], inv_z[kPixels];
  alignas(64) float light[kPixels];   // transmittance behind the fragment in hand
  alignas(64) float behind[kPixels];  // gradient of all that lies behind it, weighted
  alignas(64) float features[FRAGPRUNE_FEATURES_MAX][kPixels];
};

// What one backward pass is asked for beside the sums.
struct Asked {
  float per_fragment;   // dL/d(fragment)
  float alpha_max;
  bool cap_gradient;    // the gradient passes through the cap
  Extras extras;
  float width, height;  // of the image
};

// What the backward pass needs to know of one Gaussian's rim, and of all (here, that it need not be
// read again and again).
struct Rim {
  float list_cut, threshold, inv_opacity;
  float per_fragment, alpha_max;
};

// What kExtra needs of one Gaussian: its features, and factors on w u and w v for |gx| and |gy|.
struct Beyond {
  const float* features;
  float along, across, down;
};

// One fragment of each lane, back to front. Skipped fragments leave light and behind untouched.
template <int kWant>
inline void unblend_block(const LocalBrush<float>& brush, const Rim& rim, const Asked& asked,
                          const Beyond& beyond, int position, Lanes px, Lanes py,
                          const int32_t* stops, int at, LossPixels& loss, Lanes* sums) {
  const Meeting<Lanes> m = meet(brush, px, py);
  const Mask reached = both(ge(m.exponent, broadcast<Lanes>(rim.list_cut)),
                            gt(load(stops + at), broadcast_int(position)));
  if (!bits(reached)) return;
  const Mask drawn =
      kWant & kThreshold ? both(reached, ge(m.exponent, broadcast<Lanes>(brush.cut))) : reached;
  const Lanes one = broadcast<Lanes>(1.f);
  const Lanes uncapped = exp2(m.exponent), full = capped(uncapped, rim.alpha_max);
  const Lanes alpha = where(drawn, full);
  const Lanes inv = reciprocal(one - alpha);
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
  if (kWant & kExtra)
    for (int k = 0; k < asked.extras.feature_count; k++)
      shade = fma(load(loss.features[k] + at), broadcast<Lanes>(beyond.features[k]), shade);
  const Lanes weight = alpha * light;
  const Lanes by_alpha = fnma(behind, inv, light * shade);
  store(loss.light + at, light);
  store(loss.behind + at, fma(weight, shade, behind));
  Lanes w = where(drawn, uncapped * by_alpha);  // straight through the cap
  if (kWant & kExtra && !asked.cap_gradient)
    w = where(ge(broadcast<Lanes>(rim.alpha_max), uncapped), w);
  int k = 0;
  sums[k] = sums[k] + w, k++;
  if (kWant & kThreshold) {
    const Lanes falloff = uncapped * broadcast<Lanes>(rim.inv_opacity);
    const Lanes away = abs(falloff - broadcast<Lanes>(rim.threshold));
    const Mask near = both(reached, ge(broadcast<Lanes>(kRimHorizon), away));
    if (bits(near)) {
      const Lanes gain = fma(full, by_alpha, broadcast<Lanes>(rim.per_fragment));
      sums[k] = sums[k] - where(near, gain * rim_density(away));
    }
    k++;
  }
  if (kWant & kGeometry) {
    const Lanes wu = w * m.u, wv = w * m.v;
    sums[k] = sums[k] + wu, k++;
    sums[k] = sums[k] + wv, k++;
    sums[k] = fma(wu, m.u, sums[k]), k++;
    sums[k] = fma(wu, m.v, sums[k]), k++;
    sums[k] = fma(wv, m.v, sums[k]), k++;
  }
  if (kWant & kColour) {
    sums[k] = fma(weight, gr, sums[k]), k++;
    sums[k] = fma(weight, gg, sums[k]), k++;
    sums[k] = fma(weight, gb, sums[k]), k++;
  }
  if (kWant & kDepth && kWant & kGeometry) sums[k] = fma(weight, gz, sums[k]), k++;
  if (kWant & kExtra) {
    const Lanes wu = w * m.u, wv = w * m.v;
    const Lanes gx = broadcast<Lanes>(beyond.along) * wu;
    const Lanes gy = fma(broadcast<Lanes>(beyond.across), wu, broadcast<Lanes>(beyond.down) * wv);
    sums[k] = sums[k] + abs(gx) + abs(gy), k++;
    for (int f = 0; f < asked.extras.feature_count; f++, k++)
      sums[k] = fma(weight, load(loss.features[f] + at), sums[k]);
  }
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

// Writes sums_of(kWant) numbers and the features' per entry of the list, at `out` + slot times their
// number.
template <int kWant>
inline void unblend_tile(const Splat* splats, const Tile& tile, const TilePixels& kept,
                         const uint64_t* reached, const uint32_t* slots, const Asked& asked,
                         LossPixels& loss, float* out) {
  constexpr int base = sums_of(kWant), most = kWant & kExtra ? kMostSums : base;
  const int n = kWant & kExtra ? base + asked.extras.feature_count : base;
  Lanes xs[4], ys[kBlockRows];  // of each column and row of blocks
  for (int b = 0; b < 4; b++)
    xs[b] = lane_x() + broadcast<Lanes>(static_cast<float>(block_x(b)));
  for (int b = 0; b < kBlockRows; b++)
    ys[b] = lane_y() + broadcast<Lanes>(static_cast<float>(block_y(4 * b)));
  std::optional<Samples> samples;
  if (kWant & kExtra)
    samples.emplace(tile, static_cast<int>(asked.width), static_cast<int>(asked.height),
                    asked.extras.offsets);
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
      if (first + j >= kAhead) __builtin_prefetch(&splats[tile.list[first + j - kAhead]]);
      const Splat& s = splats[tile.list[first + j]];
      const LocalBrush<float> brush =
          localize(s.brush, static_cast<float>(tile.x), static_cast<float>(tile.y));
      const Rim rim = {s.brush.list_cut, s.threshold, s.inv_opacity, asked.per_fragment,
                       asked.alpha_max};
      Beyond beyond = {};
      if (kWant & kExtra) {  // dL/dx = w u times the first, and so on
        const float x = asked.width / kLog2E, y = asked.height / kLog2E;
        beyond = {asked.extras.features + size_t{s.id} * asked.extras.feature_count,
                  x * brush.scale, y * brush.skew, y * brush.down};
      }
      Lanes sums[most];
      for (Lanes& v : sums) v = broadcast<Lanes>(0.f);
      for (; todo; todo &= todo - 1) {
        const int b = __builtin_ctzll(todo);
        unblend_block<kWant>(brush, rim, asked, beyond, first + j,
                             kWant & kExtra ? samples->x[b] : xs[b % 4],
                             kWant & kExtra ? samples->y[b] : ys[b / 4], kept.stop, b * kLanes,
                             loss, sums);
      }
      float* to = place(first + j);
      if (!(kWant & kExtra)) {
        sum_each<base>(sums, to);
      } else {
        float all[most];
        sum_each<most>(sums, all);
        std::copy(all, all + n, to);
      }
    }
  }
}

}  // namespace fp
