// What the path tracer holds of the paths that it follows side by side: one column per number, so
// that its loops run over many paths at once.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <numeric>
#include <utility>

#include "dcheck.h"
#include "float3.h"
#include "frame.h"
#include "path_brdf.h"
#include "visibility.h"

namespace univoxel {

constexpr int kLanes = 512;  // paths in a wave: its columns stay in the second-level cache
// Numbers in a column: at a power of two all columns would fall in one set of the first-level
// cache.
constexpr int kColumn = kLanes + 16;

struct Columns {
    float x[kColumn], y[kColumn], z[kColumn];

    float3 operator[](int i) const { return {x[i], y[i], z[i]}; }
    void set(int i, float3 v) { x[i] = v.x, y[i] = v.y, z[i] = v.z; }
    void fill(int first, int count, float3 v) {
        std::fill_n(x + first, count, v.x);
        std::fill_n(y + first, count, v.y);
        std::fill_n(z + first, count, v.z);
    }
};

using PathFrame = Frame<float3>;

/// A place where a path meets a surface.
struct Vertex {
    float3 origin;     // where its rays start
    float3 geometric;  // no light comes from below this plane; zero: no such plane
    float3 normal;
    float3 wo;  // to where the path came from
    float3 albedo, f0;
    float roughness;
};

/// Paths at their present vertex, one a lane.
struct Paths {
    int n = 0;
    Columns origin, geometric, normal, throughput;
    Columns wo, diffuse, f0;  // wo in the frame of the normal
    float alpha[kColumn], specular_share[kColumn];
    uint32_t seed[kColumn], index[kColumn];  // of the path's numbers
    int32_t path[kColumn];                   // its place in `Wave::light`

    PathBrdf brdf(int i) const { return {wo[i], diffuse[i], f0[i], alpha[i], specular_share[i]}; }

    /// Add a path; `settle` has to follow.
    void push(const Vertex& v, float3 carries, uint32_t own, uint32_t number, int32_t place) {
        DCHECK(n < kLanes && place >= 0 && place < kLanes);
        origin.set(n, v.origin), geometric.set(n, v.geometric), normal.set(n, v.normal);
        throughput.set(n, carries);
        wo.set(n, v.wo), diffuse.set(n, v.albedo), f0.set(n, v.f0), alpha[n] = v.roughness;
        seed[n] = own, index[n] = number, path[n] = place;
        ++n;
    }

    /// Make BRDFs of what was pushed.
    void settle() {
#pragma GCC ivdep
        for (int i = 0; i < n; ++i) {
            const float3 local = PathFrame(normal[i]).to_local(wo[i]);
            const PathBrdf brdf = PathBrdf::of(local, diffuse[i], alpha[i], f0[i]);
            wo.set(i, brdf.wo), diffuse.set(i, brdf.diffuse);
            alpha[i] = brdf.alpha, specular_share[i] = brdf.specular_share;
        }
    }

    /// Add `count` times a path of others, settled; numbers and places count up.
    void repeat(const Paths& from, int lane, uint32_t number, int32_t place, int count) {
        DCHECK(lane < from.n && n + count <= kLanes && place + count <= kLanes);
        const std::pair<Columns*, const Columns*> columns[] = {
            {&origin, &from.origin}, {&geometric, &from.geometric},
            {&normal, &from.normal}, {&throughput, &from.throughput},
            {&wo, &from.wo},         {&diffuse, &from.diffuse},
            {&f0, &from.f0}};
        for (const auto& [to, source] : columns) to->fill(n, count, (*source)[lane]);
        std::fill_n(alpha + n, count, from.alpha[lane]);
        std::fill_n(specular_share + n, count, from.specular_share[lane]);
        std::fill_n(seed + n, count, from.seed[lane]);
        std::iota(index + n, index + n + count, number);
        std::iota(path + n, path + n + count, place);
        n += count;
    }
};

/// Directions sampled, one a lane, and what arrives along each if nothing stands in its way.
struct LightSamples {
    Columns direction, light;
    float distance[kColumn];
};

/// Rays on their way to Embree, without gaps.
struct Rays {
    int n;
    int32_t lane[kColumn];  // of `Paths`
    Columns origin, direction, light;
    float distance[kColumn];
    uint8_t occluded[kColumn];

    void set(int k, int32_t from, float3 start, float3 towards, float farthest) {
        lane[k] = from, distance[k] = farthest;
        origin.set(k, start), direction.set(k, towards);
    }
    RayStream stream(float t_min) const {
        return {origin.x, origin.y, origin.z, direction.x, direction.y, direction.z, t_min, n};
    }
};

/// All that one thread needs.
struct Wave {
    Paths first, both[2];
    Paths *paths = &both[0], *next = &both[1];
    Columns light;  // by path: its radiance so far
    LightSamples sampled;
    Columns throughput;  // of the paths that go on along `sampled`
    float pdf[kColumn];  // of the samples; 0: the path ends
    Rays rays;
    Hit hit[kColumn];
    // Samples of the map
    float u[kColumn], v[kColumn];
    int32_t row[kColumn], column[kColumn];
    float x[kColumn], y[kColumn], z[kColumn];
};

}  // namespace univoxel
