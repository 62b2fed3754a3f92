#include "march.h"

#include "bindings/grids.h"

namespace univoxel {
namespace {

template <class T>
array<T> array_of(const std::vector<T>& v) {
    return array<T>(v.size(), v.data());
}

template <class T>
void bind_march(py::module_& m) {
    def(m, "brick_minimum", "sdf out threads", [](In<T> sdf, Out<T> out, int threads) {
        const int64_t size[3] = {sdf.shape(0), sdf.shape(1), sdf.shape(2)};
        brick_minimum(sdf.data(), size, out.mutable_data(), threads);
    });
    def(m, "sparse_brick_minimum", "sdf table place size out threads",
        [](In<T> sdf, In<int32_t> table, In<int32_t> place, const Size3& size, Out<T> out,
           int threads) {
            require(out.size() == place.size(), "brick_minimum: out of another size");
            sparse_brick_minimum(sdf.data(), size.data(), brick_nodes_of(table, size), place.data(),
                                 place.size(), out.mutable_data(), threads);
        });
    def(m, "march",
        "sdf brick_min origin direction jitter grid_origin voxel_size step inv_s min_weight "
        "early_stop table size threads",
        [](In<T> sdf, In<T> brick_min, In<T> origin, In<T> direction, In<T> jitter,
           const Vec3& grid_origin, double voxel_size, double step, double inv_s, double min_weight,
           double early_stop, OptionalIn<int32_t> table, const Size3& size, int threads) {
            March<T> in{sdf.data(),    brick_min.data(),
                        origin.data(), direction.data(),
                        jitter.data(), {size[0], size[1], size[2]},
                        jitter.size(), {T(grid_origin[0]), T(grid_origin[1]), T(grid_origin[2])},
                        T(voxel_size), T(step),
                        T(inv_s),      T(min_weight),
                        T(early_stop)};
            bool fits = true;
            if (table) {
                const BrickNodes nodes = brick_nodes_of(*table, size);
                in.table = nodes.table, in.bricks_y = nodes.bricks_y, in.bricks_z = nodes.bricks_z;
                fits = brick_min.size() * kBrickNodes == sdf.size();
            } else {
                for (int a = 0; a < 3; ++a) fits &= brick_min.shape(a) == bricks_along(size[a]);
            }
            require(fits, "march: brick_min does not belong to this sdf");
            const PackedSamples<T> out = march(in, threads);
            py::gil_scoped_acquire gil;
            return py::make_tuple(array_of(out.t), array_of(out.connected), array_of(out.offsets));
        });
}

}  // namespace

void bind_march_ops(py::module_& m) {
    bind_march<float>(m);
    bind_march<double>(m);
}

}  // namespace univoxel
