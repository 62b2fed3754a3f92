// The one way kernels use threads.
#pragma once

#include <algorithm>
#include <atomic>
#include <cstdint>
#include <exception>

#include "dcheck.h"

#ifdef UNIVOXEL_STD_THREADS
#include <thread>
#include <vector>
#endif

namespace univoxel {

/// Call f(c) for each c in [0, n), one after another as threads are free. f must not throw.
///
/// With UNIVOXEL_STD_THREADS the team is one of std::thread, dealt out in turns: the thread
/// sanitizer follows those, not OpenMP's runtime, and sees races of threads that had any work.
template <class F>
void share_out(int64_t n, [[maybe_unused]] int team, F&& f) {
#ifdef UNIVOXEL_STD_THREADS
    const auto work = [&](int64_t first) {
        for (int64_t c = first; c < n; c += team) f(c);
    };
    std::vector<std::thread> others;
    for (int i = 1; i < team; ++i) others.emplace_back(work, i);
    work(0);
    for (std::thread& other : others) other.join();
#else
#pragma omp parallel for schedule(dynamic, 1) num_threads(team)
    for (int64_t c = 0; c < n; ++c) f(c);
#endif
}

/// Call f(begin, end) over [0, n) in chunks of `grain`, on up to `threads` threads.
///
/// Chunk bounds depend on n and grain alone, never on the thread count: a kernel whose chunks
/// write to disjoint places gives the same bits for any number of threads. Work of a single
/// chunk runs serially: a thread team costs more than it brings there. The first exception
/// leaves the parallel region and is thrown in the caller.
///
/// Memory order, for processors that reorder writes, as ARM does: chunks share nothing but
/// `failed`, a hint that orders nothing, and `error`, which one thread writes and the caller reads
/// behind the end of the region. Its barrier, or the join of each thread, releases all that the
/// threads wrote.
template <class F>
void parallel_for(int64_t n, int64_t grain, int threads, F&& f) {
    DCHECK(n >= 0 && grain > 0);
    const int64_t chunks = (n + grain - 1) / grain;
    const int team = static_cast<int>(std::min<int64_t>(chunks, threads));
    if (team <= 1) {
        for (int64_t c = 0; c < chunks; ++c) f(c * grain, std::min(n, (c + 1) * grain));
        return;
    }
    std::exception_ptr error;
    std::atomic<bool> failed{false};
    share_out(chunks, team, [&](int64_t c) {
        if (failed.load(std::memory_order_relaxed)) return;
        try {
            f(c * grain, std::min(n, (c + 1) * grain));
        } catch (...) {
            if (!failed.exchange(true)) error = std::current_exception();
        }
    });
    if (error) std::rethrow_exception(error);
}

}  // namespace univoxel
