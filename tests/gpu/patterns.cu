// Kernels whose traffic can be told by hand.
#include <stdint.h>

namespace fp {

struct Numbers {
  uint32_t* to;
};

struct alignas(16) Four {
  uint32_t of[4];
};

FP_KERNEL(fp_row, Numbers, 1) { f.to[threadIdx.x] = 1; }

FP_KERNEL(fp_every_eighth, Numbers, 1) { f.to[8 * threadIdx.x] = 1; }

FP_KERNEL(fp_twice, Numbers, 1) {
  f.to[threadIdx.x] = 1;
  f.to[threadIdx.x ^ 1] = 2;
}

FP_KERNEL(fp_half_of_a_warp, Numbers, 1) {
  if (threadIdx.x & 16) f.to[threadIdx.x] = 1;
}

FP_KERNEL(fp_fours, Numbers, 1) { reinterpret_cast<Four*>(f.to)[threadIdx.x] = Four{}; }

FP_KERNEL(fp_adds, Numbers, 1) { atomicAdd(f.to, 1u); }

FP_KERNEL(fp_banks, Numbers, 1) {
  __shared__ uint32_t words[33 * 32];
  if (words[threadIdx.x] == 7) f.to[0] = 1;
}

FP_KERNEL(fp_one_bank, Numbers, 1) {
  __shared__ uint32_t words[32 * 256];
  if (words[32 * threadIdx.x] == 7) f.to[0] = 1;
}

FP_KERNEL(fp_two_banks, Numbers, 1) {
  __shared__ uint32_t words[32 * 256];
  if (words[16 * threadIdx.x] == 7) f.to[0] = 1;
}

FP_KERNEL(fp_one_word, Numbers, 1) {
  __shared__ uint32_t words[32];
  if (words[0] == 7) f.to[0] = 1;
}

FP_KERNEL(fp_shared_fours, Numbers, 1) {
  __shared__ Four fours[256];
  const Four four = fours[threadIdx.x];
  if (four.of[0] + four.of[3] == 7) f.to[0] = 1;
}

}  // namespace fp
