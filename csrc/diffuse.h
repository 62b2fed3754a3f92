// Diffusion among chosen nodes of a grid, such as of a sparse gradient before the optimiser's step.
#pragma once

#include <cstdint>

#include "nodes.h"

namespace univoxel {

/// values [n] of the nodes at ascending rows [n] of a grid that is 0 elsewhere, in place, passes
/// times: f += amount (mean of the six neighbours - f); the border repeats.
template <class T>
void diffuse_rows(T* values, const int64_t size[3], const int64_t* rows, int64_t n, T amount,
                  int passes, int threads);

/// The same for a sparse grid; arguments as in smooth_brick_rows.
template <class T>
void diffuse_brick_rows(T* values, const int64_t size[3], const BrickNodes& nodes,
                        const int32_t* place, int64_t n_rows, const int64_t* rows, int64_t n,
                        T amount, int passes, int threads);

}  // namespace univoxel
