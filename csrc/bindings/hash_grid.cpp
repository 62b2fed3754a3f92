#include "hash_grid.h"

#include "bindings/grids.h"

namespace univoxel {
namespace {

template <class T>
HashGrid<T> hash_grid_of(In<T> table, In<T> points, Sizes sizes, const Vec3& origin,
                         Numbers voxel_sizes) {
    const int64_t levels = static_cast<int64_t>(sizes.size());
    require(levels > 0 && table.shape(0) % levels == 0,
            "encode_hash: levels and rows do not fit together");
    return {table.data(),
            points.data(),
            levels_of(sizes, origin, voxel_sizes),
            table.shape(0) / levels,
            points.shape(0),
            table.shape(1)};
}

template <class T>
void bind_hash_grid(py::module_& m) {
    def(m, "encode_hash_forward", "table points out sizes origin voxel_sizes threads",
        [](In<T> table, In<T> points, Out<T> out, Sizes sizes, const Vec3& origin,
           Numbers voxel_sizes, int threads) {
            const auto in = hash_grid_of(table, points, sizes, origin, voxel_sizes);
            encode_hash_forward(in, out.mutable_data(), threads);
        });
    def(m, "hash_rows", "table points sizes origin voxel_sizes threads",
        [](In<T> table, In<T> points, Sizes sizes, const Vec3& origin, Numbers voxel_sizes,
           int threads) {
            const auto in = hash_grid_of(table, points, sizes, origin, voxel_sizes);
            return HashRows::touched(in, threads);
        });
    def(m, "encode_hash_backward",
        "table points grad_out grad_table touched grad_points sizes origin voxel_sizes felt "
        "threads",
        [](In<T> table, In<T> points, In<T> grad_out, OptionalOut<T> grad_table,
           const HashRows* touched, OptionalOut<T> grad_points, Sizes sizes, const Vec3& origin,
           Numbers voxel_sizes, int64_t felt, int threads) {
            const auto in = hash_grid_of(table, points, sizes, origin, voxel_sizes);
            require(felt >= 0 && felt <= in.n_levels(), "encode_hash: felt out of range");
            encode_hash_backward(in, grad_out.data(), raw(grad_table), touched, raw(grad_points),
                                 felt, threads);
        });
}

}  // namespace

void bind_hash_grid_ops(py::module_& m) {
    py::class_<HashRows> rows(m, "HashRows");
    rows.def("__len__", &HashRows::count);
    def(rows, "write", "rows threads", [](const HashRows& touched, Out<int64_t> rows, int threads) {
        require(rows.size() == touched.count(), "hash_rows: rows of another size");
        touched.write(rows.mutable_data(), threads);
    });
    bind_hash_grid<float>(m);
    bind_hash_grid<double>(m);
}

}  // namespace univoxel
