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

}  // namespace

template <class T>
void smooth_rows(T* grid, const int64_t size[3], int64_t C, const int64_t* rows, int64_t n,
                 T amount, int order, int threads) {
    // Compute every change before any is applied: the order of rows does not matter.
    std::vector<T> change(n * C, T(0));
    parallel_for(n, kRowsPerChunk, threads, [&](int64_t begin, int64_t end) {
        for (int64_t k = begin; k < end; ++k) {
            const Node node{
                {rows[k] / (size[1] * size[2]), rows[k] / size[2] % size[1], rows[k] % size[2]}};
            T* out = change.data() + k * C;
            if (order == 1) {
                add_laplacian(grid, size, C, node, amount, out);
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
