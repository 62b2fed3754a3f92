// Shared by kernels over vectors: 3-vectors over GLM and row-major access.
#pragma once

#include <cstdint>
#include <glm/geometric.hpp>
#include <glm/vec3.hpp>

namespace univoxel {

constexpr double kPi = 3.14159265358979323846;

template <class T>
using vec3 = glm::vec<3, T, glm::defaultp>;

/// Row i of a row-major [N, 3] buffer.
template <class T>
inline vec3<T> load3(const T* p, int64_t i = 0) {
    return {p[3 * i], p[3 * i + 1], p[3 * i + 2]};
}

template <class T>
inline void store3(T* p, int64_t i, const vec3<T>& v) {
    p[3 * i] = v.x;
    p[3 * i + 1] = v.y;
    p[3 * i + 2] = v.z;
}

}  // namespace univoxel
