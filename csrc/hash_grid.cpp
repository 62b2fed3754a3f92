#include "hash_grid.h"

#include <algorithm>
#include <limits>

#include "dcheck.h"
#include "parallel.h"

namespace univoxel {
namespace {

constexpr int64_t kPointsPerChunk = 1024;
// Points whose eight rows a level are fetched before the first is read: the fetches overlap.
constexpr int64_t kPointsPerBlock = 8;

/// Which row of its level a node has: its own while there are enough, otherwise by hash
/// (Teschner et al. 2003; the factors of Mueller et al. 2022).
struct RowLookup {
    int64_t y, z;  // strides; y = 0: hashed
    uint32_t mask;

    RowLookup(const Lattice& level, int64_t rows)
        : y(0), z(0), mask(static_cast<uint32_t>(rows - 1)) {
        DCHECK(rows > 0 && (rows & (rows - 1)) == 0);  // the mask is all ones
        const double nodes = static_cast<double>(level.size[0]) *
                             static_cast<double>(level.size[1]) *
                             static_cast<double>(level.size[2]);
        if (nodes <= static_cast<double>(rows)) y = level.size[1], z = level.size[2];
    }
    int64_t at(int64_t i, int64_t j, int64_t k) const {
        if (y) {
            DCHECK(i >= 0 && j >= 0 && j < y && k >= 0 && k < z);
            return (i * y + j) * z + k;
        }
        return (static_cast<uint32_t>(i) ^ (static_cast<uint32_t>(j) * 2654435761u) ^
                (static_cast<uint32_t>(k) * 805459861u)) &
               mask;
    }
};

/// The eight nodes around a point: corner k is 4 x + 2 y + z.
template <class T>
struct Corners {
    int64_t row[8];
    T weight[8];
};

template <class T>
inline Corners<T> corners(const Lattice& level, const RowLookup& rows, const T* p) {
    int64_t node[3][2];
    T weight[3][2];
    for (int d = 0; d < 3; ++d) {
        const Place at = place(level, d, static_cast<double>(p[d]));
        node[d][0] = at.cell;
        node[d][1] = std::min(at.cell + 1, level.size[d] - 1);
        weight[d][0] = static_cast<T>(1 - at.t), weight[d][1] = static_cast<T>(at.t);
    }
    Corners<T> c;
    for (int k = 0; k < 8; ++k) {
        const int a = k >> 2, b = k >> 1 & 1, d = k & 1;
        c.row[k] = rows.at(node[0][a], node[1][b], node[2][d]);
        c.weight[k] = weight[0][a] * weight[1][b] * weight[2][d];
    }
    return c;
}

/// Call f with the number of features as a compile-time constant where it is a common one, else 0.
template <class F>
void with_features(int64_t n, F&& f) {
    switch (n) {
        case 2:
            return f(std::integral_constant<int64_t, 2>{});
        case 4:
            return f(std::integral_constant<int64_t, 4>{});
        default:
            return f(std::integral_constant<int64_t, 0>{});
    }
}

/// Encode n points; to(i): where the L * F numbers of point i go.
template <class T, class To>
void encode_levels(const HashGrid<T>& in, const T* points, int64_t n, To to) {
    with_features(in.n_features, [&](auto constant) {
        constexpr int64_t kF = decltype(constant)::value;
        const int64_t F = kF ? kF : in.n_features;
        // Level by level: the rows that the points share stay in the cache.
        for (int64_t l = 0; l < in.n_levels(); ++l) {
            const RowLookup rows(in.levels[l], in.rows);
            const T* table = in.table + l * in.rows * F;
            Corners<T> block[kPointsPerBlock];
            for (int64_t j = 0; j < n; j += kPointsPerBlock) {
                const int64_t count = std::min(kPointsPerBlock, n - j);
                for (int64_t i = 0; i < count; ++i) {
                    block[i] = corners(in.levels[l], rows, points + 3 * (j + i));
                    for (const int64_t row : block[i].row) __builtin_prefetch(table + row * F);
                }
                for (int64_t i = 0; i < count; ++i) {
                    T* o = to(j + i) + l * F;
                    const bool lost = has_nan(points + 3 * (j + i));
                    std::fill(o, o + F, lost ? std::numeric_limits<T>::quiet_NaN() : T(0));
                    for (int k = 0; k < 8; ++k) {
                        const T* row = table + block[i].row[k] * F;
                        for (int64_t f = 0; f < F; ++f) o[f] += block[i].weight[k] * row[f];
                    }
                }
            }
        }
    });
}

/// Derivative of a level's output, weighted by grad, to the point: added to out [3].
template <class T>
void add_point_gradient(const HashGrid<T>& in, int64_t l, const RowLookup& rows, const T* p,
                        const T* grad, T* out) {
    const Lattice& level = in.levels[l];
    const Corners<T> c = corners(level, rows, p);
    Place at[3];
    for (int d = 0; d < 3; ++d) at[d] = place(level, d, static_cast<double>(p[d]));
    const T step = static_cast<T>(level.per_voxel);
    for (int k = 0; k < 8; ++k) {
        const T* row = in.table + (l * in.rows + c.row[k]) * in.n_features;
        T dot = 0;
        for (int64_t f = 0; f < in.n_features; ++f) dot += row[f] * grad[f];
        for (int d = 0; d < 3; ++d) {
            if (!at[d].inside) continue;
            T weight = (k >> (2 - d) & 1) ? step : -step;
            for (int e = 0; e < 3; ++e) {
                const T t = static_cast<T>(at[e].t);
                if (e != d) weight *= (k >> (2 - e) & 1) ? t : 1 - t;
            }
            out[d] += weight * dot;
        }
    }
}

}  // namespace

template <class T>
HashRows HashRows::touched(const HashGrid<T>& in, int threads) {
    HashRows found;
    const int64_t levels = in.n_levels(), words = (in.rows + 63) / 64;
    found.words_per_level_ = words, found.rows_ = in.rows;
    found.words_.assign(levels * words, Word{0, 0});
    found.first_.assign(levels + 1, 0);
    parallel_for(levels, 1, threads, [&](int64_t l, int64_t) {
        const RowLookup rows(in.levels[l], in.rows);
        Word* level = found.words_.data() + l * words;
        for (int64_t i = 0; i < in.n_points; ++i) {
            const T* p = in.points + 3 * i;
            if (has_nan(p)) continue;
            const Corners<T> c = corners(in.levels[l], rows, p);
            for (const int64_t row : c.row) level[row >> 6].bits |= uint64_t(1) << (row & 63);
        }
        int64_t count = 0;
        for (int64_t w = 0; w < words; ++w) {
            level[w].first = count;
            count += __builtin_popcountll(level[w].bits);
        }
        found.first_[l + 1] = count;
    });
    for (int64_t l = 0; l < levels; ++l) found.first_[l + 1] += found.first_[l];
    for (int64_t l = 1; l < levels; ++l) {
        for (int64_t w = 0; w < words; ++w) found.words_[l * words + w].first += found.first_[l];
    }
    return found;
}

void HashRows::write(int64_t* rows, int threads) const {
    const int64_t levels = static_cast<int64_t>(first_.size()) - 1;
    parallel_for(levels, 1, threads, [&](int64_t l, int64_t) {
        int64_t slot = first_[l];
        for (int64_t w = 0; w < words_per_level_; ++w) {
            uint64_t bits = words_[l * words_per_level_ + w].bits;
            for (; bits; bits &= bits - 1) {
                rows[slot++] = l * rows_ + 64 * w + __builtin_ctzll(bits);
            }
        }
    });
}

template <class T>
void encode_hash_forward(const HashGrid<T>& in, T* out, int threads) {
    const int64_t width = in.n_levels() * in.n_features;
    parallel_for(in.n_points, kPointsPerChunk, threads, [&](int64_t begin, int64_t end) {
        encode_levels(in, in.points + 3 * begin, end - begin,
                      [&](int64_t i) { return out + (begin + i) * width; });
    });
}

template <class T>
void encode_hash_rows(const HashGrid<T>& in, const T* points, const std::vector<int64_t>& rows,
                      T* out, int64_t stride) {
    encode_levels(in, points, static_cast<int64_t>(rows.size()),
                  [&](int64_t i) { return out + rows[i] * stride; });
}

template <class T>
void encode_hash_backward(const HashGrid<T>& in, const T* grad_out, T* grad_table,
                          const HashRows* touched, T* grad_points, int64_t felt, int threads) {
    const int64_t width = in.n_levels() * in.n_features;
    if (grad_table) {
        with_features(in.n_features, [&](auto constant) {
            constexpr int64_t kF = decltype(constant)::value;
            const int64_t F = kF ? kF : in.n_features;
            parallel_for(in.n_levels(), 1, threads, [&](int64_t l, int64_t) {
                const RowLookup rows(in.levels[l], in.rows);
                const int64_t first = touched ? touched->first(l) : l * in.rows;
                const int64_t last = touched ? touched->first(l + 1) : (l + 1) * in.rows;
                std::fill(grad_table + first * F, grad_table + last * F, T(0));
                for (int64_t i = 0; i < in.n_points; ++i) {
                    const T* p = in.points + 3 * i;
                    if (has_nan(p)) continue;
                    const Corners<T> c = corners(in.levels[l], rows, p);
                    const T* pull = grad_out + i * width + l * F;
                    for (int k = 0; k < 8; ++k) {
                        const int64_t row = c.row[k];
                        T* sum = grad_table + (touched ? touched->slot(l, row) : first + row) * F;
                        for (int64_t f = 0; f < F; ++f) sum[f] += c.weight[k] * pull[f];
                    }
                }
            });
        });
    }
    if (!grad_points) return;
    parallel_for(in.n_points, kPointsPerChunk, threads, [&](int64_t begin, int64_t end) {
        std::fill(grad_points + 3 * begin, grad_points + 3 * end, T(0));
        for (int64_t l = 0; l < felt; ++l) {
            const RowLookup rows(in.levels[l], in.rows);
            for (int64_t i = begin; i < end; ++i) {
                const T* p = in.points + 3 * i;
                if (has_nan(p)) continue;
                const T* pull = grad_out + i * width + l * in.n_features;
                add_point_gradient(in, l, rows, p, pull, grad_points + 3 * i);
            }
        }
    });
}

template HashRows HashRows::touched(const HashGrid<float>&, int);
template HashRows HashRows::touched(const HashGrid<double>&, int);
template void encode_hash_forward(const HashGrid<float>&, float*, int);
template void encode_hash_forward(const HashGrid<double>&, double*, int);
template void encode_hash_rows(const HashGrid<float>&, const float*, const std::vector<int64_t>&,
                               float*, int64_t);
template void encode_hash_rows(const HashGrid<double>&, const double*, const std::vector<int64_t>&,
                               double*, int64_t);
template void encode_hash_backward(const HashGrid<float>&, const float*, float*, const HashRows*,
                                   float*, int64_t, int);
template void encode_hash_backward(const HashGrid<double>&, const double*, double*, const HashRows*,
                                   double*, int64_t, int);

}  // namespace univoxel
