#include "integrator.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <memory>

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
    return {at + kHitOffset * size * geometric, geometric, normal,
            PathBrdf::of(PathFrame(normal).to_local(-1 * direction), albedo, roughness, f0)};
}

/// Number rays so that neighbours point the same way: by the square of a 16 x 16 grid over the
/// octahedron that their direction meets, the squares along Morton's curve.
template <int N>
void order_by_direction(const Ways<N>& ways, uint8_t* key, int32_t* order) {
    const int n = ways.n;
#pragma GCC ivdep
    for (int i = 0; i < n; ++i) {
        const vec d = ways.direction[i];
        const float ax = std::abs(d.x), ay = std::abs(d.y);
        const float scale = 1 / (ax + ay + std::abs(d.z) + 1e-30f);
        const float fx = std::copysign(1 - ay * scale, d.x),
                    fy = std::copysign(1 - ax * scale, d.y);
        const float x = d.z < 0 ? fx : d.x * scale, y = d.z < 0 ? fy : d.y * scale;
        uint32_t a = static_cast<int32_t>(std::min(std::max(0.f, 8 + 8 * x), 15.f));
        uint32_t b = static_cast<int32_t>(std::min(std::max(0.f, 8 + 8 * y), 15.f));
        a = (a | (a << 2)) & 0x33, b = (b | (b << 2)) & 0x33;
        a = (a | (a << 1)) & 0x55, b = (b | (b << 1)) & 0x55;
        key[i] = static_cast<uint8_t>(a | (b << 1));
    }
    int32_t start[257] = {};
    for (int i = 0; i < n; ++i) ++start[key[i] + 1];
    for (int k = 0; k < 256; ++k) start[k + 1] += start[k];
    for (int i = 0; i < n; ++i) order[start[key[i]]++] = i;
}

/// Put the rays of some ways side by side in a good order.
template <int N>
RayStream stream_of(Wave& w, const Ways<N>& ways, float t_min) {
    order_by_direction(ways, w.key, w.order);
    for (int j = 0; j < ways.n; ++j) {
        const int i = w.order[j];
        w.origin.set(j, w.paths->origin[ways.lane[i]]);
        w.direction.set(j, ways.direction[i]);
        w.distance[j] = ways.distance[i];
    }
    return {w.origin.x,    w.origin.y,    w.origin.z, w.direction.x,
            w.direction.y, w.direction.z, t_min,      ways.n};
}

/// Look along the shadow rays and add the light that arrives.
void trace_shadows(const Relight& in, Wave& w, float t_min) {
    in.scene->occluded(stream_of(w, w.shadows, t_min), w.distance, w.blocked);
    for (int j = 0; j < w.shadows.n; ++j) {
        if (w.blocked[j]) continue;
        const int i = w.order[j], path = w.paths->path[w.shadows.lane[i]];
        w.light.set(path, w.light[path] + w.shadows.light[i]);
    }
    w.shadows.n = 0;
}

/// Take those of the ways drawn that carry light among the shadow rays; times the map's light where
/// one is given.
void queue_drawn(const Relight& in, Wave& w, float t_min, const EnvMap* map = nullptr) {
    Ways<2 * kLanes>& to = w.shadows;
    if (to.n + w.paths->n > 2 * kLanes) trace_shadows(in, w, t_min);
    const int first = to.n;
    for (int i = 0; i < w.paths->n; ++i) {
        const vec light = w.drawn.light[i];
        to.direction.set(to.n, w.drawn.direction[i]);
        to.light.set(to.n, light);
        to.distance[to.n] = w.drawn.distance[i];
        to.lane[to.n] = i;
        to.n += largest(light) > 0;
    }
    if (!map) return;
    for (int k = first; k < to.n; ++k)
        to.light.set(k, to.light[k] * map->radiance({w.x[to.lane[k]], w.y[to.lane[k]]}));
}

/// Light of the suns and lamps that arrives at the vertices and leaves them along the paths.
void draw_suns_and_lamps(const Relight& in, Wave& w, uint32_t depth, float t_min) {
    const Paths& p = *w.paths;
    const auto add = [&](int i, vec direction, vec irradiance, float distance) {
        const vec local = PathFrame(p.normal[i]).to_local(direction);
        const vec light = p.throughput[i] * p.brdf(i).evaluate(local).f_cos * irradiance;
        w.drawn.direction.set(i, direction);
        w.drawn.light.set(i, where(above(p, i, direction), light));
        w.drawn.distance[i] = distance;
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
        queue_drawn(in, w, t_min);
    }
    for (int64_t k = 0; k < in.lights.n_lamps; ++k) {
        const vec position = row(in.lights.lamp + 6 * k);
        const vec intensity = row(in.lights.lamp + 6 * k + 3);
        for (int i = 0; i < p.n; ++i) {
            const vec way = position - p.origin[i];
            const float squared = std::max(dot(way, way), 1e-30f);
            const float distance = std::sqrt(squared);
            add(i, (1 / distance) * way, (1 / squared) * intensity, distance);
        }
        queue_drawn(in, w, t_min);
    }
}

/// Draw a direction of the map for each path: `drawn` gets what arrives for each unit of light.
void draw_map(const Relight& in, const EnvMap& map, Wave& w, uint32_t depth) {
    const Paths& p = *w.paths;
    const int n = p.n;
#pragma GCC ivdep
    for (int i = 0; i < n; ++i) {
        const Point2 u = sobol2(p.index[i], hash(hash(p.seed[i], depth), 0));
        w.u[i] = u.x, w.v[i] = u.y;
    }
    map.draw({w.u, w.v, w.row, w.column, w.x, w.z, n});
    const float both = in.strategy == Strategy::mis ? 1 : 0;
#pragma GCC ivdep
    for (int i = 0; i < n; ++i) {
        const vec direction = map.direction(w.x[i], w.z[i]);
        const PathFrame frame(p.normal[i]);
        const PathBrdf::Value value = p.brdf(i).evaluate(frame.to_local(direction));
        const float pdf = map.pdf(w.row[i], w.column[i]);
        const bool ok = (pdf > 0) & above(p, i, direction);
        const float weight = ok ? mis_weight(pdf, value.pdf, both) / pdf : 0.f;
        w.y[i] = map.down(w.z[i]);
        w.drawn.direction.set(i, direction);
        w.drawn.light.set(i, weight * (p.throughput[i] * value.f_cos));
        w.drawn.distance[i] = kFar;
    }
}

/// Draw a direction of the BRDF for each path: what arrives for each unit of the map's light, and
/// of light from a next vertex; a density of 0 where the path ends.
void draw_brdf(const Relight& in, const EnvMap& map, Wave& w, uint32_t depth) {
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
        w.drawn.direction.set(i, direction);
        w.drawn.distance[i] = kFar;
    }
#pragma GCC ivdep
    for (int i = 0; i < n; ++i) {
        const MapPlace at = map.place(w.drawn.direction[i]);
        const float balance = lit * mis_weight(w.pdf[i], map.pdf(at), both);
        const float weight = w.pdf[i] > 0 ? balance : 0.f;
        w.x[i] = at.x, w.y[i] = at.y;
        w.drawn.light.set(i, weight * w.throughput[i]);
    }
}

/// Follow the directions drawn: to the map, whose light is added, or to the next vertices.
void advance(const Relight& in, const EnvMap& map, Wave& w, uint32_t depth, float t_min) {
    Ways<2 * kLanes>& ways = w.shadows;  // empty now
    for (int i = 0; i < w.paths->n; ++i) {
        ways.direction.set(ways.n, w.drawn.direction[i]);
        ways.distance[ways.n] = kFar;
        ways.lane[ways.n] = i;
        ways.n += w.pdf[i] > 0;
    }
    in.scene->closest_hit(stream_of(w, ways, t_min), w.hit);
    w.next->n = 0;
    for (int j = 0; j < ways.n; ++j) {
        const int i = ways.lane[w.order[j]], path = w.paths->path[i];
        const Hit& hit = w.hit[j];
        if (hit.face < 0) {
            const vec light = w.drawn.light[i] * map.radiance({w.x[i], w.y[i]});
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
        w.next->push(vertex_at(in, w.paths->origin[i], w.drawn.direction[i], hit), throughput, seed,
                     index, path, 1);
    }
    ways.n = 0;
    std::swap(w.paths, w.next);
}

/// Radiance along the paths of a wave, into `light`.
void trace(const Relight& in, const EnvMap& map, Wave& w) {
    float t_min = in.offset;
    for (int depth = 0; w.paths->n > 0; ++depth, t_min = 0) {
        const bool last = depth == in.bounces;
        draw_suns_and_lamps(in, w, depth, t_min);
        if (in.strategy != Strategy::brdf && !map.black()) {
            draw_map(in, map, w, depth);
            queue_drawn(in, w, t_min, &map);
        }
        if (!last || (in.strategy != Strategy::map && !map.black())) {
            draw_brdf(in, map, w, depth);
            if (last) queue_drawn(in, w, t_min, &map);
        }
        trace_shadows(in, w, t_min);
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
        vec3<double> sum[kLanes] = {};  // in float, equal addends of many samples drift
        const int points = static_cast<int>(end - begin), together = kLanes / points;
        for (int done = 0; done < in.samples; done += together) {
            const int samples = std::min(together, in.samples - done);
            w.paths->n = w.shadows.n = 0;
            for (int k = 0; k < points * samples; ++k) w.light.set(k, {});
            for (int64_t i = begin; i < end; ++i) {
                const vec normal = row(in.normal, i), wo = row(in.wo, i);
                const vec position = row(in.position, i), albedo = row(in.albedo, i);
                const vec f0 = row(in.f0, i);
                // A missing normal, or anything that is not a number, shades black.
                if (!(dot(normal, normal) > 0.5f) ||
                    !std::isfinite(mean(normal + wo + position + albedo + f0) + in.roughness[i]))
                    continue;
                const Vertex first{
                    position + in.offset * normal,
                    {},
                    normal,
                    PathBrdf::of(PathFrame(normal).to_local(wo), albedo, in.roughness[i], f0)};
                const uint32_t seed = hash(static_cast<uint32_t>(i), in.seed);
                w.paths->push(first, {1, 1, 1}, seed, in.first + static_cast<uint32_t>(done),
                              static_cast<int>(i - begin) * samples, samples);
            }
            trace(in, map, w);
            for (int k = 0; k < points * samples; ++k)
                sum[k / samples] += vec3<double>(w.light.x[k], w.light.y[k], w.light.z[k]);
        }
        for (int k = 0; k < points; ++k)
            store3(rgb, begin + k, vec3<float>(sum[k] / static_cast<double>(in.samples)));
    });
}

}  // namespace univoxel
