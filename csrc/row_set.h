// Which rows of a table are chosen, and a number for each.
#pragma once

#include <cstdint>
#include <vector>

#include "dcheck.h"
#include "parallel.h"

namespace univoxel {

/// A number (slot) for each chosen row of a table, ascending with the rows. Mark rows, then
/// `number` them. A bit per row: costs 16 bytes for 64 rows of the table.
class RowSet {
  public:
    explicit RowSet(int64_t n_rows) : words_((n_rows + 63) / 64, Word{0, 0}), n_rows_(n_rows) {}

    void mark(int64_t row) { mark(row >> 6, uint64_t(1) << (row & 63)); }
    /// Mark those of rows 64 word .. 64 word + 63 whose bit is set.
    void mark(int64_t word, uint64_t bits) {
        DCHECK(word >= 0 && word < static_cast<int64_t>(words_.size()));
        words_[word].bits |= bits;
    }
    /// After the last mark.
    void number() {
        DCHECK(count_ == 0);
        for (Word& w : words_) {
            w.first = count_;
            count_ += __builtin_popcountll(w.bits);
        }
    }
    int64_t count() const { return count_; }
    /// Of the table.
    int64_t n_rows() const { return n_rows_; }
    /// Marked rows before this one: a multiple of 64, or the table's end.
    int64_t before(int64_t row) const {
        DCHECK(row == n_rows_ || row % 64 == 0);
        return row == n_rows_ ? count_ : words_[row >> 6].first;
    }

    bool has(int64_t row) const { return words_[row >> 6].bits >> (row & 63) & 1; }
    /// Slot of a marked row.
    int64_t slot(int64_t row) const {
        DCHECK(has(row));
        const Word& w = words_[row >> 6];
        return w.first + __builtin_popcountll(w.bits & ((uint64_t(1) << (row & 63)) - 1));
    }

    /// Slot of a row, or `other` of one that is not marked: without a jump, which would be guessed.
    int64_t slot_or(int64_t row, int64_t other) const {
        const Word& w = words_[row >> 6];
        const uint64_t bit = uint64_t(1) << (row & 63);
        const int64_t slot = w.first + __builtin_popcountll(w.bits & (bit - 1));
        return w.bits & bit ? slot : other;
    }

    /// Write the row of every slot to rows [count].
    void write_rows(int64_t* rows, int threads) const {
        const int64_t n = static_cast<int64_t>(words_.size());
        parallel_for(n, kWordsPerChunk, threads, [&](int64_t begin, int64_t end) {
            for (int64_t w = begin; w < end; ++w) {
                int64_t* out = rows + words_[w].first;
                for (uint64_t bits = words_[w].bits; bits; bits &= bits - 1) {
                    *out++ = 64 * w + __builtin_ctzll(bits);
                }
            }
        });
    }

    /// Write the place of every slot's row in an array of this shape to indices [dims, count].
    void write_indices(const std::vector<int64_t>& shape, int64_t* indices, int threads) const {
        const int64_t n = static_cast<int64_t>(words_.size());
        const int dims = static_cast<int>(shape.size());
        parallel_for(n, kWordsPerChunk, threads, [&](int64_t begin, int64_t end) {
            for (int64_t w = begin; w < end; ++w) {
                int64_t slot = words_[w].first;
                for (uint64_t bits = words_[w].bits; bits; bits &= bits - 1, ++slot) {
                    // Divided in 32 bits where the row fits, as it mostly does: 64 bits are slow
                    uint64_t row = 64 * w + __builtin_ctzll(bits);
                    for (int d = dims - 1; d > 0; --d) {
                        const uint64_t size = shape[d];
                        const bool small = row <= UINT32_MAX;
                        const uint64_t next = small ? uint32_t(row) / uint32_t(size) : row / size;
                        indices[d * count_ + slot] = row - next * size;
                        row = next;
                    }
                    indices[slot] = row;
                }
            }
        });
    }

  private:
    static constexpr int64_t kWordsPerChunk = 4096;

    struct Word {
        uint64_t bits;
        int64_t first;  // marked rows before this word
    };
    std::vector<Word> words_;
    int64_t n_rows_;
    int64_t count_ = 0;
};

}  // namespace univoxel
