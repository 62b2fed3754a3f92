// Smoothing of grids at chosen nodes, as a decoupled regulariser after an optimiser step.
#pragma once

#include <cstdint>

#include "nodes.h"

namespace univoxel {

/// grid [X, Y, Z, C] in place at flat node indices rows [K]; all is computed from the grid as it
/// was before. With L f = mean of the six neighbours - f (the border repeats):
///   order 1: f += amount L f       diffusion, pulls towards the neighbours' mean
///   order 2: f -= amount L L f     thin plate, leaves linear functions alone
template <class T>
void smooth_rows(T* grid, const int64_t size[3], int64_t channels, const int64_t* rows, int64_t n,
                 T amount, int order, int threads);

/// The same for a sparse grid [R, C], size its nodes along each axis: `place` [R / 64] tells where
/// in the table a brick stands. Neighbours in missing bricks are as bricks 0 and 1 say. Rows are
/// none of these two; in ascending order they are fastest.
template <class T>
void smooth_brick_rows(T* grid, const int64_t size[3], const BrickNodes& nodes,
                       const int32_t* place, int64_t channels, const int64_t* rows, int64_t n,
                       T amount, int order, int threads);

}  // namespace univoxel
