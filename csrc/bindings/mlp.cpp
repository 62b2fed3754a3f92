#include "mlp.h"

#include <pybind11/stl.h>

#include "bindings/common.h"

namespace univoxel {
namespace {

template <class T>
using arrays = std::vector<array<T>>;

template <class T>
Mlp<T> mlp_of(const array<T>& x, const arrays<T>& weights, const arrays<T>& biases) {
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
    m.def(
        "mlp_forward",
        [](const array<T>& x, const arrays<T>& weights, const arrays<T>& biases, array<T>& out,
           int threads) {
            const auto in = mlp_of(x, weights, biases);
            require(out.size() == in.n_rows * in.sizes.back(), "mlp: sizes do not fit");
            T* o = out.mutable_data();
            py::gil_scoped_release nogil;
            mlp_forward(in, o, threads);
        },
        py::arg("x").noconvert(), py::arg("weights").noconvert(), py::arg("biases").noconvert(),
        py::arg("out").noconvert(), py::arg("threads"));
    m.def(
        "mlp_backward",
        [](const array<T>& x, const arrays<T>& weights, const arrays<T>& biases,
           const array<T>& grad_out, std::optional<array<T>> grad_x, arrays<T> grad_weights,
           arrays<T> grad_biases, int threads) {
            const auto in = mlp_of(x, weights, biases);
            require(grad_weights.size() == grad_biases.size() &&
                        (grad_weights.empty() || grad_weights.size() == weights.size()),
                    "mlp: layers do not fit");
            MlpGrad<T> grad{grad_x ? grad_x->mutable_data() : nullptr, {}, {}};
            for (size_t l = 0; l < grad_weights.size(); ++l) {
                require(grad_weights[l].size() == weights[l].size() &&
                            grad_biases[l].size() == biases[l].size(),
                        "mlp: sizes do not fit");
                grad.weights.push_back(grad_weights[l].mutable_data());
                grad.biases.push_back(grad_biases[l].mutable_data());
            }
            py::gil_scoped_release nogil;
            mlp_backward(in, grad_out.data(), grad, threads);
        },
        py::arg("x").noconvert(), py::arg("weights").noconvert(), py::arg("biases").noconvert(),
        py::arg("grad_out").noconvert(), py::arg("grad_x").noconvert(),
        py::arg("grad_weights").noconvert(), py::arg("grad_biases").noconvert(),
        py::arg("threads"));
}

}  // namespace

void bind_mlp_ops(py::module_& m) {
    bind_mlp<float>(m);
    bind_mlp<double>(m);
}

}  // namespace univoxel
