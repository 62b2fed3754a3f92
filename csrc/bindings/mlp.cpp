#include "mlp.h"

#include "bindings/common.h"

namespace univoxel {
namespace {

template <class T>
using Arrays = const std::vector<array<T>>&;
template <class T>
using OutArrays = std::vector<array<T>>&;

template <class T>
Mlp<T> mlp_of(In<T> x, Arrays<T> weights, Arrays<T> biases) {
    Mlp<T> in{x.data(), {x.shape(1)}, {}, {}, x.shape(0)};
    require(!weights.empty() && weights.size() == biases.size(), "mlp: layers do not fit");
    for (size_t l = 0; l < weights.size(); ++l) {
        in.sizes.push_back(biases[l].size());
        require(in.sizes[l] > 0 && weights[l].size() == in.sizes[l] * in.sizes[l + 1],
                "mlp: sizes do not fit");
        in.weights.push_back(weights[l].data());
        in.biases.push_back(biases[l].data());
    }
    require(in.sizes.back() > 0, "mlp: sizes do not fit");
    return in;
}

template <class T>
void bind_mlp(py::module_& m) {
    def(m, "mlp_forward", "x weights biases out threads",
        [](In<T> x, Arrays<T> weights, Arrays<T> biases, Out<T> out, int threads) {
            const auto in = mlp_of(x, weights, biases);
            require(out.size() == in.n_rows * in.sizes.back(), "mlp: sizes do not fit");
            mlp_forward(in, out.mutable_data(), threads);
        });
    def(m, "mlp_backward", "x weights biases grad_out grad_x grad_weights grad_biases threads",
        [](In<T> x, Arrays<T> weights, Arrays<T> biases, In<T> grad_out, OptionalOut<T> grad_x,
           OutArrays<T> grad_weights, OutArrays<T> grad_biases, int threads) {
            const auto in = mlp_of(x, weights, biases);
            require(grad_weights.size() == grad_biases.size() &&
                        (grad_weights.empty() || grad_weights.size() == weights.size()),
                    "mlp: layers do not fit");
            MlpGrad<T> grad{raw(grad_x), {}, {}};
            for (size_t l = 0; l < grad_weights.size(); ++l) {
                require(grad_weights[l].size() == weights[l].size() &&
                            grad_biases[l].size() == biases[l].size(),
                        "mlp: sizes do not fit");
                grad.weights.push_back(grad_weights[l].mutable_data());
                grad.biases.push_back(grad_biases[l].mutable_data());
            }
            mlp_backward(in, grad_out.data(), grad, threads);
        });
}

}  // namespace

void bind_mlp_ops(py::module_& m) {
    bind_mlp<float>(m);
    bind_mlp<double>(m);
}

}  // namespace univoxel
