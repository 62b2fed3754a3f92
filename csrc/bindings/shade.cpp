#include "shade.h"

#include "bindings/common.h"

namespace univoxel {
namespace {

template <class T>
Shade<T> shade_of(const char* op, In<T> normal, In<T> wo, In<T> albedo, In<T> roughness,
                  In<T> directions, In<T> f0, double solid_angle) {
    const int64_t n = roughness.size();
    require(normal.size() == 3 * n && wo.size() == 3 * n && albedo.size() == 3 * n &&
                directions.size() % 3 == 0 && (f0.size() == 1 || f0.size() == 3 * n),
            std::string(op) + ": sizes do not fit");
    return make<Shade<T>>(normal, wo, albedo, roughness, directions, f0, n, directions.size() / 3,
                          T(solid_angle), f0.size() != 1);
}

/// An empty array of the gradient to the light or the normal means that nobody asks for it.
template <class T>
ShadeGrad<T> shade_grad_of(Out<T> light, Out<T> normal, Out<T> albedo, Out<T> roughness,
                           Out<T> f0) {
    return {light.size() ? light.mutable_data() : nullptr,
            normal.size() ? normal.mutable_data() : nullptr, albedo.mutable_data(),
            roughness.mutable_data(), f0.mutable_data()};
}

/// Radiance [N, D, 3] of the samples that `in` describes.
template <class T>
const T* radiance_of(const Shade<T>& in, In<T> radiance) {
    require(radiance.size() == 3 * in.n_samples * in.n_directions,
            "shade_radiance: radiance of another size");
    return radiance.data();
}

template <class T>
void bind_shade_radiance(py::module_& m) {
    def(m, "shade_radiance_forward",
        "radiance normal wo albedo roughness directions f0 rgb solid_angle threads",
        [](In<T> radiance, In<T> normal, In<T> wo, In<T> albedo, In<T> roughness, In<T> directions,
           In<T> f0, Out<T> rgb, double solid_angle, int threads) {
            const auto in = shade_of("shade_radiance", normal, wo, albedo, roughness, directions,
                                     f0, solid_angle);
            shade_radiance_forward(in, radiance_of(in, radiance), rgb.mutable_data(), threads);
        });
    def(m, "shade_radiance_backward",
        "radiance normal wo albedo roughness directions f0 grad_rgb grad_radiance grad_normal "
        "grad_albedo grad_roughness grad_f0 solid_angle threads",
        [](In<T> radiance, In<T> normal, In<T> wo, In<T> albedo, In<T> roughness, In<T> directions,
           In<T> f0, In<T> grad_rgb, Out<T> grad_radiance, Out<T> grad_normal, Out<T> grad_albedo,
           Out<T> grad_roughness, Out<T> grad_f0, double solid_angle, int threads) {
            const auto in = shade_of("shade_radiance", normal, wo, albedo, roughness, directions,
                                     f0, solid_angle);
            const auto grad =
                shade_grad_of(grad_radiance, grad_normal, grad_albedo, grad_roughness, grad_f0);
            shade_radiance_backward(in, radiance_of(in, radiance), grad_rgb.data(), grad, threads);
        });
}

template <class T>
void bind_specular_response(py::module_& m) {
    def(m, "specular_response", "normal wo roughness directions response f0 solid_angle threads",
        [](In<T> normal, In<T> wo, In<T> roughness, In<T> directions, Out<T> response, double f0,
           double solid_angle, int threads) {
            const int64_t n = roughness.size(), d = directions.size() / 3;
            require(normal.size() == 3 * n && wo.size() == 3 * n && response.size() == n * d,
                    "specular_response: sizes do not fit");
            const T reflectance = T(f0);
            const auto in = make<Shade<T>>(normal, wo, nullptr, roughness, directions, &reflectance,
                                           n, d, T(solid_angle), false);
            specular_response(in, response.mutable_data(), threads);
        });
}

template <class T>
using Fractions = const std::variant<array<uint8_t>, array<T>>&;
template <class T>
using Halves = const std::variant<array<uint16_t>, array<T>>&;

template <class T>
MapLight<T> map_light_of(const Shade<T>& in, In<T> map, Fractions<T> visibility, Halves<T> indirect,
                         In<int64_t> index) {
    const auto size_of = [](const auto& arrays) {
        return std::visit([](const auto& a) { return int64_t(a.size()); }, arrays);
    };
    const int64_t d = in.n_directions, points = d ? size_of(visibility) / d : 0;
    require(map.size() == 3 * d && size_of(visibility) == points * d &&
                size_of(indirect) == 3 * points * d && index.size() == in.n_samples,
            "shade_map: sizes do not fit");
    require(all_of<int64_t>(index, [=](int64_t p) { return p >= 0 && p < points; }),
            "shade_map: index must lie in [0, P=" + std::to_string(points) + ")");
    MapLight<T> light{map.data(), {}, {}, index.data()};
    std::visit([&](const auto& a) { light.visibility = a.data(); }, visibility);
    std::visit([&](const auto& a) { light.indirect = a.data(); }, indirect);
    return light;
}

template <class T>
void bind_shade_map(py::module_& m) {
    def(m, "shade_map_forward",
        "map visibility indirect index normal wo albedo roughness directions f0 rgb solid_angle "
        "threads",
        [](In<T> map, Fractions<T> visibility, Halves<T> indirect, In<int64_t> index, In<T> normal,
           In<T> wo, In<T> albedo, In<T> roughness, In<T> directions, In<T> f0, Out<T> rgb,
           double solid_angle, int threads) {
            const auto in =
                shade_of("shade_map", normal, wo, albedo, roughness, directions, f0, solid_angle);
            const auto light = map_light_of(in, map, visibility, indirect, index);
            shade_map_forward(in, light, rgb.mutable_data(), threads);
        });
    def(m, "shade_map_backward",
        "map visibility indirect index normal wo albedo roughness directions f0 grad_rgb grad_map "
        "grad_normal grad_albedo grad_roughness grad_f0 solid_angle threads",
        [](In<T> map, Fractions<T> visibility, Halves<T> indirect, In<int64_t> index, In<T> normal,
           In<T> wo, In<T> albedo, In<T> roughness, In<T> directions, In<T> f0, In<T> grad_rgb,
           Out<T> grad_map, Out<T> grad_normal, Out<T> grad_albedo, Out<T> grad_roughness,
           Out<T> grad_f0, double solid_angle, int threads) {
            const auto in =
                shade_of("shade_map", normal, wo, albedo, roughness, directions, f0, solid_angle);
            const auto light = map_light_of(in, map, visibility, indirect, index);
            const auto grad =
                shade_grad_of(grad_map, grad_normal, grad_albedo, grad_roughness, grad_f0);
            shade_map_backward(in, light, grad_rgb.data(), grad, threads);
        });
}

}  // namespace

void bind_shade_ops(py::module_& m) {
    bind_specular_response<float>(m);
    bind_specular_response<double>(m);
    bind_shade_radiance<float>(m);
    bind_shade_radiance<double>(m);
    bind_shade_map<float>(m);
    bind_shade_map<double>(m);
}

}  // namespace univoxel
