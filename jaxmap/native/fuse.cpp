// One frame into the map, in place: points counted in voxels and columns, free space carved, evidence added.
//
// The twin of `fusion.frame.add_plainly`, which says what each number means. It touches what the frame touches: points
// once, and of the window the columns in view. XLA goes through the whole window once for each step, and scatters point
// by point on one core.
//
// Neighbouring pixels that fall into one voxel are a run. Runs are summed up side by side, and then one thread adds all
// runs of a voxel, in the order of the pixels: its sums hang neither on the window nor on the number of threads.

#include <algorithm>
#include <atomic>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <limits>
#include <memory>
#include <mutex>
#include <vector>

#include "threads.h"
#include "vectors.h"
#include "xla/ffi/api/ffi.h"

namespace ffi = xla::ffi;
using namespace jaxmap;

namespace {

constexpr int32_t kNowhere = std::numeric_limits<int32_t>::min();  // the place of a point that does not count
constexpr int64_t kBlock = 2048;                                   // points that are worked on together
constexpr int64_t kVoxels = 256;                                   // voxels that are
constexpr int kMostThreads = 8;                                    // that add runs: each looks at all of them
constexpr float kLeastWeight = 1e-12f;

enum Rule { kSum, kOnce, kMajority, kMean };

// In the order in which `fusion.native` packs them; the matrix of increments follows.
struct Numbers {
  float rotation[9], translation[3];  // from the world to the camera
  float fx, fy, cx, cy;
  float margin, sigma;  // metres, and metres of two sigmas for each square metre of depth
  float nearest, farthest;
  float lattice[3], size[3];
  float camera_z;
  float hit, miss, full_points;
};

// What a thread has summed up: rows of numbers for the voxels, or columns, that its points fell into.
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
  std::vector<Sums<float>> voxels;
  std::vector<Sums<double>> columns;
  // Of each run its voxel, weights by class and heights; those of block `b` begin at `b * kBlock`.
  Scratch<int32_t> places, runs_of_block;
  Scratch<float> weights;
  Scratch<double> heights;

  static std::unique_ptr<Workspace> take() {
    std::lock_guard<std::mutex> lock(mutex);
    if (idle.empty()) return std::make_unique<Workspace>();
    auto taken = std::move(idle.back());
    idle.pop_back();
    return taken;
  }

  static void give_back(std::unique_ptr<Workspace> workspace) {
    std::lock_guard<std::mutex> lock(mutex);
    idle.push_back(std::move(workspace));
  }

  static inline std::mutex mutex;
  static inline std::vector<std::unique_ptr<Workspace>> idle;
};

struct Frame {
  Numbers numbers;
  const float* increments;  // (classes, classes)
  int32_t first[3];         // of the window on the lattice
  int32_t corner[3];        // of the window in the map
  int64_t shape[3];         // of the window
  int64_t map_shape[3];
  int64_t points, height, width;
  const float *x, *y, *z;            // of each point in the world
  const uint8_t* keep;               // which points count
  const int32_t* labels;             // of each point, or null
  std::vector<const float*> shares;  // of each class in each point, where there are no labels
  const float* weights;              // of each point
  const float* height_weights;       // of each point for the heights of columns, or null
  const float* measured;             // depth (height, width), 0 where there is none
  int classes;
  Rule rule;
  float* log_odds;  // (1 + classes, map)
  float* surface;   // (4, columns and layers of the map), or null
  int64_t layer, map_layers;  // voxels of the lattice to a layer, and layers of the map

  // The layer of the window that one of its voxels lies in.
  int32_t layer_of(int32_t z) const { return floor_divide(first[2] + z) - floor_divide(first[2]); }
  int32_t floor_divide(int32_t index) const {
    return int32_t(index >= 0 ? index / layer : -((layer - 1 - index) / layer));
  }
  int32_t window_layers() const { return int32_t(shape[2] / layer) + 2; }

  int64_t cell(int64_t x, int64_t y, int64_t z) const {
    return ((corner[0] + x) * map_shape[1] + corner[1] + y) * map_shape[2] + corner[2] + z;
  }
};

// The voxel of the window that each point lies in; `~voxel` where it counts for heights alone.
void locate(const Frame& frame, int64_t begin, int32_t count, int32_t* __restrict places) {
  const Numbers n = frame.numbers;
  const float *px = frame.x + begin, *py = frame.y + begin, *pz = frame.z + begin, *weights = frame.weights + begin;
  const uint8_t* keep = frame.keep + begin;
  // XLA divides by a number that all share in this way.
  const float by_x = 1.0f / n.size[0], by_y = 1.0f / n.size[1], by_z = 1.0f / n.size[2];
  const float shape_x = frame.shape[0], shape_y = frame.shape[1], shape_z = frame.shape[2];
  const float first_x = frame.first[0], first_y = frame.first[1], first_z = frame.first[2];
  const int32_t stride_y = frame.shape[2], stride_x = stride_y * frame.shape[1];
  for (int32_t i = 0; i < count; ++i) {
    // Found on the lattice and then moved: the same voxel in any window.
    const float x = std::floor((px[i] - n.lattice[0]) * by_x) - first_x;
    const float y = std::floor((py[i] - n.lattice[1]) * by_y) - first_y;
    const float z = std::floor((pz[i] - n.lattice[2]) * by_z) - first_z;
    // Of a number that is not finite a comparison is false.
    const bool inside = (x >= 0) & (x < shape_x) & (y >= 0) & (y < shape_y) & (z >= 0) & (z < shape_z) & (keep[i] != 0);
    const int32_t voxel = int32_t(inside ? x : 0.0f) * stride_x + int32_t(inside ? y : 0.0f) * stride_y +
                          int32_t(inside ? z : 0.0f);
    const int32_t weighed = std::fabs(weights[i]) < INFINITY ? voxel : ~voxel;
    places[i] = inside ? weighed : kNowhere;
  }
  for (const float* all : frame.shares) {
    const float* share = all + begin;
    for (int32_t i = 0; i < count; ++i) {
      const int32_t spoilt = places[i] >= 0 ? ~places[i] : places[i];
      places[i] = std::fabs(share[i]) < INFINITY ? places[i] : spoilt;
    }
  }
}

// The weight of a run of points for each class, and for none in the last row.
void weigh(const Frame& frame, int64_t begin, int64_t end, float* __restrict rows) {
  const int classes = frame.classes;
  const float* weights = frame.weights;
  for (int row = 0; row <= classes; ++row) rows[row] = 0;
  if (frame.labels != nullptr) {
    for (int64_t i = begin; i < end;) {
      const int32_t label = frame.labels[i];
      float sum = 0;
      for (; i < end && frame.labels[i] == label; ++i) sum += weights[i];
      rows[uint32_t(label) < uint32_t(classes) ? label : classes] += sum;
    }
  } else if (classes == 3) {
    // The usual number, written out: one pass.
    const float *one = frame.shares[0], *two = frame.shares[1], *three = frame.shares[2];
    float first = 0, second = 0, third = 0, rest = 0;
    for (int64_t i = begin; i < end; ++i) {
      first += one[i] * weights[i], second += two[i] * weights[i], third += three[i] * weights[i];
      rest += (1.0f - (one[i] + two[i] + three[i])) * weights[i];
    }
    rows[0] = first, rows[1] = second, rows[2] = third, rows[3] = rest;
  } else {
    for (int64_t i = begin; i < end; ++i) {
      float known = 0;
      for (int c = 0; c < classes; ++c) {
        known += frame.shares[c][i];
        rows[c] += frame.shares[c][i] * weights[i];
      }
      rows[classes] += (1.0f - known) * weights[i];
    }
  }
}

// Number, weight and first two moments of the heights of a run of points, above the camera.
void weigh_heights(const Frame& frame, int64_t begin, int64_t end, double* __restrict rows) {
  double count = 0, mass = 0, first = 0, second = 0;
  for (int64_t i = begin; i < end; ++i) {
    const double weight = frame.height_weights[i], above = double(frame.z[i]) - frame.numbers.camera_z;
    count += weight > 0, mass += weight, first += weight * above, second += weight * above * above;
  }
  rows[0] = count, rows[1] = mass, rows[2] = first, rows[3] = second;
}

// Finds the runs of a block of points and sums each of them up.
void sum_runs(const Frame& frame, int32_t block, Workspace& work) {
  const int64_t begin = block * kBlock;
  const int32_t count = int32_t(std::min(kBlock, frame.points - begin));
  int32_t places[kBlock], runs = 0;
  locate(frame, begin, count, places);
  for (int32_t i = 0; i < count;) {
    const int32_t place = places[i], from = i;
    while (i < count && places[i] == place) ++i;
    if (place == kNowhere) continue;
    const int64_t run = begin + runs++;
    work.places.get()[run] = place;
    weigh(frame, begin + from, begin + i, work.weights.get() + run * (frame.classes + 1));
    if (frame.height_weights != nullptr)
      weigh_heights(frame, begin + from, begin + i, work.heights.get() + run * 4);
  }
  work.runs_of_block.get()[block] = runs;
}

// Adds up the runs in the voxels from `low` up to `high`.
void add_runs(const Frame& frame, int32_t blocks, int32_t low, int32_t high, Workspace& work, int share) {
  const int rows = frame.classes + 1;
  const int32_t depth = int32_t(frame.shape[2]);
  for (int32_t block = 0; block < blocks; ++block) {
    const int64_t begin = block * kBlock, end = begin + work.runs_of_block.get()[block];
    for (int64_t run = begin; run < end; ++run) {
      const int32_t place = work.places.get()[run], voxel = place >= 0 ? place : ~place;
      if (voxel < low || voxel >= high) continue;
      if (place >= 0) {
        float* row = work.voxels[share].row(work.voxel_slots.data(), voxel, rows);
        for (int r = 0; r < rows; ++r) row[r] += work.weights.get()[run * rows + r];
      }
      if (frame.height_weights != nullptr) {
        double* row = work.columns[share].row(
            work.column_slots.data(), voxel / depth * frame.window_layers() + frame.layer_of(voxel % depth), 4);
        for (int r = 0; r < 4; ++r) row[r] += work.heights.get()[run * 4 + r];
      }
    }
  }
}

// Adds what the points say of their voxels to the map; returns how many voxels hold points.
int32_t add_hits(const Frame& frame, Workspace& work, const Sums<float>& voxels) {
  const Numbers& n = frame.numbers;
  const int classes = frame.classes, rows = classes + 1;
  const int64_t map_voxels = frame.map_shape[0] * frame.map_shape[1] * frame.map_shape[2];
  std::vector<float> shares(classes);
  int32_t hits = 0;
  for (size_t k = 0; k < voxels.places.size(); ++k) {
    const float* row = voxels.rows.data() + k * rows;
    const int32_t voxel = voxels.places[k];
    float points = row[0];
    for (int r = 1; r < rows; ++r) points += row[r];
    // Points without weight say nothing: the voxel may still be free.
    if (points == 0) work.voxel_slots[voxel] = 0;
    hits += points > 0;
    float amount = points;
    if (frame.rule == kMean) {
      const float full = std::max(points, n.full_points);
      amount = points / full;
      for (int c = 0; c < classes; ++c) shares[c] = row[c] / full;
    } else if (frame.rule == kSum) {
      std::copy(row, row + classes, shares.begin());
    } else {
      amount = points > 0;
      const float greatest = *std::max_element(row, row + rows);
      const bool alone = std::count(row, row + rows, greatest) == 1;
      for (int c = 0; c < classes; ++c) shares[c] = frame.rule == kOnce ? row[c] > 0 : alone && row[c] == greatest;
    }
    const int32_t depth = frame.shape[2], column = voxel / depth;
    float* cell = frame.log_odds + frame.cell(column / frame.shape[1], column % frame.shape[1], voxel % depth);
    *cell += amount * n.hit;
    for (int to = 0; to < classes; ++to) {
      float gain = 0;
      for (int from = 0; from < classes; ++from) gain += frame.increments[from * classes + to] * shares[from];
      cell[(to + 1) * map_voxels] += gain;
    }
  }
  return hits;
}

// Combines the heights of the frame with those of the map, as `surface.combine` does.
void add_heights(const Frame& frame, const Sums<double>& columns) {
  const int64_t apart = frame.map_shape[0] * frame.map_shape[1] * frame.map_layers, layers = frame.window_layers();
  const int32_t lowest = frame.floor_divide(frame.first[2]) - frame.floor_divide(frame.first[2] - frame.corner[2]);
  for (size_t k = 0; k < columns.places.size(); ++k) {
    const double* row = columns.rows.data() + 4 * k;
    if (!(row[1] > 0)) continue;
    const int64_t column = columns.places[k] / layers, layer = columns.places[k] % layers + lowest;
    const int64_t x = frame.corner[0] + column / frame.shape[1], y = frame.corner[1] + column % frame.shape[1];
    float* cell = frame.surface + (x * frame.map_shape[1] + y) * frame.map_layers + layer;
    float &count = cell[0], &mass = cell[apart], &mean = cell[2 * apart], &square = cell[3 * apart];
    const float weight = row[1], height = frame.numbers.camera_z + row[2] / row[1];
    const float scatter = std::max(row[3] - row[2] * row[2] / row[1], 0.0);
    const float share = weight / std::max(mass + weight, kLeastWeight), rise = height - mean;
    square += scatter + rise * rise * (mass * share);
    mean += rise * share;
    count += float(row[0]);
    mass += weight;
  }
}

struct Range {
  int64_t begin, end;
};

// The columns of a plane of the window that may hold voxels in view: each face of the view cuts off a half-plane.
Range columns_in_view(const Frame& frame, int64_t plane) {
  const Numbers& n = frame.numbers;
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
      for (int i = 0; i < 3; ++i) world[axis] += face[i] * n.rotation[3 * i + axis];
      offset += face[axis] * n.translation[axis];
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

// Marks down the voxels of one plane of the window that the camera saw through; returns how many. Loops of their own
// before and after the look-up: compilers vectorise those, but not all of them the look-up itself.
int32_t carve_plane(const Frame& frame, int64_t plane, const float* y_of, const float* z_of, const int32_t* slots) {
  const Numbers n = frame.numbers;
  const float *R = n.rotation, *t = n.translation, *depths = frame.measured;
  const float x = n.lattice[0] + (float(frame.first[0] + int32_t(plane)) + 0.5f) * n.size[0];
  const float width = float(frame.width), height = float(frame.height), miss = n.miss;
  const int32_t stride = int32_t(frame.width);
  const Range columns = columns_in_view(frame, plane);
  const int64_t depth = frame.shape[2];
  // Where the window is as high as the map, columns follow each other in both, and all are one row.
  const bool one_row = depth == frame.map_shape[2];
  const int64_t row_columns = one_row ? std::max<int64_t>(columns.end - columns.begin, 1) : 1;
  float distance[kVoxels], measured[kVoxels];
  int32_t pixel[kVoxels], seen_through[kVoxels], freed = 0;
  for (int64_t column = columns.begin; column < columns.end; column += row_columns) {
    for (int64_t start = 0; start < row_columns * depth; start += kVoxels) {
      const int32_t voxels = int32_t(std::min(kVoxels, row_columns * depth - start));
      const float *y_here = y_of + column * depth + start, *z_here = z_of + column * depth + start;
      for (int32_t j = 0; j < voxels; ++j) {
        const float y = y_here[j], z = z_here[j];
        const float x_camera = R[0] * x + R[1] * y + R[2] * z + t[0];
        const float y_camera = R[3] * x + R[4] * y + R[5] * z + t[1];
        const float z_camera = R[6] * x + R[7] * y + R[8] * z + t[2];
        const float inverse = 1.0f / (z_camera > 0 ? z_camera : 1.0f);
        const float u = __builtin_rintf(n.fx * x_camera * inverse + n.cx);
        const float v = __builtin_rintf(n.fy * y_camera * inverse + n.cy);
        const bool in_view = (z_camera > 0) & (u >= 0) & (u < width) & (v >= 0) & (v < height);
        const bool in_range = (z_camera >= n.nearest) & (z_camera <= n.farthest);
        pixel[j] = int32_t(in_view ? v : 0.0f) * stride + int32_t(in_view ? u : 0.0f);
        distance[j] = in_view & in_range ? z_camera : INFINITY;
      }
      for (int32_t j = 0; j < voxels; ++j) measured[j] = depths[pixel[j]];
      int32_t any = 0;
      for (int32_t j = 0; j < voxels; ++j) {
        const float margin = n.margin + measured[j] * measured[j] * n.sigma;
        seen_through[j] = distance[j] + margin < measured[j] ? 1 : 0;
        any += seen_through[j];
      }
      // Where nothing is free the map is not even looked at.
      if (any == 0) continue;
      float* __restrict cell = frame.log_odds + frame.cell(plane, column, 0) + start;
      const int32_t* slot = slots + (plane * frame.shape[1] + column) * depth + start;
      for (int32_t j = 0; j < voxels; ++j) {
        const bool free = (seen_through[j] != 0) & (slot[j] == 0);
        cell[j] += free ? miss : 0.0f;
        freed += free ? 1 : 0;
      }
    }
  }
  return freed;
}

// The ends of ranges of planes of the window, each with a like number of runs.
std::vector<int64_t> share_planes(const Frame& frame, int32_t blocks, const Workspace& work, int shares) {
  const int64_t planes = frame.shape[0], of_plane = frame.shape[1] * frame.shape[2];
  std::vector<int64_t> runs(planes, 0), ends;
  int64_t total = 0, sum = 0;
  for (int32_t block = 0; block < blocks; ++block) {
    const int64_t begin = block * kBlock, end = begin + work.runs_of_block.get()[block];
    // One in eight shows well enough where they are.
    for (int64_t run = begin; run < end; run += 8, ++total) {
      const int32_t place = work.places.get()[run];
      ++runs[(place >= 0 ? place : ~place) / of_plane];
    }
  }
  for (int64_t plane = 0; plane < planes && int64_t(ends.size()) + 1 < shares; ++plane) {
    sum += runs[plane];
    if (sum * shares >= total * int64_t(ends.size() + 1)) ends.push_back(plane + 1);
  }
  while (int64_t(ends.size()) < shares) ends.push_back(planes);
  return ends;
}

void fuse(ffi::ThreadPool& pool, const Frame& frame, bool carve, int32_t* counted) {
  auto work = Workspace::take();
  const int64_t columns = frame.shape[0] * frame.shape[1], depth = frame.shape[2], of_plane = frame.shape[1] * depth;
  const int32_t blocks = int32_t((frame.points + kBlock - 1) / kBlock);
  const int threads = int(std::clamp<int64_t>(pool.num_threads(), 1, kMostThreads));
  work->voxel_slots.resize(std::max<size_t>(work->voxel_slots.size(), columns * depth), 0);
  work->column_slots.resize(std::max<size_t>(work->column_slots.size(), columns * frame.window_layers()), 0);
  work->voxels.resize(std::max<size_t>(work->voxels.size(), threads));
  work->columns.resize(std::max<size_t>(work->columns.size(), threads));
  work->places.of(frame.points);
  work->runs_of_block.of(blocks);
  work->weights.of(frame.points * (frame.classes + 1));
  if (frame.height_weights != nullptr) work->heights.of(frame.points * 4);

  in_parallel(pool, blocks, [&](int block) { sum_runs(frame, block, *work); });
  const std::vector<int64_t> ends = share_planes(frame, blocks, *work, threads);
  std::atomic<int32_t> hits{0}, freed{0};
  in_parallel(pool, threads, [&](int share) {
    const int32_t low = int32_t((share == 0 ? 0 : ends[share - 1]) * of_plane), high = int32_t(ends[share] * of_plane);
    add_runs(frame, blocks, low, high, *work, share);
    hits += add_hits(frame, *work, work->voxels[share]);
    if (frame.surface != nullptr) add_heights(frame, work->columns[share]);
  });
  if (carve) {
    const Numbers& n = frame.numbers;
    std::vector<float> y_of(of_plane), z_of(of_plane);
    for (int64_t j = 0; j < of_plane; ++j) {
      y_of[j] = n.lattice[1] + (float(frame.first[1] + int32_t(j / depth)) + 0.5f) * n.size[1];
      z_of[j] = n.lattice[2] + (float(frame.first[2] + int32_t(j % depth)) + 0.5f) * n.size[2];
    }
    in_parallel(pool, int(frame.shape[0]), [&](int plane) {
      freed += carve_plane(frame, plane, y_of.data(), z_of.data(), work->voxel_slots.data());
    });
  }
  in_parallel(pool, threads, [&](int share) {
    work->voxels[share].clear(work->voxel_slots.data());
    work->columns[share].clear(work->column_slots.data());
  });
  counted[0] = hits, counted[1] = freed;
  Workspace::give_back(std::move(work));
}

ffi::Error fuse_frame(ffi::ThreadPool pool, ffi::Buffer<ffi::F32> log_odds, ffi::Buffer<ffi::F32> surface,
                     ffi::Buffer<ffi::F32> numbers, ffi::Buffer<ffi::S32> places, ffi::Buffer<ffi::F32> x,
                     ffi::Buffer<ffi::F32> y, ffi::Buffer<ffi::F32> z, ffi::Buffer<ffi::PRED> keep,
                     ffi::Buffer<ffi::S32> labels, ffi::Buffer<ffi::F32> weights, ffi::Buffer<ffi::F32> height_weights,
                     ffi::Buffer<ffi::F32> measured, ffi::RemainingArgs shares, ffi::Result<ffi::Buffer<ffi::F32>> new_log_odds,
                     ffi::Result<ffi::Buffer<ffi::F32>> new_surface, ffi::Result<ffi::Buffer<ffi::S32>> counted,
                     ffi::Span<const int64_t> shape, int64_t layer, bool carve, int64_t rule) {
  Frame frame;
  const auto map = log_odds.dimensions();
  frame.classes = int(map[0]) - 1;
  if (int64_t(numbers.element_count()) * 4 != int64_t(sizeof(Numbers)) + 4 * frame.classes * frame.classes)
    return ffi::Error::InvalidArgument("fuse: the numbers are not as many as the kernel takes");
  std::memcpy(&frame.numbers, numbers.typed_data(), sizeof(Numbers));
  frame.increments = numbers.typed_data() + sizeof(Numbers) / sizeof(float);
  for (int axis = 0; axis < 3; ++axis) {
    frame.first[axis] = places.typed_data()[axis];
    frame.corner[axis] = places.typed_data()[3 + axis];
    frame.shape[axis] = shape[axis];
    frame.map_shape[axis] = map[axis + 1];
    if (frame.corner[axis] < 0 || frame.corner[axis] + shape[axis] > map[axis + 1])
      return ffi::Error::InvalidArgument("fuse: the window is not in the map");
  }
  frame.points = int64_t(weights.element_count());
  frame.height = measured.dimensions()[0], frame.width = measured.dimensions()[1];
  frame.x = x.typed_data(), frame.y = y.typed_data(), frame.z = z.typed_data();
  frame.keep = reinterpret_cast<const uint8_t*>(keep.typed_data());
  frame.labels = labels.element_count() ? labels.typed_data() : nullptr;
  for (size_t index = 0; index < shares.size(); ++index) {
    auto share = shares.get<ffi::Buffer<ffi::F32>>(index);
    if (!share.has_value()) return share.error();
    frame.shares.push_back(share->typed_data());
  }
  frame.weights = weights.typed_data();
  frame.height_weights = height_weights.element_count() ? height_weights.typed_data() : nullptr;
  frame.measured = measured.typed_data();
  frame.layer = layer, frame.map_layers = surface.dimensions()[3];
  frame.rule = static_cast<Rule>(rule);
  frame.log_odds = new_log_odds->typed_data();
  frame.surface = surface.element_count() ? new_surface->typed_data() : nullptr;
  // Where XLA could not give the results the place of the arguments.
  if (frame.log_odds != log_odds.typed_data()) std::memcpy(frame.log_odds, log_odds.typed_data(), log_odds.size_bytes());
  if (frame.surface != nullptr && frame.surface != surface.typed_data())
    std::memcpy(frame.surface, surface.typed_data(), surface.size_bytes());
  fuse(pool, frame, carve, counted->typed_data());
  return ffi::Error::Success();
}

}  // namespace

XLA_FFI_DEFINE_HANDLER_SYMBOL(jaxmap_fuse, fuse_frame,
                              ffi::Ffi::Bind()
                                  .Ctx<ffi::ThreadPool>()
                                  .Arg<ffi::Buffer<ffi::F32>>()   // log_odds
                                  .Arg<ffi::Buffer<ffi::F32>>()   // surface
                                  .Arg<ffi::Buffer<ffi::F32>>()   // numbers
                                  .Arg<ffi::Buffer<ffi::S32>>()   // places
                                  .Arg<ffi::Buffer<ffi::F32>>()   // x
                                  .Arg<ffi::Buffer<ffi::F32>>()   // y
                                  .Arg<ffi::Buffer<ffi::F32>>()   // z
                                  .Arg<ffi::Buffer<ffi::PRED>>()  // keep
                                  .Arg<ffi::Buffer<ffi::S32>>()   // labels
                                  .Arg<ffi::Buffer<ffi::F32>>()   // weights
                                  .Arg<ffi::Buffer<ffi::F32>>()   // height_weights
                                  .Arg<ffi::Buffer<ffi::F32>>()   // measured
                                  .RemainingArgs()                // shares
                                  .Ret<ffi::Buffer<ffi::F32>>()
                                  .Ret<ffi::Buffer<ffi::F32>>()
                                  .Ret<ffi::Buffer<ffi::S32>>()
                                  .Attr<ffi::Span<const int64_t>>("shape")
                                  .Attr<int64_t>("layer")
                                  .Attr<bool>("carve")
                                  .Attr<int64_t>("rule"));
