#include "dense_grid.h"

namespace univoxel {

template <class T>
void sample_grid_forward(const DenseGrid<T>& in, T* value, T* gradient, T* feature, int threads) {
    sample_forward(in, value, gradient, feature, threads);
}

template <class T>
void sample_grid_backward(const DenseGrid<T>& in, const DenseGridGrads<T>& grads, int threads) {
    sample_backward(in, grads, sampling::AllRows{in.nodes}, threads);
}

template void sample_grid_forward(const DenseGrid<float>&, float*, float*, float*, int);
template void sample_grid_forward(const DenseGrid<double>&, double*, double*, double*, int);
template void sample_grid_backward(const DenseGrid<float>&, const DenseGridGrads<float>&, int);
template void sample_grid_backward(const DenseGrid<double>&, const DenseGridGrads<double>&, int);

}  // namespace univoxel
