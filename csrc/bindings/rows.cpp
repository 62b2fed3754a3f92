#include "adam.h"
#include "bindings/grids.h"
#include "diffuse.h"
#include "smooth.h"

namespace univoxel {
namespace {

std::string range(int64_t first, int64_t end) {
    return "[" + std::to_string(first) + ", " + std::to_string(end) + ")";
}

/// Whether all rows lie in [0, end).
bool inside(In<int64_t> rows, int64_t end) {
    return all_of<int64_t>(rows, [=](int64_t row) { return row >= 0 && row < end; });
}

void require_ascending(In<int64_t> rows, int64_t first, int64_t end) {
    const int64_t *r = rows.data(), n = rows.size();
    const bool inside = n == 0 || (r[0] >= first && r[n - 1] < end);
    require(inside && std::adjacent_find(r, r + n, std::greater_equal<>()) == r + n,
            "diffuse_rows_: rows must ascend in " + range(first, end));
}

/// Whether the bricks of these rows stand somewhere.
bool stand(In<int64_t> rows, In<int32_t> place) {
    const int32_t* p = place.data();
    return all_of<int64_t>(rows, [=](int64_t row) { return p[row / kBrickNodes] >= 0; });
}

template <class T>
void bind_adam(py::module_& m) {
    def(m, "adam_rows", "param exp_avg exp_avg_sq rows grad lr beta1 beta2 eps step threads",
        [](Out<T> param, Out<T> exp_avg, Out<T> exp_avg_sq, In<int64_t> rows, In<T> grad, double lr,
           double beta1, double beta2, double eps, double step, int threads) {
            const int64_t n = param.shape(0);
            require(inside(rows, n),
                    "adam_rows_: rows must lie in [0, R=" + std::to_string(n) + ")");
            const auto in = make<AdamRows<T>>(param, exp_avg, exp_avg_sq, rows, grad, rows.size(),
                                              param.shape(1), lr, beta1, beta2, eps, step);
            adam_rows(in, threads);
        });
}

template <class T>
void bind_smooth(py::module_& m) {
    def(m, "smooth_rows", "grid rows amount order threads",
        [](Out<T> grid, In<int64_t> rows, double amount, int order, int threads) {
            const int64_t size[3] = {grid.shape(0), grid.shape(1), grid.shape(2)};
            const int64_t nodes = size[0] * size[1] * size[2];
            require(inside(rows, nodes), "smooth_rows_: rows must lie in " + range(0, nodes));
            smooth_rows(grid.mutable_data(), size, grid.shape(3), rows.data(), rows.size(),
                        T(amount), order, threads);
        });
    def(m, "smooth_brick_rows", "grid table place size rows amount order threads",
        [](Out<T> grid, In<int32_t> table, In<int32_t> place, const Size3& size, In<int64_t> rows,
           double amount, int order, int threads) {
            const int64_t end = grid.shape(0);
            require(inside(rows, end) && stand(rows, place),
                    "smooth_rows_: rows must be of bricks that stand somewhere, in " +
                        range(kMissingRows, end));
            smooth_brick_rows(grid.mutable_data(), size.data(), brick_nodes_of(table, size),
                              place.data(), grid.shape(1), rows.data(), rows.size(), T(amount),
                              order, threads);
        });
}

template <class T>
void bind_diffuse(py::module_& m) {
    def(m, "diffuse_rows", "values size rows amount passes threads",
        [](Out<T> values, const Size3& size, In<int64_t> rows, double amount, int passes,
           int threads) {
            require_ascending(rows, 0, size[0] * size[1] * size[2]);
            diffuse_rows(values.mutable_data(), size.data(), rows.data(), rows.size(), T(amount),
                         passes, threads);
        });
    def(m, "diffuse_brick_rows", "values table place size rows amount passes threads",
        [](Out<T> values, In<int32_t> table, In<int32_t> place, const Size3& size, In<int64_t> rows,
           double amount, int passes, int threads) {
            const int64_t end = place.size() * kBrickNodes;
            require_ascending(rows, kMissingRows, end);
            require(stand(rows, place),
                    "diffuse_rows_: rows must be of bricks that stand somewhere");
            diffuse_brick_rows(values.mutable_data(), size.data(), brick_nodes_of(table, size),
                               place.data(), end, rows.data(), rows.size(), T(amount), passes,
                               threads);
        });
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
