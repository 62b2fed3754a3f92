#include "visibility.h"

#include <memory>

#include "bindings/common.h"
#include "integrator.h"

namespace univoxel {
namespace {

RayBatch rays_of(In<float> origin, In<float> direction, float t_min, float t_max) {
    require(origin.size() == direction.size(), "rays: as many origins as directions");
    return {origin.data(), direction.data(), origin.size() / 3, t_min, t_max};
}

void bind_scene(py::module_& m) {
    m.def("embree_version", &embree_version);
    py::class_<VisibilityScene> scene(m, "VisibilityScene");
    def_init(scene, "vertices faces threads",
             [](In<float> vertices, In<int32_t> faces, int threads) {
                 py::gil_scoped_release nogil;
                 return std::make_unique<VisibilityScene>(vertices.data(), vertices.size() / 3,
                                                          faces.data(), faces.size() / 3, threads);
             });
    def(scene, "occluded", "origin direction out t_min t_max threads",
        [](const VisibilityScene& scene, In<float> origin, In<float> direction, Out<bool> out,
           float t_min, float t_max, int threads) {
            const auto rays = rays_of(origin, direction, t_min, t_max);
            require(out.size() == rays.n_rays, "occluded: out must be [N]");
            occluded(scene, rays, out.mutable_data(), threads);
        });
    def(scene, "closest_hit", "origin direction t face barycentric t_min t_max threads",
        [](const VisibilityScene& scene, In<float> origin, In<float> direction, Out<float> t,
           Out<int64_t> face, Out<float> barycentric, float t_min, float t_max, int threads) {
            const auto rays = rays_of(origin, direction, t_min, t_max);
            require(t.size() == rays.n_rays && face.size() == rays.n_rays &&
                        barycentric.size() == 2 * rays.n_rays,
                    "closest_hit: t, face and barycentric must be [N], [N] and [N, 2]");
            closest_hit(scene, rays, t.mutable_data(), face.mutable_data(),
                        barycentric.mutable_data(), threads);
        });
}

void bind_integrator(py::module_& m) {
    py::enum_<Strategy>(m, "Strategy")
        .value("mis", Strategy::mis)
        .value("map", Strategy::map)
        .value("brdf", Strategy::brdf);
    def(m, "relight",
        "scene vertex_normal vertex_albedo vertex_roughness vertex_f0 texel row_cdf column_cdf "
        "rotation sun lamp position normal wo albedo roughness f0 rgb offset first samples bounces "
        "seed strategy threads",
        [](const VisibilityScene& scene, OptionalIn<float> vertex_normal,
           OptionalIn<float> vertex_albedo, OptionalIn<float> vertex_roughness,
           OptionalIn<float> vertex_f0, In<float> texel, In<float> row_cdf, In<float> column_cdf,
           float rotation, In<float> sun, In<float> lamp, In<float> position, In<float> normal,
           In<float> wo, In<float> albedo, In<float> roughness, In<float> f0, Out<float> rgb,
           float offset, uint32_t first, int samples, int bounces, uint32_t seed, Strategy strategy,
           int threads) {
            const int64_t n = roughness.size(), h = texel.shape(0), w = texel.shape(1);
            require(texel.size() == 4 * h * w && row_cdf.size() == h + 1 &&
                        column_cdf.size() == h * (w + 1),
                    "relight: the tables do not belong to this map");
            for (const int64_t size :
                 {position.size(), normal.size(), wo.size(), albedo.size(), f0.size(), rgb.size()})
                require(size == 3 * n, "relight: points differ in number");
            require(
                bounces == 0 || (vertex_normal && vertex_albedo && vertex_roughness && vertex_f0),
                "relight: bounces need materials");
            require(sun.size() % 7 == 0 && lamp.size() % 6 == 0, "relight: lights of another size");
            const EnvMapTables map{texel.data(), row_cdf.data(), column_cdf.data(), h, w, rotation};
            const Lights lights{sun.data(), lamp.data(), sun.size() / 7, lamp.size() / 6};
            const auto in =
                make<Relight>(&scene, vertex_normal, vertex_albedo, vertex_roughness, vertex_f0,
                              map, lights, position, normal, wo, albedo, roughness, f0, n, offset,
                              first, samples, bounces, seed, strategy);
            relight(in, rgb.mutable_data(), threads);
        });
}

}  // namespace

void bind_visibility_ops(py::module_& m) {
    bind_scene(m);
    bind_integrator(m);
}

}  // namespace univoxel
