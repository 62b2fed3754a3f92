// Sampling of a field along packed rays, opacity and compositing in one pass.
#pragma once

#include <cstdint>

#include "hash_grid.h"
#include "nodes.h"
#include "sample_grid.h"

namespace univoxel {

/// Numbers of a ray before its C features, and of a held sample before its.
constexpr int64_t kRayNumbers = 5;     // opacity, t, gradient
constexpr int64_t kSampleNumbers = 4;  // sdf, gradient

/// A field and packed samples along rays; see march.h. N rays, M samples; row-major, contiguous.
template <class T, class Nodes>
struct FieldRays {
    Sampling<T, Nodes> grid;  // without points; features of nodes: none where there is a hash table
    HashGrid<T> hash;         // without points; no levels: there is none
    const T* origin;          // [N, 3]
    const T* direction;       // [N, 3]
    const T* t;               // [M]
    const bool* connected;    // [M]  sample i + 1 ends the section that starts at i
    const int64_t* offsets;   // [N + 1]
    int64_t n_rays;
    T inv_s;      // sharpness of the density, 1 / world units
    T min_share;  // of a ray's heaviest sample: of lighter ones only the distance is read

    int64_t channels() const {
        return hash.levels.empty() ? grid.n_channels : hash.n_levels() * hash.n_features;
    }
};

/// Sums over the sections of rays, out [N, 5 + C]: opacity, t, gradient, features. What was read of
/// samples is held [M, 4 + C] for the way back; of light ones only the distance, else 0.
template <class T, class Nodes>
void composite_field_forward(const FieldRays<T, Nodes>& in, T* out, T* held, int threads);

/// What `composite_field_pulls` writes: how far the loss pulls at what was read of each sample.
template <class T>
struct FieldPulls {
    T* points;          // [M, 3]
    T* feature_points;  // [M, 3]  the same, or NaN where no features were read
    T* value;           // [M]
    T* gradient;        // [M, 3]
    T* feature;         // [M, C]
};

template <class T, class Nodes>
void composite_field_pulls(const FieldRays<T, Nodes>& in, const T* held, const T* grad_out,
                           const FieldPulls<T>& pulls, int threads);

}  // namespace univoxel
