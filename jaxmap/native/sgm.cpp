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
#include <new>
#include <utility>

#include "census.h"
#include "small_integers.h"
#include "threads.h"
#include "vectors.h"
#include "xla/ffi/api/ffi.h"

namespace ffi = xla::ffi;

namespace {

using namespace jaxmap;

struct Winners {
  int16_t* place;
  uint16_t *cost, *second, *lower, *higher;
};

constexpr int vectors_for(int64_t disparities, int bytes) { return int((disparities + bytes - 1) / bytes); }

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
      : pair_(pair), step_(step), vectors_(vectors_for(pair.disparities, kBytes)), costs_(pair, vectors()) {
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
      for (int k = 0; k < vectors(); ++k, sum += 2 * kBytes)
        store_for_later(sum, even[k]), store_for_later(sum + kBytes, odd[k]);
    }
    all_stored();
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

template <int kBytes>
void match_by(ffi::ThreadPool& pool, const Pair& pair, Workspace& work, const Winners& winners) {
  switch (vectors_for(pair.disparities, kBytes)) {
    case 1: return match<kBytes, 1>(pool, pair, work, winners);
    case 2: return match<kBytes, 2>(pool, pair, work, winners);
    case 3: return match<kBytes, 3>(pool, pair, work, winners);
    case 4: return match<kBytes, 4>(pool, pair, work, winners);
    default: return match<kBytes, 0>(pool, pair, work, winners);
  }
}

// By vectors as long as the processor's, or half as long where those hold the disparities with less to spare.
void match_any(ffi::ThreadPool& pool, const Pair& pair, Workspace& work, const Winners& winners) {
  constexpr int kHalf = kWidest / 2;
  if (vectors_for(pair.disparities, kHalf) < 2 * vectors_for(pair.disparities, kWidest))
    return match_by<kHalf>(pool, pair, work, winners);
  match_by<kWidest>(pool, pair, work, winners);
}

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
    auto work = Kept<Workspace>::take();
    match_any(pool, pair, *work, winners);
    Kept<Workspace>::give_back(std::move(work));
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
