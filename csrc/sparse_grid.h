// Sampling of a grid of which only bricks around a surface are stored; see sample_grid.h.
#pragma once

#include "sample_grid.h"

namespace univoxel {

template <class T>
using SparseGrid = Sampling<T, BrickNodes>;

template <class T>
using SparseGridGrads = SamplingGrads<T, RowSet>;

template <class T>
void sample_grid_forward(const SparseGrid<T>& in, T* value, T* gradient, T* feature, int threads);

template <class T>
void sample_grid_backward(const SparseGrid<T>& in, const SparseGridGrads<T>& grads, int threads);

}  // namespace univoxel
