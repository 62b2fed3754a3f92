#include "stereo.h"

#include <algorithm>
#include <cmath>
#include <vector>

#include "dcheck.h"
#include "parallel.h"

namespace univoxel {
namespace {

constexpr int64_t kRowsPerChunk = 16;  // of pixels; those next to a chunk are looked up twice
constexpr int64_t kLinesPerChunk = 16;

/// Differences [steps] of a pixel's colour from another view's picture at points along its ray;
/// `most` where that shows nothing.
void differences(const Match& in, int64_t view, int64_t ray, float* out) {
    // It runs in the picture along (x, y) = (a + t b) / (c + t d)
    const float *m = in.matrix + 12 * view, *o = in.origin + 3 * ray, *d = in.direction + 3 * ray;
    float a[3], b[3];
    for (int i = 0; i < 3; ++i, m += 4) {
        a[i] = m[0] * o[0] + m[1] * o[1] + m[2] * o[2] + m[3];
        b[i] = m[0] * d[0] + m[1] * d[1] + m[2] * d[2];
    }
    const int32_t *picture = in.pictures + view * in.H * in.W, *right_of = picture + 1,
                  *below = picture + in.W, *beyond = below + 1;
    const float red = 255 * in.color[3 * ray], green = 255 * in.color[3 * ray + 1],
                blue = 255 * in.color[3 * ray + 2], start = in.start[ray], step = in.step,
                most = in.most, right = in.W - 1, bottom = in.H - 1;
    const int steps = in.steps, W = in.W;
#pragma omp simd
    for (int k = 0; k < steps; ++k) {
        const float t = start + k * step, z = a[2] + t * b[2];
        const float x = (a[0] + t * b[0]) / z - 0.5f, y = (a[1] + t * b[1]) / z - 0.5f;
        const bool inside = (z > 0) & (x >= 0) & (y >= 0) & (x < right) & (y < bottom);
        const float there_x = inside ? x : 0.f, there_y = inside ? y : 0.f;
        const int i = static_cast<int>(there_x), j = static_cast<int>(there_y), at = j * W + i;
        const float u = there_x - i, v = there_y - j;
        const int32_t p = picture[at], q = right_of[at], r = below[at], s = beyond[at];
        const auto mix = [&](int shift) {
            const auto of = [&](int32_t c) { return static_cast<float>(c >> shift & 255); };
            return (1 - v) * ((1 - u) * of(p) + u * of(q)) + v * ((1 - u) * of(r) + u * of(s));
        };
        const float cover = mix(24), share = cover / 255;
        const float off = std::abs(mix(0) - share * red) + std::abs(mix(8) - share * green) +
                          std::abs(mix(16) - share * blue);
        out[k] = inside & (cover >= 127.5f) ? std::min(most, off / (3 * cover)) : most;
    }
}

/// Differences of the last 2 radius + 1 rows of pixels: as many as a window needs.
class LastRows {
  public:
    explicit LastRows(const Match& in)
        : in_(in), kept_(2 * in.radius + 1), buffer_(kept_ * in.M * in.W * in.steps) {}

    void look_up(int64_t y) {
        for (int64_t m = 0; m < in_.M; ++m)
            for (int64_t x = 0; x < in_.W; ++x) {
                const int64_t ray = in_.rows[y * in_.W + x];
                if (ray >= 0) differences(in_, in_.others[m], ray, at(y, m, x));
            }
    }

    /// Sums [M, steps] over the window around a pixel; returns how many pixels with a ray it has.
    int64_t sum_around(int64_t y, int64_t x, float* sum) {
        std::fill(sum, sum + in_.M * in_.steps, 0.f);
        int64_t count = 0;
        for (int64_t j = first(y); j <= last(y, in_.H); ++j)
            for (int64_t i = first(x); i <= last(x, in_.W); ++i) {
                if (in_.rows[j * in_.W + i] < 0) continue;
                ++count;
                for (int64_t m = 0; m < in_.M; ++m) {
                    const float* from = at(j, m, i);
                    float* to = sum + m * in_.steps;
                    for (int64_t k = 0; k < in_.steps; ++k) to[k] += from[k];
                }
            }
        return count;
    }

    /// The ends of a window around a pixel.
    int64_t first(int64_t pixel) const { return std::max<int64_t>(0, pixel - in_.radius); }
    int64_t last(int64_t pixel, int64_t count) const {
        return std::min(count - 1, pixel + in_.radius);
    }

  private:
    float* at(int64_t y, int64_t m, int64_t x) {
        DCHECK(y >= 0 && m >= 0 && m < in_.M && x >= 0 && x < in_.W);
        return buffer_.data() + ((y % kept_ * in_.M + m) * in_.W + x) * in_.steps;
    }

    const Match& in_;
    int64_t kept_;
    std::vector<float> buffer_;  // [kept, M, W, steps]
};

/// Means [steps], times `scale`, of the `best` lowest of M values of each step, which are lost.
void mean_of_best(const Match& in, float* values, float scale, float* least, float* mean) {
    std::fill(least, least + in.best * in.steps, HUGE_VALF);
    for (int64_t m = 0; m < in.M; ++m)
        for (int64_t j = 0; j < in.best; ++j) {  // lower ones stay, higher ones go on
            float *value = values + m * in.steps, *low = least + j * in.steps;
#pragma omp simd
            for (int64_t k = 0; k < in.steps; ++k) {
                const float here = value[k];
                value[k] = std::max(low[k], here);
                low[k] = std::min(low[k], here);
            }
        }
    std::fill(mean, mean + in.steps, 0.f);
    for (int64_t j = 0; j < in.best; ++j)
        for (int64_t k = 0; k < in.steps; ++k) mean[k] += least[j * in.steps + k];
    for (int64_t k = 0; k < in.steps; ++k) mean[k] *= scale / in.best;
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
    if (in.W < 2 || in.H < 2) {  // nothing lies between four pixels
        std::fill(cost, cost + in.N * in.steps, in.most);
        return;
    }
    parallel_for(in.H, kRowsPerChunk, threads, [&](int64_t begin, int64_t end) {
        LastRows window(in);
        std::vector<float> sum(in.M * in.steps), least(in.best * in.steps);
        int64_t known = window.first(begin);
        for (int64_t y = begin; y < end; ++y) {
            while (known <= window.last(y, in.H)) window.look_up(known++);
            for (int64_t x = 0; x < in.W; ++x) {
                const int64_t ray = in.rows[y * in.W + x];
                if (ray < 0) continue;
                DCHECK(ray < in.N);
                const int64_t count = window.sum_around(y, x, sum.data());
                mean_of_best(in, sum.data(), 1.f / count, least.data(), cost + ray * in.steps);
            }
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
