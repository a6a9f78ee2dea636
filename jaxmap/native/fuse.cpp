// One frame into the map, in place: pixels to points, points counted in voxels and columns, free space carved, evidence
// added.
//
// The twin of `fusion.frame.add_plainly`, which says what each number means. It touches what the frame touches:
// disparities and labels once, and of the window the columns in view. XLA would write the points down, go through the
// whole window once for each step, and scatter point by point on one core.

#include <algorithm>
#include <atomic>
#include <cstdint>
#include <cstring>
#include <iterator>
#include <limits>

#include "fuse_carve.h"
#include "fuse_evidence.h"
#include "fuse_frame.h"
#include "fuse_points.h"
#include "threads.h"
#include "xla/ffi/api/ffi.h"

namespace ffi = xla::ffi;
using namespace jaxmap;

namespace {

constexpr int kMostThreads = 8;  // that add up tiles: each looks at all of them

void fuse(ffi::ThreadPool& pool, const Frame& frame, int32_t* counted) {
  const Numbers& n = frame.numbers;
  const auto parts = [](int64_t whole, int64_t part) { return (whole + part - 1) / part; };
  const int64_t tiles = parts(frame.height, kTileRows) * parts(frame.width, kTileColumns);
  const int64_t threads = std::clamp<int64_t>(pool.num_threads(), 1, kMostThreads);
  auto work = Kept<Workspace>::take();
  work->voxel_slots.resize(std::max<size_t>(work->voxel_slots.size(), frame.voxels()), 0);
  work->column_slots.resize(std::max<size_t>(work->column_slots.size(), frame.columns() * frame.window_layers()), 0);
  work->voxels.resize(std::max<size_t>(work->voxels.size(), threads));
  work->columns.resize(std::max<size_t>(work->columns.size(), threads));
  work->seen.of(tiles * kTilePixels), work->seen_of_tile.of(tiles);
  work->sums.of(tiles * kTilePixels * frame.rows());
  work->reach.of(frame.height * frame.width);
  work->block_reach.of(parts(frame.height, kReachBlock) * parts(frame.width, kReachBlock));
  float* across = work->across.of(frame.width);
  for (int64_t column = 0; column < frame.width; ++column) across[column] = (float(column) - n.cx) * (1.0f / n.fx);

  std::atomic<int32_t> hits{0}, freed{0}, valid{0}, in_range{0}, kept{0};
  in_parallel(pool, tiles, [&](int64_t tile) {
    const PixelCounts counts = sum_tile(frame, tile, *work);
    valid += counts.valid, in_range += counts.in_range, kept += counts.kept;
  });
  in_parallel(pool, threads, [&](int64_t share) {
    gather_tiles(frame, tiles, share, threads, *work);
    hits += add_hits(frame, *work, work->voxels[share]);
    if (frame.surface != nullptr) add_heights(frame, work->columns[share]);
  });
  if (frame.carve) {
    const View view(frame);
    measure_row(frame, work->along);
    in_parallel(pool, frame.shape[0], [&](int64_t plane) { freed += carve_plane(frame, view, plane, *work); });
  }
  for (int64_t share = 0; share < threads; ++share) {
    work->voxels[share].clear(work->voxel_slots.data());
    work->columns[share].clear(work->column_slots.data());
  }
  const int32_t numbers[] = {hits, freed, valid, in_range, kept};
  std::copy(std::begin(numbers), std::end(numbers), counted);  // `fusion.frame.Counted`
  Kept<Workspace>::give_back(std::move(work));
}

ffi::Error fuse_frame(ffi::ThreadPool pool, ffi::Buffer<ffi::F32> log_odds, ffi::Buffer<ffi::F32> surface,
                      ffi::Buffer<ffi::F32> numbers, ffi::Buffer<ffi::S32> places, ffi::Buffer<ffi::F32> disparity,
                      ffi::Buffer<ffi::PRED> keep, ffi::Buffer<ffi::S32> labels, ffi::RemainingArgs shares,
                      ffi::Result<ffi::Buffer<ffi::F32>> new_log_odds, ffi::Result<ffi::Buffer<ffi::F32>> new_surface,
                      ffi::Result<ffi::Buffer<ffi::S32>> counted, ffi::Span<const int64_t> shape, int64_t layer,
                      bool carve, int64_t rule) {
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
  frame.height = disparity.dimensions()[0], frame.width = disparity.dimensions()[1];
  if (std::max(frame.voxels(), frame.height * frame.width) > std::numeric_limits<int32_t>::max())
    return ffi::Error::InvalidArgument("fuse: more voxels in view, or pixels, than the kernel counts");
  frame.disparity = disparity.typed_data();
  frame.keep = reinterpret_cast<const uint8_t*>(keep.typed_data());
  frame.labels = labels.element_count() ? labels.typed_data() : nullptr;
  for (size_t index = 0; index < shares.size(); ++index) {
    auto share = shares.get<ffi::Buffer<ffi::F32>>(index);
    if (!share.has_value()) return share.error();
    frame.shares.push_back(share->typed_data());
  }
  frame.layer = layer, frame.map_layers = surface.dimensions()[3];
  frame.rule = static_cast<Rule>(rule), frame.carve = carve;
  frame.log_odds = new_log_odds->typed_data();
  frame.surface = surface.element_count() ? new_surface->typed_data() : nullptr;
  // Where XLA could not give the results the place of the arguments.
  if (frame.log_odds != log_odds.typed_data())
    std::memcpy(frame.log_odds, log_odds.typed_data(), log_odds.size_bytes());
  if (frame.surface != nullptr && frame.surface != surface.typed_data())
    std::memcpy(frame.surface, surface.typed_data(), surface.size_bytes());
  fuse(pool, frame, counted->typed_data());
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
                                  .Arg<ffi::Buffer<ffi::F32>>()   // disparity
                                  .Arg<ffi::Buffer<ffi::PRED>>()  // keep
                                  .Arg<ffi::Buffer<ffi::S32>>()   // labels
                                  .RemainingArgs()                // shares
                                  .Ret<ffi::Buffer<ffi::F32>>()
                                  .Ret<ffi::Buffer<ffi::F32>>()
                                  .Ret<ffi::Buffer<ffi::S32>>()
                                  .Attr<ffi::Span<const int64_t>>("shape")
                                  .Attr<int64_t>("layer")
                                  .Attr<bool>("carve")
                                  .Attr<int64_t>("rule"));
