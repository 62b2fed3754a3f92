#include "visibility.h"

#include <pybind11/stl.h>

#include <memory>
#include <optional>

#include "bindings/common.h"
#include "integrator.h"

namespace univoxel {
namespace {

RayBatch rays_of(const array<float>& origin, const array<float>& direction, float t_min,
                 float t_max) {
    require(origin.size() == direction.size(), "rays: as many origins as directions");
    return {origin.data(), direction.data(), origin.size() / 3, t_min, t_max};
}

void bind_visibility(py::module_& m) {
    m.def("embree_version", &embree_version);
    py::class_<VisibilityScene>(m, "VisibilityScene")
        .def(py::init([](const array<float>& vertices, const array<int32_t>& faces, int threads) {
                 py::gil_scoped_release nogil;
                 return std::make_unique<VisibilityScene>(vertices.data(), vertices.size() / 3,
                                                          faces.data(), faces.size() / 3, threads);
             }),
             py::arg("vertices").noconvert(), py::arg("faces").noconvert(), py::arg("threads"))
        .def(
            "occluded",
            [](const VisibilityScene& scene, const array<float>& origin,
               const array<float>& direction, array<bool>& out, float t_min, float t_max,
               int threads) {
                const auto rays = rays_of(origin, direction, t_min, t_max);
                require(out.size() == rays.n_rays, "occluded: out must be [N]");
                bool* o = out.mutable_data();
                py::gil_scoped_release nogil;
                occluded(scene, rays, o, threads);
            },
            py::arg("origin").noconvert(), py::arg("direction").noconvert(),
            py::arg("out").noconvert(), py::arg("t_min"), py::arg("t_max"), py::arg("threads"))
        .def(
            "closest_hit",
            [](const VisibilityScene& scene, const array<float>& origin,
               const array<float>& direction, array<float>& t, array<int64_t>& face,
               array<float>& barycentric, float t_min, float t_max, int threads) {
                const auto rays = rays_of(origin, direction, t_min, t_max);
                require(t.size() == rays.n_rays && face.size() == rays.n_rays &&
                            barycentric.size() == 2 * rays.n_rays,
                        "closest_hit: t, face and barycentric must be [N], [N] and [N, 2]");
                float *out_t = t.mutable_data(), *out_uv = barycentric.mutable_data();
                int64_t* out_face = face.mutable_data();
                py::gil_scoped_release nogil;
                closest_hit(scene, rays, out_t, out_face, out_uv, threads);
            },
            py::arg("origin").noconvert(), py::arg("direction").noconvert(),
            py::arg("t").noconvert(), py::arg("face").noconvert(),
            py::arg("barycentric").noconvert(), py::arg("t_min"), py::arg("t_max"),
            py::arg("threads"));
}

void bind_integrator(py::module_& m) {
    py::enum_<Strategy>(m, "Strategy")
        .value("mis", Strategy::mis)
        .value("map", Strategy::map)
        .value("brdf", Strategy::brdf);
    using optional_array = std::optional<array<float>>;
    m.def(
        "relight",
        [](const VisibilityScene& scene, const optional_array& vertex_normal,
           const optional_array& vertex_albedo, const optional_array& vertex_roughness,
           const optional_array& vertex_f0, const array<float>& texel, const array<float>& row_cdf,
           const array<float>& column_cdf, float rotation, const array<float>& sun,
           const array<float>& lamp, const array<float>& position, const array<float>& normal,
           const array<float>& wo, const array<float>& albedo, const array<float>& roughness,
           const array<float>& f0, array<float>& rgb, float offset, uint32_t first, int samples,
           int bounces, uint32_t seed, Strategy strategy, int threads) {
            const int64_t n = roughness.size(), h = texel.shape(0), w = texel.shape(1);
            require(texel.size() == 4 * h * w && row_cdf.size() == h + 1 &&
                        column_cdf.size() == h * (w + 1),
                    "relight: the tables do not belong to this map");
            for (const array<float>* a :
                 {&position, &normal, &wo, &albedo, &f0, static_cast<const array<float>*>(&rgb)})
                require(a->size() == 3 * n, "relight: points differ in number");
            require(
                bounces == 0 || (vertex_normal && vertex_albedo && vertex_roughness && vertex_f0),
                "relight: bounces need materials");
            require(sun.size() % 7 == 0 && lamp.size() % 6 == 0, "relight: lights of another size");
            const auto data = [](const optional_array& a) { return a ? a->data() : nullptr; };
            const Relight in{&scene,
                             data(vertex_normal),
                             data(vertex_albedo),
                             data(vertex_roughness),
                             data(vertex_f0),
                             {texel.data(), row_cdf.data(), column_cdf.data(), h, w, rotation},
                             {sun.data(), lamp.data(), sun.size() / 7, lamp.size() / 6},
                             position.data(),
                             normal.data(),
                             wo.data(),
                             albedo.data(),
                             roughness.data(),
                             f0.data(),
                             n,
                             offset,
                             first,
                             samples,
                             bounces,
                             seed,
                             strategy};
            float* out = rgb.mutable_data();
            py::gil_scoped_release nogil;
            relight(in, out, threads);
        },
        py::arg("scene"), py::arg("vertex_normal").noconvert(),
        py::arg("vertex_albedo").noconvert(), py::arg("vertex_roughness").noconvert(),
        py::arg("vertex_f0").noconvert(), py::arg("texel").noconvert(),
        py::arg("row_cdf").noconvert(), py::arg("column_cdf").noconvert(), py::arg("rotation"),
        py::arg("sun").noconvert(), py::arg("lamp").noconvert(), py::arg("position").noconvert(),
        py::arg("normal").noconvert(), py::arg("wo").noconvert(), py::arg("albedo").noconvert(),
        py::arg("roughness").noconvert(), py::arg("f0").noconvert(), py::arg("rgb").noconvert(),
        py::arg("offset"), py::arg("first"), py::arg("samples"), py::arg("bounces"),
        py::arg("seed"), py::arg("strategy"), py::arg("threads"));
}

}  // namespace

void bind_visibility_ops(py::module_& m) {
    bind_visibility(m);
    bind_integrator(m);
}

}  // namespace univoxel
