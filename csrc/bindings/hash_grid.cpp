#include "hash_grid.h"

#include <pybind11/stl.h>

#include <array>
#include <optional>
#include <vector>

#include "bindings/common.h"

namespace univoxel {
namespace {

using Size = std::array<int64_t, 3>;

template <class T>
HashGrid<T> hash_grid_of(const array<T>& table, const array<T>& points,
                         const std::vector<Size>& sizes, const std::array<double, 3>& origin,
                         const std::vector<double>& voxel_sizes) {
    const int64_t levels = static_cast<int64_t>(sizes.size());
    require(levels > 0 && voxel_sizes.size() == sizes.size() && table.shape(0) % levels == 0,
            "encode_hash: levels and rows do not fit together");
    HashGrid<T> grid{table.data(),    points.data(), {}, table.shape(0) / levels,
                     points.shape(0), table.shape(1)};
    for (int64_t l = 0; l < levels; ++l) {
        const Size& s = sizes[l];
        require(s[0] > 0 && s[1] > 0 && s[2] > 0, "encode_hash: a level has no nodes");
        grid.levels.push_back(
            {{s[0], s[1], s[2]}, {origin[0], origin[1], origin[2]}, 1 / voxel_sizes[l]});
    }
    return grid;
}

template <class T>
void bind_hash_grid(py::module_& m) {
    using Vec3 = std::array<double, 3>;
    m.def(
        "encode_hash_forward",
        [](const array<T>& table, const array<T>& points, array<T>& out,
           const std::vector<Size>& sizes, const Vec3& origin,
           const std::vector<double>& voxel_sizes, int threads) {
            const auto in = hash_grid_of(table, points, sizes, origin, voxel_sizes);
            T* o = out.mutable_data();
            py::gil_scoped_release nogil;
            encode_hash_forward(in, o, threads);
        },
        py::arg("table").noconvert(), py::arg("points").noconvert(), py::arg("out").noconvert(),
        py::arg("sizes"), py::arg("origin"), py::arg("voxel_sizes"), py::arg("threads"));
    m.def(
        "hash_rows",
        [](const array<T>& table, const array<T>& points, const std::vector<Size>& sizes,
           const Vec3& origin, const std::vector<double>& voxel_sizes, int threads) {
            const auto in = hash_grid_of(table, points, sizes, origin, voxel_sizes);
            py::gil_scoped_release nogil;
            return HashRows::touched(in, threads);
        },
        py::arg("table").noconvert(), py::arg("points").noconvert(), py::arg("sizes"),
        py::arg("origin"), py::arg("voxel_sizes"), py::arg("threads"));
    m.def(
        "encode_hash_backward",
        [](const array<T>& table, const array<T>& points, const array<T>& grad_out,
           std::optional<array<T>> grad_table, const HashRows* touched,
           std::optional<array<T>> grad_points, const std::vector<Size>& sizes, const Vec3& origin,
           const std::vector<double>& voxel_sizes, int threads) {
            const auto in = hash_grid_of(table, points, sizes, origin, voxel_sizes);
            const T* g = grad_out.data();
            T* t = grad_table ? grad_table->mutable_data() : nullptr;
            T* p = grad_points ? grad_points->mutable_data() : nullptr;
            py::gil_scoped_release nogil;
            encode_hash_backward(in, g, t, touched, p, threads);
        },
        py::arg("table").noconvert(), py::arg("points").noconvert(),
        py::arg("grad_out").noconvert(), py::arg("grad_table").noconvert(), py::arg("touched"),
        py::arg("grad_points").noconvert(), py::arg("sizes"), py::arg("origin"),
        py::arg("voxel_sizes"), py::arg("threads"));
}

}  // namespace

void bind_hash_grid_ops(py::module_& m) {
    py::class_<HashRows>(m, "HashRows")
        .def("__len__", &HashRows::count)
        .def(
            "write",
            [](const HashRows& touched, array<int64_t>& rows, int threads) {
                require(rows.size() == touched.count(), "hash_rows: rows of another size");
                int64_t* out = rows.mutable_data();
                py::gil_scoped_release nogil;
                touched.write(out, threads);
            },
            py::arg("rows").noconvert(), py::arg("threads"));
    bind_hash_grid<float>(m);
    bind_hash_grid<double>(m);
}

}  // namespace univoxel
