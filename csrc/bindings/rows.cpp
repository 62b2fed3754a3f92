#include <functional>
#include <numeric>

#include "adam.h"
#include "bindings/grids.h"
#include "diffuse.h"
#include "smooth.h"
#include "sum_rows.h"

namespace univoxel {
namespace {

std::string range(int64_t first, int64_t end) {
    return "[" + std::to_string(first) + ", " + std::to_string(end) + ")";
}

/// Whether all rows lie in [0, end).
bool inside(In<int64_t> rows, int64_t end) {
    return all_of<int64_t>(rows, [=](int64_t row) { return row >= 0 && row < end; });
}

void require_ascending(const std::string& op, In<int64_t> rows, int64_t first, int64_t end) {
    const int64_t *r = rows.data(), n = rows.size();
    const bool inside = n == 0 || (r[0] >= first && r[n - 1] < end);
    require(inside && std::adjacent_find(r, r + n, std::greater_equal<>()) == r + n,
            op + ": rows must ascend in " + range(first, end));
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
            require_ascending("diffuse_rows_", rows, 0, size[0] * size[1] * size[2]);
            diffuse_rows(values.mutable_data(), size.data(), rows.data(), rows.size(), T(amount),
                         passes, threads);
        });
    def(m, "diffuse_brick_rows", "values table place size rows amount passes threads",
        [](Out<T> values, In<int32_t> table, In<int32_t> place, const Size3& size, In<int64_t> rows,
           double amount, int passes, int threads) {
            const int64_t end = place.size() * kBrickNodes;
            require_ascending("diffuse_rows_", rows, kMissingRows, end);
            require(stand(rows, place),
                    "diffuse_rows_: rows must be of bricks that stand somewhere");
            diffuse_brick_rows(values.mutable_data(), size.data(), brick_nodes_of(table, size),
                               place.data(), end, rows.data(), rows.size(), T(amount), passes,
                               threads);
        });
}

using ManyRows = const std::vector<array<int64_t>>&;

template <class T>
std::vector<RowList<T>> lists_of(ManyRows rows, const std::vector<array<T>>& values) {
    std::vector<RowList<T>> lists;
    for (size_t i = 0; i < rows.size(); ++i)
        lists.push_back({rows[i].data(), values[i].data(), rows[i].size()});
    return lists;
}

template <class T>
void bind_sums(py::module_& m) {
    def(m, "union_rows", "rows values n_rows threads",
        [](ManyRows rows, const std::vector<array<T>>& values, int64_t n_rows, int threads) {
            for (const auto& list : rows) require_ascending("sum_rows", list, 0, n_rows);
            return union_rows(lists_of(rows, values), n_rows, threads);
        });
    def(m, "sum_rows", "rows values set out indices shape threads",
        [](ManyRows rows, const std::vector<array<T>>& values, const RowSet& set, Out<T> out,
           Out<int64_t> indices, const std::vector<int64_t>& shape, int threads) {
            const int64_t dims = static_cast<int64_t>(shape.size());
            const bool fits = std::accumulate(shape.begin(), shape.end(), int64_t(1),
                                              std::multiplies<>()) == set.n_rows() &&
                              out.shape(0) == set.count() && indices.size() == dims * set.count();
            require(fits, "sum_rows: out, indices or shape of another size");
            sum_rows(lists_of(rows, values), set, out.shape(1), out.mutable_data(), threads);
            set.write_indices(shape, indices.mutable_data(), threads);
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
    bind_sums<float>(m);
    bind_sums<double>(m);
}

}  // namespace univoxel
