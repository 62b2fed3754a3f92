// Multiresolution hash encoding: features of points from small tables, level by level.
#pragma once

#include <cstdint>
#include <vector>

#include "dcheck.h"
#include "trilinear.h"

namespace univoxel {

/// Buffers of one pass. M points, L levels of R rows each, F features a row; row-major.
template <class T>
struct HashGrid {
    const T* table;               // [L * R, F]
    const T* points;              // [M, 3] world; outside a lattice they are clamped to its border
    std::vector<Lattice> levels;  // L of them
    int64_t rows;                 // R, a power of two
    int64_t n_points, n_features;

    int64_t n_levels() const { return static_cast<int64_t>(levels.size()); }
};

/// The rows of a table that some points touch, and a number (slot) for each, ascending.
class HashRows {
  public:
    template <class T>
    static HashRows touched(const HashGrid<T>& in, int threads);

    int64_t count() const { return first_.back(); }
    /// Slots of a level: [first(level), first(level + 1)).
    int64_t first(int64_t level) const { return first_[level]; }
    /// Slot of a touched row of a level.
    int64_t slot(int64_t level, int64_t row) const {
        const Word& w = words_[level * words_per_level_ + (row >> 6)];
        DCHECK(w.bits >> (row & 63) & 1);
        const uint64_t below = w.bits & ((uint64_t(1) << (row & 63)) - 1);
        return w.first + __builtin_popcountll(below);
    }
    /// Write the row in the whole table of every slot to rows [count].
    void write(int64_t* rows, int threads) const;

  private:
    struct Word {
        uint64_t bits;
        int64_t first;  // touched rows before this word
    };
    int64_t words_per_level_ = 0, rows_ = 0;
    std::vector<Word> words_;
    std::vector<int64_t> first_;
};

/// out [M, L * F]: of each level the trilinear interpolant of its nodes' rows. NaN at NaN points.
template <class T>
void encode_hash_forward(const HashGrid<T>& in, T* out, int threads);

/// The same of other points, one for each of some rows of out, which are `stride` numbers apart.
template <class T>
void encode_hash_rows(const HashGrid<T>& in, const T* points, const std::vector<int64_t>& rows,
                      T* out, int64_t stride);

/// Gradients: grad_table [L * R, F], or [touched->count(), F]; grad_points [M, 3], from the first
/// `felt` levels; null: not wanted.
///
/// A level is summed by one thread, in the points' order: the same bits for any number of threads.
template <class T>
void encode_hash_backward(const HashGrid<T>& in, const T* grad_out, T* grad_table,
                          const HashRows* touched, T* grad_points, int64_t felt, int threads);

}  // namespace univoxel
