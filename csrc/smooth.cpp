#include "smooth.h"

#include <algorithm>
#include <vector>

#include "parallel.h"

namespace univoxel {
namespace {

constexpr int64_t kRowsPerChunk = 2048;

/// A node by its coordinates; neighbours stop at the border.
struct Node {
    int64_t i[3];

    int64_t flat(const int64_t size[3]) const { return (i[0] * size[1] + i[1]) * size[2] + i[2]; }
    Node step(int axis, int64_t by, const int64_t size[3]) const {
        Node n = *this;
        n.i[axis] = std::min(std::max<int64_t>(i[axis] + by, 0), size[axis] - 1);
        return n;
    }
};

/// out[c] += scale (L f)[c] at a node.
template <class T>
void add_laplacian(const T* grid, const int64_t size[3], int64_t C, const Node& node, T scale,
                   T* out) {
    const T* centre = grid + node.flat(size) * C;
    for (int64_t c = 0; c < C; ++c) out[c] -= scale * centre[c];
    for (int axis = 0; axis < 3; ++axis)
        for (int64_t by : {-1, 1}) {
            const T* near = grid + node.step(axis, by, size).flat(size) * C;
            for (int64_t c = 0; c < C; ++c) out[c] += scale / 6 * near[c];
        }
}

/// L L f as one stencil of 25 nodes, for nodes at least two away from the border.
struct Plate {
    int64_t offset[25];
    double weight[25];

    explicit Plate(const int64_t size[3]) {
        const int64_t stride[3] = {size[1] * size[2], size[2], 1};
        int n = 0;
        const auto put = [&](int64_t o, double w) {
            offset[n] = o;
            weight[n++] = w;
        };
        put(0, 7.0 / 6);
        for (int a = 0; a < 3; ++a)
            for (int64_t s : {-1, 1}) {
                put(s * stride[a], -1.0 / 3);
                put(2 * s * stride[a], 1.0 / 36);
                for (int b = a + 1; b < 3; ++b)
                    for (int64_t t : {-1, 1}) put(s * stride[a] + t * stride[b], 1.0 / 18);
            }
    }
};

bool inner(const Node& node, const int64_t size[3]) {
    for (int a = 0; a < 3; ++a)
        if (node.i[a] < 2 || node.i[a] >= size[a] - 2) return false;
    return true;
}

}  // namespace

template <class T>
void smooth_rows(T* grid, const int64_t size[3], int64_t C, const int64_t* rows, int64_t n,
                 T amount, int order, int threads) {
    // Compute every change before any is applied: the order of rows does not matter.
    std::vector<T> change(n * C, T(0));
    const Plate plate(size);
    parallel_for(n, kRowsPerChunk, threads, [&](int64_t begin, int64_t end) {
        for (int64_t k = begin; k < end; ++k) {
            const Node node{
                {rows[k] / (size[1] * size[2]), rows[k] / size[2] % size[1], rows[k] % size[2]}};
            T* out = change.data() + k * C;
            if (order == 1) {
                add_laplacian(grid, size, C, node, amount, out);
                continue;
            }
            if (inner(node, size)) {
                for (int j = 0; j < 25; ++j) {
                    const T* near = grid + (rows[k] + plate.offset[j]) * C;
                    const T w = -amount * T(plate.weight[j]);
                    for (int64_t c = 0; c < C; ++c) out[c] += w * near[c];
                }
                continue;
            }
            add_laplacian(grid, size, C, node, amount, out);  // -amount L (Lf) = amount (Lf - mean)
            for (int axis = 0; axis < 3; ++axis)
                for (int64_t by : {-1, 1})
                    add_laplacian(grid, size, C, node.step(axis, by, size), -amount / 6, out);
        }
    });
    parallel_for(n, kRowsPerChunk, threads, [&](int64_t begin, int64_t end) {
        for (int64_t k = begin; k < end; ++k)
            for (int64_t c = 0; c < C; ++c) grid[rows[k] * C + c] += change[k * C + c];
    });
}

template void smooth_rows(float*, const int64_t[3], int64_t, const int64_t*, int64_t, float, int,
                          int);
template void smooth_rows(double*, const int64_t[3], int64_t, const int64_t*, int64_t, double, int,
                          int);

}  // namespace univoxel
