// Spherical Gaussians from numbers without limits, as networks give them.
#pragma once

#include <cstdint>

namespace univoxel {

/// M lobes; row-major, contiguous.
template <class T>
struct RawLobes {
    const T* parameters;  // [M, 7]: three for the axis, one for the sharpness, three amplitudes
    int64_t n;
    T min_sharpness, max_sharpness;  // of what is decoded: from the one to the sum of both
};

/// axis [M, 3], sharpness [M] and amplitude [M, 3] of the lobes.
template <class T>
void decode_lobes_forward(const RawLobes<T>& in, T* axis, T* sharpness, T* amplitude, int threads);

/// Gradient [M, 7] to the parameters; recomputes what it needs.
template <class T>
void decode_lobes_backward(const RawLobes<T>& in, const T* grad_axis, const T* grad_sharpness,
                           const T* grad_amplitude, T* grad_parameters, int threads);

}  // namespace univoxel
