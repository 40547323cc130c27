// Counts what warps ask of memory. Kernels that are compiled for ThreadSanitizer call its hooks at
// every access; here they are answered by others, which note it. What the lanes of a warp ask at
// one place of the code, each for the same time, is one request: of sectors of 32 bytes, or of
// shared memory, of which each of 32 banks gives one word of 4 bytes a turn.
//
// What lies on a stack is left out: a GPU has it in registers. Run one block at a time.
#include <algorithm>
#include <map>
#include <vector>

#include "emulation.h"

extern char __start_emulated_shared[] __attribute__((weak));
extern char __stop_emulated_shared[] __attribute__((weak));

namespace {

enum Kind { kRead, kWrite, kAtomic, kShared, kKinds };

struct Count {
  int64_t requests, lanes;
  int64_t units;  // sectors that requests ask for; or turns of shared memory
  int64_t least;  // sectors, each once for a block; or turns if no two words lay in one bank
} counts[kKinds];

struct Access {
  const void* place;
  int turn;  // at this place
  Kind kind;
  uintptr_t at, size;
  bool operator<(const Access& other) const {
    return place != other.place ? place < other.place : turn < other.turn;
  }
};

struct Lane {
  std::vector<Access> accesses;
  std::map<const void*, int> turns;
} lanes[1024];


void note(const void* place, Kind kind, const volatile void* where, uintptr_t size) {
  if (emulated::on_stack(where) || where == &threadIdx.x || where == &blockIdx.x) return;
  const auto at = reinterpret_cast<uintptr_t>(where);
  Lane& lane = lanes[threadIdx.x];
  if (at >= reinterpret_cast<uintptr_t>(__start_emulated_shared) &&
      at < reinterpret_cast<uintptr_t>(__stop_emulated_shared))
    kind = kShared;
  const uintptr_t step = size <= 8 ? 8 : at % 16 == 0 && size % 16 == 0 ? 16 : 4;
  for (uintptr_t done = 0; done < size; done += step) {
    const auto part = static_cast<const char*>(place) + done;  // an instruction of its own
    lane.accesses.push_back({part, lane.turns[part]++, kind, at + done, std::min(step, size - done)});
  }
}

int64_t distinct(std::vector<uintptr_t>& all) {
  std::sort(all.begin(), all.end());
  all.erase(std::unique(all.begin(), all.end()), all.end());
  return static_cast<int64_t>(all.size());
}

std::vector<uintptr_t> of_block[kKinds];  // sectors

// The parts of memory, of so many bytes each, that a request asks for.
std::vector<uintptr_t> parts(const Access* request, size_t n, uintptr_t bytes) {
  std::vector<uintptr_t> all;
  for (const Access* a = request; a < request + n; a++)
    for (uintptr_t p = a->at / bytes; p <= (a->at + a->size - 1) / bytes; p++) all.push_back(p);
  distinct(all);
  return all;
}

void count(const Access* request, size_t n) {
  Count& to = counts[request->kind];
  to.requests++, to.lanes += static_cast<int64_t>(n);
  if (request->kind == kShared) {
    int64_t banks[32] = {};
    const std::vector<uintptr_t> words = parts(request, n, 4);
    for (uintptr_t word : words) banks[word % 32]++;
    to.units += *std::max_element(banks, banks + 32);
    to.least += static_cast<int64_t>(words.size() + 31) / 32;
  } else {
    const std::vector<uintptr_t> sectors = parts(request, n, 32);
    to.units += static_cast<int64_t>(sectors.size());
    std::vector<uintptr_t>& all = of_block[request->kind];
    all.insert(all.end(), sectors.begin(), sectors.end());
  }
}

}  // namespace

// Threads of the block that have met: what they asked for since the last time is complete.
extern "C" void emulated_met(int begin, int end) {
  for (int first = begin; first < end; first += 32) {
    std::vector<Access> all;
    for (Lane* lane = lanes + first; lane < lanes + first + 32; lane++) {
      all.insert(all.end(), lane->accesses.begin(), lane->accesses.end());
      *lane = Lane();
    }
    std::sort(all.begin(), all.end());
    for (size_t i = 0, next; i < all.size(); i = next) {
      for (next = i; next < all.size() && !(all[i] < all[next]);) next++;
      count(&all[i], next - i);
    }
  }
}

// A block is over.
extern "C" void emulated_left() {
  for (int kind = 0; kind < kKinds; kind++) {
    if (kind != kShared) counts[kind].least += distinct(of_block[kind]);
    of_block[kind].clear();
  }
}

// (kKinds, 4) counts since the last call.
extern "C" __attribute__((visibility("default"))) void emulated_traffic(int64_t* to) {
  memcpy(to, counts, sizeof counts);
  memset(counts, 0, sizeof counts);
}

#define HERE __builtin_return_address(0)
#define ACCESSES(size)                                                                    \
  extern "C" void __tsan_read##size(void* at) { note(HERE, kRead, at, size); }            \
  extern "C" void __tsan_write##size(void* at) { note(HERE, kWrite, at, size); }          \
  extern "C" void __tsan_unaligned_read##size(void* at) { note(HERE, kRead, at, size); }  \
  extern "C" void __tsan_unaligned_write##size(void* at) { note(HERE, kWrite, at, size); }
ACCESSES(1) ACCESSES(2) ACCESSES(4) ACCESSES(8) ACCESSES(16)
extern "C" void __tsan_read_range(void* at, uintptr_t size) { note(HERE, kRead, at, size); }
extern "C" void __tsan_write_range(void* at, uintptr_t size) { note(HERE, kWrite, at, size); }
extern "C" void __tsan_init() {}
extern "C" void __tsan_func_entry(void*) {}
extern "C" void __tsan_func_exit() {}

// Loads are of loops that stand for one addition of a GPU's.
#define ATOMICS(bits, T)                                                                     \
  extern "C" T __tsan_atomic##bits##_load(const volatile T* at, int) {                       \
    return __atomic_load_n(at, __ATOMIC_RELAXED);                                            \
  }                                                                                          \
  extern "C" T __tsan_atomic##bits##_fetch_add(volatile T* at, T v, int) {                   \
    note(HERE, kAtomic, at, sizeof v);                                                       \
    return __atomic_fetch_add(at, v, __ATOMIC_RELAXED);                                      \
  }                                                                                          \
  extern "C" T __tsan_atomic##bits##_exchange(volatile T* at, T v, int) {                    \
    note(HERE, kAtomic, at, sizeof v);                                                       \
    return __atomic_exchange_n(at, v, __ATOMIC_RELAXED);                                     \
  }                                                                                          \
  extern "C" int __tsan_atomic##bits##_compare_exchange_weak(volatile T* at, T* was, T v, int, \
                                                             int) {                          \
    note(HERE, kAtomic, at, sizeof v);                                                       \
    return __atomic_compare_exchange_n(at, was, v, false, __ATOMIC_RELAXED, __ATOMIC_RELAXED); \
  }                                                                                          \
  extern "C" int __tsan_atomic##bits##_compare_exchange_strong(volatile T* at, T* was, T v,   \
                                                               int, int) {                   \
    note(HERE, kAtomic, at, sizeof v);                                                       \
    return __atomic_compare_exchange_n(at, was, v, false, __ATOMIC_RELAXED, __ATOMIC_RELAXED); \
  }
ATOMICS(32, uint32_t) ATOMICS(64, uint64_t)
