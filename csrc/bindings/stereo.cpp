#include "stereo.h"

#include "bindings/common.h"

namespace univoxel {

void bind_stereo_ops(py::module_& m) {
    m.def(
        "match_cost",
        [](const array<int32_t>& pictures, const array<float>& matrix, const array<float>& origin,
           const array<float>& direction, const array<float>& start, const array<float>& color,
           const array<int64_t>& rows, const array<int64_t>& others, array<float>& cost, float step,
           float most, int64_t radius, int64_t best, int threads) {
            const int64_t n = start.size();
            require(rows.shape(0) == pictures.shape(1) && rows.shape(1) == pictures.shape(2),
                    "match_cost: rows must be [H, W]");
            require(origin.size() == 3 * n && direction.size() == 3 * n && color.size() == 3 * n &&
                        cost.shape(0) == n && matrix.size() == 12 * pictures.shape(0),
                    "match_cost: rays differ in number");
            const Match in{pictures.data(),
                           matrix.data(),
                           origin.data(),
                           direction.data(),
                           start.data(),
                           color.data(),
                           rows.data(),
                           others.data(),
                           rows.shape(0),
                           rows.shape(1),
                           n,
                           others.size(),
                           cost.shape(1),
                           step,
                           most,
                           radius,
                           best};
            float* out = cost.mutable_data();
            py::gil_scoped_release nogil;
            match_cost(in, out, threads);
        },
        py::arg("pictures").noconvert(), py::arg("matrix").noconvert(),
        py::arg("origin").noconvert(), py::arg("direction").noconvert(),
        py::arg("start").noconvert(), py::arg("color").noconvert(), py::arg("rows").noconvert(),
        py::arg("others").noconvert(), py::arg("cost").noconvert(), py::arg("step"),
        py::arg("most"), py::arg("radius"), py::arg("best"), py::arg("threads"));
    m.def(
        "semi_global",
        [](const array<float>& cost, const array<int64_t>& rows, array<float>& sum, float small,
           float large, int threads) {
            require(sum.size() == cost.size(), "semi_global: sum must be of cost's size");
            float* out = sum.mutable_data();
            py::gil_scoped_release nogil;
            semi_global(cost.data(), rows.data(), rows.shape(0), rows.shape(1), cost.shape(0),
                        cost.shape(1), small, large, out, threads);
        },
        py::arg("cost").noconvert(), py::arg("rows").noconvert(), py::arg("sum").noconvert(),
        py::arg("small"), py::arg("large"), py::arg("threads"));
}

}  // namespace univoxel
