#include "composite_field.h"

#include "bindings/grids.h"

namespace univoxel {
namespace {

template <class T, class Nodes>
FieldRays<T, Nodes> rays_of(const Grid<Nodes>& grid, In<T> sdf, In<T> features, Sizes sizes,
                            const Vec3& lower, Numbers voxel_sizes, In<T> origin, In<T> direction,
                            In<T> t, In<bool> connected, In<int64_t> offsets, double inv_s,
                            double min_share) {
    const int64_t *o = offsets.data(), n = offsets.size() - 1;
    require(n >= 0 && o[0] == 0 && o[n] == t.size() && std::is_sorted(o, o + n + 1),
            "composite_field: offsets must rise from 0 to the number of samples (" +
                std::to_string(t.size()) + ")");
    require(origin.size() == 3 * n && direction.size() == 3 * n && connected.size() == t.size(),
            "composite_field: rays, samples and offsets do not fit together");
    require(has_rows(grid, sdf.size()), "composite_field: sdf does not belong to this grid");
    const bool hashed = !sizes.empty();
    const int64_t levels = std::max<int64_t>(1, sizes.size());
    require(!hashed || features.shape(0) % levels == 0,
            "composite_field: levels and rows do not fit together");
    const int64_t width = features.shape(features.ndim() - 1);
    const Sampling<T, Nodes> nodes{sdf.data(),        features.data(), nullptr,    nullptr,
                                   grid.lattice,      grid.nodes,      sdf.size(), 0,
                                   hashed ? 0 : width};
    const HashGrid<T> hash{features.data(),
                           nullptr,
                           levels_of(sizes, lower, voxel_sizes),
                           features.shape(0) / levels,
                           0,
                           width};
    return {nodes, hash, origin.data(), direction.data(), t.data(), connected.data(),
            o,     n,    T(inv_s),      T(min_share)};
}

template <class T, class Nodes>
void bind_composite_field(py::module_& m) {
    def(m, "composite_field_forward",
        "grid sdf features sizes lower voxel_sizes origin direction t connected offsets inv_s "
        "min_share out held threads",
        [](const Grid<Nodes>& grid, In<T> sdf, In<T> features, Sizes sizes, const Vec3& lower,
           Numbers voxel_sizes, In<T> origin, In<T> direction, In<T> t, In<bool> connected,
           In<int64_t> offsets, double inv_s, double min_share, Out<T> out, Out<T> held,
           int threads) {
            const auto in = rays_of(grid, sdf, features, sizes, lower, voxel_sizes, origin,
                                    direction, t, connected, offsets, inv_s, min_share);
            composite_field_forward(in, out.mutable_data(), held.mutable_data(), threads);
        });
    def(m, "composite_field_pulls",
        "grid sdf features sizes lower voxel_sizes origin direction t connected offsets inv_s "
        "min_share held grad_out points feature_points value gradient feature threads",
        [](const Grid<Nodes>& grid, In<T> sdf, In<T> features, Sizes sizes, const Vec3& lower,
           Numbers voxel_sizes, In<T> origin, In<T> direction, In<T> t, In<bool> connected,
           In<int64_t> offsets, double inv_s, double min_share, In<T> held, In<T> grad_out,
           Out<T> points, Out<T> feature_points, Out<T> value, Out<T> gradient, Out<T> feature,
           int threads) {
            const auto in = rays_of(grid, sdf, features, sizes, lower, voxel_sizes, origin,
                                    direction, t, connected, offsets, inv_s, min_share);
            const auto pulls =
                make<FieldPulls<T>>(points, feature_points, value, gradient, feature);
            composite_field_pulls(in, held.data(), grad_out.data(), pulls, threads);
        });
}

}  // namespace

void bind_composite_field_ops(py::module_& m) {
    bind_composite_field<float, DenseNodes>(m);
    bind_composite_field<double, DenseNodes>(m);
    bind_composite_field<float, BrickNodes>(m);
    bind_composite_field<double, BrickNodes>(m);
}

}  // namespace univoxel
