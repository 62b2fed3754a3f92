// Three floats for loops that the compiler turns into vector instructions: GLM's vectors are unions
// inside, which keeps such loops scalar.
#pragma once

#include <algorithm>
#include <cmath>

#include "common.h"

namespace univoxel {

struct float3 {
    float x, y, z;
};

inline float3 of(const vec3<float>& v) {
    return {v.x, v.y, v.z};
}
inline float3 operator+(float3 a, float3 b) {
    return {a.x + b.x, a.y + b.y, a.z + b.z};
}
inline float3 operator-(float3 a, float3 b) {
    return {a.x - b.x, a.y - b.y, a.z - b.z};
}
inline float3 operator*(float3 a, float3 b) {
    return {a.x * b.x, a.y * b.y, a.z * b.z};
}
inline float3 operator*(float s, float3 a) {
    return {s * a.x, s * a.y, s * a.z};
}
inline float dot(float3 a, float3 b) {
    return a.x * b.x + a.y * b.y + a.z * b.z;
}
inline float3 unit(float3 a) {
    return (1 / std::sqrt(dot(a, a))) * a;
}
/// a where it holds, else 0, without a branch.
inline float3 where(bool holds, float3 a) {
    return {holds ? a.x : 0.f, holds ? a.y : 0.f, holds ? a.z : 0.f};
}
inline float largest(float3 a) {
    return std::max(a.x, std::max(a.y, a.z));
}
inline float mean(float3 a) {
    return (a.x + a.y + a.z) / 3;
}

}  // namespace univoxel
