#include "tiles.h"

#include <algorithm>
#include <numeric>
#include <utility>

#include "dcheck.h"
#include "huge_pages.h"

namespace univoxel {
namespace {

constexpr int64_t kPointsPerChunk = 8192;

int64_t tiles_along(const Lattice& grid, int axis) {
    return (std::max<int64_t>(grid.size[axis] - 2, 0) >> kTileShift) + 1;
}

template <class T>
int64_t slab_of(const Lattice& grid, const T* points, int64_t i) {
    return place(grid, 0, static_cast<double>(points[3 * i])).cell >> kTileShift;
}

}  // namespace

template <class T>
void sort_by_tile(const Lattice& grid, const T* points, int64_t n_points, int32_t* order,
                  int threads) {
    threads = team_for(n_points, threads);
    const int64_t slabs = tiles_along(grid, 0);
    const int64_t ny = tiles_along(grid, 1), nz = tiles_along(grid, 2);
    const int64_t chunks = (n_points + kPointsPerChunk - 1) / kPointsPerChunk;
    struct Keyed {
        int32_t point, column;  // column: tile within the slab
    };
    std::vector<int32_t> slab(n_points), column(n_points);
    std::vector<Keyed> keyed(n_points);
    std::vector<int64_t> place_of(chunks * slabs, 0);

    // Count the points of each chunk by slab.
    parallel_for(n_points, kPointsPerChunk, threads, [&](int64_t begin, int64_t end) {
        int64_t* count = place_of.data() + begin / kPointsPerChunk * slabs;
        for (int64_t i = begin; i < end; ++i) {
            const T* p = points + 3 * i;
            slab[i] = static_cast<int32_t>(slab_of(grid, points, i));
            const int64_t y = place(grid, 1, static_cast<double>(p[1])).cell >> kTileShift;
            const int64_t z = place(grid, 2, static_cast<double>(p[2])).cell >> kTileShift;
            column[i] = static_cast<int32_t>(y * nz + z);
            ++count[slab[i]];
        }
    });
    // Turn counts into places: slab by slab, within it chunk by chunk.
    std::vector<int64_t> bounds(slabs + 1, 0);
    int64_t sum = 0;
    for (int64_t s = 0; s < slabs; ++s) {
        for (int64_t c = 0; c < chunks; ++c) {
            sum += std::exchange(place_of[c * slabs + s], sum);
        }
        bounds[s + 1] = sum;
    }
    parallel_for(n_points, kPointsPerChunk, threads, [&](int64_t begin, int64_t end) {
        int64_t* next = place_of.data() + begin / kPointsPerChunk * slabs;
        for (int64_t i = begin; i < end; ++i) {
            keyed[next[slab[i]]++] = {static_cast<int32_t>(i), column[i]};
        }
    });
    // Sort each slab by tile.
    parallel_for(slabs, 1, threads, [&](int64_t first, int64_t) {
        const int64_t begin = bounds[first], end = bounds[first + 1];
        if (begin == end) return;
        std::vector<int32_t> next(ny * nz + 1, 0);
        for (int64_t i = begin; i < end; ++i) ++next[keyed[i].column + 1];
        std::partial_sum(next.begin(), next.end(), next.begin());
        for (int64_t i = begin; i < end; ++i) {
            order[begin + next[keyed[i].column]++] = keyed[i].point;
        }
    });
}

template <class T>
std::vector<int64_t> slab_bounds(const Lattice& grid, const T* points, int64_t n_points,
                                 const int32_t* order) {
    std::vector<int64_t> bounds(tiles_along(grid, 0) + 1, n_points);
    for (size_t s = 0; s + 1 < bounds.size(); ++s) {
        const int32_t* at = std::partition_point(order, order + n_points, [&](int32_t i) {
            return slab_of(grid, points, i) < static_cast<int64_t>(s);
        });
        bounds[s] = at - order;
    }
    DCHECK(std::is_sorted(bounds.begin(), bounds.end()));
    return bounds;
}

Planes planes_to_clear(const Lattice& grid, int64_t slab, int64_t n_slabs) {
    const int64_t x = slab * kTile, size = grid.size[0];
    if (slab % 2 == 0) return {std::max<int64_t>(x - 1, 0), std::min(x + kTile + 2, size)};
    return {std::min(x + 2, size), slab + 1 == n_slabs ? size : x + kTile - 1};
}

template <class T>
std::vector<std::vector<CellColumn>> occupied_columns(const Lattice& grid, const T* points,
                                                      const int32_t* order,
                                                      const std::vector<int64_t>& bounds,
                                                      int threads) {
    const int64_t slabs = static_cast<int64_t>(bounds.size()) - 1;
    std::vector<std::vector<CellColumn>> columns(slabs);
    threads = team_for(bounds.back(), threads);
    parallel_for(slabs, 1, threads, [&](int64_t s, int64_t) {
        uint8_t cells[kTile][kTile] = {};  // of one tile: a bit per cell along z
        int64_t corner[3] = {-1, -1, -1};  // its first cell
        const auto flush = [&] {
            for (int64_t a = 0; a < kTile; ++a) {
                for (int64_t b = 0; b < kTile; ++b) {
                    const uint8_t mask = std::exchange(cells[a][b], uint8_t(0));
                    if (!mask) continue;
                    columns[s].push_back({static_cast<int32_t>(corner[0] + a),
                                          static_cast<int32_t>(corner[1] + b),
                                          static_cast<int32_t>(corner[2]), mask});
                }
            }
        };
        for (int64_t i = bounds[s]; i < bounds[s + 1]; ++i) {
            const T* p = points + 3 * static_cast<int64_t>(order[i]);
            if (has_nan(p)) continue;
            int64_t cell[3];
            for (int d = 0; d < 3; ++d) cell[d] = place(grid, d, static_cast<double>(p[d])).cell;
            const bool same = (cell[0] & ~(kTile - 1)) == corner[0] &&
                              (cell[1] & ~(kTile - 1)) == corner[1] &&
                              (cell[2] & ~(kTile - 1)) == corner[2];
            if (!same) {
                flush();
                for (int d = 0; d < 3; ++d) corner[d] = cell[d] & ~(kTile - 1);
            }
            DCHECK(cell[0] >> kTileShift == s);  // the points are sorted by slab
            cells[cell[0] - corner[0]][cell[1] - corner[1]] |=
                static_cast<uint8_t>(1 << (cell[2] - corner[2]));
        }
        flush();
    });
    return columns;
}

TouchedRows::TouchedRows(const Lattice& grid, const std::vector<std::vector<CellColumn>>& columns,
                         bool wide, int threads)
    : size_x_(grid.size[0]),
      size_y_(grid.size[1]),
      size_z_(grid.size[2]),
      words_per_line_((grid.size[2] + 63) / 64),
      line_(grid.size[0] * grid.size[1], -1),
      plane_(grid.size[0] + 1, 0) {
    const int64_t slabs = static_cast<int64_t>(columns.size());
    int64_t n_columns = 0;
    for (const auto& of_slab : columns) n_columns += static_cast<int64_t>(of_slab.size());
    threads = team_for(n_columns, threads);
    // Number the lines that are touched.
    for_slabs(slabs, threads, [&](int64_t s) {
        for (const CellColumn& column : columns[s]) {
            for_lines(grid, column, wide,
                      [&](int64_t x, int64_t y, bool) { line_[x * size_y_ + y] = 0; });
        }
    });
    int64_t lines = 0;
    for (int32_t& line : line_) {
        if (line == 0) line = static_cast<int32_t>(words_per_line_ * lines++);
    }
    // Set the bits of the nodes.
    words_.assign(lines * words_per_line_, Word{0, 0});
    for_slabs(slabs, threads, [&](int64_t s) {
        for (const CellColumn& column : columns[s]) {
            const NodesAlongZ along = nodes_along_z(grid, column, wide);
            for_lines(grid, column, wide, [&](int64_t x, int64_t y, bool inner) {
                const uint64_t nodes = inner ? along.beyond : along.ends;
                const int64_t shift = along.z & 63;
                Word* w = &words_[line_[x * size_y_ + y] + (along.z >> 6)];
                w[0].bits |= nodes << shift;
                const uint64_t rest = shift ? nodes >> (64 - shift) : 0;
                if (rest) w[1].bits |= rest;
            });
        }
    });
    // Count.
    for (int64_t x = 0; x < size_x_; ++x) {
        for (int64_t y = 0; y < size_y_; ++y) {
            const int32_t line = line_[x * size_y_ + y];
            if (line < 0) continue;
            for (int64_t w = line; w < line + words_per_line_; ++w) {
                words_[w].first = count_;
                count_ += __builtin_popcountll(words_[w].bits);
            }
        }
        plane_[x + 1] = count_;
    }
}

void TouchedRows::write_indices(int64_t* indices, int threads) const {
    threads = team_for(count_, threads);
    want_huge_pages(indices, 3 * count_ * static_cast<int64_t>(sizeof(int64_t)));
    parallel_for(size_x_, kTile, threads, [&](int64_t begin, int64_t end) {
        for (int64_t x = begin; x < end; ++x) {
            std::fill(indices + plane_[x], indices + plane_[x + 1], x);
            int64_t slot = plane_[x];
            for (int64_t y = 0; y < size_y_; ++y) {
                const int32_t line = line_[x * size_y_ + y];
                if (line < 0) continue;
                const int64_t first = slot;
                for (int64_t w = 0; w < words_per_line_; ++w) {
                    uint64_t bits = words_[line + w].bits;
                    for (; bits; bits &= bits - 1) {
                        indices[2 * count_ + slot++] = 64 * w + __builtin_ctzll(bits);
                    }
                }
                std::fill(indices + count_ + first, indices + count_ + slot, y);
            }
        }
    });
}

template void sort_by_tile(const Lattice&, const float*, int64_t, int32_t*, int);
template void sort_by_tile(const Lattice&, const double*, int64_t, int32_t*, int);
template std::vector<int64_t> slab_bounds(const Lattice&, const float*, int64_t, const int32_t*);
template std::vector<int64_t> slab_bounds(const Lattice&, const double*, int64_t, const int32_t*);
template std::vector<std::vector<CellColumn>> occupied_columns(const Lattice&, const float*,
                                                               const int32_t*,
                                                               const std::vector<int64_t>&, int);
template std::vector<std::vector<CellColumn>> occupied_columns(const Lattice&, const double*,
                                                               const int32_t*,
                                                               const std::vector<int64_t>&, int);

}  // namespace univoxel
