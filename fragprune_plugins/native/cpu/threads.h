// A team of threads for the duration of one call; no thread outlives it.
#pragma once

#include <atomic>
#include <condition_variable>
#include <cstddef>
#include <exception>
#include <functional>
#include <mutex>
#include <system_error>
#include <thread>
#include <vector>

#if defined(__SSE2__)
#include <immintrin.h>
#endif

namespace fp {

class Team {
 public:
  explicit Team(int threads) {
    crew_.reserve(threads > 1 ? threads - 1 : 0);
    const unsigned wanted = threads > 1 ? static_cast<unsigned>(threads) : 0;
    impatient_ = wanted && wanted <= std::thread::hardware_concurrency();
    for (int i = 1; i < threads; i++) {
      try {
        crew_.emplace_back([this] { wait_for_work(); });
      } catch (const std::exception&) {
        break;  // the machine gives no more, or no memory for it: fewer do the same work
      }
    }
  }

  ~Team() {
    {
      std::lock_guard<std::mutex> lock(mutex_);
      leaving_ = true;
    }
    wake_.notify_all();
    for (std::thread& t : crew_) t.join();
  }

  Team(const Team&) = delete;
  Team& operator=(const Team&) = delete;

  int size() const { return static_cast<int>(crew_.size()) + 1; }

  // Calls work(begin, end) over [0, count) in pieces of `grain`, in any order, on any thread.
  template <class Work>
  void each(size_t count, size_t grain, Work work) {
    if (count == 0) return;
    std::atomic<size_t> next{0};
    const std::function<void()> take = [&] {
      for (;;) {
        const size_t begin = next.fetch_add(grain, std::memory_order_relaxed);
        if (begin >= count) return;
        work(begin, begin + grain < count ? begin + grain : count);
      }
    };
    if (crew_.empty() || count <= grain) return take();
    {
      std::lock_guard<std::mutex> lock(mutex_);
      job_ = &take;
      running_ = crew_.size();
      round_++;
    }
    wake_.notify_all();
    run_guarded(take);
    watch([&] { return running_ == 0; });
    std::unique_lock<std::mutex> lock(mutex_);
    done_.wait(lock, [&] { return running_ == 0; });
    if (failure_) {
      const std::exception_ptr failure = failure_;
      failure_ = nullptr;
      std::rethrow_exception(failure);
    }
  }

 private:
  void wait_for_work() {
    unsigned seen = 0;
    for (;;) {
      const std::function<void()>* job;
      watch([&] { return leaving_ || round_ != seen; });
      {
        std::unique_lock<std::mutex> lock(mutex_);
        wake_.wait(lock, [&] { return leaving_ || round_ != seen; });
        if (leaving_) return;
        seen = round_;
        job = job_;
      }
      run_guarded(*job);
      std::lock_guard<std::mutex> lock(mutex_);
      if (--running_ == 0) done_.notify_one();
    }
  }

  // Looks for a while before going to sleep: pieces of work follow each other closely, and waking
  // takes longer than many of them. Not where threads outnumber processors: they need the time.
  template <class Condition>
  void watch(Condition condition) const {
    if (!impatient_) return;
    for (int i = 0; i < 4000 && !condition(); i++) {
#if defined(__SSE2__)
      _mm_pause();
#endif
    }
  }

  void run_guarded(const std::function<void()>& job) {
    try {
      job();
    } catch (...) {
      std::lock_guard<std::mutex> lock(mutex_);
      if (!failure_) failure_ = std::current_exception();
    }
  }

  std::vector<std::thread> crew_;
  std::mutex mutex_;
  std::condition_variable wake_, done_;
  const std::function<void()>* job_ = nullptr;
  std::exception_ptr failure_;
  std::atomic<size_t> running_{0};
  std::atomic<unsigned> round_{0};
  std::atomic<bool> leaving_{false};
  bool impatient_ = false;  // may spin
};

}  // namespace fp
