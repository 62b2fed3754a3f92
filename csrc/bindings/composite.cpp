#include "composite.h"

#include <string>

#include "bindings/common.h"

namespace univoxel {
namespace {

/// offsets [N + 1] must start at 0, never fall and end at n_samples; returns N.
int64_t check_offsets(const char* op, const array<int64_t>& offsets, int64_t n_samples) {
    const int64_t n = offsets.size() - 1;
    const int64_t* o = offsets.data();
    bool ok = n >= 0 && o[0] == 0 && o[n] == n_samples;
    for (int64_t i = 0; ok && i < n; ++i) ok = o[i] <= o[i + 1];
    require(ok, std::string(op) + ": offsets must rise from 0 to the number of samples (" +
                    std::to_string(n_samples) + ")");
    return n;
}

template <class T>
Composite<T> composite_of(const array<T>& alpha, const array<T>& value,
                          const array<int64_t>& offsets, double early_stop) {
    const int64_t n = check_offsets("composite", offsets, alpha.size());
    return {alpha.data(), value.data(), offsets.data(), n, value.shape(1), T(early_stop)};
}

template <class T>
void bind_composite(py::module_& m) {
    m.def(
        "composite_forward",
        [](const array<T>& alpha, const array<T>& value, const array<int64_t>& offsets,
           array<T>& out, array<T>& weight, double early_stop, int threads) {
            const auto in = composite_of(alpha, value, offsets, early_stop);
            T *o = out.mutable_data(), *w = weight.mutable_data();
            py::gil_scoped_release nogil;
            composite_forward(in, o, w, threads);
        },
        py::arg("alpha").noconvert(), py::arg("value").noconvert(), py::arg("offsets").noconvert(),
        py::arg("out").noconvert(), py::arg("weight").noconvert(), py::arg("early_stop"),
        py::arg("threads"));
    m.def(
        "composite_backward",
        [](const array<T>& alpha, const array<T>& value, const array<int64_t>& offsets,
           const array<T>& grad_out, const array<T>& grad_weight, array<T>& grad_alpha,
           array<T>& grad_value, double early_stop, int threads) {
            const auto in = composite_of(alpha, value, offsets, early_stop);
            T *ga = grad_alpha.mutable_data(), *gv = grad_value.mutable_data();
            py::gil_scoped_release nogil;
            composite_backward(in, grad_out.data(), grad_weight.data(), ga, gv, threads);
        },
        py::arg("alpha").noconvert(), py::arg("value").noconvert(), py::arg("offsets").noconvert(),
        py::arg("grad_out").noconvert(), py::arg("grad_weight").noconvert(),
        py::arg("grad_alpha").noconvert(), py::arg("grad_value").noconvert(), py::arg("early_stop"),
        py::arg("threads"));
}

}  // namespace

void bind_composite_ops(py::module_& m) {
    bind_composite<float>(m);
    bind_composite<double>(m);
}

}  // namespace univoxel
