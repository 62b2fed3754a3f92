// Light that surface points send to the eye under an environment map, by path tracing.
#pragma once

#include <cstdint>

#include "envmap.h"
#include "visibility.h"

namespace univoxel {

/// Which directions carry light; `mis` weighs both (Veach 1997), the others are for comparison.
enum class Strategy { mis, map, brdf };

/// Points to shade. N points, P vertices of the mesh; row-major, contiguous.
struct Relight {
    const VisibilityScene* scene;
    const float* vertex_normal;     // [P, 3] unit; these three may be null without bounces
    const float* vertex_albedo;     // [P, 3]
    const float* vertex_roughness;  // [P]
    EnvMapTables map;
    const float* position;   // [N, 3]
    const float* normal;     // [N, 3] unit
    const float* wo;         // [N, 3] unit
    const float* albedo;     // [N, 3]
    const float* roughness;  // [N]
    int64_t n_points;
    float
        offset;  // first rays start this far along the normal and pass what is as near, world units
    int samples, bounces;
    uint32_t seed;
    Strategy strategy;
};

/// rgb [N, 3]: the mean over the samples. The same bits for any number of threads.
void relight(const Relight& in, float* rgb, int threads);

}  // namespace univoxel
