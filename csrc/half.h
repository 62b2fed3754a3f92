// Numbers of 16 bits.
#pragma once

#include <cstdint>
#include <cstring>

namespace univoxel {

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

}  // namespace univoxel
