// The machine behind emulation.h.
#include "emulation.h"

#include <setjmp.h>
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

namespace emulated {

constexpr int kResident = 3;     // blocks that run at a time
constexpr int kPatience = 4000;  // turns in which nobody does anything but wait

enum class Wait { kNothing, kPause, kBlock, kWarp, kGone };

struct Fiber {
  ucontext_t start;
  jmp_buf here;
  std::vector<char> stack;
  bool started = false;
  Wait wait = Wait::kNothing;
  int line = 0;        // of the operation that it waits at
  uint64_t given = 0;  // to the operation
};

struct Block {
  unsigned index = 0;
  std::vector<Fiber> fibers;
  std::vector<char> shared;
  uint64_t warp_given[32][32];  // to the operation that was completed last
  bool block_all = false;       // what the last barrier found
};

struct Machine {
  std::mt19937 random{1};
  jmp_buf scheduler;
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

// Gives way to the other threads until the scheduler comes back.
void wait(Wait kind, int line, uint64_t given) {
  Machine& m = machine();
  Fiber& fiber = m.fiber();
  fiber.wait = kind, fiber.line = line, fiber.given = given;
  if (_setjmp(fiber.here) == 0) _longjmp(m.scheduler, 1);
}

void enter() {
  Machine& m = machine();
  m.body(m.arguments);
  m.fiber().wait = Wait::kGone;
  _longjmp(m.scheduler, 1);
}

void resume(int thread) {
  Machine& m = machine();
  m.thread = thread;
  threadIdx = {static_cast<unsigned>(thread), 0, 0};
  Fiber& fiber = m.fiber();
  fiber.wait = Wait::kNothing;
  if (_setjmp(m.scheduler) != 0) return;
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

void run_grid(unsigned blocks, int threads, void (*body)(const void*),
                     const void* arguments) {
  Machine& m = machine();
  m.body = body, m.arguments = arguments;
  const size_t shared = static_cast<size_t>(__stop_emulated_shared - __start_emulated_shared);
  std::vector<unsigned> queue(blocks);
  for (unsigned b = 0; b < blocks; b++) queue[b] = b;
  for (unsigned i = blocks; i > 1; i--) std::swap(queue[i - 1], queue[m.random() % i]);
  std::vector<int> order(threads);
  for (int i = 0; i < threads; i++) order[i] = i;
  static Block rooms[kResident];  // their stacks are used again
  std::vector<Block*> resident;
  const auto begin = [&](Block& block) {
    block.index = queue.back();
    queue.pop_back();
    block.fibers.resize(threads);
    for (Fiber& fiber : block.fibers) fiber.started = false, fiber.wait = Wait::kNothing;
    block.shared.assign(shared, static_cast<char>(0xff));
  };
  for (Block& room : rooms) {
    if (queue.empty()) break;
    begin(room);
    resident.push_back(&room);
  }
  for (int idle = 0; !resident.empty();) {
    const size_t which = m.random() % resident.size();
    Block& block = *resident[which];
    m.block = &block;
    blockIdx = {block.index, 0, 0};
    memcpy(__start_emulated_shared, block.shared.data(), shared);
    for (bool more = true; more && m.random() % 64;) {  // now and then, and when it waits, leave it
      more = turn(block, order);
      idle = more ? 0 : idle + 1;
      if (idle > kPatience) fail("threads wait for each other forever");
    }
    memcpy(block.shared.data(), __start_emulated_shared, shared);
    if (!finished(block)) continue;
    idle = 0;
    if (queue.empty())
      resident.erase(resident.begin() + static_cast<std::ptrdiff_t>(which));
    else
      begin(block);
  }
}


const uint64_t* exchange(int line, uint32_t mask, uint64_t given) {
  // line 0 is nobody's: a partial warp meets nobody
  wait(Wait::kWarp, mask == 0xffffffffu ? line : 0, given);
  return machine().block->warp_given[threadIdx.x / 32];
}
bool barrier(int line, bool v) {
  wait(Wait::kBlock, line, v);
  return machine().block->block_all;
}
void pause() { wait(Wait::kPause, 0, 0); }

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
                           const void* arguments, unsigned seed) {
  try {
    const auto found = emulated::kernels().find(name);
    if (found == emulated::kernels().end()) emulated::fail("no such kernel");
    emulated::machine().random.seed(seed);
    emulated::run_grid(blocks, static_cast<int>(threads), found->second, arguments);
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
