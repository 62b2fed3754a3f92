#include "sg.h"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <vector>

#include "parallel.h"
#include "shading.h"

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

/// The directions, which are the same for every point in its own frame.
template <class T>
Directions<T> canonical(const ShadeSG<T>& in) {
    Directions<T> dir(in.n_directions);
    for (int64_t d = 0; d < dir.count; ++d) {
        dir.x[d] = in.directions[3 * d];
        dir.y[d] = in.directions[3 * d + 1];
        dir.z[d] = in.directions[3 * d + 2];
        dir.cosine[d] = std::max(dir.z[d], T(0));
        dir.held[d] = std::max(dir.z[d], T(kCosMin));
    }
    return dir;
}

/// One point in the frame of the directions: the frame of its normal, turned by -rotation. There
/// the directions are constants and the normal is +Z.
template <class T>
struct Point {
    Frame<T> frame;
    T cos_r, sin_r;
    LocalBrdf<T> brdf;

    Point(const ShadeSG<T>& in, int64_t i)
        : frame(load3(in.normal, i)),
          cos_r(std::cos(in.rotation[i])),
          sin_r(std::sin(in.rotation[i])),
          brdf(local(load3(in.wo, i)), load3(in.albedo, i), in.roughness[i], in.f0) {}

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
        Directions<T> dir = canonical(in);
        for (int64_t i = begin; i < end; ++i) {
            const Point<T> p(in, i);
            specular_layer(p.brdf, in.f0, dir);
            vec3<T> sum(0);
            for (int64_t k = i * K; k < (i + 1) * K; ++k) {
                const auto s = lobe_forward(dir, p.local(load3(in.axis, k)), in.sharpness[k]);
                sum += load3(in.amplitude, k) * (p.brdf.diffuse * s.diffuse + s.layer);
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
        Directions<T> dir = canonical(in);
        for (int64_t i = begin; i < end; ++i) {
            const Point<T> p(in, i);
            const vec3<T> g = weight * load3(grad_rgb, i);
            specular_layer(p.brdf, in.f0, dir);
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
                const T to_cosine = glm::dot(ga, p.brdf.diffuse), to_layer = ga.x + ga.y + ga.z;
                vec3<T> moment;
                const auto s = lobe_backward(dir, axis, sharpness, to_cosine, to_layer, moment);
                store3(grad.amplitude, k, g * (p.brdf.diffuse * s.diffuse + s.layer));
                grad_diffuse += ga * s.diffuse;
                grad.sharpness[k] =
                    glm::dot(moment, axis) - (to_cosine * s.diffuse + to_layer * s.layer);
                store3(grad.axis, k, from_local(sharpness * moment, world));
            }
            auto [grad_a2, grad_wo] = specular_layer_backward<true>(p.brdf, in.f0, dir);
            const auto grad_brdf =
                p.brdf.backward(grad_diffuse, grad_a2, load3(in.albedo, i), in.roughness[i]);
            store3(grad.albedo, i, grad_brdf.albedo);
            grad.roughness[i] = grad_brdf.roughness;
            grad_wo.z += grad_brdf.e * p.brdf.layer.d_cosine;
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
