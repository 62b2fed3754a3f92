#include "mlp.h"

#include <algorithm>
#include <new>

#include "dcheck.h"
#include "parallel.h"

namespace univoxel {
namespace {

// Everything is multiplied in blocks of kBlockRows x kWidth numbers that the compiler keeps in
// registers: half of them for sums. Vectors are those of the instruction set compiled for, as the
// compiler's own vector types: it keeps arrays of them in registers, which it does not for arrays
// of numbers in a loop.
#if defined(__AVX512F__)
constexpr int64_t kVectorBytes = 64, kBlockRows = 8;
#elif defined(__AVX__)
constexpr int64_t kVectorBytes = 32, kBlockRows = 4;
#else
constexpr int64_t kVectorBytes = 16, kBlockRows = 4;
#endif

// Rows of a tile: its layers and gradients, some 1 kB a row, stay in the second-level cache.
constexpr int64_t kTileRows = 128;
// Chunks sum gradients of the weights apart: their number bounds that memory and the sums at the
// end.
constexpr int64_t kMaxChunks = 32;
constexpr int64_t kMinRowsPerChunk = 256;
// Numbers of the sums at the end that a thread takes at a time: a part of every chunk's in turn,
// which its first-level cache holds.
constexpr int64_t kNumbersPerChunk = 4096;

template <class T>
struct Simd {
    static constexpr int64_t kCount = kVectorBytes / sizeof(T);
    typedef T Vector __attribute__((vector_size(kVectorBytes), may_alias));
};

template <class T>
constexpr int64_t kWidth = 2 * Simd<T>::kCount;  // columns of a panel

constexpr int64_t panels(int64_t columns, int64_t width) {
    return (columns + width - 1) / width;
}

/// Numbers aligned for vectors, not set to anything.
template <class T>
class Buffer {
  public:
    explicit Buffer(int64_t n)
        : data_(static_cast<T*>(::operator new(n * sizeof(T), std::align_val_t(kVectorBytes)))) {}
    Buffer(Buffer&& other) noexcept : data_(other.data_) { other.data_ = nullptr; }
    Buffer(const Buffer&) = delete;
    Buffer& operator=(const Buffer&) = delete;
    Buffer& operator=(Buffer&&) = delete;
    ~Buffer() { ::operator delete(data_, std::align_val_t(kVectorBytes)); }
    T* data() const { return data_; }

  private:
    T* data_;
};

// Matrices are kept in panels of kWidth columns, [panel][row][kWidth]: whatever a block reads then
// lies in order. What comes in is padded with zeros to whole panels and blocks; products with the
// padding reach nothing but padding.

/// Numbers in a matrix of so many rows in panels.
template <class T>
int64_t panel_size(int64_t rows, int64_t columns) {
    return panels(columns, kWidth<T>) * rows * kWidth<T>;
}

/// A matrix, element (i, j) at from[i * row_step + j * column_step], into panels of `height` rows.
template <class T>
void pack(const T* from, int64_t row_step, int64_t column_step, int64_t rows, int64_t columns,
          int64_t height, T* to) {
    constexpr int64_t W = kWidth<T>;
    const int64_t padded = std::min(panels(rows, kBlockRows) * kBlockRows, height);
    for (int64_t p = 0; p < columns; p += W) {
        const int64_t width = std::min(W, columns - p);
        T* row = to + p * height;
        for (int64_t i = 0; i < rows; ++i, row += W) {
            for (int64_t j = 0; j < width; ++j) row[j] = from[i * row_step + (p + j) * column_step];
            std::fill(row + width, row + W, T(0));
        }
        std::fill(row, row + (padded - rows) * W, T(0));
    }
}

/// The way back.
template <class T>
void unpack(const T* from, int64_t height, int64_t rows, int64_t columns, T* to) {
    constexpr int64_t W = kWidth<T>;
    for (int64_t p = 0; p < columns; p += W) {
        const int64_t width = std::min(W, columns - p);
        for (int64_t i = 0; i < rows; ++i) {
            const T* row = from + p * height + i * W;
            std::copy(row, row + width, to + i * columns + p);
        }
    }
}

/// What a block does with its sums.
enum class Finish { kStore, kRelu, kMask };

/// c (+)= a b for a block of kBlockRows rows and one or two vectors of columns.
template <class T>
struct Block {
    const T* a;          // element (i, k) is a[i * kRowStep + k * kStep]
    int64_t run;         // so many of a's columns lie kStep apart
    int64_t skip;        // then the next run begins so many numbers after this one
    const T* b;          // row k is b + k * kWidth
    int64_t depth;       // columns of a, rows of b
    const T* start;      // what the sums start from; null: 0
    int64_t start_step;  // between its rows
    const T* mask;       // for kMask: c is 0 where this is at most 0
    T* c;
};

template <int64_t kRowStep, int64_t kStep, int64_t kVectors, Finish kFinish, class T>
inline void multiply_block(const Block<T> block) {
    using Vector = typename Simd<T>::Vector;
    constexpr int64_t W = kWidth<T>, L = Simd<T>::kCount;
    const T *a = block.a, *b = block.b, *start = block.start;
    DCHECK(reinterpret_cast<uintptr_t>(b) % kVectorBytes == 0);
    DCHECK(reinterpret_cast<uintptr_t>(block.c) % kVectorBytes == 0);
    Vector sum[kBlockRows][kVectors];
#pragma GCC unroll 8
    for (int64_t i = 0; i < kBlockRows; ++i) {
#pragma GCC unroll 2
        for (int64_t v = 0; v < kVectors; ++v)
            sum[i][v] = start
                            ? *reinterpret_cast<const Vector*>(start + i * block.start_step + v * L)
                            : Vector{};
    }
    for (int64_t first = 0; first < block.depth; first += block.run) {
        const int64_t end = std::min(block.run, block.depth - first);
        for (int64_t k = 0; k < end; ++k) {
            Vector row[kVectors];
#pragma GCC unroll 2
            for (int64_t v = 0; v < kVectors; ++v)
                row[v] = *reinterpret_cast<const Vector*>(b + k * W + v * L);
#pragma GCC unroll 8
            for (int64_t i = 0; i < kBlockRows; ++i) {
                const T weight = a[i * kRowStep + k * kStep];
#pragma GCC unroll 2
                for (int64_t v = 0; v < kVectors; ++v) sum[i][v] += weight * row[v];
            }
        }
        a += block.skip;
        b += end * W;
    }
#pragma GCC unroll 8
    for (int64_t i = 0; i < kBlockRows; ++i) {
#pragma GCC unroll 2
        for (int64_t v = 0; v < kVectors; ++v) {
            const int64_t at = i * W + v * L;
            Vector s = sum[i][v];
            if constexpr (kFinish == Finish::kRelu) s = s < 0 ? Vector{} : s;  // NaN stays
            if constexpr (kFinish == Finish::kMask) {
                s = *reinterpret_cast<const Vector*>(block.mask + at) <= 0 ? Vector{} : s;
            }
            *reinterpret_cast<Vector*>(block.c + at) = s;
        }
    }
}

/// A block of the last panel may need its first half alone.
template <int64_t kRowStep, int64_t kStep, Finish kFinish, class T>
inline void multiply_block(int64_t columns, const Block<T>& block) {
    if (columns <= Simd<T>::kCount) {
        multiply_block<kRowStep, kStep, 1, kFinish>(block);
    } else {
        multiply_block<kRowStep, kStep, 2, kFinish>(block);
    }
}

/// A tile times a packed matrix, all in panels.
template <class T>
struct Product {
    const T* a;  // [rows, depth]
    const T* b;  // [depth, columns]
    int64_t rows, depth, columns;
    T* c;                      // [rows, columns]
    const T* start = nullptr;  // [columns, padded] added to each row; null: nothing
    const T* mask = nullptr;   // [rows, columns] of Finish::kMask
};

/// c = finish(start + a b).
template <Finish kFinish, class T>
void multiply(const Product<T>& p) {
    constexpr int64_t W = kWidth<T>, panel = kTileRows * W;
    DCHECK(p.rows <= kTileRows && (kFinish != Finish::kMask || p.mask));
    for (int64_t j = 0; j < p.columns; j += W) {
        for (int64_t i = 0; i < p.rows; i += kBlockRows) {
            const int64_t at = j * kTileRows + i * W;
            multiply_block<W, 1, kFinish>(
                p.columns - j, Block<T>{p.a + i * W, W, panel, p.b + j * p.depth, p.depth,
                                        p.start ? p.start + j : nullptr, 0,
                                        p.mask ? p.mask + at : nullptr, p.c + at});
        }
    }
}

/// sum += a^T b over the rows of two tiles: [a's columns, b's columns] in panels.
template <class T>
void add_outer(const T* a, int64_t a_columns, const T* b, int64_t b_columns, int64_t rows, T* sum) {
    constexpr int64_t W = kWidth<T>;
    const int64_t height = panels(a_columns, W) * W;
    for (int64_t j = 0; j < b_columns; j += W) {
        for (int64_t i = 0; i < a_columns; i += kBlockRows) {
            T* c = sum + j * height + i * W;
            const T* from = a + i / W * W * kTileRows + i % W;
            multiply_block<1, W, Finish::kStore>(
                b_columns - j, Block<T>{from, rows, 0, b + j * kTileRows, rows, c, W, nullptr, c});
        }
    }
}

/// sum [columns] += the rows of a tile.
template <class T>
void add_rows(const T* a, int64_t columns, int64_t rows, T* sum) {
    constexpr int64_t W = kWidth<T>;
    for (int64_t p = 0; p < columns; p += W) {
        const T* from = a + p * kTileRows;
        T sums[W] = {};
        for (int64_t r = 0; r < rows; ++r) {
#pragma omp simd
            for (int64_t j = 0; j < W; ++j) sums[j] += from[r * W + j];
        }
        for (int64_t j = 0; j < std::min(W, columns - p); ++j) sum[p + j] += sums[j];
    }
}

/// Rows of a chunk, whatever the number of threads.
int64_t grain_of(int64_t n_rows) {
    return std::max(kMinRowsPerChunk, panels(panels(n_rows, kMaxChunks), kTileRows) * kTileRows);
}

/// The network in panels, and its padded biases.
template <class T>
struct Packed {
    std::vector<Buffer<T>> forward, backward, bias;  // W^T for h W^T, W for g W

    Packed(const Mlp<T>& in, bool with_backward) {
        for (int64_t l = 0; l < in.layers(); ++l) {
            const int64_t i = in.sizes[l], o = in.sizes[l + 1];
            forward.emplace_back(panel_size<T>(i, o));
            pack(in.weights[l], 1, i, i, o, i, forward[l].data());
            bias.emplace_back(panel_size<T>(1, o));
            pack(in.biases[l], o, 1, 1, o, 1, bias[l].data());
            if (!with_backward) continue;
            backward.emplace_back(panel_size<T>(o, i));
            pack(in.weights[l], i, 1, o, i, o, backward[l].data());
        }
    }
};

/// What a thread works in: a tile of every layer.
template <class T>
std::vector<Buffer<T>> tiles(const std::vector<int64_t>& sizes) {
    std::vector<Buffer<T>> result;
    for (const int64_t n : sizes) result.emplace_back(panel_size<T>(kTileRows, n));
    return result;
}

/// Fill tiles[0 .. count] from rows of x.
template <class T>
void run_layers(const Mlp<T>& in, const Packed<T>& net, int64_t first, int64_t rows, int64_t count,
                std::vector<Buffer<T>>& tile) {
    pack(in.x + first * in.sizes[0], in.sizes[0], 1, rows, in.sizes[0], kTileRows, tile[0].data());
    for (int64_t l = 0; l < count; ++l) {
        const auto multiply_ =
            l + 1 < in.layers() ? multiply<Finish::kRelu, T> : multiply<Finish::kStore, T>;
        multiply_({tile[l].data(), net.forward[l].data(), rows, in.sizes[l], in.sizes[l + 1],
                   tile[l + 1].data(), net.bias[l].data()});
    }
}

}  // namespace

template <class T>
void mlp_forward(const Mlp<T>& in, T* out, int threads) {
    const Packed<T> net(in, false);
    const int64_t last = in.sizes.back();
    const int64_t grain = grain_of(in.n_rows);
    parallel_for(in.n_rows, grain, threads, [&](int64_t begin, int64_t end) {
        std::vector<Buffer<T>> tile = tiles<T>(in.sizes);
        for (int64_t first = begin; first < end; first += kTileRows) {
            const int64_t rows = std::min(kTileRows, end - first);
            run_layers(in, net, first, rows, in.layers(), tile);
            unpack(tile.back().data(), kTileRows, rows, last, out + first * last);
        }
    });
}

// With g_l = dL/d h_l:  dL/dW_l = g_{l+1}^T h_l,  dL/db_l = sum over rows of g_{l+1},  and
// g_l = (g_{l+1} W_l) where h_l > 0. Chunks sum apart, and their sums are added in their order: the
// same bits for any number of threads.
template <class T>
void mlp_backward(const Mlp<T>& in, const T* grad_out, const MlpGrad<T>& grad, int threads) {
    constexpr int64_t W = kWidth<T>;
    const Packed<T> net(in, true);
    const int64_t layers = in.layers(), last = in.sizes.back();
    const bool to_weights = !grad.weights.empty();
    const int64_t grain = grain_of(in.n_rows);
    const int64_t chunks = panels(in.n_rows, grain);
    std::vector<int64_t> at(layers + 1, 0);  // where a layer's sums begin: weights, then biases
    for (int64_t l = 0; l < layers; ++l) {
        const int64_t height = panels(in.sizes[l + 1], W) * W;
        at[l + 1] = at[l] + panel_size<T>(height, in.sizes[l]) + height;
    }
    Buffer<T> sums(to_weights ? std::max<int64_t>(chunks, 1) * at[layers] : 0);
    parallel_for(in.n_rows, grain, threads, [&](int64_t begin, int64_t end) {
        std::vector<Buffer<T>> tile = tiles<T>(in.sizes), g = tiles<T>(in.sizes);
        T* sum = sums.data() + begin / grain * at[layers];
        if (to_weights) std::fill(sum, sum + at[layers], T(0));
        for (int64_t first = begin; first < end; first += kTileRows) {
            const int64_t rows = std::min(kTileRows, end - first);
            run_layers(in, net, first, rows, layers - 1, tile);
            pack(grad_out + first * last, last, 1, rows, last, kTileRows, g.back().data());
            for (int64_t l = layers - 1; l >= 0; --l) {
                const int64_t i = in.sizes[l], o = in.sizes[l + 1];
                const T *h = tile[l].data(), *from = g[l + 1].data();
                if (to_weights) {
                    add_outer(from, o, h, i, rows, sum + at[l]);
                    add_rows(from, o, rows, sum + at[l + 1] - panels(o, W) * W);
                }
                Product<T> to_layer{from, net.backward[l].data(), rows, o, i, g[l].data()};
                if (l > 0) {
                    to_layer.mask = h;
                    multiply<Finish::kMask>(to_layer);
                } else if (grad.x) {
                    multiply<Finish::kStore>(to_layer);
                    unpack(g[0].data(), kTileRows, rows, i, grad.x + first * i);
                }
            }
        }
    });
    if (!to_weights) return;
    T* total = sums.data();
    if (!chunks) std::fill(total, total + at[layers], T(0));
    parallel_for(at[layers], kNumbersPerChunk, threads, [&](int64_t begin, int64_t end) {
        for (int64_t c = 1; c < chunks; ++c) {
            const T* part = total + c * at[layers];
#pragma omp simd
            for (int64_t k = begin; k < end; ++k) total[k] += part[k];
        }
    });
    for (int64_t l = 0; l < layers; ++l) {
        const int64_t i = in.sizes[l], o = in.sizes[l + 1], height = panels(o, W) * W;
        unpack(total + at[l], height, o, i, grad.weights[l]);
        std::copy_n(total + at[l + 1] - height, o, grad.biases[l]);
    }
}

template void mlp_forward(const Mlp<float>&, float*, int);
template void mlp_forward(const Mlp<double>&, double*, int);
template void mlp_backward(const Mlp<float>&, const float*, const MlpGrad<float>&, int);
template void mlp_backward(const Mlp<double>&, const double*, const MlpGrad<double>&, int);

}  // namespace univoxel
