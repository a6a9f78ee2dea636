// From pixels to sums over the points in each voxel, a tile of pixels at a time. Points never lie in memory.
//
// Neighbours in a row that fall into one voxel are a run. Each run is added, lane by lane, to the sums of its voxel in
// the tile; the lanes are added up when the tile is done. What a voxel gets thus hangs neither on the window nor on the
// number of threads.

#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <limits>
#include <memory>
#include <utility>

#include "fuse_frame.h"
#include "vectors.h"

namespace jaxmap {

constexpr int kTileRows = 8, kTileColumns = 256, kTilePixels = kTileRows * kTileColumns;
constexpr int kStride = kTileColumns + 8;  // from row to row of values: reading past the end of one ends in the next
constexpr int kReachBlock = kTileRows;  // pixels to the edge of a block of `block_reach`; columns divide into them
constexpr int32_t kNowhere = std::numeric_limits<int32_t>::min();  // the voxel of a point that does not count

// As `geometry.camera.disparity_to_depth` decides it; false of NaN.
inline bool has_depth(float shifted) { return (shifted > 1e-6f) & (shifted < INFINITY); }

// Pixels that have a depth, that lie between the depths which are mapped, and whose points count.
struct PixelCounts {
  int32_t valid = 0, in_range = 0, kept = 0;
};

// The points of neighbouring pixels in a row.
struct Strip {
  float depths[kTileColumns], heights[kTileColumns];  // metres; heights above the middle of the voxel
  float falls[kTileColumns];                          // below the camera, metres
  int32_t voxels[kTileColumns];                       // of the window, or kNowhere
  uint8_t starts[kTileColumns + sizeof(uint64_t)];    // where a run starts
};

// Sums over points are kept in eight lanes: points are added in one order on all processors.
constexpr int kLaneCount = 8;
typedef float Lanes __attribute__((vector_size(kLaneCount * sizeof(float))));
typedef int32_t LaneMask __attribute__((vector_size(kLaneCount * sizeof(int32_t))));

// Adds the values of points to sums: the same points of each row of values to a row of lanes.
inline void add_to_rows(const float* values, int begin, int end, int rows, Lanes* sums) {
  for (; begin < end; begin += kLaneCount) {
    const LaneMask inside = LaneMask{0, 1, 2, 3, 4, 5, 6, 7} < end - begin;
    for (int row = 0; row < rows; ++row) {
      LaneMask bits;
      std::memcpy(&bits, values + row * kStride + begin, sizeof bits);
      sums[row] += Lanes(bits & inside);
    }
  }
}

inline float sum_of(const Lanes* lanes) {
  const float* lane = reinterpret_cast<const float*>(lanes);
  return ((lane[0] + lane[4]) + (lane[2] + lane[6])) + ((lane[1] + lane[5]) + (lane[3] + lane[7]));
}

// Projects the pixels, and finds the voxels that their points lie in (`geometry.cloud.project`, `flat_voxel_index`).
// Returns whether any point counts in the window.
inline bool locate(const Frame& frame, const float* across, int64_t row, int64_t column, int count, Strip& strip) {
  const Numbers n = frame.numbers;
  const float *R = n.world_of_camera.rotation, *t = n.world_of_camera.translation;
  const float* disparity = frame.disparity + row * frame.width + column;
  const uint8_t* keep = frame.keep + row * frame.width + column;
  across += column;
  const float down = (float(row) - n.cy) * (1.0f / n.fy);
  // XLA divides by a number that all share in this way.
  const float by_x = 1.0f / n.size[0], by_y = 1.0f / n.size[1], by_z = 1.0f / n.size[2];
  const float shape_x = frame.shape[0], shape_y = frame.shape[1], shape_z = frame.shape[2];
  const float first_x = frame.first[0], first_y = frame.first[1], first_z = frame.first[2];
  const int32_t stride_y = frame.shape[2], stride_x = stride_y * frame.shape[1];
  int32_t any = 0;
  for (int i = 0; i < count; ++i) {
    const float shifted = disparity[i] + n.doffs;
    const bool valid = has_depth(shifted);
    const float ratio = n.depth_px / (valid ? shifted : 1.0f), depth = valid ? ratio : 1.0f;
    const float x_camera = across[i] * depth, y_camera = down * depth;
    const float x_world = R[0] * x_camera + R[1] * y_camera + R[2] * depth + t[0];
    const float y_world = R[3] * x_camera + R[4] * y_camera + R[5] * depth + t[1];
    const float z_world = R[6] * x_camera + R[7] * y_camera + R[8] * depth + t[2];
    // Found on the lattice and then moved: the same voxel in any window.
    const float level = std::floor((z_world - n.lattice[2]) * by_z);
    const float x = std::floor((x_world - n.lattice[0]) * by_x) - first_x;
    const float y = std::floor((y_world - n.lattice[1]) * by_y) - first_y, z = level - first_z;
    // Of a number that is not finite a comparison is false.
    const bool inside = (x >= 0) & (x < shape_x) & (y >= 0) & (y < shape_y) & (z >= 0) & (z < shape_z) &
                        (keep[i] != 0) & valid;
    const int32_t voxel = int32_t(inside ? x : 0.0f) * stride_x + int32_t(inside ? y : 0.0f) * stride_y +
                          int32_t(inside ? z : 0.0f);
    strip.voxels[i] = inside ? voxel : kNowhere;
    any |= inside ? 1 : 0;
    strip.depths[i] = depth;
    strip.heights[i] = z_world - (n.lattice[2] + (level + 0.5f) * n.size[2]);
    strip.falls[i] = std::fabs(z_world - t[2]);
  }
  return any != 0;
}

// Loops of their own, here and below: compilers vectorise each, but not all of them together.
inline void count_pixels(const Frame& frame, int64_t pixel, int count, const float* depths, PixelCounts& counts) {
  const Numbers n = frame.numbers;
  const float* disparity = frame.disparity + pixel;
  const uint8_t* keep = frame.keep + pixel;
  int32_t valid = 0, in_range = 0, kept = 0;
  for (int i = 0; i < count; ++i) {
    const int32_t known = has_depth(disparity[i] + n.doffs) ? 1 : 0;
    valid += known;
    in_range += (depths[i] >= n.nearest) & (depths[i] <= n.farthest) ? known : 0;
    kept += keep[i] != 0 ? known : 0;
  }
  counts.valid += valid, counts.in_range += in_range, counts.kept += kept;
}

// Up to where the camera saw through each pixel, and the farthest of those seen so far in each column.
inline void look_through(const Frame& frame, int64_t pixel, int count, const float* depths, float* reach,
                         float* farthest) {
  const Numbers n = frame.numbers;
  const float* disparity = frame.disparity + pixel;
  for (int i = 0; i < count; ++i) {
    const float depth = depths[i], before = depth - (n.margin + depth * depth * n.sigmas);
    const float seen = has_depth(disparity[i] + n.doffs) ? before : 0.0f;
    reach[i] = seen;
    farthest[i] = std::max(farthest[i], seen);
  }
}

// How much each point counts (`fusion.sensor_model.point_weights`), by class where it has a share of each.
inline void weigh(const Frame& frame, int64_t pixel, int count, const float* depths, float* __restrict values) {
  const Numbers n = frame.numbers;
  float weights[kTileColumns], known[kTileColumns];
  for (int i = 0; i < count; ++i) {
    const float ratio = depths[i] * depths[i] * n.sigma * n.by_edge;
    weights[i] = 1.0f / (1.0f + ratio * ratio);
    known[i] = 0.0f;
  }
  if (frame.labels != nullptr) {
    std::copy(weights, weights + count, values);
    return;
  }
  for (const float* shares : frame.shares)
    for (int i = 0; i < count; ++i) known[i] += shares[pixel + i];
  // Where a share is not finite, neither is their sum.
  for (int i = 0; i < count; ++i) weights[i] = std::fabs(known[i]) < INFINITY ? weights[i] : 0.0f;
  for (const float* shares : frame.shares) {
    for (int i = 0; i < count; ++i) values[i] = weights[i] != 0 ? shares[pixel + i] * weights[i] : 0.0f;
    values += kStride;
  }
  for (int i = 0; i < count; ++i) values[i] = weights[i] != 0 ? (1.0f - known[i]) * weights[i] : 0.0f;
}

// How much the height of each point counts (`fusion.surface.height_sigma`): its number, weight and two moments.
inline void weigh_heights(const Frame& frame, const Strip& strip, int count, float* __restrict values) {
  const Numbers n = frame.numbers;
  for (int i = 0; i < count; ++i) {
    const float depth = strip.depths[i], sigma = strip.falls[i] * depth * n.sigma;
    const float weight = sigma < INFINITY ? 1.0f / (sigma * sigma + n.height_variance) : 0.0f;
    const float first = weight * strip.heights[i];
    values[i] = weight > 0 ? 1.0f : 0.0f;
    values[kStride + i] = weight;
    values[2 * kStride + i] = weight > 0 ? first : 0.0f;
    values[3 * kStride + i] = weight > 0 ? first * strip.heights[i] : 0.0f;
  }
}

// Marks where runs start, and past the end, so that one is always found. Points of a run have one label, if any.
inline void find_runs(const int32_t* __restrict voxels, const int32_t* __restrict labels, int count,
                      uint8_t* __restrict starts) {
  starts[0] = 1;
  for (int i = 1; i < count; ++i) starts[i] = voxels[i] != voxels[i - 1];
  if (labels != nullptr)
    for (int i = 1; i < count; ++i) starts[i] |= labels[i] != labels[i - 1];
  starts[count] = 1;
}

inline int next_run(const uint8_t* starts, int from) {
  for (uint64_t eight;; from += sizeof eight) {
    std::memcpy(&eight, starts + from, sizeof eight);
    if (eight != 0) return from + __builtin_ctzll(eight) / 8;
  }
}

// The voxels that a tile of pixels sees, in the order in which it meets them, and the sums of each: rows of lanes.
class TileSums {
 public:
  Lanes* sums_of(int32_t voxel, int rows) {
    uint32_t slot = uint32_t(voxel) * 2654435761u >> (32 - kSlotBits);
    for (; slots_[slot] != 0; slot = (slot + 1) % kSlots)
      if (voxels_[slots_[slot] - 1] == voxel) return lanes_.get() + (slots_[slot] - 1) * rows;
    Lanes* sums = lanes_.of(int64_t(kTilePixels) * rows) + count_ * rows;
    std::fill(sums, sums + rows, Lanes{});
    voxels_[count_] = voxel, taken_[count_] = uint16_t(slot);
    slots_[slot] = uint16_t(++count_);
    return sums;
  }

  // Writes down the voxels and their sums, forgets them, and returns how many there were.
  int32_t move_to(int32_t* voxels, float* sums, int rows) {
    std::copy(voxels_, voxels_ + count_, voxels);
    for (int row = 0; row < count_ * rows; ++row) sums[row] = sum_of(lanes_.get() + row);
    for (int k = 0; k < count_; ++k) slots_[taken_[k]] = 0;
    return std::exchange(count_, 0);
  }

 private:
  // Twice as many slots as a tile can see voxels.
  static constexpr int kSlotBits = 12;
  static constexpr uint32_t kSlots = 1u << kSlotBits;
  static_assert(kSlots >= 2 * kTilePixels);
  int count_ = 0;
  int32_t voxels_[kTilePixels];
  uint16_t slots_[kSlots] = {}, taken_[kTilePixels];
  Scratch<Lanes> lanes_;
};

// Adds the runs of a strip, whose first pixel is `pixel`, to the sums of their voxels.
inline void add_runs(const Frame& frame, int64_t pixel, int count, const Strip& strip, const float* values,
                     TileSums& sums) {
  const int rows = frame.rows();
  for (int begin = 0, end; begin < count; begin = end) {
    end = next_run(strip.starts, begin + 1);
    if (strip.voxels[begin] == kNowhere) continue;
    Lanes* row = sums.sums_of(strip.voxels[begin], rows);
    const float* value = values;
    if (frame.labels != nullptr) {
      const uint32_t label = frame.labels[pixel + begin], last = frame.classes;
      add_to_rows(value, begin, end, 1, row + std::min(label, last));
      row += frame.class_rows(), value += kStride;
    }
    add_to_rows(value, begin, end, frame.value_rows() - (value != values), row);
  }
}

// What a thread keeps from tile to tile.
struct TileMemory {
  Strip strip;
  TileSums sums;
  Scratch<float> values;

  // To be asked for once a tile: a library looks up what is a thread's own by a call.
  static TileMemory& own() {
    thread_local const auto memory = std::make_unique<TileMemory>();
    return *memory;
  }
};

// Sums up the points of a tile by voxels; returns how many there are.
inline PixelCounts sum_tile(const Frame& frame, int64_t tile, Workspace& work) {
  auto& [strip, sums, kept] = TileMemory::own();
  float *values = kept.of((frame.value_rows() + 1) * kStride), farthest[kTileColumns] = {};
  PixelCounts counts;
  const int64_t tiles_across = (frame.width + kTileColumns - 1) / kTileColumns;
  const int64_t column = tile % tiles_across * kTileColumns, top = tile / tiles_across * kTileRows;
  const int count = int(std::min<int64_t>(kTileColumns, frame.width - column));
  for (int64_t row = top; row < std::min(frame.height, top + kTileRows); ++row) {
    const int64_t pixel = row * frame.width + column;
    const bool any = locate(frame, work.across.get(), row, column, count, strip);
    count_pixels(frame, pixel, count, strip.depths, counts);
    if (frame.carve) look_through(frame, pixel, count, strip.depths, work.reach.get() + pixel, farthest);
    if (!any) continue;
    find_runs(strip.voxels, frame.labels != nullptr ? frame.labels + pixel : nullptr, count, strip.starts);
    weigh(frame, pixel, count, strip.depths, values);
    if (frame.surface != nullptr) weigh_heights(frame, strip, count, values + frame.weight_rows() * kStride);
    add_runs(frame, pixel, count, strip, values, sums);
  }
  if (frame.carve) {
    const int64_t blocks_across = (frame.width + kReachBlock - 1) / kReachBlock;
    float* blocks = work.block_reach.get() + top / kReachBlock * blocks_across + column / kReachBlock;
    for (int i = 0; i < count; i += kReachBlock)
      *blocks++ = *std::max_element(farthest + i, farthest + std::min(count, i + kReachBlock));
  }
  const int64_t place = tile * kTilePixels, rows = frame.rows();
  work.seen_of_tile.get()[tile] = sums.move_to(work.seen.get() + place, work.sums.get() + place * rows, int(rows));
  return counts;
}

}  // namespace jaxmap
