#include "adam.h"

#include <cmath>

#include "dcheck.h"
#include "parallel.h"

namespace univoxel {
namespace {

// Numbers of the table that a thread takes at a time: many, so that handing them out costs little.
constexpr int64_t kNumbersPerChunk = 16384;

}  // namespace

template <class T>
void adam_rows(const AdamRows<T>& in, int threads) {
    const int64_t C = in.n_channels;
    if (C == 0) return;
    DCHECK(in.step >= 1);  // or the corrections divide by 0
    const T decay1 = static_cast<T>(1 - in.beta1), decay2 = static_cast<T>(1 - in.beta2);
    const T rate = static_cast<T>(in.lr / (1 - std::pow(in.beta1, in.step)));
    const T unbias = static_cast<T>(1 / std::sqrt(1 - std::pow(in.beta2, in.step)));
    const T eps = static_cast<T>(in.eps);
    const int64_t grain = std::max<int64_t>(kNumbersPerChunk / C, 1);
    parallel_for(in.n_touched, grain, threads, [&](int64_t begin, int64_t end) {
        for (int64_t k = begin; k < end; ++k) {
            DCHECK(in.rows[k] >= 0);
            const int64_t at = in.rows[k] * C;
            T *p = in.param + at, *m = in.exp_avg + at, *v = in.exp_avg_sq + at;
            const T* g = in.grad + k * C;
#pragma omp simd
            for (int64_t c = 0; c < C; ++c) {
                m[c] += decay1 * (g[c] - m[c]);
                v[c] += decay2 * (g[c] * g[c] - v[c]);
                p[c] -= rate * m[c] / (std::sqrt(v[c]) * unbias + eps);
            }
        }
    });
}

template void adam_rows(const AdamRows<float>&, int);
template void adam_rows(const AdamRows<double>&, int);

}  // namespace univoxel
