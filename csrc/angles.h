// Angles in turns (1 is a full circle) without calls to libm, so that loops over them vectorise.
#pragma once

#include <algorithm>
#include <cmath>

#include "float3.h"

namespace univoxel {

struct CosSin {
    float cos, sin;
};

/// Cosine and sine of a number of turns; within 1e-6 for |turns| < 100.
inline CosSin cos_sin(float turns) {
    // The nearest quarter, and the rest in radians, at most pi / 4.
    const float quarter = std::floor(4 * turns + 0.5f);
    const float x = float(2 * kPi) * (turns - 0.25f * quarter), x2 = x * x;
    const float c = 1 + x2 * (-1 / 2.f + x2 * (1 / 24.f + x2 * (-1 / 720.f + x2 / 40320)));
    const float s = x * (1 + x2 * (-1 / 6.f + x2 * (1 / 120.f + x2 * (-1 / 5040.f))));
    const int q = static_cast<int>(quarter) & 3;
    const float a = q & 1 ? s : c, b = q & 1 ? c : s;
    return {static_cast<float>(1 - ((q + 1) & 2)) * a, static_cast<float>(1 - (q & 2)) * b};
}

/// atan2(y, x) in turns, in [-1/2, 1/2], within 1e-7; 0 for (0, 0). The polynomial is a minimax
/// fit of atan on [0, 1].
inline float turns_of(float y, float x) {
    const float ax = std::abs(x), ay = std::abs(y);
    const float low = ax < ay ? ax : ay, high = ax < ay ? ay : ax;
    const float r = low / (high + 1e-37f), r2 = r * r;
    float t =
        0.159154324f +
        r2 * (-0.0530262385f +
              r2 * (0.031525119f +
                    r2 * (-0.0210615203f +
                          r2 * (0.0126725019f + r2 * (-0.00534827673f + r2 * 0.00108412983f)))));
    t *= r;
    t = ay > ax ? 0.25f - t : t;
    t = x < 0 ? 0.5f - t : t;
    return y < 0 ? -t : t;
}

/// A place uniform on the unit circle from u in [0, 1), scaled.
inline float3 on_circle(float u, float radius, float z) {
    const CosSin a = cos_sin(u);
    return {radius * a.cos, radius * a.sin, z};
}

}  // namespace univoxel
