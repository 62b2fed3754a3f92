#include "dense_grid.h"

#include <pybind11/stl.h>

#include <array>
#include <memory>
#include <optional>
#include <utility>

#include "bindings/grids.h"
#include "tiles.h"

namespace univoxel {
namespace {

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
            {sdf.shape(1), sdf.shape(2)},
            sdf.size(),
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
            sort_by_tile(in.lattice, in.points, in.n_points, o, threads);
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
        [](const array<T>& points, const array<int32_t>& order, const Size3& size,
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

}  // namespace

void bind_dense_grid_ops(py::module_& m) {
    bind_touched_rows(m);
    bind_dense_grid<float>(m);
    bind_dense_grid<double>(m);
}

}  // namespace univoxel
