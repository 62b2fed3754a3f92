// NumPy arrays -> structs of pointers, with the GIL released. No mathematics here.
//
// Every array argument is noconvert: pybind11 would otherwise copy an array of another dtype or
// stride, fill the copy and drop it. The Python side checks shapes; here only extents that a wrong
// call would overrun.
#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include <array>
#include <stdexcept>
#include <string>

#include "composite.h"
#include "march.h"
#include "smooth.h"

namespace py = pybind11;
using namespace univoxel;

namespace {

template <class T>
using array = py::array_t<T, py::array::c_style>;

void require(bool ok, const std::string& message) {
    if (!ok) throw std::invalid_argument(message);
}

/// offsets [N + 1] must start at 0, never fall and end at n_samples; returns N.
int64_t check_offsets(const char* op, const array<int64_t>& offsets, int64_t n_samples) {
    const int64_t n = offsets.size() - 1;
    const int64_t* o = offsets.data();
    bool ok = n >= 0 && o[0] == 0 && o[n] == n_samples;
    for (int64_t i = 0; ok && i < n; ++i) ok = o[i] <= o[i + 1];
    require(ok, std::string(op) + ": offsets must rise from 0 to the number of samples (" +
                    std::to_string(n_samples) + ")");
    return n;
}

template <class T>
Composite<T> composite_of(const array<T>& alpha, const array<T>& value,
                          const array<int64_t>& offsets, double early_stop) {
    const int64_t n = check_offsets("composite", offsets, alpha.size());
    return {alpha.data(), value.data(), offsets.data(), n, value.shape(1), T(early_stop)};
}

template <class T>
void bind_composite(py::module_& m) {
    m.def(
        "composite_forward",
        [](const array<T>& alpha, const array<T>& value, const array<int64_t>& offsets,
           array<T>& out, array<T>& weight, double early_stop, int threads) {
            const auto in = composite_of(alpha, value, offsets, early_stop);
            T *o = out.mutable_data(), *w = weight.mutable_data();
            py::gil_scoped_release nogil;
            composite_forward(in, o, w, threads);
        },
        py::arg("alpha").noconvert(), py::arg("value").noconvert(), py::arg("offsets").noconvert(),
        py::arg("out").noconvert(), py::arg("weight").noconvert(), py::arg("early_stop"),
        py::arg("threads"));
    m.def(
        "composite_backward",
        [](const array<T>& alpha, const array<T>& value, const array<int64_t>& offsets,
           const array<T>& grad_out, const array<T>& grad_weight, array<T>& grad_alpha,
           array<T>& grad_value, double early_stop, int threads) {
            const auto in = composite_of(alpha, value, offsets, early_stop);
            T *ga = grad_alpha.mutable_data(), *gv = grad_value.mutable_data();
            py::gil_scoped_release nogil;
            composite_backward(in, grad_out.data(), grad_weight.data(), ga, gv, threads);
        },
        py::arg("alpha").noconvert(), py::arg("value").noconvert(), py::arg("offsets").noconvert(),
        py::arg("grad_out").noconvert(), py::arg("grad_weight").noconvert(),
        py::arg("grad_alpha").noconvert(), py::arg("grad_value").noconvert(), py::arg("early_stop"),
        py::arg("threads"));
}

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
        "march",
        [](const array<T>& sdf, const array<T>& brick_min, const array<T>& origin,
           const array<T>& direction, const array<T>& jitter, std::array<double, 3> grid_origin,
           double voxel_size, double step, double inv_s, double min_weight, double early_stop,
           int threads) {
            const March<T> in{
                sdf.data(),    brick_min.data(),
                origin.data(), direction.data(),
                jitter.data(), {sdf.shape(0), sdf.shape(1), sdf.shape(2)},
                jitter.size(), {T(grid_origin[0]), T(grid_origin[1]), T(grid_origin[2])},
                T(voxel_size), T(step),
                T(inv_s),      T(min_weight),
                T(early_stop)};
            for (int a = 0; a < 3; ++a)
                require(brick_min.shape(a) == bricks_along(sdf.shape(a)),
                        "march: brick_min does not belong to this sdf");
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
        py::arg("early_stop"), py::arg("threads"));
}

template <class T>
void bind_smooth(py::module_& m) {
    m.def(
        "smooth_rows",
        [](array<T>& grid, const array<int64_t>& rows, double amount, int order, int threads) {
            const int64_t size[3] = {grid.shape(0), grid.shape(1), grid.shape(2)};
            const int64_t nodes = size[0] * size[1] * size[2];
            const int64_t* r = rows.data();
            for (int64_t k = 0; k < rows.size(); ++k)
                require(r[k] >= 0 && r[k] < nodes, "smooth_rows: rows must be in [0, " +
                                                       std::to_string(nodes) + "), got " +
                                                       std::to_string(r[k]));
            T* g = grid.mutable_data();
            py::gil_scoped_release nogil;
            smooth_rows(g, size, grid.shape(3), r, rows.size(), T(amount), order, threads);
        },
        py::arg("grid").noconvert(), py::arg("rows").noconvert(), py::arg("amount"),
        py::arg("order"), py::arg("threads"));
}

}  // namespace

PYBIND11_MODULE(_core, m) {
    m.doc() = "Native kernels of univoxel: plain functions over contiguous buffers.";
    bind_composite<float>(m);
    bind_composite<double>(m);
    bind_march<float>(m);
    bind_march<double>(m);
    bind_smooth<float>(m);
    bind_smooth<double>(m);
}
