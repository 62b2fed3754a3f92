// The rows of a sparse grid that some points touch.
#pragma once

#include <cstdint>
#include <vector>

#include "bricks.h"
#include "nodes.h"

namespace univoxel {

/// A number (slot) for each row of a sparse grid that some points touch, ascending with the rows.
///
/// A bit per row: a brick of 4^3 nodes is one word. Costs 16 bytes for each brick.
class TouchedBrickRows {
  public:
    /// wide: as in TouchedRows. Rows of missing bricks are never touched.
    TouchedBrickRows(const Lattice& grid, const BrickNodes& nodes, int64_t n_rows,
                     const std::vector<std::vector<CellColumn>>& columns, bool wide, int threads);

    int64_t count() const { return count_; }
    /// Slot of a touched row.
    int64_t slot(int64_t row) const {
        const Word& w = words_[row / kBrickNodes];
        const uint64_t below = w.bits & ((uint64_t(1) << row % kBrickNodes) - 1);
        return w.first + __builtin_popcountll(below);
    }
    /// Write the row of every slot to rows [count].
    void write_rows(int64_t* rows, int threads) const;

  private:
    struct Word {
        uint64_t bits;
        int64_t first;  // touched rows before this brick
    };
    std::vector<Word> words_;  // [bricks]
    int64_t count_ = 0;
};

}  // namespace univoxel
