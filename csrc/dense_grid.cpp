#include "dense_grid.h"

#include <algorithm>
#include <limits>
#include <type_traits>

namespace univoxel {
namespace {

constexpr int64_t kPointsPerChunk = 2048;
constexpr int64_t kSerialBelow = 2048;  // points: fewer are done before a thread team stands

/// Call f with the channel count as a compile-time constant where it is a common one, else 0.
template <class F>
void with_channels(int64_t n, F&& f) {
    switch (n) {
        case 8:
            return f(std::integral_constant<int64_t, 8>{});
        case 12:
            return f(std::integral_constant<int64_t, 12>{});
        case 16:
            return f(std::integral_constant<int64_t, 16>{});
        default:
            return f(std::integral_constant<int64_t, 0>{});
    }
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

/// Whether line (a, b) of the 4 x 4 lines along z carries all four nodes; the other lines carry
/// the middle two, and those at the corners none.
inline bool inner(int a) {
    return a == 1 || a == 2;
}

/// Sums along one line of the stencil.
template <class T>
struct Line {
    T value, slope;            // sum of f times the weights along z
    T value_step, slope_step;  // and their derivatives to the point's z
};

template <class T>
inline Line<T> sum_line(const T* f, const Stencil<T>& z, bool all) {
    const T f1 = f[z.node[1]], f2 = f[z.node[2]];
    Line<T> line{z.value[1] * f1 + z.value[2] * f2, 0, z.value_step[1] * f1 + z.value_step[2] * f2,
                 0};
    if (all) {
        const T f0 = f[z.node[0]], f3 = f[z.node[3]];
        line.slope = z.slope[0] * f0 + z.slope[1] * f1 + z.slope[2] * f2 + z.slope[3] * f3;
        line.slope_step = z.slope_step[0] * f0 + z.slope_step[1] * f1 + z.slope_step[2] * f2 +
                          z.slope_step[3] * f3;
    }
    return line;
}

template <class T>
inline void sample_sdf(const DenseGrid<T>& in, const Stencil3<T>& s, T* value, T* gradient) {
    T v = 0, gx = 0, gy = 0, gz = 0;
    for (int a = 0; a < 4; ++a) {
        for (int b = 0; b < 4; ++b) {
            if (!inner(a) && !inner(b)) continue;
            const T* f =
                in.sdf + (s.x.node[a] * in.lattice.size[1] + s.y.node[b]) * in.lattice.size[2];
            const Line<T> line = sum_line(f, s.z, inner(a) && inner(b));
            v += s.x.value[a] * s.y.value[b] * line.value;
            gx += s.x.slope[a] * s.y.value[b] * line.value;
            gy += s.x.value[a] * s.y.slope[b] * line.value;
            gz += s.x.value[a] * s.y.value[b] * line.slope;
        }
    }
    *value = v;
    gradient[0] = gx, gradient[1] = gy, gradient[2] = gz;
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
    const int64_t first = s.z.node[0], middle = s.z.node[1];
    for (int a = 0; a < 4; ++a) {
        for (int b = 0; b < 4; ++b) {
            if (!inner(a) && !inner(b)) continue;
            const T straight = (g.value * s.x.value[a] + g.x * s.x.slope[a]) * s.y.value[b] +
                               g.y * s.x.value[a] * s.y.slope[b];
            if (inner(a) && inner(b)) {
                const T along = g.z * s.x.value[a] * s.y.value[b];
                T* out = grad_sdf + rows.slot(s.x.node[a], s.y.node[b], first);
                for (int c = 0; c < 4; ++c) {
                    out[s.z.node[c] - first] += straight * s.z.value[c] + along * s.z.slope[c];
                }
            } else {
                T* out = grad_sdf + rows.slot(s.x.node[a], s.y.node[b], middle);
                out[0] += straight * s.z.value[1];
                out[s.z.node[2] - middle] += straight * s.z.value[2];
            }
        }
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
inline void point_gradient(const DenseGrid<T>& in, const Stencil3<T>& s, const Pull<T>& g,
                           const T* grad_feature, T* grad_point) {
    T dx = 0, dy = 0, dz = 0;
    for (int a = 0; a < 4; ++a) {
        for (int b = 0; b < 4; ++b) {
            if (!inner(a) && !inner(b)) continue;
            const T* f =
                in.sdf + (s.x.node[a] * in.lattice.size[1] + s.y.node[b]) * in.lattice.size[2];
            const Line<T> line = sum_line(f, s.z, inner(a) && inner(b));
            const T X = s.x.value[a], Y = s.y.value[b], XX = s.x.slope[a], YY = s.y.slope[b];
            const T dX = s.x.value_step[a], dY = s.y.value_step[b];
            const T dXX = s.x.slope_step[a], dYY = s.y.slope_step[b];
            const T pulled = g.value * line.value + g.z * line.slope;
            dx += (pulled * dX + g.x * line.value * dXX) * Y + g.y * line.value * dX * YY;
            dy += (pulled * X + g.x * line.value * XX) * dY + g.y * line.value * X * dYY;
            dz += ((g.value * X + g.x * XX) * Y + g.y * X * YY) * line.value_step +
                  g.z * X * Y * line.slope_step;
        }
    }
    const int64_t C = kC ? kC : in.n_channels;
    for (int k = 0; k < 8; ++k) {
        const int a = 1 + (k >> 2), b = 1 + (k >> 1 & 1), c = 1 + (k & 1);
        const int64_t node =
            (s.x.node[a] * in.lattice.size[1] + s.y.node[b]) * in.lattice.size[2] + s.z.node[c];
        const T* row = in.features + node * C;
        T dot = 0;
#pragma omp simd reduction(+ : dot)
        for (int64_t i = 0; i < C; ++i) dot += row[i] * grad_feature[i];
        dx += dot * s.x.value_step[a] * s.y.value[b] * s.z.value[c];
        dy += dot * s.x.value[a] * s.y.value_step[b] * s.z.value[c];
        dz += dot * s.x.value[a] * s.y.value[b] * s.z.value_step[c];
    }
    grad_point[0] = dx, grad_point[1] = dy, grad_point[2] = dz;
}

/// Sum the samples into the rows of a gradient with `width` numbers each, slab by slab.
template <class T, class Rows, class F>
void accumulate(const DenseGrid<T>& in, const std::vector<int64_t>& bounds, const Rows& rows,
                int64_t width, T* grad, int threads, F&& add) {
    const int64_t slabs = static_cast<int64_t>(bounds.size()) - 1;
    for_slabs(slabs, threads, [&](int64_t slab) {
        const Planes planes = planes_to_clear(in.lattice, slab, slabs);
        std::fill(grad + rows.slots_below(planes.begin) * width,
                  grad + rows.slots_below(planes.end) * width, T(0));
        for (int64_t j = bounds[slab]; j < bounds[slab + 1]; ++j) {
            const int64_t i = in.order[j];
            const T* p = in.points + 3 * i;
            if (!has_nan(p)) add(i, stencil3(in.lattice, p));
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
            for (int64_t j = begin; j < end; ++j) {
                const int64_t i = in.order[j];
                const T* p = in.points + 3 * i;
                if (has_nan(p)) {
                    const T nan = std::numeric_limits<T>::quiet_NaN();
                    value[i] = nan;
                    std::fill(gradient + 3 * i, gradient + 3 * i + 3, nan);
                    std::fill(feature + C * i, feature + C * i + C, nan);
                    continue;
                }
                const Stencil3<T> s = stencil3(in.lattice, p);
                sample_sdf(in, s, value + i, gradient + 3 * i);
                sample_features<kC>(in, s, feature + C * i);
            }
        });
    });
}

template <class T>
void sample_dense_backward(const DenseGrid<T>& in, const DenseGridGrads<T>& grads, int threads) {
    const int64_t C = in.n_channels;
    const int team = in.n_points < kSerialBelow ? 1 : threads;
    const std::vector<int64_t> bounds = slab_bounds(in.lattice, in.points, in.n_points, in.order);
    const auto into_sdf = [&](const auto& rows) {
        accumulate(in, bounds, rows, 1, grads.grad_sdf, team, [&](int64_t i, const auto& s) {
            scatter_sdf(rows, s, pull_of(grads, i), grads.grad_sdf);
        });
    };
    if (grads.grad_sdf) {
        if (grads.sdf_rows)
            into_sdf(*grads.sdf_rows);
        else
            into_sdf(AllRows{in.lattice});
    }
    with_channels(C, [&](auto constant) {
        constexpr int64_t kC = decltype(constant)::value;
        const auto into_features = [&](const auto& rows) {
            accumulate(in, bounds, rows, C, grads.grad_features, team,
                       [&](int64_t i, const auto& s) {
                           scatter_features<kC>(rows, s, grads.grad_feature + i * C, C,
                                                grads.grad_features);
                       });
        };
        if (grads.grad_features) {
            if (grads.feature_rows)
                into_features(*grads.feature_rows);
            else
                into_features(AllRows{in.lattice});
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
                point_gradient<kC>(in, stencil3(in.lattice, p), pull_of(grads, i),
                                   grads.grad_feature + i * C, out);
            }
        });
    });
}

template void sample_dense_forward(const DenseGrid<float>&, float*, float*, float*, int);
template void sample_dense_forward(const DenseGrid<double>&, double*, double*, double*, int);
template void sample_dense_backward(const DenseGrid<float>&, const DenseGridGrads<float>&, int);
template void sample_dense_backward(const DenseGrid<double>&, const DenseGridGrads<double>&, int);

}  // namespace univoxel
