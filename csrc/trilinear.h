// Where a point falls in a lattice of nodes, and the weights of the nodes around it.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>

#include "dcheck.h"

namespace univoxel {

/// Node (i, j, k) lies at origin + voxel_size * (i, j, k). Outside, the nearest border value holds.
struct Lattice {
    int64_t size[3];  // X, Y, Z: at least 1 each
    double origin[3];
    double per_voxel;  // 1 / voxel_size
};

/// Place of a point along one axis, between the nodes cell and cell + 1.
struct Place {
    int64_t cell;  // in [0, max(size - 2, 0)], whatever the point
    double t;      // in [0, 1]
    bool inside;   // false where the point was clamped or there is one node: t stays as it moves
};

/// In double, so that a float32 point far from the origin keeps its fraction. NaN gives cell 0.
inline Place place(const Lattice& grid, int axis, double x) {
    const double p = (x - grid.origin[axis]) * grid.per_voxel;
    const double last = static_cast<double>(grid.size[axis] - 1);
    const double u = std::min(std::max(0.0, p), last);  // max(0, NaN) is 0
    const int64_t cell =
        std::min<int64_t>(static_cast<int64_t>(u), std::max<int64_t>(grid.size[axis] - 2, 0));
    const double t = u - static_cast<double>(cell);
    DCHECK(cell >= 0 && cell < grid.size[axis] && t >= 0 && t <= 1);
    return {cell, t, p >= 0 && p <= last && last > 0};
}

template <class T>
inline bool has_nan(const T* point) {
    return std::isnan(point[0]) || std::isnan(point[1]) || std::isnan(point[2]);
}

/// The four nodes around a place and their weights along one axis, in world units.
///
/// `value` interpolates linearly between the middle two. `slope` interpolates linearly the central
/// differences at these two: the central difference of the interpolant with a step of one voxel.
template <class T>
struct Stencil {
    int64_t node[4];  // cell - 1 .. cell + 2, clamped to the lattice
    T value[4];       // {0, 1 - t, t, 0}
    T slope[4];       // {t - 1, -t, 1 - t, t} / (2 h)
};

template <class T>
inline Stencil<T> stencil(const Lattice& grid, int axis, const Place& at) {
    Stencil<T> s;
    const int64_t last = grid.size[axis] - 1;
    for (int64_t a = 0; a < 4; ++a) {
        s.node[a] = std::min(std::max<int64_t>(at.cell - 1 + a, 0), last);
    }
    const T t = static_cast<T>(at.t), u = static_cast<T>(1 - at.t);
    const T half = static_cast<T>(0.5 * grid.per_voxel);
    s.value[0] = 0, s.value[1] = u, s.value[2] = t, s.value[3] = 0;
    s.slope[0] = -half * u, s.slope[1] = -half * t, s.slope[2] = half * u, s.slope[3] = half * t;
    DCHECK(std::abs(s.value[1] + s.value[2] - 1) < T(1e-6));
    DCHECK(s.node[0] >= 0 && s.node[0] <= s.node[1] && s.node[1] <= s.node[2]);
    return s;
}

template <class T>
struct Stencil3 {
    Stencil<T> x, y, z;
};

template <class T>
inline Stencil3<T> stencil3(const Lattice& grid, const T* p) {
    return {stencil<T>(grid, 0, place(grid, 0, static_cast<double>(p[0]))),
            stencil<T>(grid, 1, place(grid, 1, static_cast<double>(p[1]))),
            stencil<T>(grid, 2, place(grid, 2, static_cast<double>(p[2])))};
}

/// Derivatives of a stencil's weights to the point, in world units; 0 where it is clamped.
template <class T>
struct StencilStep {
    T value[4], slope[4];
};

template <class T>
inline StencilStep<T> stencil_step(const Lattice& grid, const Place& at) {
    const T step = at.inside ? static_cast<T>(grid.per_voxel) : T(0);
    const T bend = step * static_cast<T>(0.5 * grid.per_voxel);
    return {{0, -step, step, 0}, {bend, -bend, -bend, bend}};
}

}  // namespace univoxel
