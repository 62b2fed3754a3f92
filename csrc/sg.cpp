#include "sg.h"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <vector>

#include "brdf.h"
#include "common.h"
#include "parallel.h"

namespace univoxel {
namespace {

constexpr int64_t kPointsPerChunk = 64;

// exp for loops that vectorise, which std::exp does not without -ffast-math. x = k ln 2 + f with
// |f| <= ln 2 / 2: 2^k goes into the exponent bits, exp(f) is a polynomial. Adding `magic` rounds
// to an integer and leaves it in the low bits. Within 2 ulp; x is clamped to where the result is
// a normal number. NaN stays NaN.

inline float simd_exp(float x) {
    constexpr float magic = 12582912.0f;  // 1.5 * 2^23
    x = std::min(std::max(x, -87.0f), 88.0f);
    const float shifted = x * 1.44269504f + magic, k = shifted - magic;
    // ln 2 in two parts: k times the first is exact
    const float f = (x - k * 0.693359375f) + k * 2.12194440e-4f;
    uint32_t bits;
    std::memcpy(&bits, &shifted, sizeof bits);
    bits = (bits << 23) + (127u << 23);
    float scale;
    std::memcpy(&scale, &bits, sizeof scale);
    float p = 1.0f / 720;
    p = p * f + 1.0f / 120;
    p = p * f + 1.0f / 24;
    p = p * f + 1.0f / 6;
    p = p * f + 0.5f;
    p = p * f + 1.0f;
    p = p * f + 1.0f;
    return p * scale;
}

inline double simd_exp(double x) {
    constexpr double magic = 6755399441055744.0;  // 1.5 * 2^52
    x = std::min(std::max(x, -708.0), 709.0);
    const double shifted = x * 1.4426950408889634 + magic, k = shifted - magic;
    const double f = (x - k * 6.93145751953125e-1) - k * 1.42860682030941723212e-6;
    uint64_t bits;
    std::memcpy(&bits, &shifted, sizeof bits);
    bits = (bits << 52) + (uint64_t{1023} << 52);
    double scale;
    std::memcpy(&scale, &bits, sizeof scale);
    double p = 1.0 / 6227020800.0;
    p = p * f + 1.0 / 479001600.0;
    p = p * f + 1.0 / 39916800.0;
    p = p * f + 1.0 / 3628800.0;
    p = p * f + 1.0 / 362880.0;
    p = p * f + 1.0 / 40320.0;
    p = p * f + 1.0 / 5040.0;
    p = p * f + 1.0 / 720.0;
    p = p * f + 1.0 / 120.0;
    p = p * f + 1.0 / 24.0;
    p = p * f + 1.0 / 6.0;
    p = p * f + 0.5;
    p = p * f + 1.0;
    p = p * f + 1.0;
    return p * scale;
}

/// The directions, each coordinate in a row of its own, and scratch rows of the same length.
template <class T>
struct Directions {
    int64_t count;
    std::vector<T> buffer;
    T *x, *y, *z, *cosine, *held, *layer, *grad_layer;

    explicit Directions(const ShadeSG<T>& in) : count(in.n_directions), buffer(7 * count) {
        T* rows[7];
        for (int i = 0; i < 7; ++i) rows[i] = buffer.data() + i * count;
        x = rows[0], y = rows[1], z = rows[2];
        cosine = rows[3];  // max(n.w, 0)
        held = rows[4];   // n.w held above kCosMin; std::max of z[d] in a loop would keep it scalar
        layer = rows[5];  // D F V max(n.w, 0)
        grad_layer = rows[6];  // its gradient
        for (int64_t d = 0; d < count; ++d) {
            x[d] = in.directions[3 * d];
            y[d] = in.directions[3 * d + 1];
            z[d] = in.directions[3 * d + 2];
            cosine[d] = std::max(z[d], T(0));
            held[d] = std::max(z[d], T(kCosMin));
        }
    }
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

/// One point in the frame of the directions: the frame of its normal, turned by -rotation. There
/// the directions are constants and the normal is +Z.
template <class T>
struct Point {
    Frame<T> frame;
    T cos_r, sin_r;
    vec3<T> wo;  // local
    T v, a2;     // n.wo held above kCosMin, alpha squared
    SpecularAlbedo<T> layer;
    vec3<T> diffuse;  // (1 - E) albedo / pi

    Point(const ShadeSG<T>& in, int64_t i)
        : frame(load3(in.normal, i)),
          cos_r(std::cos(in.rotation[i])),
          sin_r(std::sin(in.rotation[i])),
          wo(local(load3(in.wo, i))) {
        v = std::max(wo.z, T(kCosMin));
        const T alpha = ggx_alpha(in.roughness[i]);
        a2 = alpha * alpha;
        layer = specular_albedo(wo.z, in.roughness[i], in.f0);
        diffuse = load3(in.albedo, i) * ((1 - layer.value) / T(kPi));
    }

    vec3<T> local(const vec3<T>& w) const {
        const T t = glm::dot(frame.tangent, w), b = glm::dot(frame.bitangent, w);
        return {cos_r * t + sin_r * b, cos_r * b - sin_r * t, glm::dot(frame.normal, w)};
    }

    /// Undo the turn about +Z: components along tangent, bitangent and normal.
    vec3<T> unturn(const vec3<T>& w) const {
        return {cos_r * w.x - sin_r * w.y, sin_r * w.x + cos_r * w.y, w.z};
    }

    vec3<T> world(const vec3<T>& u) const {
        return u.x * frame.tangent + u.y * frame.bitangent + u.z * frame.normal;
    }
};

// In the two loops below q = |wi + wo|^2, and D's denominator is taken times q: `raw`, and `den`
// with the floor of ggx_denominator.

/// Fill `layer`: D F V max(n.w, 0) for every direction. D V is one quotient: divisions are dear.
template <class T>
void specular_layer(const Point<T>& p, T f0, Directions<T>& dir) {
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

/// Take the gradient of the specular layer to wo (local) and alpha squared.
template <class T>
void specular_layer_backward(const Point<T>& p, T f0, const Directions<T>& dir, vec3<T>& grad_wo,
                             T& grad_a2) {
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
        const T g_live = live ? g_den : T(0), g_q = live ? 2 * r * inv_q : T(0);
        ga += r * inv_a2 + g_den * (live ? hz * hz : T(0.5) * q);
        // F, through wo.h = sqrt(q) / 2.
        const T m = 1 - cosine_h, m2 = m * m;
        const T g_half = dv * T(-2.5) * (1 - f0) * m2 * m2 * inv_length;
        const T g_xy = 2 * (g_live + g_q) + g_half;
        gx += hx * g_xy;
        gy += hy * g_xy;
        gz += hz * (2 * (g_live * a2 + g_q) + g_half);
        // V = 1 / (2 smith)
        const T g_smith = -r * inv_smith;
        gv += g_smith * root_l;
        g_root += g_smith * l;
        ga += g_smith * v * (1 - l * l) * T(0.5) * inv_root_l;
    }
    gv += g_root * v * (1 - a2) / root_v;
    grad_a2 = ga + g_root * (1 - v * v) / (2 * root_v);
    grad_wo = {gx, gy, gz + (oz >= T(kCosMin) ? gv : T(0))};
}

/// Integrals of one lobe of unit amplitude over the directions.
template <class T>
struct LobeSums {
    T diffuse, layer;  // against max(n.w, 0) and the specular layer
};

template <class T>
LobeSums<T> lobe_forward(const Directions<T>& dir, const vec3<T>& axis, T sharpness) {
    const T *x = dir.x, *y = dir.y, *z = dir.z, *cosine = dir.cosine, *layer = dir.layer;
    const T ex = axis.x * sharpness, ey = axis.y * sharpness, ez = axis.z * sharpness;
    const int64_t count = dir.count;
    T diffuse = 0, specular = 0;
#pragma omp simd reduction(+ : diffuse, specular)
    for (int64_t d = 0; d < count; ++d) {
        const T g = simd_exp(ex * x[d] + ey * y[d] + ez * z[d] - sharpness);
        diffuse += g * cosine[d];
        specular += g * layer[d];
    }
    return {diffuse, specular};
}

/// The same; adds grad_layer_scale * lobe to the layer's gradient, and returns in `moment` the sum
/// of grad_lobe * lobe * w with grad_lobe = grad_cosine_scale * cosine + grad_layer_scale * layer.
template <class T>
LobeSums<T> lobe_backward(Directions<T>& dir, const vec3<T>& axis, T sharpness, T grad_cosine_scale,
                          T grad_layer_scale, vec3<T>& moment) {
    const T *x = dir.x, *y = dir.y, *z = dir.z, *cosine = dir.cosine, *layer = dir.layer;
    T* grad_layer = dir.grad_layer;
    const T ex = axis.x * sharpness, ey = axis.y * sharpness, ez = axis.z * sharpness;
    const int64_t count = dir.count;
    T diffuse = 0, specular = 0, mx = 0, my = 0, mz = 0;
#pragma omp simd reduction(+ : diffuse, specular, mx, my, mz)
    for (int64_t d = 0; d < count; ++d) {
        const T g = simd_exp(ex * x[d] + ey * y[d] + ez * z[d] - sharpness);
        const T gc = g * cosine[d], gl = g * layer[d];
        const T w = grad_cosine_scale * gc + grad_layer_scale * gl;
        diffuse += gc;
        specular += gl;
        mx += w * x[d];
        my += w * y[d];
        mz += w * z[d];
        grad_layer[d] += grad_layer_scale * g;
    }
    moment = {mx, my, mz};
    return {diffuse, specular};
}

}  // namespace

template <class T>
void shade_sg_forward(const ShadeSG<T>& in, T* rgb, int threads) {
    const int64_t K = in.n_lobes;
    const T weight = T(2 * kPi) / T(in.n_directions);
    parallel_for(in.n_points, kPointsPerChunk, threads, [&](int64_t begin, int64_t end) {
        Directions<T> dir(in);
        for (int64_t i = begin; i < end; ++i) {
            const Point<T> p(in, i);
            specular_layer(p, in.f0, dir);
            vec3<T> sum(0);
            for (int64_t k = i * K; k < (i + 1) * K; ++k) {
                const auto s = lobe_forward(dir, p.local(load3(in.axis, k)), in.sharpness[k]);
                sum += load3(in.amplitude, k) * (p.diffuse * s.diffuse + s.layer);
            }
            store3(rgb, i, weight * sum);
        }
    });
}

// With P_k, S_k the integrals of lobe k against cosine and layer, rgb = sum_k amplitude_k (diffuse
// P_k + S_k). In the point's own frame directions are constants, so all that a lobe's exponential
// passes on are its moments; the frame's gradient follows once a point. See docs/derivations/sg.md.
template <class T>
void shade_sg_backward(const ShadeSG<T>& in, const T* grad_rgb, const ShadeSGGrad<T>& grad,
                       int threads) {
    const int64_t K = in.n_lobes;
    const T weight = T(2 * kPi) / T(in.n_directions);
    parallel_for(in.n_points, kPointsPerChunk, threads, [&](int64_t begin, int64_t end) {
        Directions<T> dir(in);
        for (int64_t i = begin; i < end; ++i) {
            const Point<T> p(in, i);
            const vec3<T> g = weight * load3(grad_rgb, i);
            specular_layer(p, in.f0, dir);
            std::fill(dir.grad_layer, dir.grad_layer + dir.count, T(0));
            vec3<T> grad_diffuse(0), grad_t(0), grad_b(0), grad_n(0);
            // Rows of the frame meet each local vector's gradient by an outer product.
            const auto from_local = [&](const vec3<T>& grad_local, const vec3<T>& world) {
                const vec3<T> u = p.unturn(grad_local);
                grad_t += u.x * world;
                grad_b += u.y * world;
                grad_n += u.z * world;
                return p.world(u);
            };
            for (int64_t k = i * K; k < (i + 1) * K; ++k) {
                const vec3<T> world = load3(in.axis, k), axis = p.local(world);
                const T sharpness = in.sharpness[k];
                const vec3<T> amplitude = load3(in.amplitude, k), ga = g * amplitude;
                const T to_cosine = glm::dot(ga, p.diffuse), to_layer = ga.x + ga.y + ga.z;
                vec3<T> moment;
                const auto s = lobe_backward(dir, axis, sharpness, to_cosine, to_layer, moment);
                store3(grad.amplitude, k, g * (p.diffuse * s.diffuse + s.layer));
                grad_diffuse += ga * s.diffuse;
                grad.sharpness[k] =
                    glm::dot(moment, axis) - (to_cosine * s.diffuse + to_layer * s.layer);
                store3(grad.axis, k, from_local(sharpness * moment, world));
            }
            vec3<T> grad_wo;
            T grad_a2;
            specular_layer_backward(p, in.f0, dir, grad_wo, grad_a2);
            // diffuse = (1 - E) albedo / pi
            store3(grad.albedo, i, grad_diffuse * ((1 - p.layer.value) / T(kPi)));
            const T grad_e = -glm::dot(grad_diffuse, load3(in.albedo, i)) / T(kPi);
            grad_wo.z += grad_e * p.layer.d_cosine;
            const T r = in.roughness[i];
            const T d_a2 = r * r >= T(kAlphaMin) ? 4 * r * r * r : T(0);
            grad.roughness[i] = grad_e * p.layer.d_roughness + grad_a2 * d_a2;
            store3(grad.wo, i, from_local(grad_wo, load3(in.wo, i)));
            store3(grad.normal, i, p.frame.backward(grad_t, grad_b, grad_n));
        }
    });
}

template void shade_sg_forward(const ShadeSG<float>&, float*, int);
template void shade_sg_forward(const ShadeSG<double>&, double*, int);
template void shade_sg_backward(const ShadeSG<float>&, const float*, const ShadeSGGrad<float>&,
                                int);
template void shade_sg_backward(const ShadeSG<double>&, const double*, const ShadeSGGrad<double>&,
                                int);

}  // namespace univoxel
