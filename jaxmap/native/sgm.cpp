// Semi-global matching of an image: costs, the paths of both ways, and the winner of each pixel.
//
// The twin of `matching.aggregate.aggregate_planes` with `select.winners`, bit for bit, and of the costs of the census
// in `matching.costs`. All disparities of a pixel lie side by side, a byte each, and what a row needs stays in the
// cache. Two threads meet in the middle: one walks down the upper half while the other walks up the lower half, and
// both keep what the paths that come their way add up to. Then each goes on into the other's half, where the sums of
// its paths and those that are kept make the whole, of which only the winner is written.

#include <algorithm>
#include <cstdint>
#include <cstring>
#include <memory>
#include <mutex>
#include <new>
#include <type_traits>
#include <utility>
#include <vector>

#if defined(__SSE4_1__)
#include <immintrin.h>
#endif

#include "threads.h"
#include "vectors.h"
#include "xla/ffi/api/ffi.h"

namespace ffi = xla::ffi;

namespace {

using jaxmap::in_parallel;
using jaxmap::Scratch;

// ---- Vectors ----

template <typename Number, int kBytes>
struct VectorOf {
  typedef Number type __attribute__((vector_size(kBytes)));
};
using Bytes16 = VectorOf<uint8_t, 16>::type;

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

// The upper half of the products of 16-bit numbers.
template <typename Words>
inline Words high_product(Words words, uint16_t factor) {
#if defined(__AVX512BW__)
  if constexpr (sizeof(Words) == 64) return (Words)_mm512_mulhi_epu16((__m512i)words, _mm512_set1_epi16(factor));
#endif
#if defined(__AVX2__)
  if constexpr (sizeof(Words) == 32) return (Words)_mm256_mulhi_epu16((__m256i)words, _mm256_set1_epi16(factor));
#endif
  for (size_t i = 0; i < sizeof(Words) / 2; ++i) words[i] = uint16_t((uint32_t(words[i]) * factor) >> 16);
  return words;
}

// The lanes of a vector moved up by one, with the last of the one before it; and down, with the first of the next.
template <typename Bytes, int... kLane>
inline Bytes moved_up(Bytes before, Bytes here, std::integer_sequence<int, kLane...>) {
  return __builtin_shufflevector(before, here, (kLane + int(sizeof(Bytes)) - 1)...);
}
template <typename Bytes, int... kLane>
inline Bytes moved_down(Bytes here, Bytes next, std::integer_sequence<int, kLane...>) {
  return __builtin_shufflevector(here, next, (kLane + 1)...);
}

// The least lane of a vector, in all lanes of another: halves are compared until 16 bytes are left.
template <typename Vector>
inline Vector least_of(Vector vector) {
  using Number = std::decay_t<decltype(vector[0])>;
  constexpr int kLeft = sizeof(Vector) / 16;
  using Short = typename VectorOf<Number, 16>::type;
  Short parts[kLeft];
  std::memcpy(parts, &vector, sizeof(Vector));
  for (int count = kLeft / 2; count > 0; count /= 2)
    for (int i = 0; i < count; ++i) parts[i] = lesser(parts[i], parts[i + count]);
#if defined(__SSE4_1__)
  using Words = VectorOf<uint16_t, 16>::type;
  Words words = (Words)parts[0];
  if (sizeof(Number) == 1) words = (Words)lesser((Bytes16)words, (Bytes16)(words >> 8));  // its upper bytes are 0
  const __m128i least = _mm_minpos_epu16((__m128i)words);
#if defined(__AVX512BW__)
  if constexpr (sizeof(Vector) == 64)
    return (Vector)(sizeof(Number) == 1 ? _mm512_broadcastb_epi8(least) : _mm512_broadcastw_epi16(least));
#endif
#if defined(__AVX2__)
  if constexpr (sizeof(Vector) == 32)
    return (Vector)(sizeof(Number) == 1 ? _mm256_broadcastb_epi8(least) : _mm256_broadcastw_epi16(least));
#endif
  return Vector{} + Number(_mm_cvtsi128_si32(least));
#else
  Number least = parts[0][0];
  for (size_t i = 1; i < 16 / sizeof(Number); ++i) least = std::min<Number>(least, parts[0][i]);
  return Vector{} + least;
#endif
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

// ---- Costs of the census ----

// Row by row, in the order of a walk; each is the mean over a block, whose edges are repeated.
template <int kBytes, int kVectors>
class CensusCosts {
 public:
  using Bytes = typename VectorOf<uint8_t, kBytes>::type;
  using Words = typename VectorOf<uint16_t, kBytes>::type;

  CensusCosts(const Pair& pair, int vectors)
      : pair_(pair), vectors_(vectors), padded_(vectors * kBytes), reach_(pair.block / 2) {
    reversed_.resize(pair.words * (pair.width + padded_));
    if (pair.block == 1 || pair.costs != nullptr) return;
    const int64_t row = pair.width * padded_;
    raw_.resize((pair.block + 1) * row);
    held_.assign(pair.block + 1, -1);
    columns_.assign(row, 0);
    const int size = pair.block * pair.block;
    while (size >> (shift_ + 1)) ++shift_;
    factor_ = uint16_t((1 << (16 + shift_)) / size + 1);
  }

  // Before the pixels of a row, which come from the left; the row after `y` must be `y + step`.
  void start(int64_t y, int64_t step) {
    if (pair_.block == 1) return describe(y);
    const int64_t last = pair_.height - 1;
    if (!begun_) {
      for (int64_t k = -reach_; k <= reach_; ++k) {
        const int64_t row = std::clamp<int64_t>(y + k, 0, last);
        start_column_sums(row);
        for (int64_t x = 0; x < pair_.width; ++x) add_to_column(x);
      }
      come_ = gone_ = nullptr;
    } else {
      start_column_sums(std::clamp<int64_t>(y + step * reach_, 0, last));
      gone_ = row_of(std::clamp<int64_t>(y - step * (reach_ + 1), 0, last));
    }
    begun_ = true;
    for (int64_t x = 0; x <= std::min(reach_, pair_.width - 1); ++x) add_to_column(x);
    for (int k = 0; k < vectors(); ++k) even_[k] = odd_[k] = Words{} + uint16_t(pair_.block * pair_.block / 2);
    for (int64_t x = -reach_; x <= reach_; ++x) {
      const uint16_t* column = column_of(x);
      for (int k = 0; k < vectors(); ++k, column += kBytes)
        even_[k] += load<Words>(column), odd_[k] += load<Words>(column + kBytes / 2);
    }
  }

  // The costs of the next pixel.
  void pixel(int64_t x, uint8_t* costs) {
    if (pair_.block == 1) {
      compare(x, costs);
    } else {
      for (int k = 0; k < vectors(); ++k)
        store(costs + k * kBytes, (Bytes)(mean(even_[k]) | mean(odd_[k]) << 8));
      if (x + reach_ + 1 < pair_.width) add_to_column(x + reach_ + 1);
      const uint16_t *come = column_of(x + reach_ + 1), *gone = column_of(x - reach_);
      for (int k = 0; k < vectors(); ++k, come += kBytes, gone += kBytes) {
        even_[k] += load<Words>(come) - load<Words>(gone);
        odd_[k] += load<Words>(come + kBytes / 2) - load<Words>(gone + kBytes / 2);
      }
    }
    // Matches outside the right image have the largest cost.
    const int64_t from = std::clamp<int64_t>(x - pair_.first - (pair_.width - 1), 0, padded_);
    const int64_t to = std::clamp<int64_t>(x - pair_.first + 1, from, padded_);
    if (from > 0) std::memset(costs, pair_.outside, from);
    if (to < padded_) std::memset(costs + to, pair_.outside, padded_ - to);
  }

 private:
  int vectors() const { return kVectors ? kVectors : vectors_; }

  // The words of a row of the right image in the order of disparities.
  void describe(int64_t y) {
    const int64_t width = pair_.width, image = pair_.height * width, length = width + padded_;
    for (int64_t word = 0; word < pair_.words; ++word) {
      const uint32_t* right = pair_.right + word * image + y * width;
      uint32_t* reversed = &reversed_[word * length];
      for (int64_t i = 0; i < length; ++i)
        reversed[i] = right[std::clamp<int64_t>(width - 1 - pair_.first - i, 0, width - 1)];
    }
    left_ = pair_.left + y * width;
  }

  // How many bits differ, at all disparities.
  void compare(int64_t x, uint8_t* __restrict costs) const {
    const int64_t image = pair_.height * pair_.width, length = pair_.width + padded_, padded = vectors() * kBytes;
    const uint32_t *left = left_ + x, *right = &reversed_[pair_.width - 1 - x];
    if (pair_.words == 2) {
      const uint32_t a = left[0], b = left[image], scale = pair_.scale;
      const uint32_t *__restrict as = right, *__restrict bs = right + length;
      for (int64_t d = 0; d < padded; ++d)
        costs[d] = uint8_t((__builtin_popcount(a ^ as[d]) + __builtin_popcount(b ^ bs[d])) * scale);
    } else {
      for (int64_t d = 0; d < padded; ++d) {
        int bits = 0;
        for (int64_t word = 0; word < pair_.words; ++word)
          bits += __builtin_popcount(left[word * image] ^ right[word * length + d]);
        costs[d] = uint8_t(bits * pair_.scale);
      }
    }
  }

  uint8_t* row_of(int64_t y) { return &raw_[y % (pair_.block + 1) * pair_.width * padded_]; }

  // Costs of the row are compared unless they are held already, and added to the sums of the columns.
  void start_column_sums(int64_t y) {
    int64_t& held = held_[y % (pair_.block + 1)];
    come_ = row_of(y);
    is_new_ = held != y;
    if (is_new_) describe(y);
    held = y;
    gone_ = nullptr;
  }

  uint16_t* column_of(int64_t x) { return &columns_[std::clamp<int64_t>(x, 0, pair_.width - 1) * padded_]; }

  void add_to_column(int64_t x) {
    if (come_ == nullptr) return;
    uint8_t* come = come_ + x * padded_;
    if (is_new_) compare(x, come);
    uint16_t* column = column_of(x);
    for (int k = 0; k < vectors(); ++k, column += kBytes) {
      const Words more = (Words)load<Bytes>(come + k * kBytes);
      Words even = load<Words>(column) + (more & 0xff), odd = load<Words>(column + kBytes / 2) + (more >> 8);
      if (gone_ != nullptr) {
        const Words less = (Words)load<Bytes>(gone_ + x * padded_ + k * kBytes);
        even -= less & 0xff, odd -= less >> 8;
      }
      store(column, even), store(column + kBytes / 2, odd);
    }
  }

  // A sum over the block, which half of it was added to, divided by its size.
  Words mean(Words sums) const { return high_product(sums, factor_) >> shift_; }

  const Pair& pair_;
  int vectors_;
  int64_t padded_, reach_;
  const uint32_t* left_ = nullptr;
  std::vector<uint32_t> reversed_;
  std::vector<uint8_t> raw_;
  std::vector<int64_t> held_;
  std::vector<uint16_t> columns_;
  uint8_t *come_ = nullptr, *gone_ = nullptr;
  Words even_[kVectors ? kVectors : 2048 / kBytes], odd_[kVectors ? kVectors : 2048 / kBytes];
  uint16_t factor_ = 0;
  int shift_ = 0;
  bool begun_ = false, is_new_ = false;
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

  Walk(const Pair& pair, int64_t step, Scratch<uint8_t>& room)
      : pair_(pair), step_(step), vectors_((pair.disparities + kBytes - 1) / kBytes), costs_(pair, vectors()) {
    const int64_t ends = pair.width * stride() + kBytes, row = pair.width * padded();
    uint8_t* memory = room.of(3 * ends + 2 * stride() + 2 * row);
    for (uint8_t*& path : paths_) path = begin(memory, pair.width), memory += ends;
    nowhere_ = begin(memory, 1), memory += 2 * stride();
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
  [[gnu::noinline]] void keep(int64_t y, uint8_t* costs, uint8_t* sums) {
    const bool given = pair_.costs != nullptr;
    const int64_t width = pair_.width, padded = this->padded();
    const uint8_t* row = given ? costs_of(y) : costs;
    Bytes along[kMost] = {}, added[kMost], passing[kMost];
    if (!given) costs_.start(y, step_);
    for (int64_t x = 0; x < width; ++x) {
      if (!given) costs_.pixel(x, costs + x * padded);
      go_along(along, row + x * padded, added);
      for (int k = 0; k < vectors(); ++k) store(from_left_ + x * padded + k * kBytes, added[k]);
    }
    std::memset(along, 0, sizeof(along));
    for (int64_t x = width - 1; x >= 0; --x) {
      const uint8_t* cost = row + x * padded;
      Words even[kMost], odd[kMost];
      go_along(along, cost, added);
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
  [[gnu::noinline]] void finish(int64_t y, const uint8_t* costs, const uint8_t* sums, const Winners& winners) {
    const uint8_t* row = pair_.costs ? costs_of(y) : costs;
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

  // A row of given costs.
  const uint8_t* costs_of(int64_t y) {
    const uint8_t* row = pair_.costs + y * pair_.width * pair_.disparities;
    if (pair_.disparities == padded()) return row;
    for (int64_t x = 0; x < pair_.width; ++x)
      std::memcpy(given_ + x * padded(), row + x * pair_.disparities, pair_.disparities);
    return given_;
  }

  // A path comes to a pixel: what it adds to the costs there, and its end.
  inline void go(const uint8_t* from, uint8_t* to, const uint8_t* cost, Bytes* added) {
    Bytes ends[kMost];
    for (int k = 0; k < vectors(); ++k, from += kBytes) {
      const Bytes beside = lesser(load<Bytes>(from - 1), load<Bytes>(from + 1)) + p1_;
      added[k] = lesser(load<Bytes>(from), beside);
    }
    arrive(cost, added, ends);
    for (int k = 0; k < vectors(); ++k) store(to + k * kBytes, ends[k]);
  }

  // The same along a row, where the end of the pixel before has just been made: in memory it would have to be awaited.
  inline void go_along(Bytes* ends, const uint8_t* cost, Bytes* added) {
    using Lanes = std::make_integer_sequence<int, kBytes>;
    for (int k = 0; k < vectors(); ++k) {
      const Bytes before = k > 0 ? ends[k - 1] : p2_, next = k + 1 < vectors() ? ends[k + 1] : p2_;
      const Bytes beside = lesser(moved_up(before, ends[k], Lanes()), moved_down(ends[k], next, Lanes())) + p1_;
      added[k] = lesser(ends[k], beside);
    }
    arrive(cost, added, ends);
  }

  inline void arrive(const uint8_t* cost, const Bytes* added, Bytes* ends) {
    Bytes lowest = {};
    lowest -= 1;
    for (int k = 0; k < vectors(); ++k) {
      ends[k] = (load<Bytes>(cost + k * kBytes) + added[k]) | beyond_[k];
      lowest = lesser(lowest, ends[k]);
    }
    const Bytes least = least_of(lowest);
    for (int k = 0; k < vectors(); ++k) ends[k] = lesser(ends[k] - least, p2_);
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
    const Words cost = least_of(lowest);
    lowest = most;
    for (int k = 0; k < vectors(); ++k) {
      const Words number = numbers_ + uint16_t(k * kBytes);
      lowest = lesser(lowest, lesser(even[k] == cost ? number : most, odd[k] == cost ? number + 1 : most));
    }
    const int place = least_of(lowest)[0];
    lowest = most;
    for (int k = 0; k < vectors(); ++k) {
      const Words apart = numbers_ + uint16_t(k * kBytes - place + 1);  // 0, 1 and 2 at the place and beside it
      lowest = lesser(lowest, lesser(apart > 2 ? even[k] : most, apart + 1 > 2 ? odd[k] : most));
    }
    const auto total = [&](int d) { return totals[d / kBytes * kBytes + (d % 2) * (kBytes / 2) + d % kBytes / 2]; };
    winners.place[pixel] = int16_t(place);
    winners.cost[pixel] = cost[0];
    winners.second[pixel] = least_of(lowest)[0];
    winners.lower[pixel] = total(std::max(place - 1, 0));
    winners.higher[pixel] = total(std::min<int>(place + 1, int(pair_.disparities) - 1));
  }

  const Pair& pair_;
  int64_t step_, rows_ = 0;
  int vectors_;
  CensusCosts<kBytes, kVectors> costs_;
  uint8_t *paths_[3], *nowhere_, *from_left_, *given_;
  Bytes p1_, p2_, beyond_[kMost];
  Words numbers_;
};

// ---- Two walks that meet in the middle ----

struct Workspace {
  Scratch<uint8_t> costs, sums, walks[2];
};

template <int kBytes, int kVectors>
void match(ffi::ThreadPool& pool, const Pair& pair, Workspace& work, const Winners& winners) {
  using HalfWalk = Walk<kBytes, kVectors>;
  HalfWalk walks[2] = {{pair, 1, work.walks[0]}, {pair, -1, work.walks[1]}};
  const int64_t middle = pair.height / 2, last = pair.height - 1, row = pair.width * walks[0].padded();
  uint8_t* costs = pair.costs ? nullptr : work.costs.of(pair.height * row);
  uint8_t* sums = work.sums.of(2 * pair.height * row);
  const auto costs_at = [&](int64_t y) { return costs ? costs + y * row : nullptr; };
  // From the outermost row of a half to the middle, and on through the other half.
  in_parallel(pool, 2, [&](int64_t side) {
    const int64_t begin = side ? last : 0, end = side ? middle - 1 : middle, step = side ? -1 : 1;
    for (int64_t y = begin; y != end; y += step) walks[side].keep(y, costs_at(y), sums + 2 * y * row);
  });
  in_parallel(pool, 2, [&](int64_t side) {
    const int64_t begin = side ? middle - 1 : middle, end = side ? -1 : last + 1, step = side ? -1 : 1;
    for (int64_t y = begin; y != end; y += step) walks[side].finish(y, costs_at(y), sums + 2 * y * row, winners);
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

XLA_FFI_DEFINE_HANDLER_SYMBOL(jaxmap_sgm, call,
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
