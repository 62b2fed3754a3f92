// The rows of a sparse grid that some points touch.
#pragma once

#include <cstdint>
#include <vector>

#include "nodes.h"
#include "row_set.h"
#include "tiles.h"

namespace univoxel {

/// The rows that points in these columns touch: a brick of 4^3 nodes is one word of the set.
/// wide: as in TouchedRows. Rows of missing bricks are never touched.
RowSet touched_brick_rows(const Lattice& grid, const BrickNodes& nodes, int64_t n_rows,
                          const std::vector<std::vector<CellColumn>>& columns, bool wide,
                          int threads);

}  // namespace univoxel
