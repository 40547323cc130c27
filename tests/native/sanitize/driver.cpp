// Calls the C interface at random, from two threads at once, and while memory runs out.
//
//     driver [first seed] [calls]
//
// Built with sanitizers by test_sanitizers.py. Exits 0 and prints a tally, or dies with a reason.

#include <atomic>
#include <cstddef>
#include <new>
#include <thread>

#include "images.h"
#include "slices.h"

namespace {

std::atomic<int64_t> allocations_left{-1};  // at 0 operator new fails; negative: it never does

void* allocate(size_t size, size_t alignment) {
  for (int64_t left = allocations_left; left >= 0;) {
    if (left == 0) throw std::bad_alloc();
    if (allocations_left.compare_exchange_weak(left, left - 1)) break;
  }
  void* found = nullptr;
  if (posix_memalign(&found, std::max(alignment, sizeof(void*)), size)) throw std::bad_alloc();
  return found;
}

}  // namespace

void* operator new(size_t size) { return allocate(size, alignof(std::max_align_t)); }
void* operator new[](size_t size) { return allocate(size, alignof(std::max_align_t)); }
void* operator new(size_t size, std::align_val_t a) { return allocate(size, size_t(a)); }
void* operator new[](size_t size, std::align_val_t a) { return allocate(size, size_t(a)); }
void operator delete(void* p) noexcept { std::free(p); }
void operator delete[](void* p) noexcept { std::free(p); }
void operator delete(void* p, size_t) noexcept { std::free(p); }
void operator delete[](void* p, size_t) noexcept { std::free(p); }
void operator delete(void* p, std::align_val_t) noexcept { std::free(p); }
void operator delete[](void* p, std::align_val_t) noexcept { std::free(p); }
void operator delete(void* p, size_t, std::align_val_t) noexcept { std::free(p); }
void operator delete[](void* p, size_t, std::align_val_t) noexcept { std::free(p); }

namespace {

calls::Tally many(uint64_t seed, int64_t count) {
  calls::Tally tally;
  for (int64_t k = 0; k < count; k++) {
    calls::seed_in_hand = seed + static_cast<uint64_t>(k);
    calls::Source from(calls::seed_in_hand);
    calls::run(from, {}, tally);
    if (from.one_in(4)) calls::run_cut(from, tally);
    if (from.one_in(8)) calls::run_loss(from, tally);
  }
  return tally;
}

// Each caller with scenes of its own, as two Python threads without the lock between them.
void two_callers(uint64_t seed, int64_t count, calls::Tally& tally) {
  calls::Tally first, second;
  std::thread other([&] { second = many(seed + static_cast<uint64_t>(count / 2), count / 2); });
  first = many(seed, count / 2);
  other.join();
  tally += first;
  tally += second;
}

// A scene large enough that every stage is cut into several pieces of work.
calls::Scene large_scene(uint64_t seed) {
  calls::Source from(seed);
  calls::Scene s;
  do
    s = calls::make_scene(from, {40'000, 150});
  while (s.in.count < 20'000 || s.in.width < 60 || s.in.height < 60 || !s.thresholds.get());
  s.in.widen = 1;
  return s;
}

// One state serves two threads at once, for it never changes.
void share_a_state(uint64_t seed) {
  calls::Scene s = large_scene(seed);
  s.in.threads = 4;
  calls::Picture p = calls::make_picture(s, 0);
  fragprune_state* state = nullptr;
  CALLS_CHECK(fragprune_forward(&s.in, &p.out, &state, nullptr) == FRAGPRUNE_OK);
  check(s, p);
  calls::Source from(seed);
  const calls::Loss loss = make_loss(s, from, 0);
  calls::Gradients mine, other;
  std::thread thread([&] { other = differentiate(s, state, loss, 0, 3); });
  mine = differentiate(s, state, loss, 0, 2);
  thread.join();
  for (size_t k = 0; k < mine.all().size(); k++) {
    CALLS_CHECK(mine.all()[k]->finite());
    CALLS_CHECK(mine.all()[k]->same_bits(*other.all()[k]));
  }
  fragprune_free(state);
}

// The first, second, third ... allocation fails, on whichever thread: a status, nothing lost.
void run_out_of_memory(uint64_t seed) {
  calls::Source from(seed);
  calls::Scene s = calls::make_scene(from, {});
  while (s.in.count < 20) s = calls::make_scene(from, {});
  s.in.threads = 3;
  const calls::Workspace workspace = calls::new_workspace();
  if (seed % 2) s.in.workspace = workspace.get();
  calls::Picture p = calls::make_picture(s, 0);
  const calls::Loss loss = make_loss(s, from, 0);
  const calls::Gradients g = make_gradients(s, 0);
  fragprune_state* state = nullptr;
  const auto until_it_works = [](auto call) {
    for (int64_t allowed = 0;; allowed++) {
      fragprune_error error;
      allocations_left.store(allowed);
      const int status = call(&error);
      allocations_left.store(-1);
      if (status == FRAGPRUNE_OK) return;
      CALLS_CHECK(status == FRAGPRUNE_OUT_OF_MEMORY && error.message[0]);
    }
  };
  until_it_works([&](fragprune_error* error) {
    const int status = fragprune_forward(&s.in, &p.out, &state, error);
    CALLS_CHECK(!state == (status != FRAGPRUNE_OK));
    return status;
  });
  check(s, p);
  until_it_works([&](fragprune_error* error) {
    return fragprune_backward(state, &loss.grads, &g.to, 3, error);
  });
  fragprune_free(state);
  calls::Pair pair = calls::make_pair(from);
  pair.in.threads = 3;
  until_it_works([&](fragprune_error* error) {
    return fragprune_photometric_loss(&pair.in, error);
  });
}

}  // namespace

int main(int argc, char** argv) {
  calls::name_the_seed_on_death();
  const uint64_t seed = argc > 1 ? std::strtoull(argv[1], nullptr, 10) : 0;
  const int64_t count = argc > 2 ? std::atoll(argv[2]) : 600;
  CALLS_CHECK(fragprune_version() == FRAGPRUNE_API_VERSION);
  calls::Tally tally;
  two_callers(seed, count, tally);
  share_a_state(seed);
#ifndef __SANITIZE_THREAD__  // exceptions cross threads inside libstdc++, out of its sight
  for (uint64_t k = 0; k < 4; k++) run_out_of_memory(seed + k);
#endif
  tally.print();
}
