// From Gaussians to lists of them per tile, front to back: project; sort those that reach a tile by
// depth; write an entry per tile, in that order; sort the entries by tile.

#include "block.cuh"

namespace fp {

// ---- projection ------------------------------------------------------------------------------

// The degree is a constant in each of its uses, so that the harmonics stay in registers.
template <int kDegree>
__device__ inline Vec3 colour_of_degree(const fragprune_inputs& in, const Vec3& towards,
                                        size_t i) {
  Harmonics<float> h;
  const int terms = harmonics(kDegree, towards, h, false);
  const float* sh = in.sh + 3 * static_cast<size_t>(in.sh_coefficients) * i;
  return raw_colour(h, terms, [sh](int k) { return read3(sh + 3 * k); });
}

__device__ inline Vec3 colour_of(const fragprune_inputs& in, const Camera<float>& c,
                                 const Vec3& mean, size_t i) {
  if (in.colors) return read3(in.colors + 3 * i);
  float inv_length;
  const Vec3 towards = direction_to(c.centre, mean, inv_length);
  switch (in.sh_degree) {
    case 0: return colour_of_degree<0>(in, towards, i);
    case 1: return colour_of_degree<1>(in, towards, i);
    case 2: return colour_of_degree<2>(in, towards, i);
    default: return colour_of_degree<3>(in, towards, i);
  }
}

// The rows of tiles that bounds reach: first, and how many.
__device__ inline int rows_of(const Bounds<float>& bounds, int& first) {
  constexpr float tile = 1.f / kTile;
  if (!ge(bounds.bottom, bounds.top)) return 0;
  first = static_cast<int>(floor(bounds.top * tile));
  return static_cast<int>(floor(bounds.bottom * tile)) - first + 1;
}

// Columns of tiles in one row of tiles, half open.
__device__ inline void columns_of(const Bounds<float>& bounds, int row, int& first, int& end) {
  float x0, x1;
  span_of(bounds, static_cast<float>(row), x0, x1);
  first = static_cast<int>(x0);
  end = static_cast<int>(x1) + 1;
}

struct Projected {
  Brush<float> brush;
  Rect rect;
  float depth;
  int32_t radius;
  uint32_t tiles;  // 0: draws nothing, and the brush is not filled in
};

// What is left of a Gaussian once its image is known: false when it draws nothing.
__device__ inline bool cut_out(const fragprune_inputs& in, float opacity, size_t i,
                               Brush<float>& b) {
  const float threshold = in.thresholds ? in.thresholds[i] : 0.f;
  if (!(opacity > 0.f && opacity < 1e30f && threshold >= 0.f)) return false;
  b.log_opacity = log2(opacity);
  b.cut = cut_of(b.log_opacity, threshold);
  b.list_cut = in.widen ? cut_of(b.log_opacity, rim_reach(threshold)) : b.cut;
  return b.log_opacity >= b.list_cut;
}

__device__ inline Projected project_one(const fragprune_inputs& in, const Camera<float>& c,
                                        size_t i) {
  Projected o;
  o.radius = 0, o.tiles = 0;
  Brush<float>& b = o.brush;
  Projection<float> p;
  Vec3 mean;
  if (in.means2d) {  // on the image already
    const Square<float> square =
        square_of(in.conics[3 * i], in.conics[3 * i + 1], in.conics[3 * i + 2]);
    o.depth = in.depths[i];
    if (!(square.exists && o.depth > 0.f && o.depth < 1e30f)) return o;
    if (!cut_out(in, in.opacities[i], i, b)) return o;
    b.x = in.means2d[2 * i], b.y = in.means2d[2 * i + 1];
    if (!(abs(b.x) <= 1e9f && abs(b.y) <= 1e9f)) return o;
    b.scale = square.scale, b.skew = square.skew, b.down = square.down;
    const auto edge = [](int32_t at, float most) {
      return clamp(static_cast<float>(at), 0.f, most);
    };
    p.tile_x0 = edge(in.tiles[4 * i], c.tiles_x), p.tile_y0 = edge(in.tiles[4 * i + 1], c.tiles_y);
    p.tile_x1 = edge(in.tiles[4 * i + 2], c.tiles_x);
    p.tile_y1 = edge(in.tiles[4 * i + 3], c.tiles_y);
  } else {
    mean = read3(in.means + 3 * i);
    if (!in_front(c, mean)) return o;
    if (!project(c, load_given(in, i), p)) return o;
    o.radius = static_cast<int32_t>(p.radius);
    o.depth = p.view.z;
    if (!cut_out(in, in.opacities[i] * compensation(c, p), i, b)) return o;
    b.x = p.x, b.y = p.y;
    b.scale = sqrt(0.5f * kLog2E * (p.var_y / p.det));
    b.skew = -b.scale * (p.cov / p.var_y);
    b.down = sqrt(0.5f * kLog2E / p.var_y);
  }
  o.rect = {static_cast<uint16_t>(p.tile_x0), static_cast<uint16_t>(p.tile_x1),
            static_cast<uint16_t>(p.tile_y0), static_cast<uint16_t>(p.tile_y1)};
  const Bounds<float> bounds = bounds_of(c, p, b);
  int first_row;
  const int rows = rows_of(bounds, first_row);
  uint32_t tiles = 0;
  for (int r = 0; r < rows; r++) {
    int first, end;
    columns_of(bounds, first_row + r, first, end);
    tiles += static_cast<uint32_t>(end - first);
  }
  if (tiles == 0) return o;
  const Vec3 colour = colour_of(in, c, mean, i);  // last, for those alone that draw
  float size = abs(colour.x) + abs(colour.y) + abs(colour.z);
  for (int k = 0; k < in.feature_count; k++)
    size += abs(in.features[static_cast<size_t>(in.feature_count) * i + k]);
  if (!(size < 1e30f)) return o;
  const bool clamped = in.colors == nullptr;
  b.r = clamped ? max(colour.x, 0.f) : colour.x;
  b.g = clamped ? max(colour.y, 0.f) : colour.y;
  b.b = clamped ? max(colour.z, 0.f) : colour.z;
  b.inv_z = 1.f / o.depth;
  o.tiles = tiles;
  return o;
}

// The bounds of a Gaussian that reaches tiles, from what projection left: the same to the bit.
__device__ inline Bounds<float> bounds_again(const Frame& f, const Camera<float>& c,
                                             uint32_t row) {
  const Brush<float> b = load_brush(f.brushes, row);
  const Rect rect = f.rects[row];
  Projection<float> p;
  p.tile_x0 = rect.x0, p.tile_x1 = rect.x1;
  p.tile_y0 = rect.y0, p.tile_y1 = rect.y1;
  return bounds_of(c, p, b);
}

// ---- entries ---------------------------------------------------------------------------------

// Counts digits of a block's keys before they are sorted.
struct Digits {
  uint32_t count[kPasses][kDigits];

  __device__ void clear(int passes) {
    for (int pass = 0; pass < passes; pass++) count[pass][threadIdx.x] = 0;
  }
  __device__ void add(uint32_t key, int passes) {
    for (int pass = 0; pass < passes; pass++) atomicAdd(&count[pass][key >> 8 * pass & 255], 1u);
  }
  __device__ void flush(uint32_t* histogram, int passes) {
    for (int pass = 0; pass < passes; pass++) {
      const uint32_t mine = count[pass][threadIdx.x];
      if (mine) atomicAdd(histogram + pass * kDigits + threadIdx.x, mine);
    }
  }
};

// Writes the entries of one Gaussian in one row of tiles, beginning at `at`.
__device__ inline void emit_row(const Frame& f, Digits& digits, uint32_t id, int row, int first,
                                int end, uint64_t at) {
  for (int x = first; x < end; x++, at++) {
    if (at >= f.capacity) return;
    const uint32_t key = static_cast<uint32_t>(row * f.tiles_x + x);
    f.entry_keys[at] = key;
    f.entry_values[at] = f.owners ? static_cast<uint32_t>(at) : id;
    if (f.owners) f.owners[at] = id;
    digits.add(key, f.tile_passes);
  }
}

constexpr uint32_t kFew = 16;  // tiles; Gaussians of more are written by a whole warp

// ---- kernels ---------------------------------------------------------------------------------

// One thread per Gaussian. Those that reach a tile are numbered in the order of the inputs.
FP_KERNEL(fp_project, Frame, 3) {
  __shared__ Camera<float> camera;
  __shared__ uint32_t room[kWarps], ticket;
  __shared__ uint64_t base;
  __shared__ Digits digits;
  if (threadIdx.x == 0) camera = camera_of(f);
  digits.clear(kPasses);
  const uint32_t block = take_ticket(&f.counters->tickets[0], ticket);
  const size_t i = size_t{block} * kThreads + threadIdx.x;
  const size_t n = static_cast<size_t>(f.in.count);
  Projected o;
  o.tiles = 0;
  if (i < n) {
    o = project_one(f.in, camera, i);
    f.out.radii[i] = o.radius;
    f.tiles[i] = o.tiles;
  }
  const bool visible = o.tiles > 0;
  const uint32_t key = __float_as_uint(visible ? o.depth : 0.f);
  if (visible) {
    store_brush(f.brushes, i, o.brush);
    f.rects[i] = o.rect;
    digits.add(key, kPasses);
  }
  uint32_t total;
  const uint32_t before = block_scan(visible ? 1u : 0u, total, room);
  if (warp_of() == 0) {
    const uint64_t up_to = look_back(f.project_words, block, total);
    if (threadIdx.x == 0) {
      base = up_to;
      if (size_t{block + 1} * kThreads >= n) f.counters->visible = up_to + total;
    }
  }
  __syncthreads();
  if (visible) {
    f.depth_keys[base + before] = key;
    f.depth_ids[base + before] = static_cast<uint32_t>(i);
  }
  digits.flush(f.depth_histogram, kPasses);
}

// One thread per Gaussian that reaches a tile, front to back.
FP_KERNEL(fp_emit, Frame, 2) {
  __shared__ Camera<float> camera;
  __shared__ uint32_t room[kWarps], ticket;
  __shared__ uint64_t base;
  __shared__ Digits digits;
  const uint32_t block = take_ticket(&f.counters->tickets[1], ticket);
  const uint64_t visible = f.counters->visible;
  if (uint64_t{block} * kThreads >= visible) return;
  if (threadIdx.x == 0) camera = camera_of(f);
  digits.clear(f.tile_passes);
  const uint64_t k = uint64_t{block} * kThreads + threadIdx.x;
  const uint32_t id = k < visible ? f.depth_ids[k] : 0;
  const uint32_t tiles = k < visible ? f.tiles[id] : 0;
  uint32_t total;
  const uint32_t before = block_scan(tiles, total, room);
  if (warp_of() == 0) {
    const uint64_t up_to = look_back(f.emit_words, block, total);
    if (threadIdx.x == 0) {
      base = up_to;
      if (uint64_t{block + 1} * kThreads >= visible) f.counters->entries = up_to + total;
    }
  }
  __syncthreads();
  const uint64_t at = base + before;
  if (tiles && f.first_slot) f.first_slot[id] = static_cast<uint32_t>(at);
  if (tiles && tiles <= kFew) {
    const Bounds<float> bounds = bounds_again(f, camera, id);
    int row;
    const int rows = rows_of(bounds, row);
    uint64_t to = at;
    for (const int end = row + rows; row < end; row++) {
      int first, past;
      columns_of(bounds, row, first, past);
      emit_row(f, digits, id, row, first, past, to);
      to += static_cast<uint32_t>(past - first);
    }
  }
  for (uint32_t todo = __ballot_sync(kAll, tiles > kFew); todo; todo &= todo - 1) {
    const int whose = __ffs(todo) - 1;
    const uint32_t its_id = __shfl_sync(kAll, id, whose);
    uint64_t to = __shfl_sync(kAll, at, whose);
    const Bounds<float> bounds = bounds_again(f, camera, its_id);
    int first_row;
    const int rows = rows_of(bounds, first_row);
    for (int r = 0; r < rows; r += 32) {  // a row of tiles per lane
      const int row = first_row + r + lane_of();
      int first = 0, past = 0;
      if (r + lane_of() < rows) columns_of(bounds, row, first, past);
      uint32_t of_warp;
      const uint32_t below = warp_scan(static_cast<uint32_t>(past - first), of_warp);
      emit_row(f, digits, its_id, row, first, past, to + below);
      to += of_warp;
    }
  }
  __syncthreads();
  digits.flush(f.tile_histogram, f.tile_passes);
}

// One pass of a stable radix sort (Adinets and Merrill's Onesweep): a block finds how many of each
// digit its own keys and those of the blocks before have, then puts each key in its place.
FP_KERNEL(fp_sort, Sort, 2) {
  __shared__ uint32_t counts[kWarps][kDigits];  // of each warp; later, of the warps before
  __shared__ uint32_t place[kDigits];
  __shared__ uint32_t room[kWarps], ticket;
  constexpr int per_block = kThreads * kSortItems;
  const uint32_t block = take_ticket(f.ticket, ticket);
  const uint64_t n = *f.count < f.capacity ? *f.count : f.capacity;
  if (uint64_t{block} * per_block >= n) return;
  for (int w = 0; w < kWarps; w++) counts[w][threadIdx.x] = 0;
  __syncthreads();
  // A warp's keys lie together, and each of its rounds takes the next 32: order is kept.
  const uint64_t from = uint64_t{block} * per_block + warp_of() * 32 * kSortItems + lane_of();
  const uint32_t below = (1u << lane_of()) - 1;
  uint32_t* mine = counts[warp_of()];
  uint32_t keys[kSortItems], ranks[kSortItems];
#pragma unroll
  for (int k = 0; k < kSortItems; k++) {
    const bool meant = from + 32 * k < n;
    keys[k] = meant ? f.keys[from + 32 * k] : 0;
    const uint32_t digit = keys[k] >> f.shift & (kDigits - 1);
    // those that are not meant are alike, and like no digit
    const uint32_t alike = __match_any_sync(kAll, meant ? digit : uint32_t{kDigits});
    const uint32_t earlier = meant ? mine[digit] : 0;
    ranks[k] = earlier + __popc(alike & below);
    __syncwarp();
    if (meant && (alike & below) == 0) mine[digit] = earlier + __popc(alike);
    __syncwarp();
  }
  __syncthreads();
  const int d = threadIdx.x;  // one digit per thread
  uint32_t in_block = 0;
  for (int w = 0; w < kWarps; w++) {
    const uint32_t of_warp = counts[w][d];
    counts[w][d] = in_block;
    in_block += of_warp;
  }
  // Words as in look_back, with numbers of 30 bits.
  constexpr uint32_t own = 1u << 30, up_to = 2u << 30;
  uint32_t* word = f.words + size_t{block} * kDigits + d;
  atomicExch(word, (block == 0 ? up_to : own) | in_block);
  uint32_t before = 0;
  for (uint32_t b = block; b > 0;) {
    const volatile uint32_t* earlier = f.words + size_t{--b} * kDigits + d;
    uint32_t v = *earlier;
    for (; v == 0; v = *earlier) FP_PAUSE();
    before += v & (own - 1);
    if (v & up_to) break;
  }
  if (block > 0) atomicExch(word, up_to | (before + in_block));
  uint32_t total;
  place[d] = before + block_scan(f.histogram[d], total, room);
  __syncthreads();
#pragma unroll
  for (int k = 0; k < kSortItems; k++) {
    if (from + 32 * k >= n) break;
    const uint32_t digit = keys[k] >> f.shift & (kDigits - 1);
    const uint32_t to = place[digit] + counts[warp_of()][digit] + ranks[k];
    f.sorted_keys[to] = keys[k];
    f.sorted_values[to] = f.values[from + 32 * k];
  }
}

// Where each tile's entries begin and end; tiles of none keep their zeros.
FP_KERNEL(fp_ranges, Frame, 2) {
  const uint64_t n = f.counters->entries < f.capacity ? f.counters->entries : f.capacity;
  const uint64_t i = uint64_t{blockIdx.x} * kThreads + threadIdx.x;
  if (i >= n) return;
  const uint32_t tile = f.entry_keys[i];
  if (i == 0 || f.entry_keys[i - 1] != tile) f.ranges[tile].first = static_cast<uint32_t>(i);
  if (i + 1 == n || f.entry_keys[i + 1] != tile) f.ranges[tile].end = static_cast<uint32_t>(i + 1);
}

}  // namespace fp
