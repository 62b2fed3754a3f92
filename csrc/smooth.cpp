#include "smooth.h"

#include <algorithm>
#include <memory>

#include "dcheck.h"
#include "parallel.h"

namespace univoxel {
namespace {

constexpr int64_t kRowsPerChunk = 2048;

/// A node by its coordinates; neighbours stop at the border.
struct GridNode {
    int64_t i[3];

    template <class Nodes>
    int64_t row(const Nodes& nodes) const {
        return nodes.row(i[0], i[1], i[2]);
    }
    GridNode step(int axis, int64_t by, const int64_t size[3]) const {
        GridNode n = *this;
        n.i[axis] = std::min(std::max<int64_t>(i[axis] + by, 0), size[axis] - 1);
        return n;
    }
};

/// out[c] += scale (L f)[c] at a node.
template <class T, class Nodes>
void add_laplacian(const T* grid, const int64_t size[3], const Nodes& nodes, int64_t C,
                   const GridNode& node, T scale, T* out) {
    const T* centre = grid + node.row(nodes) * C;
    for (int64_t c = 0; c < C; ++c) out[c] -= scale * centre[c];
    for (int axis = 0; axis < 3; ++axis)
        for (int64_t by : {-1, 1}) {
            const T* near = grid + node.step(axis, by, size).row(nodes) * C;
            for (int64_t c = 0; c < C; ++c) out[c] += scale / 6 * near[c];
        }
}

/// The change of a node far enough from the border, as one weighted sum: amount L f or
/// -amount L L f. Offsets and the width of a tile count numbers, not nodes.
template <class T>
struct Weights {
    static constexpr int64_t kTile = 16;
    int64_t offset[25], reach = 0;
    T weight[25];
    int count = 0;

    Weights(const int64_t size[3], int64_t C, T amount, int order) {
        const int64_t stride[3] = {size[1] * size[2] * C, size[2] * C, C};
        const auto put = [&](int64_t o, double w) {
            reach = std::max(reach, o);
            offset[count] = o;
            weight[count++] = amount * T(w);
        };
        put(0, order == 1 ? -1 : -7.0 / 6);
        for (int a = 0; a < 3; ++a)
            for (int64_t s : {-1, 1}) {
                put(s * stride[a], order == 1 ? 1.0 / 6 : 1.0 / 3);
                if (order == 1) continue;
                put(2 * s * stride[a], -1.0 / 36);
                for (int b = a + 1; b < 3; ++b)
                    for (int64_t t : {-1, 1}) put(s * stride[a] + t * stride[b], -1.0 / 18);
            }
    }

    /// Sums for n numbers from p; a tile may read, and drop, the numbers behind them.
    void apply(const T* p, int64_t n, const T* grid_end, T* out) const {
        for (int64_t i = 0; i < n; i += kTile, p += kTile, out += kTile) {
            const int64_t used = std::min(kTile, n - i);
            T sum[kTile] = {};
            if (grid_end - p >= reach + kTile) {
                for (int j = 0; j < count; ++j) {
                    const T* q = p + offset[j];
#pragma omp simd
                    for (int64_t k = 0; k < kTile; ++k) sum[k] += weight[j] * q[k];
                }
            } else {
                for (int j = 0; j < count; ++j)
                    for (int64_t k = 0; k < used; ++k) sum[k] += weight[j] * p[offset[j] + k];
            }
            std::copy(sum, sum + used, out);
        }
    }
};

bool away_from_border(int64_t i, int64_t size, int64_t margin) {
    return i >= margin && i < size - margin;
}

/// The change of a node near the border, where neighbours repeat.
template <class T, class Nodes>
void border_change(const T* grid, const int64_t size[3], const Nodes& nodes, int64_t C,
                   const GridNode& node, T amount, int order, T* out) {
    std::fill(out, out + C, T(0));
    add_laplacian(grid, size, nodes, C, node, amount, out);
    if (order == 1) return;
    // -amount L (Lf) = amount (Lf - mean of Lf)
    for (int axis = 0; axis < 3; ++axis)
        for (int64_t by : {-1, 1})
            add_laplacian(grid, size, nodes, C, node.step(axis, by, size), -amount / 6, out);
}

/// Copy the nodes of a brick and `margin` around it, all inside the grid, z fastest.
template <class T>
void gather_brick(const T* grid, const BrickNodes& nodes, int64_t C, const GridNode& first,
                  int64_t margin, T* out) {
    const int64_t width = kBrick + 2 * margin;
    for (int64_t x = 0; x < width; ++x)
        for (int64_t y = 0; y < width; ++y) {
            const int64_t at[2] = {first.i[0] - margin + x, first.i[1] - margin + y};
            const auto copy = [&](int64_t z, int64_t count) {
                const T* from = grid + nodes.row(at[0], at[1], z) * C;
                out = std::copy(from, from + count * C, out);
            };
            copy(first.i[2] - margin, margin);
            copy(first.i[2], kBrick);
            copy(first.i[2] + kBrick, margin);
        }
}

/// grid += change at the rows.
template <class T>
void apply_change(T* grid, int64_t C, const int64_t* rows, int64_t n, const T* change,
                  int threads) {
    parallel_for(n, kRowsPerChunk, threads, [&](int64_t begin, int64_t end) {
        for (int64_t k = begin; k < end; ++k)
            for (int64_t c = 0; c < C; ++c) grid[rows[k] * C + c] += change[k * C + c];
    });
}

}  // namespace

template <class T>
void smooth_rows(T* grid, const int64_t size[3], int64_t C, const int64_t* rows, int64_t n,
                 T amount, int order, int threads) {
    // Compute every change before any is applied: the order of rows does not matter.
    const std::unique_ptr<T[]> change(new T[n * C]);
    const Weights<T> weights(size, C, amount, order);
    const DenseNodes nodes{size[1], size[2]};
    const T* grid_end = grid + size[0] * size[1] * size[2] * C;
    parallel_for(n, kRowsPerChunk, threads, [&](int64_t begin, int64_t end) {
        for (int64_t k = begin; k < end;) {
            const int64_t line = rows[k] / size[2], z = rows[k] - line * size[2];
            const int64_t x = line / size[1], y = line - x * size[1];
            T* out = change.get() + k * C;
            if (!away_from_border(x, size[0], order) || !away_from_border(y, size[1], order) ||
                !away_from_border(z, size[2], order)) {
                border_change(grid, size, nodes, C, {{x, y, z}}, amount, order, out);
                ++k;
                continue;
            }
            // Neighbours along z that follow each other are one run of numbers.
            const int64_t longest = std::min(end - k, size[2] - order - z);
            int64_t run = 1;
            while (run < longest && rows[k + run] == rows[k] + run) ++run;
            DCHECK(rows[k] * C >= weights.reach);
            DCHECK((rows[k] + run) * C + weights.reach <= grid_end - grid);
            weights.apply(grid + rows[k] * C, run * C, grid_end, out);
            k += run;
        }
    });
    apply_change(grid, C, rows, n, change.get(), threads);
}

template <class T>
void smooth_brick_rows(T* grid, const int64_t size[3], const BrickNodes& nodes,
                       const int32_t* place, int64_t C, const int64_t* rows, int64_t n, T amount,
                       int order, int threads) {
    const std::unique_ptr<T[]> change(new T[n * C]);
    const int64_t width = kBrick + 2 * order, numbers = width * width * width * C;
    const int64_t padded[3] = {width, width, width};
    const Weights<T> weights(padded, C, amount, order);
    parallel_for(n, kRowsPerChunk, threads, [&](int64_t begin, int64_t end) {
        const std::unique_ptr<T[]> around(new T[numbers]);
        int64_t gathered = -1;
        for (int64_t k = begin; k < end;) {
            const int64_t brick = rows[k] / kBrickNodes;
            const Node corner = nodes.first_node(place[brick]);
            const GridNode first{{corner.x, corner.y, corner.z}};
            bool whole = true;  // the brick and what the stencil needs of its neighbours
            for (int a = 0; a < 3; ++a) {
                whole = whole && first.i[a] >= order && first.i[a] + kBrick + order <= size[a];
            }
            const auto [x, y, z] = BrickNodes::offset(rows[k] % kBrickNodes);
            T* out = change.get() + k * C;
            if (!whole) {
                const GridNode node{{first.i[0] + x, first.i[1] + y, first.i[2] + z}};
                border_change(grid, size, nodes, C, node, amount, order, out);
                ++k;
                continue;
            }
            if (gathered != brick) gather_brick(grid, nodes, C, first, order, around.get());
            gathered = brick;
            int64_t run = 1;
            while (k + run < end && run < kBrick - z && rows[k + run] == rows[k] + run) ++run;
            const int64_t at = ((x + order) * width + y + order) * width + z + order;
            DCHECK(at * C >= weights.reach && (at + run) * C + weights.reach <= numbers);
            weights.apply(around.get() + at * C, run * C, around.get() + numbers, out);
            k += run;
        }
    });
    apply_change(grid, C, rows, n, change.get(), threads);
}

template void smooth_rows(float*, const int64_t[3], int64_t, const int64_t*, int64_t, float, int,
                          int);
template void smooth_rows(double*, const int64_t[3], int64_t, const int64_t*, int64_t, double, int,
                          int);
template void smooth_brick_rows(float*, const int64_t[3], const BrickNodes&, const int32_t*,
                                int64_t, const int64_t*, int64_t, float, int, int);
template void smooth_brick_rows(double*, const int64_t[3], const BrickNodes&, const int32_t*,
                                int64_t, const int64_t*, int64_t, double, int, int);

}  // namespace univoxel
