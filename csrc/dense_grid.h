// Sampling of a dense grid [X, Y, Z]; see sample_grid.h.
#pragma once

#include "sample_grid.h"

namespace univoxel {

template <class T>
using DenseGrid = Sampling<T, DenseNodes>;

template <class T>
using DenseGridGrads = SamplingGrads<T, TouchedRows>;

template <class T>
void sample_grid_forward(const DenseGrid<T>& in, T* value, T* gradient, T* feature, int threads);

template <class T>
void sample_grid_backward(const DenseGrid<T>& in, const DenseGridGrads<T>& grads, int threads);

}  // namespace univoxel
