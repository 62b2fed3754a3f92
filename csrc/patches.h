// Small patches of a surface, compared between photographs.
#pragma once

#include <cstdint>
#include <variant>

namespace univoxel {

/// N patches of M = side^2 pixels, each seen in K other views; row-major, contiguous.
template <class T>
struct Patches {
    std::variant<const uint16_t*, const T*> brightness;  // [V, H, W]; uint16 holds IEEE halves
    const T* projection;   // [V, 3, 4] world to (x z, y z, z) of pixels
    const T* origin;       // [N, 3] eye of the patch's own view
    const T* direction;    // [N, 3, 3] through its middle; what a column, what a row adds to it
    const T* own;          // [N, M] brightness, row by row
    const int64_t* views;  // [N, K] in [0, V)
    const T* position;     // [N, 3] a point of the patch's plane
    const T* normal;       // [N, 3] of it
    int64_t V, H, W, N, M, K;
};

/// What comes of them.
template <class T>
struct PatchResult {
    T* correlation;  // [N, K]
    uint8_t* seen;   // [N, K] 1: all pixels show brightness of at least 0
    T* pulls;        // [N, K, 6] gradient of the correlation to position and normal
};

/// noise: brightness below which a patch's variation counts little, > 0.
template <class T>
void patch_correlation(const Patches<T>& in, const PatchResult<T>& out, T noise, int threads);

}  // namespace univoxel
