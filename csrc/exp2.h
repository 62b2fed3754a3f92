// 2^x for loops that vectorise, which std::exp2 does not without -ffast-math.
#pragma once

#include <algorithm>
#include <cstdint>
#include <cstring>

namespace univoxel {

// x = k + f, |f| <= 1/2: adding `magic` rounds to the integer k and leaves k + bias in the low
// bits, which become the exponent; 2^f is a polynomial, minimax in float and Taylor's in double,
// summed as a tree. A short chain of dependent operations is what counts: the processor overlaps as
// many iterations as its scheduler holds. x is clamped to where the result is a normal number,
// within 2 ulp; NaN stays NaN.

constexpr double kLog2E = 1.4426950408889634;

/// What 2^x is clamped to. Not constants: the compiler would follow each as a path of its own.
template <class T>
struct Clamp {
    T low, high;
};
inline volatile float exponent_low = -125, exponent_high = 126;
template <class T>
Clamp<T> clamp_of() {
    constexpr T wider = sizeof(T) == 8 ? 8 : 1;
    return {wider * T(exponent_low), wider * T(exponent_high)};
}

inline float simd_exp2(float x, Clamp<float> clamp) {
    constexpr float magic = 12582912.0f + 127.0f;  // 1.5 * 2^23
    x = std::min(std::max(x, clamp.low), clamp.high);
    const float shifted = x + magic, f = x - (shifted - magic), f2 = f * f;
    uint32_t bits;
    std::memcpy(&bits, &shifted, sizeof bits);
    bits <<= 23;
    float scale;
    std::memcpy(&scale, &bits, sizeof scale);
    const float p = (1.0f + 0.693146978f * f) + f2 * ((0.240222421f + 0.0555073374f * f) +
                                                      f2 * (0.00967151269f + 0.00132647272f * f));
    return p * scale;
}

/// ln(2)^n / n!
constexpr double exp2_term(int n) {
    double term = 1;
    for (int i = 1; i <= n; ++i) term *= 0.69314718055994530942 / i;
    return term;
}

inline double simd_exp2(double x, Clamp<double> clamp) {
    constexpr double magic = 6755399441055744.0 + 1023.0;  // 1.5 * 2^52
    constexpr double c1 = exp2_term(1), c2 = exp2_term(2), c3 = exp2_term(3), c4 = exp2_term(4),
                     c5 = exp2_term(5), c6 = exp2_term(6), c7 = exp2_term(7), c8 = exp2_term(8),
                     c9 = exp2_term(9), c10 = exp2_term(10), c11 = exp2_term(11),
                     c12 = exp2_term(12), c13 = exp2_term(13);
    x = std::min(std::max(x, clamp.low), clamp.high);
    const double shifted = x + magic, f = x - (shifted - magic), f2 = f * f, f4 = f2 * f2;
    uint64_t bits;
    std::memcpy(&bits, &shifted, sizeof bits);
    bits <<= 52;
    double scale;
    std::memcpy(&scale, &bits, sizeof scale);
    const double low = (1 + c1 * f) + f2 * (c2 + c3 * f);
    const double middle = (c4 + c5 * f) + f2 * (c6 + c7 * f);
    const double high = (c8 + c9 * f) + f2 * (c10 + c11 * f) + f4 * (c12 + c13 * f);
    return (low + f4 * (middle + f4 * high)) * scale;
}

}  // namespace univoxel
