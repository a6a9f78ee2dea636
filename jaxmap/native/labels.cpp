// Shares of the classes at all pixels, from the coarse logits of a network, for XLA on a CPU: upsampling, softmax, sums
// over classes that become one, and the odds that relief gives one of them, in one pass.
//
// XLA makes an image of each of these; here a thread makes a few rows, whose numbers stay in its cache and registers.
// `jaxmap/labellers/shares.py` says what is computed, in JAX.

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "threads.h"
#include "vectors.h"
#include "xla/ffi/api/ffi.h"

namespace ffi = xla::ffi;
using namespace jaxmap;

namespace {

constexpr int kMostClasses = 32;      // of a network; shares.py knows it, too
constexpr int64_t kBandRows = 32;     // made by a thread at a time
constexpr float kLeastShare = 1e-7f;  // shares.py knows it, too

// ---- Exponential and logarithm, after Moshier's Cephes, to the last two bits ----

typedef int32_t Integers __attribute__((vector_size(sizeof(Vector))));

inline Vector greater(Vector one, Vector other) { return one > other ? one : other; }
inline Vector smaller(Vector one, Vector other) { return one < other ? one : other; }

template <size_t kTerms>
inline Vector polynomial(const float (&terms)[kTerms], Vector x) {
  Vector sum = all(terms[0]);
  for (size_t term = 1; term < kTerms; ++term) sum = sum * x + all(terms[term]);
  return sum;
}

// Of numbers beyond what a float holds it is that of the nearest one within.
inline Vector exponential(Vector x) {
  constexpr float kTerms[] = {1.9875691500e-4f, 1.3981999507e-3f, 8.3334519073e-3f,
                              4.1665795894e-2f, 1.6666665459e-1f, 5.0000001201e-1f};
  x = smaller(greater(x, all(-87.f)), all(88.f));
  // Adding 1.5 * 2^23 rounds to a whole number, which is then in the lowest bits.
  const Vector magic = all(12582912.f), shifted = x * all(1.44269504f) + magic, whole = shifted - magic;
  const Vector rest = x - whole * all(0.693359375f) - whole * all(-2.12194440e-4f);
  const Vector power = polynomial(kTerms, rest) * rest * rest + rest + all(1.f);
  return (Vector)((Integers)power + ((Integers)shifted << 23));
}

// Of positive numbers.
inline Vector logarithm(Vector x) {
  constexpr float kTerms[] = {7.0376836292e-2f,  -1.1514610310e-1f, 1.1676998740e-1f,
                              -1.2420140846e-1f, 1.4249322787e-1f,  -1.6668057665e-1f,
                              2.0000714765e-1f,  -2.4999993993e-1f, 3.3333331174e-1f};
  const Integers bits = (Integers)x, exponent = (bits - 0x3f3504f3) >> 23;
  const Vector whole = __builtin_convertvector(exponent, Vector);
  const Vector rest = (Vector)(bits - (exponent << 23)) - all(1.f), square = rest * rest;
  const Vector sum = polynomial(kTerms, rest) * rest * square + whole * all(-2.12194440e-4f) - square * all(0.5f);
  return rest + sum + whole * all(0.693359375f);
}

// ---- What there is ----

// Where the pixels along an axis lie among coarse ones: each is a sum of `near` neighbours from `starts` on.
struct Axis {
  const int32_t* starts;
  const float* weights;  // near x pixels
  int64_t near, pixels;
};

struct Image {
  const float* logits;  // coarse, (height, width, classes)
  int64_t width, classes;
  Axis rows, columns;
  const uint8_t* wanted;
  const float* factors;  // of relief, (., factors_width), whose pixels are `stride` of the image's wide; or null
  int64_t factors_width, stride, favoured;
  float sharpness, gain;
  const int64_t* targets;  // for each class the share that it adds to, or -1
  std::vector<float*> shares;
};

// ---- Rows ----

// A coarse row at the columns of the image, class by class.
void widen(const Image& image, const float* logits, float* wide) {
  const Axis& columns = image.columns;
  for (int64_t c = 0; c < image.classes; ++c, wide += columns.pixels) {
    std::fill(wide, wide + columns.pixels, 0.f);
    for (int64_t k = 0; k < columns.near; ++k) {
      const float* weights = columns.weights + k * columns.pixels;
      for (int64_t x = 0; x < columns.pixels; ++x) {
        wide[x] += weights[x] * logits[(columns.starts[x] + k) * image.classes + c];
      }
    }
  }
}

// The odds of one share against each other are multiplied; their sum stays.
inline void multiply_odds(const Image& image, Vector* shares, Vector factor) {
  const int64_t count = image.shares.size();
  Vector total{}, sum{};
  for (int64_t s = 0; s < count; ++s) {
    total += shares[s];
    shares[s] = greater(shares[s], all(kLeastShare));
    if (image.gain != 1.f) shares[s] = exponential(all(image.gain) * logarithm(shares[s]));
    if (s == image.favoured) shares[s] *= factor;
    sum += shares[s];
  }
  const Vector scale = total / sum;
  for (int64_t s = 0; s < count; ++s) shares[s] *= scale;
}

// The shares of `some` pixels of a row, from the coarse rows near it, and the factors of that row.
inline void label_pixels(const Image& image, const float* wide, int64_t row, int64_t column, int64_t some,
                         const float* factors) {
  const int64_t width = image.columns.pixels, height = image.rows.pixels;
  Vector powers[kMostClasses], top = all(-INFINITY), sum{};
  for (int64_t c = 0; c < image.classes; ++c) {
    Vector logit{};
    for (int64_t k = 0; k < image.rows.near; ++k) {
      const float* from = wide + (k * image.classes + c) * width + column;
      logit += all(image.rows.weights[k * height + row]) * load_some(from, some);
    }
    powers[c] = logit;
    top = greater(top, logit);
  }
  for (int64_t c = 0; c < image.classes; ++c) {
    powers[c] = exponential((powers[c] - top) * all(image.sharpness));
    sum += powers[c];
  }
  const int64_t count = image.shares.size();
  Vector shares[kMostClasses] = {};
  const Vector scale = all(1.f) / sum;
  for (int64_t c = 0; c < image.classes; ++c) {
    if (image.targets[c] >= 0) shares[image.targets[c]] += powers[c] * scale;
  }
  if (factors) multiply_odds(image, shares, load_some(factors + column, some));
  for (int64_t s = 0; s < count; ++s) store_some(image.shares[s] + row * width + column, shares[s], some);
}

void label_rows(const Image& image, int64_t first, int64_t end) {
  thread_local Scratch<float> kept_wide, kept_factors;
  const Axis& rows = image.rows;
  const int64_t width = image.columns.pixels, wide_row = image.classes * width;
  const int64_t top = rows.starts[first], coarse_rows = rows.starts[end - 1] + rows.near - top;
  float* wide = kept_wide.of(coarse_rows * wide_row);
  float* factors = image.factors ? kept_factors.of(width) : nullptr;
  int64_t widened = 0, factors_row = -1;
  for (int64_t row = first; row < end; ++row) {
    const uint8_t* wanted = image.wanted + row * width;
    if (std::find(wanted, wanted + width, 1) == wanted + width) {
      for (float* share : image.shares) std::fill(share + row * width, share + (row + 1) * width, 0.f);
      continue;
    }
    const int64_t start = rows.starts[row] - top;
    for (; widened < start + rows.near; ++widened) {
      widen(image, image.logits + (top + widened) * image.width * image.classes, wide + widened * wide_row);
    }
    if (factors && row / image.stride != factors_row) {
      factors_row = row / image.stride;
      const float* from = image.factors + factors_row * image.factors_width;
      for (int64_t x = 0; x < width; ++x) factors[x] = from[x / image.stride];
    }
    for (int64_t x = 0; x < width; x += kLanes) {
      label_pixels(image, wide + start * wide_row, row, x, std::min<int64_t>(kLanes, width - x), factors);
    }
  }
}

// ---- What XLA calls ----

using Numbers = ffi::Buffer<ffi::F32>;
using Places = ffi::Buffer<ffi::S32>;

Axis axis_of(const Places& starts, const Numbers& weights) {
  return {starts.typed_data(), weights.typed_data(), weights.dimensions()[0], weights.dimensions()[1]};
}

ffi::Error call(ffi::ThreadPool pool, Numbers logits, Places row_starts, Numbers row_weights, Places column_starts,
                Numbers column_weights, ffi::Buffer<ffi::PRED> wanted, Numbers factors, Numbers scales,
                ffi::RemainingRets results, ffi::Span<const int64_t> targets, int64_t stride, int64_t favoured) {
  const auto size = logits.dimensions();
  Image image{logits.typed_data(), size[1], size[2], axis_of(row_starts, row_weights),
              axis_of(column_starts, column_weights), reinterpret_cast<const uint8_t*>(wanted.typed_data()),
              factors.element_count() ? factors.typed_data() : nullptr, factors.dimensions()[1], stride, favoured,
              scales.typed_data()[0], scales.typed_data()[1], targets.begin(), {}};
  const int64_t rows = image.rows.pixels, pixels = rows * image.columns.pixels;
  if (size[2] > kMostClasses || int64_t(results.size()) > kMostClasses || int64_t(targets.size()) != size[2] ||
      int64_t(wanted.element_count()) != pixels) {
    return ffi::Error::InvalidArgument("labels: arrays that do not fit together");
  }
  for (size_t index = 0; index < results.size(); ++index) {
    auto share = results.get<Numbers>(index);
    if (!share.has_value()) return share.error();
    image.shares.push_back((*share)->typed_data());
  }
  in_parallel(pool, (rows + kBandRows - 1) / kBandRows, [&](int64_t band) {
    label_rows(image, band * kBandRows, std::min(rows, (band + 1) * kBandRows));
  });
  return ffi::Error::Success();
}

}  // namespace

XLA_FFI_DEFINE_HANDLER_SYMBOL(jaxmap_labels, call,
                              ffi::Ffi::Bind()
                                  .Ctx<ffi::ThreadPool>()
                                  .Arg<Numbers>()  // logits (h, w, C)
                                  .Arg<Places>()   // rows: where their neighbours start (H,), and weights (K, H)
                                  .Arg<Numbers>()
                                  .Arg<Places>()  // columns: likewise, (W,) and (K, W)
                                  .Arg<Numbers>()
                                  .Arg<ffi::Buffer<ffi::PRED>>()  // wanted (H, W)
                                  .Arg<Numbers>()                 // factors (h2, w2), empty for none
                                  .Arg<Numbers>()                 // sharpness and gain
                                  .RemainingRets()                // shares (H * W,)
                                  .Attr<ffi::Span<const int64_t>>("targets")
                                  .Attr<int64_t>("stride")
                                  .Attr<int64_t>("favoured"));
