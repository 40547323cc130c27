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

// A lane reads what another stored before both voted: a vote is no fence.
FP_KERNEL(fp_ballot_for_fence, Numbers, 1) {
  __shared__ uint32_t mine[256];
  mine[threadIdx.x] = threadIdx.x;
  __ballot_sync(0xffffffffu, true);
  f.to[256 * blockIdx.x + threadIdx.x] = mine[threadIdx.x ^ 1];
}

FP_KERNEL(fp_syncwarp, Numbers, 1) {
  __shared__ uint32_t mine[256];
  mine[threadIdx.x] = threadIdx.x;
  __syncwarp();
  f.to[256 * blockIdx.x + threadIdx.x] = mine[threadIdx.x ^ 1];
}

// The block that begins first stores a number, then a flag; the others wait for the flag, which says
// nothing of the number.
FP_KERNEL(fp_flag_without_fence, Numbers, 1) {
  if (threadIdx.x > 0) return;
  uint32_t *ticket = f.to, *flag = f.to + 1, *number = f.to + 2;
  if (atomicAdd(ticket, 1u) == 0) {
    *number = 7;
    atomicExch(flag, 1u);
  } else {
    while (*const_cast<volatile uint32_t*>(flag) == 0) FP_PAUSE();
    f.to[3 + blockIdx.x] = *number;
  }
}

// Which it does when the number itself is what is waited for.
FP_KERNEL(fp_number_is_flag, Numbers, 1) {
  if (threadIdx.x > 0) return;
  uint32_t *ticket = f.to, *number = f.to + 2;
  if (atomicAdd(ticket, 1u) == 0) {
    atomicExch(number, 7u);
  } else {
    uint32_t v;
    while ((v = *const_cast<volatile uint32_t*>(number)) == 0) FP_PAUSE();
    f.to[3 + blockIdx.x] = v;
  }
}

FP_KERNEL(fp_beyond_its_shared_memory, Numbers, 1) {
  __shared__ uint32_t mine[256];
  mine[threadIdx.x + 1] = 0;
  __syncthreads();
  f.to[threadIdx.x] = mine[threadIdx.x];
}

FP_KERNEL(fp_beyond_its_array, Numbers, 1) { f.to[256 * (blockIdx.x + 1) + threadIdx.x] = 0; }

FP_KERNEL(fp_shifts_too_far, Numbers, 1) { f.to[threadIdx.x] = 1 << (f.to[1] + 32 + threadIdx.x); }

// The first block waits for the last, which others may keep from starting.
FP_KERNEL(fp_waits_forever, Numbers, 1) {
  volatile uint32_t* flag = f.to;
  while (*flag == 0) FP_PAUSE();
}

}  // namespace fp
