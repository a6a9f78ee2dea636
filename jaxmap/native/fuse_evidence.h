// What the sums over points say of the voxels and columns of the map.

#pragma once

#include <algorithm>
#include <cstdint>
#include <vector>

#include "fuse_frame.h"
#include "fuse_points.h"

namespace jaxmap {

constexpr float kLeastWeight = 1e-12f;
constexpr int kAhead = 16;  // voxels whose memory is asked for before it is needed

// Adds up what the tiles saw of one share of the columns, in the order of the tiles.
inline void gather_tiles(const Frame& frame, int64_t tiles, int64_t share, int64_t shares, Workspace& work) {
  const int class_rows = frame.class_rows(), rows = frame.rows();
  const int32_t depth = int32_t(frame.shape[2]);
  for (int64_t tile = 0; tile < tiles; ++tile) {
    const int64_t begin = tile * kTilePixels, end = begin + work.seen_of_tile.get()[tile];
    for (int64_t seen = begin; seen < end; ++seen) {
      if (seen + kAhead < end) __builtin_prefetch(work.voxel_slots.data() + work.seen.get()[seen + kAhead]);
      const int32_t voxel = work.seen.get()[seen], column = voxel / depth, z = voxel % depth;
      if (column % shares != share) continue;
      const float* sums = work.sums.get() + seen * rows;
      float* row = work.voxels[share].row(work.voxel_slots.data(), voxel, class_rows);
      for (int r = 0; r < class_rows; ++r) row[r] += sums[r];
      if (frame.surface == nullptr) continue;
      // Heights above the middle of a voxel become heights above the camera.
      const double count = sums[class_rows], mass = sums[class_rows + 1], first = sums[class_rows + 2];
      const double up = double(frame.centre(2, z)) - frame.numbers.world_of_camera.translation[2];
      const int32_t place = column * frame.window_layers() + frame.layer_of(z);
      double* moments = work.columns[share].row(work.column_slots.data(), place, 4);
      moments[0] += count, moments[1] += mass, moments[2] += first + up * mass;
      moments[3] += sums[class_rows + 3] + up * (2 * first + up * mass);
    }
  }
}

// What the rule makes of a voxel's weights by class: how much it is hit, which is returned, and the share of each class.
inline float share_out(const Frame& frame, const float* row, float points, float* shares) {
  const int classes = frame.classes, rows = classes + 1;
  if (frame.rule == kSum) {
    std::copy(row, row + classes, shares);
    return points;
  }
  if (frame.rule == kMean) {
    const float full = std::max(points, frame.numbers.full_points);
    for (int c = 0; c < classes; ++c) shares[c] = row[c] / full;
    return points / full;
  }
  const float greatest = *std::max_element(row, row + rows);
  const bool alone = std::count(row, row + rows, greatest) == 1;
  for (int c = 0; c < classes; ++c) shares[c] = frame.rule == kOnce ? row[c] > 0 : alone && row[c] == greatest;
  return points > 0;
}

// Adds what the points say of their voxels to the map; returns how many voxels hold points.
inline int32_t add_hits(const Frame& frame, Workspace& work, const Sums<float>& voxels) {
  const int classes = frame.classes, rows = classes + 1;
  const int64_t map_voxels = frame.map_voxels();
  std::vector<float> shares(classes);
  const auto cell_of = [&](int32_t voxel) {
    const int32_t depth = frame.shape[2], column = voxel / depth, width = frame.shape[1];
    return frame.log_odds + frame.cell(column / width, column % width, voxel % depth);
  };
  int32_t hits = 0;
  for (size_t k = 0; k < voxels.places.size(); ++k) {
    const float* row = voxels.rows.data() + k * rows;
    const int32_t voxel = voxels.places[k];
    if (k + kAhead < voxels.places.size())
      for (int row = 0; row < rows; ++row)
        __builtin_prefetch(cell_of(voxels.places[k + kAhead]) + row * map_voxels, 1);
    float points = row[0];
    for (int r = 1; r < rows; ++r) points += row[r];
    // Points without weight say nothing: the voxel may still be free.
    if (points == 0) work.voxel_slots[voxel] = 0;
    hits += points > 0;
    const float amount = share_out(frame, row, points, shares.data());
    float* cell = cell_of(voxel);
    *cell += amount * frame.numbers.hit;
    for (int to = 0; to < classes; ++to) {
      float gain = 0;
      for (int from = 0; from < classes; ++from) gain += frame.increments[from * classes + to] * shares[from];
      cell[(to + 1) * map_voxels] += gain;
    }
  }
  return hits;
}

// Combines the heights of the frame with those of the map, as `surface.combine` does.
inline void add_heights(const Frame& frame, const Sums<double>& columns) {
  const int64_t apart = frame.map_shape[0] * frame.map_shape[1] * frame.map_layers, layers = frame.window_layers();
  const int32_t lowest = frame.floor_divide(frame.first[2]) - frame.floor_divide(frame.first[2] - frame.corner[2]);
  for (size_t k = 0; k < columns.places.size(); ++k) {
    const double* row = columns.rows.data() + 4 * k;
    if (!(row[1] > 0)) continue;
    const int64_t column = columns.places[k] / layers, layer = columns.places[k] % layers + lowest;
    const int64_t x = frame.corner[0] + column / frame.shape[1], y = frame.corner[1] + column % frame.shape[1];
    float* cell = frame.surface + (x * frame.map_shape[1] + y) * frame.map_layers + layer;
    float &count = cell[0], &mass = cell[apart], &mean = cell[2 * apart], &square = cell[3 * apart];
    const float weight = row[1], height = frame.numbers.world_of_camera.translation[2] + row[2] / row[1];
    const float scatter = std::max(row[3] - row[2] * row[2] / row[1], 0.0);
    const float share = weight / std::max(mass + weight, kLeastWeight), rise = height - mean;
    square += scatter + rise * rise * (mass * share);
    mean += rise * share;
    count += float(row[0]);
    mass += weight;
  }
}

}  // namespace jaxmap
