// Shared by the kernels that shade: directions in the frame of a normal, and the BRDF's loops over
// them. docs/derivations/sg.md derives the gradients.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "brdf.h"
#include "common.h"

namespace univoxel {

/// Directions in the frame of a normal, each coordinate in a row of its own, and scratch rows of
/// the same length. Rows begin at cache lines: a vector that straddles two takes two loads.
template <class T>
struct Directions {
    int64_t count;
    std::vector<T> buffer;
    T *x, *y, *z, *cosine, *held, *layer, *grad_layer, *lobe;

    explicit Directions(int64_t n) : count(n) {
        constexpr int64_t kLine = 64 / sizeof(T);
        const int64_t step = (n + kLine - 1) / kLine * kLine;
        buffer.resize(8 * step + kLine);
        const auto past = reinterpret_cast<uintptr_t>(buffer.data()) / sizeof(T) % kLine;
        T* first = buffer.data() + (kLine - past) % kLine;
        T* rows[8];
        for (int i = 0; i < 8; ++i) rows[i] = first + i * step;
        x = rows[0], y = rows[1], z = rows[2];
        cosine = rows[3];  // max(n.w, 0)
        held = rows[4];   // n.w held above kCosMin; std::max of z[d] in a loop would keep it scalar
        layer = rows[5];  // D F V max(n.w, 0)
        grad_layer = rows[6];  // its gradient
        lobe = rows[7];        // of a spherical Gaussian
    }
    Directions(Directions&&) = default;  // a copy's rows would point into the original
};

/// The frame of Duff et al. 2017 around a normal. Its rows take a world vector to local
/// coordinates.
template <class T>
struct Frame {
    vec3<T> tangent, bitangent, normal;
    T sign, a;

    explicit Frame(const vec3<T>& n) : normal(n), sign(std::copysign(T(1), n.z)) {
        a = -1 / (sign + n.z);
        const T b = n.x * n.y * a;
        tangent = {1 + sign * n.x * n.x * a, sign * b, -sign * n.x};
        bitangent = {b, sign + n.y * n.y * a, -n.y};
    }

    /// Gradient to the normal from those to the three rows.
    vec3<T> backward(const vec3<T>& gt, const vec3<T>& gb, const vec3<T>& gn) const {
        const T x = normal.x, y = normal.y;
        const T grad_b = sign * gt.y + gb.x;
        const T grad_a = gt.x * sign * x * x + gb.y * y * y + grad_b * x * y;
        return gn + vec3<T>(2 * gt.x * sign * x * a - sign * gt.z + grad_b * y * a,
                            2 * gb.y * y * a - gb.z + grad_b * x * a, grad_a * a * a);
    }
};

/// The BRDF of one point seen from wo, in the frame of its normal: there the normal is +Z.
template <class T>
struct LocalBrdf {
    vec3<T> wo;  // local
    T v, a2;     // n.wo held above kCosMin, alpha squared
    SpecularAlbedo<T> layer;
    vec3<T> diffuse;  // (1 - E) albedo / pi

    LocalBrdf(const vec3<T>& local_wo, const vec3<T>& albedo, T roughness, T f0)
        : wo(local_wo), v(std::max(wo.z, T(kCosMin))) {
        const T alpha = ggx_alpha(roughness);
        a2 = alpha * alpha;
        layer = specular_albedo(wo.z, roughness, f0);
        diffuse = albedo * ((1 - layer.value) / T(kPi));
    }

    /// Gradients to albedo, roughness and E from those to `diffuse` and `a2`.
    struct Gradients {
        vec3<T> albedo;
        T roughness, e;
    };
    Gradients backward(const vec3<T>& grad_diffuse, T grad_a2, const vec3<T>& albedo,
                       T roughness) const {
        const T grad_e = -glm::dot(grad_diffuse, albedo) / T(kPi), r = roughness;
        const T d_a2 = r * r >= T(kAlphaMin) ? 4 * r * r * r : T(0);
        return {grad_diffuse * ((1 - layer.value) / T(kPi)),
                grad_e * layer.d_roughness + grad_a2 * d_a2, grad_e};
    }
};

// In the two loops over directions below q = |wi + wo|^2, and D's denominator is taken times q:
// `raw`, and `den` with the floor of ggx_denominator.

/// Fill `layer`: D F V max(n.w, 0) for every direction. D V is one quotient: divisions are dear.
template <class T>
void specular_layer(const LocalBrdf<T>& p, T f0, Directions<T>& dir) {
    const T *x = dir.x, *y = dir.y, *z = dir.z, *cosine = dir.cosine, *held = dir.held;
    T* out = dir.layer;
    const T ox = p.wo.x, oy = p.wo.y, oz = p.wo.z;
    const T a2 = p.a2, v = p.v, root_v = smith_root(v, a2), scale = a2 / T(2 * kPi);
    const int64_t count = dir.count;
#pragma omp simd
    for (int64_t d = 0; d < count; ++d) {
        const T hx = x[d] + ox, hy = y[d] + oy, hz = z[d] + oz;
        const T xy = hx * hx + hy * hy, q = xy + hz * hz + T(kHalfEpsilon);
        const T raw = xy + a2 * hz * hz, den = std::max(raw, T(0.5) * a2 * q);
        const T l = held[d], smith = l * root_v + v * smith_root(l, a2);
        const T top = scale * q * q * cosine[d];
        out[d] = top * schlick_f(T(0.5) * std::sqrt(q), f0) / (den * den * smith);
    }
}

template <class T>
struct SpecularLayerGrad {
    T a2;
    vec3<T> wo;  // local
};

/// Gradients of sum_d grad_layer_d layer_d; that to wo is 0 unless asked for.
template <bool kToWo, class T>
SpecularLayerGrad<T> specular_layer_backward(const LocalBrdf<T>& p, T f0,
                                             const Directions<T>& dir) {
    const T *x = dir.x, *y = dir.y, *z = dir.z, *cosine = dir.cosine, *held = dir.held,
            *grad = dir.grad_layer;
    const T ox = p.wo.x, oy = p.wo.y, oz = p.wo.z;
    const T a2 = p.a2, v = p.v, root_v = smith_root(v, a2), scale = a2 / T(2 * kPi);
    const T inv_a2 = 1 / a2;
    const int64_t count = dir.count;
    T gx = 0, gy = 0, gz = 0, gv = 0, g_root = 0, ga = 0;
#pragma omp simd reduction(+ : gx, gy, gz, gv, g_root, ga)
    for (int64_t d = 0; d < count; ++d) {
        const T hx = x[d] + ox, hy = y[d] + oy, hz = z[d] + oz;
        const T xy = hx * hx + hy * hy, q = xy + hz * hz + T(kHalfEpsilon);
        const T raw = xy + a2 * hz * hz, den = std::max(raw, T(0.5) * a2 * q);
        const T l = held[d];
        const T root_l2 = l * l * (1 - a2) + a2, inv_root_l = 1 / std::sqrt(root_l2);
        const T root_l = root_l2 * inv_root_l, smith = l * root_v + v * root_l;
        const T inv_length = 1 / std::sqrt(q), inv_q = inv_length * inv_length;
        const T cosine_h = T(0.5) * q * inv_length;
        const T quotient = 1 / (den * den * smith);
        const T inv_den = quotient * den * smith;
        const T inv_smith = quotient * den * den;
        const T dv = scale * q * q * quotient * cosine[d] * grad[d];
        const T r = dv * schlick_f(cosine_h, f0);  // grad * value
        // D = a^2 q^2 / (pi denominator^2); its floor passes gradient to alpha alone.
        const bool live = raw > T(0.5) * a2 * q;
        const T g_den = -2 * r * inv_den;
        ga += r * inv_a2 + g_den * (live ? hz * hz : T(0.5) * q);
        if constexpr (kToWo) {
            const T g_live = live ? g_den : T(0), g_q = live ? 2 * r * inv_q : T(0);
            // F, through wo.h = sqrt(q) / 2.
            const T m = 1 - cosine_h, m2 = m * m;
            const T g_half = dv * T(-2.5) * (1 - f0) * m2 * m2 * inv_length;
            const T g_xy = 2 * (g_live + g_q) + g_half;
            gx += hx * g_xy;
            gy += hy * g_xy;
            gz += hz * (2 * (g_live * a2 + g_q) + g_half);
        }
        // V = 1 / (2 smith)
        const T g_smith = -r * inv_smith;
        g_root += g_smith * l;
        ga += g_smith * v * (1 - l * l) * T(0.5) * inv_root_l;
        if constexpr (kToWo) gv += g_smith * root_l;
    }
    ga += g_root * (1 - v * v) / (2 * root_v);
    if constexpr (!kToWo) return {ga, vec3<T>(0)};
    gv += g_root * v * (1 - a2) / root_v;
    return {ga, {gx, gy, gz + (oz >= T(kCosMin) ? gv : T(0))}};
}

}  // namespace univoxel
