// Blending, front to back. A block takes a tile, a warp its sub-tile: it meets those Gaussians
// alone whose cutoff ellipse reaches there, and no exponential is taken outside the ellipse.

#include "tile.cuh"

#ifndef FP_COUNTS  // count fragments per pixel and per Gaussian
#define FP_COUNTS 0
#endif
#ifndef FP_SCORES  // also the Gaussians' weights, and who wins which pixel
#define FP_SCORES 0
#endif
#ifndef FP_STOP  // the fragment that crosses the line is drawn
#define FP_STOP 0
#endif

namespace fp {

FP_KERNEL(fp_blend, Frame, 2) {
  __shared__ Staged staged;
  const Pixel p = pixel_of(f);
  const Range range = f.ranges[blockIdx.x];
  float light = 1.f, r = 0.f, g = 0.f, blue = 0.f, inv_z = 0.f;
  int32_t drawn = 0, stop = static_cast<int32_t>(range.end - range.first);
  uint32_t met = 0;
#if FP_FEATURES
  float features[FP_FEATURES] = {};
#endif
#if FP_SCORES
  float best = 0.f;
  int32_t winner = -1;
#endif
  bool alive = p.inside;
  for (uint32_t first = range.first; first < range.end; first += kThreads) {
    if (__syncthreads_and(!alive)) break;  // also: nobody reads the last batch any more
    const uint32_t mine = first + threadIdx.x;
    staged.reached[threadIdx.x] = 0;
    if (mine < range.end) {
      const uint32_t row = row_of(f, f.entry_values[mine]);
      const Brush<float> brush = load_brush(f.brushes, row);
      staged.put(threadIdx.x, brush, row, p);
      const uint8_t reached = sub_tiles_of(brush, p);
      staged.reached[threadIdx.x] = reached;
      if (f.reached) f.reached[mine] = reached;
    }
    __syncthreads();
    for (int base = 0; base < kThreads; base += 32) {
      if (!__any_sync(kAll, alive)) break;
      for (uint32_t todo = staged.word(base); todo; todo &= todo - 1) {
        const int j = base + __ffs(todo) - 1;
        const LocalBrush<float> b = staged.get(j);
        met++;
        const float exponent = meet(b, p.px, p.py).exponent;
        bool draws = alive && exponent >= b.cut;
        float weight = 0.f;
        if (draws) {
          const float alpha = min(exp2(exponent), f.in.alpha_max);
          const float after = fnma(light, alpha, light);
          if (FP_STOP || after >= kTransmittanceMin) {
            weight = alpha * light;
            light = after;
            r = fma(weight, b.r, r);
            g = fma(weight, b.g, g);
            blue = fma(weight, b.b, blue);
            inv_z = fma(weight, b.inv_z, inv_z);
#if FP_FEATURES
#pragma unroll
            for (int k = 0; k < FP_FEATURES; k++)
              features[k] = fma(weight, f.in.features[size_t{FP_FEATURES} * staged.row[j] + k], features[k]);
#endif
#if FP_SCORES
            if (weight > best) best = weight, winner = static_cast<int32_t>(staged.row[j]);
#endif
            drawn++;
          } else {
            alive = draws = false;
            stop = static_cast<int32_t>(first - range.first) + j;
          }
#if FP_STOP
          if (after < f.in.stop) {
            alive = false;
            stop = static_cast<int32_t>(first - range.first) + j + 1;
          }
#endif
        }
#if FP_COUNTS
        const uint32_t each = __popc(__ballot_sync(kAll, draws));
        if (lane_of() == 0 && each)
          atomicAdd(f.out.fragments_per_gaussian + staged.row[j], static_cast<int32_t>(each));
#endif
#if FP_SCORES  // whole numbers: the order of additions does not matter
        const float of_warp = warp_sum(weight);
        if (lane_of() == 0 && of_warp > 0.f)
          atomicAdd(reinterpret_cast<unsigned long long*>(f.weights + staged.row[j]),
                    static_cast<unsigned long long>(of_warp * 4294967296.f));
#endif
      }
    }
  }
  const uint32_t drawn_here = warp_sum(static_cast<uint32_t>(drawn));
  if (lane_of() == 0) {
    atomicAdd(reinterpret_cast<unsigned long long*>(&f.counters->drawn), 0ull + drawn_here);
    atomicAdd(reinterpret_cast<unsigned long long*>(&f.counters->evaluated), 32ull * met);
  }
  if (!p.inside) return;
  const size_t plane = static_cast<size_t>(f.in.width) * f.in.height;
  f.out.image[p.at] = fma(light, f.in.background[0], r);
  f.out.image[plane + p.at] = fma(light, f.in.background[1], g);
  f.out.image[2 * plane + p.at] = fma(light, f.in.background[2], blue);
  f.out.invdepth[p.at] = inv_z;
  f.out.alpha[p.at] = 1.f - light;
#if FP_COUNTS
  f.out.fragments[p.at] = drawn;
#endif
#if FP_FEATURES
#pragma unroll
  for (int k = 0; k < FP_FEATURES; k++) f.out.features[k * plane + p.at] = features[k];
#endif
#if FP_SCORES
  f.out.winners[p.at] = winner;
  if (winner >= 0) atomicAdd(f.out.wins_per_gaussian + winner, 1);
#endif
  if (f.transmittance) {
    f.transmittance[p.at] = light;
    f.stop[p.at] = stop;
  }
}

}  // namespace fp
