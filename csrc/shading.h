// Shared by the kernels that shade: directions in the frame of a normal, and the BRDF's loops over
// them. docs/method/gradients-shading.md derives the gradients.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <iterator>
#include <type_traits>
#include <utility>
#include <vector>

#include "brdf.h"
#include "common.h"
#include "frame.h"

namespace univoxel {

/// Directions in the frame of a normal, each coordinate in a column of its own, and scratch columns
/// of the same length. Columns begin at cache lines: a vector that straddles two takes two loads.
template <class T>
struct Directions {
    int64_t count;
    std::vector<T> buffer;
    T *x, *y, *z;
    T* cosine;          // max(n.w, 0)
    T* clamped_cosine;  // max(n.w, kCosMin); std::max of z[d] in a loop would keep it scalar
    T* layer;           // D F V max(n.w, 0); with F0 per channel, of F0 = 0
    T* grad_layer;
    T* lobe;  // of a spherical Gaussian
    T* gain;  // with F0 per channel: how much more F0 = 1 gives
    T* grad_gain;

    explicit Directions(int64_t n) : count(n) {
        T** const columns[] = {&x,     &y,          &z,    &cosine, &clamped_cosine,
                               &layer, &grad_layer, &lobe, &gain,   &grad_gain};
        constexpr int64_t kLine = 64 / sizeof(T);
        const int64_t step = (n + kLine - 1) / kLine * kLine;
        buffer.resize(std::size(columns) * step + kLine);
        const auto past = reinterpret_cast<uintptr_t>(buffer.data()) / sizeof(T) % kLine;
        T* next = buffer.data() + (kLine - past) % kLine;
        for (T** column : columns) *column = std::exchange(next, next + step);
    }
    Directions(Directions&&) = default;  // a copy's columns would point into the original
};

// F0 is a number, the same for all channels, or a color: code below takes its type. Schlick's F is
// linear in it, so a colored layer is two numbers a direction: layer + F0 gain.
template <class F0>
constexpr bool kColored = !std::is_floating_point_v<F0>;

/// Call f with the function that gives F0 of point i, from a buffer of [N, 3] or of one number.
template <class T, class F>
void with_f0(const T* f0, bool colored, F&& f) {
    if (colored)
        f([f0](int64_t i) { return load3(f0, i); });
    else
        f([f0](int64_t) { return *f0; });
}

template <class T>
inline T sum_of(const vec3<T>& v) {
    return v.x + v.y + v.z;
}
template <class T>
inline std::enable_if_t<std::is_floating_point_v<T>, T> sum_of(T x) {
    return x;
}

/// The BRDF of one point seen from wo, in the frame of its normal: there the normal is +Z.
template <class T, class F0>
struct LocalBrdf {
    vec3<T> wo;  // local
    T v, a2;     // n.wo, at least kCosMin, alpha squared
    F0 f0;
    decltype(specular_albedo(T(), T(), std::declval<F0>())) layer;
    vec3<T> diffuse;  // (1 - E) albedo / pi

    LocalBrdf(const vec3<T>& local_wo, const vec3<T>& albedo, T roughness, const F0& f0_)
        : wo(local_wo), v(std::max(wo.z, T(kCosMin))), f0(f0_) {
        const T alpha = ggx_alpha(roughness);
        a2 = alpha * alpha;
        layer = specular_albedo(wo.z, roughness, f0);
        diffuse = albedo * ((T(1) - layer.value) / T(kPi));
    }

    /// Color of what the columns `layer` and `gain` sum to.
    vec3<T> color_of(T layer_sum, [[maybe_unused]] T gain) const {
        if constexpr (kColored<F0>)
            return layer_sum + f0 * gain;
        else
            return vec3<T>(layer_sum);
    }

    /// Gradients to albedo, roughness, n.wo inside E and E from those to `diffuse` and `a2`.
    struct Gradients {
        vec3<T> albedo;
        T roughness, cosine;
        F0 e;
    };
    Gradients backward(const vec3<T>& grad_diffuse, T grad_a2, const vec3<T>& albedo,
                       T roughness) const {
        const vec3<T> to_e = -grad_diffuse * albedo / T(kPi);
        F0 grad_e;
        if constexpr (kColored<F0>)
            grad_e = to_e;
        else
            grad_e = sum_of(to_e);
        const T r = roughness, d_a2 = r * r >= T(kAlphaMin) ? 4 * r * r * r : T(0);
        return {grad_diffuse * ((T(1) - layer.value) / T(kPi)),
                sum_of(grad_e * layer.d_roughness) + grad_a2 * d_a2,
                sum_of(grad_e * layer.d_cosine), grad_e};
    }
};

// In the two loops over directions below q = |wi + wo|^2, and D's denominator is taken times q:
// `raw`, and `den` with the floor of ggx_denominator.

/// Fill `layer`, and `gain` for a colored F0. D V is one quotient: divisions are dear.
template <class T, class F0>
void specular_layer(const LocalBrdf<T, F0>& p, Directions<T>& dir) {
    const T *x = dir.x, *y = dir.y, *z = dir.z, *cosine = dir.cosine, *clamped = dir.clamped_cosine;
    T* out = dir.layer;
    [[maybe_unused]] T* out_gain = dir.gain;
    const T ox = p.wo.x, oy = p.wo.y, oz = p.wo.z;
    const T a2 = p.a2, v = p.v, root_v = smith_root(v, a2), scale = a2 / T(2 * kPi);
    [[maybe_unused]] const F0 f0 = p.f0;
    const int64_t count = dir.count;
#pragma omp simd
    for (int64_t d = 0; d < count; ++d) {
        const T hx = x[d] + ox, hy = y[d] + oy, hz = z[d] + oz;
        const T xy = hx * hx + hy * hy, q = xy + hz * hz + T(kHalfEpsilon);
        const T raw = xy + a2 * hz * hz, den = std::max(raw, T(0.5) * a2 * q);
        const T l = clamped[d], smith = l * root_v + v * smith_root(l, a2);
        const T top = scale * q * q * cosine[d], cosine_h = T(0.5) * std::sqrt(q);
        if constexpr (kColored<F0>) {
            const T white = top / (den * den * smith), black = white * schlick_weight(cosine_h);
            out[d] = black;
            out_gain[d] = white - black;
        } else {
            out[d] = top * schlick_f(cosine_h, f0) / (den * den * smith);
        }
    }
}

template <class T>
struct SpecularLayerGrad {
    T a2;
    vec3<T> wo, normal;  // local
};

/// Gradients of sum_d grad_layer_d layer_d + grad_gain_d gain_d; those to wo and to the normal are
/// 0 unless asked for. The normal is a vector of its own, of any length.
template <bool kToWo, bool kToNormal, class T, class F0>
SpecularLayerGrad<T> specular_layer_backward(const LocalBrdf<T, F0>& p, const Directions<T>& dir) {
    const T *x = dir.x, *y = dir.y, *z = dir.z, *cosine = dir.cosine, *clamped = dir.clamped_cosine,
            *grad = dir.grad_layer;
    [[maybe_unused]] const T* grad_gain = dir.grad_gain;
    const T ox = p.wo.x, oy = p.wo.y, oz = p.wo.z;
    const T a2 = p.a2, v = p.v, root_v = smith_root(v, a2), scale = a2 / T(2 * kPi);
    const T inv_a2 = 1 / a2;
    [[maybe_unused]] const F0 f0 = p.f0;
    const int64_t count = dir.count;
    T gx = 0, gy = 0, gz = 0, gv = 0, g_root = 0, ga = 0, nx = 0, ny = 0, nz = 0;
#pragma omp simd reduction(+ : gx, gy, gz, gv, g_root, ga, nx, ny, nz)
    for (int64_t d = 0; d < count; ++d) {
        const T hx = x[d] + ox, hy = y[d] + oy, hz = z[d] + oz;
        const T xy = hx * hx + hy * hy, q = xy + hz * hz + T(kHalfEpsilon);
        const T raw = xy + a2 * hz * hz, den = std::max(raw, T(0.5) * a2 * q);
        const T l = clamped[d];
        const T root_l2 = l * l * (1 - a2) + a2, inv_root_l = 1 / std::sqrt(root_l2);
        const T root_l = root_l2 * inv_root_l, smith = l * root_v + v * root_l;
        const T inv_length = 1 / std::sqrt(q), inv_q = inv_length * inv_length;
        const T cosine_h = T(0.5) * q * inv_length;
        const T quotient = 1 / (den * den * smith);
        const T inv_den = quotient * den * smith;
        const T inv_smith = quotient * den * den;
        const T dv = scale * q * q * quotient;
        // F's share at normal incidence, and what comes on top of it with (1 - wo.h)^5.
        T steady;
        if constexpr (kColored<F0>)
            steady = grad_gain[d];
        else
            steady = f0 * grad[d];
        const T rising = grad[d] - steady;
        const T to_dv = steady + rising * schlick_weight(cosine_h);
        const T r = dv * cosine[d] * to_dv;  // grad * value
        // D = a^2 q^2 / (pi denominator^2); its floor passes gradient to alpha alone.
        const bool live = raw > T(0.5) * a2 * q;
        const T g_den = -2 * r * inv_den;
        const T g_live = live ? g_den : T(0);
        ga += r * inv_a2 + g_den * (live ? hz * hz : T(0.5) * q);
        if constexpr (kToWo) {
            const T g_q = live ? 2 * r * inv_q : T(0);
            // F, through wo.h = sqrt(q) / 2.
            const T m = 1 - cosine_h, m2 = m * m;
            const T g_half = dv * cosine[d] * rising * T(-2.5) * m2 * m2 * inv_length;
            const T g_xy = 2 * (g_live + g_q) + g_half;
            gx += hx * g_xy;
            gy += hy * g_xy;
            gz += hz * (2 * (g_live * a2 + g_q) + g_half);
        }
        // V = 1 / (2 smith)
        const T g_smith = -r * inv_smith;
        g_root += g_smith * l;
        ga += g_smith * v * (1 - l * l) * T(0.5) * inv_root_l;
        if constexpr (kToWo || kToNormal) gv += g_smith * root_l;
        if constexpr (kToNormal) {
            // |n x h|^2 = |n|^2 |h|^2 - (n.h)^2, then n.wi in V and as the cosine.
            const T across = 2 * g_live * (a2 - 1) * hz;
            const T in_v = g_smith * (root_v + v * l * (1 - a2) * inv_root_l);
            const T along = (z[d] >= T(kCosMin) ? in_v : T(0)) + (z[d] > 0 ? dv * to_dv : T(0));
            nx += across * hx + along * x[d];
            ny += across * hy + along * y[d];
            nz += 2 * g_live * raw + along * z[d];
        }
    }
    ga += g_root * (1 - v * v) / (2 * root_v);
    if constexpr (!kToWo && !kToNormal) return {ga, vec3<T>(0), vec3<T>(0)};
    gv = oz >= T(kCosMin) ? gv + g_root * v * (1 - a2) / root_v : T(0);
    return {ga,
            {gx, gy, kToWo ? gz + gv : T(0)},
            kToNormal ? vec3<T>(nx, ny, nz) + gv * p.wo : vec3<T>(0)};
}

}  // namespace univoxel
