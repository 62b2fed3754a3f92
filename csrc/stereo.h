// Depth from photographs: how well pixels agree at depths along their rays, and the depths that
// neighbours agree on.
#pragma once

#include <cstdint>

namespace univoxel {

/// Arguments of match_cost; see univoxel/ops/patches.py.
struct Match {
    const int32_t* pictures;  // [V, H, W] colour times coverage, coverage: bytes, red the lowest
    const float* matrix;      // [V, 3, 4] world to (x z, y z, z) of pixels
    const float* origin;      // [N, 3]
    const float* direction;   // [N, 3]
    const float* start;       // [N]
    const float* color;       // [N, 3] what the pixels show
    const int64_t* rows;      // [H, W] which of the N rays is a pixel's; -1: none
    const int64_t* others;    // [M] views to compare with
    int64_t H, W, N, M, steps;
    float step, most;
    int64_t radius, best;
};

/// cost [N, steps].
void match_cost(const Match& in, float* cost, int threads);

/// Sums [N, steps] of the least costs along the four straight paths to each pixel.
void semi_global(const float* cost, const int64_t* rows, int64_t H, int64_t W, int64_t N,
                 int64_t steps, float small, float large, float* sum, int threads);

}  // namespace univoxel
