#include "hull.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

#include "parallel.h"

namespace univoxel {
namespace {

constexpr int64_t kPointsPerChunk = 4096;  // their sums stay in a core's cache
constexpr float kInfinity = std::numeric_limits<float>::infinity();

/// Where a view shows a point, in pixels, and its depth.
struct Place {
    float x, y, depth;
};

inline Place project(const float* m, const float* p) {
    const float a = m[0] * p[0] + m[1] * p[1] + m[2] * p[2] + m[3];
    const float b = m[4] * p[0] + m[5] * p[1] + m[6] * p[2] + m[7];
    const float z = m[8] * p[0] + m[9] * p[1] + m[10] * p[2] + m[11];
    return {a / z, b / z, z};
}

/// A coordinate within [0, most]; 0 for what is no number.
inline float within(float x, float most) {
    return x > 0 ? std::min(x, most) : 0.f;
}

/// Bilinear, of a map's width x height pixels; beyond its border lies the border.
inline float look_up(const float* map, int64_t stride, float x, float y, int width, int height) {
    x = within(x - 0.5f, width - 1.f), y = within(y - 0.5f, height - 1.f);
    const int i = static_cast<int>(x), j = static_cast<int>(y);
    const float u = x - i, v = y - j;
    const float *top = map + j * stride, *bottom = map + std::min(j + 1, height - 1) * stride;
    const int right = std::min(i + 1, width - 1);
    return (1 - v) * ((1 - u) * top[i] + u * top[right]) +
           v * ((1 - u) * bottom[i] + u * bottom[right]);
}

}  // namespace

void hull_sdf(const ViewedPoints& in, const float* distance, const uint8_t* uncut,
              const float* focal, int64_t votes, int64_t seen_by, float wider, float* sdf,
              int threads) {
    parallel_for(in.N, kPointsPerChunk, threads, [&](int64_t begin, int64_t end) {
        const int64_t count = end - begin;
        std::vector<float> highest(votes * count, -kInfinity);  // a point's, the largest first
        std::vector<int32_t> voters(count, 0);
        for (int64_t view = 0; view < in.V; ++view) {
            const int width = in.sizes[2 * view], height = in.sizes[2 * view + 1];
            const float* map = distance + view * in.H * in.W;
            for (int64_t n = 0; n < count; ++n) {
                const Place at = project(in.matrix + 12 * view, in.points + 3 * (begin + n));
                const bool seen = at.depth > 0 && at.x >= 0 && at.y >= 0 && at.x <= float(width) &&
                                  at.y <= float(height);
                if (!seen && !uncut[view]) continue;
                float bound = look_up(map, in.W, at.x, at.y, width, height) - wider;
                if (!seen) bound = std::max(bound, 0.5f);
                bound *= std::abs(at.depth) / focal[view];
                ++voters[n];
                float* rank = highest.data() + votes * n;
                for (int64_t r = 0; r < votes && bound > -kInfinity; ++r) {
                    const float before = rank[r];
                    rank[r] = std::max(before, bound), bound = std::min(before, bound);
                }
            }
        }
        for (int64_t n = 0; n < count; ++n) {
            const int64_t enough = std::clamp<int64_t>((voters[n] + 1) / 2, 1, votes);
            sdf[begin + n] = voters[n] < seen_by ? kInfinity : highest[votes * n + enough - 1];
        }
    });
}

void count_votes(const ViewedPoints& in, const float* mask, const float* distance,
                 const uint8_t* known, const float* eye, float band, float* sums, int threads) {
    parallel_for(in.N, kPointsPerChunk, threads, [&](int64_t begin, int64_t end) {
        for (int i = 0; i < 7; ++i) std::fill(sums + i * in.N + begin, sums + i * in.N + end, 0.f);
        for (int64_t view = 0; view < in.V; ++view) {
            const int width = in.sizes[2 * view], height = in.sizes[2 * view + 1];
            const float* from = eye + 3 * view;
            for (int64_t n = begin; n < end; ++n) {
                const float* p = in.points + 3 * n;
                const Place at = project(in.matrix + 12 * view, p);
                const bool seen = at.depth > 0 && at.x >= 0 && at.y >= 0 && at.x < float(width) &&
                                  at.y < float(height);
                if (!seen) continue;
                const int64_t pixel =
                    (view * in.H + static_cast<int64_t>(at.y)) * in.W + static_cast<int64_t>(at.x);
                const float a = p[0] - from[0], b = p[1] - from[1], c = p[2] - from[2];
                const float clear = distance[pixel] - std::sqrt(a * a + b * b + c * c);
                const bool sure = known[pixel], near = sure && std::abs(clear) <= band;
                const bool hidden = sure && clear < -band;
                const float shown = mask[pixel];
                sums[n] += 1, sums[in.N + n] += shown;
                sums[2 * in.N + n] += sure && clear > band;
                sums[3 * in.N + n] += near;
                sums[4 * in.N + n] += near ? -clear / band : 0.f;
                sums[5 * in.N + n] += !hidden;
                sums[6 * in.N + n] += hidden ? 0.f : shown;
            }
        }
    });
}

}  // namespace univoxel
