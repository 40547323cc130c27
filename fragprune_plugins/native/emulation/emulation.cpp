// The machine behind emulation.h.
#include "emulation.h"

#include <setjmp.h>
#include <sys/mman.h>
#include <ucontext.h>

#include <algorithm>
#include <map>
#include <random>
#include <stdexcept>
#include <string>
#include <vector>

// Of the section that holds shared memory; absent where a source has none.
extern char __start_emulated_shared[] __attribute__((weak));
extern char __stop_emulated_shared[] __attribute__((weak));

Index threadIdx, blockIdx;

// ThreadSanitizer's own, where it is loaded.
#define WEAK extern "C" __attribute__((weak))
WEAK void* __tsan_get_current_fiber();
WEAK void* __tsan_create_fiber(unsigned);
WEAK void __tsan_destroy_fiber(void*);
WEAK void __tsan_switch_to_fiber(void*, unsigned);
WEAK void __tsan_acquire(void*);
WEAK void __tsan_release(void*);
// Of traffic.cpp, where accesses are counted.
WEAK void emulated_met(int begin, int end);
WEAK void emulated_left();
// What ThreadSanitizer is told of volatile accesses: nothing, they are atomic.
#define SILENT(size)                                  \
  extern "C" void __tsan_volatile_read##size(void*) {} \
  extern "C" void __tsan_volatile_write##size(void*) {}
SILENT(1) SILENT(2) SILENT(4) SILENT(8) SILENT(16)

namespace emulated {

constexpr int kMostResident = 3;  // blocks that run at a time
constexpr int kPatience = 4000;  // turns in which nobody does anything but wait

enum class Wait { kNothing, kPause, kBlock, kWarp, kGone };

// What happened before a release of it happened before its acquisition, by threads.
struct Order {
  char at[2];  // as atomics have addresses; a barrier uses them in turns
  void acquire(int turn = 0) { if (__tsan_acquire) __tsan_acquire(at + turn); }
  void release(int turn = 0) { if (__tsan_release) __tsan_release(at + turn); }
};

struct Fiber {
  void* tsan = nullptr;
  ucontext_t start;
  jmp_buf here;
  std::vector<char> stack;
  bool started = false;
  Wait wait = Wait::kNothing;
  int barriers = 0, fences = 0;  // that it has met
  int line = 0;        // of the operation that it waits at
  uint64_t given = 0;  // to the operation
};

struct Block {
  unsigned index = 0;
  std::vector<Fiber> fibers;
  std::vector<char> shared;
  uint64_t warp_given[32][32];  // to the operation that was completed last
  bool block_all = false;       // what the last barrier found
  Order barrier, warps[32];
};

struct Machine {
  std::mt19937 random{1};
  jmp_buf scheduler;
  void* tsan = __tsan_get_current_fiber ? __tsan_get_current_fiber() : nullptr;
  Order from_scheduler, to_scheduler;
  Block* block = nullptr;
  int thread = 0;
  void (*body)(const void*) = nullptr;
  const void* arguments = nullptr;
  Fiber& fiber() { return block->fibers[thread]; }
};
Machine& machine() {
  static Machine m;
  return m;
}

[[noreturn]] void fail(const std::string& what) { throw std::runtime_error(what); }

constexpr unsigned kNoOrder = 1;  // of switching

[[noreturn]] void leave() {
  Machine& m = machine();
  if (m.tsan) __tsan_switch_to_fiber(m.tsan, kNoOrder);
  _longjmp(m.scheduler, 1);
}

// Gives way to the other threads until the scheduler comes back.
void wait(Wait kind, int line, uint64_t given) {
  Machine& m = machine();
  Fiber& fiber = m.fiber();
  fiber.wait = kind, fiber.line = line, fiber.given = given;
  if (_setjmp(fiber.here) == 0) leave();
  m.from_scheduler.acquire();
}

void enter() {
  Machine& m = machine();
  m.from_scheduler.acquire();
  m.body(m.arguments);
  m.to_scheduler.release();
  m.fiber().wait = Wait::kGone;
  leave();
}

void resume(int thread) {
  Machine& m = machine();
  m.thread = thread;
  threadIdx = {static_cast<unsigned>(thread), 0, 0};
  Fiber& fiber = m.fiber();
  fiber.wait = Wait::kNothing;
  if (_setjmp(m.scheduler) != 0) return;
  if (m.tsan && !fiber.tsan) fiber.tsan = __tsan_create_fiber(0);
  if (m.tsan) __tsan_switch_to_fiber(fiber.tsan, kNoOrder);
  if (fiber.started) _longjmp(fiber.here, 1);
  fiber.started = true;
  fiber.stack.resize(1 << 16);
  getcontext(&fiber.start);
  fiber.start.uc_stack.ss_sp = fiber.stack.data();
  fiber.start.uc_stack.ss_size = fiber.stack.size();
  fiber.start.uc_link = nullptr;
  makecontext(&fiber.start, enter, 0);
  setcontext(&fiber.start);
}

// Releases the warps whose 32 lanes wait at one operation, and the block at its barrier.
bool release(Block& block) {
  const int n = static_cast<int>(block.fibers.size());
  bool any = false;
  for (int w = 0; w < n / 32; w++) {
    Fiber* lanes = &block.fibers[32 * w];
    int waiting = 0, gone = 0;
    for (int l = 0; l < 32; l++)
      waiting += lanes[l].wait == Wait::kWarp, gone += lanes[l].wait == Wait::kGone;
    if (waiting && gone) fail("a lane has left while others of its warp wait for it");
    if (waiting < 32) continue;
    for (int l = 0; l < 32; l++) {
      if (lanes[l].line != lanes[0].line) fail("lanes of one warp at different operations");
      block.warp_given[w][l] = lanes[l].given;
      lanes[l].wait = Wait::kNothing;
    }
    if (emulated_met) emulated_met(32 * w, 32 * w + 32);
    any = true;
  }
  int waiting = 0, gone = 0;
  bool all = true;
  for (const Fiber& fiber : block.fibers) {
    waiting += fiber.wait == Wait::kBlock, gone += fiber.wait == Wait::kGone;
    if (fiber.wait == Wait::kBlock) all = all && fiber.given != 0;
  }
  if (waiting && gone) fail("a thread has left while others wait for it at a barrier");
  if (waiting < n) return any;
  for (Fiber& fiber : block.fibers) {
    if (fiber.line != block.fibers[0].line) fail("threads of one block at different barriers");
    fiber.wait = Wait::kNothing;
  }
  if (emulated_met) emulated_met(0, n);
  block.block_all = all;
  return true;
}

// Lets each thread of a block that can run do so once, in random order. True: something happened.
bool turn(Block& block, std::vector<int>& order) {
  Machine& m = machine();
  for (size_t i = order.size(); i > 1; i--) std::swap(order[i - 1], order[m.random() % i]);
  bool any = false;
  for (int thread : order) {
    const Wait was = block.fibers[thread].wait;
    if (was != Wait::kNothing && was != Wait::kPause) continue;
    resume(thread);
    any |= was != Wait::kPause || block.fibers[thread].wait != Wait::kPause;
  }
  return release(block) || any;
}

bool finished(const Block& block) {
  for (const Fiber& fiber : block.fibers)
    if (fiber.wait != Wait::kGone) return false;
  return true;
}

// Copies, unseen by sanitizers, who would take it for the kernel's doing.
void copy(char* to, const char* from, size_t size) {
  for (; size >= sizeof(uint64_t); size -= sizeof(uint64_t)) {
    uint64_t word;
    __builtin_memcpy(&word, from, sizeof word);
    *reinterpret_cast<volatile uint64_t*>(to) = word;
    from += sizeof word, to += sizeof word;
  }
  for (; size > 0; size--) *reinterpret_cast<volatile char*>(to++) = *from++;
}

// Puts a block's shared memory where kernels look for it. All blocks have it at one address: the
// sanitizer is made to forget what others did there, which mapping memory anew does.
void put_shared(const Block& block, char* at, size_t size) {
  if (machine().tsan && size > 0) {
    const uintptr_t page = 4096, first = reinterpret_cast<uintptr_t>(at) & ~(page - 1);
    const size_t all = (reinterpret_cast<uintptr_t>(at) + size - first + page - 1) & ~(page - 1);
    char* pages = reinterpret_cast<char*>(first);
    std::vector<char> kept(all);
    copy(kept.data(), pages, all);
    if (mmap(pages, all, PROT_READ | PROT_WRITE, MAP_FIXED | MAP_PRIVATE | MAP_ANONYMOUS, -1, 0) !=
        pages)
      fail("shared memory cannot be mapped anew");
    copy(pages, kept.data(), all);
  }
  copy(at, block.shared.data(), size);
  machine().from_scheduler.release();
}

void run_grid(unsigned blocks, int threads, int most_resident, void (*body)(const void*),
              const void* arguments) {
  Machine& m = machine();
  m.body = body, m.arguments = arguments;
  const size_t shared = static_cast<size_t>(__stop_emulated_shared - __start_emulated_shared);
  std::vector<unsigned> queue(blocks);
  for (unsigned b = 0; b < blocks; b++) queue[b] = b;
  for (unsigned i = blocks; i > 1; i--) std::swap(queue[i - 1], queue[m.random() % i]);
  std::vector<int> order(threads);
  for (int i = 0; i < threads; i++) order[i] = i;
  static Block rooms[kMostResident];  // their stacks are used again
  std::vector<Block*> resident;
  Block* there = nullptr;  // whose shared memory is
  const auto begin = [&](Block& block) {
    block.index = queue.back();
    queue.pop_back();
    block.fibers.resize(threads);
    for (Fiber& fiber : block.fibers) fiber.started = false, fiber.wait = Wait::kNothing;
    block.shared.assign(shared, static_cast<char>(0xff));
    if (there == &block) there = nullptr;
  };
  for (int r = 0; r < most_resident && !queue.empty(); r++) {
    begin(rooms[r]);
    resident.push_back(&rooms[r]);
  }
  m.from_scheduler.release();
  for (int idle = 0; !resident.empty();) {
    const size_t which = m.random() % resident.size();
    Block& block = *resident[which];
    if (there != &block) {
      if (there) copy(there->shared.data(), __start_emulated_shared, shared);
      put_shared(block, __start_emulated_shared, shared);
      there = &block;
    }
    m.block = &block;
    blockIdx = {block.index, 0, 0};
    for (bool more = true; more && m.random() % 64;) {  // now and then, and when it waits, leave it
      more = turn(block, order);
      idle = more ? 0 : idle + 1;
      if (idle > kPatience) fail("threads wait for each other forever");
    }
    if (!finished(block)) continue;
    if (emulated_met) emulated_met(0, threads), emulated_left();
    idle = 0;
    if (queue.empty())
      resident.erase(resident.begin() + static_cast<std::ptrdiff_t>(which));
    else
      begin(block);
  }
  m.to_scheduler.acquire();
  for (Block& room : rooms)  // as many as the sanitizer can have
    for (Fiber& fiber : room.fibers)
      if (fiber.tsan) __tsan_destroy_fiber(fiber.tsan), fiber.tsan = nullptr;
}

const uint64_t* exchange(int line, uint32_t mask, uint64_t given, bool fence) {
  Machine& m = machine();
  Order& order = m.block->warps[threadIdx.x / 32];
  const int turn = m.fiber().fences & 1;
  if (fence) order.release(turn), m.fiber().fences++;
  // line 0 is nobody's: a partial warp meets nobody
  wait(Wait::kWarp, mask == 0xffffffffu ? line : 0, given);
  if (fence) order.acquire(turn);
  return m.block->warp_given[threadIdx.x / 32];
}
bool barrier(int line, bool v) {
  Machine& m = machine();
  const int turn = m.fiber().barriers++ & 1;
  m.block->barrier.release(turn);
  wait(Wait::kBlock, line, v);
  m.block->barrier.acquire(turn);
  return m.block->block_all;
}
void pause() { wait(Wait::kPause, 0, 0); }
bool on_stack(const volatile void* at) {
  const std::vector<char>& stack = machine().fiber().stack;
  const auto place = reinterpret_cast<uintptr_t>(at) - reinterpret_cast<uintptr_t>(stack.data());
  return place < stack.size();
}

using Kernels = std::map<std::string, void (*)(const void*)>;
Kernels& kernels() {
  static Kernels all;
  return all;
}
Register::Register(const char* name, void (*run)(const void*)) { kernels()[name] = run; }

std::string& message() {
  static std::string text;
  return text;
}

}  // namespace emulated

#define EXPORT extern "C" __attribute__((visibility("default")))

// Runs a grid of blocks; 0, or 1 with a message.
EXPORT int emulated_launch(const char* name, unsigned blocks, unsigned threads,
                           const void* arguments, unsigned seed, int resident) {
  try {
    const auto found = emulated::kernels().find(name);
    if (found == emulated::kernels().end()) emulated::fail("no such kernel");
    emulated::machine().random.seed(seed);
    emulated::run_grid(blocks, static_cast<int>(threads), resident, found->second, arguments);
    return 0;
  } catch (const std::exception& e) {
    emulated::message() = std::string(name) + ": " + e.what();
    return 1;
  }
}
EXPORT int emulated_knows(const char* name) {
  return static_cast<int>(emulated::kernels().count(name));
}
EXPORT const char* emulated_message() { return emulated::message().c_str(); }
