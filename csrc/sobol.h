// Low-discrepancy points: the first two dimensions of Sobol's sequence, Owen-scrambled by a hash
// (Burley 2020, "Practical hash-based Owen scrambling"). Every seed gives another scramble.
#pragma once

#include <cstdint>

namespace univoxel {

/// A well-mixed 32-bit hash (Wellons' "lowbias32" search, 2018).
inline uint32_t hash(uint32_t x) {
    x = (x ^ (x >> 16)) * 0x7feb352du;
    x = (x ^ (x >> 15)) * 0x846ca68bu;
    return x ^ (x >> 16);
}

inline uint32_t hash(uint32_t x, uint32_t y) {
    return hash(x ^ hash(y + 0x9e3779b9u));
}

inline uint32_t reverse_bits(uint32_t x) {
    x = ((x >> 1) & 0x55555555u) | ((x & 0x55555555u) << 1);
    x = ((x >> 2) & 0x33333333u) | ((x & 0x33333333u) << 2);
    x = ((x >> 4) & 0x0f0f0f0fu) | ((x & 0x0f0f0f0fu) << 4);
    x = ((x >> 8) & 0x00ff00ffu) | ((x & 0x00ff00ffu) << 8);
    return (x >> 16) | (x << 16);
}

/// Owen scrambling of a number whose first binary digit is its lowest bit: each step lets a bit
/// depend only on lower ones (Laine and Karras 2011, constants of Burley 2020).
inline uint32_t scramble_reversed(uint32_t x, uint32_t seed) {
    x += seed;
    x ^= x * 0x6c50b47cu;
    x ^= x * 0xb82f1e52u;
    x ^= x * 0xc7afe638u;
    x ^= x * 0x8d22f6e6u;
    return x;
}

/// Sobol's second dimension with the lowest bit first: its generator matrix is Pascal's triangle
/// modulo 2, a sum over supersets of bits.
inline uint32_t pascal(uint32_t x) {
    x ^= (x >> 1) & 0x55555555u;
    x ^= (x >> 2) & 0x33333333u;
    x ^= (x >> 4) & 0x0f0f0f0fu;
    x ^= (x >> 8) & 0x00ff00ffu;
    return x ^ (x >> 16);
}

inline float unit_float(uint32_t x) {
    return static_cast<float>(x >> 8) * 0x1p-24f;
}

struct Point2 {
    float x, y;  // in [0, 1)
};

/// Point `index` of the sequence scrambled by `seed`. Sequences of two seeds are shuffled against
/// each other, so their points can be paired.
inline Point2 sobol2(uint32_t index, uint32_t seed) {
    const uint32_t i = reverse_bits(scramble_reversed(reverse_bits(index), seed));
    return {unit_float(reverse_bits(scramble_reversed(i, hash(seed, 1)))),
            unit_float(reverse_bits(scramble_reversed(pascal(i), hash(seed, 2))))};
}

}  // namespace univoxel
