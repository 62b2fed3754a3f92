// Shared by every kernel: 3-vectors over GLM, row-major access, debug checks.
#pragma once

#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <glm/geometric.hpp>
#include <glm/vec3.hpp>

namespace univoxel {

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

// A broken invariant is a bug of ours: it stops a debug build. User errors are raised in Python.
#ifdef UNIVOXEL_DEBUG
#define DCHECK(condition)                                                                \
    do {                                                                                 \
        if (!(condition)) {                                                              \
            std::fprintf(stderr, "%s:%d: DCHECK(%s)\n", __FILE__, __LINE__, #condition); \
            std::abort();                                                                \
        }                                                                                \
    } while (false)
#else
#define DCHECK(condition) ((void)0)
#endif
