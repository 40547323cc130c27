// A tile in the hands of a block: one pixel per thread, an 8x4 sub-tile per warp.
#pragma once

#include "block.cuh"

namespace fp {

constexpr int kSubWidth = 8, kSubHeight = 4;
static_assert(kSubWidth * kSubHeight == 32 && kTile == 2 * kSubWidth && kTile == 4 * kSubHeight,
              "eight warps cover a tile");

struct Pixel {
  int tile_x, tile_y;  // of the tile's first pixel
  int x, y;            // in the image
  bool inside;         // the image
  float px, py;        // where it is sampled, from the tile's first pixel
  size_t at;           // in a plane of the image
  float spread;        // how far from their places pixels are sampled at most
};

__device__ inline Pixel pixel_of(const Frame& f) {
  Pixel p;
  p.tile_x = static_cast<int>(blockIdx.x) % f.tiles_x * kTile;
  p.tile_y = static_cast<int>(blockIdx.x) / f.tiles_x * kTile;
  const int dx = (warp_of() & 1) * kSubWidth + (lane_of() & (kSubWidth - 1));
  const int dy = (warp_of() >> 1) * kSubHeight + lane_of() / kSubWidth;
  p.x = p.tile_x + dx, p.y = p.tile_y + dy;
  p.inside = p.x < f.in.width && p.y < f.in.height;
  p.px = static_cast<float>(dx), p.py = static_cast<float>(dy);
  p.at = static_cast<size_t>(p.y) * f.in.width + p.x;
  p.spread = f.spread ? *f.spread : 0.f;
  if (f.in.sample_offsets && p.inside) {
    p.px = p.px + f.in.sample_offsets[2 * p.at];
    p.py = p.py + f.in.sample_offsets[2 * p.at + 1];
  }
  return p;
}

// Bit w: the brush reaches the sub-tile of warp w.
__device__ inline uint8_t sub_tiles_of(const Brush<float>& b, const Pixel& tile) {
  const float x = b.x - static_cast<float>(tile.tile_x), y = b.y - static_cast<float>(tile.tile_y);
  const Ellipse<float> e = ellipse_of(b.scale, b.skew, b.down, b.log_opacity - b.list_cut, tile.spread);
  const float above = y - tile.spread, below = y + tile.spread;  // see Bounds
  const float top = ceil(y - e.half_height), bottom = floor(y + e.half_height);
  uint32_t reached = 0;
#pragma unroll
  for (int band = 0; band < kTile / kSubHeight; band++) {
    const float first = static_cast<float>(band * kSubHeight);
    const float low = max(top, first), high = min(bottom, first + (kSubHeight - 1));
    if (!ge(high, low)) continue;
    const float right = floor(x + span_end(e, low - below, high - above, 1.f));
    const float left = ceil(x + span_end(e, low - below, high - above, -1.f));
    if (!ge(right, left)) continue;
    if (left <= kSubWidth - 1 && right >= 0.f) reached |= 1u << 2 * band;
    if (left <= kTile - 1 && right >= kSubWidth) reached |= 2u << 2 * band;
  }
  return static_cast<uint8_t>(reached);
}

// Up to kThreads Gaussians of the tile's list, one brought in by each thread, read by all.
struct Staged {
  float4 a[kThreads];  // scale, skew, u0, down
  float4 b[kThreads];  // v0, log_opacity, cut, inv_z
  float4 c[kThreads];  // r, g, b, list_cut
  uint32_t row[kThreads];  // or entry
  uint8_t reached[kThreads];  // sub-tiles

  __device__ void put(int j, const Brush<float>& brush, uint32_t its_row, const Pixel& tile) {
    const LocalBrush<float> l = localize(brush, static_cast<float>(tile.tile_x),
                                         static_cast<float>(tile.tile_y));
    a[j] = make_float4(l.scale, l.skew, l.u0, l.down);
    b[j] = make_float4(l.v0, l.log_opacity, l.cut, l.inv_z);
    c[j] = make_float4(l.r, l.g, l.b, brush.list_cut);
    row[j] = its_row;
  }
  __device__ LocalBrush<float> get(int j) const {
    const float4 p = a[j], q = b[j], s = c[j];
    return {p.x, p.y, p.z, p.w, q.x, q.y, q.z, s.x, s.y, s.z, q.w};
  }
  // Which of the 32 Gaussians from j on reach this warp's sub-tile.
  __device__ uint32_t word(int j) const {
    return __ballot_sync(kAll, reached[j + lane_of()] >> warp_of() & 1);
  }
};

}  // namespace fp
