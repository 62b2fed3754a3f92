// Rays through an SDF grid -> the few samples that matter. Not differentiable.
#pragma once

#include <cstdint>
#include <vector>

#include "common.h"
#include "nodes.h"

namespace univoxel {

inline int64_t bricks_along(int64_t nodes) {
    return std::max<int64_t>(1, (nodes - 2) / kBrick + 1);
}

/// An SDF on a grid and the rays through it. Grid X x Y x Z, N rays; row-major, contiguous.
template <class T>
struct March {
    const T* sdf;        // [X, Y, Z], or [R]: world units, negative inside
    const T* brick_min;  // [bricks_along(X), .. (Y), .. (Z)], or [R / 64]: least sdf in a brick
    const T* origin;     // [N, 3]
    const T* direction;  // [N, 3] unit
    const T* jitter;     // [N] in [0, 1): where in its first step a ray starts
    int64_t size[3], n_rays;
    vec3<T> grid_origin;             // node (0, 0, 0)
    T voxel_size;                    // world units
    T step;                          // distance of samples, world units
    T inv_s;                         // sharpness of the NeuS density, 1 / world units
    T min_weight;                    // sections that weigh less are left out
    T early_stop;                    // a ray ends where its transmittance falls below this
    const int32_t* table = nullptr;  // [A, B, C] of BrickNodes; null: the grid is dense
    int64_t bricks_y = 0, bricks_z = 0;

    DenseNodes dense() const { return {size[1], size[2]}; }
    BrickNodes sparse() const { return {table, bricks_y, bricks_z}; }
};

/// Packed samples; see core/records.py. Sample i starts a section when connected[i] is 1.
template <class T>
struct PackedSamples {
    std::vector<T> t;
    std::vector<uint8_t> connected;
    std::vector<int64_t> offsets;
};

template <class T>
void brick_minimum(const T* sdf, const int64_t size[3], T* out, int threads);

/// The same for the bricks of a sparse grid: `place` [n] tells where in the table a brick stands.
/// Missing bricks have nothing to see: infinity outside, minus infinity inside.
template <class T>
void sparse_brick_minimum(const T* sdf, const int64_t size[3], const BrickNodes& nodes,
                          const int32_t* place, int64_t n, T* out, int threads);

template <class T>
PackedSamples<T> march(const March<T>& in, int threads);

}  // namespace univoxel
