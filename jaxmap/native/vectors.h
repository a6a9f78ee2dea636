// Vectors of the processor's registers, and memory that suits them.

#pragma once

#include <algorithm>
#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <memory>
#include <mutex>
#include <new>
#include <utility>
#include <vector>

#if defined(__linux__)
#include <sys/mman.h>
#endif

namespace jaxmap {

#if defined(__AVX512F__)
constexpr int kLanes = 16, kRegisters = 32;
#elif defined(__AVX__)
constexpr int kLanes = 8, kRegisters = 16;
#elif defined(__aarch64__)
constexpr int kLanes = 4, kRegisters = 32;
#else
constexpr int kLanes = 4, kRegisters = 16;
#endif
typedef float Vector __attribute__((vector_size(kLanes * sizeof(float))));
typedef float Unaligned __attribute__((vector_size(kLanes * sizeof(float)), aligned(4)));

inline Vector load(const float* from) { return *reinterpret_cast<const Unaligned*>(from); }
inline void store(float* to, Vector value) { *reinterpret_cast<Unaligned*>(to) = value; }
// Taking away zeros changes no number, where adding them turns -0 into 0, and compiles to nothing.
inline Vector all(float value) { return value - Vector{}; }

// The first `count` lanes; the others are zero, or are left alone.
inline Vector load_some(const float* from, int64_t count) {
  if (count >= kLanes) return load(from);
  Vector value{};
  std::memcpy(&value, from, count * sizeof(float));
  return value;
}

inline void store_some(float* to, Vector value, int64_t count) {
  if (count >= kLanes) return store(to, value);
  std::memcpy(to, &value, count * sizeof(float));
}

constexpr size_t kLargePage = 1 << 21;

// An array that a thread or a workspace keeps from call to call, as fresh pages cost more than what is done with them.
// It grows, and then forgets what it held.
template <typename Number>
class Scratch {
 public:
  Number* of(int64_t count) {
    if (count > size_) {
      std::free(numbers_);
      // Much memory comes in large pages, where the system has them: fewer addresses to look up.
      const size_t wanted = count * sizeof(Number), page = wanted < kLargePage ? 64 : kLargePage;
      const size_t bytes = (wanted + page - 1) / page * page;
      numbers_ = static_cast<Number*>(std::aligned_alloc(page, bytes));
#if defined(MADV_HUGEPAGE)
      if (numbers_ && page == kLargePage) madvise(numbers_, bytes, MADV_HUGEPAGE);
#endif
      size_ = numbers_ ? count : 0;
      if (!numbers_) throw std::bad_alloc();
    }
    return numbers_;
  }
  Number* get() const { return numbers_; }

  Scratch() = default;
  Scratch(const Scratch&) = delete;
  Scratch& operator=(const Scratch&) = delete;
  ~Scratch() { std::free(numbers_); }

 private:
  Number* numbers_ = nullptr;
  int64_t size_ = 0;
};

// What calls keep for those after them: taken by one at a time, and given back by those that came to their end alone.
template <typename Workspace>
class Kept {
 public:
  static std::unique_ptr<Workspace> take() {
    std::lock_guard<std::mutex> lock(mutex_);
    if (idle_.empty()) return std::make_unique<Workspace>();
    auto taken = std::move(idle_.back());
    idle_.pop_back();
    return taken;
  }

  static void give_back(std::unique_ptr<Workspace> workspace) {
    std::lock_guard<std::mutex> lock(mutex_);
    idle_.push_back(std::move(workspace));
  }

 private:
  static inline std::mutex mutex_;
  static inline std::vector<std::unique_ptr<Workspace>> idle_;
};

}  // namespace jaxmap
