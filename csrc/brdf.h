// The BRDF of docs/reference/conventions.md in scalars: a GGX layer over a Lambertian base.
// univoxel/brdf.py is its twin; tests hold one against the other.
#pragma once

#include <algorithm>
#include <cmath>
#include <glm/vec2.hpp>

#include "common.h"

namespace univoxel {

constexpr double kAlphaMin = 1e-3;     // smallest GGX alpha
constexpr double kCosMin = 1e-4;       // cosines in denominators are held above this
constexpr double kHalfEpsilon = 1e-7;  // added to |wi + wo|^2, which may be 0

/// GGX alpha = roughness^2, at least kAlphaMin.
template <class T>
inline T ggx_alpha(T roughness) {
    return std::max(roughness * roughness, T(kAlphaMin));
}

/// |n x h|^2 + a^2 (n.h)^2, the root of D's denominator over pi; never below a^2 for a unit h, and
/// half of that guards a missing half vector.
template <class T>
inline T ggx_denominator(T n_dot_h_squared, T n_cross_h_squared, T a2) {
    return std::max(n_cross_h_squared + a2 * n_dot_h_squared, T(0.5) * a2);
}

/// GGX normal distribution (Walter et al. 2007, eq. 33); a2 is alpha squared.
template <class T>
inline T ggx_d(T n_dot_h_squared, T n_cross_h_squared, T a2) {
    const T den = ggx_denominator(n_dot_h_squared, n_cross_h_squared, a2);
    return a2 / (T(kPi) * den * den);
}

/// The root in Smith's masking: sqrt(c^2 (1 - a^2) + a^2) for a cosine c.
template <class T>
inline T smith_root(T cosine, T a2) {
    return std::sqrt(cosine * cosine * (1 - a2) + a2);
}

/// Height-correlated Smith masking-shadowing over 4 (n.v)(n.l) (Heitz 2014, eq. 99). Cosines must
/// be at least kCosMin.
template <class T>
inline T smith_v(T n_dot_v, T n_dot_l, T a2) {
    return T(0.5) / (n_dot_l * smith_root(n_dot_v, a2) + n_dot_v * smith_root(n_dot_l, a2));
}

/// (1 - v.h)^5, the share of 1 in Schlick's mean of 1 and F0.
template <class T>
inline T schlick_weight(T v_dot_h) {
    const T m = 1 - v_dot_h, m2 = m * m;
    return m2 * m2 * m;
}

/// Fresnel reflectance (Schlick 1994, eq. 15).
template <class T>
inline T schlick_f(T v_dot_h, T f0) {
    return f0 + (1 - f0) * schlick_weight(v_dot_h);
}

/// E, the albedo of the specular layer alone, and its derivatives.
template <class T>
struct SpecularAlbedo {
    T value;        // in [0, 1]
    T d_cosine;     // dE / d n.v
    T d_roughness;  // dE / d roughness
};

/// Polynomials of total degree 4 in cosine, roughness and u = cosine / (cosine + alpha), exponents
/// counting up with that of u fastest: E for F0 = 0 and for F0 = 1. See univoxel/brdf.py.
constexpr double kAlbedoBlack[35] = {
    0.745523, 2.79565,  -8.54429, 10.4028,  -4.40541, -2.03631, -3.23016, 5.87168, -1.51822,
    2.34881,  -10.8813, 28.1217,  -1.20787, 31.7152,  0.18939,  -5.392,   5.48925, -22.6324,
    17.9447,  3.53936,  -28.1758, 25.3064,  -25.0208, 5.48368,  6.23112,  9.27461, 3.79092,
    -4.89692, 5.30421,  -3.44505, -1.23944, -2.04994, -4.57074, -1.07901, 2.02599,
};
constexpr double kAlbedoWhite[35] = {
    0.724531, -0.74156, 1.75763,  -0.0237653, -0.714459, 1.22618,   14.7944,  -35.535,  19.52,
    -2.26108, -44.7913, 76.4906,  2.05057,    90.465,    -0.773033, -13.8655, 30.9258,  -45.5647,
    28.4446,  5.73739,  -84.7276, 77.534,     -79.2618,  69.526,    24.9903,  23.2341,  -46.2919,
    23.344,   -6.60739, 9.15137,  -7.20615,   7.20929,   -7.59783,  -0.86621, 0.162265,
};

/// A polynomial with such exponents, of numbers or of pairs of them, and its derivatives.
template <class V, class T, class Coefficient>
inline SpecularAlbedo<V> albedo_polynomial(T n_dot_v, T roughness, Coefficient&& coefficient) {
    const T v = std::max(n_dot_v, T(kCosMin)), alpha = ggx_alpha(roughness);
    const T inv = 1 / (v + alpha), u = v * inv;
    T pv[5] = {1}, pr[5] = {1}, pu[5] = {1};
    for (int i = 1; i < 5; ++i) {
        pv[i] = pv[i - 1] * v;
        pr[i] = pr[i - 1] * roughness;
        pu[i] = pu[i - 1] * u;
    }
    V value(0), dv(0), dr(0), du(0);
    for (int i = 0, term = 0; i < 5; ++i) {
        for (int j = 0; i + j < 5; ++j) {
            for (int k = 0; i + j + k < 5; ++k, ++term) {
                const V c = coefficient(term);
                value += c * pv[i] * pr[j] * pu[k];
                if (i > 0) dv += c * T(i) * pv[i - 1] * pr[j] * pu[k];
                if (j > 0) dr += c * T(j) * pv[i] * pr[j - 1] * pu[k];
                if (k > 0) du += c * T(k) * pv[i] * pr[j] * pu[k - 1];
            }
        }
    }
    if (n_dot_v >= T(kCosMin))
        dv += du * alpha * inv * inv;
    else
        dv = V(0);
    if (roughness * roughness >= T(kAlphaMin)) dr -= du * v * inv * inv * T(2) * roughness;
    return {value, dv, dr};
}

/// Within 0.005 of quadrature for n.v in [0.02, 1], roughness in [0.05, 1] and any F0.
template <class T>
inline SpecularAlbedo<T> specular_albedo(T n_dot_v, T roughness, T f0) {
    const auto e = albedo_polynomial<T>(n_dot_v, roughness, [f0](int term) {
        return T(kAlbedoBlack[term]) + f0 * (T(kAlbedoWhite[term]) - T(kAlbedoBlack[term]));
    });
    if (e.value < 0 || e.value > 1) return {std::min(std::max(e.value, T(0)), T(1)), 0, 0};
    return e;
}

/// E of an F0 per channel, and its derivatives.
template <class T>
struct ColoredAlbedo {
    vec3<T> value, d_cosine, d_roughness;
    vec3<T> d_f0;  // dE_c / d F0_c
};

template <class T>
inline ColoredAlbedo<T> specular_albedo(T n_dot_v, T roughness, const vec3<T>& f0) {
    using Pair = glm::vec<2, T, glm::defaultp>;
    const auto e = albedo_polynomial<Pair>(n_dot_v, roughness, [](int term) {
        return Pair(T(kAlbedoBlack[term]), T(kAlbedoWhite[term]) - T(kAlbedoBlack[term]));
    });
    const vec3<T> value = e.value.x + f0 * e.value.y;
    ColoredAlbedo<T> out{value, e.d_cosine.x + f0 * e.d_cosine.y,
                         e.d_roughness.x + f0 * e.d_roughness.y, vec3<T>(e.value.y)};
    for (int c = 0; c < 3; ++c) {
        if (!(value[c] < 0 || value[c] > 1)) continue;
        out.value[c] = std::min(std::max(value[c], T(0)), T(1));
        out.d_cosine[c] = out.d_roughness[c] = out.d_f0[c] = 0;
    }
    return out;
}

}  // namespace univoxel
