#include "lobes.h"

#include <algorithm>
#include <cmath>

#include "exp2.h"
#include "parallel.h"

namespace univoxel {
namespace {

constexpr int64_t kNumbers = 7;  // of a lobe
constexpr int64_t kBlock = 64;   // lobes that are read into columns, for loops over them
constexpr int64_t kLobesPerChunk = 4096;
constexpr double kShortest = 1e-12;  // squared length of a vector, below which its axis is shorter

/// Numbers of a block of lobes, one column each.
template <class T>
struct Block {
    T column[kNumbers][kBlock];
    int64_t count;

    void read(const T* rows, int64_t lobes) {
        count = lobes;
        for (int64_t i = 0; i < count; ++i) {
            for (int64_t c = 0; c < kNumbers; ++c) column[c][i] = rows[kNumbers * i + c];
        }
    }
    void write(T* rows) const {
        for (int64_t i = 0; i < count; ++i) {
            for (int64_t c = 0; c < kNumbers; ++c) rows[kNumbers * i + c] = column[c][i];
        }
    }
};

template <class T>
inline T exp_of_minus(T x, Clamp<T> clamp) {
    return simd_exp2(-T(kLog2E) * std::abs(x), clamp);
}

template <class T>
inline T sigmoid(T x, T e) {  // e: exp(-|x|)
    return (x >= 0 ? T(1) : e) / (1 + e);
}

/// log(1 + e) for e in [0, 1]: 2 artanh(s) with s = e / (2 + e), which is at most 1/3.
template <class T>
inline T log_of_one_and(T e) {
    constexpr int kTerms = sizeof(T) == 8 ? 17 : 7;
    const T s = e / (2 + e), s2 = s * s;
    T sum = 0;
    for (int k = kTerms - 1; k >= 0; --k) sum = sum * s2 + T(1) / T(2 * k + 1);
    return 2 * s * sum;
}

template <class T>
inline T inverse_length(T x, T y, T z) {
    return 1 / std::sqrt(std::max(x * x + y * y + z * z, T(kShortest)));
}

}  // namespace

template <class T>
void decode_lobes_forward(const RawLobes<T>& in, T* axis, T* sharpness, T* amplitude, int threads) {
    const Clamp<T> clamp = clamp_of<T>();
    parallel_for(in.n, kLobesPerChunk, threads, [&](int64_t begin, int64_t end) {
        Block<T> b;
        for (int64_t first = begin; first < end; first += kBlock) {
            b.read(in.parameters + kNumbers * first, std::min(kBlock, end - first));
            const int64_t n = b.count;
            // By name: clang takes no structured binding into a loop of OpenMP
            auto &x = b.column[0], &y = b.column[1], &z = b.column[2], &s = b.column[3];
            auto &red = b.column[4], &green = b.column[5], &blue = b.column[6];
#pragma omp simd
            for (int64_t i = 0; i < n; ++i) {
                const T r = inverse_length(x[i], y[i], z[i]);
                x[i] *= r, y[i] *= r, z[i] *= r;
                s[i] =
                    in.min_sharpness + in.max_sharpness * sigmoid(s[i], exp_of_minus(s[i], clamp));
            }
            for (T* a : {red, green, blue}) {
#pragma omp simd
                for (int64_t i = 0; i < n; ++i) {
                    a[i] = std::max(a[i], T(0)) + log_of_one_and(exp_of_minus(a[i], clamp));
                }
            }
            for (int64_t i = 0; i < n; ++i) {
                T *to_axis = axis + 3 * (first + i), *to_amplitude = amplitude + 3 * (first + i);
                to_axis[0] = x[i], to_axis[1] = y[i], to_axis[2] = z[i];
                sharpness[first + i] = s[i];
                to_amplitude[0] = red[i], to_amplitude[1] = green[i], to_amplitude[2] = blue[i];
            }
        }
    });
}

template <class T>
void decode_lobes_backward(const RawLobes<T>& in, const T* grad_axis, const T* grad_sharpness,
                           const T* grad_amplitude, T* grad_parameters, int threads) {
    const Clamp<T> clamp = clamp_of<T>();
    parallel_for(in.n, kLobesPerChunk, threads, [&](int64_t begin, int64_t end) {
        Block<T> b, g;
        for (int64_t first = begin; first < end; first += kBlock) {
            b.read(in.parameters + kNumbers * first, std::min(kBlock, end - first));
            const int64_t n = g.count = b.count;
            for (int64_t i = 0; i < n; ++i) {
                for (int64_t c = 0; c < 3; ++c) {
                    g.column[c][i] = grad_axis[3 * (first + i) + c];
                    g.column[4 + c][i] = grad_amplitude[3 * (first + i) + c];
                }
                g.column[3][i] = grad_sharpness[first + i];
            }
            const auto &x = b.column[0], &y = b.column[1], &z = b.column[2], &s = b.column[3];
            const auto &red = b.column[4], &green = b.column[5], &blue = b.column[6];
            auto &gx = g.column[0], &gy = g.column[1], &gz = g.column[2], &gs = g.column[3];
            auto &g_red = g.column[4], &g_green = g.column[5], &g_blue = g.column[6];
#pragma omp simd
            for (int64_t i = 0; i < n; ++i) {
                const T r = inverse_length(x[i], y[i], z[i]), r2 = r * r;
                // Where the length is at its floor, the vector is no more than scaled
                const bool whole = x[i] * x[i] + y[i] * y[i] + z[i] * z[i] >= T(kShortest);
                const T dot = x[i] * gx[i] + y[i] * gy[i] + z[i] * gz[i];
                const T along = whole ? dot * r2 : T(0);
                gx[i] = r * (gx[i] - along * x[i]);
                gy[i] = r * (gy[i] - along * y[i]);
                gz[i] = r * (gz[i] - along * z[i]);
                const T e = exp_of_minus(s[i], clamp), kept = 1 / (1 + e);
                gs[i] *= in.max_sharpness * e * kept * kept;
            }
            const T* amplitudes[] = {red, green, blue};
            T* grads[] = {g_red, g_green, g_blue};
            for (int c = 0; c < 3; ++c) {
                const T* a = amplitudes[c];
                T* ga = grads[c];
#pragma omp simd
                for (int64_t i = 0; i < n; ++i) ga[i] *= sigmoid(a[i], exp_of_minus(a[i], clamp));
            }
            g.write(grad_parameters + kNumbers * first);
        }
    });
}

#define UNIVOXEL_INSTANTIATE(T)                                              \
    template void decode_lobes_forward(const RawLobes<T>&, T*, T*, T*, int); \
    template void decode_lobes_backward(const RawLobes<T>&, const T*, const T*, const T*, T*, int);
UNIVOXEL_INSTANTIATE(float)
UNIVOXEL_INSTANTIATE(double)
#undef UNIVOXEL_INSTANTIATE

}  // namespace univoxel
