// A small network of linear layers with ReLU between them, fused over tiles of rows.
#pragma once

#include <cstdint>
#include <vector>

namespace univoxel {

/// Buffers of one pass. N rows; layer l takes sizes[l] numbers to sizes[l + 1]; all row-major.
template <class T>
struct Mlp {
    const T* x;                     // [N, sizes.front()]
    std::vector<int64_t> sizes;     // layers + 1 of them, each at least 1
    std::vector<const T*> weights;  // [sizes[l + 1], sizes[l]]
    std::vector<const T*> biases;   // [sizes[l + 1]]
    int64_t n_rows;

    int64_t layers() const { return static_cast<int64_t>(weights.size()); }
};

/// Where the gradients go: the shapes of Mlp. x may be null; so may weights and biases together.
template <class T>
struct MlpGrad {
    T* x;
    std::vector<T*> weights, biases;  // empty: not wanted
};

/// out [N, sizes.back()]: h_0 = x, h_{l+1} = max(h_l W_l^T + b_l, 0), without max in the last
/// layer.
template <class T>
void mlp_forward(const Mlp<T>& in, T* out, int threads);

/// Recomputes the hidden layers tile by tile; stores nothing between the passes.
template <class T>
void mlp_backward(const Mlp<T>& in, const T* grad_out, const MlpGrad<T>& grad, int threads);

}  // namespace univoxel
