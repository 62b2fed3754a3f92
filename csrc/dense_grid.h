// Sampling of a dense grid: distance, its spatial gradient and features at points.
#pragma once

#include <cstdint>

#include "bricks.h"
#include "trilinear.h"

namespace univoxel {

/// Buffers of one sampling pass. M samples, C channels; row-major, contiguous.
template <class T>
struct DenseGrid {
    const T* sdf;          // [X, Y, Z]
    const T* features;     // [X, Y, Z, C]
    const T* points;       // [M, 3]  world; outside the lattice they are clamped to its border
    const int32_t* order;  // [M]     from sort_by_brick
    Lattice lattice;
    int64_t n_points, n_channels;
};

/// value [M] and feature [M, C] by trilinear interpolation; gradient [M, 3] by trilinear
/// interpolation of the nodes' central differences. NaN at NaN points.
template <class T>
void sample_dense_forward(const DenseGrid<T>& in, T* value, T* gradient, T* feature, int threads);

/// Incoming gradients of a pass, and where to write the outgoing ones; null: not wanted.
template <class T>
struct DenseGridGrads {
    const T* grad_value;              // [M]
    const T* grad_gradient;           // [M, 3]
    const T* grad_feature;            // [M, C]
    T* grad_sdf;                      // [X, Y, Z], or [sdf_rows->count()]
    T* grad_features;                 // [X, Y, Z, C], or [feature_rows->count(), C]
    T* grad_points;                   // [M, 3]
    const TouchedRows* sdf_rows;      // null: dense
    const TouchedRows* feature_rows;  // null: dense
};

template <class T>
void sample_dense_backward(const DenseGrid<T>& in, const DenseGridGrads<T>& grads, int threads);

}  // namespace univoxel
