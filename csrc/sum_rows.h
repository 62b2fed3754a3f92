// Sums of gradients that each hold some rows of a table.
#pragma once

#include <cstdint>
#include <vector>

#include "row_set.h"

namespace univoxel {

/// Rows of a table, strictly ascending, and their values [n, C].
template <class T>
struct RowList {
    const int64_t* rows;
    const T* values;
    int64_t n;
};

/// Which of a table's rows are in any of the lists.
template <class T>
RowSet union_rows(const std::vector<RowList<T>>& lists, int64_t n_rows, int threads);

/// out [set.count(), C]: for each row of the set the sum of its values, list after list.
template <class T>
void sum_rows(const std::vector<RowList<T>>& lists, const RowSet& set, int64_t channels, T* out,
              int threads);

}  // namespace univoxel
