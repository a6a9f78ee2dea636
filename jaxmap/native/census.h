// Costs of the census, row by row.

#pragma once

#include <algorithm>
#include <cstdint>
#include <cstring>
#include <vector>

#include "small_integers.h"

namespace jaxmap {

// What is matched, and how.
struct Pair {
  int64_t height, width, disparities, first;
  int64_t words;  // of the census of a pixel
  const uint32_t *left, *right;
  const uint8_t* costs;  // (height, width, disparities), where they are given
  int block, scale, outside;
  int p1, p2, paths;
};

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
#if defined(__AVX512VPOPCNTDQ__)
      for (int64_t d = 0; d < padded; ++d)
        costs[d] = uint8_t((__builtin_popcount(a ^ as[d]) + __builtin_popcount(b ^ bs[d])) * scale);
#else  // one by one, so both words at once
      for (int64_t d = 0; d < padded; ++d)
        costs[d] = uint8_t(__builtin_popcountll(uint64_t(b ^ bs[d]) << 32 | (a ^ as[d])) * scale);
#endif
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

}  // namespace jaxmap
