// The texels of a texture: which triangle each lies in, and what photographs say of its albedo.
#pragma once

#include <cstdint>

namespace univoxel {

/// K texels of a mesh's texture, and one photograph; row-major, contiguous. See
/// univoxel/ops/charts.py.
struct Texels {
    const int32_t* face;          // [K]
    const uint16_t* barycentric;  // [K, 2] halves: weights of the second and third corner
    const int32_t* corners;       // [F, 3] rows of `values`
    const uint8_t* shown;         // [F] whether the photograph shows a face
    const float* values;          // [P, 13] A, B, place, albedo, weight
    const float* matrix;          // [3, 4] world to (x z, y z, z) of the mask's pixels
    const float* mask;            // [h, w]
    const float* linear;          // [256] of the picture's bytes
    int64_t K, H, W, h, w;
    float scale;  // pixels of the picture in one of the mask
    float clipped, of_clipped;
};

/// Adds the albedo at each texel, times what it is trusted, to total [K, 3], and that to weights
/// [K]. The picture is [H, W, 3], sRGB bytes or linear.
template <class Stored>
void add_photograph(const Texels& in, const Stored* picture, float* total, float* weights,
                    int threads);

/// Linear colours [N, 3] of a picture [H, W, 3], sRGB bytes or linear, at places [N, 2] in pixels;
/// `linear` is [256] of the bytes. Bilinear; beyond the border lies the border.
template <class Stored>
void sample_picture(const Stored* picture, int64_t H, int64_t W, const float* linear,
                    const float* place, int64_t N, float* colors, int threads);

/// Which face holds the centre of each texel of a texture's rows [top, top + rows); the last of
/// several, -1 where none does.
///
/// owner [rows, size]; barycentric [rows, size, 2], weights of the second and third corner.
void rasterise(const float* uv, const int32_t* faces, int64_t F, int64_t size, int64_t top,
               int64_t rows, int32_t* owner, float* barycentric);

}  // namespace univoxel
