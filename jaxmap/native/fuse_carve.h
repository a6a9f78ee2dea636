// Free space: the voxels that the camera saw through (`fusion.carve` says which).
//
// Voxels are looked up along y, where a row of them is all air or all ground, as a rule. Each looks itself up among
// blocks of pixels first, which lie in the innermost cache. Only where one of a row is nearer than the farthest of what
// was seen in its block do they look at their own pixels.

#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>

#include "fuse_frame.h"
#include "fuse_points.h"
#include "vectors.h"

namespace jaxmap {

constexpr int kTogether = 128;  // voxels that are looked up together

struct Range {
  int64_t begin, end;
};

// The pyramid that the camera sees.
class View {
 public:
  explicit View(const Frame& frame) : frame_(frame) {
    const Numbers& n = frame.numbers;
    const Pose& pose = n.camera_of_world;
    const double slack = 1.0, right = double(frame.width) - 0.5 - n.cx, below = double(frame.height) - 0.5 - n.cy;
    // In the camera: a x + b y + c z + d >= 0 within each face.
    const double faces[kFaces][4] = {{n.fx, 0, n.cx + 0.5 + slack, 0}, {-n.fx, 0, right + slack, 0},
                                     {0, n.fy, n.cy + 0.5 + slack, 0}, {0, -n.fy, below + slack, 0},
                                     {0, 0, 1, 0},                     {0, 0, -1, n.farthest}};
    for (int face = 0; face < kFaces; ++face) {
      faces_[face][3] = faces[face][3];
      for (int i = 0; i < 3; ++i) {
        for (int axis = 0; axis < 3; ++axis) faces_[face][axis] += faces[face][i] * pose.rotation[3 * i + axis];
        faces_[face][3] += faces[face][i] * pose.translation[i];
      }
      // Solved for y, but for faces that run along it.
      const double slope = std::fabs(faces_[face][1]);
      if (slope >= 1e-9)
        for (double& number : faces_[face]) number /= slope;
    }
  }

  // The voxels along y that may be in view where x and z are these.
  Range along_y(double x, double z) const {
    double low = -1e300, high = 1e300;
    for (const auto& face : faces_) {
      const double rest = face[0] * x + face[2] * z + face[3];
      if (std::fabs(face[1]) < 1e-9) {
        if (rest < -1e-3) return {0, 0};
      } else if (face[1] > 0) {
        low = std::max(low, -rest);
      } else {
        high = std::min(high, rest);
      }
    }
    const Numbers& n = frame_.numbers;
    const double origin = n.lattice[1] + double(frame_.first[1]) * n.size[1], last = double(frame_.shape[1]);
    // A voxel to either side for rounding.
    const double begin = std::clamp(std::floor((low - origin) / n.size[1]) - 1.0, 0.0, last);
    const double end = std::clamp(std::ceil((high - origin) / n.size[1]) + 1.0, 0.0, last);
    return {int64_t(begin), std::max(int64_t(begin), int64_t(end))};
  }

 private:
  static constexpr int kFaces = 6;
  const Frame& frame_;
  double faces_[kFaces][4] = {};  // in the world
};

// Voxels that are looked up together: how far each lies, and where in the image it is seen.
struct LookUp {
  float distance[kTogether];  // INFINITY out of view
  int32_t pixel[kTogether], block[kTogether];
};

// Finds where the camera sees the centres (x, y[j], z). A loop of its own, as are those after it: compilers
// vectorise each, but not all of them together.
inline void look_up(const Frame& frame, float x, const float* y, float z, int count, LookUp& found) {
  const Numbers n = frame.numbers;
  const float *R = n.camera_of_world.rotation, *t = n.camera_of_world.translation;
  const float width = float(frame.width), height = float(frame.height);
  const int32_t stride = int32_t(frame.width), blocks = (stride + kReachBlock - 1) / kReachBlock;
  for (int j = 0; j < count; ++j) {
    const float x_camera = R[0] * x + R[1] * y[j] + R[2] * z + t[0];
    const float y_camera = R[3] * x + R[4] * y[j] + R[5] * z + t[1];
    const float z_camera = R[6] * x + R[7] * y[j] + R[8] * z + t[2];
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
inline int32_t mark_before(const float* distance, const float* reach, const int32_t* place, int count,
                           int32_t* before) {
  float there[kTogether];
  for (int j = 0; j < count; ++j) there[j] = reach[place[j]];
  int32_t any = 0;
  for (int j = 0; j < count; ++j) any += before[j] = distance[j] < there[j] ? 1 : 0;
  return any;
}

// The y of the centres along a row; those beyond the window, up to where they are looked up together, are nowhere.
inline void measure_row(const Frame& frame, Scratch<float>& along) {
  float* y = along.of(frame.shape[1] + kTogether);
  for (int64_t j = 0; j < frame.shape[1] + kTogether; ++j) y[j] = j < frame.shape[1] ? frame.centre(1, j) : NAN;
}

// Marks down the voxels of one plane of the window that the camera saw through; returns how many.
inline int32_t carve_plane(const Frame& frame, const View& view, int64_t plane, const Workspace& work) {
  const float miss = frame.numbers.miss, x = frame.centre(0, plane);
  const int64_t depth = frame.shape[2], map_depth = frame.map_shape[2];
  LookUp found;
  int32_t before[kTogether], freed = 0;
  for (int64_t level = 0; level < depth; ++level) {
    const float z = frame.centre(2, level);
    const Range row = view.along_y(x, z);
    float* cells = frame.log_odds + frame.cell(plane, 0, level);
    const int32_t* slots = work.voxel_slots.data() + plane * frame.shape[1] * depth + level;
    for (int64_t begin = row.begin; begin < row.end; begin += kTogether) {
      // Whole vectors, beyond the row as well: there, too, it is looked up what is free.
      const int count = int(std::min<int64_t>(kTogether, (row.end - begin + kLanes - 1) / kLanes * kLanes));
      look_up(frame, x, work.along.get() + begin, z, count, found);
      if (mark_before(found.distance, work.block_reach.get(), found.block, count, before) == 0 ||
          mark_before(found.distance, work.reach.get(), found.pixel, count, before) == 0)
        continue;
      for (int j = 0; j < count; ++j) {
        if (before[j] == 0 || slots[(begin + j) * depth] != 0) continue;
        cells[(begin + j) * map_depth] += miss;
        ++freed;
      }
    }
  }
  return freed;
}

}  // namespace jaxmap
