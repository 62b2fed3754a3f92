// NumPy arrays -> structs of pointers, with the GIL released. No mathematics here.
//
// Every array argument is noconvert: pybind11 would otherwise copy an array of another dtype or
// stride, fill the copy and drop it. The Python side checks shapes; here only extents that a wrong
// call would overrun.
#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include <array>
#include <memory>
#include <optional>
#include <stdexcept>
#include <string>
#include <utility>
#include <variant>

#include "adam.h"
#include "bricks.h"
#include "composite.h"
#include "dense_grid.h"
#include "march.h"
#include "sg.h"
#include "shade.h"
#include "smooth.h"
#include "visibility.h"

namespace py = pybind11;
using namespace univoxel;

namespace {

template <class T>
using array = py::array_t<T, py::array::c_style>;

void require(bool ok, const std::string& message) {
    if (!ok) throw std::invalid_argument(message);
}

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

template <class T>
void bind_march(py::module_& m) {
    m.def(
        "brick_minimum",
        [](const array<T>& sdf, array<T>& out, int threads) {
            const int64_t size[3] = {sdf.shape(0), sdf.shape(1), sdf.shape(2)};
            T* o = out.mutable_data();
            py::gil_scoped_release nogil;
            brick_minimum(sdf.data(), size, o, threads);
        },
        py::arg("sdf").noconvert(), py::arg("out").noconvert(), py::arg("threads"));
    m.def(
        "march",
        [](const array<T>& sdf, const array<T>& brick_min, const array<T>& origin,
           const array<T>& direction, const array<T>& jitter, std::array<double, 3> grid_origin,
           double voxel_size, double step, double inv_s, double min_weight, double early_stop,
           int threads) {
            const March<T> in{
                sdf.data(),    brick_min.data(),
                origin.data(), direction.data(),
                jitter.data(), {sdf.shape(0), sdf.shape(1), sdf.shape(2)},
                jitter.size(), {T(grid_origin[0]), T(grid_origin[1]), T(grid_origin[2])},
                T(voxel_size), T(step),
                T(inv_s),      T(min_weight),
                T(early_stop)};
            for (int a = 0; a < 3; ++a)
                require(brick_min.shape(a) == bricks_along(sdf.shape(a)),
                        "march: brick_min does not belong to this sdf");
            Marched<T> out;
            {
                py::gil_scoped_release nogil;
                out = march(in, threads);
            }
            const auto owned = [](const auto& v) {
                using V = typename std::decay_t<decltype(v)>::value_type;
                return array<V>(v.size(), v.data());
            };
            return py::make_tuple(owned(out.t), owned(out.connected), owned(out.offsets));
        },
        py::arg("sdf").noconvert(), py::arg("brick_min").noconvert(), py::arg("origin").noconvert(),
        py::arg("direction").noconvert(), py::arg("jitter").noconvert(), py::arg("grid_origin"),
        py::arg("voxel_size"), py::arg("step"), py::arg("inv_s"), py::arg("min_weight"),
        py::arg("early_stop"), py::arg("threads"));
}

template <class T>
void bind_smooth(py::module_& m) {
    m.def(
        "smooth_rows",
        [](array<T>& grid, const array<int64_t>& rows, double amount, int order, int threads) {
            const int64_t size[3] = {grid.shape(0), grid.shape(1), grid.shape(2)};
            const int64_t nodes = size[0] * size[1] * size[2];
            const int64_t* r = rows.data();
            for (int64_t k = 0; k < rows.size(); ++k)
                require(r[k] >= 0 && r[k] < nodes, "smooth_rows: rows must be in [0, " +
                                                       std::to_string(nodes) + "), got " +
                                                       std::to_string(r[k]));
            T* g = grid.mutable_data();
            py::gil_scoped_release nogil;
            smooth_rows(g, size, grid.shape(3), r, rows.size(), T(amount), order, threads);
        },
        py::arg("grid").noconvert(), py::arg("rows").noconvert(), py::arg("amount"),
        py::arg("order"), py::arg("threads"));
}

/// Size [X, Y, Z], origin and voxel size as Python passes them; a size of 0 holds nothing.
Lattice lattice_of(const std::array<int64_t, 3>& size, const std::array<double, 3>& origin,
                   double voxel_size) {
    require(size[0] > 0 && size[1] > 0 && size[2] > 0, "sample_dense: the grid has no nodes");
    return {{size[0], size[1], size[2]}, {origin[0], origin[1], origin[2]}, 1 / voxel_size};
}

template <class T>
DenseGrid<T> dense_grid_of(const array<T>& sdf, const array<T>& features, const array<T>& points,
                           const array<int32_t>& order, const std::array<double, 3>& origin,
                           double voxel_size) {
    const int64_t n = points.shape(0);
    require(order.size() == n, "sample_dense: order and points differ in length");
    return {sdf.data(),
            features.data(),
            points.data(),
            order.data(),
            lattice_of({sdf.shape(0), sdf.shape(1), sdf.shape(2)}, origin, voxel_size),
            n,
            features.shape(3)};
}

template <class T>
void bind_dense_grid(py::module_& m) {
    using Vec3 = std::array<double, 3>;
    m.def(
        "sample_dense_forward",
        [](const array<T>& sdf, const array<T>& features, const array<T>& points,
           array<int32_t>& order, array<T>& value, array<T>& gradient, array<T>& feature,
           const Vec3& origin, double voxel_size, int threads) {
            int32_t* o = order.mutable_data();
            const auto in = dense_grid_of(sdf, features, points, order, origin, voxel_size);
            T *v = value.mutable_data(), *g = gradient.mutable_data(), *f = feature.mutable_data();
            py::gil_scoped_release nogil;
            sort_by_brick(in.lattice, in.points, in.n_points, o, threads);
            sample_dense_forward(in, v, g, f, threads);
        },
        py::arg("sdf").noconvert(), py::arg("features").noconvert(), py::arg("points").noconvert(),
        py::arg("order").noconvert(), py::arg("value").noconvert(), py::arg("gradient").noconvert(),
        py::arg("feature").noconvert(), py::arg("origin"), py::arg("voxel_size"),
        py::arg("threads"));
    m.def(
        "sample_dense_backward",
        [](const array<T>& sdf, const array<T>& features, const array<T>& points,
           const array<int32_t>& order, const array<T>& grad_value, const array<T>& grad_gradient,
           const array<T>& grad_feature, std::optional<array<T>> grad_sdf,
           std::optional<array<T>> grad_features, std::optional<array<T>> grad_points,
           const TouchedRows* sdf_rows, const TouchedRows* feature_rows, const Vec3& origin,
           double voxel_size, int threads) {
            const auto in = dense_grid_of(sdf, features, points, order, origin, voxel_size);
            const auto data = [](auto& a) { return a ? a->mutable_data() : nullptr; };
            const DenseGridGrads<T> grads{
                grad_value.data(), grad_gradient.data(), grad_feature.data(),
                data(grad_sdf),    data(grad_features),  data(grad_points),
                sdf_rows,          feature_rows};
            py::gil_scoped_release nogil;
            sample_dense_backward(in, grads, threads);
        },
        py::arg("sdf").noconvert(), py::arg("features").noconvert(), py::arg("points").noconvert(),
        py::arg("order").noconvert(), py::arg("grad_value").noconvert(),
        py::arg("grad_gradient").noconvert(), py::arg("grad_feature").noconvert(),
        py::arg("grad_sdf").noconvert(), py::arg("grad_features").noconvert(),
        py::arg("grad_points").noconvert(), py::arg("sdf_rows"), py::arg("feature_rows"),
        py::arg("origin"), py::arg("voxel_size"), py::arg("threads"));
    m.def(
        "touched_rows",
        [](const array<T>& points, const array<int32_t>& order, const std::array<int64_t, 3>& size,
           const Vec3& origin, double voxel_size, bool sdf, bool features, int threads) {
            const Lattice grid = lattice_of(size, origin, voxel_size);
            const T* p = points.data();
            const int32_t* o = order.data();
            const int64_t n = order.size();
            py::gil_scoped_release nogil;
            const auto columns = occupied_columns(grid, p, o, slab_bounds(grid, p, n, o), threads);
            const auto rows = [&](bool wanted, bool wide) {
                return wanted ? std::make_unique<TouchedRows>(grid, columns, wide, threads)
                              : nullptr;
            };
            return std::pair(rows(sdf, true), rows(features, false));
        },
        py::arg("points").noconvert(), py::arg("order").noconvert(), py::arg("size"),
        py::arg("origin"), py::arg("voxel_size"), py::arg("sdf"), py::arg("features"),
        py::arg("threads"));
}

void bind_touched_rows(py::module_& m) {
    py::class_<TouchedRows>(m, "TouchedRows")
        .def("__len__", &TouchedRows::count)
        .def(
            "write_indices",
            [](const TouchedRows& rows, array<int64_t>& indices, int threads) {
                require(indices.size() == 3 * rows.count(),
                        "touched_rows: indices of another size");
                int64_t* out = indices.mutable_data();
                py::gil_scoped_release nogil;
                rows.write_indices(out, threads);
            },
            py::arg("indices").noconvert(), py::arg("threads"));
}

template <class T>
void bind_adam(py::module_& m) {
    m.def(
        "adam_rows",
        [](array<T>& param, array<T>& exp_avg, array<T>& exp_avg_sq, const array<int64_t>& rows,
           const array<T>& grad, double lr, double beta1, double beta2, double eps, double step,
           int threads) {
            const int64_t n = param.shape(0), k = rows.size();
            const int64_t* r = rows.data();
            bool ok = true;
            for (int64_t i = 0; i < k; ++i) ok &= r[i] >= 0 && r[i] < n;
            require(ok, "adam_rows_: rows must lie in [0, R=" + std::to_string(n) + ")");
            const AdamRows<T> in{param.mutable_data(),
                                 exp_avg.mutable_data(),
                                 exp_avg_sq.mutable_data(),
                                 r,
                                 grad.data(),
                                 k,
                                 param.shape(1),
                                 lr,
                                 beta1,
                                 beta2,
                                 eps,
                                 step};
            py::gil_scoped_release nogil;
            adam_rows(in, threads);
        },
        py::arg("param").noconvert(), py::arg("exp_avg").noconvert(),
        py::arg("exp_avg_sq").noconvert(), py::arg("rows").noconvert(), py::arg("grad").noconvert(),
        py::arg("lr"), py::arg("beta1"), py::arg("beta2"), py::arg("eps"), py::arg("step"),
        py::arg("threads"));
}

template <class T>
ShadeSG<T> shade_sg_of(const array<T>& axis, const array<T>& sharpness, const array<T>& amplitude,
                       const array<T>& normal, const array<T>& wo, const array<T>& albedo,
                       const array<T>& roughness, const array<T>& directions,
                       const array<T>& rotation, double f0) {
    const int64_t n = rotation.size(), k = n ? sharpness.size() / n : 0;
    require(axis.size() == 3 * n * k && sharpness.size() == n * k &&
                amplitude.size() == 3 * n * k && normal.size() == 3 * n && wo.size() == 3 * n &&
                albedo.size() == 3 * n && roughness.size() == n && directions.size() % 3 == 0,
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
            n,
            k,
            directions.size() / 3,
            T(f0)};
}

template <class T>
void bind_sg(py::module_& m) {
    m.def(
        "shade_sg_forward",
        [](const array<T>& axis, const array<T>& sharpness, const array<T>& amplitude,
           const array<T>& normal, const array<T>& wo, const array<T>& albedo,
           const array<T>& roughness, const array<T>& directions, const array<T>& rotation,
           array<T>& rgb, double f0, int threads) {
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
        py::arg("rgb").noconvert(), py::arg("f0"), py::arg("threads"));
    m.def(
        "shade_sg_backward",
        [](const array<T>& axis, const array<T>& sharpness, const array<T>& amplitude,
           const array<T>& normal, const array<T>& wo, const array<T>& albedo,
           const array<T>& roughness, const array<T>& directions, const array<T>& rotation,
           const array<T>& grad_rgb, array<T>& grad_axis, array<T>& grad_sharpness,
           array<T>& grad_amplitude, array<T>& grad_normal, array<T>& grad_wo,
           array<T>& grad_albedo, array<T>& grad_roughness, double f0, int threads) {
            const auto in = shade_sg_of(axis, sharpness, amplitude, normal, wo, albedo, roughness,
                                        directions, rotation, f0);
            const ShadeSGGrad<T> grad{grad_axis.mutable_data(),      grad_sharpness.mutable_data(),
                                      grad_amplitude.mutable_data(), grad_normal.mutable_data(),
                                      grad_wo.mutable_data(),        grad_albedo.mutable_data(),
                                      grad_roughness.mutable_data()};
            py::gil_scoped_release nogil;
            shade_sg_backward(in, grad_rgb.data(), grad, threads);
        },
        py::arg("axis").noconvert(), py::arg("sharpness").noconvert(),
        py::arg("amplitude").noconvert(), py::arg("normal").noconvert(), py::arg("wo").noconvert(),
        py::arg("albedo").noconvert(), py::arg("roughness").noconvert(),
        py::arg("directions").noconvert(), py::arg("rotation").noconvert(),
        py::arg("grad_rgb").noconvert(), py::arg("grad_axis").noconvert(),
        py::arg("grad_sharpness").noconvert(), py::arg("grad_amplitude").noconvert(),
        py::arg("grad_normal").noconvert(), py::arg("grad_wo").noconvert(),
        py::arg("grad_albedo").noconvert(), py::arg("grad_roughness").noconvert(), py::arg("f0"),
        py::arg("threads"));
}

template <class T>
Shade<T> shade_of(const char* op, const array<T>& normal, const array<T>& wo,
                  const array<T>& albedo, const array<T>& roughness, const array<T>& directions,
                  double solid_angle, double f0) {
    const int64_t n = roughness.size();
    require(normal.size() == 3 * n && wo.size() == 3 * n && albedo.size() == 3 * n &&
                directions.size() % 3 == 0,
            std::string(op) + ": sizes do not fit");
    return {normal.data(),         wo.data(),         albedo.data(),
            roughness.data(),      directions.data(), n,
            directions.size() / 3, T(solid_angle),    T(f0)};
}

/// An empty array of the light's gradient means that nobody asks for it.
template <class T>
ShadeGrad<T> shade_grad_of(array<T>& light, array<T>& albedo, array<T>& roughness) {
    return {light.size() ? light.mutable_data() : nullptr, albedo.mutable_data(),
            roughness.mutable_data()};
}

template <class T>
void bind_shade_radiance(py::module_& m) {
    m.def(
        "shade_radiance_forward",
        [](const array<T>& radiance, const array<T>& normal, const array<T>& wo,
           const array<T>& albedo, const array<T>& roughness, const array<T>& directions,
           array<T>& rgb, double solid_angle, double f0, int threads) {
            const auto in = shade_of("shade_radiance", normal, wo, albedo, roughness, directions,
                                     solid_angle, f0);
            require(radiance.size() == 3 * in.n_samples * in.n_directions,
                    "shade_radiance: radiance of another size");
            const T* light = radiance.data();
            T* out = rgb.mutable_data();
            py::gil_scoped_release nogil;
            shade_radiance_forward(in, light, out, threads);
        },
        py::arg("radiance").noconvert(), py::arg("normal").noconvert(), py::arg("wo").noconvert(),
        py::arg("albedo").noconvert(), py::arg("roughness").noconvert(),
        py::arg("directions").noconvert(), py::arg("rgb").noconvert(), py::arg("solid_angle"),
        py::arg("f0"), py::arg("threads"));
    m.def(
        "shade_radiance_backward",
        [](const array<T>& radiance, const array<T>& normal, const array<T>& wo,
           const array<T>& albedo, const array<T>& roughness, const array<T>& directions,
           const array<T>& grad_rgb, array<T>& grad_radiance, array<T>& grad_albedo,
           array<T>& grad_roughness, double solid_angle, double f0, int threads) {
            const auto in = shade_of("shade_radiance", normal, wo, albedo, roughness, directions,
                                     solid_angle, f0);
            require(radiance.size() == 3 * in.n_samples * in.n_directions,
                    "shade_radiance: radiance of another size");
            const auto grad = shade_grad_of(grad_radiance, grad_albedo, grad_roughness);
            const T *light = radiance.data(), *from = grad_rgb.data();
            py::gil_scoped_release nogil;
            shade_radiance_backward(in, light, from, grad, threads);
        },
        py::arg("radiance").noconvert(), py::arg("normal").noconvert(), py::arg("wo").noconvert(),
        py::arg("albedo").noconvert(), py::arg("roughness").noconvert(),
        py::arg("directions").noconvert(), py::arg("grad_rgb").noconvert(),
        py::arg("grad_radiance").noconvert(), py::arg("grad_albedo").noconvert(),
        py::arg("grad_roughness").noconvert(), py::arg("solid_angle"), py::arg("f0"),
        py::arg("threads"));
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
           array<T>& rgb, double solid_angle, double f0, int threads) {
            const auto in =
                shade_of("shade_map", normal, wo, albedo, roughness, directions, solid_angle, f0);
            const auto light = map_light_of(in, map, visibility, indirect, index);
            T* out = rgb.mutable_data();
            py::gil_scoped_release nogil;
            shade_map_forward(in, light, out, threads);
        },
        py::arg("map").noconvert(), py::arg("visibility").noconvert(),
        py::arg("indirect").noconvert(), py::arg("index").noconvert(),
        py::arg("normal").noconvert(), py::arg("wo").noconvert(), py::arg("albedo").noconvert(),
        py::arg("roughness").noconvert(), py::arg("directions").noconvert(),
        py::arg("rgb").noconvert(), py::arg("solid_angle"), py::arg("f0"), py::arg("threads"));
    m.def(
        "shade_map_backward",
        [](const array<T>& map, const Fractions<T>& visibility, const Halves<T>& indirect,
           const array<int64_t>& index, const array<T>& normal, const array<T>& wo,
           const array<T>& albedo, const array<T>& roughness, const array<T>& directions,
           const array<T>& grad_rgb, array<T>& grad_map, array<T>& grad_albedo,
           array<T>& grad_roughness, double solid_angle, double f0, int threads) {
            const auto in =
                shade_of("shade_map", normal, wo, albedo, roughness, directions, solid_angle, f0);
            const auto light = map_light_of(in, map, visibility, indirect, index);
            const auto grad = shade_grad_of(grad_map, grad_albedo, grad_roughness);
            const T* from = grad_rgb.data();
            py::gil_scoped_release nogil;
            shade_map_backward(in, light, from, grad, threads);
        },
        py::arg("map").noconvert(), py::arg("visibility").noconvert(),
        py::arg("indirect").noconvert(), py::arg("index").noconvert(),
        py::arg("normal").noconvert(), py::arg("wo").noconvert(), py::arg("albedo").noconvert(),
        py::arg("roughness").noconvert(), py::arg("directions").noconvert(),
        py::arg("grad_rgb").noconvert(), py::arg("grad_map").noconvert(),
        py::arg("grad_albedo").noconvert(), py::arg("grad_roughness").noconvert(),
        py::arg("solid_angle"), py::arg("f0"), py::arg("threads"));
}

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

}  // namespace

PYBIND11_MODULE(_core, m) {
    m.doc() = "Native kernels of univoxel: plain functions over contiguous buffers.";
    bind_composite<float>(m);
    bind_composite<double>(m);
    bind_march<float>(m);
    bind_march<double>(m);
    bind_smooth<float>(m);
    bind_smooth<double>(m);
    bind_touched_rows(m);
    bind_dense_grid<float>(m);
    bind_dense_grid<double>(m);
    bind_adam<float>(m);
    bind_adam<double>(m);
    bind_sg<float>(m);
    bind_sg<double>(m);
    bind_shade_radiance<float>(m);
    bind_shade_radiance<double>(m);
    bind_shade_map<float>(m);
    bind_shade_map<double>(m);
    bind_visibility(m);
}
