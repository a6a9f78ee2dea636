// Free space: the voxels that the camera saw through (`fusion.carve` says which).
//
// Each voxel looks itself up among blocks of pixels first, which lie in the innermost cache. Most are farther than
// anything that was seen in theirs; only where one of a few hundred is not do these look at their own pixels.

#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>

#include "fuse_frame.h"
#include "fuse_points.h"

namespace jaxmap {

constexpr int64_t kTogether = 256;  // voxels that are looked up together

struct Range {
  int64_t begin, end;
};

// The columns of a plane of the window that may hold voxels in view: each face of the view cuts off a half-plane.
inline Range columns_in_view(const Frame& frame, int64_t plane) {
  const Numbers& n = frame.numbers;
  const Pose& pose = n.camera_of_world;
  const double slack = 1.0, right = double(frame.width) - 0.5 - n.cx, below = double(frame.height) - 0.5 - n.cy;
  // In the camera: a x + b y + c z + d >= 0 within each face.
  const double faces[6][4] = {{n.fx, 0, n.cx + 0.5 + slack, 0}, {-n.fx, 0, right + slack, 0},
                              {0, n.fy, n.cy + 0.5 + slack, 0}, {0, -n.fy, below + slack, 0},
                              {0, 0, 1, 0},                     {0, 0, -1, n.farthest}};
  double low = -1e300, high = 1e300;
  const auto centre = [&](int axis, double index) {
    return n.lattice[axis] + (frame.first[axis] + index + 0.5) * n.size[axis];
  };
  const double x = centre(0, plane), bottom = centre(2, 0), top = centre(2, frame.shape[2] - 1);
  for (const auto& face : faces) {
    double world[3], offset = face[3];
    for (int axis = 0; axis < 3; ++axis) {
      world[axis] = 0;
      for (int i = 0; i < 3; ++i) world[axis] += face[i] * pose.rotation[3 * i + axis];
      offset += face[axis] * pose.translation[axis];
    }
    const double rest = world[0] * x + std::max(world[2] * bottom, world[2] * top) + offset;
    if (std::fabs(world[1]) < 1e-9) {
      if (rest < -1e-3) return {0, 0};
    } else if (world[1] > 0) {
      low = std::max(low, -rest / world[1]);
    } else {
      high = std::min(high, -rest / world[1]);
    }
  }
  const double origin = n.lattice[1] + double(frame.first[1]) * n.size[1], last = double(frame.shape[1]);
  // A voxel to either side for rounding.
  const double begin = std::clamp(std::floor((low - origin) / n.size[1]) - 1.0, 0.0, last);
  const double end = std::clamp(std::ceil((high - origin) / n.size[1]) + 1.0, 0.0, last);
  return {int64_t(begin), std::max(int64_t(begin), int64_t(end))};
}

// Voxels that are looked up together: how far each lies, and where in the image it is seen.
struct LookUp {
  float distance[kTogether];  // INFINITY out of view
  int32_t pixel[kTogether], block[kTogether];
};

// Finds where the camera sees the centres (x, y[j], z[j]). A loop of its own, as are those after it: compilers
// vectorise each, but not all of them together.
inline void look_up(const Frame& frame, float x, const float* y, const float* z, int count, LookUp& found) {
  const Numbers n = frame.numbers;
  const float *R = n.camera_of_world.rotation, *t = n.camera_of_world.translation;
  const float width = float(frame.width), height = float(frame.height);
  const int32_t stride = int32_t(frame.width), blocks = (stride + kReachBlock - 1) / kReachBlock;
  for (int j = 0; j < count; ++j) {
    const float x_camera = R[0] * x + R[1] * y[j] + R[2] * z[j] + t[0];
    const float y_camera = R[3] * x + R[4] * y[j] + R[5] * z[j] + t[1];
    const float z_camera = R[6] * x + R[7] * y[j] + R[8] * z[j] + t[2];
    const float inverse = 1.0f / (z_camera > 0 ? z_camera : 1.0f);
    const float u = __builtin_rintf(n.fx * x_camera * inverse + n.cx);
    const float v = __builtin_rintf(n.fy * y_camera * inverse + n.cy);
    const bool in_view = (z_camera > 0) & (u >= 0) & (u < width) & (v >= 0) & (v < height);
    const bool in_range = (z_camera >= n.nearest) & (z_camera <= n.farthest);
    const int32_t column = int32_t(in_view ? u : 0.0f), row = int32_t(in_view ? v : 0.0f);
    found.pixel[j] = row * stride + column;
    found.block[j] = row / kReachBlock * blocks + column / kReachBlock;
    found.distance[j] = in_view & in_range ? z_camera : INFINITY;
  }
}

// Marks the voxels that lie before what was seen where they are; returns how many do.
inline int32_t mark_before(const float* distance, const float* reach, const int32_t* place, int count, int32_t* before) {
  float there[kTogether];
  for (int j = 0; j < count; ++j) there[j] = reach[place[j]];
  int32_t any = 0;
  for (int j = 0; j < count; ++j) any += before[j] = distance[j] < there[j] ? 1 : 0;
  return any;
}

// Marks down the voxels of one plane of the window that the camera saw through; returns how many.
inline int32_t carve_plane(const Frame& frame, int64_t plane, const float* y_of, const float* z_of,
                           const Workspace& work) {
  const float miss = frame.numbers.miss, x = frame.centre(0, plane);
  const Range columns = columns_in_view(frame, plane);
  const int64_t depth = frame.shape[2];
  // Where the window is as high as the map, columns follow each other in both, and all are one row.
  const bool one_row = depth == frame.map_shape[2];
  const int64_t row_columns = one_row ? std::max<int64_t>(columns.end - columns.begin, 1) : 1;
  LookUp found;
  int32_t before[kTogether], freed = 0;
  for (int64_t column = columns.begin; column < columns.end; column += row_columns) {
    for (int64_t start = 0; start < row_columns * depth; start += kTogether) {
      const int count = int(std::min(kTogether, row_columns * depth - start));
      const int64_t place = column * depth + start;
      look_up(frame, x, y_of + place, z_of + place, count, found);
      if (mark_before(found.distance, work.block_reach.get(), found.block, count, before) == 0 ||
          mark_before(found.distance, work.reach.get(), found.pixel, count, before) == 0)
        continue;
      float* __restrict cell = frame.log_odds + frame.cell(plane, column, 0) + start;
      const int32_t* slot = work.voxel_slots.data() + plane * frame.shape[1] * depth + place;
      for (int j = 0; j < count; ++j) {
        const bool free = (before[j] != 0) & (slot[j] == 0);
        cell[j] += free ? miss : 0.0f;
        freed += free ? 1 : 0;
      }
    }
  }
  return freed;
}

}  // namespace jaxmap
