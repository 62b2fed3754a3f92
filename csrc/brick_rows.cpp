#include "brick_rows.h"

namespace univoxel {
namespace {

constexpr int64_t kBricksPerChunk = 4096;

}  // namespace

TouchedBrickRows::TouchedBrickRows(const Lattice& grid, const BrickNodes& nodes, int64_t n_rows,
                                   const std::vector<std::vector<CellColumn>>& columns, bool wide,
                                   int threads)
    : words_(n_rows / kBrickNodes, Word{0, 0}) {
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
                    words_[brick].bits |= (bits & 15) << ((x & 3) << 4 | (y & 3) << 2);
                }
            });
        }
    });
    for (Word& w : words_) {
        w.first = count_;
        count_ += __builtin_popcountll(w.bits);
    }
}

void TouchedBrickRows::write_rows(int64_t* rows, int threads) const {
    const int64_t n = static_cast<int64_t>(words_.size());
    parallel_for(n, kBricksPerChunk, team_for(count_, threads), [&](int64_t begin, int64_t end) {
        for (int64_t brick = begin; brick < end; ++brick) {
            int64_t* out = rows + words_[brick].first;
            for (uint64_t bits = words_[brick].bits; bits; bits &= bits - 1) {
                *out++ = brick * kBrickNodes + __builtin_ctzll(bits);
            }
        }
    });
}

}  // namespace univoxel
