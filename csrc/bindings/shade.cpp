#include "shade.h"

#include <pybind11/stl.h>

#include <string>
#include <variant>

#include "bindings/common.h"

namespace univoxel {
namespace {

template <class T>
Shade<T> shade_of(const char* op, const array<T>& normal, const array<T>& wo,
                  const array<T>& albedo, const array<T>& roughness, const array<T>& directions,
                  const array<T>& f0, double solid_angle) {
    const int64_t n = roughness.size();
    require(normal.size() == 3 * n && wo.size() == 3 * n && albedo.size() == 3 * n &&
                directions.size() % 3 == 0 && (f0.size() == 1 || f0.size() == 3 * n),
            std::string(op) + ": sizes do not fit");
    return {normal.data(), wo.data(), albedo.data(),         roughness.data(), directions.data(),
            f0.data(),     n,         directions.size() / 3, T(solid_angle),   f0.size() != 1};
}

/// An empty array of the gradient to the light or the normal means that nobody asks for it.
template <class T>
ShadeGrad<T> shade_grad_of(array<T>& light, array<T>& normal, array<T>& albedo, array<T>& roughness,
                           array<T>& f0) {
    return {light.size() ? light.mutable_data() : nullptr,
            normal.size() ? normal.mutable_data() : nullptr, albedo.mutable_data(),
            roughness.mutable_data(), f0.mutable_data()};
}

template <class T>
void bind_shade_radiance(py::module_& m) {
    m.def(
        "shade_radiance_forward",
        [](const array<T>& radiance, const array<T>& normal, const array<T>& wo,
           const array<T>& albedo, const array<T>& roughness, const array<T>& directions,
           const array<T>& f0, array<T>& rgb, double solid_angle, int threads) {
            const auto in = shade_of("shade_radiance", normal, wo, albedo, roughness, directions,
                                     f0, solid_angle);
            require(radiance.size() == 3 * in.n_samples * in.n_directions,
                    "shade_radiance: radiance of another size");
            const T* light = radiance.data();
            T* out = rgb.mutable_data();
            py::gil_scoped_release nogil;
            shade_radiance_forward(in, light, out, threads);
        },
        py::arg("radiance").noconvert(), py::arg("normal").noconvert(), py::arg("wo").noconvert(),
        py::arg("albedo").noconvert(), py::arg("roughness").noconvert(),
        py::arg("directions").noconvert(), py::arg("f0").noconvert(), py::arg("rgb").noconvert(),
        py::arg("solid_angle"), py::arg("threads"));
    m.def(
        "shade_radiance_backward",
        [](const array<T>& radiance, const array<T>& normal, const array<T>& wo,
           const array<T>& albedo, const array<T>& roughness, const array<T>& directions,
           const array<T>& f0, const array<T>& grad_rgb, array<T>& grad_radiance,
           array<T>& grad_normal, array<T>& grad_albedo, array<T>& grad_roughness,
           array<T>& grad_f0, double solid_angle, int threads) {
            const auto in = shade_of("shade_radiance", normal, wo, albedo, roughness, directions,
                                     f0, solid_angle);
            require(radiance.size() == 3 * in.n_samples * in.n_directions,
                    "shade_radiance: radiance of another size");
            const auto grad =
                shade_grad_of(grad_radiance, grad_normal, grad_albedo, grad_roughness, grad_f0);
            const T *light = radiance.data(), *from = grad_rgb.data();
            py::gil_scoped_release nogil;
            shade_radiance_backward(in, light, from, grad, threads);
        },
        py::arg("radiance").noconvert(), py::arg("normal").noconvert(), py::arg("wo").noconvert(),
        py::arg("albedo").noconvert(), py::arg("roughness").noconvert(),
        py::arg("directions").noconvert(), py::arg("f0").noconvert(),
        py::arg("grad_rgb").noconvert(), py::arg("grad_radiance").noconvert(),
        py::arg("grad_normal").noconvert(), py::arg("grad_albedo").noconvert(),
        py::arg("grad_roughness").noconvert(), py::arg("grad_f0").noconvert(),
        py::arg("solid_angle"), py::arg("threads"));
}

template <class T>
void bind_specular_response(py::module_& m) {
    m.def(
        "specular_response",
        [](const array<T>& normal, const array<T>& wo, const array<T>& roughness,
           const array<T>& directions, array<T>& response, double f0, double solid_angle,
           int threads) {
            const int64_t n = roughness.size(), d = directions.size() / 3;
            require(normal.size() == 3 * n && wo.size() == 3 * n && response.size() == n * d,
                    "specular_response: sizes do not fit");
            const T reflectance = T(f0);
            const Shade<T> in{normal.data(),     wo.data(),    nullptr, roughness.data(),
                              directions.data(), &reflectance, n,       d,
                              T(solid_angle),    false};
            T* out = response.mutable_data();
            py::gil_scoped_release nogil;
            specular_response(in, out, threads);
        },
        py::arg("normal").noconvert(), py::arg("wo").noconvert(), py::arg("roughness").noconvert(),
        py::arg("directions").noconvert(), py::arg("response").noconvert(), py::arg("f0"),
        py::arg("solid_angle"), py::arg("threads"));
}

template <class T>
using Fractions = std::variant<array<uint8_t>, array<T>>;
template <class T>
using Halves = std::variant<array<uint16_t>, array<T>>;

template <class T>
MapLight<T> map_light_of(const Shade<T>& in, const array<T>& map, const Fractions<T>& visibility,
                         const Halves<T>& indirect, const array<int64_t>& index) {
    const int64_t d = in.n_directions, n = in.n_samples;
    const int64_t open = std::visit([](auto& a) { return int64_t(a.size()); }, visibility);
    const int64_t blocked = std::visit([](auto& a) { return int64_t(a.size()); }, indirect);
    const int64_t points = d ? open / d : 0;
    require(
        map.size() == 3 * d && open == points * d && blocked == 3 * points * d && index.size() == n,
        "shade_map: sizes do not fit");
    const int64_t* p = index.data();
    bool ok = true;
    for (int64_t i = 0; i < n; ++i) ok &= p[i] >= 0 && p[i] < points;
    require(ok, "shade_map: index must lie in [0, P=" + std::to_string(points) + ")");
    MapLight<T> light{map.data(), {}, {}, p};
    std::visit([&](auto& a) { light.visibility = a.data(); }, visibility);
    std::visit([&](auto& a) { light.indirect = a.data(); }, indirect);
    return light;
}

template <class T>
void bind_shade_map(py::module_& m) {
    m.def(
        "shade_map_forward",
        [](const array<T>& map, const Fractions<T>& visibility, const Halves<T>& indirect,
           const array<int64_t>& index, const array<T>& normal, const array<T>& wo,
           const array<T>& albedo, const array<T>& roughness, const array<T>& directions,
           const array<T>& f0, array<T>& rgb, double solid_angle, int threads) {
            const auto in =
                shade_of("shade_map", normal, wo, albedo, roughness, directions, f0, solid_angle);
            const auto light = map_light_of(in, map, visibility, indirect, index);
            T* out = rgb.mutable_data();
            py::gil_scoped_release nogil;
            shade_map_forward(in, light, out, threads);
        },
        py::arg("map").noconvert(), py::arg("visibility").noconvert(),
        py::arg("indirect").noconvert(), py::arg("index").noconvert(),
        py::arg("normal").noconvert(), py::arg("wo").noconvert(), py::arg("albedo").noconvert(),
        py::arg("roughness").noconvert(), py::arg("directions").noconvert(),
        py::arg("f0").noconvert(), py::arg("rgb").noconvert(), py::arg("solid_angle"),
        py::arg("threads"));
    m.def(
        "shade_map_backward",
        [](const array<T>& map, const Fractions<T>& visibility, const Halves<T>& indirect,
           const array<int64_t>& index, const array<T>& normal, const array<T>& wo,
           const array<T>& albedo, const array<T>& roughness, const array<T>& directions,
           const array<T>& f0, const array<T>& grad_rgb, array<T>& grad_map, array<T>& grad_normal,
           array<T>& grad_albedo, array<T>& grad_roughness, array<T>& grad_f0, double solid_angle,
           int threads) {
            const auto in =
                shade_of("shade_map", normal, wo, albedo, roughness, directions, f0, solid_angle);
            const auto light = map_light_of(in, map, visibility, indirect, index);
            const auto grad =
                shade_grad_of(grad_map, grad_normal, grad_albedo, grad_roughness, grad_f0);
            const T* from = grad_rgb.data();
            py::gil_scoped_release nogil;
            shade_map_backward(in, light, from, grad, threads);
        },
        py::arg("map").noconvert(), py::arg("visibility").noconvert(),
        py::arg("indirect").noconvert(), py::arg("index").noconvert(),
        py::arg("normal").noconvert(), py::arg("wo").noconvert(), py::arg("albedo").noconvert(),
        py::arg("roughness").noconvert(), py::arg("directions").noconvert(),
        py::arg("f0").noconvert(), py::arg("grad_rgb").noconvert(), py::arg("grad_map").noconvert(),
        py::arg("grad_normal").noconvert(), py::arg("grad_albedo").noconvert(),
        py::arg("grad_roughness").noconvert(), py::arg("grad_f0").noconvert(),
        py::arg("solid_angle"), py::arg("threads"));
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
