#include "sg.h"

#include "bindings/common.h"

namespace univoxel {
namespace {

template <class T>
ShadeSG<T> shade_sg_of(In<T> axis, In<T> sharpness, In<T> amplitude, In<T> normal, In<T> wo,
                       In<T> albedo, In<T> roughness, In<T> directions, In<T> rotation, In<T> f0) {
    const int64_t n = rotation.size(), k = n ? sharpness.size() / n : 0;
    require(axis.size() == 3 * n * k && sharpness.size() == n * k &&
                amplitude.size() == 3 * n * k && normal.size() == 3 * n && wo.size() == 3 * n &&
                albedo.size() == 3 * n && roughness.size() == n && directions.size() % 3 == 0 &&
                (f0.size() == 1 || f0.size() == 3 * n),
            "shade_sg: sizes do not fit");
    return make<ShadeSG<T>>(axis, sharpness, amplitude, normal, wo, albedo, roughness, directions,
                            rotation, f0, n, k, directions.size() / 3, f0.size() != 1);
}

template <class T>
void bind_sg(py::module_& m) {
    def(m, "shade_sg_forward",
        "axis sharpness amplitude normal wo albedo roughness directions rotation f0 rgb threads",
        [](In<T> axis, In<T> sharpness, In<T> amplitude, In<T> normal, In<T> wo, In<T> albedo,
           In<T> roughness, In<T> directions, In<T> rotation, In<T> f0, Out<T> rgb, int threads) {
            const auto in = shade_sg_of(axis, sharpness, amplitude, normal, wo, albedo, roughness,
                                        directions, rotation, f0);
            shade_sg_forward(in, rgb.mutable_data(), threads);
        });
    def(m, "shade_sg_backward",
        "axis sharpness amplitude normal wo albedo roughness directions rotation f0 grad_rgb "
        "grad_axis grad_sharpness grad_amplitude grad_normal grad_wo grad_albedo grad_roughness "
        "grad_f0 threads",
        [](In<T> axis, In<T> sharpness, In<T> amplitude, In<T> normal, In<T> wo, In<T> albedo,
           In<T> roughness, In<T> directions, In<T> rotation, In<T> f0, In<T> grad_rgb,
           Out<T> grad_axis, Out<T> grad_sharpness, Out<T> grad_amplitude, Out<T> grad_normal,
           Out<T> grad_wo, Out<T> grad_albedo, Out<T> grad_roughness, Out<T> grad_f0, int threads) {
            const auto in = shade_sg_of(axis, sharpness, amplitude, normal, wo, albedo, roughness,
                                        directions, rotation, f0);
            const auto grad =
                make<ShadeSGGrad<T>>(grad_axis, grad_sharpness, grad_amplitude, grad_normal,
                                     grad_wo, grad_albedo, grad_roughness, grad_f0);
            shade_sg_backward(in, grad_rgb.data(), grad, threads);
        });
}

}  // namespace

void bind_sg_ops(py::module_& m) {
    bind_sg<float>(m);
    bind_sg<double>(m);
}

}  // namespace univoxel
