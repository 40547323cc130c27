// The execution model of a GPU on one CPU thread: the kernels' sources, unchanged, run as C++. A
// block's threads are fibers, which run in random order from one barrier or warp operation to the
// next; a few blocks are under way at a time, taken from the grid and continued in random order;
// shared memory is filled with NaN before each block. What works in one order only, or reads what
// nobody wrote, shows.
//
// Under ThreadSanitizer it knows what a GPU promises, and no more: fibers are threads, barriers and
// __syncwarp order what lies before and after them; shuffles, votes and atomics order nothing. So it
// reports what happens to work here and need not there.
//
// Stops with a message when threads wait for each other forever, when the lanes of a warp meet at
// different operations, or when a thread has left while others wait for it.
#pragma once

#include <math.h>
#include <stdint.h>
#include <string.h>

#include <type_traits>

#define FP_EMULATED
#define UNSEEN __attribute__((no_sanitize("thread")))  // by what counts or orders accesses
#define __device__
#define __host__
#define __global__
#define __launch_bounds__(...)
#define __shared__ static __attribute__((section("emulated_shared")))

struct alignas(16) float4 {
  float x, y, z, w;
};
inline float4 make_float4(float x, float y, float z, float w) { return {x, y, z, w}; }


struct Index {
  unsigned x, y, z;
};
extern Index threadIdx, blockIdx;

namespace emulated {

template <class T>
UNSEEN inline uint64_t as_word(T v) {
  static_assert(sizeof v <= 8, "");
  uint64_t word = 0;
  memcpy(&word, &v, sizeof v);
  return word;
}
template <class T>
UNSEEN inline T from_word(uint64_t word) {
  T v;
  memcpy(&v, &word, sizeof v);
  return v;
}

// What each lane of this warp gave to the operation in `line`, which may be a fence, too.
const uint64_t* exchange(int line, uint32_t mask, uint64_t given, bool fence = false);
bool barrier(int line, bool v);  // whether all threads of the block gave true
void pause();
bool on_stack(const volatile void* at);  // of the thread that runs
inline int lane() { return static_cast<int>(threadIdx.x) & 31; }

template <class T>
UNSEEN inline T shuffle(int line, uint32_t mask, T v, int from) {
  const uint64_t* all = exchange(line, mask, as_word(v));
  return from_word<T>(from >= 0 && from < 32 ? all[from] : all[lane()]);
}
UNSEEN inline uint32_t ballot(int line, uint32_t mask, bool v) {
  const uint64_t* all = exchange(line, mask, v);
  uint32_t bits = 0;
  for (int l = 0; l < 32; l++) bits |= static_cast<uint32_t>(all[l] & 1) << l;
  return bits;
}
UNSEEN inline uint32_t match(int line, uint32_t mask, uint32_t v) {
  const uint64_t* all = exchange(line, mask, v);
  uint32_t bits = 0;
  for (int l = 0; l < 32; l++) bits |= static_cast<uint32_t>(all[l] == v) << l;
  return bits;
}

// A result as it is; or with -DEMULATED_ROUGH off by up to so many units in the last place, always
// the same, as a GPU's special unit gives it.
inline float rounded(float v, int units) {
#ifdef EMULATED_ROUGH
  const uint32_t bits = static_cast<uint32_t>(as_word(v)), low = (1u << 23) - 1;
  if ((bits & low) < 8 || (bits & low) > low - 8 || !isfinite(v)) return v;
  const int by = static_cast<int>((bits * 2654435761u >> 16) % (2 * units + 1)) - units;
  return from_word<float>(bits + static_cast<uint32_t>(by));
#else
  static_cast<void>(units);
  return v;
#endif
}

// Makes a kernel known by its name.
struct Register {
  Register(const char* name, void (*run)(const void*));
};

}  // namespace emulated

#define __shfl_sync(mask, v, from) emulated::shuffle(__LINE__, mask, v, from)
#define __shfl_xor_sync(mask, v, by) emulated::shuffle(__LINE__, mask, v, emulated::lane() ^ (by))
#define __shfl_up_sync(mask, v, by) emulated::shuffle(__LINE__, mask, v, emulated::lane() - (by))
#define __shfl_down_sync(mask, v, by) emulated::shuffle(__LINE__, mask, v, emulated::lane() + (by))
#define __ballot_sync(mask, v) emulated::ballot(__LINE__, mask, v)
#define __any_sync(mask, v) (emulated::ballot(__LINE__, mask, v) != 0)
#define __match_any_sync(mask, v) emulated::match(__LINE__, mask, v)
#define __syncwarp() emulated::exchange(__LINE__, 0xffffffffu, 0, true)
#define __syncthreads() emulated::barrier(__LINE__, true)
#define __syncthreads_and(v) emulated::barrier(__LINE__, v)
#define FP_PAUSE() emulated::pause()
#define __popc(v) __builtin_popcount(v)
#define __ffs(v) __builtin_ffs(static_cast<int>(v))
#define __clz(v) ((v) ? __builtin_clz(v) : 32)

inline uint32_t __float_as_uint(float v) { return emulated::from_word<uint32_t>(emulated::as_word(v)); }

template <class T, class U>
inline T atomicAdd(T* at, U v) {
  if constexpr (std::is_integral<T>::value) {
    return __atomic_fetch_add(at, static_cast<T>(v), __ATOMIC_RELAXED);
  } else {
    T before, after;
    __atomic_load(at, &before, __ATOMIC_RELAXED);
    do after = before + static_cast<T>(v);
    while (!__atomic_compare_exchange(at, &before, &after, true, __ATOMIC_RELAXED, __ATOMIC_RELAXED));
    return before;
  }
}
template <class T, class U>
inline T atomicExch(T* at, U v) {
  return __atomic_exchange_n(at, static_cast<T>(v), __ATOMIC_RELAXED);
}

#define FP_KERNEL(name, Arguments, blocks)                                      \
  static void name(const Arguments f);                                          \
  static emulated::Register name##_registered(                                  \
      #name, [](const void* a) UNSEEN { name(*static_cast<const Arguments*>(a)); }); \
  static void name(const Arguments f)
