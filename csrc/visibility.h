// Rays against a triangle mesh. Embree stands behind this interface, in visibility.cpp alone.
#pragma once

#include <cstdint>
#include <limits>
#include <memory>

#include "common.h"

namespace univoxel {

/// The nearest triangle along a ray; the point is (1 - u - v) p0 + u p1 + v p2.
struct Hit {
    float t;             // distance in units of the ray's direction; infinity: nothing met
    float u, v;          // barycentric coordinates of the second and third corner
    int64_t face;        // -1: nothing met
    vec3<float> normal;  // of the triangle by its winding, not unit
};

/// Rays as columns of n numbers.
struct RayStream {
    const float *ox, *oy, *oz, *dx, *dy, *dz;
    float t_min;
    int n;
};

/// Major version of the Embree behind this build, 0 where it was built without.
int embree_version();

/// A mesh ready for rays. Any number of threads may ask at once.
class VisibilityScene {
  public:
    /// vertices [P, 3], faces [F, 3] with indices in 0 .. P - 1; both are copied. Builds on
    /// `threads` threads. Throws std::runtime_error where Embree is missing or fails.
    VisibilityScene(const float* vertices, int64_t n_vertices, const int32_t* faces,
                    int64_t n_faces, int threads);
    ~VisibilityScene();

    /// Whether a triangle lies at t in [t_min, t_max]. A ray that is not finite, or as
    /// far out as 1e18, meets none.
    bool occluded(const vec3<float>& origin, const vec3<float>& direction, float t_min,
                  float t_max = std::numeric_limits<float>::infinity()) const;

    Hit closest_hit(const vec3<float>& origin, const vec3<float>& direction, float t_min,
                    float t_max = std::numeric_limits<float>::infinity()) const;

    /// The same for many rays at once, several in step: the nearer neighbours lie, the faster.
    /// `distance` [n] holds t_max, out [n].
    void occluded(const RayStream& rays, const float* distance, uint8_t* out) const;

    void closest_hit(const RayStream& rays, Hit* out) const;

    const int32_t* faces() const;  // [F, 3]

  private:
    struct Impl;
    std::unique_ptr<Impl> impl_;
};

/// Rays of one batch. N rays; row-major, contiguous.
struct RayBatch {
    const float* origin;     // [N, 3]
    const float* direction;  // [N, 3]
    int64_t n_rays;
    float t_min, t_max;  // in units of the direction
};

/// out [N]
void occluded(const VisibilityScene& scene, const RayBatch& rays, bool* out, int threads);

/// t [N] (infinity: nothing met), face [N] (-1), barycentric [N, 2] (0)
void closest_hit(const VisibilityScene& scene, const RayBatch& rays, float* t, int64_t* face,
                 float* barycentric, int threads);

}  // namespace univoxel
