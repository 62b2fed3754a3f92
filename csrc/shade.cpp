#include "shade.h"

#include <algorithm>
#include <vector>

#include "dcheck.h"
#include "half.h"
#include "parallel.h"
#include "shading.h"

namespace univoxel {
namespace {

constexpr int64_t kSamplesPerChunk = 64;
constexpr int64_t kMapChunks = 64;  // each sums a gradient of the map of its own

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

/// Three columns of n numbers.
template <class T>
struct Columns3 {
    int64_t count;
    std::vector<T> buffer;

    explicit Columns3(int64_t n) : count(n), buffer(3 * n) {}
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

/// What all samples share: the directions, world, in columns.
template <class T>
Columns3<T> world_directions(const Shade<T>& in) {
    Columns3<T> world(in.n_directions);
    world.split(in.directions);
    return world;
}

/// A sample: the frame of its normal, and what it reflects there.
template <class T, class F0>
struct Sample {
    Frame<vec3<T>> frame;
    LocalBrdf<T, F0> brdf;

    Sample(const Shade<T>& in, int64_t i, const F0& f0, const vec3<T>& albedo)
        : frame(load3(in.normal, i)),
          brdf(frame.to_local(load3(in.wo, i)), albedo, in.roughness[i], f0) {}
};

/// Take the directions into the frame of a sample, and fill the specular layer. Below the horizon
/// the cosine is 0, which masks all that follows: cheaper than packing the rest.
template <class T, class F0>
void fill_specular_layer(const Sample<T, F0>& sample, const Columns3<T>& world,
                         Directions<T>& dir) {
    const auto& frame = sample.frame;
    const vec3<T> t = frame.tangent, b = frame.bitangent, n = frame.normal;
    const T *wx = world[0], *wy = world[1], *wz = world[2];
    T *x = dir.x, *y = dir.y, *z = dir.z, *cosine = dir.cosine, *clamped = dir.clamped_cosine;
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
        clamped[d] = std::max(c, lowest);
    }
    specular_layer(sample.brdf, dir);
}

/// What a direction of unit radiance adds to each channel: its cosine and BRDF.
template <class T, class F0>
struct Response {
    const T *cosine, *layer, *gain;
    vec3<T> diffuse, f0;

    Response(const LocalBrdf<T, F0>& brdf, const Directions<T>& dir)
        : cosine(dir.cosine),
          layer(dir.layer),
          gain(dir.gain),
          diffuse(brdf.diffuse),
          f0(brdf.f0) {}

    T r(int64_t d) const { return of(d, diffuse.x, f0.x); }
    T g(int64_t d) const { return of(d, diffuse.y, f0.y); }
    T b(int64_t d) const { return of(d, diffuse.z, f0.z); }

  private:
    T of(int64_t d, T diffuse_c, [[maybe_unused]] T f0_c) const {
        const T value = diffuse_c * cosine[d] + layer[d];
        if constexpr (kColored<F0>)
            return value + f0_c * gain[d];
        else
            return value;
    }
};

/// rgb / solid_angle of one sample.
template <class T, class F0>
vec3<T> reflect(const LocalBrdf<T, F0>& brdf, const Directions<T>& dir,
                const Columns3<T>& radiance) {
    const T *r = radiance[0], *g = radiance[1], *b = radiance[2];
    const Response<T, F0> response(brdf, dir);
    const int64_t count = dir.count;
    T sr = 0, sg = 0, sb = 0;
#pragma omp simd reduction(+ : sr, sg, sb)
    for (int64_t d = 0; d < count; ++d) {
        sr += r[d] * response.r(d);
        sg += g[d] * response.g(d);
        sb += b[d] * response.b(d);
    }
    return {sr, sg, sb};
}

/// Sum over the directions above the horizon of (c . radiance) w, local: the gradient to the normal
/// from the cosine that weighs the radiance.
template <class T>
vec3<T> cosine_moment(const vec3<T>& c, const Columns3<T>& radiance, const Directions<T>& dir) {
    const T *r = radiance[0], *g = radiance[1], *b = radiance[2];
    const T *x = dir.x, *y = dir.y, *z = dir.z;
    const int64_t count = dir.count;
    T mx = 0, my = 0, mz = 0;
#pragma omp simd reduction(+ : mx, my, mz)
    for (int64_t d = 0; d < count; ++d) {
        const T all = c.x * r[d] + c.y * g[d] + c.z * b[d], seen = z[d] > 0 ? all : T(0);
        mx += seen * x[d];
        my += seen * y[d];
        mz += seen * z[d];
    }
    return {mx, my, mz};
}

/// Write the gradients of one sample but that to the light; g is solid_angle times that to rgb.
template <class T, class F0>
void sample_backward(const Shade<T>& in, const Sample<T, F0>& sample, const Columns3<T>& radiance,
                     const vec3<T>& g, int64_t i, Directions<T>& dir, const ShadeGrad<T>& grad) {
    constexpr bool kGain = kColored<F0>;
    const auto& brdf = sample.brdf;
    const T *r = radiance[0], *gr = radiance[1], *b = radiance[2], *cosine = dir.cosine;
    T* grad_layer = dir.grad_layer;
    [[maybe_unused]] const T* gain = dir.gain;
    [[maybe_unused]] T* grad_gain = dir.grad_gain;
    [[maybe_unused]] const vec3<T> gf = g * brdf.f0;
    const int64_t count = dir.count;
    T sr = 0, sg = 0, sb = 0, fr = 0, fg = 0, fb = 0;
#pragma omp simd reduction(+ : sr, sg, sb, fr, fg, fb)
    for (int64_t d = 0; d < count; ++d) {
        sr += r[d] * cosine[d];
        sg += gr[d] * cosine[d];
        sb += b[d] * cosine[d];
        grad_layer[d] = g.x * r[d] + g.y * gr[d] + g.z * b[d];
        if constexpr (kGain) {
            fr += r[d] * gain[d];
            fg += gr[d] * gain[d];
            fb += b[d] * gain[d];
            grad_gain[d] = gf.x * r[d] + gf.y * gr[d] + gf.z * b[d];
        }
    }
    const auto from_layer = grad.normal ? specular_layer_backward<false, true>(brdf, dir)
                                        : specular_layer_backward<false, false>(brdf, dir);
    const auto from_brdf =
        brdf.backward(g * vec3<T>(sr, sg, sb), from_layer.a2, load3(in.albedo, i), in.roughness[i]);
    store3(grad.albedo, i, from_brdf.albedo);
    grad.roughness[i] = from_brdf.roughness;
    if constexpr (kGain)
        store3(grad.f0, i, g * vec3<T>(fr, fg, fb) + from_brdf.e * brdf.layer.d_f0);
    if (!grad.normal) return;
    const vec3<T> normal = from_layer.normal + from_brdf.cosine * brdf.wo +
                           cosine_moment(g * brdf.diffuse, radiance, dir);
    store3(grad.normal, i, sample.frame.to_world(normal));
}

// What the kernels below read light from: load(i) fetches the radiance that sample i sees.

/// Light [N, D, 3] of each sample's own.
template <class T>
struct OwnLight {
    const T* from;
    Columns3<T> radiance;

    OwnLight(const T* light, int64_t count) : from(light), radiance(count) {}
    void load(int64_t i) { radiance.split(from + 3 * i * radiance.count); }
};

/// One map, partly hidden from each point.
template <class T>
struct MapReader {
    const MapLight<T>& light;
    Columns3<T> map;
    Columns3<T> radiance;
    std::vector<T> visibility, interleaved;
    int64_t loaded = -1;  // views of one point often follow each other

    MapReader(const MapLight<T>& in, int64_t count)
        : light(in), map(count), radiance(count), visibility(count), interleaved(3 * count) {
        map.split(in.map);
    }

    void load(int64_t i) {
        const int64_t count = map.count, p = light.index[i];
        DCHECK(p >= 0);
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
        const T* visible = visibility.data();
        for (int c = 0; c < 3; ++c) {
            T* to = radiance[c];
            const T* from = map[c];
#pragma omp simd
            for (int64_t d = 0; d < count; ++d) to[d] += visible[d] * from[d];
        }
    }
};

/// Call f(i, sample, dir, reader) for each sample, with the directions in its frame and their
/// specular layer in dir. A chunk of samples shares dir and a reader, of make_reader().
template <class T, class MakeReader, class F>
void for_samples(const Shade<T>& in, int64_t grain, int threads, MakeReader&& make_reader, F&& f) {
    const Columns3<T> world = world_directions(in);
    with_f0(in.f0, in.colored, [&](auto f0_of) {
        parallel_for(in.n_samples, grain, threads, [&](int64_t begin, int64_t end) {
            Directions<T> dir(in.n_directions);
            auto reader = make_reader();
            for (int64_t i = begin; i < end; ++i) {
                const Sample sample(in, i, f0_of(i), in.albedo ? load3(in.albedo, i) : vec3<T>(0));
                fill_specular_layer(sample, world, dir);
                f(i, sample, dir, reader);
            }
        });
    });
}

template <class T, class MakeReader>
void forward(const Shade<T>& in, T* rgb, int threads, MakeReader&& make_reader) {
    for_samples(in, kSamplesPerChunk, threads, make_reader,
                [&](int64_t i, const auto& sample, const auto& dir, auto& reader) {
                    reader.load(i);
                    store3(rgb, i, in.solid_angle * reflect(sample.brdf, dir, reader.radiance));
                });
}

}  // namespace

template <class T>
void specular_response(const Shade<T>& in, T* response, int threads) {
    const int64_t D = in.n_directions;
    for_samples(
        in, kSamplesPerChunk, threads, [] { return nullptr; },
        [&](int64_t i, const auto&, const auto& dir, auto) {
            T* out = response + i * D;
            for (int64_t d = 0; d < D; ++d) out[d] = in.solid_angle * dir.layer[d];
        });
}

template <class T>
void shade_radiance_forward(const Shade<T>& in, const T* radiance, T* rgb, int threads) {
    forward(in, rgb, threads, [&] { return OwnLight<T>(radiance, in.n_directions); });
}

// grad radiance_dc = g_c (diffuse_c max(n.w, 0) + layer_dc) with g = solid_angle grad_rgb, and the
// layer receives sum_c g_c radiance_dc. See docs/method/gradients-shading.md.
template <class T>
void shade_radiance_backward(const Shade<T>& in, const T* radiance, const T* grad_rgb,
                             const ShadeGrad<T>& grad, int threads) {
    const int64_t D = in.n_directions;
    for_samples(
        in, kSamplesPerChunk, threads, [&] { return OwnLight<T>(radiance, D); },
        [&](int64_t i, const auto& sample, auto& dir, auto& reader) {
            const vec3<T> g = in.solid_angle * load3(grad_rgb, i);
            reader.load(i);
            sample_backward(in, sample, reader.radiance, g, i, dir, grad);
            if (!grad.light) return;
            T* to = grad.light + 3 * i * D;
            const Response response(sample.brdf, dir);
#pragma omp simd
            for (int64_t d = 0; d < D; ++d) {
                to[3 * d] = g.x * response.r(d);
                to[3 * d + 1] = g.y * response.g(d);
                to[3 * d + 2] = g.z * response.b(d);
            }
        });
}

template <class T>
void shade_map_forward(const Shade<T>& in, const MapLight<T>& light, T* rgb, int threads) {
    forward(in, rgb, threads, [&] { return MapReader<T>(light, in.n_directions); });
}

// As above; the map receives sum_n visibility_nd grad radiance_nd. Chunks sum apart, and their sums
// are added in their order: the same bits for any number of threads.
template <class T>
void shade_map_backward(const Shade<T>& in, const MapLight<T>& light, const T* grad_rgb,
                        const ShadeGrad<T>& grad, int threads) {
    const int64_t D = in.n_directions;
    const int64_t grain = std::max(kSamplesPerChunk, (in.n_samples + kMapChunks - 1) / kMapChunks);
    const int64_t chunks = (in.n_samples + grain - 1) / grain;
    std::vector<Columns3<T>> sums(grad.light ? chunks : 0, Columns3<T>(D));
    for_samples(
        in, grain, threads, [&] { return MapReader<T>(light, D); },
        [&](int64_t i, const auto& sample, auto& dir, auto& reader) {
            const vec3<T> g = in.solid_angle * load3(grad_rgb, i);
            reader.load(i);
            sample_backward(in, sample, reader.radiance, g, i, dir, grad);
            if (!grad.light) return;
            Columns3<T>& sum = sums[i / grain];
            T *x = sum[0], *y = sum[1], *z = sum[2];
            const T* visible = reader.visibility.data();
            const Response response(sample.brdf, dir);
#pragma omp simd
            for (int64_t d = 0; d < D; ++d) {
                x[d] += visible[d] * (g.x * response.r(d));
                y[d] += visible[d] * (g.y * response.g(d));
                z[d] += visible[d] * (g.z * response.b(d));
            }
        });
    if (!grad.light) return;
    std::fill(grad.light, grad.light + 3 * D, T(0));
    for (const Columns3<T>& sum : sums) {
        for (int c = 0; c < 3; ++c) {
            for (int64_t d = 0; d < D; ++d) grad.light[3 * d + c] += sum[c][d];
        }
    }
}

template void specular_response(const Shade<float>&, float*, int);
template void specular_response(const Shade<double>&, double*, int);
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
