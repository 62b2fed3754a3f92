#include "sparse_grid.h"

namespace univoxel {

template <class T>
void sample_grid_forward(const SparseGrid<T>& in, T* value, T* gradient, T* feature, int threads) {
    sample_forward(in, value, gradient, feature, threads);
}

template <class T>
void sample_grid_backward(const SparseGrid<T>& in, const SparseGridGrads<T>& grads, int threads) {
    sample_backward(in, grads, sampling::AllBrickRows{in.n_rows}, threads);
}

template void sample_grid_forward(const SparseGrid<float>&, float*, float*, float*, int);
template void sample_grid_forward(const SparseGrid<double>&, double*, double*, double*, int);
template void sample_grid_backward(const SparseGrid<float>&, const SparseGridGrads<float>&, int);
template void sample_grid_backward(const SparseGrid<double>&, const SparseGridGrads<double>&, int);

}  // namespace univoxel
