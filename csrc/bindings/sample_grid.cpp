#include <memory>
#include <utility>

#include "bindings/grids.h"
#include "dense_grid.h"
#include "sparse_grid.h"

namespace univoxel {
namespace {

template <class T, class Nodes>
Sampling<T, Nodes> sampling_of(const Grid<Nodes>& grid, In<T> sdf, In<T> features, In<T> points,
                               In<int32_t> order) {
    const int64_t n = points.shape(0);
    require(order.size() == n, "sample_grid: order and points differ in length");
    require(has_rows(grid, sdf.size()), "sample_grid: sdf does not belong to this grid");
    return make<Sampling<T, Nodes>>(sdf, features, points, order, grid.lattice, grid.nodes,
                                    sdf.size(), n, features.shape(sdf.ndim()));
}

using Columns = std::vector<std::vector<CellColumn>>;

std::unique_ptr<TouchedRows> touched(const Grid<DenseNodes>& grid, int64_t, const Columns& columns,
                                     bool wide, int threads) {
    return std::make_unique<TouchedRows>(grid.lattice, columns, wide, threads);
}
std::unique_ptr<RowSet> touched(const Grid<BrickNodes>& grid, int64_t n_rows,
                                const Columns& columns, bool wide, int threads) {
    return std::make_unique<RowSet>(
        touched_brick_rows(grid.lattice, grid.nodes, n_rows, columns, wide, threads));
}

template <class T, class Nodes, class Rows>
void bind_sampling(py::module_& m) {
    def(m, "sample_grid_forward", "grid sdf features points order value gradient feature threads",
        [](const Grid<Nodes>& grid, In<T> sdf, In<T> features, In<T> points, Out<int32_t> order,
           Out<T> value, Out<T> gradient, Out<T> feature, int threads) {
            const auto in = sampling_of(grid, sdf, features, points, order);
            sort_by_tile(in.lattice, in.points, in.n_points, order.mutable_data(), threads);
            sample_grid_forward(in, value.mutable_data(), gradient.mutable_data(),
                                feature.mutable_data(), threads);
        });
    def(m, "sample_grid_backward",
        "grid sdf features points order grad_value grad_gradient grad_feature grad_sdf "
        "grad_features grad_points sdf_rows feature_rows threads",
        [](const Grid<Nodes>& grid, In<T> sdf, In<T> features, In<T> points, In<int32_t> order,
           In<T> grad_value, In<T> grad_gradient, In<T> grad_feature, OptionalOut<T> grad_sdf,
           OptionalOut<T> grad_features, OptionalOut<T> grad_points, const Rows* sdf_rows,
           const Rows* feature_rows, int threads) {
            const auto in = sampling_of(grid, sdf, features, points, order);
            const auto grads =
                make<SamplingGrads<T, Rows>>(grad_value, grad_gradient, grad_feature, grad_sdf,
                                             grad_features, grad_points, sdf_rows, feature_rows);
            sample_grid_backward(in, grads, threads);
        });
    def(m, "sort_by_tile", "grid points order threads",
        [](const Grid<Nodes>& grid, In<T> points, Out<int32_t> order, int threads) {
            require(order.size() == points.shape(0), "sort_by_tile: order of another length");
            sort_by_tile(grid.lattice, points.data(), order.size(), order.mutable_data(), threads);
        });
    def(m, "touched_rows", "grid points order n_rows sdf features threads",
        [](const Grid<Nodes>& grid, In<T> points, In<int32_t> order, int64_t n_rows, bool sdf,
           bool features, int threads) {
            const Lattice& lattice = grid.lattice;
            const auto bounds = slab_bounds(lattice, points.data(), order.size(), order.data());
            const auto columns =
                occupied_columns(lattice, points.data(), order.data(), bounds, threads);
            const auto rows = [&](bool wanted, bool wide) {
                return wanted ? touched(grid, n_rows, columns, wide, threads) : nullptr;
            };
            return std::pair(rows(sdf, true), rows(features, false));
        });
}

/// Rows that some points touch; `write` puts where they are into an array [dimensions, rows].
template <class Rows, class Write>
void bind_rows(py::module_& m, const char* name, int64_t dimensions, Write write) {
    py::class_<Rows> rows(m, name);
    rows.def("__len__", &Rows::count);
    def(rows, "write", "indices threads",
        [dimensions, write](const Rows& touched, Out<int64_t> indices, int threads) {
            require(indices.size() == dimensions * touched.count(),
                    "touched_rows: indices of another size");
            (touched.*write)(indices.mutable_data(), team_for(touched.count(), threads));
        });
}

}  // namespace

void bind_grid_ops(py::module_& m) {
    py::class_<Grid<DenseNodes>> dense(m, "DenseGrid");
    def_init(dense, "size origin voxel_size",
             [](const Size3& size, const Vec3& origin, double voxel_size) {
                 return Grid<DenseNodes>{lattice_of(size, origin, voxel_size), {size[1], size[2]}};
             });
    py::class_<Grid<BrickNodes>> sparse(m, "SparseGrid");
    def_init(
        sparse, "table size origin voxel_size",
        [](In<int32_t> table, const Size3& size, const Vec3& origin, double voxel_size) {
            return Grid<BrickNodes>{lattice_of(size, origin, voxel_size),
                                    brick_nodes_of(table, size)};
        },
        py::keep_alive<1, 2>());  // the table
    bind_rows<TouchedRows>(m, "TouchedRows", 3, &TouchedRows::write_indices);
    bind_rows<RowSet>(m, "RowSet", 1, &RowSet::write_rows);
    bind_sampling<float, DenseNodes, TouchedRows>(m);
    bind_sampling<double, DenseNodes, TouchedRows>(m);
    bind_sampling<float, BrickNodes, RowSet>(m);
    bind_sampling<double, BrickNodes, RowSet>(m);
}

}  // namespace univoxel
