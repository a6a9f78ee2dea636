// From the winners of semi-global matching to disparity: what is doubtful is left out.
//
// The twin of `matching.select.decide`, bit for bit: uniqueness, the left-right check, parabolas between disparities,
// speckles and edges.

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <vector>

#include "xla/ffi/api/ffi.h"

namespace ffi = xla::ffi;

namespace {

constexpr float kUnknown = std::numeric_limits<float>::quiet_NaN();
constexpr float kInfinity = std::numeric_limits<float>::infinity();

struct Image {
  int64_t height, width;
  float* disparity;

  float* row(int64_t y) const { return disparity + y * width; }
};

struct Winners {
  const int16_t* place;
  const uint16_t *cost, *second, *lower, *higher;
};

struct Checks {
  int64_t disparities, first;
  float least_ratio;   // of the winner's cost to the second's
  float most_apart;    // in the left-right check; negative for none
};

// The disparities of a row whose matches are inside the right image, unique, and the same seen from there.
void choose(const Winners& winners, const Checks& checks, int64_t width, float* disparity) {
  constexpr int32_t kNone = std::numeric_limits<int32_t>::max();
  thread_local std::vector<int32_t> cheapest, place_there;
  cheapest.assign(width, kNone);
  place_there.assign(width, kNone);
  const auto column_there = [&](int64_t x) { return x - checks.first - winners.place[x]; };
  const auto is_inside = [&](int64_t column) { return column >= 0 && column < width; };
  // A pixel of the right image has the disparity of the cheapest of all winners that lead to it.
  for (int64_t x = 0; x < width; ++x) {
    const int64_t there = column_there(x);
    if (!is_inside(there)) continue;
    const int32_t cost = winners.cost[x], place = winners.place[x];
    if (cost < cheapest[there] || (cost == cheapest[there] && place < place_there[there]))
      cheapest[there] = cost, place_there[there] = place;
  }
  for (int64_t x = 0; x < width; ++x) {
    const int64_t there = column_there(x);
    const int32_t place = winners.place[x];
    const float cost = winners.cost[x], lower = winners.lower[x], higher = winners.higher[x];
    disparity[x] = kUnknown;
    if (!is_inside(there) || !(float(winners.second[x]) * checks.least_ratio > cost)) continue;
    if (checks.most_apart >= 0 && float(std::abs(place_there[there] - place)) > checks.most_apart) continue;
    const float bend = lower + higher - 2 * cost;
    const bool has_both = place > 0 && place < checks.disparities - 1;
    const float offset = has_both && bend > 0 ? (lower - higher) / (2 * bend) : 0.0f;
    disparity[x] = float(checks.first) + (float(place) + offset);
  }
}

// Pixels in a row that hang together are a run; runs that hang together are a blob.
class Blobs {
 public:
  void drop(const Image& image, float step, int64_t most) {
    const int64_t width = image.width;
    runs_.resize(image.height * width);
    parents_.clear();
    sizes_.clear();
    for (int64_t y = 0; y < image.height; ++y) {
      const float *here = image.row(y), *above = here - width;
      int32_t *runs = &runs_[y * width], *runs_above = runs - width;
      int32_t tied_run = -1, tied_above = -1;  // that were joined last
      for (int64_t x = 0; x < width; ++x) {
        if (std::isnan(here[x])) continue;
        if (x == 0 || !(std::fabs(here[x] - here[x - 1]) <= step)) {
          parents_.push_back(int32_t(parents_.size()));
          sizes_.push_back(0);
        }
        const int32_t run = runs[x] = int32_t(parents_.size() - 1);
        ++sizes_[run];
        if (y == 0 || !(std::fabs(here[x] - above[x]) <= step)) continue;
        if (run == tied_run && runs_above[x] == tied_above) continue;
        tied_run = run, tied_above = runs_above[x];
        join(run, tied_above);
      }
    }
    // A parent has a lower number than its runs.
    for (int32_t run = int32_t(parents_.size()) - 1; run >= 0; --run)
      if (parents_[run] != run) sizes_[parents_[run]] += sizes_[run];
    for (size_t run = 0; run < parents_.size(); ++run) sizes_[run] = sizes_[parents_[run]];
    for (int64_t i = 0; i < image.height * width; ++i)
      if (!std::isnan(image.disparity[i]) && sizes_[runs_[i]] <= most) image.disparity[i] = kUnknown;
  }

 private:
  int32_t root(int32_t run) {
    while (parents_[run] != run) run = parents_[run] = parents_[parents_[run]];
    return run;
  }

  void join(int32_t a, int32_t b) {
    a = root(a), b = root(b);
    parents_[std::max(a, b)] = std::min(a, b);
  }

  std::vector<int32_t> runs_, parents_;
  std::vector<int64_t> sizes_;
};

// Without pixels that have a greater step of disparity within a square around them.
class Edges {
 public:
  void drop(const Image& image, float step, int64_t window) {
    const int64_t width = image.width, reach = window / 2;
    nearest_.resize(image.height * width);
    farthest_.resize(image.height * width);
    near_.assign(width + 2 * reach, kInfinity);
    far_.assign(width + 2 * reach, -kInfinity);
    for (int64_t y = 0; y < image.height; ++y) {
      float *near = &near_[reach], *far = &far_[reach];
      std::fill_n(near, width, kInfinity);
      std::fill_n(far, width, -kInfinity);
      for (int64_t v = std::max<int64_t>(y - reach, 0); v <= std::min(y + reach, image.height - 1); ++v) {
        const float* row = image.row(v);
        for (int64_t x = 0; x < width; ++x) {
          near[x] = row[x] < near[x] ? row[x] : near[x];  // unknown is neither less nor more
          far[x] = row[x] > far[x] ? row[x] : far[x];
        }
      }
      float *nearest = &nearest_[y * width], *farthest = &farthest_[y * width];
      std::copy_n(near - reach, width, nearest);
      std::copy_n(far - reach, width, farthest);
      for (int64_t u = 1 - reach; u <= reach; ++u) {
        for (int64_t x = 0; x < width; ++x) {
          nearest[x] = std::min(nearest[x], near[x + u]);
          farthest[x] = std::max(farthest[x], far[x + u]);
        }
      }
    }
    for (int64_t i = 0; i < image.height * width; ++i)
      if (farthest_[i] - nearest_[i] > step) image.disparity[i] = kUnknown;
  }

 private:
  std::vector<float> near_, far_, nearest_, farthest_;
};

ffi::Error call(ffi::Buffer<ffi::S16> place, ffi::Buffer<ffi::U16> cost, ffi::Buffer<ffi::U16> second,
                ffi::Buffer<ffi::U16> lower, ffi::Buffer<ffi::U16> higher, ffi::Buffer<ffi::F32> uniqueness,
                ffi::Result<ffi::Buffer<ffi::F32>> disparity, int64_t disparities, int64_t first, float most_apart,
                float speckle_range, int64_t speckle_most, float edge_step, int64_t edge_window) {
  thread_local Blobs blobs;
  thread_local Edges edges;
  const Image image{place.dimensions()[0], place.dimensions()[1], disparity->typed_data()};
  const Checks checks{disparities, first, 1 - uniqueness.typed_data()[0], most_apart};
  for (int64_t y = 0; y < image.height; ++y) {
    const int64_t at = y * image.width;
    const Winners row{place.typed_data() + at, cost.typed_data() + at, second.typed_data() + at,
                      lower.typed_data() + at, higher.typed_data() + at};
    choose(row, checks, image.width, image.row(y));
  }
  if (speckle_most > 0) blobs.drop(image, speckle_range, speckle_most);
  if (edge_step > 0) edges.drop(image, edge_step, edge_window);
  return ffi::Error::Success();
}

}  // namespace

XLA_FFI_DEFINE_HANDLER_SYMBOL(jaxmap_select, call,
                              ffi::Ffi::Bind()
                                  .Arg<ffi::Buffer<ffi::S16>>()  // place
                                  .Arg<ffi::Buffer<ffi::U16>>()  // cost
                                  .Arg<ffi::Buffer<ffi::U16>>()  // second
                                  .Arg<ffi::Buffer<ffi::U16>>()  // lower
                                  .Arg<ffi::Buffer<ffi::U16>>()  // higher
                                  .Arg<ffi::Buffer<ffi::F32>>()  // uniqueness
                                  .Ret<ffi::Buffer<ffi::F32>>()
                                  .Attr<int64_t>("disparities")
                                  .Attr<int64_t>("first")
                                  .Attr<float>("most_apart")
                                  .Attr<float>("speckle_range")
                                  .Attr<int64_t>("speckle_most")
                                  .Attr<float>("edge_step")
                                  .Attr<int64_t>("edge_window"));
