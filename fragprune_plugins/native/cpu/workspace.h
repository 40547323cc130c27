// Memory that calls hand on to each other: fresh pages cost more than what is done with them.
#pragma once

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <iterator>
#include <map>
#include <memory>
#include <mutex>
#include <new>
#include <type_traits>
#include <utility>
#include <vector>

#if defined(__linux__)
#include <sys/mman.h>
#endif

#if defined(__SANITIZE_ADDRESS__)
#define FP_EXACT_SIZES
#elif defined(__has_feature)
#if __has_feature(address_sanitizer)
#define FP_EXACT_SIZES
#endif
#endif

namespace fp {

// Blocks by size class, four to an octave. What lies idle is bounded by what was in use at once,
// and that peak is forgotten over some hundred allocations' worth of frames.
class Pool {
 public:
  Pool() = default;
  Pool(const Pool&) = delete;
  Pool& operator=(const Pool&) = delete;
  ~Pool() {
    for (auto& idle : idle_)
      for (void* block : idle.second) give_up(block, idle.first);
  }

  static size_t class_of(size_t bytes) {
    if (bytes > SIZE_MAX / 2) throw std::bad_alloc();  // rounding up would wrap around
#ifdef FP_EXACT_SIZES
    return std::max<size_t>(bytes, 1);  // so that one number too many is seen
#endif
    size_t step = 64;
    while (step * 8 < bytes) step *= 2;
    return (bytes + step - 1) / step * step;
  }

  void* take(size_t size_class) {
    std::lock_guard<std::mutex> lock(mutex_);
    const auto found = idle_.find(size_class);
    if (found != idle_.end() && !found->second.empty()) {
      void* block = found->second.back();
      found->second.pop_back();
      idle_bytes_ -= size_class;
      count_in(size_class);
      return block;
    }
    void* block = obtain(size_class);
    count_in(size_class);
    return block;
  }

  void put(void* block, size_t size_class) noexcept {
    std::lock_guard<std::mutex> lock(mutex_);
    in_use_ -= size_class;
    try {
      idle_[size_class].push_back(block);
    } catch (...) {
      give_up(block, size_class);
      return;
    }
    idle_bytes_ += size_class;
    if (in_use_ == 0) peak_ -= peak_ / 64;  // a frame has ended
    while (idle_bytes_ + in_use_ > peak_ + peak_ / 4) drop_largest();
  }

 private:
  // Large blocks ask for large pages: splats are read in no order at all, and with small pages each
  // read would first have to find out where its page is.
  static constexpr size_t kLargePage = size_t{1} << 21;
  static size_t alignment_of(size_t size_class) {
    return size_class >= kLargePage ? kLargePage : 64;
  }

  static void* obtain(size_t size_class) {
    const size_t alignment = alignment_of(size_class);
    void* block = ::operator new(size_class, std::align_val_t(alignment));
#if defined(__linux__)
    if (alignment == kLargePage) madvise(block, size_class, MADV_HUGEPAGE);  // a wish, no more
#endif
    return block;
  }

  static void give_up(void* block, size_t size_class) {
    ::operator delete(block, std::align_val_t(alignment_of(size_class)));
  }

  void count_in(size_t size_class) {
    in_use_ += size_class;
    if (in_use_ > peak_) peak_ = in_use_;
  }

  void drop_largest() {
    auto last = std::prev(idle_.end());
    if (!last->second.empty()) {
      give_up(last->second.back(), last->first);
      last->second.pop_back();
      idle_bytes_ -= last->first;
    }
    if (last->second.empty()) idle_.erase(last);
  }

  std::mutex mutex_;
  std::map<size_t, std::vector<void*>> idle_;
  size_t in_use_ = 0, idle_bytes_ = 0, peak_ = 0;
};

using Memory = std::shared_ptr<Pool>;

// An array out of a pool, not filled. Moves, does not copy.
template <class T>
class Buffer {
  static_assert(std::is_trivially_destructible<T>::value, "");

 public:
  Buffer() = default;
  Buffer(const Memory& memory, size_t n)
      : memory_(memory), class_(Pool::class_of(n * sizeof(T))), size_(n) {
    data_ = static_cast<T*>(memory->take(class_));
  }
  Buffer(Buffer&& other) noexcept { swap(other); }
  Buffer& operator=(Buffer&& other) noexcept {
    Buffer gone(std::move(other));
    swap(gone);
    return *this;
  }
  ~Buffer() {
    if (data_) memory_->put(data_, class_);
  }
  T& operator[](size_t i) { return data_[i]; }
  const T& operator[](size_t i) const { return data_[i]; }
  T* data() { return data_; }
  const T* data() const { return data_; }
  size_t size() const { return size_; }
  void swap(Buffer& other) noexcept {
    std::swap(memory_, other.memory_);
    std::swap(data_, other.data_);
    std::swap(class_, other.class_);
    std::swap(size_, other.size_);
  }

 private:
  Memory memory_;
  T* data_ = nullptr;
  size_t class_ = 0, size_ = 0;
};

// A growing array out of a pool.
template <class T>
class Heap {
  static_assert(std::is_trivially_copyable<T>::value, "");

 public:
  Heap() = default;
  Heap(const Memory& memory, size_t capacity) : memory_(memory), buffer_(memory, capacity) {}
  void append(const T* values, size_t n) {
    while (size_ + n > buffer_.size()) grow();
    std::copy(values, values + n, buffer_.data() + size_);
    size_ += n;
  }
  size_t size() const { return size_; }
  const T* data() const { return buffer_.data(); }

 private:
  void grow() {
    Buffer<T> larger(memory_, 2 * buffer_.size());
    std::copy(buffer_.data(), buffer_.data() + size_, larger.data());
    buffer_ = std::move(larger);
  }
  Memory memory_;
  Buffer<T> buffer_;
  size_t size_ = 0;
};

}  // namespace fp
