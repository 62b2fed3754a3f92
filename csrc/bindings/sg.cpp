#include "sg.h"

#include "bindings/common.h"

namespace univoxel {
namespace {

template <class T>
ShadeSG<T> shade_sg_of(const array<T>& axis, const array<T>& sharpness, const array<T>& amplitude,
                       const array<T>& normal, const array<T>& wo, const array<T>& albedo,
                       const array<T>& roughness, const array<T>& directions,
                       const array<T>& rotation, const array<T>& f0) {
    const int64_t n = rotation.size(), k = n ? sharpness.size() / n : 0;
    require(axis.size() == 3 * n * k && sharpness.size() == n * k &&
                amplitude.size() == 3 * n * k && normal.size() == 3 * n && wo.size() == 3 * n &&
                albedo.size() == 3 * n && roughness.size() == n && directions.size() % 3 == 0 &&
                (f0.size() == 1 || f0.size() == 3 * n),
            "shade_sg: sizes do not fit");
    return {axis.data(),
            sharpness.data(),
            amplitude.data(),
            normal.data(),
            wo.data(),
            albedo.data(),
            roughness.data(),
            directions.data(),
            rotation.data(),
            f0.data(),
            n,
            k,
            directions.size() / 3,
            f0.size() != 1};
}

template <class T>
void bind_sg(py::module_& m) {
    m.def(
        "shade_sg_forward",
        [](const array<T>& axis, const array<T>& sharpness, const array<T>& amplitude,
           const array<T>& normal, const array<T>& wo, const array<T>& albedo,
           const array<T>& roughness, const array<T>& directions, const array<T>& rotation,
           const array<T>& f0, array<T>& rgb, int threads) {
            const auto in = shade_sg_of(axis, sharpness, amplitude, normal, wo, albedo, roughness,
                                        directions, rotation, f0);
            T* out = rgb.mutable_data();
            py::gil_scoped_release nogil;
            shade_sg_forward(in, out, threads);
        },
        py::arg("axis").noconvert(), py::arg("sharpness").noconvert(),
        py::arg("amplitude").noconvert(), py::arg("normal").noconvert(), py::arg("wo").noconvert(),
        py::arg("albedo").noconvert(), py::arg("roughness").noconvert(),
        py::arg("directions").noconvert(), py::arg("rotation").noconvert(),
        py::arg("f0").noconvert(), py::arg("rgb").noconvert(), py::arg("threads"));
    m.def(
        "shade_sg_backward",
        [](const array<T>& axis, const array<T>& sharpness, const array<T>& amplitude,
           const array<T>& normal, const array<T>& wo, const array<T>& albedo,
           const array<T>& roughness, const array<T>& directions, const array<T>& rotation,
           const array<T>& f0, const array<T>& grad_rgb, array<T>& grad_axis,
           array<T>& grad_sharpness, array<T>& grad_amplitude, array<T>& grad_normal,
           array<T>& grad_wo, array<T>& grad_albedo, array<T>& grad_roughness, array<T>& grad_f0,
           int threads) {
            const auto in = shade_sg_of(axis, sharpness, amplitude, normal, wo, albedo, roughness,
                                        directions, rotation, f0);
            const ShadeSGGrad<T> grad{grad_axis.mutable_data(),      grad_sharpness.mutable_data(),
                                      grad_amplitude.mutable_data(), grad_normal.mutable_data(),
                                      grad_wo.mutable_data(),        grad_albedo.mutable_data(),
                                      grad_roughness.mutable_data(), grad_f0.mutable_data()};
            py::gil_scoped_release nogil;
            shade_sg_backward(in, grad_rgb.data(), grad, threads);
        },
        py::arg("axis").noconvert(), py::arg("sharpness").noconvert(),
        py::arg("amplitude").noconvert(), py::arg("normal").noconvert(), py::arg("wo").noconvert(),
        py::arg("albedo").noconvert(), py::arg("roughness").noconvert(),
        py::arg("directions").noconvert(), py::arg("rotation").noconvert(),
        py::arg("f0").noconvert(), py::arg("grad_rgb").noconvert(),
        py::arg("grad_axis").noconvert(), py::arg("grad_sharpness").noconvert(),
        py::arg("grad_amplitude").noconvert(), py::arg("grad_normal").noconvert(),
        py::arg("grad_wo").noconvert(), py::arg("grad_albedo").noconvert(),
        py::arg("grad_roughness").noconvert(), py::arg("grad_f0").noconvert(), py::arg("threads"));
}

}  // namespace

void bind_sg_ops(py::module_& m) {
    bind_sg<float>(m);
    bind_sg<double>(m);
}

}  // namespace univoxel
