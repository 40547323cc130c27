// From splats to lists of splats per cell, front to back; and from a cell's list to the blocks of its
// tiles' pixels.
#pragma once

#include <stdexcept>

#include "projection.h"

namespace fp {

// A splat on the list of a cell: it reaches none but the tiles x0..x1 of it, both included.
struct CellEntry {
  uint32_t depth;  // the bits of a positive float, which sort as it does
  uint32_t splat;
  uint8_t x0, x1;
};

// Cell c holds entries [first[c], first[c + 1]), in the order of the inputs.
struct CellLists {
  std::vector<uint32_t> first;  // per cell, row by row; one more at the end
  Buffer<CellEntry> entries;
};

// Each thread walks all splats for a band of rows of its own: cheaper than counting beforehand what
// each part of the splats puts into each row, up to some number of threads.
FP_STAGE inline CellLists list_cells(Team& team, const Memory& memory, const Scene& scene) {
  const size_t across = scene.across, rows = scene.cells.size() / across;
  CellLists lists;
  lists.first.reserve(scene.cells.size() + 1);
  uint64_t total = 0;
  for (uint32_t count : scene.cells) {
    lists.first.push_back(static_cast<uint32_t>(total));
    total += count;
  }
  if (total > UINT32_MAX) throw std::length_error("tile lists");
  lists.first.push_back(static_cast<uint32_t>(total));
  lists.entries = Buffer<CellEntry>(memory, total);
  const size_t bands = total < 1u << 12 ? 1 : static_cast<size_t>(std::min(team.size(), 8));
  const auto edge = [&](size_t band) {  // bands hold about as many entries each
    size_t row = 0;
    while (row < rows && (band == bands || lists.first[row * across] < total * band / bands)) row++;
    return row;
  };
  team.each(bands, 1, [&](size_t band, size_t) {
    const size_t top = edge(band), bottom = edge(band + 1);
    std::vector<uint32_t> cursor(lists.first.begin(), lists.first.end());
    for (size_t piece = 0; piece < scene.pieces(); piece++)
      for (size_t k = piece * kPiece; k < piece * kPiece + scene.count[piece]; k++) {
        const Reach reach = scene.reach[k];
        const size_t end = std::min<size_t>(reach.y1 + size_t{1}, bottom);
        size_t y = std::max<size_t>(reach.y0, top);
        if (y >= end) continue;
        const auto depth = bits_as<uint32_t>(scene.depth[k]);
        for (; y < end; y++)
          for (int x = reach.x0 / kCell; x <= reach.x1 / kCell; x++)
            lists.entries[cursor[y * across + static_cast<size_t>(x)]++] = {
                depth, static_cast<uint32_t>(k),
                static_cast<uint8_t>(std::max(reach.x0 - x * kCell, 0)),
                static_cast<uint8_t>(std::min(reach.x1 - x * kCell, kCell - 1))};
      }
  });
  return lists;
}

// The entries of one cell, front to back; those of one depth in the order of the inputs. Sorts no
// more of them than are asked for: mostly, the foremost hide all others.
class FrontToBack {
 public:
  FrontToBack(const Memory& memory, const CellEntry* begin, const CellEntry* end)
      : memory_(memory), begin_(begin), end_(end), counts_(1, static_cast<uint32_t>(end - begin)) {
    if (counts_[0] <= kRun) return;
    const Range all(begin, end);
    from_ = all.least;
    shift_ = std::max(all.width() - kBucketBits, 0);
    counts_.assign(static_cast<size_t>((all.most - all.least) >> shift_) + 1, 0);
    for (const CellEntry* e = begin; e < end; e++) counts_[(e->depth - from_) >> shift_]++;
  }

  // The next ones, more each time; false: there are none.
  bool next(const CellEntry*& begin, const CellEntry*& end) {
    const size_t first = bucket_;
    size_t n = 0;
    while (bucket_ < counts_.size() && (n == 0 || n + counts_[bucket_] <= run_))
      n += counts_[bucket_++];
    run_ *= 2;
    if (n == 0) return false;
    sorted_ = Buffer<CellEntry>(memory_, n + 1);  // one more, to write what is not meant
    if (counts_.size() == 1) {
      std::copy(begin_, end_, sorted_.data());
    } else {
      size_t at = 0;
      for (const CellEntry* e = begin_; e < end_; e++) {
        sorted_[at] = *e;
        const size_t bucket = (e->depth - from_) >> shift_;
        at += bucket >= first && bucket < bucket_;
      }
    }
    sort(n);
    begin = sorted_.data(), end = begin + n;
    return true;
  }

 private:
  static constexpr int kBucketBits = 10, kDigitBits = 9;
  static constexpr uint32_t kRun = 4096;

  struct Range {
    Range(const CellEntry* begin, const CellEntry* end) {
      for (const CellEntry* e = begin; e < end; e++)
        least = std::min(least, e->depth), most = std::max(most, e->depth);
    }
    int width() const { return most > least ? 32 - __builtin_clz(most - least) : 0; }
    uint32_t least = UINT32_MAX, most = 0;
  };

  // A stable radix sort of sorted_[0..n).
  void sort(size_t n) {
    const Range all(sorted_.data(), sorted_.data() + n);
    Buffer<CellEntry> other(memory_, n);
    // Digits as wide as the count's: counting them then costs about what moving the entries does.
    const int widest = std::clamp(31 - __builtin_clz(static_cast<uint32_t>(n) | 1), 5, kDigitBits);
    const int digits = (all.width() + widest - 1) / widest;
    const int width = digits ? (all.width() + digits - 1) / digits : 0;  // bits
    for (int shift = 0; shift < all.width(); shift += width) {
      uint32_t place[1 << kDigitBits];
      std::fill_n(place, 1u << width, 0);
      const auto digit = [&](const CellEntry& e) {
        return (e.depth - all.least) >> shift & ((1u << width) - 1);
      };
      for (size_t i = 0; i < n; i++) place[digit(sorted_[i])]++;
      uint32_t total = 0;
      for (uint32_t i = 0; i < 1u << width; i++) total += std::exchange(place[i], total);
      for (size_t i = 0; i < n; i++) other[place[digit(sorted_[i])]++] = sorted_[i];
      sorted_.swap(other);
    }
  }

  const Memory& memory_;
  const CellEntry *begin_, *end_;
  Buffer<CellEntry> sorted_;
  std::vector<uint32_t> counts_;  // per bucket of depths
  uint32_t from_ = 0;
  int shift_ = 0;
  size_t bucket_ = 0, run_ = kRun;
};

// ---- blocks ----------------------------------------------------------------------------------

// A tile is cut into blocks of 4 columns by kLanes / 4 rows, one pixel per lane.
constexpr int kBlockWidth = 4, kBlockHeight = kLanes / kBlockWidth;
constexpr int kBlockRows = kTile / kBlockHeight, kBlocks = kBlockRows * 4;
static_assert(kCell < 32, "a cell's tiles fit a word");

// One bit for each block of a tile.
#if FP_LANES == 4
typedef uint64_t Blocks;
#else
typedef uint32_t Blocks;
#endif
constexpr Blocks kAllBlocks = ~Blocks{0} >> (8 * sizeof(Blocks) - kBlocks);

// One bit for each of a cell's tiles x0..x1.
inline uint32_t tile_bits(int x0, int x1) { return (2u << x1) - (1u << x0); }

#if FP_LANES > 4
// One number for each row of blocks.
typedef float Columns __attribute__((vector_size(4 * kBlockRows)));
typedef int32_t WholeColumns __attribute__((vector_size(4 * kBlockRows)));
#if FP_LANES == 8
inline WholeColumns shifted_left(WholeColumns a, WholeColumns by) {
  return (WholeColumns)_mm256_sllv_epi32((__m256i)a, (__m256i)by);
}
inline WholeColumns shifted_right(WholeColumns a, WholeColumns by) {
  return (WholeColumns)_mm256_srlv_epi32((__m256i)a, (__m256i)by);
}
#else
inline WholeColumns shifted_left(WholeColumns a, WholeColumns by) {
  return (WholeColumns)_mm_sllv_epi32((__m128i)a, (__m128i)by);
}
inline WholeColumns shifted_right(WholeColumns a, WholeColumns by) {
  return (WholeColumns)_mm_srlv_epi32((__m128i)a, (__m128i)by);
}
#endif
#endif

// Columns of blocks of a cell that kLanes splats reach, by row of blocks: begin..end, both included;
// from 1 to 0 where there are none. To be rounded towards 0.
struct BlockSpans {
  alignas(64) float begin[kLanes][kBlockRows], end[kLanes][kBlockRows];

  // The blocks of the cell's tile x that one splat reaches.
  Blocks of_tile(int lane, int x) const {
    Blocks blocks = 0;
#if FP_LANES == 4
    for (int r = 0; r < kBlockRows; r++) {
      const int from = std::max(static_cast<int>(begin[lane][r]) - 4 * x, 0);
      const int to = std::min(static_cast<int>(end[lane][r]) - 4 * x, 3);
      if (from <= to) blocks |= static_cast<Blocks>((2u << to) - (1u << from)) << 4 * r;
    }
#else
    Columns first, last;
    std::memcpy(&first, begin[lane], sizeof first);
    std::memcpy(&last, end[lane], sizeof last);
    // columns to leave out, on the left and on the right; 4 or more: all
    WholeColumns left = __builtin_convertvector(first, WholeColumns) - 4 * x, none = {}, place;
    WholeColumns right = 4 * x + 3 - __builtin_convertvector(last, WholeColumns);
    left = left > none ? left : none, right = right > none ? right : none;
    for (int r = 0; r < kBlockRows; r++) place[r] = 4 * r;
    const auto fifteen = none + 15;
    const auto bits =
        shifted_left(shifted_left(fifteen, left) & shifted_right(fifteen, right), place);
    typedef uint64_t Pairs __attribute__((vector_size(sizeof bits)));
    const auto pairs = bits_as<Pairs>(bits);
    uint64_t all = 0;
    for (int k = 0; k < kBlockRows / 2; k++) all |= pairs[k];
    blocks = static_cast<Blocks>(all | all >> 32);
#endif
    return blocks;
  }
};

// What kLanes splats reach of the cell whose first pixel is (x, y). Pixels are sampled up to `spread`
// from their centres.
inline void find_blocks(const Splat* splats, const uint32_t* which, float spread, float x, float y,
                        BlockSpans& to) {
  const auto splat = [&](int i) { return reinterpret_cast<const float*>(splats + which[i]); };
  Lanes v[8];
  load_columns(splat, v);
  load_columns([&](int i) { return splat(i) + 4; }, v + 4);
  const Lanes one = broadcast<Lanes>(1.f), none = broadcast<Lanes>(0.f);
  const Lanes away = broadcast<Lanes>(spread), mean_x = v[0] - x, mean_y = v[1] - y;
  const Ellipse<Lanes> e = ellipse_of(v[2], v[3], v[4], v[5] - v[7], away);
  const Lanes top = ceil(mean_y - e.half_height), bottom = floor(mean_y + e.half_height);
  const Lanes above = mean_y - away, below = mean_y + away;
  Lanes begin[4], end[4];
  for (int row = 0; row < kBlockRows; row++) {
    const float first = static_cast<float>(row * kBlockHeight);
    const Lanes low = max(broadcast<Lanes>(first), top);
    const Lanes high = min(broadcast<Lanes>(first + (kBlockHeight - 1)), bottom);
    const Lanes left = ceil(mean_x + span_end(e, low - below, high - above, -one));
    const Lanes right = floor(mean_x + span_end(e, low - below, high - above, one));
    const Lanes from = max(none, left), last = min(broadcast<Lanes>(kCell * kTile - 1), right);
    const Mask some = both(ge(high, low), ge(last, from));
    constexpr float block = 1.f / kBlockWidth;
    begin[row % 4] = select(some, from * block, one);
    end[row % 4] = select(some, last * block, none);
    if (row % 4 != 3) continue;
    store_rows(begin, [&](int lane) { return to.begin[lane] + row - 3; });
    store_rows(end, [&](int lane) { return to.end[lane] + row - 3; });
  }
}

}  // namespace fp
