// What silhouettes and depth maps of all views say of points in space.
#pragma once

#include <cstdint>

namespace univoxel {

/// N points and the V views that may show them; row-major, contiguous. A view's maps are the top
/// left part, of its own size, of [H, W].
struct ViewedPoints {
    const float* points;   // [N, 3]
    const float* matrix;   // [V, 3, 4] world to (x z, y z, z) of pixels
    const int32_t* sizes;  // [V, 2] width and height
    int64_t N, V, H, W;
};

/// Signed distance [N] to the visual hull; see univoxel/preparation/hull.py.
///
/// distance [V, H, W] to the silhouettes, pixels. uncut [V]: whether a silhouette stays clear of
/// the picture's border. focal [V], pixels.
void hull_sdf(const ViewedPoints& in, const float* distance, const uint8_t* uncut,
              const float* focal, int64_t votes, int64_t seen_by, float wider, float* sdf,
              int threads);

/// Sums [7, N] over views of what univoxel/preparation/object_shape.py's `Votes` has.
///
/// mask [V, H, W]; distance [V, H, W] along rays and known [V, H, W]; eye [V, 3].
void count_votes(const ViewedPoints& in, const float* mask, const float* distance,
                 const uint8_t* known, const float* eye, float band, float* sums, int threads);

}  // namespace univoxel
