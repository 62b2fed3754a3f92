#include "integrator.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <memory>

#include "dcheck.h"
#include "parallel.h"
#include "sobol.h"
#include "wave.h"

namespace univoxel {
namespace {

using vec = float3;

constexpr int kFewestPoints = 16;    // in a chunk
constexpr int kRouletteDepth = 2;    // bounces before paths may end at random
constexpr float kHitOffset = 1e-5f;  // of the coordinates: lifts a ray off the triangle it left
constexpr float kFar = std::numeric_limits<float>::infinity();

/// The power heuristic for one sample of each kind (Veach 1997, eq. 9.13); 1 where `both`, 1 or 0,
/// says that there is one kind alone.
float mis_weight(float pdf, float other, float both) {
    const float ratio = std::min(other / pdf, 1e15f);
    return 1 / (1 + both * ratio * ratio);
}

/// Whether a direction leaves to the outer side of the triangle.
bool above(const Paths& paths, int i, vec direction) {
    return dot(paths.geometric[i], direction) >= 0;
}

/// Row i of a row-major [N, 3] buffer.
vec row(const float* p, int64_t i = 0) {
    return {p[3 * i], p[3 * i + 1], p[3 * i + 2]};
}

/// Interpolate the mesh at a hit.
Vertex vertex_at(const Relight& in, vec origin, vec direction, const Hit& hit) {
    DCHECK(hit.face >= 0);
    const int32_t* face = in.scene->faces() + 3 * hit.face;
    const float w[3] = {1 - hit.u - hit.v, hit.u, hit.v};
    vec normal{}, albedo{}, f0{};
    float roughness = 0;
    for (int k = 0; k < 3; ++k) {
        normal = normal + w[k] * row(in.vertex_normal, face[k]);
        albedo = albedo + w[k] * row(in.vertex_albedo, face[k]);
        roughness += w[k] * in.vertex_roughness[face[k]];
        f0 = f0 + w[k] * row(in.vertex_f0, face[k]);
    }
    // Surfaces have two sides: turn both normals to the side that the path came from.
    vec geometric = unit(of(hit.normal));
    if (dot(geometric, direction) >= 0) geometric = -1 * geometric;
    const float length = std::sqrt(dot(normal, normal));
    normal = length > 1e-6f ? (1 / length) * normal : geometric;
    if (dot(normal, geometric) < 0) normal = -1 * normal;
    const vec at = origin + hit.t * direction;
    const float size = std::max(largest({std::abs(at.x), std::abs(at.y), std::abs(at.z)}), hit.t);
    return {at + kHitOffset * size * geometric,
            geometric,
            normal,
            -1 * direction,
            albedo,
            f0,
            roughness};
}

/// Test shadow rays along the sampled directions that carry light, and add it where nothing is in
/// between. With a map, the light is the map's in that direction times that of the sample.
void trace_shadow_rays(const Relight& in, Wave& w, float t_min, const EnvMap* map = nullptr) {
    Rays& rays = w.rays;
    int n = 0;
    for (int i = 0; i < w.paths->n; ++i) {
        rays.lane[n] = i;
        n += largest(w.sampled.light[i]) > 0;
    }
    if (map)
        for (int k = 0; k < n; ++k) map->prefetch({w.x[rays.lane[k]], w.y[rays.lane[k]]});
    rays.n = 0;
    for (int k = 0; k < n; ++k) {
        const int i = rays.lane[k];
        const vec light = w.sampled.light[i];
        const vec arriving = map ? light * map->radiance({w.x[i], w.y[i]}) : light;
        rays.light.set(rays.n, arriving);
        rays.set(rays.n, i, w.paths->origin[i], w.sampled.direction[i], w.sampled.distance[i]);
        rays.n += largest(arriving) > 0;
    }
    in.scene->occluded(rays.stream(t_min), rays.distance, rays.occluded);
    for (int k = 0; k < rays.n; ++k) {
        if (rays.occluded[k]) continue;
        const int path = w.paths->path[rays.lane[k]];
        w.light.set(path, w.light[path] + rays.light[k]);
    }
}

/// Light of the suns and lamps that arrives at the vertices and leaves them along the paths.
void sample_suns_and_lamps(const Relight& in, Wave& w, uint32_t depth, float t_min) {
    const Paths& p = *w.paths;
    const auto add = [&](int i, vec direction, vec irradiance, float distance) {
        const vec local = PathFrame(p.normal[i]).to_local(direction);
        const vec light = p.throughput[i] * p.brdf(i).evaluate(local).f_cos * irradiance;
        w.sampled.direction.set(i, direction);
        w.sampled.light.set(i, where(above(p, i, direction), light));
        w.sampled.distance[i] = distance;
    };
    for (int64_t k = 0; k < in.lights.n_suns; ++k) {
        const float* sun = in.lights.sun + 7 * k;
        const PathFrame disc(row(sun));
        const vec irradiance = 2 / (1 + sun[6]) * row(sun + 3);
        for (int i = 0; i < p.n; ++i) {
            // A place on its disc, uniform in solid angle; the disc shines evenly.
            const uint32_t own = hash(hash(p.seed[i], depth), 3);
            const Point2 u = sobol2(p.index[i], hash(own, static_cast<uint32_t>(k)));
            const float down = u.x * (1 - sun[6]);
            const float radius = std::sqrt(down * (2 - down));
            add(i, disc.to_world(on_circle(u.y, radius, 1 - down)), irradiance, kFar);
        }
        trace_shadow_rays(in, w, t_min);
    }
    for (int64_t k = 0; k < in.lights.n_lamps; ++k) {
        const vec position = row(in.lights.lamp + 6 * k);
        const vec intensity = row(in.lights.lamp + 6 * k + 3);
        for (int i = 0; i < p.n; ++i) {
            const vec to_lamp = position - p.origin[i];
            const float squared = std::max(dot(to_lamp, to_lamp), 1e-30f);
            const float distance = std::sqrt(squared);
            add(i, (1 / distance) * to_lamp, (1 / squared) * intensity, distance);
        }
        trace_shadow_rays(in, w, t_min);
    }
}

/// Sample a direction of the map for each path: `sampled` gets what arrives for each unit of light.
void sample_map(const Relight& in, const EnvMap& map, Wave& w, uint32_t depth) {
    const Paths& p = *w.paths;
    const int n = p.n;
#pragma GCC ivdep
    for (int i = 0; i < n; ++i) {
        const Point2 u = sobol2(p.index[i], hash(hash(p.seed[i], depth), 0));
        w.u[i] = u.x, w.v[i] = u.y;
    }
    map.sample({w.u, w.v, w.row, w.column, w.x, w.z, w.pdf, n});
    const float both = in.strategy == Strategy::mis ? 1 : 0;
#pragma GCC ivdep
    for (int i = 0; i < n; ++i) {
        const vec direction = map.direction(w.x[i], w.z[i]);
        const PathFrame frame(p.normal[i]);
        const PathBrdf::Value value = p.brdf(i).evaluate(frame.to_local(direction));
        const float pdf = w.pdf[i];
        const bool ok = (pdf > 0) & above(p, i, direction);
        const float weight = ok ? mis_weight(pdf, value.pdf, both) / pdf : 0.f;
        w.y[i] = map.down(w.z[i]);
        w.sampled.direction.set(i, direction);
        w.sampled.light.set(i, weight * (p.throughput[i] * value.f_cos));
        w.sampled.distance[i] = kFar;
    }
}

/// Sample a direction of the BRDF for each path: what arrives for each unit of the map's light, and
/// of light from a next vertex; a density of 0 where the path ends.
void sample_brdf(const Relight& in, const EnvMap& map, Wave& w, uint32_t depth) {
    const Paths& p = *w.paths;
    const int n = p.n;
    const float both = in.strategy == Strategy::mis ? 1 : 0;
    const float lit = in.strategy == Strategy::map ? 0 : 1;
#pragma GCC ivdep
    for (int i = 0; i < n; ++i) {
        const PathBrdf brdf = p.brdf(i);
        const vec wi = brdf.sample(sobol2(p.index[i], hash(hash(p.seed[i], depth), 1)));
        const PathBrdf::Value value = brdf.evaluate(wi);
        const vec direction = PathFrame(p.normal[i]).to_world(wi);
        const float pdf = above(p, i, direction) ? value.pdf : 0.f;
        w.pdf[i] = pdf;
        w.throughput.set(i, (1 / std::max(pdf, 1e-30f)) * (p.throughput[i] * value.f_cos));
        w.sampled.direction.set(i, direction);
        w.sampled.distance[i] = kFar;
    }
#pragma GCC ivdep
    for (int i = 0; i < n; ++i) {
        const MapPlace at = map.place(w.sampled.direction[i]);
        const float balance = lit * mis_weight(w.pdf[i], map.pdf(at), both);
        const float weight = w.pdf[i] > 0 ? balance : 0.f;
        w.x[i] = at.x, w.y[i] = at.y;
        w.sampled.light.set(i, weight * w.throughput[i]);
    }
}

/// Follow the sampled directions: to the map, whose light is added, or to the next vertices.
void advance(const Relight& in, const EnvMap& map, Wave& w, uint32_t depth, float t_min) {
    Rays& rays = w.rays;
    rays.n = 0;
    for (int i = 0; i < w.paths->n; ++i) {
        rays.set(rays.n, i, w.paths->origin[i], w.sampled.direction[i], kFar);
        rays.n += w.pdf[i] > 0;
    }
    in.scene->closest_hit(rays.stream(t_min), w.hit);
    w.next->n = 0;
    for (int k = 0; k < rays.n; ++k) {
        const int i = rays.lane[k], path = w.paths->path[i];
        const Hit& hit = w.hit[k];
        if (hit.face < 0) {
            const vec light = w.sampled.light[i] * map.radiance({w.x[i], w.y[i]});
            w.light.set(path, w.light[path] + light);
            continue;
        }
        // End dim paths at random; the survivors carry what these would have brought.
        vec throughput = w.throughput[i];
        const uint32_t seed = w.paths->seed[i], index = w.paths->index[i];
        if (depth + 1 >= kRouletteDepth) {
            const float survival = std::min(1.f, largest(throughput));
            if (!(unit_float(hash(hash(hash(seed, depth), 2), index)) < survival)) continue;
            throughput = (1 / survival) * throughput;
        }
        w.next->push(vertex_at(in, w.paths->origin[i], w.sampled.direction[i], hit), throughput,
                     seed, index, path);
    }
    w.next->settle();
    std::swap(w.paths, w.next);
}

/// Radiance along the paths of a wave, into `light`.
void trace(const Relight& in, const EnvMap& map, Wave& w) {
    float t_min = in.offset;
    for (int depth = 0; w.paths->n > 0; ++depth, t_min = 0) {
        const bool last = depth == in.bounces;
        sample_suns_and_lamps(in, w, depth, t_min);
        if (in.strategy != Strategy::brdf && !map.black()) {
            sample_map(in, map, w, depth);
            trace_shadow_rays(in, w, t_min, &map);
        }
        if (!last || (in.strategy != Strategy::map && !map.black())) {
            sample_brdf(in, map, w, depth);
            if (last) trace_shadow_rays(in, w, t_min, &map);
        }
        if (last) return;
        advance(in, map, w, depth, t_min);
    }
}

}  // namespace

void relight(const Relight& in, float* rgb, int threads) {
    const EnvMap map(in.map);
    const int grain = std::min(std::max(kLanes / in.samples, kFewestPoints), kLanes);
    parallel_for(in.n_points, grain, threads, [&](int64_t begin, int64_t end) {
        thread_local const auto wave = std::make_unique<Wave>();
        Wave& w = *wave;
        vec3<double> sum[kLanes];  // in float, equal addends of many samples drift
        const int points = static_cast<int>(end - begin), together = kLanes / points;
        DCHECK(points <= kLanes && together >= 1);
        std::fill_n(sum, points, vec3<double>(0));
        w.first.n = 0;
        for (int64_t i = begin; i < end; ++i) {
            const Vertex first{row(in.position, i) + in.offset * row(in.normal, i),
                               {},
                               row(in.normal, i),
                               row(in.wo, i),
                               row(in.albedo, i),
                               row(in.f0, i),
                               in.roughness[i]};
            // A missing normal, or anything that is not a number, shades black.
            if (dot(first.normal, first.normal) > 0.5f &&
                std::isfinite(
                    mean(first.origin + first.normal + first.wo + first.albedo + first.f0) +
                    first.roughness))
                w.first.push(first, {1, 1, 1}, hash(static_cast<uint32_t>(i), in.seed), 0,
                             static_cast<int>(i - begin));
        }
        w.first.settle();
        for (int done = 0; done < in.samples; done += together) {
            const int samples = std::min(together, in.samples - done);
            w.paths->n = 0;
            for (int k = 0; k < points * samples; ++k) w.light.set(k, {});
            for (int k = 0; k < w.first.n; ++k)
                w.paths->repeat(w.first, k, in.first + static_cast<uint32_t>(done),
                                w.first.path[k] * samples, samples);
            trace(in, map, w);
            for (int k = 0, i = 0; k < points; ++k)
                for (int j = 0; j < samples; ++j, ++i)
                    sum[k] += vec3<double>(w.light.x[i], w.light.y[i], w.light.z[i]);
        }
        for (int k = 0; k < points; ++k)
            store3(rgb, begin + k, vec3<float>(sum[k] / static_cast<double>(in.samples)));
    });
}

}  // namespace univoxel
