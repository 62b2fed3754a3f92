#include "sum_rows.h"

#include <algorithm>
#include <type_traits>

#include "parallel.h"

namespace univoxel {
namespace {

// Rows of the table that a thread takes at a time. Whole words of the set: no two threads mark one.
constexpr int64_t kRowsPerChunk = 32768;
static_assert(kRowsPerChunk % 64 == 0);

/// Call f(k) for the entries of a list whose rows lie in [begin, end).
template <class T, class F>
void each_within(const RowList<T>& list, int64_t begin, int64_t end, F&& f) {
    const int64_t* last = list.rows + list.n;
    const int64_t* row = std::lower_bound(list.rows, last, begin);
    for (; row != last && *row < end; ++row) f(row - list.rows);
}

template <class T, class Channels>
void add_up(const std::vector<RowList<T>>& lists, const RowSet& set, Channels channels, T* out,
            int threads) {
    parallel_for(set.n_rows(), kRowsPerChunk, threads, [&](int64_t begin, int64_t end) {
        std::fill(out + set.before(begin) * channels, out + set.before(end) * channels, T(0));
        for (const RowList<T>& list : lists) {
            each_within(list, begin, end, [&](int64_t k) {
                const T* value = list.values + k * channels;
                T* sum = out + set.slot(list.rows[k]) * channels;
                for (int64_t c = 0; c < channels; ++c) sum[c] += value[c];
            });
        }
    });
}

}  // namespace

template <class T>
RowSet union_rows(const std::vector<RowList<T>>& lists, int64_t n_rows, int threads) {
    RowSet set(n_rows);
    parallel_for(n_rows, kRowsPerChunk, threads, [&](int64_t begin, int64_t end) {
        for (const RowList<T>& list : lists)
            each_within(list, begin, end, [&](int64_t k) { set.mark(list.rows[k]); });
    });
    set.number();
    return set;
}

template <class T>
void sum_rows(const std::vector<RowList<T>>& lists, const RowSet& set, int64_t channels, T* out,
              int threads) {
    switch (channels) {  // counts that unroll
        case 1:
            return add_up(lists, set, std::integral_constant<int64_t, 1>{}, out, threads);
        case 2:
            return add_up(lists, set, std::integral_constant<int64_t, 2>{}, out, threads);
        default:
            return add_up(lists, set, channels, out, threads);
    }
}

template RowSet union_rows(const std::vector<RowList<float>>&, int64_t, int);
template RowSet union_rows(const std::vector<RowList<double>>&, int64_t, int);
template void sum_rows(const std::vector<RowList<float>>&, const RowSet&, int64_t, float*, int);
template void sum_rows(const std::vector<RowList<double>>&, const RowSet&, int64_t, double*, int);

}  // namespace univoxel
