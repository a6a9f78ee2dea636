// A frame, and the part of the map that it can touch, as the kernel of fusion takes them.

#pragma once

#include <cstdint>
#include <vector>

#include "vectors.h"

namespace jaxmap {

enum Rule { kSum, kOnce, kMajority, kMean };

struct Pose {
  float rotation[9], translation[3];
};

// In the order in which `fusion.kernel` packs them; the matrix of increments follows.
struct Numbers {
  Pose world_of_camera, camera_of_world;
  float fx, fy, cx, cy;
  float doffs, depth_px;  // depth = depth_px / (disparity + doffs)
  float sigma;            // of depth: metres for each square metre of depth
  float by_edge;          // 1 / mean edge of a voxel; 0 where points count alike however far they are
  float height_variance;  // that no height is better than
  float margin, sigmas;   // before a surface, metres and standard deviations of its depth, nothing is known to be free
  float nearest, farthest;
  float lattice[3], size[3];
  float hit, miss, full_points;
};

struct Frame {
  Numbers numbers;
  const float* increments;  // (classes, classes)
  int32_t first[3];         // of the window on the lattice
  int32_t corner[3];        // of the window in the map
  int64_t shape[3];         // of the window
  int64_t map_shape[3];
  int64_t height, width;
  const float* disparity;            // (height, width), not finite where unknown
  const uint8_t* keep;               // which pixels' points count
  const int32_t* labels;             // of each pixel, or null
  std::vector<const float*> shares;  // of each class in each pixel, where there are no labels
  int classes;
  Rule rule;
  bool carve;
  float* log_odds;            // (1 + classes, map)
  float* surface;             // (4, columns and layers of the map), or null
  int64_t layer, map_layers;  // voxels of the lattice to a layer, and layers of the map

  // What is summed up over the points of a voxel: weights by class and of none; number, weight and first two moments of
  // heights. A point with a label has one weight, which goes to the row of its class.
  int class_rows() const { return classes + 1; }
  int height_rows() const { return surface ? 4 : 0; }
  int rows() const { return class_rows() + height_rows(); }
  int weight_rows() const { return labels ? 1 : class_rows(); }
  int value_rows() const { return weight_rows() + height_rows(); }

  int64_t columns() const { return shape[0] * shape[1]; }
  int64_t voxels() const { return columns() * shape[2]; }
  int64_t map_voxels() const { return map_shape[0] * map_shape[1] * map_shape[2]; }

  // The layer of the window that one of its voxels lies in.
  int32_t layer_of(int32_t z) const { return floor_divide(first[2] + z) - floor_divide(first[2]); }
  int32_t floor_divide(int32_t index) const {
    return int32_t(index >= 0 ? index / layer : -((layer - 1 - index) / layer));
  }
  int32_t window_layers() const { return int32_t(shape[2] / layer) + 2; }

  int64_t cell(int64_t x, int64_t y, int64_t z) const {
    return ((corner[0] + x) * map_shape[1] + corner[1] + y) * map_shape[2] + corner[2] + z;
  }
  // As `geometry.grid.voxel_centres` rounds it.
  float centre(int axis, int64_t index) const {
    return numbers.lattice[axis] + (float(first[axis] + int32_t(index)) + 0.5f) * numbers.size[axis];
  }
};

// Rows of numbers, for each place that was asked for; `slots` says which, and is 0 at all others.
template <typename Number>
struct Sums {
  std::vector<int32_t> places;
  std::vector<Number> rows;

  Number* row(int32_t* slots, int32_t place, int width) {
    int32_t& slot = slots[place];
    if (slot == 0) {
      places.push_back(place);
      slot = int32_t(places.size());
      rows.resize(rows.size() + width, Number(0));
    }
    return rows.data() + int64_t(slot - 1) * width;
  }

  void clear(int32_t* slots) {
    for (int32_t place : places) slots[place] = 0;
    places.clear();
    rows.clear();
  }
};

// Memory that is kept from frame to frame; all slots are zero in between.
struct Workspace {
  std::vector<int32_t> voxel_slots, column_slots;
  std::vector<Sums<float>> voxels;   // of each thread
  std::vector<Sums<double>> columns;
  Scratch<float> across, along;  // of each column of pixels x at depth 1, of each row of voxels y
  // Up to which depth the camera saw free space through each pixel, and the farthest of each block of pixels.
  Scratch<float> reach, block_reach;
  // Of each voxel that a tile of pixels saw: its place, and the sums over those pixels.
  Scratch<int32_t> seen, seen_of_tile;
  Scratch<float> sums;
};

}  // namespace jaxmap
