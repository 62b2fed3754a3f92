#include "march.h"

#include <algorithm>
#include <cmath>
#include <limits>

#include "dcheck.h"
#include "density.h"
#include "parallel.h"

namespace univoxel {
namespace {

constexpr int64_t kRaysPerChunk = 128;
constexpr int64_t kBricksPerChunk = 1024;
// A brick whose sdf stays above this many s lets light through: sigmoid(8) = 0.99966.
constexpr int kClearBand = 8;
constexpr int kLongest = 1000;  // diagonals of the grid that a ray may take to cross it

/// Sdf at the corners (x, y, z) .. (x, y, z) + step of a cell, z fastest.
template <class T>
void corners(const March<T>& in, const DenseNodes& nodes, const int64_t i[3], const int64_t step[3],
             T* f) {
    const T* p = in.sdf + nodes.row(i[0], i[1], i[2]);
    const int64_t x = step[0] * in.size[1] * in.size[2], y = step[1] * in.size[2];
    for (int k = 0; k < 8; ++k) f[k] = p[(k >> 2) * x + (k >> 1 & 1) * y + (k & 1) * step[2]];
}

template <class T>
void corners(const March<T>& in, const BrickNodes& nodes, const int64_t i[3], const int64_t step[3],
             T* f) {
    const auto next_inside = [&](int axis) { return (i[axis] & kBrickMask) < kBrickMask; };
    if (next_inside(0) && next_inside(1) && next_inside(2)) {  // all in one brick
        const T* p = in.sdf + nodes.row(i[0], i[1], i[2]);
        const int64_t x = step[0] << 2 * kBrickShift, y = step[1] << kBrickShift;
        for (int k = 0; k < 8; ++k) f[k] = p[(k >> 2) * x + (k >> 1 & 1) * y + (k & 1) * step[2]];
        return;
    }
    for (int k = 0; k < 8; ++k) {
        f[k] = in.sdf[nodes.row(i[0] + (k >> 2) * step[0], i[1] + (k >> 1 & 1) * step[1],
                                i[2] + (k & 1) * step[2])];
    }
}

/// Trilinear sdf at grid coordinates inside [0, size - 1].
template <class T, class Nodes>
T sdf_at(const March<T>& in, const Nodes& nodes, vec3<T> g) {
    int64_t i[3], step[3];
    T w[3], f[8];
    for (int a = 0; a < 3; ++a) {
        const T x = std::min(std::max(g[a], T(0)), T(in.size[a] - 1));
        i[a] = std::min(static_cast<int64_t>(x), std::max<int64_t>(in.size[a] - 2, 0));
        w[a] = x - T(i[a]);
        step[a] = in.size[a] > 1;
    }
    corners(in, nodes, i, step, f);
    for (int a = 0; a < 3; ++a) DCHECK(i[a] >= 0 && i[a] + step[a] < in.size[a]);
    const auto lerp = [](T a, T b, T t) { return a + t * (b - a); };
    const auto along_z = [&](int k) { return lerp(f[k], f[k + 1], w[2]); };
    const auto along_y = [&](int k) { return lerp(along_z(k), along_z(k + 2), w[1]); };
    return lerp(along_y(0), along_y(4), w[0]);
}

/// Least sdf in a brick.
template <class T>
T least(const March<T>& in, const DenseNodes&, const int64_t b[3]) {
    const int64_t by = bricks_along(in.size[1]), bz = bricks_along(in.size[2]);
    return in.brick_min[(b[0] * by + b[1]) * bz + b[2]];
}

template <class T>
T least(const March<T>& in, const BrickNodes& nodes, const int64_t b[3]) {
    return in.brick_min[nodes.brick(b[0], b[1], b[2])];
}

/// Part of a ray inside the box [0, upper]; false when it misses or is no ray.
template <class T>
bool clip(vec3<T> o, vec3<T> d, vec3<T> upper, T& near, T& far) {
    if (!std::isfinite(glm::dot(o, o) + glm::dot(d, d))) return false;
    near = 0;
    far = std::numeric_limits<T>::infinity();
    for (int a = 0; a < 3; ++a) {
        if (d[a] == 0) {
            if (!(o[a] >= 0 && o[a] <= upper[a])) return false;
            continue;
        }
        const T t0 = -o[a] / d[a], t1 = (upper[a] - o[a]) / d[a];
        near = std::max(near, std::min(t0, t1));
        far = std::min(far, std::max(t0, t1));
    }
    return near < far && std::isfinite(far);
}

/// Walk one ray; append its samples.
template <class T, class Nodes>
void march_ray(const March<T>& in, const Nodes& nodes, int64_t ray, PackedSamples<T>& out) {
    // Change to grid coordinates; t stays in world units.
    const vec3<T> o = (load3(in.origin, ray) - in.grid_origin) / in.voxel_size;
    const vec3<T> d = load3(in.direction, ray) / in.voxel_size;
    const vec3<T> upper(in.size[0] - 1, in.size[1] - 1, in.size[2] - 1);
    T near, far;
    if (!clip(o, d, upper, near, far)) return;
    // A direction that is far from unit would take steps without end.
    if (far - near > T(kLongest) * glm::length(upper) * in.voxel_size) return;
    const T start = near + in.jitter[ray] * in.step;
    if (!std::isfinite(start)) return;
    const T band = kClearBand / in.inv_s;
    const int64_t last = static_cast<int64_t>((far - start) / in.step);

    const T clear = -std::log(std::numeric_limits<T>::epsilon());
    T trans = 1, f_before = 0;
    int64_t k = 0, before = -2, emitted = -2;
    while (k <= last && trans >= in.early_stop) {
        const vec3<T> g = o + (start + T(k) * in.step) * d;
        // Skip an empty brick: go to the first sample behind it.
        vec3<T> corner;
        int64_t b[3];
        for (int a = 0; a < 3; ++a) {
            const int64_t n = bricks_along(in.size[a]);
            b[a] = std::min(std::max<int64_t>(static_cast<int64_t>(g[a]) / kBrick, 0), n - 1);
            corner[a] = T(kBrick * (b[a] + (d[a] > 0 ? 1 : 0)));
        }
        DCHECK(k > before);  // a ray goes on
        if (least(in, nodes, b) > band) {
            T exit = far;
            for (int a = 0; a < 3; ++a)
                if (d[a] != 0) exit = std::min(exit, (corner[a] - o[a]) / d[a]);
            k = std::max(k + 1, static_cast<int64_t>(std::ceil((exit - start) / in.step)));
            continue;
        }
        // The section that ends here starts at the sample before, even if that was skipped.
        if (before != k - 1) {
            const T t = start + T(std::max<int64_t>(k - 1, 0)) * in.step;
            f_before = sdf_at(in, nodes, o + t * d) * in.inv_s;
        }
        const T f_here = sdf_at(in, nodes, g) * in.inv_s;
        // Where this ends so far outside, opacity is less than a rounding error.
        const T alpha = k > 0 && f_here < clear ? section_alpha(f_before, f_here) : T(0);
        if (alpha * trans > in.min_weight) {
            if (emitted != k - 1) {
                out.t.push_back(start + T(k - 1) * in.step);
                out.connected.push_back(0);
            }
            out.connected.back() = 1;
            out.t.push_back(start + T(k) * in.step);
            out.connected.push_back(0);
            emitted = k;
            DCHECK(out.t.size() == out.connected.size());
        }
        trans *= 1 - alpha;
        f_before = f_here;
        before = k++;
    }
}

}  // namespace

template <class T>
void brick_minimum(const T* sdf, const int64_t size[3], T* out, int threads) {
    const int64_t X = size[0], Y = size[1], Z = size[2];
    const int64_t by = bricks_along(Y), bz = bricks_along(Z);
    parallel_for(bricks_along(X), 1, threads, [&](int64_t begin, int64_t end) {
        for (int64_t bx = begin; bx < end; ++bx) {
            T* plane = out + bx * by * bz;
            std::fill(plane, plane + by * bz, std::numeric_limits<T>::infinity());
            // A brick owns the nodes on all its faces: neighbours share them.
            for (int64_t x = bx * kBrick; x <= std::min(X - 1, (bx + 1) * kBrick); ++x)
                for (int64_t b = 0; b < by; ++b)
                    for (int64_t y = b * kBrick; y <= std::min(Y - 1, (b + 1) * kBrick); ++y) {
                        const T* row = sdf + (x * Y + y) * Z;
                        for (int64_t c = 0; c < bz; ++c) {
                            T least = plane[b * bz + c];
                            const int64_t stop = std::min(Z - 1, (c + 1) * kBrick);
                            for (int64_t z = c * kBrick; z <= stop; ++z)
                                least = std::min(least, row[z]);
                            plane[b * bz + c] = least;
                        }
                    }
        }
    });
}

template <class T>
void sparse_brick_minimum(const T* sdf, const int64_t size[3], const BrickNodes& nodes,
                          const int32_t* place, int64_t n, T* out, int threads) {
    out[0] = std::numeric_limits<T>::infinity();
    out[1] = -out[0];
    parallel_for(n, kBricksPerChunk, threads, [&](int64_t begin, int64_t end) {
        for (int64_t brick = std::max(begin, kMissingBricks); brick < end; ++brick) {
            if (place[brick] < 0) {
                out[brick] = out[0];
                continue;
            }
            const Node node = nodes.first_node(place[brick]);
            const int64_t first[3] = {node.x, node.y, node.z};
            int64_t last[3];
            for (int a = 0; a < 3; ++a) last[a] = std::min(first[a] + kBrick, size[a] - 1);
            T lowest = std::numeric_limits<T>::infinity();
            for (int64_t x = first[0]; x <= last[0]; ++x)
                for (int64_t y = first[1]; y <= last[1]; ++y) {
                    const T* line = sdf + nodes.row(x, y, first[2]);
                    const int64_t inside = std::min(last[2] - first[2], kBrick - 1);
                    for (int64_t z = 0; z <= inside; ++z) lowest = std::min(lowest, line[z]);
                    if (last[2] - first[2] == kBrick)
                        lowest = std::min(lowest, sdf[nodes.row(x, y, last[2])]);
                }
            out[brick] = lowest;
        }
    });
}

template <class T>
PackedSamples<T> march(const March<T>& in, int threads) {
    const int64_t chunks = (in.n_rays + kRaysPerChunk - 1) / kRaysPerChunk;
    std::vector<PackedSamples<T>> parts(chunks);
    parallel_for(in.n_rays, kRaysPerChunk, threads, [&](int64_t begin, int64_t end) {
        PackedSamples<T>& part = parts[begin / kRaysPerChunk];
        for (int64_t ray = begin; ray < end; ++ray) {
            if (in.table) {
                march_ray(in, in.sparse(), ray, part);
            } else {
                march_ray(in, in.dense(), ray, part);
            }
            part.offsets.push_back(static_cast<int64_t>(part.t.size()));
        }
    });
    PackedSamples<T> all;
    all.offsets.push_back(0);
    for (const PackedSamples<T>& part : parts) {
        const int64_t base = all.offsets.back();
        all.t.insert(all.t.end(), part.t.begin(), part.t.end());
        all.connected.insert(all.connected.end(), part.connected.begin(), part.connected.end());
        for (int64_t end : part.offsets) all.offsets.push_back(base + end);
    }
    return all;
}

template void brick_minimum(const float*, const int64_t[3], float*, int);
template void brick_minimum(const double*, const int64_t[3], double*, int);
template void sparse_brick_minimum(const float*, const int64_t[3], const BrickNodes&,
                                   const int32_t*, int64_t, float*, int);
template void sparse_brick_minimum(const double*, const int64_t[3], const BrickNodes&,
                                   const int32_t*, int64_t, double*, int);
template PackedSamples<float> march(const March<float>&, int);
template PackedSamples<double> march(const March<double>&, int);

}  // namespace univoxel
