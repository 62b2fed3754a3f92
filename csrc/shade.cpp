#include "shade.h"

#include <algorithm>
#include <cstring>
#include <vector>

#include "parallel.h"
#include "shading.h"

namespace univoxel {
namespace {

constexpr int64_t kSamplesPerChunk = 64;
constexpr int64_t kMapChunks = 64;  // each sums a gradient of the map of its own

/// IEEE half to float, in a form that vectorises on any processor.
inline float from_half(uint16_t half) {
    const uint32_t sign = uint32_t(half & 0x8000) << 16, magnitude = half & 0x7fff;
    // Exponents move from bias 15 to 127; the largest means infinity or NaN in both.
    const uint32_t bias = magnitude >= 0x7c00 ? 224u << 23 : 112u << 23;
    const float subnormal = float(int32_t(magnitude)) * 0x1p-24f;
    uint32_t bits;
    std::memcpy(&bits, &subnormal, sizeof bits);
    bits = sign | (magnitude < 0x400 ? bits : (magnitude << 13) + bias);
    float value;
    std::memcpy(&value, &bits, sizeof value);
    return value;
}

// Stored numbers as T.
template <class T>
inline T radiance_of(T x) {
    return x;
}
template <class T>
inline T radiance_of(uint16_t x) {
    return T(from_half(x));
}
template <class T>
inline T fraction_of(T x) {
    return x;
}
template <class T>
inline T fraction_of(uint8_t x) {
    return T(x) * (T(1) / 255);
}

/// Three rows of n numbers.
template <class T>
struct Rows3 {
    int64_t count;
    std::vector<T> buffer;

    explicit Rows3(int64_t n) : count(n), buffer(3 * n) {}
    T* operator[](int c) { return buffer.data() + c * count; }
    const T* operator[](int c) const { return buffer.data() + c * count; }

    /// From interleaved [n, 3].
    void split(const T* from) {
        T *x = (*this)[0], *y = (*this)[1], *z = (*this)[2];
#pragma omp simd
        for (int64_t d = 0; d < count; ++d) {
            x[d] = from[3 * d];
            y[d] = from[3 * d + 1];
            z[d] = from[3 * d + 2];
        }
    }
};

/// What all samples share: the directions, world, in rows.
template <class T>
Rows3<T> world_directions(const Shade<T>& in) {
    Rows3<T> world(in.n_directions);
    world.split(in.directions);
    return world;
}

/// Take the directions into the frame of a sample's normal, and fill the specular layer. Below the
/// horizon the cosine is 0, which masks all that follows: cheaper than packing the rest.
template <class T>
LocalBrdf<T> look(const Shade<T>& in, const Rows3<T>& world, int64_t i, Directions<T>& dir) {
    const Frame<T> frame(load3(in.normal, i));
    const vec3<T> t = frame.tangent, b = frame.bitangent, n = frame.normal;
    const T *wx = world[0], *wy = world[1], *wz = world[2];
    T *x = dir.x, *y = dir.y, *z = dir.z, *cosine = dir.cosine, *held = dir.held;
    const T lowest = T(kCosMin), zero = 0;
    const int64_t count = dir.count;
#pragma omp simd
    for (int64_t d = 0; d < count; ++d) {
        const T u = wx[d], v = wy[d], w = wz[d];
        const T c = n.x * u + n.y * v + n.z * w;
        x[d] = t.x * u + t.y * v + t.z * w;
        y[d] = b.x * u + b.y * v + b.z * w;
        z[d] = c;
        cosine[d] = std::max(c, zero);
        held[d] = std::max(c, lowest);
    }
    const vec3<T> wo = load3(in.wo, i);
    const LocalBrdf<T> brdf({glm::dot(t, wo), glm::dot(b, wo), glm::dot(n, wo)},
                            load3(in.albedo, i), in.roughness[i], in.f0);
    specular_layer(brdf, in.f0, dir);
    return brdf;
}

/// rgb / solid_angle of one sample.
template <class T>
vec3<T> reflect(const LocalBrdf<T>& brdf, const Directions<T>& dir, const Rows3<T>& radiance) {
    const T *r = radiance[0], *g = radiance[1], *b = radiance[2];
    const T *cosine = dir.cosine, *layer = dir.layer;
    const vec3<T> diffuse = brdf.diffuse;
    const int64_t count = dir.count;
    T sr = 0, sg = 0, sb = 0;
#pragma omp simd reduction(+ : sr, sg, sb)
    for (int64_t d = 0; d < count; ++d) {
        sr += r[d] * (diffuse.x * cosine[d] + layer[d]);
        sg += g[d] * (diffuse.y * cosine[d] + layer[d]);
        sb += b[d] * (diffuse.z * cosine[d] + layer[d]);
    }
    return {sr, sg, sb};
}

/// Write albedo and roughness gradients of one sample; g is solid_angle times that to rgb.
template <class T>
void materials_backward(const Shade<T>& in, const LocalBrdf<T>& brdf, const Rows3<T>& radiance,
                        const vec3<T>& g, int64_t i, Directions<T>& dir, const ShadeGrad<T>& grad) {
    const T *r = radiance[0], *gr = radiance[1], *b = radiance[2], *cosine = dir.cosine;
    T* grad_layer = dir.grad_layer;
    const int64_t count = dir.count;
    T sr = 0, sg = 0, sb = 0;
#pragma omp simd reduction(+ : sr, sg, sb)
    for (int64_t d = 0; d < count; ++d) {
        sr += r[d] * cosine[d];
        sg += gr[d] * cosine[d];
        sb += b[d] * cosine[d];
        grad_layer[d] = g.x * r[d] + g.y * gr[d] + g.z * b[d];
    }
    const T grad_a2 = specular_layer_backward<false>(brdf, in.f0, dir).a2;
    const auto out =
        brdf.backward(g * vec3<T>(sr, sg, sb), grad_a2, load3(in.albedo, i), in.roughness[i]);
    store3(grad.albedo, i, out.albedo);
    grad.roughness[i] = out.roughness;
}

/// Fetches the radiance that one sample sees.
template <class T>
struct MapReader {
    const MapLight<T>& light;
    Rows3<T> map;
    Rows3<T> radiance;
    std::vector<T> visibility, interleaved;
    int64_t loaded = -1;  // views of one point often follow each other

    MapReader(const MapLight<T>& in, int64_t count)
        : light(in), map(count), radiance(count), visibility(count), interleaved(3 * count) {
        map.split(in.map);
    }

    void load(int64_t i) {
        const int64_t count = map.count, p = light.index[i];
        if (p == loaded) return;
        loaded = p;
        std::visit(
            [&](auto* from) {
                T* to = visibility.data();
                from += p * count;
#pragma omp simd
                for (int64_t d = 0; d < count; ++d) to[d] = fraction_of<T>(from[d]);
            },
            light.visibility);
        std::visit(
            [&](auto* from) {
                T* to = interleaved.data();
                from += 3 * p * count;
#pragma omp simd
                for (int64_t k = 0; k < 3 * count; ++k) to[k] = radiance_of<T>(from[k]);
            },
            light.indirect);
        radiance.split(interleaved.data());
        const T* open = visibility.data();
        for (int c = 0; c < 3; ++c) {
            T* to = radiance[c];
            const T* from = map[c];
#pragma omp simd
            for (int64_t d = 0; d < count; ++d) to[d] += open[d] * from[d];
        }
    }
};

}  // namespace

template <class T>
void shade_radiance_forward(const Shade<T>& in, const T* radiance, T* rgb, int threads) {
    const Rows3<T> world = world_directions(in);
    const int64_t D = in.n_directions;
    parallel_for(in.n_samples, kSamplesPerChunk, threads, [&](int64_t begin, int64_t end) {
        Directions<T> dir(D);
        Rows3<T> light(D);
        for (int64_t i = begin; i < end; ++i) {
            const auto brdf = look(in, world, i, dir);
            light.split(radiance + 3 * i * D);
            store3(rgb, i, in.solid_angle * reflect(brdf, dir, light));
        }
    });
}

// grad radiance_dc = g_c (diffuse_c max(n.w, 0) + layer_d) with g = solid_angle grad_rgb, and the
// layer receives sum_c g_c radiance_dc. See docs/derivations/shade.md.
template <class T>
void shade_radiance_backward(const Shade<T>& in, const T* radiance, const T* grad_rgb,
                             const ShadeGrad<T>& grad, int threads) {
    const Rows3<T> world = world_directions(in);
    const int64_t D = in.n_directions;
    parallel_for(in.n_samples, kSamplesPerChunk, threads, [&](int64_t begin, int64_t end) {
        Directions<T> dir(D);
        Rows3<T> light(D);
        for (int64_t i = begin; i < end; ++i) {
            const auto brdf = look(in, world, i, dir);
            const vec3<T> g = in.solid_angle * load3(grad_rgb, i), gd = g * brdf.diffuse;
            light.split(radiance + 3 * i * D);
            materials_backward(in, brdf, light, g, i, dir, grad);
            if (!grad.light) continue;
            T* to = grad.light + 3 * i * D;
            const T *cosine = dir.cosine, *layer = dir.layer;
#pragma omp simd
            for (int64_t d = 0; d < D; ++d) {
                to[3 * d] = gd.x * cosine[d] + g.x * layer[d];
                to[3 * d + 1] = gd.y * cosine[d] + g.y * layer[d];
                to[3 * d + 2] = gd.z * cosine[d] + g.z * layer[d];
            }
        }
    });
}

template <class T>
void shade_map_forward(const Shade<T>& in, const MapLight<T>& light, T* rgb, int threads) {
    const Rows3<T> world = world_directions(in);
    const int64_t D = in.n_directions;
    parallel_for(in.n_samples, kSamplesPerChunk, threads, [&](int64_t begin, int64_t end) {
        Directions<T> dir(D);
        MapReader<T> reader(light, D);
        for (int64_t i = begin; i < end; ++i) {
            const auto brdf = look(in, world, i, dir);
            reader.load(i);
            store3(rgb, i, in.solid_angle * reflect(brdf, dir, reader.radiance));
        }
    });
}

// As above; the map receives sum_n visibility_nd grad radiance_nd. Chunks sum apart, and their sums
// are added in their order: the same bits for any number of threads.
template <class T>
void shade_map_backward(const Shade<T>& in, const MapLight<T>& light, const T* grad_rgb,
                        const ShadeGrad<T>& grad, int threads) {
    const Rows3<T> world = world_directions(in);
    const int64_t D = in.n_directions;
    const int64_t grain = std::max(kSamplesPerChunk, (in.n_samples + kMapChunks - 1) / kMapChunks);
    const int64_t chunks = (in.n_samples + grain - 1) / grain;
    std::vector<Rows3<T>> sums(grad.light ? chunks : 0, Rows3<T>(D));
    parallel_for(in.n_samples, grain, threads, [&](int64_t begin, int64_t end) {
        Directions<T> dir(D);
        MapReader<T> reader(light, D);
        for (int64_t i = begin; i < end; ++i) {
            const auto brdf = look(in, world, i, dir);
            const vec3<T> g = in.solid_angle * load3(grad_rgb, i), gd = g * brdf.diffuse;
            reader.load(i);
            materials_backward(in, brdf, reader.radiance, g, i, dir, grad);
            if (!grad.light) continue;
            Rows3<T>& sum = sums[begin / grain];
            T *x = sum[0], *y = sum[1], *z = sum[2];
            const T *cosine = dir.cosine, *layer = dir.layer, *open = reader.visibility.data();
#pragma omp simd
            for (int64_t d = 0; d < D; ++d) {
                x[d] += open[d] * (gd.x * cosine[d] + g.x * layer[d]);
                y[d] += open[d] * (gd.y * cosine[d] + g.y * layer[d]);
                z[d] += open[d] * (gd.z * cosine[d] + g.z * layer[d]);
            }
        }
    });
    if (!grad.light) return;
    std::fill(grad.light, grad.light + 3 * D, T(0));
    for (const Rows3<T>& sum : sums) {
        for (int c = 0; c < 3; ++c) {
            for (int64_t d = 0; d < D; ++d) grad.light[3 * d + c] += sum[c][d];
        }
    }
}

template void shade_radiance_forward(const Shade<float>&, const float*, float*, int);
template void shade_radiance_forward(const Shade<double>&, const double*, double*, int);
template void shade_radiance_backward(const Shade<float>&, const float*, const float*,
                                      const ShadeGrad<float>&, int);
template void shade_radiance_backward(const Shade<double>&, const double*, const double*,
                                      const ShadeGrad<double>&, int);
template void shade_map_forward(const Shade<float>&, const MapLight<float>&, float*, int);
template void shade_map_forward(const Shade<double>&, const MapLight<double>&, double*, int);
template void shade_map_backward(const Shade<float>&, const MapLight<float>&, const float*,
                                 const ShadeGrad<float>&, int);
template void shade_map_backward(const Shade<double>&, const MapLight<double>&, const double*,
                                 const ShadeGrad<double>&, int);

}  // namespace univoxel
