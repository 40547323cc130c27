// Blending one tile, forwards and backwards.
//
// Forward collects what reaches the tile, kBatch Gaussians at a time, and goes block by block, the
// pixels in registers; backward goes Gaussian by Gaussian, its sums in registers.
#pragma once

#include <cstring>
#include <optional>
#include <type_traits>
#include <vector>

#include "binning.h"

namespace fp {

constexpr int kPixels = kTile * kTile;
constexpr int kWord = 64;        // Gaussians per word of bits
constexpr int kInFlight = 4;     // Gaussians that one block blends at once
constexpr int kNobody = kBatch;  // place of a Gaussian that reaches nothing
constexpr int kAhead = 16;       // Gaussians; far enough to hide a miss of the caches

// What the forward pass leaves for the backward pass, pixels in block order.
struct TilePixels {
  float transmittance[kPixels];  // final
  int32_t stop[kPixels];         // fragments at this place of the list or later are not alive
};

struct Tile {
  int x, y;  // of the first pixel
  const uint32_t* list;
  const Blocks* reached;  // by each of the list
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

// Where the pixels of each block lie in their tile.
class BlockCentres {
 public:
  BlockCentres() {
    for (int b = 0; b < 4; b++)
      xs_[b] = lane_x() + broadcast<Lanes>(static_cast<float>(block_x(b)));
    for (int b = 0; b < kBlockRows; b++)
      ys_[b] = lane_y() + broadcast<Lanes>(static_cast<float>(block_y(4 * b)));
  }
  Lanes x(int block) const { return xs_[block % 4]; }
  Lanes y(int block) const { return ys_[block / 4]; }

 private:
  Lanes xs_[4], ys_[kBlockRows];  // of each column and row of blocks
};

// Up to kBatch Gaussians in coordinates of a tile, one array per number.
struct Batch {
  typedef float Numbers[kBatch + 1];
  alignas(64) Numbers scale, skew, u0, down, v0, log_opacity, cut, r, g, b, inv_z;

  Batch() {
    for (float* numbers : {scale, skew, u0, down, v0, log_opacity, r, g, b, inv_z})
      numbers[kNobody] = 0.f;
    cut[kNobody] = 1e30f;
  }
  LocalBrush<float> operator[](int j) const {
    return {scale[j], skew[j], u0[j], down[j], v0[j], log_opacity[j],
            cut[j],   r[j],    g[j],  b[j],    inv_z[j]};
  }

  // Copies `count` coloured Gaussians out of the scene.
  void fill(const Splat* splats, const uint32_t* which, int count, int tile_x, int tile_y) {
    for (int at = 0; at < count; at += kLanes) {
      const auto splat = [&](int i) {
        return reinterpret_cast<const float*>(splats + which[std::min(at + i, count - 1)]);
      };
      Lanes v[8];
      load_columns(splat, v);
      load_columns([&](int i) { return splat(i) + 4; }, v + 4);
      const Lanes none = broadcast<Lanes>(0.f);
      const Brush<Lanes> brush = {v[0], v[1], v[2], v[3], v[4], v[5], v[6], v[7],
                                  none, none, none, none};
      const LocalBrush<Lanes> local =
          localize(brush, broadcast<Lanes>(static_cast<float>(tile_x)),
                   broadcast<Lanes>(static_cast<float>(tile_y)));
      store(scale + at, local.scale), store(skew + at, local.skew), store(u0 + at, local.u0);
      store(down + at, local.down), store(v0 + at, local.v0);
      store(log_opacity + at, local.log_opacity), store(cut + at, local.cut);
    }
    for (int j = 0; j < count; j++) {
      float rgbz[4];
      Colours::get(splats[which[j]], rgbz);
      r[j] = rgbz[0], g[j] = rgbz[1], b[j] = rgbz[2], inv_z[j] = rgbz[3];
    }
  }
};

constexpr int words_of(int count) { return (count + kWord - 1) / kWord; }

// For each block one bit per Gaussian, from one bit per block for each Gaussian.
inline void transpose_bits(const Blocks* reached, int count, uint64_t (*words)[kBlocks]) {
  std::memset(words, 0, static_cast<size_t>(words_of(count)) * sizeof *words);
#if FP_LANES == 8
  for (int j = 0; j < count; j += 32) {
    alignas(32) Blocks mine[32] = {};
    std::copy_n(reached + j, std::min(count - j, 32), mine);
    // byte k of each to plane k: four from each register's halves, then these in order
    const __m256i bytes = _mm256_setr_epi8(0, 4, 8, 12, 1, 5, 9, 13, 2, 6, 10, 14, 3, 7, 11, 15,
                                           0, 4, 8, 12, 1, 5, 9, 13, 2, 6, 10, 14, 3, 7, 11, 15);
    const auto four = [&](int i) {
      const __m256i all = _mm256_load_si256(reinterpret_cast<const __m256i*>(mine + 8 * i));
      return _mm256_shuffle_epi8(all, bytes);
    };
    const __m256i a = four(0), b = four(1), c = four(2), d = four(3);
    const __m256i ab = _mm256_unpacklo_epi32(a, b), cd = _mm256_unpacklo_epi32(c, d);
    const __m256i ab2 = _mm256_unpackhi_epi32(a, b), cd2 = _mm256_unpackhi_epi32(c, d);
    const __m256i planes[4] = {_mm256_unpacklo_epi64(ab, cd), _mm256_unpackhi_epi64(ab, cd),
                               _mm256_unpacklo_epi64(ab2, cd2), _mm256_unpackhi_epi64(ab2, cd2)};
    const __m256i halves = _mm256_setr_epi32(0, 4, 1, 5, 2, 6, 3, 7);
    for (int k = 0; k < 4; k++) {
      __m256i plane = _mm256_permutevar8x32_epi32(planes[k], halves);
      for (int b = 8 * k + 7; b >= 8 * k; b--) {
        const auto found = static_cast<uint32_t>(_mm256_movemask_epi8(plane));
        words[j / kWord][b] |= uint64_t{found} << j % kWord;
        plane = _mm256_add_epi8(plane, plane);
      }
    }
  }
#elif FP_LANES == 16
  for (int j = 0; j < count; j += kLanes) {
    const auto some = static_cast<__mmask16>((1u << std::min(count - j, kLanes)) - 1);
    const __m512i all = _mm512_loadu_si512(reached + j);
    const __m512i mine = _mm512_maskz_mov_epi32(some, all);
    for (int b = 0; b < kBlocks; b++)
      words[j / kWord][b] |= uint64_t{_mm512_test_epi32_mask(mine, _mm512_set1_epi32(1 << b))}
                             << j % kWord;
  }
#else
  for (int j = 0; j < count; j++)
    for (Blocks todo = reached[j]; todo; todo &= todo - 1)
      words[j / kWord][__builtin_ctzll(todo)] |= uint64_t{1} << j % kWord;
#endif
}

// ---- forward ---------------------------------------------------------------------------------

struct BlockPixels {
  Lanes light;  // transmittance; stays what it is once the pixel stopped
  Lanes r, g, b, inv_z;
  IntLanes drawn, stop;
  Mask alive;  // has not stopped, and lies in the image
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
    const BlockCentres centres;
    for (int b = 0; b < kBlocks; b++) {
      x[b] = centres.x(b), y[b] = centres.y(b);
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

  void reset() {
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
    for (ExtraPixels& block : blocks) block.reset();
  }
  void grow(int length) {
    if (extras.counts) each.fragments.resize(length);
    if (extras.scores) each.weight.resize(length);
  }
  const float* row(const Splat& splat) const {
    if (!extras.feature_count) return nullptr;
    return extras.features + size_t{splat.id} * extras.feature_count;
  }
};

// Blends the Gaussians `which` of a batch, front to back, into one block, kInFlight at a time: their
// exponentials do not wait for each other. `which` ends in kNobody. The batch is what the list holds
// from `first` to `end`. Each is handed to `also(j, weight, drawn)`, too. Returns how many it met.
// (Local copies of the pixels, one by one: a struct would be copied in small pieces, which stalls
// the loads that follow.)
template <bool kKeep, bool kDepth, bool kStop, bool kSoft, class Also>
inline int blend_block(const Batch& batch, const int32_t* which, int count, int first, int end,
                       Lanes px, Lanes py, float alpha_max, float line, const BlockPixels& before,
                       BlockPixels& pixels, Also also) {
  const Lanes floor = broadcast<Lanes>(kStop ? line : kTransmittanceMin);
  const Lanes faintest = broadcast<Lanes>(kFaintest), none = broadcast<Lanes>(0.f);
  Lanes light = before.light;
  Lanes r = before.r, g = before.g, blue = before.b, inv_z = before.inv_z;
  IntLanes drawn_count = before.drawn, stop = before.stop;
  Mask alive = before.alive;
  const auto blend = [&](const int32_t* who, auto some) {
    constexpr int kSome = decltype(some)::value;
    Lanes alpha[kSome], share[kSome];
    Mask inside[kSome];
    for (int k = 0; k < kSome; k++) {
      const int j = who[k];
      const Meeting<Lanes> m = meet(batch[j], px, py);
      alpha[k] = m.exponent;
      if constexpr (kSoft) {  // no branch: rims cross most blocks, and it would often be guessed wrong
        share[k] = coverage_of(batch[j], m).share;
        inside[k] = both(ge(m.exponent, faintest), gt(share[k], none));
      } else {
        inside[k] = ge(m.exponent, broadcast<Lanes>(batch.cut[j]));
      }
    }
    for (int k = 0; k < kSome; k++) {
      alpha[k] = capped(exp2(alpha[k]), alpha_max);
      if constexpr (kSoft) alpha[k] = alpha[k] * share[k];
      alpha[k] = where(inside[k], alpha[k]);
    }
    for (int k = 0; k < kSome; k++) {
      const int j = who[k];
      const Lanes after = fnma(light, alpha[k], light);
      const Mask goes_on = both(alive, ge(after, floor)), draws = kStop ? alive : goes_on;
      alive = goes_on;
      const Lanes weight = where(draws, alpha[k] * light);
      light = select(draws, after, light);
      if (kKeep) stop = select(draws, broadcast_int(std::min(first + j + 1, end)), stop);
      const Mask drawn = both(inside[k], draws);
      drawn_count = increment(drawn, drawn_count);
      r = fma(weight, broadcast<Lanes>(batch.r[j]), r);
      g = fma(weight, broadcast<Lanes>(batch.g[j]), g);
      blue = fma(weight, broadcast<Lanes>(batch.b[j]), blue);
      if (kDepth) inv_z = fma(weight, broadcast<Lanes>(batch.inv_z[j]), inv_z);
      if (j != kNobody) also(j, weight, drawn);
    }
  };
  int i = 0;
  for (; i + 2 < count && bits(alive); i += kInFlight)
    blend(which + i, std::integral_constant<int, kInFlight>());
  if (i < count && bits(alive)) {
    blend(which + i, std::integral_constant<int, 2>());
    i += 2;
  }
  pixels.light = light, pixels.alive = alive;
  pixels.r = r, pixels.g = g, pixels.b = blue;
  pixels.inv_z = inv_z;
  pixels.drawn = drawn_count, pixels.stop = stop;
  return std::min(i, count);
}

struct Canvas {
  int width, height;
  float background[3];
  float spread, alpha_max, stop;
  bool soft;
  float *image, *invdepth, *alpha, *features;
  int32_t *fragments, *winners;
};

// A picture's planes are written past the caches where they would not stay there, a line at a time:
// that spares reading each line first.
inline bool streams(const Canvas& c, const void* plane) {
  constexpr size_t kCached = size_t{1} << 18;  // pixels; their planes fill a second-level cache
  return c.width % kTile == 0 && static_cast<size_t>(c.width) * c.height >= kCached &&
         reinterpret_cast<uintptr_t>(plane) % kLine == 0;
}

// One number per pixel of a tile, value_of(block) those of a block, to rows of a plane of the image.
template <class T, class ValueOf>
inline void paint_tile(const Canvas& c, T* plane, int x0, int y0, ValueOf value_of) {
  static_assert(kTile * sizeof(T) == kLine, "a tile's row is a line");
  const size_t width = static_cast<size_t>(c.width);
  plane += static_cast<size_t>(y0) * width + x0;
  const auto each = [&](auto write) {  // write(to, from, x, y): 4 numbers to (x, y) of the tile
    T* row = plane;
    for (int y = 0; y < kTile; y += kBlockHeight, row += kBlockHeight * width)
      for (int x = 0; x < kTile; x += kBlockWidth) {
        T values[kLanes];
        store(values, value_of(y / kBlockHeight * 4 + x / kBlockWidth));
        for (int k = 0; k < kBlockHeight; k++)
          write(row + k * width + x, values + k * kBlockWidth, x, y + k);
      }
  };
  if (x0 + kTile > c.width || y0 + kTile > c.height)
    each([&](T* to, const T* from, int x, int y) {
      for (int i = 0; i < kBlockWidth && x0 + x + i < c.width && y0 + y < c.height; i++)
        to[i] = from[i];
    });
  else if (streams(c, plane))
    each([](T* to, const T* from, int, int) { stream4(to, from); });
  else
    each([](T* to, const T* from, int, int) { std::memcpy(to, from, 4 * sizeof(T)); });
}

// One number everywhere in tiles side by side, from the tile at (x0, y0) on.
template <class T>
inline void fill_tiles(const Canvas& c, T* plane, int x0, int y0, int wide, T value) {
  if (!plane) return;
  const bool past = streams(c, plane);
  const T four[4] = {value, value, value, value};
  const int end = std::min(wide, c.width - x0), high = std::min(kTile, c.height - y0);
  for (int y = 0; y < high; y++) {
    T* const to = plane + static_cast<size_t>(y0 + y) * c.width + x0;
    for (int x = 0; past && x < end; x += kTile)
      for (int i = 0; i < kTile; i += 4) stream4(to + x + i, four);
    if (!past) std::fill_n(to, end, value);
  }
}

// Asks for the rows of the image that a tile will be painted on: they come while it is blended.
// Those that are written past the caches need not come.
inline void prefetch_canvas(const Canvas& c, int tile_x, int tile_y) {
  const size_t size = static_cast<size_t>(c.width) * c.height;
  const int high = std::min(kTile, c.height - tile_y);
  for (const float* plane : {c.image, c.image + size, c.image + 2 * size, c.invdepth, c.alpha})
    for (int y = 0; plane && !streams(c, plane) && y < high; y++)
      __builtin_prefetch(plane + static_cast<size_t>(tile_y + y) * c.width + tile_x, 1);
}

// Lanes whose pixel lies in the image: all ones, the others 0.
inline Lanes in_image(const Canvas& c, int x0, int y0) {
  if (x0 + kBlockWidth <= c.width && y0 + kBlockHeight <= c.height) return broadcast<Lanes>(1.f);
  float a[kLanes];
  for (int i = 0; i < kLanes; i++)
    a[i] = x0 + i % kBlockWidth < c.width && y0 + i / kBlockWidth < c.height ? 1.f : 0.f;
  return load(a);
}

// A block before anything is blended into it; `inside` is 1 in the image, 0 beyond it.
inline BlockPixels untouched(Lanes inside) {
  const Lanes none = broadcast<Lanes>(0.f);
  return {inside, none, none, none, none, broadcast_int(0), broadcast_int(0),
          ge(inside, broadcast<Lanes>(1.f))};
}

// A tile's list as far as it was blended, for those who want to know afterwards.
struct TileList {
  Heap<uint32_t> splat;
  Heap<Blocks> reached;

  explicit TileList(const Memory& memory) : splat(memory, kBatch), reached(memory, kBatch) {}
};

// A tile while it is being blended.
struct OpenTile {
  int x, y;     // of the first pixel
  int blended;  // length of the list so far
  int waiting;  // what goes next
  Blocks alive;  // blocks where something shows through
  Blocks begun;  // blocks into which anything was blended; the others' pixels are unknown
  uint32_t splat[kBatch];
  Blocks reached[kBatch];
  BlockPixels blocks[kBlocks];

  void open(const Canvas& canvas, int tile_x, int tile_y) {
    x = tile_x, y = tile_y;
    blended = waiting = 0;
    begun = 0, alive = kAllBlocks;
    if (x + kTile <= canvas.width && y + kTile <= canvas.height) return;
    for (int b = 0; b < kBlocks; b++)
      if (x + block_x(b) >= canvas.width || y + block_y(b) >= canvas.height)
        alive &= ~(Blocks{1} << b);
  }
  // A block before anything is blended into it.
  BlockPixels untouched(const Canvas& canvas, int b) const {
    return fp::untouched(in_image(canvas, x + block_x(b), y + block_y(b)));
  }
};

// Blends what waits; returns lanes spent. A `list` grows by it; `extra` is NULL, unless kExtra.
template <bool kKeep, bool kExtra, bool kDepth, bool kStop, bool kSoft>
inline int64_t blend_waiting(const Splat* splats, const Colours& colours, const Canvas& canvas,
                             OpenTile& tile, TileList* list, ExtraTile* extra) {
  const int count = tile.waiting, first = tile.blended, end = first + count;
  tile.blended = end, tile.waiting = 0;
  if (first == 0) prefetch_canvas(canvas, tile.x, tile.y);
  colours.fill(tile.splat, count);
  Batch batch;
  batch.fill(splats, tile.splat, count, tile.x, tile.y);
  for (int j = 0; j < count; j++)
    if (!(batch.inv_z[j] > 0)) tile.reached[j] = 0;  // no finite colour: not even 0 times it
  if (list) {
    list->splat.append(tile.splat, static_cast<size_t>(count));
    list->reached.append(tile.reached, static_cast<size_t>(count));
  }
  if (kExtra) extra->grow(end);
  uint64_t words[kBatch / kWord][kBlocks];
  transpose_bits(tile.reached, count, words);
  Blocks todo = 0;
  for (int j = 0; j < count; j++) todo |= tile.reached[j];
  todo &= tile.alive;
  const BlockCentres centres;
  const BlockPixels inner = untouched(broadcast<Lanes>(1.f));
  const bool whole = tile.x + kTile <= canvas.width && tile.y + kTile <= canvas.height;
  int64_t met = 0;
  for (; todo; todo &= todo - 1) {
    const int b = __builtin_ctzll(todo);
    BlockPixels edge, &pixels = tile.blocks[b];
    const bool begun = tile.begun >> b & 1;
    if (!begun && !whole) edge = tile.untouched(canvas, b);
    const BlockPixels& before = begun ? pixels : whole ? inner : edge;
    tile.begun |= Blocks{1} << b;
    int32_t which[kBatch + kLanes + kInFlight], *last = which;
    for (int w = 0; w < words_of(count); w++) last = expand(words[w][b], w * kWord, last);
    std::fill_n(last, kInFlight - 1, kNobody);
    const int reached = static_cast<int>(last - which);
    if constexpr (kExtra) {
      const auto also = [&](int j, Lanes weight, Mask drawn) {
        const float* row = extra->row(splats[tile.splat[j]]);
        extra->blocks[b].blend(extra->extras, row, first + j, weight, drawn, extra->each);
      };
      met += blend_block<kKeep, true, kStop, kSoft>(batch, which, reached, first, end,
                                             extra->samples.x[b], extra->samples.y[b],
                                             canvas.alpha_max, canvas.stop, before, pixels, also);
    } else {
      met += blend_block<kKeep, kDepth, kStop, kSoft>(batch, which, reached, first, end, centres.x(b),
                                               centres.y(b), canvas.alpha_max, canvas.stop, before,
                                               pixels, [](int, Lanes, Mask) {});
    }
    if (!bits(pixels.alive)) tile.alive &= ~(Blocks{1} << b);
  }
  return kLanes * met;
}

// Paints tiles side by side, from the one at (x0, y0) on, into which nothing was blended.
inline void paint_empty(const Canvas& c, int x0, int y0, int wide) {
  const size_t size = static_cast<size_t>(c.width) * c.height;
  for (int k = 0; k < 3; k++)
    fill_tiles(c, c.image + size * k, x0, y0, wide, fma(1.f, c.background[k], 0.f));
  fill_tiles(c, c.invdepth, x0, y0, wide, 0.f);
  fill_tiles(c, c.alpha, x0, y0, wide, 0.f);
  fill_tiles(c, c.fragments, x0, y0, wide, 0);
}

// Paints a tile; returns how many fragments it drew. `list` is read with `extra` only.
inline int64_t close_tile(const Splat* splats, const Canvas& c, OpenTile& tile,
                          const TileList* list, const ExtraTile* extra, TilePixels* keep) {
  const size_t size = static_cast<size_t>(c.width) * c.height;
  for (Blocks rest = kAllBlocks & ~tile.begun; rest; rest &= rest - 1) {
    const int b = __builtin_ctzll(rest);
    tile.blocks[b] = tile.untouched(c, b);
  }
  const auto paint = [&](auto* plane, auto value_of) {
    if (plane) paint_tile(c, plane, tile.x, tile.y, value_of);
  };
  const auto over = [&](int b, Lanes v, float back) {
    return fma(tile.blocks[b].light, broadcast<Lanes>(back), v);
  };
  paint(c.image, [&](int b) { return over(b, tile.blocks[b].r, c.background[0]); });
  paint(c.image + size, [&](int b) { return over(b, tile.blocks[b].g, c.background[1]); });
  paint(c.image + 2 * size, [&](int b) { return over(b, tile.blocks[b].b, c.background[2]); });
  paint(c.invdepth, [&](int b) { return tile.blocks[b].inv_z; });
  paint(c.alpha, [&](int b) { return broadcast<Lanes>(1.f) - tile.blocks[b].light; });
  paint(c.fragments, [&](int b) { return tile.blocks[b].drawn; });
  if (extra) {
    for (int k = 0; c.features && k < extra->extras.feature_count; k++)
      paint(c.features + static_cast<size_t>(k) * size,
            [&](int b) { return extra->blocks[b].features[k]; });
    paint(c.winners, [&](int b) {
      IntLanes rows = extra->blocks[b].winner;
      for (int i = 0; i < kLanes; i++)
        if (rows[i] >= 0) rows[i] = static_cast<int32_t>(splats[list->splat.data()[rows[i]]].id);
      return rows;
    });
  }
  IntLanes drawn = broadcast_int(0);
  for (int b = 0; b < kBlocks; b++) {
    drawn = drawn + tile.blocks[b].drawn;
    if (!keep) continue;
    store(keep->transmittance + b * kLanes, tile.blocks[b].light);
    store(keep->stop + b * kLanes, tile.blocks[b].stop);
  }
  int64_t total = 0;
  for (int i = 0; i < kLanes; i++) total += drawn[i];
  return total;
}

// ---- backward --------------------------------------------------------------------------------

// What is wanted of the backward pass; each part that is not costs nothing. kExtra, what some
// dialects want, comes with all others but kThreshold, and a soft rim with all but kDepth.
enum Want { kGeometry = 1, kColour = 2, kThreshold = 4, kDepth = 8, kExtra = 16, kSoft = 32 };
constexpr int kWholeExtra = kExtra | kGeometry | kColour | kDepth;
constexpr int kWholeSoft = kSoft | kGeometry | kColour | kThreshold;

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
  constexpr bool soft = kWant & kSoft;
  const Meeting<Lanes> m = meet(brush, px, py);
  Mask reached = both(ge(m.exponent, broadcast<Lanes>(soft ? kFaintest : rim.list_cut)),
                      gt(load(stops + at), broadcast_int(position)));
  const Lanes one = broadcast<Lanes>(1.f);
  Coverage<Lanes> cover;
  if constexpr (soft) {
    cover = coverage_of(brush, m);
    reached = both(reached, gt(cover.share, broadcast<Lanes>(0.f)));
  }
  if (!bits(reached)) return;
  const Mask drawn = kWant & kThreshold && !soft
                         ? both(reached, ge(m.exponent, broadcast<Lanes>(brush.cut)))
                         : reached;
  const Lanes uncapped = exp2(m.exponent), full = capped(uncapped, rim.alpha_max);
  const Lanes alpha = where(drawn, soft ? full * cover.share : full);
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
  Lanes w = uncapped * by_alpha;  // straight through the cap
  if (soft) w = w * cover.share;
  w = where(drawn, w);
  if (kWant & kExtra && !asked.cap_gradient)
    w = where(ge(broadcast<Lanes>(rim.alpha_max), uncapped), w);
  int k = 0;
  sums[k] = sums[k] + w, k++;
  // At a soft rim w gets the exponent's gradient through the share, and `bend` its slope's. The square
  // of the slope is 4 (u, v) M (u, v), M being (scale skew; 0 down) times its transpose, so that goes
  // along M (u, v).
  Lanes bend_u, bend_v;
  if constexpr (soft) {
    const Mask partly = both(reached, gt(one, cover.share));
    const Lanes by_share = full * by_alpha;
    if (rim.threshold > 0) {
      const Lanes gain = (by_share + broadcast<Lanes>(rim.per_fragment)) * cover.per_pixel;
      sums[k] = sums[k] - where(partly, gain * broadcast<Lanes>(kLog2E / rim.threshold));
    }
    const Lanes edge = where(partly, by_share * cover.per_pixel * broadcast<Lanes>(kLog2E));
    const Lanes bend = (edge + edge) * (cover.share - broadcast<Lanes>(0.5f)) * cover.per_pixel;
    bend_u = bend * fma(cover.along, broadcast<Lanes>(brush.scale),
                        cover.down * broadcast<Lanes>(brush.skew));
    bend_v = bend * cover.down * broadcast<Lanes>(brush.down);
    w = w + edge;
    k++;
  } else if (kWant & kThreshold) {
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
    Lanes wu = w * m.u, wv = w * m.v;
    if constexpr (soft) wu = wu + bend_u, wv = wv + bend_v;
    sums[k] = sums[k] + wu, k++;
    sums[k] = sums[k] + wv, k++;
    if constexpr (soft) {  // M moves with the shape, as (u, v) do: once more
      sums[k] = fma(wu + bend_u, m.u, sums[k]), k++;
      sums[k] = fma(wu, m.v, fma(bend_v, m.u, sums[k])), k++;
      sums[k] = fma(wv + bend_v, m.v, sums[k]), k++;
    } else {
      sums[k] = fma(wu, m.u, sums[k]), k++;
      sums[k] = fma(wu, m.v, sums[k]), k++;
      sums[k] = fma(wv, m.v, sums[k]), k++;
    }
  }
  if (kWant & kColour) {
    sums[k] = fma(weight, gr, sums[k]), k++;
    sums[k] = fma(weight, gg, sums[k]), k++;
    sums[k] = fma(weight, gb, sums[k]), k++;
  }
  if (kWant & kDepth && kWant & kGeometry) sums[k] = fma(weight, gz, sums[k]), k++;
  if (kWant & kExtra) {
    Lanes wu = w * m.u, wv = w * m.v;
    if constexpr (soft) wu = wu + bend_u, wv = wv + bend_v;
    const Lanes gx = broadcast<Lanes>(beyond.along) * wu;
    const Lanes gy = fma(broadcast<Lanes>(beyond.across), wu, broadcast<Lanes>(beyond.down) * wv);
    sums[k] = sums[k] + abs(gx) + abs(gy), k++;
    for (int f = 0; f < asked.extras.feature_count; f++, k++)
      sums[k] = fma(weight, load(loss.features[f] + at), sums[k]);
  }
}

// Where a splat's sums of one cell go.
struct CellSlots {
  const Scene& scene;
  uint32_t row, column;  // of the cell
  size_t operator()(uint32_t splat) const { return scene.slot(splat, row, column); }
};

// Adds sums_of(kWant) numbers and the features' per entry of the list, at `out` + slot times their
// number.
template <int kWant>
inline void unblend_tile(const Splat* splats, const Tile& tile, const TilePixels& kept,
                         const CellSlots& slot, const Asked& asked, LossPixels& loss, float* out) {
  constexpr int base = sums_of(kWant), most = kWant & kExtra ? kMostSums : base;
  const int n = kWant & kExtra ? base + asked.extras.feature_count : base;
  const BlockCentres centres;
  std::optional<Samples> samples;
  if (kWant & kExtra)
    samples.emplace(tile, static_cast<int>(asked.width), static_cast<int>(asked.height),
                    asked.extras.offsets);
  // Blocks in the order in which they open, the deepest pixel first.
  struct Opening {
    int32_t stop;
    int block;
  } opening[kBlocks];
  for (int b = 0; b < kBlocks; b++)
    opening[b] = {*std::max_element(kept.stop + b * kLanes, kept.stop + (b + 1) * kLanes), b};
  std::sort(opening, opening + kBlocks,
            [](const Opening& a, const Opening& b) { return a.stop > b.stop; });
  Blocks open = 0;
  int next = 0;
  for (int position = std::min(opening[0].stop, tile.length) - 1; position >= 0; position--) {
    for (; next < kBlocks && opening[next].stop > position; next++)
      open |= Blocks{1} << opening[next].block;
    if (position >= kAhead) {
      __builtin_prefetch(&splats[tile.list[position - kAhead]]);
      __builtin_prefetch(out + slot(tile.list[position - kAhead / 2]) * n, 1);
    }
    const Splat& s = splats[tile.list[position]];
    Blocks todo = tile.reached[position] & open;
    if (!todo) continue;
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
      unblend_block<kWant>(brush, rim, asked, beyond, position,
                           kWant & kExtra ? samples->x[b] : centres.x(b),
                           kWant & kExtra ? samples->y[b] : centres.y(b), kept.stop, b * kLanes, loss,
                           sums);
    }
    float all[most];
    sum_each<most>(sums, all);
    float* to = out + slot(tile.list[position]) * n;
    for (int i = 0; i < n; i++) to[i] += all[i];
  }
}

}  // namespace fp
