#include "stereo.h"

#include "bindings/common.h"
#include "hull.h"
#include "patches.h"

namespace univoxel {
namespace {

template <class T>
void bind_patch_correlation(py::module_& m) {
    def(m, "patch_correlation",
        "brightness projection origin direction own views position normal correlation seen pulls "
        "noise threads",
        [](const std::variant<array<uint16_t>, array<T>>& brightness, In<T> projection,
           In<T> origin, In<T> direction, In<T> own, In<int64_t> views, In<T> position,
           In<T> normal, Out<T> correlation, Out<uint8_t> seen, Out<T> pulls, double noise,
           int threads) {
            Patches<T> in{{},
                          projection.data(),
                          origin.data(),
                          direction.data(),
                          own.data(),
                          views.data(),
                          position.data(),
                          normal.data(),
                          0,
                          0,
                          0,
                          own.shape(0),
                          own.shape(1),
                          views.shape(1)};
            std::visit(
                [&](const auto& a) {
                    in.brightness = a.data();
                    in.V = a.shape(0), in.H = a.shape(1), in.W = a.shape(2);
                },
                brightness);
            const int64_t n = in.N, k = in.K, v = in.V;
            require(in.H >= 2 && in.W >= 2 && projection.size() == 12 * v &&
                        origin.size() == 3 * n && direction.size() == 9 * n &&
                        views.size() == n * k && position.size() == 3 * n &&
                        normal.size() == 3 * n && correlation.size() == n * k &&
                        seen.size() == n * k && pulls.size() == 6 * n * k,
                    "patch_correlation: sizes do not fit");
            require(all_of<int64_t>(views, [=](int64_t i) { return i >= 0 && i < v; }),
                    "patch_correlation: views must lie in [0, V=" + std::to_string(v) + ")");
            const PatchResult<T> out{correlation.mutable_data(), seen.mutable_data(),
                                     pulls.mutable_data()};
            patch_correlation(in, out, T(noise), threads);
        });
}

/// The points and views of maps [V, H, W].
ViewedPoints viewed(In<float> points, In<float> matrix, In<int32_t> sizes, In<float> maps) {
    require(maps.ndim() == 3 && points.size() % 3 == 0 && matrix.size() == 12 * maps.shape(0) &&
                sizes.size() == 2 * maps.shape(0),
            "points, views and their maps do not fit");
    for (int64_t v = 0; v < maps.shape(0); ++v) {
        const int32_t width = sizes.data()[2 * v], height = sizes.data()[2 * v + 1];
        require(1 <= width && width <= maps.shape(2) && 1 <= height && height <= maps.shape(1),
                "sizes of views must lie in those of their maps");
    }
    return make<ViewedPoints>(points, matrix, sizes, points.size() / 3, maps.shape(0),
                              maps.shape(1), maps.shape(2));
}

}  // namespace

void bind_stereo_ops(py::module_& m) {
    def(m, "match_cost",
        "pictures matrix origin direction start color rows others cost step most radius best "
        "threads",
        [](In<int32_t> pictures, In<float> matrix, In<float> origin, In<float> direction,
           In<float> start, In<float> color, In<int64_t> rows, In<int64_t> others, Out<float> cost,
           float step, float most, int64_t radius, int64_t best, int threads) {
            const int64_t n = start.size();
            require(rows.shape(0) == pictures.shape(1) && rows.shape(1) == pictures.shape(2),
                    "match_cost: rows must be [H, W]");
            require(origin.size() == 3 * n && direction.size() == 3 * n && color.size() == 3 * n &&
                        cost.shape(0) == n && matrix.size() == 12 * pictures.shape(0),
                    "match_cost: rays differ in number");
            const auto in = make<Match>(pictures, matrix, origin, direction, start, color, rows,
                                        others, rows.shape(0), rows.shape(1), n, others.size(),
                                        cost.shape(1), step, most, radius, best);
            match_cost(in, cost.mutable_data(), threads);
        });
    def(m, "semi_global", "cost rows sum small large threads",
        [](In<float> cost, In<int64_t> rows, Out<float> sum, float small, float large,
           int threads) {
            require(sum.size() == cost.size(), "semi_global: sum must be of cost's size");
            semi_global(cost.data(), rows.data(), rows.shape(0), rows.shape(1), cost.shape(0),
                        cost.shape(1), small, large, sum.mutable_data(), threads);
        });
    def(m, "hull_sdf", "points matrix sizes distance uncut focal sdf votes seen_by wider threads",
        [](In<float> points, In<float> matrix, In<int32_t> sizes, In<float> distance,
           In<uint8_t> uncut, In<float> focal, Out<float> sdf, int64_t votes, int64_t seen_by,
           float wider, int threads) {
            const ViewedPoints in = viewed(points, matrix, sizes, distance);
            require(uncut.size() == in.V && focal.size() == in.V && sdf.size() == in.N,
                    "hull_sdf: sizes do not fit");
            require(votes >= 1, "hull_sdf: votes must be at least 1");
            hull_sdf(in, distance.data(), uncut.data(), focal.data(), votes, seen_by, wider,
                     sdf.mutable_data(), threads);
        });
    def(m, "count_votes", "points matrix sizes mask distance known eye sums band threads",
        [](In<float> points, In<float> matrix, In<int32_t> sizes, In<float> mask,
           In<float> distance, In<uint8_t> known, In<float> eye, Out<float> sums, float band,
           int threads) {
            const ViewedPoints in = viewed(points, matrix, sizes, distance);
            require(mask.size() == distance.size() && known.size() == distance.size() &&
                        eye.size() == 3 * in.V && sums.size() == 7 * in.N,
                    "count_votes: sizes do not fit");
            count_votes(in, mask.data(), distance.data(), known.data(), eye.data(), band,
                        sums.mutable_data(), threads);
        });
    bind_patch_correlation<float>(m);
    bind_patch_correlation<double>(m);
}

}  // namespace univoxel
