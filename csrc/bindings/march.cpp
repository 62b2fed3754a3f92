#include "march.h"

#include <pybind11/stl.h>

#include <array>
#include <optional>

#include "bindings/grids.h"

namespace univoxel {
namespace {

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
        "sparse_brick_minimum",
        [](const array<T>& sdf, const array<int32_t>& table, const array<int32_t>& place,
           const Size3& size, array<T>& out, int threads) {
            const BrickNodes nodes = brick_nodes_of(table, size);
            require(out.size() == place.size(), "brick_minimum: out of another size");
            T* o = out.mutable_data();
            py::gil_scoped_release nogil;
            sparse_brick_minimum(sdf.data(), size.data(), nodes, place.data(), place.size(), o,
                                 threads);
        },
        py::arg("sdf").noconvert(), py::arg("table").noconvert(), py::arg("place").noconvert(),
        py::arg("size"), py::arg("out").noconvert(), py::arg("threads"));
    m.def(
        "march",
        [](const array<T>& sdf, const array<T>& brick_min, const array<T>& origin,
           const array<T>& direction, const array<T>& jitter, std::array<double, 3> grid_origin,
           double voxel_size, double step, double inv_s, double min_weight, double early_stop,
           std::optional<array<int32_t>> table, const Size3& size, int threads) {
            March<T> in{sdf.data(),    brick_min.data(),
                        origin.data(), direction.data(),
                        jitter.data(), {size[0], size[1], size[2]},
                        jitter.size(), {T(grid_origin[0]), T(grid_origin[1]), T(grid_origin[2])},
                        T(voxel_size), T(step),
                        T(inv_s),      T(min_weight),
                        T(early_stop)};
            if (table) {
                const BrickNodes nodes = brick_nodes_of(*table, size);
                in.table = nodes.table, in.bricks_y = nodes.bricks_y, in.bricks_z = nodes.bricks_z;
                require(brick_min.size() * kBrickNodes == sdf.size(),
                        "march: brick_min does not belong to this sdf");
            } else {
                for (int a = 0; a < 3; ++a)
                    require(brick_min.shape(a) == bricks_along(size[a]),
                            "march: brick_min does not belong to this sdf");
            }
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
        py::arg("early_stop"), py::arg("table").noconvert(), py::arg("size"), py::arg("threads"));
}

}  // namespace

void bind_march_ops(py::module_& m) {
    bind_march<float>(m);
    bind_march<double>(m);
}

}  // namespace univoxel
