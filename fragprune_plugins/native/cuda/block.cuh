// What the threads of a warp, of a block, and of blocks in turn find out together.
#pragma once

#include "frame.h"

#ifndef FP_PAUSE  // while waiting for another block
#define FP_PAUSE() __nanosleep(32)
#endif

namespace fp {

constexpr uint32_t kAll = 0xffffffffu;

__device__ inline int lane_of() { return threadIdx.x & 31; }
__device__ inline int warp_of() { return threadIdx.x >> 5; }

template <class T>
__device__ inline T warp_sum(T v) {
  for (int step = 16; step > 0; step >>= 1) v += __shfl_xor_sync(kAll, v, step);
  return v;
}

// Sum over the lanes below, and over all.
__device__ inline uint32_t warp_scan(uint32_t mine, uint32_t& total) {
  uint32_t v = mine;
  for (int step = 1; step < 32; step <<= 1) {
    const uint32_t below = __shfl_up_sync(kAll, v, step);
    if (lane_of() >= step) v += below;
  }
  total = __shfl_sync(kAll, v, 31);
  return v - mine;
}

// Sum over the threads before, and over all. All threads call it; `room` is free again after the
// block's next barrier.
__device__ inline uint32_t block_scan(uint32_t mine, uint32_t& total, uint32_t (&room)[kWarps]) {
  uint32_t of_warp;
  const uint32_t below = warp_scan(mine, of_warp);
  if (lane_of() == 0) room[warp_of()] = of_warp;
  __syncthreads();
  uint32_t before = 0;
  total = 0;
  for (int w = 0; w < kWarps; w++) {
    if (w < warp_of()) before += room[w];
    total += room[w];
  }
  return before + below;
}

// Blocks take numbers as they start, for those that wait for others must wait for such as run.
__device__ inline uint32_t take_ticket(uint32_t* ticket, uint32_t& room) {
  if (threadIdx.x == 0) room = atomicAdd(ticket, 1u);
  __syncthreads();
  return room;
}

// A number that other blocks wait for, and what it is, in one word: no order among words matters.
constexpr uint64_t kOwn = 1ull << 62, kUpTo = 2ull << 62, kNumber = kOwn - 1;

__device__ inline void publish(uint64_t* word, uint64_t value) {
  atomicExch(reinterpret_cast<unsigned long long*>(word), static_cast<unsigned long long>(value));
}
__device__ inline uint64_t await(const uint64_t* word) {
  for (;;) {
    const uint64_t v = *const_cast<const volatile uint64_t*>(word);
    if (v) return v;
    FP_PAUSE();
  }
}

// Sum of `mine` over the blocks before this one, by one whole warp (Merrill and Garland's decoupled
// look-back: own sums are known at once, sums up to here as soon as those before are).
__device__ inline uint64_t look_back(uint64_t* words, uint32_t block, uint64_t mine) {
  const int lane = lane_of();
  if (lane == 0) publish(words + block, (block == 0 ? kUpTo : kOwn) | mine);
  uint64_t before = 0;
  for (int64_t at = static_cast<int64_t>(block) - 1; at >= 0; at -= 32) {
    const int64_t k = at - lane;
    const uint64_t word = k < 0 ? kUpTo : await(words + k);
    const uint32_t up_to = __ballot_sync(kAll, (word & kUpTo) != 0);
    const int nearest = up_to ? __ffs(up_to) - 1 : 31;
    before += warp_sum(lane <= nearest ? word & kNumber : uint64_t{0});
    if (up_to) break;
  }
  if (lane == 0 && block > 0) publish(words + block, kUpTo | (before + mine));
  return before;
}

}  // namespace fp
