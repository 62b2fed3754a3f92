#include "sparse_grid.h"

#include <pybind11/stl.h>

#include <memory>
#include <optional>
#include <utility>

#include "bindings/grids.h"

namespace univoxel {
namespace {

template <class T>
SparseGrid<T> sparse_grid_of(const array<T>& sdf, const array<T>& features, const array<T>& points,
                             const array<int32_t>& order, const array<int32_t>& table,
                             const Size3& size, const std::array<double, 3>& origin,
                             double voxel_size) {
    const int64_t n = points.shape(0);
    require(order.size() == n, "sample_sparse: order and points differ in length");
    return {sdf.data(),
            features.data(),
            points.data(),
            order.data(),
            lattice_of(size, origin, voxel_size),
            brick_nodes_of(table, size),
            sdf.size(),
            n,
            features.shape(1)};
}

template <class T>
void bind_sparse_grid(py::module_& m) {
    using Vec3 = std::array<double, 3>;
    m.def(
        "sample_sparse_forward",
        [](const array<T>& sdf, const array<T>& features, const array<T>& points,
           array<int32_t>& order, const array<int32_t>& table, array<T>& value, array<T>& gradient,
           array<T>& feature, const Size3& size, const Vec3& origin, double voxel_size,
           int threads) {
            int32_t* o = order.mutable_data();
            const auto in =
                sparse_grid_of(sdf, features, points, order, table, size, origin, voxel_size);
            T *v = value.mutable_data(), *g = gradient.mutable_data(), *f = feature.mutable_data();
            py::gil_scoped_release nogil;
            sort_by_tile(in.lattice, in.points, in.n_points, o, threads);
            sample_sparse_forward(in, v, g, f, threads);
        },
        py::arg("sdf").noconvert(), py::arg("features").noconvert(), py::arg("points").noconvert(),
        py::arg("order").noconvert(), py::arg("table").noconvert(), py::arg("value").noconvert(),
        py::arg("gradient").noconvert(), py::arg("feature").noconvert(), py::arg("size"),
        py::arg("origin"), py::arg("voxel_size"), py::arg("threads"));
    m.def(
        "sample_sparse_backward",
        [](const array<T>& sdf, const array<T>& features, const array<T>& points,
           const array<int32_t>& order, const array<int32_t>& table, const array<T>& grad_value,
           const array<T>& grad_gradient, const array<T>& grad_feature,
           std::optional<array<T>> grad_sdf, std::optional<array<T>> grad_features,
           std::optional<array<T>> grad_points, const RowSet* sdf_rows, const RowSet* feature_rows,
           const Size3& size, const Vec3& origin, double voxel_size, int threads) {
            const auto in =
                sparse_grid_of(sdf, features, points, order, table, size, origin, voxel_size);
            const auto data = [](auto& a) { return a ? a->mutable_data() : nullptr; };
            const SparseGridGrads<T> grads{
                grad_value.data(), grad_gradient.data(), grad_feature.data(),
                data(grad_sdf),    data(grad_features),  data(grad_points),
                sdf_rows,          feature_rows};
            py::gil_scoped_release nogil;
            sample_sparse_backward(in, grads, threads);
        },
        py::arg("sdf").noconvert(), py::arg("features").noconvert(), py::arg("points").noconvert(),
        py::arg("order").noconvert(), py::arg("table").noconvert(),
        py::arg("grad_value").noconvert(), py::arg("grad_gradient").noconvert(),
        py::arg("grad_feature").noconvert(), py::arg("grad_sdf").noconvert(),
        py::arg("grad_features").noconvert(), py::arg("grad_points").noconvert(),
        py::arg("sdf_rows"), py::arg("feature_rows"), py::arg("size"), py::arg("origin"),
        py::arg("voxel_size"), py::arg("threads"));
    m.def(
        "touched_brick_rows",
        [](const array<T>& points, const array<int32_t>& order, const array<int32_t>& table,
           int64_t n_rows, const Size3& size, const Vec3& origin, double voxel_size, bool sdf,
           bool features, int threads) {
            const Lattice grid = lattice_of(size, origin, voxel_size);
            const BrickNodes nodes = brick_nodes_of(table, size);
            const T* p = points.data();
            const int32_t* o = order.data();
            const int64_t n = order.size();
            py::gil_scoped_release nogil;
            const auto columns = occupied_columns(grid, p, o, slab_bounds(grid, p, n, o), threads);
            const auto rows = [&](bool wanted, bool wide) {
                return wanted ? std::make_unique<RowSet>(
                                    touched_brick_rows(grid, nodes, n_rows, columns, wide, threads))
                              : nullptr;
            };
            return std::pair(rows(sdf, true), rows(features, false));
        },
        py::arg("points").noconvert(), py::arg("order").noconvert(), py::arg("table").noconvert(),
        py::arg("n_rows"), py::arg("size"), py::arg("origin"), py::arg("voxel_size"),
        py::arg("sdf"), py::arg("features"), py::arg("threads"));
}

}  // namespace

void bind_sparse_grid_ops(py::module_& m) {
    py::class_<RowSet>(m, "RowSet")
        .def("__len__", &RowSet::count)
        .def(
            "write_rows",
            [](const RowSet& touched, array<int64_t>& rows, int threads) {
                require(rows.size() == touched.count(), "touched_brick_rows: rows of another size");
                int64_t* out = rows.mutable_data();
                py::gil_scoped_release nogil;
                touched.write_rows(out, team_for(touched.count(), threads));
            },
            py::arg("rows").noconvert(), py::arg("threads"));
    bind_sparse_grid<float>(m);
    bind_sparse_grid<double>(m);
}

}  // namespace univoxel
