// Work shared out over the threads of XLA.

#pragma once

#include <algorithm>
#include <atomic>
#include <condition_variable>
#include <cstdint>
#include <limits>
#include <memory>
#include <mutex>

#include "xla/ffi/api/ffi.h"

namespace jaxmap {

// Does work(0) to work(count - 1), each once and in any order, on this thread and on those of XLA that are idle.
//
// It never waits for a thread that has not begun: all of them may be waiting in the same way.
template <typename Work>
void in_parallel(xla::ffi::ThreadPool& pool, int64_t count, const Work& work,
                 int64_t most_threads = std::numeric_limits<int64_t>::max()) {
  struct Progress {
    std::atomic<int64_t> next{0};
    int64_t done = 0;
    std::mutex mutex;
    std::condition_variable all_done;
  };
  if (count <= 0) return;
  const auto progress = std::make_shared<Progress>();
  // A thread that starts late finds nothing left, and does not look at `work`, which may be gone.
  const auto take_part = [progress, count, &work] {
    int64_t own = 0;
    for (int64_t index; (index = progress->next.fetch_add(1)) < count; ++own) work(index);
    if (own == 0) return;
    std::lock_guard<std::mutex> lock(progress->mutex);
    if ((progress->done += own) == count) progress->all_done.notify_one();
  };
  const int64_t helpers = std::min({int64_t(pool.num_threads()), most_threads, count}) - 1;
  for (int64_t helper = 0; helper < helpers; ++helper) pool.Schedule([take_part] { take_part(); });
  take_part();
  std::unique_lock<std::mutex> lock(progress->mutex);
  progress->all_done.wait(lock, [&] { return progress->done == count; });
}

}  // namespace jaxmap
