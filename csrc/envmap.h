// Lookup and importance sampling of an equirectangular environment map; docs/conventions.md has its
// axes. univoxel/envmap.py builds the tables and is the twin of this.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "common.h"

namespace univoxel {

/// Buffers of a map; row-major, contiguous.
struct EnvMapTables {
    const float* radiance;    // [H, W, 3] linear
    const float* row_cdf;     // [H + 1]     0 .. 1: which row
    const float* column_cdf;  // [H, W + 1]  0 .. 1: which column, given the row
    int64_t height, width;
    float rotation;  // radians, counter-clockwise about +Z
};

struct LightSample {
    vec3<float> direction;
    vec3<float> radiance;
    float pdf;  // per steradian
};

struct LightDraw {
    vec3<float> direction;
    float pdf;  // per steradian
    float x;    // across the map, in [0, 1)
};

class EnvMap {
  public:
    explicit EnvMap(const EnvMapTables& tables) : t_(tables), edge_(tables.height + 1) {
        for (int64_t r = 0; r <= t_.height; ++r)
            edge_[r] = static_cast<float>(std::cos(kPi64 * r / t_.height));
        const float* end = t_.radiance + 3 * t_.height * t_.width;
        black_ = std::none_of(t_.radiance, end, [](float value) { return value > 0; });
    }

    bool black() const { return black_; }

    /// Draw a direction from two numbers in [0, 1): the texel by inverting both tables, then a
    /// place uniform in solid angle within it. `radiance` of it is for the caller to ask: half of
    /// all draws lie below the horizon.
    LightDraw sample(float u, float v) const {
        const int64_t r = find(t_.row_cdf, t_.height, v);
        const int64_t c = find(t_.column_cdf + r * (t_.width + 1), t_.width, u);
        const float z = edge_[r] + v * (edge_[r + 1] - edge_[r]);
        const float x = (c + u) / t_.width;
        const float phi = kPi32 * (1 - 2 * x) + t_.rotation;
        const float radius = std::sqrt(std::max(0.f, 1 - z * z));
        return {{radius * std::cos(phi), radius * std::sin(phi), z}, texel_pdf(r, c), x};
    }

    vec3<float> radiance(const LightDraw& s) const {
        return radiance(s.x, 0.5f - std::asin(s.direction.z) / kPi32);
    }

    /// Radiance from a unit direction, and the density with which `sample` draws it.
    LightSample lookup(const vec3<float>& direction) const {
        const float z = std::min(std::max(direction.z, -1.f), 1.f);
        float x = 0.5f - (std::atan2(direction.y, direction.x) - t_.rotation) / (2 * kPi32);
        x -= std::floor(x);
        const float y = 0.5f - std::asin(z) / kPi32;
        return {direction, radiance(x, y),
                texel_pdf(std::min<int64_t>(y * t_.height, t_.height - 1),
                          std::min<int64_t>(x * t_.width, t_.width - 1))};
    }

  private:
    static constexpr double kPi64 = 3.14159265358979323846;
    static constexpr float kPi32 = static_cast<float>(kPi64);

    /// The interval of a table that holds u; leaves in u the place within it, in [0, 1). An empty
    /// interval is never found.
    static int64_t find(const float* cdf, int64_t n, float& u) {
        const float* above = std::upper_bound(cdf, cdf + n + 1, u);
        const int64_t i = std::min<int64_t>(std::max<int64_t>(above - cdf - 1, 0), n - 1);
        u = std::min((u - cdf[i]) / std::max(cdf[i + 1] - cdf[i], 1e-30f), 1 - 0x1p-24f);
        return i;
    }

    float texel_pdf(int64_t r, int64_t c) const {
        const float* column = t_.column_cdf + r * (t_.width + 1) + c;
        const float share = (t_.row_cdf[r + 1] - t_.row_cdf[r]) * (column[1] - column[0]);
        return share * t_.width / (2 * kPi32 * (edge_[r] - edge_[r + 1]));
    }

    /// Bilinear between pixel centres, around the border in x, clamped at the poles; x, y in [0,
    /// 1].
    vec3<float> radiance(float x, float y) const {
        const int64_t W = t_.width, H = t_.height;
        const float column = x * W - 0.5f, row = std::min(std::max(y * H - 0.5f, 0.f), H - 1.f);
        const float left = std::floor(column);
        const int64_t c0 = (static_cast<int64_t>(left) + W) % W, c1 = (c0 + 1) % W;
        const int64_t r0 = static_cast<int64_t>(row), r1 = std::min(r0 + 1, H - 1);
        const float fc = column - left, fr = row - r0;
        const auto at = [&](int64_t r, int64_t c) { return load3(t_.radiance, r * W + c); };
        return (1 - fr) * ((1 - fc) * at(r0, c0) + fc * at(r0, c1)) +
               fr * ((1 - fc) * at(r1, c0) + fc * at(r1, c1));
    }

    EnvMapTables t_;
    std::vector<float> edge_;  // [H + 1] z of the rows' borders, from 1 to -1
    bool black_;
};

}  // namespace univoxel
