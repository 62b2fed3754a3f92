// The BRDF as a path tracer needs it: its value, its density, and directions sampled from it. No
// branches, so that loops over many points vectorise.
#pragma once

#include <algorithm>
#include <cmath>

#include "angles.h"
#include "brdf.h"
#include "sobol.h"

namespace univoxel {

/// The polynomials of specular_albedo, unrolled for loops over points: terms from First on in the
/// last, the last two and all three of their variables, up to a total degree of N - 1.
template <int First, int N>
inline float albedo_terms(const double (&c)[35], float u) {
    if constexpr (N == 1)
        return static_cast<float>(c[First]);
    else
        return static_cast<float>(c[First]) + u * albedo_terms<First + 1, N - 1>(c, u);
}
template <int First, int N>
inline float albedo_terms(const double (&c)[35], float roughness, float u) {
    const float here = albedo_terms<First, N>(c, u);
    if constexpr (N == 1)
        return here;
    else
        return here + roughness * albedo_terms<First + N, N - 1>(c, roughness, u);
}
template <int First, int N>
inline float albedo_terms(const double (&c)[35], float cosine, float roughness, float u) {
    const float here = albedo_terms<First, N>(c, roughness, u);
    if constexpr (N == 1)
        return here;
    else
        return here + cosine * albedo_terms<First + N*(N + 1) / 2, N - 1>(c, cosine, roughness, u);
}

/// At one point towards one eye, in the frame of the normal.
struct PathBrdf {
    float3 wo, diffuse, f0;       // diffuse: (1 - E) albedo / pi
    float alpha, specular_share;  // how often `sample` chooses the specular layer

    static PathBrdf of(float3 wo, const float3& albedo, float roughness, const float3& f0) {
        // An eye behind the shading normal looks on at grazing angle.
        wo.z = std::max(wo.z, float(kCosMin));
        wo = unit(wo);
        const float alpha = ggx_alpha(roughness), u = wo.z / (wo.z + alpha);
        const float black = albedo_terms<0, 5>(kAlbedoBlack, wo.z, roughness, u);
        const float white = albedo_terms<0, 5>(kAlbedoWhite, wo.z, roughness, u);
        const auto layer_of = [=](float f) {
            return std::min(std::max(0.f, black + f * (white - black)), 1.f);
        };
        const float3 layer{layer_of(f0.x), layer_of(f0.y), layer_of(f0.z)};
        const float3 diffuse = (float3{1, 1, 1} - layer) * albedo;
        const float base = mean(diffuse), top = mean(layer);
        return {wo, (1 / float(kPi)) * diffuse, f0, alpha, top / std::max(top + base, 1e-6f)};
    }

    struct Value {
        float3 f_cos;  // the BRDF times the cosine to the light; 0 from below
        float pdf;     // of `sample`, per steradian; 0 from below
    };

    Value evaluate(const float3& wi) const {
        const float a2 = alpha * alpha;
        const float3 h = wo + wi;
        const float squared = dot(h, h) + float(kHalfEpsilon);
        const float inverse = 1 / squared;
        const float d = ggx_d(h.z * h.z * inverse, (h.x * h.x + h.y * h.y) * inverse, a2);
        const float root = smith_root(wo.z, a2);
        const float z = std::max(wi.z, float(kCosMin));
        const float v = 0.5f / (z * root + wo.z * smith_root(z, a2));
        const float f = schlick_f(0.5f * std::sqrt(squared), 0.f), dv = d * v;
        // Visible normals have density D G1 (wo.h) / (n.wo); reflection divides by 4 (wo.h).
        const float pdf =
            specular_share * d / (2 * (wo.z + root)) + (1 - specular_share) * wi.z / float(kPi);
        const float lit = wi.z > 0 ? wi.z : 0.f;
        const float3 one{1, 1, 1};
        return {lit * (diffuse + dv * (f0 + f * (one - f0))), wi.z > 0 ? pdf : 0.f};
    }

    /// A direction to the light, perhaps below the horizon, where `evaluate` gives 0.
    float3 sample(Point2 u) const {
        // One number chooses the lobe and, stretched, serves within it: strata stay whole.
        const bool specular = u.x < specular_share;
        const float rest = 1 - specular_share;
        const float x = specular ? u.x / std::max(specular_share, 1e-30f)
                                 : (u.x - specular_share) / std::max(rest, 1e-30f);
        // A visible normal of the GGX layer (Heitz 2018), through the spherical cap of Dupuy and
        // Benyoub 2023; for the base a direction in proportion to its cosine.
        const float3 stretched = unit({alpha * wo.x, alpha * wo.y, wo.z});
        const float cap = (1 - x) * (1 + stretched.z) - stretched.z;
        const float z = specular ? cap : std::sqrt(std::max(0.f, 1 - x));
        const float3 on = on_circle(u.y, std::sqrt(std::max(0.f, 1 - z * z)), z);
        const float3 h = unit({alpha * (on.x + stretched.x), alpha * (on.y + stretched.y),
                               std::max(on.z + stretched.z, 1e-7f)});
        const float3 mirrored = 2 * dot(wo, h) * h - wo;
        return {specular ? mirrored.x : on.x, specular ? mirrored.y : on.y,
                specular ? mirrored.z : on.z};
    }
};

}  // namespace univoxel
