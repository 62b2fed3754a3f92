// Sampling of a grid: distance, its spatial gradient and features at points. How it is done, for
// dense_grid.cpp and sparse_grid.cpp, whose nodes lie differently.
#pragma once

#include <algorithm>
#include <cstdint>
#include <limits>
#include <type_traits>
#include <vector>

#include "brick_rows.h"
#include "channels.h"
#include "dcheck.h"
#include "huge_pages.h"
#include "nodes.h"
#include "tiles.h"
#include "trilinear.h"

namespace univoxel {

/// Buffers of one sampling pass. R rows, M samples, C channels; row-major, contiguous.
template <class T, class Nodes>
struct Sampling {
    const T* sdf;          // [R]
    const T* features;     // [R, C]
    const T* points;       // [M, 3]  world; outside the lattice they are clamped to its border
    const int32_t* order;  // [M]     from sort_by_tile
    Lattice lattice;
    Nodes nodes;
    int64_t n_rows, n_points, n_channels;
};

/// Incoming gradients of a pass, and where to write the outgoing ones; null: not wanted.
template <class T, class Touched>
struct SamplingGrads {
    const T* grad_value;          // [M]
    const T* grad_gradient;       // [M, 3]
    const T* grad_feature;        // [M, C]
    T* grad_sdf;                  // [R], or [sdf_rows->count()]
    T* grad_features;             // [R, C], or [feature_rows->count(), C]
    T* grad_points;               // [M, 3]
    const Touched* sdf_rows;      // null: all rows
    const Touched* feature_rows;  // null: all rows
};

namespace sampling {

constexpr int64_t kPointsPerChunk = 2048;
// Numbers of a gradient that a thread clears at a time: many, so that handing them out costs
// little, and few enough to share evenly.
constexpr int64_t kNumbersPerChunk = 1 << 16;
// Samples whose nodes are fetched before the first of them is read: the fetches overlap, and their
// cache lines, 24 a sample of 16 channels, fit the first-level cache together.
constexpr int64_t kPointsPerBlock = 8;
// How many samples ahead the caller's buffers are fetched, where sorted samples lie anywhere. More
// than a block: what is fetched arrives while the block before is worked on.
constexpr int64_t kAhead = 12;
static_assert(kAhead > kPointsPerBlock);

/// Fetch the cache lines of n numbers before they are read or written.
template <class T>
inline void prefetch(const T* p, int64_t n) {
    constexpr int64_t kLine = 64 / sizeof(T);
    for (int64_t i = 0; i < n; i += kLine) __builtin_prefetch(p + i, 1);
    if (n) __builtin_prefetch(p + n - 1, 1);
}

/// A sample's weights and the nodes that they belong to.
template <class T, class Nodes>
struct Located {
    Stencil3<T> s;
    typename Nodes::Near near;

    int64_t row(int a, int b, int c) const { return near.row(s, a, b, c); }
    bool run(int first, int last) const { return near.run(s, first, last); }
};

template <class T, class Nodes>
inline Located<T, Nodes> locate(const Sampling<T, Nodes>& in, const T* point) {
    const Stencil3<T> s = stencil3(in.lattice, point);
    const Located<T, Nodes> at{s, in.nodes.near(s)};
    DCHECK(at.row(0, 0, 0) >= 0 && at.row(3, 3, 3) < in.n_rows);
    return at;
}

/// The four nodes of the line (a, b); one load where they follow each other.
template <class T, class Nodes>
inline void load4(const T* sdf, const Located<T, Nodes>& at, int a, int b, T* f) {
    if (at.run(0, 3)) {
        const T* line = sdf + at.row(a, b, 0);
        for (int c = 0; c < 4; ++c) f[c] = line[c];
    } else {
        for (int c = 0; c < 4; ++c) f[c] = sdf[at.row(a, b, c)];
    }
}

template <class T>
inline void add4(T* sum, T weight, const T* f) {
    for (int c = 0; c < 4; ++c) sum[c] += weight * f[c];
}

template <class T>
inline T dot4(const T* a, const T* b) {
    return (a[0] * b[0] + a[1] * b[1]) + (a[2] * b[2] + a[3] * b[3]);
}

/// Sums over the lines first, four nodes at a time, then along z.
template <class T, class Nodes>
inline void sample_sdf(const T* sdf, const Located<T, Nodes>& at, T* value, T* gradient) {
    const Stencil3<T>& s = at.s;
    T straight[4] = {}, across_x[4] = {}, across_y[4] = {}, f[4];
    for (int k = 0; k < 4; ++k) {
        const int a = 1 + (k >> 1), b = 1 + (k & 1);
        load4(sdf, at, a, b, f);
        add4(straight, s.x.value[a] * s.y.value[b], f);
        add4(across_x, s.x.slope[a] * s.y.value[b], f);
        add4(across_y, s.x.value[a] * s.y.slope[b], f);
    }
    for (int k = 0; k < 4; ++k) {
        const int outer = 3 * (k >> 1), middle = 1 + (k & 1);
        load4(sdf, at, outer, middle, f);
        add4(across_x, s.x.slope[outer] * s.y.value[middle], f);
        load4(sdf, at, middle, outer, f);
        add4(across_y, s.x.value[middle] * s.y.slope[outer], f);
    }
    *value = dot4(straight, s.z.value);
    gradient[0] = dot4(across_x, s.z.value);
    gradient[1] = dot4(across_y, s.z.value);
    gradient[2] = dot4(straight, s.z.slope);
}

template <int64_t kC, class T, class Nodes>
inline void sample_features(const Sampling<T, Nodes>& in, const Located<T, Nodes>& at, T* feature) {
    const int64_t C = kC ? kC : in.n_channels;
    const auto row = [&](int k, int c) {
        return in.features + at.row(1 + (k >> 1), 1 + (k & 1), c) * C;
    };
    const T *r0 = row(0, 1), *r1 = row(1, 1), *r2 = row(2, 1), *r3 = row(3, 1);
    const T *f0 = row(0, 2), *f1 = row(1, 2), *f2 = row(2, 2), *f3 = row(3, 2);
    const Stencil3<T>& s = at.s;
    const T w0 = s.x.value[1] * s.y.value[1], w1 = s.x.value[1] * s.y.value[2],
            w2 = s.x.value[2] * s.y.value[1], w3 = s.x.value[2] * s.y.value[2];
    const T near_z = s.z.value[1], far_z = s.z.value[2];
#pragma omp simd
    for (int64_t c = 0; c < C; ++c) {
        feature[c] = near_z * (w0 * r0[c] + w1 * r1[c] + w2 * r2[c] + w3 * r3[c]) +
                     far_z * (w0 * f0[c] + w1 * f1[c] + w2 * f2[c] + w3 * f3[c]);
    }
}

/// Fetch the nodes around a sample, save the outermost: they lie in its neighbours' lines.
template <int64_t kC, class T, class Nodes>
inline void prefetch_nodes(const Sampling<T, Nodes>& in, const Located<T, Nodes>& at) {
    const int64_t C = kC ? kC : in.n_channels;
    for (int a = 0; a < 4; ++a) {
        for (int b = 0; b < 4; ++b) __builtin_prefetch(in.sdf + at.row(a, b, 1));
    }
    const bool pair = at.run(1, 2);
    for (int k = 0; k < 4; ++k) {
        const int a = 1 + (k >> 1), b = 1 + (k & 1);
        prefetch(in.features + at.row(a, b, 1) * C, pair ? 2 * C : C);
        if (!pair) prefetch(in.features + at.row(a, b, 2) * C, C);
    }
}

/// Slots of a gradient in which every node of a dense grid has a row.
struct AllRows {
    DenseNodes nodes;
    int64_t slots_below(int64_t x) const { return nodes.row(x, 0, 0); }
};

/// Slots of a gradient in which every row has one; missing bricks get none.
struct AllBrickRows {
    int64_t n_rows;
    int64_t count() const { return n_rows; }
};

/// Slot of a node around a sample, or -1: its brick is missing.
template <class T>
inline int64_t slot(const AllRows&, const Located<T, DenseNodes>& at, int a, int b, int c) {
    return at.row(a, b, c);
}
template <class T>
inline int64_t slot(const TouchedRows& rows, const Located<T, DenseNodes>& at, int a, int b,
                    int c) {
    return rows.slot(at.s.x.node[a], at.s.y.node[b], at.s.z.node[c]);
}
template <class T>
inline int64_t slot(const AllBrickRows&, const Located<T, BrickNodes>& at, int a, int b, int c) {
    const int64_t row = at.row(a, b, c);
    return row < kMissingRows ? -1 : row;
}
template <class T>
inline int64_t slot(const RowSet& rows, const Located<T, BrickNodes>& at, int a, int b, int c) {
    const int64_t row = at.row(a, b, c);
    return row < kMissingRows ? -1 : rows.slot(row);
}

template <class Nodes>
constexpr bool kComplete = std::is_same_v<Nodes, DenseNodes>;  // no node is missing

/// How far the loss pulls at the outputs of one sample.
template <class T>
struct Pull {
    T value, x, y, z;  // dL / d value, dL / d gradient
};

template <class T, class Touched>
inline Pull<T> pull_of(const SamplingGrads<T, Touched>& g, int64_t i) {
    const T* n = g.grad_gradient + 3 * i;
    return {g.grad_value[i], n[0], n[1], n[2]};
}

// dL/df at node (a, b, c) is the loss's pull on the weights,
//   (v X_a + gx X'_a) Y_b Z_c + gy X_a Y'_b Z_c + gz X_a Y_b Z'_c,
// X the value weights and X' the slope weights along x. See docs/method/gradients.md.
template <class T, class Nodes, class Rows>
inline void scatter_sdf(const Rows& rows, const Located<T, Nodes>& at, const Pull<T>& g,
                        T* grad_sdf) {
    const Stencil3<T>& s = at.s;
    const bool whole = at.run(0, 3), pair = at.run(1, 2);
    const auto add = [&](int a, int b, int c, T x) {
        const int64_t to = slot(rows, at, a, b, c);
        DCHECK(!kComplete<Nodes> || to >= 0);
        if (kComplete<Nodes> || to >= 0) grad_sdf[to] += x;
    };
    for (int k = 0; k < 4; ++k) {
        const int a = 1 + (k >> 1), b = 1 + (k & 1);
        const T straight = (g.value * s.x.value[a] + g.x * s.x.slope[a]) * s.y.value[b] +
                           g.y * s.x.value[a] * s.y.slope[b];
        const T along = g.z * s.x.value[a] * s.y.value[b];
        T sum[4];
        for (int c = 0; c < 4; ++c) sum[c] = straight * s.z.value[c] + along * s.z.slope[c];
        if (whole) {
            const int64_t to = slot(rows, at, a, b, 0);
            if (!kComplete<Nodes> && to < 0) continue;
            for (int c = 0; c < 4; ++c) grad_sdf[to + c] += sum[c];
        } else {
            for (int c = 0; c < 4; ++c) add(a, b, c, sum[c]);
        }
    }
    const auto add2 = [&](int a, int b, T weight) {
        if (pair) {
            const int64_t to = slot(rows, at, a, b, 1);
            if (!kComplete<Nodes> && to < 0) return;
            grad_sdf[to] += weight * s.z.value[1];
            grad_sdf[to + 1] += weight * s.z.value[2];
        } else {
            add(a, b, 1, weight * s.z.value[1]);
            add(a, b, 2, weight * s.z.value[2]);
        }
    };
    for (int k = 0; k < 4; ++k) {
        const int outer = 3 * (k >> 1), middle = 1 + (k & 1);
        add2(outer, middle, g.x * s.x.slope[outer] * s.y.value[middle]);
        add2(middle, outer, g.y * s.x.value[middle] * s.y.slope[outer]);
    }
}

template <int64_t kC, class T, class Nodes, class Rows>
inline void scatter_features(const Rows& rows, const Located<T, Nodes>& at, const T* g,
                             int64_t channels, T* grad_features) {
    const int64_t C = kC ? kC : channels;
    const Stencil3<T>& s = at.s;
    const bool pair = at.run(1, 2);
    const auto add = [&](int64_t to, T weight) {
        T* out = grad_features + to * C;
#pragma omp simd
        for (int64_t c = 0; c < C; ++c) out[c] += weight * g[c];
    };
    for (int k = 0; k < 4; ++k) {
        const int a = 1 + (k >> 1), b = 1 + (k & 1);
        const T w = s.x.value[a] * s.y.value[b];
        const T near_w = w * s.z.value[1], far_w = w * s.z.value[2];
        const int64_t to = slot(rows, at, a, b, 1), next = pair ? to + 1 : slot(rows, at, a, b, 2);
        if (kComplete<Nodes> || to >= 0) add(to, near_w);
        if (kComplete<Nodes> || (pair ? to : next) >= 0) add(next, far_w);
    }
}

/// dL/d point of one sample: the same sums with the weights' derivatives.
template <int64_t kC, class T, class Nodes>
inline void point_gradient(const Sampling<T, Nodes>& in, const T* point, const Pull<T>& g,
                           const T* grad_feature, T* grad_point) {
    const Located<T, Nodes> at = locate(in, point);
    const Stencil3<T>& s = at.s;
    StencilStep<T> step[3];
    for (int d = 0; d < 3; ++d) {
        step[d] = stencil_step<T>(in.lattice, place(in.lattice, d, static_cast<double>(point[d])));
    }
    const StencilStep<T>&x = step[0], &y = step[1], &z = step[2];
    T dx = 0, dy = 0, dz = 0, f[4];
    for (int a = 0; a < 4; ++a) {
        for (int b = 0; b < 4; ++b) {
            load4(in.sdf, at, a, b, f);
            const T X = s.x.value[a], Y = s.y.value[b], XX = s.x.slope[a], YY = s.y.slope[b];
            const T value = dot4(f, s.z.value), slope = dot4(f, s.z.slope);
            const T pulled = g.value * value + g.z * slope;
            dx += (pulled * x.value[a] + g.x * value * x.slope[a]) * Y +
                  g.y * value * x.value[a] * YY;
            dy += (pulled * X + g.x * value * XX) * y.value[b] + g.y * value * X * y.slope[b];
            dz += ((g.value * X + g.x * XX) * Y + g.y * X * YY) * dot4(f, z.value) +
                  g.z * X * Y * dot4(f, z.slope);
        }
    }
    const int64_t C = kC ? kC : in.n_channels;
    for (int k = 0; k < 8; ++k) {
        const int a = 1 + (k >> 2), b = 1 + (k >> 1 & 1), c = 1 + (k & 1);
        const T* row = in.features + at.row(a, b, c) * C;
        T dot = 0;
#pragma omp simd reduction(+ : dot)
        for (int64_t i = 0; i < C; ++i) dot += row[i] * grad_feature[i];
        dx += dot * x.value[a] * s.y.value[b] * s.z.value[c];
        dy += dot * s.x.value[a] * y.value[b] * s.z.value[c];
        dz += dot * s.x.value[a] * s.y.value[b] * z.value[c];
    }
    grad_point[0] = dx, grad_point[1] = dy, grad_point[2] = dz;
}

/// Set a gradient of all slots, with `width` numbers each, to 0.
template <class T>
void clear(T* grad, int64_t n, int threads) {
    want_huge_pages(grad, n * static_cast<int64_t>(sizeof(T)));
    parallel_for(n, kNumbersPerChunk, threads,
                 [&](int64_t begin, int64_t end) { std::fill(grad + begin, grad + end, T(0)); });
}

/// Sum the samples into the gradients of sdf and features, slab by slab.
template <int64_t kC, class T, class Nodes, class Touched, class Rows>
void scatter(const Sampling<T, Nodes>& in, const SamplingGrads<T, Touched>& grads,
             const Rows* sdf_rows, const Rows* feature_rows, int threads) {
    const int64_t C = in.n_channels;
    const std::vector<int64_t> bounds = slab_bounds(in.lattice, in.points, in.n_points, in.order);
    const int64_t slabs = static_cast<int64_t>(bounds.size()) - 1;
    // Rows in order of x are cleared by the slab that is first to add to them, others all before.
    if constexpr (kComplete<Nodes>) {
        const int64_t end = in.lattice.size[0], bytes = sizeof(T);
        if (grads.grad_sdf) want_huge_pages(grads.grad_sdf, sdf_rows->slots_below(end) * bytes);
        if (grads.grad_features) {
            want_huge_pages(grads.grad_features, feature_rows->slots_below(end) * C * bytes);
        }
    } else {
        if (grads.grad_sdf) clear(grads.grad_sdf, sdf_rows->count(), threads);
        if (grads.grad_features) clear(grads.grad_features, feature_rows->count() * C, threads);
    }
    for_slabs(slabs, threads, [&](int64_t slab) {
        if constexpr (kComplete<Nodes>) {
            const Planes planes = planes_to_clear(in.lattice, slab, slabs);
            const auto clear_planes = [&](T* grad, const Rows* rows, int64_t width) {
                std::fill(grad + rows->slots_below(planes.begin) * width,
                          grad + rows->slots_below(planes.end) * width, T(0));
            };
            if (grads.grad_sdf) clear_planes(grads.grad_sdf, sdf_rows, 1);
            if (grads.grad_features) clear_planes(grads.grad_features, feature_rows, C);
        }
        for (int64_t j = bounds[slab]; j < bounds[slab + 1]; ++j) {
            const int64_t i = in.order[j];
            DCHECK(i >= 0 && i < in.n_points);
            const int64_t next = in.order[std::min(j + kAhead, bounds[slab + 1] - 1)];
            prefetch(in.points + 3 * next, 3);
            prefetch(grads.grad_value + next, 1);
            prefetch(grads.grad_gradient + 3 * next, 3);
            prefetch(grads.grad_feature + C * next, kC ? kC : C);
            const T* p = in.points + 3 * i;
            if (has_nan(p)) continue;
            const Located<T, Nodes> at = locate(in, p);
            if (grads.grad_sdf) scatter_sdf(*sdf_rows, at, pull_of(grads, i), grads.grad_sdf);
            if (grads.grad_features) {
                scatter_features<kC>(*feature_rows, at, grads.grad_feature + i * C, C,
                                     grads.grad_features);
            }
        }
    });
}

}  // namespace sampling

/// value [M] and feature [M, C] by trilinear interpolation; gradient [M, 3] by trilinear
/// interpolation of the nodes' central differences. NaN at NaN points.
template <class T, class Nodes>
void sample_forward(const Sampling<T, Nodes>& in, T* value, T* gradient, T* feature, int threads) {
    using namespace sampling;
    const int64_t C = in.n_channels;
    with_channels(C, [&](auto constant) {
        constexpr int64_t kC = decltype(constant)::value;
        parallel_for(in.n_points, kPointsPerChunk, threads, [&](int64_t begin, int64_t end) {
            Located<T, Nodes> located[kPointsPerBlock];
            for (int64_t j = begin; j < end; j += kPointsPerBlock) {
                const int64_t n = std::min(kPointsPerBlock, end - j);
                // Locate a few samples and fetch what they need, then sample.
                for (int64_t k = 0; k < n; ++k) {
                    const int64_t i = in.order[j + k];
                    const int64_t next = in.order[std::min(j + k + kAhead, end - 1)];
                    prefetch(in.points + 3 * next, 3);
                    prefetch(value + next, 1);
                    prefetch(gradient + 3 * next, 3);
                    prefetch(feature + C * next, kC ? kC : C);
                    located[k] = locate(in, in.points + 3 * i);
                    prefetch_nodes<kC>(in, located[k]);
                }
                for (int64_t k = 0; k < n; ++k) {
                    const int64_t i = in.order[j + k];
                    if (has_nan(in.points + 3 * i)) {
                        const T nan = std::numeric_limits<T>::quiet_NaN();
                        value[i] = nan;
                        std::fill(gradient + 3 * i, gradient + 3 * i + 3, nan);
                        std::fill(feature + C * i, feature + C * i + C, nan);
                        continue;
                    }
                    sample_sdf(in.sdf, located[k], value + i, gradient + 3 * i);
                    sample_features<kC>(in, located[k], feature + C * i);
                }
            }
        });
    });
}

template <class T, class Nodes, class Touched, class Rows>
void sample_backward(const Sampling<T, Nodes>& in, const SamplingGrads<T, Touched>& grads,
                     const Rows& all, int threads) {
    using namespace sampling;
    const int64_t C = in.n_channels;
    const int team = team_for(in.n_points, threads);
    with_channels(C, [&](auto constant) {
        constexpr int64_t kC = decltype(constant)::value;
        if (grads.sdf_rows || grads.feature_rows) {
            scatter<kC>(in, grads, grads.sdf_rows, grads.feature_rows, team);
        } else if (grads.grad_sdf || grads.grad_features) {
            scatter<kC>(in, grads, &all, &all, team);
        }
        if (!grads.grad_points) return;
        parallel_for(in.n_points, kPointsPerChunk, threads, [&](int64_t begin, int64_t end) {
            for (int64_t j = begin; j < end; ++j) {
                const int64_t i = in.order[j];
                const T* p = in.points + 3 * i;
                T* out = grads.grad_points + 3 * i;
                if (has_nan(p)) {
                    std::fill(out, out + 3, T(0));
                    continue;
                }
                point_gradient<kC>(in, p, pull_of(grads, i), grads.grad_feature + i * C, out);
            }
        });
    });
}

}  // namespace univoxel
