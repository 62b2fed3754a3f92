// Reflection of light given as spherical Gaussians, by quadrature over the half-sphere.
#pragma once

#include <cstdint>

namespace univoxel {

/// Buffers of one shading pass. N points, K lobes a point, D directions; row-major, contiguous.
template <class T>
struct ShadeSG {
    const T* axis;        // [N, K, 3] unit, world
    const T* sharpness;   // [N, K]    >= 0
    const T* amplitude;   // [N, K, 3] linear radiance
    const T* normal;      // [N, 3]    unit, world
    const T* wo;          // [N, 3]    unit, world, to the eye
    const T* albedo;      // [N, 3]    linear
    const T* roughness;   // [N]       in [0, 1]
    const T* directions;  // [D, 3]    unit, around +Z
    const T* rotation;    // [N]       radians about +Z
    const T* f0;          // [N, 3]    reflectance at normal incidence, if colored; else [1]
    int64_t n_points, n_lobes, n_directions;
    bool colored;
};

/// Where the gradients go: the shapes of ShadeSG; that to f0 is written if it is colored.
template <class T>
struct ShadeSGGrad {
    T *axis, *sharpness, *amplitude, *normal, *wo, *albedo, *roughness, *f0;
};

/// rgb [N, 3] = (2 pi / D) sum_d L(w_d) f(w_d, wo) max(n.w_d, 0).
template <class T>
void shade_sg_forward(const ShadeSG<T>& in, T* rgb, int threads);

/// Recomputes what it needs; stores nothing between the passes.
template <class T>
void shade_sg_backward(const ShadeSG<T>& in, const T* grad_rgb, const ShadeSGGrad<T>& grad,
                       int threads);

}  // namespace univoxel
