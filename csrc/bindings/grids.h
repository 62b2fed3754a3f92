// What the bindings of grids share.
#pragma once

#include <array>

#include "bindings/common.h"
#include "nodes.h"
#include "trilinear.h"

namespace univoxel {

using Size3 = std::array<int64_t, 3>;
using Vec3 = std::array<double, 3>;

/// Size [X, Y, Z], origin and voxel size as Python passes them; a size of 0 holds nothing.
inline Lattice lattice_of(const Size3& size, const Vec3& origin, double voxel_size) {
    require(size[0] > 0 && size[1] > 0 && size[2] > 0, "the grid has no nodes");
    return {{size[0], size[1], size[2]}, {origin[0], origin[1], origin[2]}, 1 / voxel_size};
}

/// Bricks of a table [A, B, C] that covers a grid of this size.
inline BrickNodes brick_nodes_of(In<int32_t> table, const Size3& size) {
    for (int a = 0; a < 3; ++a) {
        require(table.ndim() == 3 && table.shape(a) == (size[a] + kBrick - 1) / kBrick,
                "the table of bricks does not belong to this size");
    }
    return {table.data(), table.shape(1), table.shape(2)};
}

/// A grid as Python passes it: its lattice in the world, and in which rows its nodes are stored.
template <class Nodes>
struct Grid {
    Lattice lattice;
    Nodes nodes;
};

inline bool has_rows(const Grid<DenseNodes>& grid, int64_t n_rows) {
    const int64_t* size = grid.lattice.size;
    return n_rows == size[0] * size[1] * size[2];
}
inline bool has_rows(const Grid<BrickNodes>&, int64_t n_rows) {
    return n_rows >= kMissingRows && n_rows % kBrickNodes == 0;
}

using Sizes = const std::vector<Size3>&;
using Numbers = const std::vector<double>&;

/// The levels of a hash table as Python passes them.
inline std::vector<Lattice> levels_of(Sizes sizes, const Vec3& origin, Numbers voxel_sizes) {
    require(sizes.size() == voxel_sizes.size(), "each level needs a size and a voxel size");
    std::vector<Lattice> levels;
    for (size_t l = 0; l < sizes.size(); ++l)
        levels.push_back(lattice_of(sizes[l], origin, voxel_sizes[l]));
    return levels;
}

}  // namespace univoxel
