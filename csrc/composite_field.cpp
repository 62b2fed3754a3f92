#include "composite_field.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

#include "dcheck.h"
#include "density.h"
#include "parallel.h"

namespace univoxel {
namespace {

// Samples of so many rays, with the nodes around them, fit the second-level cache.
constexpr int64_t kRaysPerChunk = 64;

template <class T, class Nodes>
void place_samples(const FieldRays<T, Nodes>& in, int64_t ray, T* points) {
    for (int64_t i = in.offsets[ray]; i < in.offsets[ray + 1]; ++i, points += 3) {
        for (int a = 0; a < 3; ++a) {
            points[a] = in.origin[3 * ray + a] + in.t[i] * in.direction[3 * ray + a];
        }
    }
}

/// Trilinear distance, as sample_sdf has it.
template <class T, class Nodes>
T distance(const T* sdf, const sampling::Located<T, Nodes>& at) {
    const Stencil3<T>& s = at.s;
    T near = 0, far = 0;
    for (int k = 0; k < 4; ++k) {
        const int a = 1 + (k >> 1), b = 1 + (k & 1);
        const T weight = s.x.value[a] * s.y.value[b];
        near += weight * sdf[at.row(a, b, 1)];
        far += weight * sdf[at.row(a, b, 2)];
    }
    return near * s.z.value[1] + far * s.z.value[2];
}

/// Opacities of a ray's sections and what its samples weigh; scratch that grows with the rays.
template <class T>
struct Weights {
    std::vector<T> alpha, trans, share;
    T opacity;  // sum of shares
    T read;     // sum of the shares of those that are read
    T least;    // share from which on a sample is read

    bool reads(int64_t i) const { return share[i] >= least; }

    /// sdf: of the ray's n samples, `stride` apart.
    void of(const T* sdf, int64_t stride, const bool* connected, int64_t n, T inv_s, T min_share) {
        alpha.assign(n, T(0)), trans.assign(n, T(0)), share.assign(n, T(0));
        T through = 1, most = 0;
        for (int64_t i = 0; i < n; ++i) {
            trans[i] = through;
            if (i + 1 == n || !connected[i]) continue;
            alpha[i] = section_alpha(sdf[i * stride] * inv_s, sdf[(i + 1) * stride] * inv_s);
            const T half = alpha[i] * through / 2;
            share[i] += half, share[i + 1] += half;
            through *= 1 - alpha[i];
        }
        opacity = read = 0;
        for (int64_t i = 0; i < n; ++i) most = std::max(most, share[i]), opacity += share[i];
        least = min_share * most;
        for (int64_t i = 0; i < n; ++i) read += reads(i) ? share[i] : T(0);
    }
    /// By which the mean of what was read is made that of all.
    T scale() const { return read > 0 ? opacity / read : T(0); }
};

/// Read distances of n samples.
template <class T, class Nodes>
void read_distances(const Sampling<T, Nodes>& grid, const T* points, int64_t n, T* held,
                    int64_t stride) {
    using namespace sampling;
    Located<T, Nodes> located[kPointsPerBlock];
    for (int64_t j = 0; j < n; j += kPointsPerBlock) {
        const int64_t block = std::min(kPointsPerBlock, n - j);
        for (int64_t k = 0; k < block; ++k) {
            located[k] = locate(grid, points + 3 * (j + k));
            for (int line = 0; line < 4; ++line) {
                __builtin_prefetch(grid.sdf + located[k].row(1 + (line >> 1), 1 + (line & 1), 1));
            }
        }
        for (int64_t k = 0; k < block; ++k) {
            held[(j + k) * stride] = has_nan(points + 3 * (j + k))
                                         ? std::numeric_limits<T>::quiet_NaN()
                                         : distance(grid.sdf, located[k]);
        }
    }
}

/// Read gradients, and the nodes' features, of some samples.
template <int64_t kC, class T, class Nodes>
void read_nodes(const Sampling<T, Nodes>& grid, const T* points, const std::vector<int64_t>& some,
                T* held, int64_t stride) {
    using namespace sampling;
    Located<T, Nodes> located[kPointsPerBlock];
    const int64_t n = static_cast<int64_t>(some.size());
    for (int64_t j = 0; j < n; j += kPointsPerBlock) {
        const int64_t block = std::min(kPointsPerBlock, n - j);
        for (int64_t k = 0; k < block; ++k) {
            located[k] = locate(grid, points + 3 * some[j + k]);
            prefetch_nodes<kC>(grid, located[k]);
        }
        for (int64_t k = 0; k < block; ++k) {
            T* to = held + some[j + k] * stride;
            T again;
            sample_sdf(grid.sdf, located[k], &again, to + 1);
            sample_features<kC>(grid, located[k], to + kSampleNumbers);
        }
    }
}

/// What a thread needs for a chunk of rays.
template <class T>
struct Scratch {
    Weights<T> weights;
    std::vector<T> points, read_points;
    std::vector<int64_t> read;  // samples of the chunk
};

template <int64_t kC, class T, class Nodes>
void forward_chunk(const FieldRays<T, Nodes>& in, int64_t begin, int64_t end, T* out, T* all_held,
                   Scratch<T>& scratch) {
    const int64_t C = in.channels(), stride = kSampleNumbers + C;
    const int64_t first = in.offsets[begin], n = in.offsets[end] - first;
    T* held = all_held + first * stride;
    scratch.points.resize(3 * n);
    for (int64_t ray = begin; ray < end; ++ray) {
        place_samples(in, ray, scratch.points.data() + 3 * (in.offsets[ray] - first));
    }
    read_distances(in.grid, scratch.points.data(), n, held, stride);

    Weights<T>& w = scratch.weights;
    scratch.read.clear(), scratch.read_points.clear();
    const auto weigh = [&](int64_t ray) {
        const int64_t from = in.offsets[ray], count = in.offsets[ray + 1] - from;
        w.of(held + (from - first) * stride, stride, in.connected + from, count, in.inv_s,
             in.min_share);
    };
    for (int64_t ray = begin; ray < end; ++ray) {
        weigh(ray);
        for (int64_t i = in.offsets[ray]; i < in.offsets[ray + 1]; ++i) {
            if (!w.reads(i - in.offsets[ray])) {
                T* row = held + (i - first) * stride;
                std::fill(row + 1, row + stride, T(0));
                continue;
            }
            const T* p = scratch.points.data() + 3 * (i - first);
            scratch.read.push_back(i - first);
            scratch.read_points.insert(scratch.read_points.end(), p, p + 3);
        }
    }
    read_nodes<kC>(in.grid, scratch.points.data(), scratch.read, held, stride);
    encode_hash_rows(in.hash, scratch.read_points.data(), scratch.read, held + kSampleNumbers,
                     stride);

    for (int64_t ray = begin; ray < end; ++ray) {
        weigh(ray);
        T* sum = out + ray * (kRayNumbers + C);
        std::fill(sum, sum + kRayNumbers + C, T(0));
        sum[0] = w.opacity;
        const int64_t from = in.offsets[ray];
        for (int64_t i = 0; i < in.offsets[ray + 1] - from; ++i) {
            sum[1] += w.share[i] * in.t[from + i];
            if (!w.reads(i)) continue;
            const T* row = held + (from + i - first) * stride;
            const T share = w.scale() * w.share[i];
#pragma omp simd
            for (int64_t c = 1; c < stride; ++c) sum[1 + c] += share * row[c];
        }
    }
}

// With shares c_i, out = A / B sum_read c_i v_i, A the sum of all shares and B of those read, m the
// mean of what was read and g the pull at out:
//   dL/dc_i = g . m + [read] A / B g . (v_i - m) + g_t t_i + g_opacity,   dL/dv_i = A / B c_i g
// A section pulls with the mean of its two ends. Then as in composite.cpp, and from opacities to
// the distances at the ends of sections. See docs/method/gradients.md.
template <class T, class Nodes>
void pull_at_ray(const FieldRays<T, Nodes>& in, int64_t ray, const T* all_held, const T* grad_out,
                 const FieldPulls<T>& pulls, Weights<T>& w, std::vector<T>& own) {
    const int64_t C = in.channels(), stride = kSampleNumbers + C;
    const int64_t from = in.offsets[ray], n = in.offsets[ray + 1] - from;
    const T* held = all_held + from * stride;
    const T* g = grad_out + ray * (kRayNumbers + C);
    w.of(held, stride, in.connected + from, n, in.inv_s, in.min_share);
    const T scale = w.scale();

    place_samples(in, ray, pulls.points + 3 * from);
    own.assign(n, T(0));  // dL / d share
    T mean = 0;           // g . m
    for (int64_t i = 0; i < n; ++i) {
        T *gradient = pulls.gradient + 3 * (from + i), *feature = pulls.feature + C * (from + i);
        T* point = pulls.feature_points + 3 * (from + i);
        if (!w.reads(i)) {
            std::fill(gradient, gradient + 3, T(0));
            std::fill(feature, feature + C, T(0));
            std::fill(point, point + 3, std::numeric_limits<T>::quiet_NaN());
            continue;
        }
        std::copy_n(pulls.points + 3 * (from + i), 3, point);
        const T* row = held + i * stride;
        const T share = scale * w.share[i];
        T dot = 0;
#pragma omp simd reduction(+ : dot)
        for (int64_t c = 1; c < stride; ++c) dot += g[1 + c] * row[c];
        for (int a = 0; a < 3; ++a) gradient[a] = share * g[2 + a];
#pragma omp simd
        for (int64_t c = 0; c < C; ++c) feature[c] = share * g[kRayNumbers + c];
        own[i] = dot;
        mean += w.share[i] * dot;
    }
    mean = w.read > 0 ? mean / w.read : T(0);
    // One way for all places in memory: the compiler's own check whether arrays overlap may choose
    // between loops that round differently
    T* o = own.data();
    const T *share = w.share.data(), *t = in.t + from, least = w.least;
#pragma omp simd
    for (int64_t i = 0; i < n; ++i) {
        const T beyond = share[i] >= least ? scale * (o[i] - mean) : T(0);
        o[i] = mean + beyond + g[1] * t[i] + g[0];
    }

    T* value = pulls.value + from;
    std::fill(value, value + n, T(0));
    T behind = 0;
    for (int64_t i = n - 2; i >= 0; --i) {
        if (!in.connected[from + i]) continue;
        const T pull = (own[i] + own[i + 1]) / 2, alpha = w.alpha[i];
        const T of_alpha = w.trans[i] * (pull - behind) * in.inv_s;
        behind = alpha * pull + (1 - alpha) * behind;
        const AlphaSlope<T> slope =
            section_alpha_slope(held[i * stride] * in.inv_s, held[(i + 1) * stride] * in.inv_s);
        value[i] += of_alpha * slope.start;
        value[i + 1] += of_alpha * slope.end;
    }
}

}  // namespace

template <class T, class Nodes>
void composite_field_forward(const FieldRays<T, Nodes>& in, T* out, T* held, int threads) {
    with_channels(in.grid.n_channels, [&](auto constant) {
        constexpr int64_t kC = decltype(constant)::value;
        parallel_for(in.n_rays, kRaysPerChunk, threads, [&](int64_t begin, int64_t end) {
            Scratch<T> scratch;
            forward_chunk<kC>(in, begin, end, out, held, scratch);
        });
    });
}

template <class T, class Nodes>
void composite_field_pulls(const FieldRays<T, Nodes>& in, const T* held, const T* grad_out,
                           const FieldPulls<T>& pulls, int threads) {
    parallel_for(in.n_rays, kRaysPerChunk, threads, [&](int64_t begin, int64_t end) {
        Weights<T> weights;
        std::vector<T> own;
        for (int64_t ray = begin; ray < end; ++ray) {
            pull_at_ray(in, ray, held, grad_out, pulls, weights, own);
        }
    });
}

#define UNIVOXEL_INSTANTIATE(T, Nodes)                                                  \
    template void composite_field_forward(const FieldRays<T, Nodes>&, T*, T*, int);     \
    template void composite_field_pulls(const FieldRays<T, Nodes>&, const T*, const T*, \
                                        const FieldPulls<T>&, int);
UNIVOXEL_INSTANTIATE(float, DenseNodes)
UNIVOXEL_INSTANTIATE(double, DenseNodes)
UNIVOXEL_INSTANTIATE(float, BrickNodes)
UNIVOXEL_INSTANTIATE(double, BrickNodes)
#undef UNIVOXEL_INSTANTIATE

}  // namespace univoxel
