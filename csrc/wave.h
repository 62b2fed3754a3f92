// What the path tracer holds of the paths that it follows side by side: one column per number, so
// that its loops run over many paths at once.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <numeric>

#include "float3.h"
#include "path_brdf.h"
#include "visibility.h"

namespace univoxel {

constexpr int kLanes = 1024;  // paths in a wave: its columns stay in the second-level cache

template <int N>
struct Columns {
    float x[N], y[N], z[N];

    float3 operator[](int i) const { return {x[i], y[i], z[i]}; }
    void set(int i, float3 v) { x[i] = v.x, y[i] = v.y, z[i] = v.z; }
    void fill(int first, int count, float3 v) {
        std::fill_n(x + first, count, v.x);
        std::fill_n(y + first, count, v.y);
        std::fill_n(z + first, count, v.z);
    }
};

/// Orthonormal frame around a unit normal (Duff et al. 2017).
struct PathFrame {
    float3 s, t, n;

    explicit PathFrame(float3 normal) : n(normal) {
        const float sign = std::copysign(1.f, n.z), a = -1 / (sign + n.z), b = n.x * n.y * a;
        s = {1 + sign * n.x * n.x * a, sign * b, -sign * n.x};
        t = {b, sign + n.y * n.y * a, -n.y};
    }
    float3 to_local(float3 v) const { return {dot(v, s), dot(v, t), dot(v, n)}; }
    float3 to_world(float3 v) const { return v.x * s + v.y * t + v.z * n; }
};

/// A place where a path meets a surface.
struct Vertex {
    float3 origin;     // where its rays start
    float3 geometric;  // no light comes from below this plane; zero: no such plane
    float3 normal;
    PathBrdf brdf;
};

/// Paths at their present vertex, one a lane.
struct Paths {
    int n = 0;
    Columns<kLanes> origin, geometric, normal, throughput;
    Columns<kLanes> wo, diffuse, f0;
    float alpha[kLanes], specular_share[kLanes];
    uint32_t seed[kLanes], index[kLanes];  // of the path's numbers
    int32_t path[kLanes];                  // its place in `Wave::light`

    PathBrdf brdf(int i) const { return {wo[i], diffuse[i], f0[i], alpha[i], specular_share[i]}; }

    /// Start `count` paths at one vertex, whose numbers and places count up.
    void push(const Vertex& v, float3 carries, uint32_t own, uint32_t number, int32_t place,
              int count) {
        origin.fill(n, count, v.origin), geometric.fill(n, count, v.geometric);
        normal.fill(n, count, v.normal), throughput.fill(n, count, carries);
        wo.fill(n, count, v.brdf.wo), diffuse.fill(n, count, v.brdf.diffuse);
        f0.fill(n, count, v.brdf.f0);
        std::fill_n(alpha + n, count, v.brdf.alpha);
        std::fill_n(specular_share + n, count, v.brdf.specular_share);
        std::fill_n(seed + n, count, own);
        std::iota(index + n, index + n + count, number);
        std::iota(path + n, path + n + count, place);
        n += count;
    }
};

/// Directions from the lanes of `Paths`, and what arrives along each if nothing stands in its way.
template <int N>
struct Ways {
    int n = 0;
    Columns<N> direction, light;
    float distance[N];
    int32_t lane[N];
};

/// All that one thread needs.
struct Wave {
    Paths both[2];
    Paths *paths = &both[0], *next = &both[1];
    Columns<kLanes> light;       // by path: its radiance so far
    Ways<kLanes> drawn;          // one for each lane
    Columns<kLanes> throughput;  // of the paths that go on along `drawn`
    float pdf[kLanes];           // of the BRDF's draws; 0: the path ends
    Ways<2 * kLanes> shadows;    // to be looked along
    // Draws of the map
    float u[kLanes], v[kLanes];
    int32_t row[kLanes], column[kLanes];
    float x[kLanes], y[kLanes], z[kLanes];
    // A batch of rays on its way to Embree
    uint8_t key[2 * kLanes], blocked[2 * kLanes];
    int32_t order[2 * kLanes];
    Columns<2 * kLanes> origin, direction;
    float distance[2 * kLanes];
    Hit hit[kLanes];
};

}  // namespace univoxel
