#include "texels.h"

#include <algorithm>
#include <cmath>

#include "half.h"
#include "parallel.h"

namespace univoxel {
namespace {

constexpr int64_t kTexelsPerChunk = 8192;
constexpr float kInside = 0.95f;  // of the mask, from which on a pixel is the object's
constexpr float kLeastLight = 1e-3f, kLeastAlbedo = 1e-4f, kTiny = 1e-6f;

inline float luminance(const float* c) {
    return 0.2126f * c[0] + 0.7152f * c[1] + 0.0722f * c[2];
}

inline float clip(float x) {
    return std::min(std::max(x, 0.f), 1.f);
}

inline float number(uint8_t stored, const float* linear) {
    return linear[stored];
}
inline float number(float stored, const float*) {
    return stored;
}

/// The four pixels around a place, and what each counts. Beyond the border lies the border.
struct Corners {
    int64_t at[4];
    float weight[4];

    Corners(float x, float y, int64_t width, int64_t height) {
        // A place that is no number, or far off, is the corner
        const float i = std::floor(x - 0.5f), j = std::floor(y - 0.5f);
        const float u = x - 0.5f - i, v = y - 0.5f - j;
        const int64_t left = index(i, width), right = index(i + 1, width);
        const int64_t top = index(j, height) * width, bottom = index(j + 1, height) * width;
        at[0] = top + left, at[1] = top + right, at[2] = bottom + left, at[3] = bottom + right;
        weight[0] = (1 - u) * (1 - v), weight[1] = u * (1 - v);
        weight[2] = (1 - u) * v, weight[3] = u * v;
    }

    static int64_t index(float x, int64_t n) {
        return x > 0 ? (x < static_cast<float>(n - 1) ? static_cast<int64_t>(x) : n - 1) : 0;
    }
};

template <class Stored>
inline void sample(const Stored* picture, const Corners& around, const float* linear,
                   float* color) {
    for (int c = 0; c < 3; ++c) color[c] = 0;
    for (int i = 0; i < 4; ++i) {
        const Stored* stored = picture + 3 * around.at[i];
        for (int c = 0; c < 3; ++c) color[c] += around.weight[i] * number(stored[c], linear);
    }
}

/// Values [13] at a texel; false where the photograph does not show it.
inline bool between_corners(const Texels& in, int64_t k, float* out) {
    const int64_t face = in.face[k];
    if (!in.shown[face]) return false;
    const float b = from_half(in.barycentric[2 * k]), c = from_half(in.barycentric[2 * k + 1]);
    const int32_t* corner = in.corners + 3 * face;
    const float *first = in.values + 13 * corner[0], *second = in.values + 13 * corner[1],
                *third = in.values + 13 * corner[2];
    for (int i = 0; i < 13; ++i) {
        out[i] = (1 - b - c) * first[i] + b * second[i] + c * third[i];
    }
    return out[12] > 0;
}

/// Add what one photograph's colour says of the albedo.
inline void add(const float* color, const float* at, const Texels& in, float* total,
                float* weight) {
    const float *a = at, *b = at + 3, *albedo = at + 9;
    float model[3], both[3], value[3];
    float least = 1, most = 0;
    for (int i = 0; i < 3; ++i) {
        model[i] = a[i] * albedo[i], both[i] = model[i] + b[i];
        const float own = model[i] / std::max(both[i], kTiny);
        least = i ? std::min(least, own) : own, most = i ? std::max(most, own) : own;
        value[i] = clip((color[i] - b[i]) / std::max(a[i], kLeastLight));
    }
    const bool clipped = std::max({color[0], color[1], color[2]}) >= in.clipped;
    const float share = luminance(model) / std::max(luminance(both), kTiny);
    const float trusted = at[12] * luminance(a) * (clipped ? in.of_clipped : 1.f) * share * share;
    const float ratio = least / std::max(most, kTiny), even = ratio * ratio;
    const float bright = luminance(value) / std::max(luminance(albedo), kLeastAlbedo);
    for (int i = 0; i < 3; ++i) {
        const float gray = clip(albedo[i] * bright);
        total[i] += trusted * (gray + even * (value[i] - gray));
    }
    *weight += trusted;
}

}  // namespace

template <class Stored>
void add_photograph(const Texels& in, const Stored* picture, float* total, float* weights,
                    int threads) {
    const float* m = in.matrix;
    parallel_for(in.K, kTexelsPerChunk, threads, [&](int64_t begin, int64_t end) {
        for (int64_t k = begin; k < end; ++k) {
            float at[13], pixel[3], color[3];
            if (!between_corners(in, k, at)) continue;
            const float* place = at + 6;
            for (int i = 0; i < 3; ++i) {
                pixel[i] = m[4 * i] * place[0] + m[4 * i + 1] * place[1] + m[4 * i + 2] * place[2] +
                           m[4 * i + 3];
            }
            const float x = pixel[0] / pixel[2], y = pixel[1] / pixel[2];
            if (!(x > 0.5f && y > 0.5f && x < in.w - 0.5f && y < in.h - 0.5f)) continue;
            const Corners beside(x, y, in.w, in.h);
            float cover = 0;
            for (int i = 0; i < 4; ++i) cover += beside.weight[i] * in.mask[beside.at[i]];
            if (!(cover > kInside)) continue;
            sample(picture, Corners(in.scale * x, in.scale * y, in.W, in.H), in.linear, color);
            add(color, at, in, total + 3 * k, weights + k);
        }
    });
}

template <class Stored>
void sample_picture(const Stored* picture, int64_t H, int64_t W, const float* linear,
                    const float* place, int64_t N, float* colors, int threads) {
    parallel_for(N, kTexelsPerChunk, threads, [&](int64_t begin, int64_t end) {
        for (int64_t n = begin; n < end; ++n) {
            sample(picture, Corners(place[2 * n], place[2 * n + 1], W, H), linear, colors + 3 * n);
        }
    });
}

void rasterise(const float* uv, const int32_t* faces, int64_t F, int64_t size, int64_t top,
               int64_t rows, int32_t* owner, float* barycentric) {
    std::fill_n(owner, rows * size, -1);
    for (int64_t f = 0; f < F; ++f) {
        double x[3], y[3];  // in texels, from the top left corner
        for (int i = 0; i < 3; ++i) {
            const float* corner = uv + 2 * int64_t(faces[3 * f + i]);
            x[i] = double(corner[0]) * size, y[i] = (1 - double(corner[1])) * size;
        }
        const auto first = [](const double* a, double low) {
            return int64_t(std::max(std::ceil(std::min({a[0], a[1], a[2]}) - 0.5), low));
        };
        const auto last = [](const double* a, double high) {
            return int64_t(std::min(std::floor(std::max({a[0], a[1], a[2]}) - 0.5), high));
        };
        const double ab[2] = {x[1] - x[0], y[1] - y[0]}, ac[2] = {x[2] - x[0], y[2] - y[0]};
        const double area = ab[0] * ac[1] - ab[1] * ac[0];
        for (int64_t r = first(y, top); r <= last(y, top + rows - 1.0); ++r) {
            for (int64_t c = first(x, 0); c <= last(x, size - 1.0); ++c) {
                const double px = c + 0.5 - x[0], py = r + 0.5 - y[0];
                // Without area they are no numbers, and the triangle holds nothing
                const double b = (px * ac[1] - py * ac[0]) / area;
                const double d = (ab[0] * py - ab[1] * px) / area;
                if (!(b >= 0 && d >= 0 && b + d <= 1)) continue;
                const int64_t texel = (r - top) * size + c;
                owner[texel] = static_cast<int32_t>(f);
                barycentric[2 * texel] = float(b), barycentric[2 * texel + 1] = float(d);
            }
        }
    }
}

template void add_photograph(const Texels&, const uint8_t*, float*, float*, int);
template void add_photograph(const Texels&, const float*, float*, float*, int);
template void sample_picture(const uint8_t*, int64_t, int64_t, const float*, const float*, int64_t,
                             float*, int);
template void sample_picture(const float*, int64_t, int64_t, const float*, const float*, int64_t,
                             float*, int);

}  // namespace univoxel
