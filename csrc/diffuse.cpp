#include "diffuse.h"

#include <algorithm>
#include <memory>
#include <vector>

#include "dcheck.h"
#include "row_set.h"
#include "tiles.h"

namespace univoxel {
namespace {

constexpr int64_t kRowsPerChunk = 4096;

/// Nodes of ascending rows of a dense grid: divides once a line.
struct DenseCursor {
    int64_t size_y, size_z;
    int64_t begin = 0, end = 0;  // rows of the line that the last row lay in
    int64_t x = 0, y = 0;        // where that line is

    Node operator()(int64_t row) {
        if (row < begin || row >= end) {
            const int64_t line = row / size_z;
            begin = line * size_z, end = begin + size_z;
            x = line / size_y, y = line - x * size_y;
        }
        return {x, y, row - begin};
    }
};

/// Nodes of ascending rows of bricks: divides once a brick.
struct BrickCursor {
    const BrickNodes& nodes;
    const int32_t* place;
    int64_t brick = -1;  // that the last row lay in
    Node first{0, 0, 0};

    Node operator()(int64_t row) {
        if (row / kBrickNodes != brick) {
            brick = row / kBrickNodes;
            first = nodes.first_node(place[brick]);
        }
        const Node offset = BrickNodes::offset(row % kBrickNodes);
        return {first.x + offset.x, first.y + offset.y, first.z + offset.z};
    }
};

/// cursor(row) -> Node, which nodes.row undoes.
template <class T, class Nodes, class Cursor>
void diffuse(T* values, const int64_t size[3], const Nodes& nodes, int64_t n_rows,
             const int64_t* rows, int64_t n, T amount, int passes, int threads,
             const Cursor& cursor) {
    threads = team_for(n, threads);
    RowSet chosen(n_rows);
    for (int64_t k = 0; k < n; ++k) chosen.mark(rows[k]);
    chosen.number();
    DCHECK(chosen.count() == n && std::is_sorted(rows, rows + n));  // slot k is that of row k
    // Neighbours by slot, looked up once for all passes; slot n holds the 0 of all other nodes, and
    // beyond the border a node is its own. A pair of neighbours is found from its lower node.
    const std::unique_ptr<int32_t[]> near(new int32_t[6 * n]);
    parallel_for(6 * n, 6 * kRowsPerChunk, threads, [&](int64_t begin, int64_t end) {
        std::fill(near.get() + begin, near.get() + end, static_cast<int32_t>(n));
    });
    parallel_for(n, kRowsPerChunk, threads, [&](int64_t begin, int64_t end) {
        Cursor node_of = cursor;
        for (int64_t k = begin; k < end; ++k) {
            const Node at = node_of(rows[k]);
            const auto put = [&](int axis, int64_t place, int64_t x, int64_t y, int64_t z) {
                int32_t *lower = near.get() + 2 * axis * n, *upper = lower + n;
                if (place == 0) lower[k] = static_cast<int32_t>(k);
                if (place + 1 == size[axis]) {
                    upper[k] = static_cast<int32_t>(k);
                } else if (const int64_t other = chosen.slot_or(nodes.row(x, y, z), n); other < n) {
                    upper[k] = static_cast<int32_t>(other);
                    lower[other] = static_cast<int32_t>(k);
                }
            };
            put(0, at.x, at.x + 1, at.y, at.z);
            put(1, at.y, at.x, at.y + 1, at.z);
            put(2, at.z, at.x, at.y, at.z + 1);
        }
    });
    std::vector<T> from(n + 1), to(n + 1);
    std::copy(values, values + n, from.begin());
    const int32_t *a = near.get(), *b = a + n, *c = b + n, *d = c + n, *e = d + n, *f = e + n;
    for (int pass = 0; pass < passes; ++pass) {
        const T* v = from.data();
        T* out = pass + 1 < passes ? to.data() : values;
        parallel_for(n, kRowsPerChunk, threads, [&](int64_t begin, int64_t end) {
#pragma omp simd
            for (int64_t k = begin; k < end; ++k) {
                const T sum = (v[a[k]] + v[b[k]]) + (v[c[k]] + v[d[k]]) + (v[e[k]] + v[f[k]]);
                out[k] = v[k] + amount * (sum / 6 - v[k]);
            }
        });
        std::swap(from, to);
    }
}

}  // namespace

template <class T>
void diffuse_rows(T* values, const int64_t size[3], const int64_t* rows, int64_t n, T amount,
                  int passes, int threads) {
    const DenseNodes nodes{size[1], size[2]};
    const int64_t n_rows = size[0] * size[1] * size[2];
    diffuse(values, size, nodes, n_rows, rows, n, amount, passes, threads,
            DenseCursor{size[1], size[2]});
}

template <class T>
void diffuse_brick_rows(T* values, const int64_t size[3], const BrickNodes& nodes,
                        const int32_t* place, int64_t n_rows, const int64_t* rows, int64_t n,
                        T amount, int passes, int threads) {
    diffuse(values, size, nodes, n_rows, rows, n, amount, passes, threads,
            BrickCursor{nodes, place});
}

template void diffuse_rows(float*, const int64_t[3], const int64_t*, int64_t, float, int, int);
template void diffuse_rows(double*, const int64_t[3], const int64_t*, int64_t, double, int, int);
template void diffuse_brick_rows(float*, const int64_t[3], const BrickNodes&, const int32_t*,
                                 int64_t, const int64_t*, int64_t, float, int, int);
template void diffuse_brick_rows(double*, const int64_t[3], const BrickNodes&, const int32_t*,
                                 int64_t, const int64_t*, int64_t, double, int, int);

}  // namespace univoxel
