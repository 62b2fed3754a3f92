#include "composite.h"

#include <algorithm>
#include <vector>

#include "parallel.h"

namespace univoxel {
namespace {

constexpr int64_t kRaysPerChunk = 256;

/// Write the transmittance in front of each sample of one ray; return how many samples count.
template <class T>
int64_t transmittance(const T* alpha, int64_t n, T early_stop, T* trans) {
    T t = 1;
    for (int64_t i = 0; i < n; ++i) {
        if (t < early_stop) return i;
        trans[i] = t;
        t *= 1 - alpha[i];
    }
    return n;
}

}  // namespace

template <class T>
void composite_forward(const Composite<T>& in, T* out, T* weight, int threads) {
    const int64_t C = in.n_channels;
    parallel_for(in.n_rays, kRaysPerChunk, threads, [&](int64_t begin, int64_t end) {
        for (int64_t ray = begin; ray < end; ++ray) {
            const int64_t first = in.offsets[ray], n = in.offsets[ray + 1] - first;
            T* sum = out + ray * C;
            T* w = weight + first;
            std::fill(sum, sum + C, T(0));
            const int64_t used = transmittance(in.alpha + first, n, in.early_stop, w);
            for (int64_t i = 0; i < used; ++i) {
                w[i] *= in.alpha[first + i];
                const T* v = in.value + (first + i) * C;
#pragma omp simd
                for (int64_t c = 0; c < C; ++c) sum[c] += w[i] * v[c];
            }
            std::fill(w + used, w + n, T(0));
        }
    });
}

// With g_i = grad_out . value_i + grad_weight_i and B_i the g composited behind sample i,
//   dL/dalpha_i = T_i (g_i - B_i),   B_{i-1} = alpha_i g_i + (1 - alpha_i) B_i,
// walked back to front: no division, so alpha = 1 stays exact. See docs/derivations/composite.md.
template <class T>
void composite_backward(const Composite<T>& in, const T* grad_out, const T* grad_weight,
                        T* grad_alpha, T* grad_value, int threads) {
    const int64_t C = in.n_channels;
    parallel_for(in.n_rays, kRaysPerChunk, threads, [&](int64_t begin, int64_t end) {
        std::vector<T> trans;
        for (int64_t ray = begin; ray < end; ++ray) {
            const int64_t first = in.offsets[ray], n = in.offsets[ray + 1] - first;
            trans.resize(std::max<int64_t>(n, static_cast<int64_t>(trans.size())));
            const int64_t used = transmittance(in.alpha + first, n, in.early_stop, trans.data());
            const T* g = grad_out + ray * C;
            T behind = 0;
            for (int64_t i = used - 1; i >= 0; --i) {
                const int64_t s = first + i;
                const T a = in.alpha[s], w = a * trans[i];
                const T* v = in.value + s * C;
                T* gv = grad_value + s * C;
                T own = grad_weight[s];
#pragma omp simd reduction(+ : own)
                for (int64_t c = 0; c < C; ++c) {
                    own += g[c] * v[c];
                    gv[c] = w * g[c];
                }
                grad_alpha[s] = trans[i] * (own - behind);
                behind = a * own + (1 - a) * behind;
            }
            std::fill(grad_alpha + first + used, grad_alpha + first + n, T(0));
            std::fill(grad_value + (first + used) * C, grad_value + (first + n) * C, T(0));
        }
    });
}

template void composite_forward(const Composite<float>&, float*, float*, int);
template void composite_forward(const Composite<double>&, double*, double*, int);
template void composite_backward(const Composite<float>&, const float*, const float*, float*,
                                 float*, int);
template void composite_backward(const Composite<double>&, const double*, const double*, double*,
                                 double*, int);

}  // namespace univoxel
