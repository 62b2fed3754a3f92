// Points grouped by tiles of 8^3 cells, and the grid rows that they touch.
#pragma once

#include <cstdint>
#include <vector>

#include "dcheck.h"
#include "parallel.h"
#include "trilinear.h"

namespace univoxel {

constexpr int kTileShift = 3;
constexpr int64_t kTile = int64_t(1) << kTileShift;  // cells along the side of a tile

/// Threads for work on n points: few are done before a team stands.
inline int team_for(int64_t n_points, int threads) {
    return n_points < 2048 ? 1 : threads;
}

/// Write to order [M] the points sorted by tile, x slowest; points of one tile keep their order.
template <class T>
void sort_by_tile(const Lattice& grid, const T* points, int64_t n_points, int32_t* order,
                  int threads);

/// Bounds [n_slabs + 1] of the slabs in a sorted order. A slab is 8 cells thick along x.
template <class T>
std::vector<int64_t> slab_bounds(const Lattice& grid, const T* points, int64_t n_points,
                                 const int32_t* order);

/// Call f(slab) for the even slabs, then for the odd ones, each half in parallel.
///
/// A sample reaches two nodes beyond its cell, so slabs of one parity share no node, and a node
/// shared by neighbours gets its even sum first: the same bits for any number of threads.
template <class F>
void for_slabs(int64_t n_slabs, int threads, F&& f) {
    for (int64_t parity = 0; parity < 2; ++parity) {
        parallel_for((n_slabs + 1 - parity) / 2, 1, threads, [&](int64_t begin, int64_t end) {
            for (int64_t i = begin; i < end; ++i) f(2 * i + parity);
        });
    }
}

/// The planes of nodes [begin, end) along x that a slab clears before for_slabs sums into them:
/// every plane once, and before its first sum.
struct Planes {
    int64_t begin, end;
};
Planes planes_to_clear(const Lattice& grid, int64_t slab, int64_t n_slabs);

/// Cells x, y, z + i for every set bit i < kTile hold points.
struct CellColumn {
    int32_t x, y, z;
    uint32_t cells;
};
static_assert(kTile <= 8, "a column of a tile is a byte of cells");

/// Call f(x, y, inner) for the lines of nodes that a column of cells touches: the four at its
/// corners (inner), and if wide the eight beside these.
template <class F>
void for_lines(const Lattice& grid, const CellColumn& column, bool wide, F&& f) {
    const int64_t from = wide ? -1 : 0, to = wide ? 2 : 1;
    for (int64_t a = from; a <= to; ++a) {
        for (int64_t b = from; b <= to; ++b) {
            const bool inner_a = a == 0 || a == 1, inner_b = b == 0 || b == 1;
            const int64_t x = column.x + a, y = column.y + b;
            if (!(inner_a || inner_b) || x < 0 || y < 0) continue;
            if (x >= grid.size[0] || y >= grid.size[1]) continue;
            f(x, y, inner_a && inner_b);
        }
    }
}

/// Nodes along z that a column touches, from z on: bit i stands for node z + i.
struct NodesAlongZ {
    int64_t z;
    uint64_t ends;    // on the lines beside the inner ones: the two ends of each cell
    uint64_t beyond;  // on the inner lines: if wide also the two nodes beyond these
};

inline NodesAlongZ nodes_along_z(const Lattice& grid, const CellColumn& column, bool wide) {
    // Bit i stands for node z - 1 + i.
    DCHECK(column.cells != 0 && column.z >= 0 && column.z < grid.size[2]);
    const uint64_t m = column.cells;
    uint64_t ends = m << 1 | m << 2, beyond = wide ? ends | m | m << 3 : ends;
    int64_t z = column.z - 1;
    if (z < 0) ends >>= 1, beyond >>= 1, z = 0;
    const int64_t room = grid.size[2] - z;
    if (room < 64) {
        ends &= (uint64_t(1) << room) - 1;
        beyond &= (uint64_t(1) << room) - 1;
    }
    return {z, ends, beyond};
}

/// The columns of occupied cells, slab by slab. NaN points occupy none.
template <class T>
std::vector<std::vector<CellColumn>> occupied_columns(const Lattice& grid, const T* points,
                                                      const int32_t* order,
                                                      const std::vector<int64_t>& bounds,
                                                      int threads);

/// Which nodes of a grid some points touch, and a number (slot) for each, in the grid's order.
///
/// A bit per node, kept only for the lines along z that hold one; a slot is the count of bits
/// before. Costs the touched lines, plus four bytes for each of the X * Y lines.
class TouchedRows {
  public:
    /// wide = false: the 8 corners of each occupied cell; true: the 32 nodes of value and slope.
    TouchedRows(const Lattice& grid, const std::vector<std::vector<CellColumn>>& columns, bool wide,
                int threads);

    int64_t count() const { return count_; }
    /// Slot of a touched node.
    int64_t slot(int64_t x, int64_t y, int64_t z) const {
        DCHECK(x < size_x_ && y < size_y_ && z < size_z_ && line_[x * size_y_ + y] >= 0);
        const Word& w = words_[line_[x * size_y_ + y] + (z >> 6)];
        DCHECK(w.bits >> (z & 63) & 1);
        const uint64_t below = w.bits & ((uint64_t(1) << (z & 63)) - 1);
        return w.first + __builtin_popcountll(below);
    }
    /// How many slots lie in planes below x; x in [0, X].
    int64_t slots_below(int64_t x) const {
        DCHECK(x >= 0 && x <= size_x_);
        return plane_[x];
    }
    /// Write the node of every slot to indices [3, count].
    void write_indices(int64_t* indices, int threads) const;

  private:
    struct Word {
        uint64_t bits;
        int64_t first;  // touched nodes before this word
    };
    int64_t size_x_, size_y_, size_z_, words_per_line_, count_ = 0;
    std::vector<int32_t> line_;   // [X * Y] its first word if it is touched, or -1
    std::vector<Word> words_;     // [touched lines, words_per_line]
    std::vector<int64_t> plane_;  // [X + 1]
};

}  // namespace univoxel
