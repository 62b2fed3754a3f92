// Light that surface points send to the eye under an environment map, by path tracing.
#pragma once

#include <cstdint>

#include "envmap.h"
#include "visibility.h"

namespace univoxel {

/// Which directions carry light; `mis` weighs both (Veach 1997), the others are for comparison.
enum class Strategy { mis, map, brdf };

/// Lights besides the map; row-major, contiguous.
struct Lights {
    const float* sun;  // [S, 7] unit direction to it, irradiance it is seen with, cos of its radius
    const float* lamp;  // [L, 6] position, radiant intensity
    int64_t n_suns, n_lamps;
};

/// Points to shade. N points, P vertices of the mesh; row-major, contiguous.
struct Relight {
    const VisibilityScene* scene;
    const float* vertex_normal;     // [P, 3] unit; these four may be null without bounces
    const float* vertex_albedo;     // [P, 3]
    const float* vertex_roughness;  // [P]
    const float* vertex_f0;         // [P, 3]
    EnvMapTables map;
    Lights lights;
    const float* position;   // [N, 3]
    const float* normal;     // [N, 3] unit
    const float* wo;         // [N, 3] unit
    const float* albedo;     // [N, 3]
    const float* roughness;  // [N]
    const float* f0;         // [N, 3]
    int64_t n_points;
    // First rays start this far along the normal and pass what is as near, world units.
    float offset;
    uint32_t first;  // number of the first sample; calls that go on share one sequence
    int samples, bounces;
    uint32_t seed;
    Strategy strategy;
};

/// rgb [N, 3]: the mean over the samples. The same bits for any number of threads.
void relight(const Relight& in, float* rgb, int threads);

}  // namespace univoxel
