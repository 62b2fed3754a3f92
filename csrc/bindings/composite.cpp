#include "composite.h"

#include "bindings/common.h"

namespace univoxel {
namespace {

template <class T>
Composite<T> composite_of(In<T> alpha, In<T> value, In<int64_t> offsets, double early_stop) {
    const int64_t *o = offsets.data(), n = offsets.size() - 1;
    require(n >= 0 && o[0] == 0 && o[n] == alpha.size() && std::is_sorted(o, o + n + 1),
            "composite: offsets must rise from 0 to the number of samples (" +
                std::to_string(alpha.size()) + ")");
    return {alpha.data(), value.data(), o, n, value.shape(1), T(early_stop)};
}

template <class T>
void bind_composite(py::module_& m) {
    def(m, "composite_forward", "alpha value offsets out weight early_stop threads",
        [](In<T> alpha, In<T> value, In<int64_t> offsets, Out<T> out, Out<T> weight,
           double early_stop, int threads) {
            const auto in = composite_of(alpha, value, offsets, early_stop);
            composite_forward(in, out.mutable_data(), weight.mutable_data(), threads);
        });
    def(m, "composite_backward",
        "alpha value offsets grad_out grad_weight grad_alpha grad_value early_stop threads",
        [](In<T> alpha, In<T> value, In<int64_t> offsets, In<T> grad_out, In<T> grad_weight,
           Out<T> grad_alpha, Out<T> grad_value, double early_stop, int threads) {
            const auto in = composite_of(alpha, value, offsets, early_stop);
            composite_backward(in, grad_out.data(), grad_weight.data(), grad_alpha.mutable_data(),
                               grad_value.mutable_data(), threads);
        });
}

}  // namespace

void bind_composite_ops(py::module_& m) {
    bind_composite<float>(m);
    bind_composite<double>(m);
}

}  // namespace univoxel
