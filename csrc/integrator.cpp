#include "integrator.h"

#include <algorithm>
#include <cmath>
#include <limits>

#include "brdf.h"
#include "parallel.h"
#include "sobol.h"

namespace univoxel {
namespace {

using vec = vec3<float>;

constexpr int64_t kPointsPerChunk = 32;
constexpr float kF0 = 0.04f;
constexpr float kPi32 = static_cast<float>(kPi);
constexpr int kRouletteDepth = 2;    // bounces before paths may end at random
constexpr float kHitOffset = 1e-5f;  // of the coordinates: lifts a ray off the triangle it left

float largest(const vec& v) {
    return std::max(v.x, std::max(v.y, v.z));
}

float mean(const vec& v) {
    return (v.x + v.y + v.z) / 3;
}

/// Orthonormal frame around a unit normal (Duff et al. 2017).
struct Frame {
    vec s, t, n;

    explicit Frame(const vec& normal) : n(normal) {
        const float sign = std::copysign(1.f, n.z), a = -1 / (sign + n.z), b = n.x * n.y * a;
        s = {1 + sign * n.x * n.x * a, sign * b, -sign * n.x};
        t = {b, sign + n.y * n.y * a, -n.y};
    }
    vec to_local(const vec& v) const { return {glm::dot(v, s), glm::dot(v, t), glm::dot(v, n)}; }
    vec to_world(const vec& v) const { return v.x * s + v.y * t + v.z * n; }
};

/// E of docs/conventions.md for each channel of F0, most often one value.
vec layer_albedo(float cosine, float roughness, const vec& f0) {
    vec e(specular_albedo(cosine, roughness, f0.x).value);
    if (f0.y != f0.x) e.y = specular_albedo(cosine, roughness, f0.y).value;
    if (f0.z != f0.x) e.z = specular_albedo(cosine, roughness, f0.z).value;
    return e;
}

/// The BRDF at one point towards one eye, in the frame of the normal.
class Brdf {
  public:
    Brdf(vec wo, const vec& albedo, float roughness, const vec& f0) : f0_(f0) {
        // An eye behind the shading normal looks on at grazing angle.
        wo.z = std::max(wo.z, static_cast<float>(kCosMin));
        wo_ = glm::normalize(wo);
        alpha_ = ggx_alpha(roughness);
        a2_ = alpha_ * alpha_;
        const vec layer = layer_albedo(wo_.z, roughness, f0);
        diffuse_ = (1.f - layer) / kPi32 * albedo;
        const float base = kPi32 * mean(diffuse_), top = mean(layer);
        specular_share_ = top / std::max(top + base, 1e-6f);
    }

    struct Value {
        vec f_cos;  // the BRDF times the cosine to the light
        float pdf;  // of `sample`, per steradian
    };

    Value evaluate(const vec& wi) const {
        if (!(wi.z > 0)) return {{0, 0, 0}, 0};
        const vec h = wo_ + wi;
        const float squared = glm::dot(h, h) + static_cast<float>(kHalfEpsilon);
        const float d = ggx_d(h.z * h.z / squared, (h.x * h.x + h.y * h.y) / squared, a2_);
        const float v = smith_v(wo_.z, std::max(wi.z, static_cast<float>(kCosMin)), a2_);
        const float grazing = schlick_f(0.5f * std::sqrt(squared), 0.f);
        const vec f = f0_ + (1.f - f0_) * grazing;
        // Visible normals have density D G1 (wo.h) / (n.wo); reflection divides by 4 (wo.h).
        const float pdf_specular = d / (2 * (wo_.z + smith_root(wo_.z, a2_)));
        return {wi.z * (diffuse_ + d * v * f),
                specular_share_ * pdf_specular + (1 - specular_share_) * wi.z / kPi32};
    }

    /// A direction to the light, perhaps below the horizon, where `evaluate` gives 0.
    vec sample(Point2 u) const {
        // One number chooses the lobe and, stretched, serves within it: strata stay whole.
        if (u.x < specular_share_) {
            const vec h = visible_normal({u.x / specular_share_, u.y});
            return 2 * glm::dot(wo_, h) * h - wo_;
        }
        const float r2 = (u.x - specular_share_) / (1 - specular_share_);
        const float r = std::sqrt(r2), phi = 2 * kPi32 * u.y;
        return {r * std::cos(phi), r * std::sin(phi), std::sqrt(std::max(0.f, 1 - r2))};
    }

  private:
    /// A GGX normal seen from wo (Heitz 2018), through the spherical cap of Dupuy and Benyoub 2023.
    vec visible_normal(Point2 u) const {
        const vec wo = glm::normalize(vec(alpha_ * wo_.x, alpha_ * wo_.y, wo_.z));
        const float z = (1 - u.x) * (1 + wo.z) - wo.z, phi = 2 * kPi32 * u.y;
        const float r = std::sqrt(std::max(0.f, 1 - z * z));
        const vec h = vec(r * std::cos(phi), r * std::sin(phi), z) + wo;
        return glm::normalize(vec(alpha_ * h.x, alpha_ * h.y, std::max(h.z, 1e-7f)));
    }

    vec wo_, f0_, diffuse_;
    float alpha_, a2_, specular_share_;
};

/// A place where a path meets a surface.
struct Vertex {
    vec origin;     // where its rays start
    float t_min;    // and from where on they count
    vec geometric;  // no light comes from below this plane; zero: no such plane
    Frame frame;
    Brdf brdf;
};

bool above(const Vertex& v, const vec& direction) {
    return glm::dot(v.geometric, direction) >= 0;
}

/// The power heuristic for one sample of each kind (Veach 1997, eq. 9.13).
float mis_weight(float pdf, float other) {
    const float ratio = other / pdf;
    return 1 / (1 + ratio * ratio);
}

/// Interpolate the mesh at a hit.
Vertex vertex_at(const Relight& in, const vec& origin, const vec& direction, const Hit& hit) {
    const int32_t* face = in.scene->faces() + 3 * hit.face;
    const float w[3] = {1 - hit.u - hit.v, hit.u, hit.v};
    vec normal(0), albedo(0), f0(in.vertex_f0 ? 0 : kF0);
    float roughness = 0;
    for (int k = 0; k < 3; ++k) {
        normal += w[k] * load3(in.vertex_normal, face[k]);
        albedo += w[k] * load3(in.vertex_albedo, face[k]);
        roughness += w[k] * in.vertex_roughness[face[k]];
        if (in.vertex_f0) f0 += w[k] * load3(in.vertex_f0, face[k]);
    }
    // Surfaces have two sides: turn both normals to the side that the path came from.
    const vec geometric =
        glm::normalize(glm::dot(hit.normal, direction) < 0 ? hit.normal : -hit.normal);
    const float length = glm::length(normal);
    normal = length > 1e-6f ? normal / length : geometric;
    if (glm::dot(normal, geometric) < 0) normal = -normal;
    const vec position = origin + hit.t * direction;
    const float size = std::max(largest(glm::abs(position)), hit.t);
    const Frame frame(normal);
    return {position + kHitOffset * size * geometric, 0, geometric, frame,
            Brdf(frame.to_local(-direction), albedo, roughness, f0)};
}

/// Light of the suns and lamps that arrives at a vertex and leaves it along the path.
vec analytic_light(const Relight& in, const Vertex& v, uint32_t index, uint32_t seed) {
    vec light(0);
    const auto add = [&](const vec& direction, const vec& irradiance, float distance) {
        const vec arriving = v.brdf.evaluate(v.frame.to_local(direction)).f_cos * irradiance;
        if (largest(arriving) > 0 && above(v, direction) &&
            !in.scene->occluded(v.origin, direction, v.t_min, distance))
            light += arriving;
    };
    const float far = std::numeric_limits<float>::infinity();
    for (int64_t k = 0; k < in.lights.n_suns; ++k) {
        const float* sun = in.lights.sun + 7 * k;
        // A place on its disc, uniform in solid angle; the disc shines evenly.
        const Point2 u = sobol2(index, hash(seed, static_cast<uint32_t>(k)));
        const float down = u.x * (1 - sun[6]), phi = 2 * kPi32 * u.y;
        const float radius = std::sqrt(down * (2 - down));
        const Frame disc(load3(sun));
        add(disc.to_world({radius * std::cos(phi), radius * std::sin(phi), 1 - down}),
            2 / (1 + sun[6]) * load3(sun + 3), far);
    }
    for (int64_t k = 0; k < in.lights.n_lamps; ++k) {
        const float* lamp = in.lights.lamp + 6 * k;
        const vec way = load3(lamp) - v.origin;
        const float squared = glm::dot(way, way), distance = std::sqrt(squared);
        if (squared > 0) add(way / distance, load3(lamp + 3) / squared, distance);
    }
    return light;
}

/// Radiance along one path from the point `v`.
vec trace(const Relight& in, const EnvMap& map, Vertex v, uint32_t index, uint32_t seed) {
    vec light(0), throughput(1);
    for (int depth = 0;; ++depth) {
        const uint32_t own = hash(seed, static_cast<uint32_t>(depth));
        light += throughput * analytic_light(in, v, index, hash(own, 3));
        // Sample the map and look whether its light arrives.
        if (in.strategy != Strategy::brdf && !map.black()) {
            const Point2 u = sobol2(index, hash(own, 0));
            const LightDraw s = map.sample(u.x, u.y);
            const Brdf::Value value = v.brdf.evaluate(v.frame.to_local(s.direction));
            if (s.pdf > 0 && largest(value.f_cos) > 0 && above(v, s.direction)) {
                const float weight =
                    in.strategy == Strategy::mis ? mis_weight(s.pdf, value.pdf) : 1.f;
                const vec arriving = throughput * value.f_cos * map.radiance(s) * (weight / s.pdf);
                if (largest(arriving) > 0 && !in.scene->occluded(v.origin, s.direction, v.t_min))
                    light += arriving;
            }
        }
        // Sample the BRDF: light that comes from there, or the next vertex of the path.
        const bool last = depth == in.bounces;
        if (last && (in.strategy == Strategy::map || map.black())) return light;
        const vec wi = v.brdf.sample(sobol2(index, hash(own, 1)));
        const Brdf::Value value = v.brdf.evaluate(wi);
        const vec direction = v.frame.to_world(wi);
        if (!(value.pdf > 0) || !above(v, direction)) return light;
        throughput *= value.f_cos / value.pdf;
        Hit hit{};
        bool met;
        if (last) {
            met = in.scene->occluded(v.origin, direction, v.t_min);
        } else {
            hit = in.scene->closest_hit(v.origin, direction, v.t_min);
            met = hit.face >= 0;
        }
        if (!met) {
            if (in.strategy == Strategy::map) return light;
            const LightSample s = map.lookup(direction);
            const float weight = in.strategy == Strategy::mis ? mis_weight(value.pdf, s.pdf) : 1.f;
            return light + weight * throughput * s.radiance;
        }
        if (last) return light;
        // End dim paths at random; the survivors carry what these would have brought.
        if (depth + 1 >= kRouletteDepth) {
            const float survival = std::min(1.f, largest(throughput));
            if (!(unit_float(hash(hash(own, 2), index)) < survival)) return light;
            throughput /= survival;
        }
        v = vertex_at(in, v.origin, direction, hit);
    }
}

}  // namespace

void relight(const Relight& in, float* rgb, int threads) {
    const EnvMap map(in.map);
    parallel_for(in.n_points, kPointsPerChunk, threads, [&](int64_t begin, int64_t end) {
        for (int64_t i = begin; i < end; ++i) {
            const vec normal = load3(in.normal, i), wo = load3(in.wo, i);
            const vec position = load3(in.position, i), albedo = load3(in.albedo, i);
            const vec f0 = in.f0 ? load3(in.f0, i) : vec(kF0);
            vec3<double> sum(0);  // in float, equal addends of many samples drift
            // A missing normal, or anything that is not a number, shades black.
            if (glm::dot(normal, normal) > 0.5f &&
                std::isfinite(glm::dot(normal + wo + position + albedo + f0, vec(1)) +
                              in.roughness[i])) {
                const Frame frame(normal);
                const Vertex first{position + in.offset * normal, in.offset, vec(0), frame,
                                   Brdf(frame.to_local(wo), albedo, in.roughness[i], f0)};
                const uint32_t seed = hash(static_cast<uint32_t>(i), in.seed);
                for (int s = 0; s < in.samples; ++s)
                    sum += vec3<double>(
                        trace(in, map, first, in.first + static_cast<uint32_t>(s), seed));
            }
            store3(rgb, i, vec(sum / static_cast<double>(in.samples)));
        }
    });
}

}  // namespace univoxel
