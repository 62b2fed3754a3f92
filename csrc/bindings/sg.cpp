#include "sg.h"

#include "bindings/common.h"
#include "lobes.h"

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

template <class T>
RawLobes<T> raw_lobes_of(In<T> parameters, int64_t n, double low, double high) {
    require(parameters.size() == 7 * n, "decode_lobes: sizes do not fit");
    return make<RawLobes<T>>(parameters, n, static_cast<T>(low), static_cast<T>(high));
}

template <class T>
void bind_lobes(py::module_& m) {
    def(m, "decode_lobes_forward",
        "parameters min_sharpness max_sharpness axis sharpness amplitude threads",
        [](In<T> parameters, double low, double high, Out<T> axis, Out<T> sharpness,
           Out<T> amplitude, int threads) {
            const int64_t n = sharpness.size();
            const auto in = raw_lobes_of(parameters, n, low, high);
            require(axis.size() == 3 * n && amplitude.size() == 3 * n,
                    "decode_lobes: sizes do not fit");
            decode_lobes_forward(in, axis.mutable_data(), sharpness.mutable_data(),
                                 amplitude.mutable_data(), threads);
        });
    def(m, "decode_lobes_backward",
        "parameters min_sharpness max_sharpness grad_axis grad_sharpness grad_amplitude "
        "grad_parameters threads",
        [](In<T> parameters, double low, double high, In<T> grad_axis, In<T> grad_sharpness,
           In<T> grad_amplitude, Out<T> grad_parameters, int threads) {
            const int64_t n = grad_sharpness.size();
            const auto in = raw_lobes_of(parameters, n, low, high);
            require(grad_axis.size() == 3 * n && grad_amplitude.size() == 3 * n &&
                        grad_parameters.size() == 7 * n,
                    "decode_lobes: sizes do not fit");
            decode_lobes_backward(in, grad_axis.data(), grad_sharpness.data(),
                                  grad_amplitude.data(), grad_parameters.mutable_data(), threads);
        });
}

}  // namespace

void bind_sg_ops(py::module_& m) {
    bind_sg<float>(m);
    bind_sg<double>(m);
    bind_lobes<float>(m);
    bind_lobes<double>(m);
}

}  // namespace univoxel
