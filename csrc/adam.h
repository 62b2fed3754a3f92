// Adam on some rows of a table, in place.
#pragma once

#include <cstdint>

namespace univoxel {

/// R rows of C numbers, K of them touched; row-major, contiguous.
template <class T>
struct AdamRows {
    T* param;             // [R, C]
    T* exp_avg;           // [R, C]
    T* exp_avg_sq;        // [R, C]
    const int64_t* rows;  // [K]  distinct, in [0, R)
    const T* grad;        // [K, C]
    int64_t n_touched, n_channels;
    double lr, beta1, beta2, eps;
    double step;  // of the whole table, from 1
};

/// m += (1 - beta1)(g - m), v += (1 - beta2)(g^2 - v), then
/// param -= lr m / (1 - beta1^step) / (sqrt(v / (1 - beta2^step)) + eps); other rows stay.
template <class T>
void adam_rows(const AdamRows<T>& in, int threads);

}  // namespace univoxel
