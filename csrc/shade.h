// Reflection of light given on fixed directions of the sphere.
#pragma once

#include <cstdint>
#include <variant>

namespace univoxel {

/// Buffers of one shading pass. N samples, D directions; row-major, contiguous.
template <class T>
struct Shade {
    const T* normal;      // [N, 3] unit, world
    const T* wo;          // [N, 3] unit, world, to the eye
    const T* albedo;      // [N, 3] linear
    const T* roughness;   // [N]    in [0, 1]
    const T* directions;  // [D, 3] unit, world
    const T* f0;          // [N, 3] reflectance at normal incidence, if colored; else [1]
    int64_t n_samples, n_directions;
    T solid_angle;  // of each direction, steradians
    bool colored;
};

/// One map of radiance seen by P points: radiance_nd = visibility map_d + indirect, row index_n.
template <class T>
struct MapLight {
    const T* map;                                       // [D, 3] linear radiance
    std::variant<const uint8_t*, const T*> visibility;  // [P, D] fraction; bytes mean x / 255
    std::variant<const uint16_t*, const T*> indirect;   // [P, D, 3]; uint16 holds IEEE halves
    const int64_t* index;                               // [N] in [0, P)
};

/// Where the gradients go. Light ([N, D, 3] or [D, 3]) and normal may be null: nobody asks. That to
/// f0 is written if it is colored.
template <class T>
struct ShadeGrad {
    T *light, *normal, *albedo, *roughness, *f0;
};

/// response [N, D] = solid_angle D F V max(n.w_d, 0), the specular layer alone for F0 = *f0; albedo
/// may be null.
template <class T>
void specular_response(const Shade<T>& in, T* response, int threads);

/// rgb [N, 3] = solid_angle sum_d radiance_nd f(w_d, wo_n) max(n.w_d, 0); radiance [N, D, 3].
template <class T>
void shade_radiance_forward(const Shade<T>& in, const T* radiance, T* rgb, int threads);

/// Recomputes what it needs; stores nothing between the passes.
template <class T>
void shade_radiance_backward(const Shade<T>& in, const T* radiance, const T* grad_rgb,
                             const ShadeGrad<T>& grad, int threads);

template <class T>
void shade_map_forward(const Shade<T>& in, const MapLight<T>& light, T* rgb, int threads);

template <class T>
void shade_map_backward(const Shade<T>& in, const MapLight<T>& light, const T* grad_rgb,
                        const ShadeGrad<T>& grad, int threads);

}  // namespace univoxel
