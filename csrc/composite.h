// Volume-render compositing along packed rays.
#pragma once

#include <cstdint>

namespace univoxel {

/// Buffers of one compositing pass. N rays, M samples, C channels; row-major, contiguous.
template <class T>
struct Composite {
    const T* alpha;          // [M]      opacity, in [0, 1]
    const T* value;          // [M, C]
    const int64_t* offsets;  // [N + 1]  ray n owns samples offsets[n] .. offsets[n + 1]
    int64_t n_rays, n_channels;
    T early_stop;  // a ray ends where its transmittance falls below this; 0 never ends early
};

/// out [N, C] and weight [M]: weight_i = alpha_i prod_{j<i} (1 - alpha_j), out = sum weight value.
template <class T>
void composite_forward(const Composite<T>& in, T* out, T* weight, int threads);

template <class T>
void composite_backward(const Composite<T>& in, const T* grad_out, const T* grad_weight,
                        T* grad_alpha, T* grad_value, int threads);

}  // namespace univoxel
