// Kernels with the faults that the emulation must notice.
#include <stdint.h>

namespace fp {

struct Numbers {
  uint32_t* to;
};

// Reads what another thread writes, without a barrier.
FP_KERNEL(fp_no_barrier, Numbers, 1) {
  __shared__ uint32_t mine[256];
  mine[threadIdx.x] = threadIdx.x;
  f.to[256 * blockIdx.x + threadIdx.x] = mine[255 - threadIdx.x];
}

FP_KERNEL(fp_with_barrier, Numbers, 1) {
  __shared__ uint32_t mine[256];
  mine[threadIdx.x] = threadIdx.x;
  __syncthreads();
  f.to[256 * blockIdx.x + threadIdx.x] = mine[255 - threadIdx.x];
}

FP_KERNEL(fp_parted, Numbers, 1) {
  if (threadIdx.x < 128)
    __syncthreads();
  else
    __syncthreads_and(true);
}

FP_KERNEL(fp_left, Numbers, 1) {
  if (threadIdx.x == 3) return;
  __syncthreads();
}

FP_KERNEL(fp_lane_left, Numbers, 1) {
  if (threadIdx.x == 3) return;
  f.to[threadIdx.x] = __ballot_sync(0xffffffffu, true);
}

FP_KERNEL(fp_half_a_warp, Numbers, 1) {
  if (threadIdx.x & 1) f.to[threadIdx.x] = __ballot_sync(0xaaaaaaaau, true);
}

// The first block waits for the last, which others may keep from starting.
FP_KERNEL(fp_waits_forever, Numbers, 1) {
  volatile uint32_t* flag = f.to;
  while (*flag == 0) FP_PAUSE();
}

}  // namespace fp
