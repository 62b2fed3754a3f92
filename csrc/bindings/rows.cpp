#include <pybind11/stl.h>

#include <string>

#include "adam.h"
#include "bindings/grids.h"
#include "diffuse.h"
#include "smooth.h"

namespace univoxel {
namespace {

template <class T>
void bind_adam(py::module_& m) {
    m.def(
        "adam_rows",
        [](array<T>& param, array<T>& exp_avg, array<T>& exp_avg_sq, const array<int64_t>& rows,
           const array<T>& grad, double lr, double beta1, double beta2, double eps, double step,
           int threads) {
            const int64_t n = param.shape(0), k = rows.size();
            const int64_t* r = rows.data();
            bool ok = true;
            for (int64_t i = 0; i < k; ++i) ok &= r[i] >= 0 && r[i] < n;
            require(ok, "adam_rows_: rows must lie in [0, R=" + std::to_string(n) + ")");
            const AdamRows<T> in{param.mutable_data(),
                                 exp_avg.mutable_data(),
                                 exp_avg_sq.mutable_data(),
                                 r,
                                 grad.data(),
                                 k,
                                 param.shape(1),
                                 lr,
                                 beta1,
                                 beta2,
                                 eps,
                                 step};
            py::gil_scoped_release nogil;
            adam_rows(in, threads);
        },
        py::arg("param").noconvert(), py::arg("exp_avg").noconvert(),
        py::arg("exp_avg_sq").noconvert(), py::arg("rows").noconvert(), py::arg("grad").noconvert(),
        py::arg("lr"), py::arg("beta1"), py::arg("beta2"), py::arg("eps"), py::arg("step"),
        py::arg("threads"));
}

template <class T>
void bind_smooth(py::module_& m) {
    m.def(
        "smooth_rows",
        [](array<T>& grid, const array<int64_t>& rows, double amount, int order, int threads) {
            const int64_t size[3] = {grid.shape(0), grid.shape(1), grid.shape(2)};
            const int64_t nodes = size[0] * size[1] * size[2];
            const int64_t* r = rows.data();
            const int64_t n = rows.size();
            bool ok = true;
            for (int64_t k = 0; k < n; ++k) ok &= r[k] >= 0 && r[k] < nodes;
            require(ok, "smooth_rows_: rows must lie in [0, " + std::to_string(nodes) + ")");
            T* g = grid.mutable_data();
            py::gil_scoped_release nogil;
            smooth_rows(g, size, grid.shape(3), r, n, T(amount), order, threads);
        },
        py::arg("grid").noconvert(), py::arg("rows").noconvert(), py::arg("amount"),
        py::arg("order"), py::arg("threads"));
    m.def(
        "smooth_brick_rows",
        [](array<T>& grid, const array<int32_t>& table, const array<int32_t>& place,
           const Size3& size, const array<int64_t>& rows, double amount, int order, int threads) {
            const BrickNodes nodes = brick_nodes_of(table, size);
            const int64_t* r = rows.data();
            const int64_t n = rows.size(), end = grid.shape(0);
            bool ok = true;
            const int32_t* stands = place.data();
            for (int64_t k = 0; k < n; ++k)
                ok = ok && r[k] >= 0 && r[k] < end && stands[r[k] / kBrickNodes] >= 0;
            require(ok, "smooth_rows_: rows must be of bricks that stand somewhere, in [" +
                            std::to_string(kMissingRows) + ", " + std::to_string(end) + ")");
            T* g = grid.mutable_data();
            py::gil_scoped_release nogil;
            smooth_brick_rows(g, size.data(), nodes, stands, grid.shape(1), r, n, T(amount), order,
                              threads);
        },
        py::arg("grid").noconvert(), py::arg("table").noconvert(), py::arg("place").noconvert(),
        py::arg("size"), py::arg("rows").noconvert(), py::arg("amount"), py::arg("order"),
        py::arg("threads"));
}

/// Rows [n] in [first, end), each above the one before.
void require_ascending(const int64_t* rows, int64_t n, int64_t first, int64_t end) {
    bool ok = n == 0 || (rows[0] >= first && rows[n - 1] < end);
    for (int64_t k = 1; k < n; ++k) ok &= rows[k - 1] < rows[k];
    require(ok, "diffuse_rows_: rows must ascend in [" + std::to_string(first) + ", " +
                    std::to_string(end) + ")");
}

template <class T>
void bind_diffuse(py::module_& m) {
    m.def(
        "diffuse_rows",
        [](array<T>& values, const Size3& size, const array<int64_t>& rows, double amount,
           int passes, int threads) {
            T* v = values.mutable_data();
            const int64_t* r = rows.data();
            const int64_t n = rows.size();
            require_ascending(r, n, 0, size[0] * size[1] * size[2]);
            py::gil_scoped_release nogil;
            diffuse_rows(v, size.data(), r, n, T(amount), passes, threads);
        },
        py::arg("values").noconvert(), py::arg("size"), py::arg("rows").noconvert(),
        py::arg("amount"), py::arg("passes"), py::arg("threads"));
    m.def(
        "diffuse_brick_rows",
        [](array<T>& values, const array<int32_t>& table, const array<int32_t>& place,
           const Size3& size, const array<int64_t>& rows, double amount, int passes, int threads) {
            const BrickNodes nodes = brick_nodes_of(table, size);
            T* v = values.mutable_data();
            const int32_t* stands = place.data();
            const int64_t* r = rows.data();
            const int64_t n = rows.size(), end = place.size() * kBrickNodes;
            require_ascending(r, n, kMissingRows, end);
            bool ok = true;
            for (int64_t k = 0; k < n; ++k) ok &= stands[r[k] / kBrickNodes] >= 0;
            require(ok, "diffuse_rows_: rows must be of bricks that stand somewhere");
            py::gil_scoped_release nogil;
            diffuse_brick_rows(v, size.data(), nodes, stands, end, r, n, T(amount), passes,
                               threads);
        },
        py::arg("values").noconvert(), py::arg("table").noconvert(), py::arg("place").noconvert(),
        py::arg("size"), py::arg("rows").noconvert(), py::arg("amount"), py::arg("passes"),
        py::arg("threads"));
}

}  // namespace

void bind_rows_ops(py::module_& m) {
    bind_adam<float>(m);
    bind_adam<double>(m);
    bind_smooth<float>(m);
    bind_smooth<double>(m);
    bind_diffuse<float>(m);
    bind_diffuse<double>(m);
}

}  // namespace univoxel
