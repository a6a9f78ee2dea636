// Semi-global matching of an image: costs, the paths of both ways, and the winner of each pixel.
//
// The twin of `matching.aggregate.aggregate_planes` with `select.winners`, bit for bit, and of the costs of the census
// in `matching.costs`. All disparities of a pixel lie side by side, a byte each, and what a row needs stays in the
// cache. Two threads meet in the middle: one walks down the upper half while the other walks up the lower half, and
// both keep what the paths that come their way add up to. Then each goes on into the other's half, where the sums of
// its paths and those that are kept make the whole, of which only the winner is written.

#include <algorithm>
#include <atomic>
#include <condition_variable>
#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <functional>
#include <memory>
#include <mutex>
#include <vector>

#if defined(__SSE4_1__)
#include <immintrin.h>
#endif
#if defined(__linux__)
#include <sys/mman.h>
#endif

#include "xla/ffi/api/ffi.h"

namespace ffi = xla::ffi;

namespace {

// ---- Vectors ----

template <typename Number, int kBytes>
struct VectorOf {
  typedef Number type __attribute__((vector_size(kBytes)));
};
using Bytes16 = VectorOf<uint8_t, 16>::type;
using Words16 = VectorOf<uint16_t, 16>::type;

template <typename Vector>
inline Vector load(const void* from) {
  Vector vector;
  std::memcpy(&vector, from, sizeof(Vector));
  return vector;
}

template <typename Vector>
inline void store(void* to, Vector vector) {
  std::memcpy(to, &vector, sizeof(Vector));
}

template <typename Vector>
inline Vector lesser(Vector a, Vector b) {
  return a < b ? a : b;
}

inline int least_of(Words16 words) {
#if defined(__SSE4_1__)
  return _mm_cvtsi128_si32(_mm_minpos_epu16((__m128i)words)) & 0xffff;
#else
  int least = words[0];
  for (int i = 1; i < 8; ++i) least = std::min<int>(least, words[i]);
  return least;
#endif
}

inline int least_of(Bytes16 bytes) {
  const Words16 words = (Words16)bytes;
  return least_of(lesser(words & 0xff, words >> 8));
}

// Of a longer vector: halves are compared until 16 bytes are left.
template <typename Vector>
inline int least_of(Vector vector) {
  using Number = std::remove_reference_t<decltype(vector[0])>;
  using Half = typename VectorOf<Number, sizeof(Vector) / 2>::type;
  const char* bytes = reinterpret_cast<const char*>(&vector);
  return least_of(lesser(load<Half>(bytes), load<Half>(bytes + sizeof(Half))));
}

// ---- What is matched ----

struct Pair {
  int64_t height, width, disparities, first;
  int64_t words;  // of the census of a pixel
  const uint32_t *left, *right;
  const uint8_t* costs;  // (height, width, disparities), where they are given
  int block, scale, outside;
  int p1, p2, paths;
};

struct Winners {
  int16_t* place;
  uint16_t *cost, *second, *lower, *higher;
};

// Memory that is kept from image to image: fresh pages cost more than what is done with them.
class Room {
 public:
  Room() = default;
  Room(const Room&) = delete;
  ~Room() { std::free(data_); }

  uint8_t* of(int64_t size) {
    if (size > size_) {
      constexpr int64_t kPage = 1 << 21;
      std::free(data_);
      size_ = (size + kPage - 1) / kPage * kPage;
      data_ = static_cast<uint8_t*>(std::aligned_alloc(kPage, size_));
      if (data_ == nullptr) throw std::bad_alloc();
#if defined(MADV_HUGEPAGE)
      madvise(data_, size_, MADV_HUGEPAGE);
#endif
    }
    return data_;
  }

 private:
  uint8_t* data_ = nullptr;
  int64_t size_ = 0;
};

// ---- Costs of the census ----

// Row by row, in the order of a walk; each is the mean over a block, whose edges are repeated.
class CensusCosts {
 public:
  CensusCosts(const Pair& pair, int64_t padded) : pair_(pair), padded_(padded) {
    const int64_t row = pair.width * padded;
    reversed_.resize(pair.words * (pair.width + padded));
    if (pair.block == 1) return;
    raw_.resize((pair.block + 1) * row);
    kept_.assign(pair.block + 1, -1);
    columns_.assign(row, 0);
    const uint32_t size = pair.block * pair.block;
    while (size >> (shift_ + 1)) ++shift_;
    factor_ = (uint64_t(1) << (16 + shift_)) / size + 1;
  }

  // The row after `y` in the walk must be `y + step`.
  void row(int64_t y, int64_t step, uint8_t* costs) {
    if (pair_.block == 1) {
      compare(y, costs);
    } else {
      sum_columns(y, step);
      average(costs);
    }
    mark_outside(costs);
  }

 private:
  // How many bits differ, of all pixels of a row at all disparities.
  void compare(int64_t y, uint8_t* costs) {
    const int64_t width = pair_.width, image = pair_.height * width, length = width + padded_;
    for (int64_t word = 0; word < pair_.words; ++word) {
      const uint32_t* right = pair_.right + word * image + y * width;
      uint32_t* reversed = &reversed_[word * length];
      // What a match compares then lies in the order of disparities.
      for (int64_t i = 0; i < length; ++i)
        reversed[i] = right[std::clamp<int64_t>(width - 1 - pair_.first - i, 0, width - 1)];
    }
    const uint32_t* left = pair_.left + y * width;
    const int64_t padded = padded_;
    for (int64_t x = 0; x < width; ++x, costs += padded) {
      const uint32_t* here = &reversed_[width - 1 - x];
      if (pair_.words == 2) {
        const uint32_t a = left[x], b = left[image + x], scale = pair_.scale;
        const uint32_t *as = here, *bs = here + length;
        for (int64_t d = 0; d < padded; ++d)
          costs[d] = uint8_t((__builtin_popcount(a ^ as[d]) + __builtin_popcount(b ^ bs[d])) * scale);
      } else {
        for (int64_t d = 0; d < padded; ++d) {
          int bits = 0;
          for (int64_t word = 0; word < pair_.words; ++word)
            bits += __builtin_popcount(left[word * image + x] ^ here[word * length + d]);
          costs[d] = uint8_t(bits * pair_.scale);
        }
      }
    }
  }

  const uint8_t* raw(int64_t y) {
    const int64_t slot = y % (pair_.block + 1);
    uint8_t* row = &raw_[slot * pair_.width * padded_];
    if (kept_[slot] != y) compare(y, row);
    kept_[slot] = y;
    return row;
  }

  void sum_columns(int64_t y, int64_t step) {
    const int64_t reach = pair_.block / 2, last = pair_.height - 1, count = pair_.width * padded_;
    uint16_t* columns = columns_.data();
    if (!begun_) {
      for (int64_t k = -reach; k <= reach; ++k) {
        const uint8_t* come = raw(std::clamp<int64_t>(y + k, 0, last));
        for (int64_t i = 0; i < count; ++i) columns[i] += come[i];
      }
    } else {
      const int64_t before = std::clamp<int64_t>(y - step * (reach + 1), 0, last);
      const int64_t after = std::clamp<int64_t>(y + step * reach, 0, last);
      if (before == after) return;
      const uint8_t *gone = raw(before), *come = raw(after);
      for (int64_t i = 0; i < count; ++i) columns[i] = uint16_t(columns[i] + come[i] - gone[i]);
    }
    begun_ = true;
  }

  // Sums of columns become means of blocks.
  void average(uint8_t* costs) {
    const int64_t reach = pair_.block / 2, last = pair_.width - 1, padded = padded_;
    const uint16_t* columns = columns_.data();
    const uint16_t half = uint16_t(pair_.block * pair_.block / 2);
    sums_.assign(padded, half);
    uint16_t* sums = sums_.data();
    for (int64_t k = -reach; k <= reach; ++k) {
      const uint16_t* come = columns + std::clamp<int64_t>(k, 0, last) * padded;
      for (int64_t d = 0; d < padded; ++d) sums[d] += come[d];
    }
    const uint32_t factor = factor_;
    const int shift = shift_;
    for (int64_t x = 0; x <= last; ++x, costs += padded) {
      const uint16_t* gone = columns + std::max<int64_t>(x - reach, 0) * padded;
      const uint16_t* come = columns + std::min<int64_t>(x + reach + 1, last) * padded;
      for (int64_t d = 0; d < padded; ++d) {
        const uint16_t sum = sums[d];
        costs[d] = uint8_t(uint16_t((sum * factor) >> 16) >> shift);  // sum / block^2
        sums[d] = uint16_t(sum + come[d] - gone[d]);
      }
    }
  }

  // The largest cost where the match lies outside the right image.
  void mark_outside(uint8_t* costs) {
    for (int64_t x = 0; x < pair_.width; ++x, costs += padded_) {
      const int64_t from = std::clamp<int64_t>(x - pair_.first - (pair_.width - 1), 0, padded_);
      const int64_t to = std::clamp<int64_t>(x - pair_.first + 1, from, padded_);
      if (from > 0) std::memset(costs, pair_.outside, from);
      if (to < padded_) std::memset(costs + to, pair_.outside, padded_ - to);
    }
  }

  const Pair& pair_;
  int64_t padded_;
  std::vector<uint32_t> reversed_;
  std::vector<uint8_t> raw_;
  std::vector<int64_t> kept_;
  std::vector<uint16_t> columns_, sums_;
  uint32_t factor_ = 0;
  int shift_ = 0;
  bool begun_ = false;
};

// ---- Paths ----

// A walk over the rows, down or up, with the ends of the paths that come its way: of each the costs above the least,
// at most p2. Between those of two pixels there is a gap of p2, so that disparities that are not searched cost that.
template <int kBytes, int kVectors>
class Walk {
 public:
  using Bytes = typename VectorOf<uint8_t, kBytes>::type;
  using Words = typename VectorOf<uint16_t, kBytes>::type;
  static constexpr int kMost = kVectors ? kVectors : 2048 / kBytes;

  Walk(const Pair& pair, int64_t step, Room& room)
      : pair_(pair), step_(step), vectors_((pair.disparities + kBytes - 1) / kBytes), costs_(pair, padded()) {
    const int64_t ends = pair.width * stride() + kBytes, row = pair.width * padded();
    uint8_t* memory = room.of(3 * ends + 4 * stride() + 2 * row);
    for (uint8_t*& path : paths_) path = begin(memory, pair.width), memory += ends;
    nowhere_ = begin(memory, 1), memory += 2 * stride();
    along_ = begin(memory, 1), memory += 2 * stride();
    from_left_ = memory;
    given_ = memory + row;
    p1_ = p2_ = Bytes{};
    p1_ += uint8_t(pair.p1);
    p2_ += uint8_t(pair.p2);
    for (int k = 0; k < vectors(); ++k)
      for (int i = 0; i < kBytes; ++i) beyond_[k][i] = k * kBytes + i < pair.disparities ? 0 : 255;
    for (int i = 0; i < kBytes / 2; ++i) numbers_[i] = uint16_t(2 * i);
  }

  int64_t padded() const { return vectors() * kBytes; }

  // The first half: makes the costs of a row, and keeps what all paths that have come so far add up to.
  void keep(int64_t y, uint8_t* costs, uint8_t* sums) {
    if (pair_.costs == nullptr) costs_.row(y, step_, costs);
    const uint8_t* row = costs_of(y, costs);
    const int64_t width = pair_.width, padded = this->padded();
    Bytes added[kMost], passing[kMost];
    start_along();
    for (int64_t x = 0; x < width; ++x) {
      go(along_, along_, row + x * padded, added);
      for (int k = 0; k < vectors(); ++k) store(from_left_ + x * padded + k * kBytes, added[k]);
    }
    start_along();
    for (int64_t x = width - 1; x >= 0; --x) {
      const uint8_t* cost = row + x * padded;
      Words even[kMost], odd[kMost];
      go(along_, along_, cost, added);
      for (int k = 0; k < vectors(); ++k) {
        const Words all = (Words)load<Bytes>(cost + k * kBytes);
        const Words sides = (Words)(added[k] + load<Bytes>(from_left_ + x * padded + k * kBytes));
        even[k] = (all & 0xff) * uint16_t(pair_.paths) + (sides & 0xff);
        odd[k] = (all >> 8) * uint16_t(pair_.paths) + (sides >> 8);
      }
      come(x, cost, even, odd, added, passing);
      uint8_t* sum = sums + 2 * x * padded;
      for (int k = 0; k < vectors(); ++k, sum += 2 * kBytes) store(sum, even[k]), store(sum + kBytes, odd[k]);
    }
    ++rows_;
  }

  // The second half: adds the paths that come from this side to what was kept of the others.
  void finish(int64_t y, const uint8_t* costs, const uint8_t* sums, const Winners& winners) {
    const uint8_t* row = costs_of(y, costs);
    const int64_t padded = this->padded();
    Bytes added[kMost], passing[kMost];
    for (int64_t x = pair_.width - 1; x >= 0; --x) {
      Words even[kMost], odd[kMost];
      const uint8_t* sum = sums + 2 * x * padded;
      for (int k = 0; k < vectors(); ++k, sum += 2 * kBytes)
        even[k] = load<Words>(sum), odd[k] = load<Words>(sum + kBytes);
      come(x, row + x * padded, even, odd, added, passing);
      choose(even, odd, winners, y * pair_.width + x);
    }
    ++rows_;
  }

 private:
  int vectors() const { return kVectors ? kVectors : vectors_; }
  int64_t stride() const { return padded() + kBytes; }

  // Ends of paths that begin, all 0, with their gaps.
  uint8_t* begin(uint8_t* memory, int64_t pixels) {
    std::memset(memory, pair_.p2, pixels * stride() + kBytes);
    for (int64_t x = 0; x < pixels; ++x) std::memset(memory + x * stride() + kBytes, 0, padded());
    return memory + kBytes;
  }

  void start_along() { std::memset(along_, 0, padded()); }

  const uint8_t* costs_of(int64_t y, const uint8_t* made) {
    if (pair_.costs == nullptr) return made;
    const uint8_t* row = pair_.costs + y * pair_.width * pair_.disparities;
    if (pair_.disparities == padded()) return row;
    for (int64_t x = 0; x < pair_.width; ++x)
      std::memcpy(given_ + x * padded(), row + x * pair_.disparities, pair_.disparities);
    return given_;
  }

  // A path comes to a pixel: what it adds to the costs there, and its end.
  inline void go(const uint8_t* from, uint8_t* to, const uint8_t* cost, Bytes* added) {
    Bytes ends[kMost], lowest = {};
    lowest -= 1;
    for (int k = 0; k < vectors(); ++k, from += kBytes) {
      const Bytes beside = lesser(load<Bytes>(from - 1), load<Bytes>(from + 1)) + p1_;
      added[k] = lesser(load<Bytes>(from), beside);
      ends[k] = (load<Bytes>(cost + k * kBytes) + added[k]) | beyond_[k];
      lowest = lesser(lowest, ends[k]);
    }
    const uint8_t least = uint8_t(least_of(lowest));
    for (int k = 0; k < vectors(); ++k) store(to + k * kBytes, lesser(ends[k] - least, p2_));
  }

  // The paths from the row before, of which those along a diagonal stay where they are in memory.
  inline void come(int64_t x, const uint8_t* cost, Words* even, Words* odd, Bytes* added, Bytes* passing) {
    uint8_t* straight = paths_[0] + x * stride();
    go(straight, straight, cost, added);
    if (pair_.paths == 8) {
      const int64_t width = pair_.width, turned = rows_ % width;
      const int64_t right = x - turned + (x < turned ? width : 0), left = x + turned - (x + turned < width ? 0 : width);
      uint8_t *to_right = paths_[1] + right * stride(), *to_left = paths_[2] + left * stride();
      go(x == 0 ? nowhere_ : to_right, to_right, cost, passing);
      for (int k = 0; k < vectors(); ++k) added[k] += passing[k];
      go(x == width - 1 ? nowhere_ : to_left, to_left, cost, passing);
      for (int k = 0; k < vectors(); ++k) even[k] += (Words)passing[k] & 0xff, odd[k] += (Words)passing[k] >> 8;
    }
    for (int k = 0; k < vectors(); ++k) even[k] += (Words)added[k] & 0xff, odd[k] += (Words)added[k] >> 8;
  }

  // The cheapest disparity of a pixel, and what `select.Winners` tells of it.
  inline void choose(Words* even, Words* odd, const Winners& winners, int64_t pixel) {
    uint16_t totals[kMost * kBytes];  // the even ones of a vector, then the odd ones
    Words lowest = {};
    lowest -= 1;
    const Words most = lowest;
    for (int k = 0; k < vectors(); ++k) {
      if (pair_.disparities < padded()) {
        even[k] |= ((Words)beyond_[k] & 0xff) * uint16_t(0x101);
        odd[k] |= ((Words)beyond_[k] >> 8) * uint16_t(0x101);
      }
      store(totals + k * kBytes, even[k]), store(totals + k * kBytes + kBytes / 2, odd[k]);
      lowest = lesser(lowest, lesser(even[k], odd[k]));
    }
    const uint16_t cost = uint16_t(least_of(lowest));
    lowest = most;
    for (int k = 0; k < vectors(); ++k) {
      const Words number = numbers_ + uint16_t(k * kBytes);
      lowest = lesser(lowest, lesser(even[k] == cost ? number : most, odd[k] == cost ? number + 1 : most));
    }
    const int place = least_of(lowest);
    lowest = most;
    for (int k = 0; k < vectors(); ++k) {
      const Words apart = numbers_ + uint16_t(k * kBytes - place + 1);  // 0, 1 and 2 at the place and beside it
      lowest = lesser(lowest, lesser(apart > 2 ? even[k] : most, apart + 1 > 2 ? odd[k] : most));
    }
    const auto total = [&](int d) { return totals[d / kBytes * kBytes + (d % 2) * (kBytes / 2) + d % kBytes / 2]; };
    winners.place[pixel] = int16_t(place);
    winners.cost[pixel] = cost;
    winners.second[pixel] = uint16_t(least_of(lowest));
    winners.lower[pixel] = total(std::max(place - 1, 0));
    winners.higher[pixel] = total(std::min<int>(place + 1, int(pair_.disparities) - 1));
  }

  const Pair& pair_;
  int64_t step_, rows_ = 0;
  int vectors_;
  CensusCosts costs_;
  uint8_t *paths_[3], *nowhere_, *along_, *from_left_, *given_;
  Bytes p1_, p2_, beyond_[kMost];
  Words numbers_;
};

// ---- Two walks that meet in the middle ----

// Does work(0) and work(1), side by side where a thread of XLA is idle.
void in_pair(ffi::ThreadPool& pool, const std::function<void(int)>& work) {
  struct Shared {
    std::function<void(int)> work;
    std::atomic<int> next{0};
    int done = 0;
    std::mutex mutex;
    std::condition_variable finished;
    void run() {
      for (int index; (index = next.fetch_add(1)) < 2;) {
        work(index);
        std::lock_guard<std::mutex> lock(mutex);
        if (++done == 2) finished.notify_all();
      }
    }
  };
  auto shared = std::make_shared<Shared>();
  shared->work = work;
  if (pool.num_threads() > 1) pool.Schedule([shared] { shared->run(); });
  shared->run();
  std::unique_lock<std::mutex> lock(shared->mutex);
  shared->finished.wait(lock, [&] { return shared->done == 2; });
}

struct Workspace {
  Room costs, sums, walks[2];
};

template <int kBytes, int kVectors>
void match(ffi::ThreadPool& pool, const Pair& pair, Workspace& work, const Winners& winners) {
  using HalfWalk = Walk<kBytes, kVectors>;
  HalfWalk walks[2] = {{pair, 1, work.walks[0]}, {pair, -1, work.walks[1]}};
  const int64_t middle = pair.height / 2, last = pair.height - 1, row = pair.width * walks[0].padded();
  uint8_t* costs = pair.costs ? nullptr : work.costs.of(pair.height * row);
  uint8_t* sums = work.sums.of(2 * pair.height * row);
  const auto costs_at = [&](int64_t y) { return costs ? costs + y * row : nullptr; };
  in_pair(pool, [&](int side) {
    HalfWalk& walk = walks[side];
    if (side == 0) {
      for (int64_t y = 0; y < middle; ++y) walk.keep(y, costs_at(y), sums + 2 * y * row);
    } else {
      for (int64_t y = last; y >= middle; --y) walk.keep(y, costs_at(y), sums + 2 * y * row);
    }
  });
  in_pair(pool, [&](int side) {
    HalfWalk& walk = walks[side];
    if (side == 0) {
      for (int64_t y = middle; y <= last; ++y) walk.finish(y, costs_at(y), sums + 2 * y * row, winners);
    } else {
      for (int64_t y = middle - 1; y >= 0; --y) walk.finish(y, costs_at(y), sums + 2 * y * row, winners);
    }
  });
}

// Vectors of 64 bytes, or of 32 where those hold the disparities with less to spare.
void match_any(ffi::ThreadPool& pool, const Pair& pair, Workspace& work, const Winners& winners) {
  const int64_t by_32 = (pair.disparities + 31) / 32, by_64 = (pair.disparities + 63) / 64;
  if (by_32 == 2 * by_64) {
    if (by_64 == 1) return match<64, 1>(pool, pair, work, winners);
    if (by_64 == 2) return match<64, 2>(pool, pair, work, winners);
    if (by_64 == 3) return match<64, 3>(pool, pair, work, winners);
    return match<64, 0>(pool, pair, work, winners);
  }
  if (by_32 == 1) return match<32, 1>(pool, pair, work, winners);
  if (by_32 == 3) return match<32, 3>(pool, pair, work, winners);
  if (by_32 == 5) return match<32, 5>(pool, pair, work, winners);
  return match<32, 0>(pool, pair, work, winners);
}

class Kept {
 public:
  Kept() {
    std::lock_guard<std::mutex> lock(mutex_);
    if (idle_.empty()) {
      work_ = std::make_unique<Workspace>();
    } else {
      work_ = std::move(idle_.back());
      idle_.pop_back();
    }
  }
  ~Kept() {
    std::lock_guard<std::mutex> lock(mutex_);
    idle_.push_back(std::move(work_));
  }
  Workspace& operator*() { return *work_; }

 private:
  std::unique_ptr<Workspace> work_;
  static inline std::mutex mutex_;
  static inline std::vector<std::unique_ptr<Workspace>> idle_;
};

ffi::Error call(ffi::ThreadPool pool, ffi::Buffer<ffi::U32> left, ffi::Buffer<ffi::U32> right,
                ffi::Buffer<ffi::U8> costs, ffi::Buffer<ffi::U8> penalties, ffi::Result<ffi::Buffer<ffi::S16>> place,
                ffi::Result<ffi::Buffer<ffi::U16>> cost, ffi::Result<ffi::Buffer<ffi::U16>> second,
                ffi::Result<ffi::Buffer<ffi::U16>> lower, ffi::Result<ffi::Buffer<ffi::U16>> higher, int64_t paths,
                int64_t disparities, int64_t first, int64_t block, int64_t scale, int64_t outside) {
  Pair pair{};
  pair.height = place->dimensions()[0], pair.width = place->dimensions()[1];
  pair.disparities = disparities, pair.first = first;
  pair.words = left.dimensions()[0], pair.left = left.typed_data(), pair.right = right.typed_data();
  pair.costs = costs.element_count() ? costs.typed_data() : nullptr;
  pair.block = int(block), pair.scale = int(scale), pair.outside = int(outside);
  pair.p1 = penalties.typed_data()[0], pair.p2 = penalties.typed_data()[1], pair.paths = int(paths);
  const Winners winners{place->typed_data(), cost->typed_data(), second->typed_data(), lower->typed_data(),
                        higher->typed_data()};
  try {
    Kept work;
    match_any(pool, pair, *work, winners);
  } catch (const std::bad_alloc&) {
    return ffi::Error(ffi::ErrorCode::kResourceExhausted, "not enough memory to match an image");
  }
  return ffi::Error::Success();
}

}  // namespace

extern "C" XLA_FFI_DEFINE_HANDLER_SYMBOL(jaxmap_sgm, call,
                              ffi::Ffi::Bind()
                                  .Ctx<ffi::ThreadPool>()
                                  .Arg<ffi::Buffer<ffi::U32>>()
                                  .Arg<ffi::Buffer<ffi::U32>>()
                                  .Arg<ffi::Buffer<ffi::U8>>()
                                  .Arg<ffi::Buffer<ffi::U8>>()
                                  .Ret<ffi::Buffer<ffi::S16>>()
                                  .Ret<ffi::Buffer<ffi::U16>>()
                                  .Ret<ffi::Buffer<ffi::U16>>()
                                  .Ret<ffi::Buffer<ffi::U16>>()
                                  .Ret<ffi::Buffer<ffi::U16>>()
                                  .Attr<int64_t>("paths")
                                  .Attr<int64_t>("disparities")
                                  .Attr<int64_t>("first")
                                  .Attr<int64_t>("block")
                                  .Attr<int64_t>("scale")
                                  .Attr<int64_t>("outside"));
