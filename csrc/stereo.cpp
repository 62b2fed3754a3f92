#include "stereo.h"

#include <algorithm>
#include <cmath>
#include <vector>

#include "parallel.h"

namespace univoxel {
namespace {

constexpr int64_t kRaysPerChunk = 64;
constexpr int64_t kLinesPerChunk = 16;

/// Where a ray runs in a picture: (x, y) = (a + t b) / (c + t d) pixels.
struct Line {
    float a[3], b[3];

    Line(const float* m, const float* o, const float* d) {
        for (int i = 0; i < 3; ++i, m += 4) {
            a[i] = m[0] * o[0] + m[1] * o[1] + m[2] * o[2] + m[3];
            b[i] = m[0] * d[0] + m[1] * d[1] + m[2] * d[2];
        }
    }
};

/// Mean difference of a colour from a picture's at a point, `most` where that shows nothing.
inline float difference(const float* picture, int64_t H, int64_t W, float x, float y,
                        const float* color, float most) {
    x -= 0.5f, y -= 0.5f;
    if (!(x >= 0 && y >= 0 && x < W - 1 && y < H - 1)) return most;
    const int64_t i = static_cast<int64_t>(x), j = static_cast<int64_t>(y);
    const float u = x - i, v = y - j;
    const float *p = picture + (j * W + i) * 4, *q = p + W * 4;
    float c[4];
    for (int k = 0; k < 4; ++k)
        c[k] = (1 - v) * ((1 - u) * p[k] + u * p[4 + k]) + v * ((1 - u) * q[k] + u * q[4 + k]);
    if (!(c[3] >= 0.5f)) return most;
    float sum = 0;
    for (int k = 0; k < 3; ++k) sum += std::abs(c[k] / c[3] - color[k]);
    return std::min(most, sum / 3);
}

/// Differences [M, N, steps] from each of the other views.
void differences(const Match& in, float* out, int threads) {
    parallel_for(in.N, kRaysPerChunk, threads, [&](int64_t begin, int64_t end) {
        for (int64_t m = 0; m < in.M; ++m) {
            const int64_t view = in.others[m];
            const float* picture = in.pictures + view * in.H * in.W * 4;
            for (int64_t n = begin; n < end; ++n) {
                const Line line(in.matrix + 12 * view, in.origin + 3 * n, in.direction + 3 * n);
                float* o = out + (m * in.N + n) * in.steps;
                for (int64_t k = 0; k < in.steps; ++k) {
                    const float t = in.start[n] + k * in.step, z = line.a[2] + t * line.b[2];
                    o[k] = z > 0 ? difference(picture, in.H, in.W, (line.a[0] + t * line.b[0]) / z,
                                              (line.a[1] + t * line.b[1]) / z, in.color + 3 * n,
                                              in.most)
                                 : in.most;
                }
            }
        }
    });
}

/// The mean of the `best` lowest of M numbers `stride` apart; `least` has room for as many.
inline float mean_of_best(const float* values, int64_t M, int64_t stride, int64_t best,
                          float* least) {
    for (int64_t m = 0; m < M; ++m) {
        const float value = values[m * stride];
        int64_t at = std::min(m, best);
        if (at == best && value >= least[best - 1]) continue;
        at = std::min(at, best - 1);
        for (; at > 0 && least[at - 1] > value; --at) least[at] = least[at - 1];
        least[at] = value;
    }
    float sum = 0;
    for (int64_t m = 0; m < best; ++m) sum += least[m];
    return sum / best;
}

/// Least costs along one path of pixels, `stride` apart in `rows`, added to `sum`.
void follow(const float* cost, const int64_t* rows, int64_t count, int64_t stride, int64_t steps,
            float small, float large, float* before, float* sum) {
    bool any = false;
    std::vector<float> here(steps);
    for (int64_t i = 0; i < count; ++i, rows += stride) {
        if (*rows < 0) {
            any = false;
            continue;
        }
        const float* c = cost + *rows * steps;
        float* s = sum + *rows * steps;
        if (any) {
            const float least = *std::min_element(before + 1, before + 1 + steps);
            for (int64_t k = 0; k < steps; ++k) {
                const float* b = before + 1 + k;
                const float stay = std::min(b[0], std::min(b[-1], b[1]) + small);
                here[k] = c[k] + std::min(stay, least + large) - least;
            }
        } else {
            std::copy(c, c + steps, here.begin());
        }
        for (int64_t k = 0; k < steps; ++k) s[k] += here[k];
        std::copy(here.begin(), here.end(), before + 1);
        any = true;
    }
}

}  // namespace

void match_cost(const Match& in, float* cost, int threads) {
    std::vector<float> apart(in.M * in.N * in.steps);
    differences(in, apart.data(), threads);
    parallel_for(in.H, 1, threads, [&](int64_t begin, int64_t end) {
        std::vector<float> mean(in.M * in.steps), least(in.best);
        for (int64_t y = begin; y < end; ++y)
            for (int64_t x = 0; x < in.W; ++x) {
                const int64_t row = in.rows[y * in.W + x];
                if (row < 0) continue;
                std::fill(mean.begin(), mean.end(), 0.f);
                int64_t count = 0;
                for (int64_t j = std::max<int64_t>(0, y - in.radius);
                     j <= std::min(in.H - 1, y + in.radius); ++j)
                    for (int64_t i = std::max<int64_t>(0, x - in.radius);
                         i <= std::min(in.W - 1, x + in.radius); ++i) {
                        const int64_t near = in.rows[j * in.W + i];
                        if (near < 0) continue;
                        ++count;
                        for (int64_t m = 0; m < in.M; ++m) {
                            const float* from = apart.data() + (m * in.N + near) * in.steps;
                            float* to = mean.data() + m * in.steps;
                            for (int64_t k = 0; k < in.steps; ++k) to[k] += from[k];
                        }
                    }
                for (int64_t k = 0; k < in.steps; ++k)
                    cost[row * in.steps + k] =
                        mean_of_best(mean.data() + k, in.M, in.steps, in.best, least.data()) /
                        count;
            }
    });
}

void semi_global(const float* cost, const int64_t* rows, int64_t H, int64_t W, int64_t N,
                 int64_t steps, float small, float large, float* sum, int threads) {
    std::fill(sum, sum + N * steps, 0.f);
    // Beyond the first and the last step there is nothing to come from
    const auto paths = [&](int64_t lines, int64_t line_stride, int64_t count, int64_t stride) {
        parallel_for(lines, kLinesPerChunk, threads, [&](int64_t begin, int64_t end) {
            std::vector<float> before(steps + 2, HUGE_VALF);
            for (int64_t l = begin; l < end; ++l) {
                const int64_t* first = rows + l * line_stride;
                follow(cost, first, count, stride, steps, small, large, before.data(), sum);
                follow(cost, first + (count - 1) * stride, count, -stride, steps, small, large,
                       before.data(), sum);
            }
        });
    };
    paths(H, W, W, 1);
    paths(W, 1, H, W);
}

}  // namespace univoxel
