// Blocks of convolutions for XLA on a CPU: a 1x1 expansion, a depthwise convolution, a 1x1 projection, in one pass.
//
// Run one after the other, the layers of a mobile network spend their time on memory: an expanded image is several
// times the size of what enters and leaves a block. Here a thread makes a few rows of it at a time, which stay in its
// cache, slides the depthwise kernel over them, and projects. Images are NHWC, float32; sums are in an order that does
// not depend on the number of threads. `jaxmap/models/fused.py` says what is computed, in JAX.

#include <algorithm>
#include <cstdint>
#include <cstring>
#include <functional>

#include "threads.h"
#include "vectors.h"
#include "xla/ffi/api/ffi.h"

namespace ffi = xla::ffi;
using namespace jaxmap;

namespace {

// Vectors of outputs whose sums registers hold beside those of several pixels, and how many pixels go with them.
constexpr int kWidest = kRegisters / 8;
constexpr int pixels_beside(int vectors) { return vectors == 4 || kWidest == 2 ? 6 : 8; }

inline int64_t vectors_of(int64_t channels) { return (channels + kLanes - 1) / kLanes; }

// An activation: values are cut off below and above; NaN stays.
struct Range {
  float low, high;
  Vector operator()(Vector value) const {
    const Vector lowest = all(low), highest = all(high);
    value = value < lowest ? lowest : value;
    return value > highest ? highest : value;
  }
};

// ---- Products of pixels with a matrix ----

// A 1x1 convolution. Its matrix is packed into panels of up to `kWidest` vectors of outputs, each panel input by input.
struct Pointwise {
  const float* kernel;  // inputs x outputs
  const float* bias;
  int64_t inputs, outputs;
  Range range;
  const float* packed = nullptr;

  int64_t vectors() const { return vectors_of(outputs); }
  int64_t packed_size() const { return inputs * vectors() * kLanes; }
  // Panels as equal as may be; of three vectors where that leaves none over, as then eight pixels go with them.
  int64_t panels() const {
    const int64_t widest = kWidest == 4 && vectors() % 3 == 0 ? 3 : kWidest;
    return (vectors() + widest - 1) / widest;
  }
  int64_t first_vector(int64_t panel) const { return vectors() * panel / panels(); }

  // Packs some inputs: row by row, as the kernel lies in memory.
  void pack(int64_t begin, int64_t end, float* packed) const {
    for (int64_t input = begin; input < end; ++input) {
      for (int64_t panel = 0; panel < panels(); ++panel) {
        const int64_t first = first_vector(panel) * kLanes, width = first_vector(panel + 1) * kLanes - first;
        const int64_t inside = std::min(width, outputs - first);
        float* to = packed + first * inputs + input * width;
        std::memcpy(to, kernel + input * outputs + first, inside * sizeof(float));
        std::fill(to + inside, to + width, 0.f);
      }
    }
  }
};

// Inputs summed in one go at most: their part of a panel stays near the innermost cache.
constexpr int64_t kDepth = 192;

struct Tile {
  const float* pixels;
  int64_t pixel_stride;
  const float* panel;
  int64_t depth;
  const float* bias;  // in the first go
  float* result;
  int64_t result_stride, channels;  // channels: of the panel, which may end within a vector
  const float* shortcut;            // added in the last go, where there is one; strides as those of the result
  const Range* range;               // in the last go
};

// What becomes of the sums of a tile, pixel by pixel.
__attribute__((noinline)) void finish_tile(const Tile& tile, const Vector* sums, int pixels, int vectors) {
  for (int pixel = 0; pixel < pixels; ++pixel) {
    float* result = tile.result + pixel * tile.result_stride;
    for (int vector = 0; vector < vectors; ++vector, ++sums) {
      const int64_t place = vector * kLanes, left = tile.channels - place;
      Vector value = *sums + load_some((tile.bias ? tile.bias : result) + place, left);
      if (tile.range) value = (*tile.range)(value);
      if (tile.shortcut) value += load_some(tile.shortcut + pixel * tile.result_stride + place, left);
      store_some(result + place, value, left);
    }
  }
}

template <int kPixels, int kVectors>
void multiply_tile(const Tile& tile) {
  // In registers, as all loops over them are unrolled.
  Vector sums[kPixels][kVectors] = {};
  const float *panel = tile.panel, *pixels = tile.pixels;
  const int64_t stride = tile.pixel_stride;
  for (int64_t input = 0; input < tile.depth; ++input, panel += kVectors * kLanes) {
    Vector weights[kVectors];
#pragma GCC unroll 8
    for (int vector = 0; vector < kVectors; ++vector) weights[vector] = load(panel + vector * kLanes);
#pragma GCC unroll 8
    for (int pixel = 0; pixel < kPixels; ++pixel) {
      const Vector value = all(pixels[pixel * stride + input]);
#pragma GCC unroll 8
      for (int vector = 0; vector < kVectors; ++vector) sums[pixel][vector] += value * weights[vector];
    }
  }
  Vector kept[kPixels * kVectors];
#pragma GCC unroll 8
  for (int pixel = 0; pixel < kPixels; ++pixel) {
#pragma GCC unroll 8
    for (int vector = 0; vector < kVectors; ++vector) kept[pixel * kVectors + vector] = sums[pixel][vector];
  }
  finish_tile(tile, kept, kPixels, kVectors);
}

template <int kPixels, int kVectors>
void multiply_few(const Tile& tile, int64_t count) {
  if constexpr (kPixels > 0) {
    count == kPixels ? multiply_tile<kPixels, kVectors>(tile) : multiply_few<kPixels - 1, kVectors>(tile, count);
  }
}

template <int kVectors>
void multiply_panel(Tile tile, int64_t count) {
  constexpr int kPixels = pixels_beside(kVectors);
  for (; count > 0; count -= kPixels) {
    multiply_few<kPixels, kVectors>(tile, std::min<int64_t>(count, kPixels));
    tile.pixels += kPixels * tile.pixel_stride;
    tile.result += kPixels * tile.result_stride;
    if (tile.shortcut) tile.shortcut += kPixels * tile.result_stride;
  }
}

// `result = range(pixels @ kernel + bias) + shortcut` for pixels in a row.
void multiply(const Pointwise& layer, const float* pixels, int64_t count, float* result, int64_t result_stride,
              const float* shortcut) {
  const int64_t parts = (layer.inputs + kDepth - 1) / kDepth;
  for (int64_t part = 0; part < parts; ++part) {
    const int64_t first = layer.inputs * part / parts, depth = layer.inputs * (part + 1) / parts - first;
    const bool last = part == parts - 1;
    for (int64_t panel = 0; panel < layer.panels(); ++panel) {
      const int64_t begin = layer.first_vector(panel), vectors = layer.first_vector(panel + 1) - begin;
      const int64_t channel = begin * kLanes;
      const Tile tile{pixels + first,
                      layer.inputs,
                      layer.packed + channel * layer.inputs + first * vectors * kLanes,
                      depth,
                      first == 0 ? layer.bias + channel : nullptr,
                      result + channel,
                      result_stride,
                      layer.outputs - channel,
                      last && shortcut ? shortcut + channel : nullptr,
                      last ? &layer.range : nullptr};
      switch (vectors) {
        case 1: multiply_panel<1>(tile, count); break;
        case 2: multiply_panel<2>(tile, count); break;
        case 3: multiply_panel<3>(tile, count); break;
        default: multiply_panel<4>(tile, count);
      }
    }
  }
}

// ---- Windows of an image ----

constexpr int64_t kLargestWindow = 16;

struct Window {
  int64_t size, stride, dilation, before_rows, before_columns;
};

// Rows of one image as they are needed; null beyond it.
using Rows = std::function<const float*(int64_t)>;

struct Depthwise {
  const float* kernel;  // size x size x channels
  const float* bias;
  int64_t channels;
  Range range;
};

// An element of the kernel, and the pixel that it meets; both are the first of their channels.
struct Tap {
  const float *weights, *pixel;
};

// Neighbouring outputs of a vector of channels, from the elements that meet the image at all of them.
template <int kOutputs, bool kWhole>
inline void sum_taps(const Depthwise& layer, const Tap* taps, int count, int64_t step, int64_t channel, float* result) {
  const int64_t some = kWhole ? kLanes : layer.channels - channel;
  Vector sums[kOutputs];
  const Vector bias = load_some(layer.bias + channel, some);
  for (int output = 0; output < kOutputs; ++output) sums[output] = bias;
  for (int tap = 0; tap < count; ++tap) {
    const Vector weight = load_some(taps[tap].weights + channel, some);
    const float* pixel = taps[tap].pixel + channel;
    for (int output = 0; output < kOutputs; ++output, pixel += step) sums[output] += weight * load_some(pixel, some);
  }
  for (int output = 0; output < kOutputs; ++output) {
    store_some(result + output * layer.channels + channel, layer.range(sums[output]), some);
  }
}

template <int kOutputs>
void sum_channels(const Depthwise& layer, const Tap* taps, int count, int64_t step, int64_t first, int64_t end,
                  float* result) {
  int64_t channel = first;
  for (; channel + kLanes <= end; channel += kLanes) sum_taps<kOutputs, true>(layer, taps, count, step, channel, result);
  if (channel < end) sum_taps<kOutputs, false>(layer, taps, count, step, channel, result);
}

// One row of the result.
void slide_row(const Depthwise& layer, const Window& window, const float* const* rows, int64_t width, int64_t outputs,
               float* result) {
  constexpr int64_t kNeighbours = 8, kChannels = 8 * kLanes;
  const int64_t channels = layer.channels;
  Tap taps[kLargestWindow * kLargestWindow];
  const auto taps_at = [&](int64_t place) {
    int count = 0;
    for (int64_t row = 0; row < window.size; ++row) {
      for (int64_t column = 0; column < window.size; ++column) {
        const int64_t pixel = place * window.stride - window.before_columns + column * window.dilation;
        if (!rows[row] || pixel < 0 || pixel >= width) continue;
        taps[count++] = {layer.kernel + (row * window.size + column) * channels, rows[row] + pixel * channels};
      }
    }
    return count;
  };
  // Outputs from `begin` to `end` see nothing but pixels of the image, several of them the same elements.
  const int64_t reach = width - 1 + window.before_columns - (window.size - 1) * window.dilation;
  const int64_t begin = std::min(outputs, (window.before_columns + window.stride - 1) / window.stride);
  int64_t end = reach < 0 ? begin : std::max(begin, std::min(outputs, reach / window.stride + 1));
  end -= (end - begin) % kNeighbours;
  for (int64_t place = 0; place < outputs; ++place) {
    if (place >= begin && place < end) continue;
    sum_channels<1>(layer, taps, taps_at(place), 0, 0, channels, result + place * channels);
  }
  // A few channels at a time, whose weights stay in the innermost cache.
  for (int64_t first = 0; first < channels; first += kChannels) {
    for (int64_t place = begin; place < end; place += kNeighbours) {
      sum_channels<kNeighbours>(layer, taps, taps_at(place), window.stride * channels, first,
                                std::min(first + kChannels, channels), result + place * channels);
    }
  }
}

// The pixels in each window of one row of the result, one window after the other: a dense convolution is their product
// with its kernel.
void gather_row(const Window& window, const float* const* rows, int64_t width, int64_t outputs, int64_t channels,
                float* result) {
  for (int64_t place = 0; place < outputs; ++place) {
    const int64_t begin = place * window.stride - window.before_columns;
    for (int64_t row = 0; row < window.size; ++row) {
      for (int64_t column = 0; column < window.size; ++column, result += channels) {
        const int64_t pixel = begin + column * window.dilation;
        if (rows[row] && pixel >= 0 && pixel < width) {
          std::memcpy(result, rows[row] + pixel * channels, channels * sizeof(float));
        } else {
          std::fill(result, result + channels, 0.f);
        }
      }
    }
  }
}

// ---- Blocks ----

struct Sizes {
  int64_t batch, height, width, channels;
};

struct Block {
  Sizes images, results;
  Window window;
  Pointwise expand, project;  // `expand` and `depthwise` have no kernel where there is none
  Depthwise depthwise;
  bool shortcut;
};

// Pixels that are projected together.
constexpr int64_t kTogether = 96;

// Rows `first` to `end` of the result of one image.
void rows_of_block(const Block& block, const float* image, float* result, int64_t first, int64_t end) {
  thread_local Scratch<float> kept_hidden, kept_windows;
  const Sizes &size = block.images, &out = block.results;
  const Window& window = block.window;
  const int64_t row_floats = size.width * (block.expand.kernel ? block.expand.outputs : size.channels);
  // The expanded rows that windows see lie in a ring; `made` is the next one to be made.
  const int64_t ring = (window.size - 1) * window.dilation + 1;
  float* hidden = block.expand.kernel ? kept_hidden.of(ring * row_floats) : nullptr;
  int64_t made = std::max<int64_t>(0, first * window.stride - window.before_rows);
  auto row_at = [&](int64_t row) -> const float* {
    if (row < 0 || row >= size.height) return nullptr;
    if (!hidden) return image + row * row_floats;
    for (; made <= row; ++made) {
      multiply(block.expand, image + made * size.width * size.channels, size.width, hidden + made % ring * row_floats,
               block.expand.outputs, nullptr);
    }
    return hidden + row % ring * row_floats;
  };
  const int64_t group = (kTogether + out.width - 1) / out.width, row_inputs = out.width * block.project.inputs;
  float* windows = kept_windows.of(group * row_inputs);
  const float* rows[kLargestWindow];
  for (int64_t begin = first; begin < end; begin += group) {
    const int64_t count = std::min(group, end - begin);
    for (int64_t row = begin; row < begin + count; ++row) {
      for (int64_t index = 0; index < window.size; ++index) {
        rows[index] = row_at(row * window.stride - window.before_rows + index * window.dilation);
      }
      float* to = windows + (row - begin) * row_inputs;
      if (block.depthwise.kernel) {
        slide_row(block.depthwise, window, rows, size.width, out.width, to);
      } else {
        gather_row(window, rows, size.width, out.width, size.channels, to);
      }
    }
    const int64_t place = begin * out.width * out.channels;
    multiply(block.project, windows, count * out.width, result + place, out.channels,
             block.shortcut ? image + place : nullptr);
  }
}

void run(ffi::ThreadPool& pool, Block block, const float* images, float* results) {
  thread_local Scratch<float> kept;
  Pointwise &expand = block.expand, &project = block.project;
  const int64_t expand_size = expand.kernel ? expand.packed_size() : 0;
  float* packed = kept.of(expand_size + project.packed_size());
  expand.packed = packed;
  project.packed = packed + expand_size;
  for (const Pointwise* layer : {&expand, &project}) {
    if (!layer->kernel) continue;
    constexpr int64_t kInputs = 32;
    in_parallel(pool, (layer->inputs + kInputs - 1) / kInputs, [&](int64_t index) {
      const int64_t first = index * kInputs;
      layer->pack(first, std::min(first + kInputs, layer->inputs), const_cast<float*>(layer->packed));
    });
  }
  const Sizes &size = block.images, &out = block.results;
  const int64_t threads = std::max<int64_t>(1, pool.num_threads());
  if (block.window.size == 1 && block.window.stride == 1 && !block.depthwise.kernel) {
    const int64_t pixels = out.batch * out.height * out.width, together = kTogether;
    in_parallel(pool, (pixels + together - 1) / together, [&](int64_t index) {
      const int64_t first = index * together, count = std::min(together, pixels - first);
      const float* shortcut = block.shortcut ? images + first * size.channels : nullptr;
      multiply(project, images + first * size.channels, count, results + first * out.channels, out.channels, shortcut);
    });
    return;
  }
  // Neighbouring parts both make the expanded rows between them, so that parts are not too thin.
  const int64_t least = expand.kernel ? 4 * (block.window.size - 1) * block.window.dilation : 4;
  const int64_t most = (out.height + threads - 1) / threads, parts_of = std::min(most, std::max<int64_t>(1, least));
  const int64_t parts = (out.height + parts_of - 1) / parts_of;
  in_parallel(pool, out.batch * parts, [&](int64_t index) {
    const int64_t image = index / parts, first = index % parts * parts_of;
    rows_of_block(block, images + image * size.height * size.width * size.channels,
                  results + image * out.height * out.width * out.channels, first,
                  std::min(first + parts_of, out.height));
  });
}

// ---- What XLA calls ----

using Numbers = ffi::Buffer<ffi::F32>;

const float* data_or_null(const Numbers& array) { return array.element_count() ? array.typed_data() : nullptr; }

Sizes sizes_of(ffi::Span<const int64_t> dimensions) {
  return {dimensions[0], dimensions[1], dimensions[2], dimensions[3]};
}

ffi::Error call(ffi::ThreadPool pool, Numbers images, Numbers expand, Numbers expand_bias, Numbers depthwise,
                Numbers depthwise_bias, Numbers project, Numbers project_bias, ffi::ResultBuffer<ffi::F32> results,
                ffi::Span<const int64_t> window, ffi::Span<const float> ranges, bool shortcut) {
  const Sizes size = sizes_of(images.dimensions()), out = sizes_of(results->dimensions());
  const bool expands = expand.element_count(), slides = depthwise.element_count();
  const int64_t hidden = expands ? static_cast<int64_t>(expand_bias.element_count()) : size.channels;
  const int64_t inputs = slides ? hidden : window[0] * window[0] * hidden;
  const int64_t counts[][2] = {
      {expands ? size.channels * hidden : 0, static_cast<int64_t>(expand.element_count())},
      {slides ? window[0] * window[0] * hidden : 0, static_cast<int64_t>(depthwise.element_count())},
      {slides ? hidden : 0, static_cast<int64_t>(depthwise_bias.element_count())},
      {inputs * out.channels, static_cast<int64_t>(project.element_count())},
      {out.channels, static_cast<int64_t>(project_bias.element_count())},
      {shortcut ? size.height * size.width * size.channels : 0, shortcut ? out.height * out.width * out.channels : 0},
      {size.batch, out.batch},
  };
  for (const auto& [wanted, given] : counts) {
    if (wanted != given) return ffi::Error::InvalidArgument("a block of convolutions whose arrays do not fit together");
  }
  if (window[0] > kLargestWindow || (expands && !slides)) {
    return ffi::Error::InvalidArgument("a block of convolutions that the kernel does not know");
  }
  const auto range = [&](int layer) { return Range{ranges[2 * layer], ranges[2 * layer + 1]}; };
  const Block block{size,
                    out,
                    {window[0], window[1], window[2], window[3], window[4]},
                    {data_or_null(expand), expand_bias.typed_data(), size.channels, hidden, range(0)},
                    {project.typed_data(), project_bias.typed_data(), inputs, out.channels, range(2)},
                    {data_or_null(depthwise), depthwise_bias.typed_data(), hidden, range(1)},
                    shortcut};
  run(pool, block, images.typed_data(), results->typed_data());
  return ffi::Error::Success();
}

}  // namespace

XLA_FFI_DEFINE_HANDLER_SYMBOL(jaxmap_block, call,
                              ffi::Ffi::Bind()
                                  .Ctx<ffi::ThreadPool>()
                                  .Arg<Numbers>()  // images (B, H, W, I)
                                  .Arg<Numbers>()  // expansion: kernel (I, C) and bias (C,), both empty for none
                                  .Arg<Numbers>()
                                  .Arg<Numbers>()  // depthwise: kernel (K, K, C) and bias (C,), both empty for none
                                  .Arg<Numbers>()
                                  .Arg<Numbers>()  // projection: kernel (C, O), or (K, K, I, O) of a dense window
                                  .Arg<Numbers>()
                                  .Ret<Numbers>()  // (B, h, w, O)
                                  .Attr<ffi::Span<const int64_t>>("window")  // fields of `Window`
                                  .Attr<ffi::Span<const float>>("ranges")    // least and greatest of the three layers
                                  .Attr<bool>("shortcut"));
