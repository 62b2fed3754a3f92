#include "stereo.h"

#include "bindings/common.h"

namespace univoxel {

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
}

}  // namespace univoxel
