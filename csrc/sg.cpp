#include "sg.h"

#include <algorithm>
#include <cmath>
#include <vector>

#include "exp2.h"
#include "parallel.h"
#include "shading.h"

namespace univoxel {
namespace {

constexpr int64_t kPointsPerChunk = 64;

/// The directions, which are the same for every point in its own frame.
template <class T>
Directions<T> canonical(const ShadeSG<T>& in) {
    Directions<T> dir(in.n_directions);
    for (int64_t d = 0; d < dir.count; ++d) {
        dir.x[d] = in.directions[3 * d];
        dir.y[d] = in.directions[3 * d + 1];
        dir.z[d] = in.directions[3 * d + 2];
        dir.cosine[d] = std::max(dir.z[d], T(0));
        dir.clamped_cosine[d] = std::max(dir.z[d], T(kCosMin));
    }
    return dir;
}

/// One point in the frame of the directions: the frame of its normal, turned by -rotation. There
/// the directions are constants and the normal is +Z.
template <class T, class F0>
struct Point {
    Frame<vec3<T>> frame;
    T cos_r, sin_r;
    LocalBrdf<T, F0> brdf;

    Point(const ShadeSG<T>& in, int64_t i, const F0& f0)
        : frame(load3(in.normal, i)),
          cos_r(std::cos(in.rotation[i])),
          sin_r(std::sin(in.rotation[i])),
          brdf(local(load3(in.wo, i)), load3(in.albedo, i), in.roughness[i], f0) {}

    vec3<T> local(const vec3<T>& w) const {
        const vec3<T> u = frame.to_local(w);
        return {cos_r * u.x + sin_r * u.y, cos_r * u.y - sin_r * u.x, u.z};
    }

    /// Undo the turn about +Z: components along tangent, bitangent and normal.
    vec3<T> unturn(const vec3<T>& w) const {
        return {cos_r * w.x - sin_r * w.y, sin_r * w.x + cos_r * w.y, w.z};
    }
};

/// Integrals of one lobe of unit amplitude over the directions, or gradients to them.
template <class T>
struct LobeSums {
    T cosine, layer, gain;  // against max(n.w, 0) and the specular layer; gain is 0 unless colored
};

/// A lobe's exponent over log2 e as a plane: x . w + offset.
template <class T>
struct Exponent {
    T x, y, z, offset;

    Exponent(const vec3<T>& axis, T sharpness) {
        const T s = sharpness * T(kLog2E);
        x = s * axis.x, y = s * axis.y, z = s * axis.z, offset = -s;
    }
    T operator()(T wx, T wy, T wz) const { return z * wz + (y * wy + (x * wx + offset)); }
};

template <bool kGain, class T>
LobeSums<T> lobe_forward(const Directions<T>& dir, const Exponent<T>& exponent, Clamp<T> clamp) {
    const T *x = dir.x, *y = dir.y, *z = dir.z, *cosine = dir.cosine, *layer = dir.layer;
    [[maybe_unused]] const T* gain = dir.gain;
    const int64_t count = dir.count;
    T diffuse = 0, specular = 0, more = 0;
#pragma omp simd reduction(+ : diffuse, specular, more)
    for (int64_t d = 0; d < count; ++d) {
        const T g = simd_exp2(exponent(x[d], y[d], z[d]), clamp);
        diffuse += g * cosine[d];
        specular += g * layer[d];
        if constexpr (kGain) more += g * gain[d];
    }
    return {diffuse, specular, more};
}

/// The same; adds to the gradients of layer and gain theirs from the sums, and returns in `moment`
/// the sum of grad_lobe * lobe * w. Two loops, `lobe` between them: iterations of one would be too
/// long to overlap.
template <bool kGain, class T>
LobeSums<T> lobe_backward(Directions<T>& dir, const Exponent<T>& exponent, Clamp<T> clamp,
                          const LobeSums<T>& grad, vec3<T>& moment) {
    const T *x = dir.x, *y = dir.y, *z = dir.z, *cosine = dir.cosine, *layer = dir.layer;
    T *grad_layer = dir.grad_layer, *lobe = dir.lobe;
    [[maybe_unused]] const T* gain = dir.gain;
    [[maybe_unused]] T* grad_gain = dir.grad_gain;
    const T to_cosine = grad.cosine, to_layer = grad.layer;
    [[maybe_unused]] const T to_gain = grad.gain;
    const int64_t count = dir.count;
#pragma omp simd
    for (int64_t d = 0; d < count; ++d) lobe[d] = simd_exp2(exponent(x[d], y[d], z[d]), clamp);
    T diffuse = 0, specular = 0, more = 0, mx = 0, my = 0, mz = 0;
#pragma omp simd reduction(+ : diffuse, specular, more, mx, my, mz)
    for (int64_t d = 0; d < count; ++d) {
        const T g = lobe[d];
        T w = to_cosine * cosine[d] + to_layer * layer[d];
        if constexpr (kGain) w += to_gain * gain[d];
        w *= g;
        diffuse += g * cosine[d];
        specular += g * layer[d];
        mx += w * x[d];
        my += w * y[d];
        mz += w * z[d];
        grad_layer[d] += to_layer * g;
        if constexpr (kGain) {
            more += g * gain[d];
            grad_gain[d] += to_gain * g;
        }
    }
    moment = {mx, my, mz};
    return {diffuse, specular, more};
}

}  // namespace

template <class T>
void shade_sg_forward(const ShadeSG<T>& in, T* rgb, int threads) {
    const int64_t K = in.n_lobes;
    const T weight = T(2 * kPi) / T(in.n_directions);
    const Clamp<T> clamp = clamp_of<T>();
    with_f0(in.f0, in.colored, [&](auto f0_of) {
        constexpr bool kGain = kColored<decltype(f0_of(0))>;
        parallel_for(in.n_points, kPointsPerChunk, threads, [&](int64_t begin, int64_t end) {
            Directions<T> dir = canonical(in);
            for (int64_t i = begin; i < end; ++i) {
                const Point p(in, i, f0_of(i));
                specular_layer(p.brdf, dir);
                vec3<T> sum(0);
                for (int64_t k = i * K; k < (i + 1) * K; ++k) {
                    const Exponent<T> exponent(p.local(load3(in.axis, k)), in.sharpness[k]);
                    const auto s = lobe_forward<kGain>(dir, exponent, clamp);
                    const vec3<T> layer = p.brdf.color_of(s.layer, s.gain);
                    sum += load3(in.amplitude, k) * (p.brdf.diffuse * s.cosine + layer);
                }
                store3(rgb, i, weight * sum);
            }
        });
    });
}

namespace {

/// Write the gradients of point i.
template <class T, class F0>
void point_backward(const ShadeSG<T>& in, const T* grad_rgb, const ShadeSGGrad<T>& grad, int64_t i,
                    const F0& f0, Clamp<T> clamp, Directions<T>& dir) {
    constexpr bool kGain = kColored<F0>;
    const int64_t K = in.n_lobes;
    const T weight = T(2 * kPi) / T(in.n_directions);
    const Point p(in, i, f0);
    const vec3<T> g = weight * load3(grad_rgb, i);
    specular_layer(p.brdf, dir);
    std::fill(dir.grad_layer, dir.grad_layer + dir.count, T(0));
    if (kGain) std::fill(dir.grad_gain, dir.grad_gain + dir.count, T(0));
    vec3<T> grad_diffuse(0), grad_f0(0), grad_t(0), grad_b(0), grad_n(0);
    // Rows of the frame meet each local vector's gradient by an outer product.
    const auto from_local = [&](const vec3<T>& grad_local, const vec3<T>& world) {
        const vec3<T> u = p.unturn(grad_local);
        grad_t += u.x * world;
        grad_b += u.y * world;
        grad_n += u.z * world;
        return p.frame.to_world(u);
    };
    for (int64_t k = i * K; k < (i + 1) * K; ++k) {
        const vec3<T> world = load3(in.axis, k), axis = p.local(world);
        const T sharpness = in.sharpness[k];
        const vec3<T> ga = g * load3(in.amplitude, k);
        LobeSums<T> to{glm::dot(ga, p.brdf.diffuse), sum_of(ga), 0};
        if constexpr (kGain) to.gain = glm::dot(ga, f0);
        vec3<T> moment;
        const auto s = lobe_backward<kGain>(dir, Exponent<T>(axis, sharpness), clamp, to, moment);
        const vec3<T> layer = p.brdf.color_of(s.layer, s.gain);
        store3(grad.amplitude, k, g * (p.brdf.diffuse * s.cosine + layer));
        grad_diffuse += ga * s.cosine;
        grad_f0 += ga * s.gain;
        grad.sharpness[k] =
            glm::dot(moment, axis) - (to.cosine * s.cosine + to.layer * s.layer + to.gain * s.gain);
        store3(grad.axis, k, from_local(sharpness * moment, world));
    }
    auto from_layer = specular_layer_backward<true, false>(p.brdf, dir);
    const auto from_brdf =
        p.brdf.backward(grad_diffuse, from_layer.a2, load3(in.albedo, i), in.roughness[i]);
    store3(grad.albedo, i, from_brdf.albedo);
    grad.roughness[i] = from_brdf.roughness;
    if constexpr (kGain) store3(grad.f0, i, grad_f0 + from_brdf.e * p.brdf.layer.d_f0);
    from_layer.wo.z += from_brdf.cosine;
    store3(grad.wo, i, from_local(from_layer.wo, load3(in.wo, i)));
    store3(grad.normal, i, p.frame.backward(grad_t, grad_b, grad_n));
}

}  // namespace

// With P_k, S_k the integrals of lobe k against cosine and layer, rgb = sum_k amplitude_k (diffuse
// P_k + S_k). In the point's own frame directions are constants, so all that a lobe's exponential
// passes on are its moments; the frame's gradient follows once a point. See
// docs/method/gradients-shading.md.
template <class T>
void shade_sg_backward(const ShadeSG<T>& in, const T* grad_rgb, const ShadeSGGrad<T>& grad,
                       int threads) {
    const Clamp<T> clamp = clamp_of<T>();
    with_f0(in.f0, in.colored, [&](auto f0_of) {
        parallel_for(in.n_points, kPointsPerChunk, threads, [&](int64_t begin, int64_t end) {
            Directions<T> dir = canonical(in);
            for (int64_t i = begin; i < end; ++i)
                point_backward(in, grad_rgb, grad, i, f0_of(i), clamp, dir);
        });
    });
}

template void shade_sg_forward(const ShadeSG<float>&, float*, int);
template void shade_sg_forward(const ShadeSG<double>&, double*, int);
template void shade_sg_backward(const ShadeSG<float>&, const float*, const ShadeSGGrad<float>&,
                                int);
template void shade_sg_backward(const ShadeSG<double>&, const double*, const ShadeSGGrad<double>&,
                                int);

}  // namespace univoxel
