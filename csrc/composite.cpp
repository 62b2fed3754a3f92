#include "composite.h"

#include <algorithm>
#include <vector>

#include "channels.h"
#include "dcheck.h"
#include "huge_pages.h"
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

template <int64_t kC, class T>
void forward_ray(const Composite<T>& in, int64_t ray, T* out, T* weight) {
    const int64_t C = kC ? kC : in.n_channels;
    const int64_t first = in.offsets[ray], n = in.offsets[ray + 1] - first;
    DCHECK(first >= 0 && n >= 0);  // offsets rise
    const T* alpha = in.alpha + first;
    const T* value = in.value + first * C;
    T *sum = out + ray * C, *w = weight + first;
    const int64_t used = transmittance(alpha, n, in.early_stop, w);
    // Sums of a known width stay in registers: the compiler cannot know that `out` is not `value`.
    T registers[kC ? kC : 1] = {};
    T* s = kC ? registers : sum;
    if (!kC) std::fill(sum, sum + C, T(0));
    for (int64_t i = 0; i < used; ++i) {
        const T wi = w[i] * alpha[i];
        w[i] = wi;
#pragma omp simd
        for (int64_t c = 0; c < C; ++c) s[c] += wi * value[i * C + c];
    }
    if (kC) std::copy(registers, registers + kC, sum);
    std::fill(w + used, w + n, T(0));
}

/// `trans` and `own` are scratch of the ray's length.
template <int64_t kC, class T>
void backward_ray(const Composite<T>& in, int64_t ray, const T* grad_out, const T* grad_weight,
                  T* grad_alpha, T* grad_value, T* trans, T* own) {
    const int64_t C = kC ? kC : in.n_channels;
    const int64_t first = in.offsets[ray], n = in.offsets[ray + 1] - first;
    DCHECK(first >= 0 && n >= 0);  // offsets rise
    const T *alpha = in.alpha + first, *value = in.value + first * C, *g = grad_out + ray * C;
    T *ga = grad_alpha + first, *gv = grad_value + first * C;
    const int64_t used = transmittance(alpha, n, in.early_stop, trans);
    for (int64_t i = 0; i < used; ++i) {
        const T w = alpha[i] * trans[i];
        T sum = 0;
#pragma omp simd reduction(+ : sum)
        for (int64_t c = 0; c < C; ++c) {
            sum += g[c] * value[i * C + c];
            gv[i * C + c] = w * g[c];
        }
        own[i] = sum + grad_weight[first + i];
    }
    T behind = 0;
    for (int64_t i = used - 1; i >= 0; --i) {
        ga[i] = trans[i] * (own[i] - behind);
        behind = alpha[i] * own[i] + (1 - alpha[i]) * behind;
    }
    std::fill(ga + used, ga + n, T(0));
    std::fill(gv + used * C, gv + n * C, T(0));
}

}  // namespace

template <class T>
void composite_forward(const Composite<T>& in, T* out, T* weight, int threads) {
    with_channels(in.n_channels, [&](auto constant) {
        constexpr int64_t kC = decltype(constant)::value;
        parallel_for(in.n_rays, kRaysPerChunk, threads, [&](int64_t begin, int64_t end) {
            for (int64_t ray = begin; ray < end; ++ray) forward_ray<kC>(in, ray, out, weight);
        });
    });
}

// With g_i = grad_out . value_i + grad_weight_i and B_i the g composited behind sample i,
//   dL/dalpha_i = T_i (g_i - B_i),   B_{i-1} = alpha_i g_i + (1 - alpha_i) B_i,
// walked back to front: no division, so alpha = 1 stays exact. See docs/method/gradients.md.
template <class T>
void composite_backward(const Composite<T>& in, const T* grad_out, const T* grad_weight,
                        T* grad_alpha, T* grad_value, int threads) {
    const int64_t samples = in.offsets[in.n_rays];
    want_huge_pages(grad_value, samples * in.n_channels * static_cast<int64_t>(sizeof(T)));
    with_channels(in.n_channels, [&](auto constant) {
        constexpr int64_t kC = decltype(constant)::value;
        parallel_for(in.n_rays, kRaysPerChunk, threads, [&](int64_t begin, int64_t end) {
            int64_t longest = 0;
            for (int64_t ray = begin; ray < end; ++ray)
                longest = std::max(longest, in.offsets[ray + 1] - in.offsets[ray]);
            std::vector<T> scratch(2 * longest);
            T *trans = scratch.data(), *own = trans + longest;
            for (int64_t ray = begin; ray < end; ++ray)
                backward_ray<kC>(in, ray, grad_out, grad_weight, grad_alpha, grad_value, trans,
                                 own);
        });
    });
}

template void composite_forward(const Composite<float>&, float*, float*, int);
template void composite_forward(const Composite<double>&, double*, double*, int);
template void composite_backward(const Composite<float>&, const float*, const float*, float*,
                                 float*, int);
template void composite_backward(const Composite<double>&, const double*, const double*, double*,
                                 double*, int);

}  // namespace univoxel
