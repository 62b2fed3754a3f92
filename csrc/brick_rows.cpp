#include "brick_rows.h"

namespace univoxel {

RowSet touched_brick_rows(const Lattice& grid, const BrickNodes& nodes, int64_t n_rows,
                          const std::vector<std::vector<CellColumn>>& columns, bool wide,
                          int threads) {
    static_assert(kBrickNodes == 64, "a brick is a word of the set");
    RowSet touched(n_rows);
    int64_t n_columns = 0;
    for (const auto& of_slab : columns) n_columns += static_cast<int64_t>(of_slab.size());
    // Slabs of one parity share no brick: they reach from the node before them to the second
    // behind.
    for_slabs(static_cast<int64_t>(columns.size()), team_for(n_columns, threads), [&](int64_t s) {
        for (const CellColumn& column : columns[s]) {
            const NodesAlongZ along = nodes_along_z(grid, column, wide);
            for_lines(grid, column, wide, [&](int64_t x, int64_t y, bool inner) {
                uint64_t bits = (inner ? along.beyond : along.ends) << (along.z & 3);
                for (int64_t c = along.z >> 2; bits; ++c, bits >>= 4) {
                    if (!(bits & 15)) continue;
                    const int64_t brick = nodes.brick(x >> 2, y >> 2, c);
                    if (brick < 2) continue;
                    touched.mark(brick, (bits & 15) << ((x & 3) << 4 | (y & 3) << 2));
                }
            });
        }
    });
    touched.number();
    return touched;
}

}  // namespace univoxel
