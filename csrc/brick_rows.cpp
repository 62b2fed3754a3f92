#include "brick_rows.h"

namespace univoxel {

RowSet touched_brick_rows(const Lattice& grid, const BrickNodes& nodes, int64_t n_rows,
                          const std::vector<std::vector<CellColumn>>& columns, bool wide,
                          int threads) {
    static_assert(kBrickNodes == 64, "a brick is a word of the set");
    constexpr uint64_t kLine = (uint64_t(1) << kBrick) - 1;  // the nodes of a brick along z
    RowSet touched(n_rows);
    int64_t n_columns = 0;
    for (const auto& of_slab : columns) n_columns += static_cast<int64_t>(of_slab.size());
    // Slabs of one parity share no brick: they reach from the node before them to the second
    // behind.
    for_slabs(static_cast<int64_t>(columns.size()), team_for(n_columns, threads), [&](int64_t s) {
        for (const CellColumn& column : columns[s]) {
            const NodesAlongZ along = nodes_along_z(grid, column, wide);
            for_lines(grid, column, wide, [&](int64_t x, int64_t y, bool inner) {
                uint64_t bits = (inner ? along.beyond : along.ends) << (along.z & kBrickMask);
                for (int64_t c = along.z >> kBrickShift; bits; ++c, bits >>= kBrick) {
                    if (!(bits & kLine)) continue;
                    const int64_t brick = nodes.brick(x >> kBrickShift, y >> kBrickShift, c);
                    if (brick < kMissingBricks) continue;
                    touched.mark(brick, (bits & kLine) << BrickNodes::inside(x, y, 0));
                }
            });
        }
    });
    touched.number();
    return touched;
}

}  // namespace univoxel
