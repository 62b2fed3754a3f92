#include "dense_grid.h"

#include <algorithm>
#include <limits>

#include "channels.h"
#include "huge_pages.h"

namespace univoxel {
namespace {

constexpr int64_t kPointsPerChunk = 2048;

constexpr int64_t kBlock = 8;
constexpr int64_t kAhead = 12;  // samples: sorted ones lie anywhere in the buffers of the caller

/// Fetch the cache lines of n numbers before they are read or written.
template <class T>
inline void prefetch(const T* p, int64_t n) {
    constexpr int64_t kLine = 64 / sizeof(T);
    for (int64_t i = 0; i < n; i += kLine) __builtin_prefetch(p + i, 1);
    if (n) __builtin_prefetch(p + n - 1, 1);
}

template <class T>
struct Stencil3 {
    Stencil<T> x, y, z;
};

template <class T>
inline Stencil3<T> stencil3(const Lattice& grid, const T* p) {
    return {stencil<T>(grid, 0, place(grid, 0, static_cast<double>(p[0]))),
            stencil<T>(grid, 1, place(grid, 1, static_cast<double>(p[1]))),
            stencil<T>(grid, 2, place(grid, 2, static_cast<double>(p[2])))};
}

/// The four nodes of a line; one load where the line is not clamped.
template <class T>
inline void load4(const T* line, const Stencil<T>& z, T* f) {
    if (z.node[3] - z.node[0] == 3) {
        for (int c = 0; c < 4; ++c) f[c] = line[z.node[0] + c];
    } else {
        for (int c = 0; c < 4; ++c) f[c] = line[z.node[c]];
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
template <class T>
inline void sample_sdf(const DenseGrid<T>& in, const Stencil3<T>& s, T* value, T* gradient) {
    T straight[4] = {}, across_x[4] = {}, across_y[4] = {}, f[4];
    const auto load = [&](int a, int b) {
        const int64_t line = s.x.node[a] * in.lattice.size[1] + s.y.node[b];
        load4(in.sdf + line * in.lattice.size[2], s.z, f);
    };
    for (int k = 0; k < 4; ++k) {
        const int a = 1 + (k >> 1), b = 1 + (k & 1);
        load(a, b);
        add4(straight, s.x.value[a] * s.y.value[b], f);
        add4(across_x, s.x.slope[a] * s.y.value[b], f);
        add4(across_y, s.x.value[a] * s.y.slope[b], f);
    }
    for (int k = 0; k < 4; ++k) {
        const int outer = 3 * (k >> 1), middle = 1 + (k & 1);
        load(outer, middle);
        add4(across_x, s.x.slope[outer] * s.y.value[middle], f);
        load(middle, outer);
        add4(across_y, s.x.value[middle] * s.y.slope[outer], f);
    }
    *value = dot4(straight, s.z.value);
    gradient[0] = dot4(across_x, s.z.value);
    gradient[1] = dot4(across_y, s.z.value);
    gradient[2] = dot4(straight, s.z.slope);
}

/// First node of the pair of corners (a, b, .) along z, and how far the second is behind it.
template <class T>
inline int64_t corner(const Lattice& grid, const Stencil3<T>& s, int k) {
    const int64_t x = s.x.node[1 + (k >> 1)], y = s.y.node[1 + (k & 1)];
    return (x * grid.size[1] + y) * grid.size[2] + s.z.node[1];
}

template <int64_t kC, class T>
inline void sample_features(const DenseGrid<T>& in, const Stencil3<T>& s, T* feature) {
    const int64_t C = kC ? kC : in.n_channels;
    const int64_t far = (s.z.node[2] - s.z.node[1]) * C;
    const T *r0 = in.features + corner(in.lattice, s, 0) * C,
            *r1 = in.features + corner(in.lattice, s, 1) * C,
            *r2 = in.features + corner(in.lattice, s, 2) * C,
            *r3 = in.features + corner(in.lattice, s, 3) * C;
    const T w0 = s.x.value[1] * s.y.value[1], w1 = s.x.value[1] * s.y.value[2],
            w2 = s.x.value[2] * s.y.value[1], w3 = s.x.value[2] * s.y.value[2];
    const T near_z = s.z.value[1], far_z = s.z.value[2];
#pragma omp simd
    for (int64_t c = 0; c < C; ++c) {
        feature[c] =
            near_z * (w0 * r0[c] + w1 * r1[c] + w2 * r2[c] + w3 * r3[c]) +
            far_z * (w0 * r0[far + c] + w1 * r1[far + c] + w2 * r2[far + c] + w3 * r3[far + c]);
    }
}

/// Fetch the nodes around a sample, save the outermost: they lie in its neighbours' lines.
template <int64_t kC, class T>
inline void prefetch_nodes(const DenseGrid<T>& in, const Stencil3<T>& s) {
    const int64_t C = kC ? kC : in.n_channels;
    for (int a = 0; a < 4; ++a) {
        for (int b = 0; b < 4; ++b) {
            const int64_t line = s.x.node[a] * in.lattice.size[1] + s.y.node[b];
            __builtin_prefetch(in.sdf + line * in.lattice.size[2] + s.z.node[1]);
        }
    }
    for (int k = 0; k < 4; ++k) prefetch(in.features + corner(in.lattice, s, k) * C, 2 * C);
}

/// Slots of a dense gradient: every node has a row.
struct AllRows {
    const Lattice& grid;
    int64_t slot(int64_t x, int64_t y, int64_t z) const {
        return (x * grid.size[1] + y) * grid.size[2] + z;
    }
    int64_t slots_below(int64_t x) const { return slot(x, 0, 0); }
};

/// How far the loss pulls at the outputs of one sample.
template <class T>
struct Pull {
    T value, x, y, z;  // dL / d value, dL / d gradient
};

template <class T>
inline Pull<T> pull_of(const DenseGridGrads<T>& g, int64_t i) {
    const T* n = g.grad_gradient + 3 * i;
    return {g.grad_value[i], n[0], n[1], n[2]};
}

// dL/df at node (a, b, c) is the loss's pull on the weights,
//   (v X_a + gx X'_a) Y_b Z_c + gy X_a Y'_b Z_c + gz X_a Y_b Z'_c,
// X the value weights and X' the slope weights along x. See docs/derivations/dense_grid.md.
template <class T, class Rows>
inline void scatter_sdf(const Rows& rows, const Stencil3<T>& s, const Pull<T>& g, T* grad_sdf) {
    const bool whole = s.z.node[3] - s.z.node[0] == 3;
    const int64_t far = s.z.node[2] - s.z.node[1];
    for (int k = 0; k < 4; ++k) {
        const int a = 1 + (k >> 1), b = 1 + (k & 1);
        const T straight = (g.value * s.x.value[a] + g.x * s.x.slope[a]) * s.y.value[b] +
                           g.y * s.x.value[a] * s.y.slope[b];
        const T along = g.z * s.x.value[a] * s.y.value[b];
        T* out = grad_sdf + rows.slot(s.x.node[a], s.y.node[b], s.z.node[0]);
        T add[4];
        for (int c = 0; c < 4; ++c) add[c] = straight * s.z.value[c] + along * s.z.slope[c];
        if (whole) {
            for (int c = 0; c < 4; ++c) out[c] += add[c];
        } else {
            for (int c = 0; c < 4; ++c) out[s.z.node[c] - s.z.node[0]] += add[c];
        }
    }
    const auto add2 = [&](int a, int b, T weight) {
        T* out = grad_sdf + rows.slot(s.x.node[a], s.y.node[b], s.z.node[1]);
        out[0] += weight * s.z.value[1];
        out[far] += weight * s.z.value[2];
    };
    for (int k = 0; k < 4; ++k) {
        const int outer = 3 * (k >> 1), middle = 1 + (k & 1);
        add2(outer, middle, g.x * s.x.slope[outer] * s.y.value[middle]);
        add2(middle, outer, g.y * s.x.value[middle] * s.y.slope[outer]);
    }
}

template <int64_t kC, class T, class Rows>
inline void scatter_features(const Rows& rows, const Stencil3<T>& s, const T* g, int64_t channels,
                             T* grad_features) {
    const int64_t C = kC ? kC : channels;
    const int64_t far = (s.z.node[2] - s.z.node[1]) * C;
    for (int k = 0; k < 4; ++k) {
        const int a = 1 + (k >> 1), b = 1 + (k & 1);
        const T w = s.x.value[a] * s.y.value[b];
        const T near_w = w * s.z.value[1], far_w = w * s.z.value[2];
        T* out = grad_features + rows.slot(s.x.node[a], s.y.node[b], s.z.node[1]) * C;
#pragma omp simd
        for (int64_t c = 0; c < C; ++c) out[c] += near_w * g[c];
        T* out_far = out + far;
#pragma omp simd
        for (int64_t c = 0; c < C; ++c) out_far[c] += far_w * g[c];
    }
}

/// dL/d point of one sample: the same sums with the weights' derivatives.
template <int64_t kC, class T>
inline void point_gradient(const DenseGrid<T>& in, const T* point, const Pull<T>& g,
                           const T* grad_feature, T* grad_point) {
    const Stencil3<T> s = stencil3(in.lattice, point);
    StencilStep<T> step[3];
    for (int d = 0; d < 3; ++d) {
        step[d] = stencil_step<T>(in.lattice, place(in.lattice, d, static_cast<double>(point[d])));
    }
    const StencilStep<T>&x = step[0], &y = step[1], &z = step[2];
    T dx = 0, dy = 0, dz = 0, f[4];
    for (int a = 0; a < 4; ++a) {
        for (int b = 0; b < 4; ++b) {
            const int64_t line = s.x.node[a] * in.lattice.size[1] + s.y.node[b];
            load4(in.sdf + line * in.lattice.size[2], s.z, f);
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
        const int64_t line = s.x.node[a] * in.lattice.size[1] + s.y.node[b];
        const T* row = in.features + (line * in.lattice.size[2] + s.z.node[c]) * C;
        T dot = 0;
#pragma omp simd reduction(+ : dot)
        for (int64_t i = 0; i < C; ++i) dot += row[i] * grad_feature[i];
        dx += dot * x.value[a] * s.y.value[b] * s.z.value[c];
        dy += dot * s.x.value[a] * y.value[b] * s.z.value[c];
        dz += dot * s.x.value[a] * s.y.value[b] * z.value[c];
    }
    grad_point[0] = dx, grad_point[1] = dy, grad_point[2] = dz;
}

/// Sum the samples into the gradients of sdf and features, slab by slab.
template <int64_t kC, class T, class Rows>
void scatter(const DenseGrid<T>& in, const DenseGridGrads<T>& grads, const Rows* sdf_rows,
             const Rows* feature_rows, int threads) {
    const int64_t C = in.n_channels;
    const std::vector<int64_t> bounds = slab_bounds(in.lattice, in.points, in.n_points, in.order);
    const int64_t slabs = static_cast<int64_t>(bounds.size()) - 1;
    const int64_t end = in.lattice.size[0], bytes = sizeof(T);
    if (grads.grad_sdf) want_huge_pages(grads.grad_sdf, sdf_rows->slots_below(end) * bytes);
    if (grads.grad_features) {
        want_huge_pages(grads.grad_features, feature_rows->slots_below(end) * C * bytes);
    }
    for_slabs(slabs, threads, [&](int64_t slab) {
        const Planes planes = planes_to_clear(in.lattice, slab, slabs);
        const auto clear = [&](T* grad, const Rows* rows, int64_t width) {
            std::fill(grad + rows->slots_below(planes.begin) * width,
                      grad + rows->slots_below(planes.end) * width, T(0));
        };
        if (grads.grad_sdf) clear(grads.grad_sdf, sdf_rows, 1);
        if (grads.grad_features) clear(grads.grad_features, feature_rows, C);
        for (int64_t j = bounds[slab]; j < bounds[slab + 1]; ++j) {
            const int64_t i = in.order[j];
            const int64_t next = in.order[std::min(j + kAhead, bounds[slab + 1] - 1)];
            prefetch(in.points + 3 * next, 3);
            prefetch(grads.grad_value + next, 1);
            prefetch(grads.grad_gradient + 3 * next, 3);
            prefetch(grads.grad_feature + C * next, kC ? kC : C);
            const T* p = in.points + 3 * i;
            if (has_nan(p)) continue;
            const Stencil3<T> s = stencil3(in.lattice, p);
            if (grads.grad_sdf) scatter_sdf(*sdf_rows, s, pull_of(grads, i), grads.grad_sdf);
            if (grads.grad_features) {
                scatter_features<kC>(*feature_rows, s, grads.grad_feature + i * C, C,
                                     grads.grad_features);
            }
        }
    });
}

}  // namespace

template <class T>
void sample_dense_forward(const DenseGrid<T>& in, T* value, T* gradient, T* feature, int threads) {
    const int64_t C = in.n_channels;
    with_channels(C, [&](auto constant) {
        constexpr int64_t kC = decltype(constant)::value;
        parallel_for(in.n_points, kPointsPerChunk, threads, [&](int64_t begin, int64_t end) {
            Stencil3<T> stencils[kBlock];
            for (int64_t j = begin; j < end; j += kBlock) {
                const int64_t n = std::min(kBlock, end - j);
                // Locate a few samples and fetch what they need, then sample.
                for (int64_t k = 0; k < n; ++k) {
                    const int64_t i = in.order[j + k];
                    const int64_t next = in.order[std::min(j + k + kAhead, end - 1)];
                    prefetch(in.points + 3 * next, 3);
                    prefetch(value + next, 1);
                    prefetch(gradient + 3 * next, 3);
                    prefetch(feature + C * next, kC ? kC : C);
                    stencils[k] = stencil3(in.lattice, in.points + 3 * i);
                    prefetch_nodes<kC>(in, stencils[k]);
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
                    sample_sdf(in, stencils[k], value + i, gradient + 3 * i);
                    sample_features<kC>(in, stencils[k], feature + C * i);
                }
            }
        });
    });
}

template <class T>
void sample_dense_backward(const DenseGrid<T>& in, const DenseGridGrads<T>& grads, int threads) {
    const int64_t C = in.n_channels;
    const int team = team_for(in.n_points, threads);
    with_channels(C, [&](auto constant) {
        constexpr int64_t kC = decltype(constant)::value;
        if (grads.sdf_rows || grads.feature_rows) {
            scatter<kC>(in, grads, grads.sdf_rows, grads.feature_rows, team);
        } else if (grads.grad_sdf || grads.grad_features) {
            const AllRows all{in.lattice};
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

template void sample_dense_forward(const DenseGrid<float>&, float*, float*, float*, int);
template void sample_dense_forward(const DenseGrid<double>&, double*, double*, double*, int);
template void sample_dense_backward(const DenseGrid<float>&, const DenseGridGrads<float>&, int);
template void sample_dense_backward(const DenseGrid<double>&, const DenseGridGrads<double>&, int);

}  // namespace univoxel
