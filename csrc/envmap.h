// Lookup and importance sampling of an equirectangular environment map;
// docs/reference/conventions.md has its axes. univoxel/envmap.py builds the tables and is the twin
// of this.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <vector>

#include "angles.h"
#include "dcheck.h"

namespace univoxel {

/// Buffers of a map; row-major, contiguous.
struct EnvMapTables {
    const float* texel;       // [H, W, 4] linear radiance, density per steradian of being sampled
    const float* row_cdf;     // [H + 1]     0 .. 1: which row
    const float* column_cdf;  // [H, W + 1]  0 .. 1: which column, given the row
    int64_t height, width;
    float rotation;  // radians, counter-clockwise about +Z
};

/// Columns of n samples of a map.
struct MapSamples {
    float *u, *v;           // in: two numbers in [0, 1)
    int32_t *row, *column;  // out: the texel
    float *x, *z;           // out: across the map in texels, the height of the direction
    float* pdf;             // out: its density per steradian
    int n;
};

/// Where on the map a direction falls, in texels: inside it even if the direction is not finite.
struct MapPlace {
    float x, y;
};

/// Loops over many directions call these: all but `radiance` vectorise.
class EnvMap {
  public:
    explicit EnvMap(const EnvMapTables& tables)
        : t_(tables),
          width_(static_cast<int32_t>(tables.width)),
          height_(static_cast<int32_t>(tables.height)),
          turn_(static_cast<float>(tables.rotation / (2 * kPi))),
          edge_(tables.height + 1),
          per_solid_(tables.height) {
        const auto edge = [&](int64_t r) { return std::cos(kPi * r / t_.height); };
        for (int64_t r = 0; r <= t_.height; ++r) edge_[r] = static_cast<float>(edge(r));
        for (int64_t r = 0; r < t_.height; ++r)
            per_solid_[r] = static_cast<float>(t_.width / (2 * kPi * (edge(r) - edge(r + 1))));
        guide_.resize(kGuide);
        for (int32_t k = 0, row = 0; k < kGuide; ++k) {
            const float v = static_cast<float>(k) / kGuide;
            while (row + 1 < height_ && t_.row_cdf[row + 1] <= v) ++row;
            guide_[k] = row;
        }
        while (blocks_ * kColumnsPerBlock < width_) blocks_ *= 2;
        block_.resize(t_.height * blocks_, 2.f);
        for (int32_t r = 0; r < height_; ++r)
            for (int32_t c = 0; c < width_; c += kColumnsPerBlock)
                block_[r * blocks_ + c / kColumnsPerBlock] = t_.column_cdf[r * (t_.width + 1) + c];
        // A black map has the density of its solid angle, or 0, but never light.
        const int64_t n = t_.height * t_.width;
        for (int64_t i = 0; i < n && black_; ++i)
            black_ = !(t_.texel[4 * i] > 0 || t_.texel[4 * i + 1] > 0 || t_.texel[4 * i + 2] > 0);
    }

    bool black() const { return black_; }

    /// Sample places: the texel by inverting both tables, then uniform in solid angle within it.
    void sample(const MapSamples& d) const {
        find_rows(d);
        find_columns(d);
        const int32_t pitch = width_ + 1;
#pragma GCC ivdep
        for (int i = 0; i < d.n; ++i) {
            const int32_t row = d.row[i], column = d.column[i];
            DCHECK(row >= 0 && row < height_ && column >= 0 && column < width_);
            const float* at = t_.column_cdf + row * pitch + column;
            const float share = at[1] - at[0];
            const float low = t_.row_cdf[row], share_of_row = t_.row_cdf[row + 1] - low;
            const float top = edge_[row], bottom = edge_[row + 1];
            d.x[i] = column + place_in(d.u[i], at[0], share);
            d.z[i] = top + place_in(d.v[i], low, share_of_row) * (bottom - top);
            d.pdf[i] = share * share_of_row * per_solid_[row];
        }
    }

    float3 direction(float x, float z) const {
        return on_circle(0.5f - x / width_ + turn_, std::sqrt(std::max(0.f, 1 - z * z)), z);
    }

    /// How far down the map, in texels, a direction of height z falls.
    float down(float z) const {
        return 2 * height_ * turns_of(std::sqrt(std::max(0.f, 1 - z * z)), z);
    }

    MapPlace place(const float3& d) const {
        float x = 0.5f - (turns_of(d.y, d.x) - turn_);
        x = (x - std::floor(x)) * width_;
        const float y = 2 * height_ * turns_of(std::sqrt(d.x * d.x + d.y * d.y), d.z);
        return {std::min(std::max(0.f, x), float(width_)),
                std::min(std::max(0.f, y), float(height_))};
    }

    float pdf(const MapPlace& at) const {
        DCHECK(at.x >= 0 && at.x <= width_ && at.y >= 0 && at.y <= height_);
        const int32_t row = static_cast<int32_t>(std::min(at.y, height_ - 1.f));
        const int32_t column = static_cast<int32_t>(std::min(at.x, width_ - 1.f));
        return t_.texel[4 * (row * width_ + column) + 3];
    }

    /// Call for the texels about a place, which `radiance` will read.
    void prefetch(const MapPlace& at) const {
        const int32_t row = static_cast<int32_t>(std::max(at.y - 0.5f, 0.f));
        const int32_t column = static_cast<int32_t>(std::max(at.x - 0.5f, 0.f));
        const float* texel = t_.texel + 4 * (row * width_ + column);
        __builtin_prefetch(texel);
        __builtin_prefetch(texel + (row + 1 < height_ ? 4 * width_ : 0));
    }

    /// Radiance, bilinear between pixel centres, around the border in x, clamped at the poles.
    float3 radiance(const MapPlace& at) const {
        const float column = at.x - 0.5f;
        const float row = std::min(std::max(at.y - 0.5f, 0.f), height_ - 1.f);
        const float left = std::floor(column);
        int32_t c0 = static_cast<int32_t>(left), r0 = static_cast<int32_t>(row);
        c0 = c0 < 0 ? c0 + width_ : c0;
        c0 = c0 >= width_ ? c0 - width_ : c0;
        const int32_t c1 = c0 + 1 < width_ ? c0 + 1 : 0, r1 = r0 + 1 < height_ ? r0 + 1 : r0;
        const float fc = column - left, fr = row - r0;
        const float w00 = (1 - fr) * (1 - fc), w01 = (1 - fr) * fc, w10 = fr * (1 - fc),
                    w11 = fr * fc;
        const float4 sum = w00 * texel(r0 * width_ + c0) + w01 * texel(r0 * width_ + c1) +
                           w10 * texel(r1 * width_ + c0) + w11 * texel(r1 * width_ + c1);
        return {sum[0], sum[1], sum[2]};
    }

  private:
    static constexpr int kGuide = 4096, kColumnsPerBlock = 16;
    using float4 = float __attribute__((vector_size(16)));

    /// Texel i of the radiance and its density.
    float4 texel(int32_t i) const {
        DCHECK(i >= 0 && i < width_ * height_);
        float4 out;
        std::memcpy(&out, t_.texel + 4 * i, sizeof out);
        return out;
    }

    /// Where u lies in the interval from `low` that it was found in, in [0, 1).
    static float place_in(float u, float low, float width) {
        return std::min((u - low) / std::max(width, 1e-30f), 1 - 0x1p-24f);
    }

    /// Rows are found from where `guide_` says; few have a step or more to go.
    void find_rows(const MapSamples& d) const {
        const float* cdf = t_.row_cdf;
#pragma GCC ivdep
        for (int i = 0; i < d.n; ++i) d.row[i] = guide_[static_cast<int32_t>(d.v[i] * kGuide)];
        for (int i = 0; i < d.n; ++i)
            while (cdf[d.row[i] + 1] <= d.v[i]) ++d.row[i];
    }

    /// The columns that hold u, by blocks first: their table stays in cache. An empty column is
    /// never found.
    void find_columns(const MapSamples& d) const {
        std::fill_n(d.column, d.n, 0);
        find(blocks_, d, [this](int32_t r, int32_t c) { return block_[r * blocks_ + c]; });
        for (int i = 0; i < d.n; ++i) d.column[i] *= kColumnsPerBlock;
        find(kColumnsPerBlock, d, [this](int32_t r, int32_t c) {
            return t_.column_cdf[r * (width_ + 1) + (c < width_ ? c : width_)];
        });
    }

    /// Move columns on by less than `reach`, a power of 2, as far as `table` is at most u. All
    /// search in step: there is no branch to mispredict.
    template <class F>
    static void find(int32_t reach, const MapSamples& d, F&& table) {
        DCHECK((reach & (reach - 1)) == 0);
        for (int32_t step = reach / 2; step > 0; step /= 2) {
#pragma GCC ivdep
            for (int i = 0; i < d.n; ++i) {
                const int32_t next = d.column[i] + step;
                d.column[i] = table(d.row[i], next) <= d.u[i] ? next : d.column[i];
            }
        }
    }

    EnvMapTables t_;
    int32_t width_, height_;
    float turn_;                    // rotation in turns
    std::vector<float> edge_;       // [H + 1] z of the rows' borders, from 1 to -1
    std::vector<float> per_solid_;  // [H] one over the solid angle of a texel
    int32_t blocks_ = 1;            // in a row, a power of 2
    std::vector<float> block_;    // [H, blocks_] where they begin in the row's table; 2: beyond it
    std::vector<int32_t> guide_;  // [kGuide] the rows that hold 0, 1 / kGuide, 2 / kGuide, ...
    bool black_ = true;
};

}  // namespace univoxel
