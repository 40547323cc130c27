// From splats to lists of splats per tile, front to back: one depth sort, then the spans of tiles
// in that order to the rows of tiles, then each row to its tiles.
#pragma once

#include "projection.h"

namespace fp {

// Tile t holds entries [first[t], first[t + 1]) of `splat`, front to back. Each entry also has a
// slot: those of a splat are next to each other, so that what the tiles find out about it can be
// gathered in a fixed order, from memory in order, without atomics.
struct TileLists {
  Buffer<uint32_t> first;  // per tile, one more at the end
  Buffer<uint32_t> splat;  // per entry
  Buffer<uint32_t> slot;   // per entry; empty unless asked for
  size_t tiles() const { return first.size() - 1; }
};

// How a team divides n things among itself: contiguous parts, in order.
struct Parts {
  Parts(const Team& team, size_t n, size_t least)
      : count(n < least ? 1 : static_cast<size_t>(std::min(team.size(), 16))), size(n),
        grain(n / count + 1) {}
  size_t begin(size_t part) const { return std::min(size, part * grain); }
  size_t end(size_t part) const { return std::min(size, (part + 1) * grain); }
  size_t count, size, grain;
};

// Stable radix sort of the splats that reach a tile, by the bits of positive floats.
inline Buffer<uint32_t> order_by_depth(Team& team, const Memory& memory, const Scene& scene) {
  struct Item {
    uint32_t key, index;
  };
  const size_t n = scene.total, pieces = scene.pieces();
  Buffer<Item> a(memory, n), b(memory, n);
  std::vector<size_t> place(pieces);
  for (size_t k = 1; k < pieces; k++) place[k] = place[k - 1] + scene.count[k - 1];
  std::vector<uint32_t> least(pieces, UINT32_MAX), most(pieces, 0);
  team.each(pieces, 16, [&](size_t begin, size_t end) {
    for (size_t k = begin; k < end; k++)
      for (uint32_t j = 0; j < scene.count[k]; j++) {
        const uint32_t key = bits_as<uint32_t>(scene.depth[k * kPiece + j]);
        a[place[k] + j] = {key, static_cast<uint32_t>(k * kPiece + j)};
        least[k] = std::min(least[k], key), most[k] = std::max(most[k], key);
      }
  });
  Buffer<uint32_t> order(memory, n);
  if (n == 0) return order;
  const uint32_t from = *std::min_element(least.begin(), least.end());
  const uint32_t range = *std::max_element(most.begin(), most.end()) - from;
  const int bits = range ? 32 - __builtin_clz(range) : 1;
  const int passes = (bits + 10) / 11, digit = (bits + passes - 1) / passes;
  const uint32_t buckets = uint32_t{1} << digit;
  const Parts parts(team, n, 1u << 14);
  std::vector<uint32_t> count(parts.count * buckets);
  for (int pass = 0; pass < passes; pass++) {
    const auto bucket = [&](uint32_t key) { return (key - from) >> pass * digit & (buckets - 1); };
    team.each(parts.count, 1, [&](size_t part, size_t) {
      uint32_t* mine = &count[part * buckets];
      std::fill_n(mine, buckets, 0);
      for (size_t i = parts.begin(part); i < parts.end(part); i++) mine[bucket(a[i].key)]++;
    });
    uint32_t total = 0;
    for (uint32_t k = 0; k < buckets; k++)
      for (size_t part = 0; part < parts.count; part++)
        total += std::exchange(count[part * buckets + k], total);
    team.each(parts.count, 1, [&](size_t part, size_t) {
      uint32_t* mine = &count[part * buckets];
      for (size_t i = parts.begin(part); i < parts.end(part); i++) {
        const uint32_t to = mine[bucket(a[i].key)]++;
        if (pass == passes - 1)
          order[to] = a[i].index;
        else
          b[to] = a[i];
      }
    });
    a.swap(b);
  }
  return order;
}

// One splat's span in one row of tiles.
struct RowSpan {
  uint32_t splat;
  Span span;
  uint32_t slot;  // of its first tile
};

// All rows' spans, front to back: row r holds [first[r], first[r + 1]).
struct RowSpans {
  Buffer<RowSpan> spans;
  std::vector<uint32_t> first;  // per row, one more at the end
  std::vector<uint32_t> tiles;  // per row, one more at the end: entries of the rows above
};

// Each thread walks all splats for a band of rows of its own: cheaper than counting beforehand what
// each part of the splats puts into each row, up to some number of threads.
inline RowSpans spans_by_row(Team& team, const Memory& memory, const Scene& scene,
                             const Buffer<uint32_t>& order, bool with_slots) {
  constexpr size_t ahead = 16;
  const size_t rows = scene.rows.size();
  RowSpans by_row;
  by_row.first.resize(rows + 1), by_row.tiles.resize(rows + 1);
  uint32_t spans = 0, tiles = 0;
  for (size_t r = 0; r < rows; r++) {
    by_row.first[r] = spans, by_row.tiles[r] = tiles;
    spans += scene.rows[r].spans, tiles += scene.rows[r].tiles;
  }
  by_row.first[rows] = spans, by_row.tiles[rows] = tiles;
  by_row.spans = Buffer<RowSpan>(memory, spans);
  const size_t bands = order.size() < 1u << 12 ? 1 : static_cast<size_t>(std::min(team.size(), 8));
  const auto edge = [&](size_t band) {  // bands hold about as many spans each
    const auto least = static_cast<uint32_t>(uint64_t{spans} * band / bands);
    const auto found = std::lower_bound(by_row.first.begin(), by_row.first.end(), least);
    return band == bands ? rows : static_cast<size_t>(found - by_row.first.begin());
  };
  const auto spans_of = [&](uint32_t k) {
    return scene.spans[k / kPiece].data() + scene.reach[k].first;
  };
  team.each(bands, 1, [&](size_t band, size_t) {
    const size_t top = edge(band), bottom = edge(band + 1);
    std::vector<RowSpan*> cursor(rows);
    for (size_t r = top; r < bottom; r++) cursor[r] = by_row.spans.data() + by_row.first[r];
    for (size_t i = 0; i < order.size(); i++) {
      if (i + 2 * ahead < order.size()) __builtin_prefetch(&scene.reach[order[i + 2 * ahead]]);
      if (i + ahead < order.size()) __builtin_prefetch(spans_of(order[i + ahead]));
      const uint32_t k = order[i];
      const Reach reach = scene.reach[k];
      const size_t first = std::max<size_t>(reach.row, top);
      const size_t end = std::min<size_t>(size_t{reach.row} + reach.rows, bottom);
      if (first >= end) continue;
      const Span* of_row = spans_of(k);
      uint32_t slot = with_slots ? scene.slot_begin(k) : 0;
      if (with_slots)
        for (size_t r = reach.row; r < first; r++) slot += of_row[r - reach.row].tiles();
      for (size_t r = first; r < end; r++) {
        const Span span = of_row[r - reach.row];
        *cursor[r]++ = {k, span, slot};
        slot += span.tiles();
      }
    }
  });
  return by_row;
}

inline TileLists distribute(Team& team, const Memory& memory, const Memory& scratch, size_t across,
                            const Scene& scene, bool with_slots) {
  const size_t rows = scene.rows.size();
  const Buffer<uint32_t> order = order_by_depth(team, scratch, scene);
  const RowSpans by_row = spans_by_row(team, scratch, scene, order, with_slots);
  const size_t entries = by_row.tiles[rows];
  TileLists lists{Buffer<uint32_t>(memory, across * rows + 1), Buffer<uint32_t>(memory, entries),
                  with_slots ? Buffer<uint32_t>(memory, entries) : Buffer<uint32_t>()};
  team.each(rows, 1, [&](size_t row, size_t) {
    const RowSpan *begin = by_row.spans.data() + by_row.first[row],
                  *end = by_row.spans.data() + by_row.first[row + 1];
    std::vector<uint32_t> cursor(across + 1, 0);
    for (const RowSpan* s = begin; s < end; s++)  // an empty span, 1 to 0, cancels itself
      cursor[s->span.x0]++, cursor[s->span.x1 + 1]--;
    uint32_t position = by_row.tiles[row], open = 0;
    for (size_t x = 0; x < across; x++) {
      open += cursor[x];
      lists.first[row * across + x] = cursor[x] = position;
      position += open;
    }
    for (const RowSpan* s = begin; s < end; s++) {
      uint32_t slot = s->slot;
      for (uint32_t x = s->span.x0; x <= s->span.x1; x++) {
        const uint32_t at = cursor[x]++;
        lists.splat[at] = s->splat;
        if (with_slots) lists.slot[at] = slot++;
      }
    }
  });
  lists.first[across * rows] = static_cast<uint32_t>(entries);
  return lists;
}

}  // namespace fp
