// From pixels to sums over the points in each voxel, a tile of pixels at a time. Points never lie in memory.
//
// Neighbours in a row that fall into one voxel are a run. Each run is added, lane by lane of the vectors, to the sums of
// its voxel in the tile; the lanes are added up when the tile is done. What a voxel gets thus hangs neither on the
// window nor on the number of threads.

#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <vector>

#include "fuse_frame.h"
#include "vectors.h"

namespace jaxmap {

constexpr int kTileRows = 8, kTileColumns = 256, kTilePixels = kTileRows * kTileColumns;
constexpr int kReachBlock = kTileRows;  // pixels to the edge of a block of `block_reach`; columns divide into them
constexpr int32_t kNowhere = std::numeric_limits<int32_t>::min();  // the voxel of a point that does not count
constexpr float kLeastDisparity = 1e-6f;

// The points of neighbouring pixels in a row.
struct Strip {
  float depths[kTileColumns], heights[kTileColumns];  // metres; heights above the middle of the voxel
  float falls[kTileColumns];                          // below the camera, metres
  int32_t voxels[kTileColumns];                       // of the window, or kNowhere
  uint8_t starts[kTileColumns + sizeof(uint64_t)];    // where a run starts
};

// Projects the pixels, and finds the voxels that their points lie in (`geometry.cloud.project`, `flat_voxel_index`).
inline void locate(const Frame& frame, const float* across, int64_t row, int64_t column, int count, Strip& strip) {
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
  for (int i = 0; i < count; ++i) {
    const float shifted = disparity[i] + n.doffs;
    const bool valid = (shifted > kLeastDisparity) & (shifted < INFINITY);
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
    const bool inside = (x >= 0) & (x < shape_x) & (y >= 0) & (y < shape_y) & (z >= 0) & (z < shape_z) & (keep[i] != 0);
    const int32_t voxel = int32_t(inside ? x : 0.0f) * stride_x + int32_t(inside ? y : 0.0f) * stride_y +
                          int32_t(inside ? z : 0.0f);
    strip.voxels[i] = inside ? voxel : kNowhere;
    strip.depths[i] = depth;
    strip.heights[i] = z_world - (n.lattice[2] + (level + 0.5f) * n.size[2]);
    strip.falls[i] = std::fabs(z_world - t[2]);
  }
}

// Up to where the camera saw through each pixel, and the farthest of those seen so far in each column.
inline void look_through(const Frame& frame, const float* disparity, int count, const float* depths, float* reach,
                         float* farthest) {
  const Numbers n = frame.numbers;
  for (int i = 0; i < count; ++i) {
    const float shifted = disparity[i] + n.doffs, depth = depths[i];
    const bool valid = (shifted > kLeastDisparity) & (shifted < INFINITY);
    const float seen = valid ? depth - (n.margin + depth * depth * n.sigmas) : 0.0f;
    reach[i] = seen;
    farthest[i] = std::max(farthest[i], seen);
  }
}

// How much each point counts (`fusion.sensor_model.point_weights`), by class where it has a share of each.
inline void weigh(const Frame& frame, int64_t pixel, int count, const float* depths, float* __restrict values,
                  int stride) {
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
    values += stride;
  }
  for (int i = 0; i < count; ++i) values[i] = weights[i] != 0 ? (1.0f - known[i]) * weights[i] : 0.0f;
}

// How much the height of each point counts (`fusion.surface.height_sigma`): its number, weight and two moments.
inline void weigh_heights(const Frame& frame, const Strip& strip, int count, float* __restrict values, int stride) {
  const Numbers n = frame.numbers;
  for (int i = 0; i < count; ++i) {
    const float depth = strip.depths[i], sigma = strip.falls[i] / depth * (depth * depth * n.sigma);
    const float weight = sigma < INFINITY ? 1.0f / (sigma * sigma + n.height_variance) : 0.0f;
    const float first = weight * strip.heights[i];
    values[i] = weight > 0 ? 1.0f : 0.0f;
    values[stride + i] = weight;
    values[2 * stride + i] = weight > 0 ? first : 0.0f;
    values[3 * stride + i] = weight > 0 ? first * strip.heights[i] : 0.0f;
  }
}

// Marks where runs start, and past the end, so that one is always found.
inline void find_runs(const int32_t* labels, int count, Strip& strip) {
  strip.starts[0] = 1;
  for (int i = 1; i < count; ++i) strip.starts[i] = strip.voxels[i] != strip.voxels[i - 1];
  if (labels != nullptr)
    for (int i = 1; i < count; ++i) strip.starts[i] |= labels[i] != labels[i - 1];
  strip.starts[count] = 1;
}

inline int next_run(const uint8_t* starts, int from) {
  for (uint64_t eight;; from += sizeof eight) {
    std::memcpy(&eight, starts + from, sizeof eight);
    if (eight != 0) return from + __builtin_ctzll(eight) / 8;
  }
}

// Adds values to the lanes of a sum.
inline void add_to_lanes(const float* values, int count, float* lanes) {
  Vector sum = load(lanes);
  for (; count >= kLanes; count -= kLanes, values += kLanes) sum += load(values);
  if (count > 0) sum += first_lanes(load(values), count);
  store(lanes, sum);
}

// The voxels that a tile of pixels sees, in the order in which it meets them, and their sums in lanes.
class TileSums {
 public:
  explicit TileSums() : slots_(kSlots, 0) {}

  float* lanes_of(int32_t voxel, int rows) {
    uint32_t slot = uint32_t(voxel) * 2654435761u >> (32 - kSlotBits);
    for (; slots_[slot] != 0; slot = (slot + 1) % kSlots)
      if (voxels_[slots_[slot] - 1] == voxel) return lanes_.data() + int64_t(slots_[slot] - 1) * rows * kLanes;
    voxels_.push_back(voxel), taken_.push_back(slot);
    slots_[slot] = int32_t(voxels_.size());
    lanes_.resize(voxels_.size() * rows * kLanes, 0.0f);
    return lanes_.data() + (voxels_.size() - 1) * rows * kLanes;
  }

  // Writes down voxels and sums, forgets them, and returns how many there were.
  int32_t move_to(int32_t* voxels, float* sums, int rows) {
    const int32_t count = int32_t(voxels_.size());
    std::copy(voxels_.begin(), voxels_.end(), voxels);
    for (int64_t row = 0; row < int64_t(count) * rows; ++row) sums[row] = sum_of(load(lanes_.data() + row * kLanes));
    for (uint32_t slot : taken_) slots_[slot] = 0;
    voxels_.clear(), taken_.clear(), lanes_.clear();
    return count;
  }

 private:
  // Twice as many slots as a tile can see voxels.
  static constexpr int kSlotBits = 12;
  static constexpr uint32_t kSlots = 1u << kSlotBits;
  static_assert(kSlots >= 2 * kTilePixels);
  std::vector<int32_t> slots_, voxels_;
  std::vector<uint32_t> taken_;
  std::vector<float> lanes_;
};

// Adds the runs of a strip, whose first pixel is `pixel`, to the sums of their voxels.
inline void add_runs(const Frame& frame, int64_t pixel, int count, const Strip& strip, const float* values, int stride,
                     TileSums& sums) {
  const int rows = frame.rows(), class_rows = frame.class_rows();
  for (int begin = 0, end; begin < count; begin = end) {
    end = next_run(strip.starts, begin + 1);
    if (strip.voxels[begin] == kNowhere) continue;
    float* lanes = sums.lanes_of(strip.voxels[begin], rows);
    int row = 0, value = 0;
    if (frame.labels != nullptr) {
      const uint32_t label = uint32_t(frame.labels[pixel + begin]);
      add_to_lanes(values + begin, end - begin, lanes + std::min(label, uint32_t(frame.classes)) * kLanes);
      row = class_rows, value = 1;
    }
    for (; row < rows; ++row, ++value)
      add_to_lanes(values + value * stride + begin, end - begin, lanes + row * kLanes);
  }
}

// Sums up the points of a tile by voxels.
inline void sum_tile(const Frame& frame, int64_t tile, Workspace& work) {
  thread_local TileSums sums;
  thread_local Strip strip;
  thread_local Scratch<float> kept;
  constexpr int kStride = kTileColumns + kLanes;
  float *values = kept.of(frame.rows() * kStride), farthest[kTileColumns] = {};
  const int64_t tiles_across = (frame.width + kTileColumns - 1) / kTileColumns;
  const int64_t column = tile % tiles_across * kTileColumns, top = tile / tiles_across * kTileRows;
  const int count = int(std::min<int64_t>(kTileColumns, frame.width - column));
  for (int64_t row = top; row < std::min(frame.height, top + kTileRows); ++row) {
    const int64_t pixel = row * frame.width + column;
    locate(frame, work.across.get(), row, column, count, strip);
    if (frame.carve)
      look_through(frame, frame.disparity + pixel, count, strip.depths, work.reach.get() + pixel, farthest);
    find_runs(frame.labels != nullptr ? frame.labels + pixel : nullptr, count, strip);
    weigh(frame, pixel, count, strip.depths, values, kStride);
    const int class_values = frame.labels != nullptr ? 1 : frame.class_rows();
    if (frame.surface != nullptr) weigh_heights(frame, strip, count, values + class_values * kStride, kStride);
    add_runs(frame, pixel, count, strip, values, kStride, sums);
  }
  if (frame.carve) {
    const int64_t blocks_across = (frame.width + kReachBlock - 1) / kReachBlock;
    float* blocks = work.block_reach.get() + top / kReachBlock * blocks_across + column / kReachBlock;
    for (int i = 0; i < count; i += kReachBlock)
      *blocks++ = *std::max_element(farthest + i, farthest + std::min(count, i + kReachBlock));
  }
  const int64_t place = tile * kTilePixels;
  work.seen_of_tile.get()[tile] = sums.move_to(work.seen.get() + place, work.sums.get() + place * frame.rows(), frame.rows());
}

}  // namespace jaxmap
