// NumPy arrays -> structs of pointers, with the GIL released. No mathematics here.
//
// Every array argument is noconvert: pybind11 would otherwise copy an array of another dtype or
// stride, fill the copy and drop it. The Python side checks shapes; here only extents that a wrong
// call would overrun.
#pragma once

#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>

#include <stdexcept>
#include <string>

namespace univoxel {

namespace py = pybind11;

template <class T>
using array = py::array_t<T, py::array::c_style>;

inline void require(bool ok, const std::string& message) {
    if (!ok) throw std::invalid_argument(message);
}

/// Add the functions of one family to the module; each in a file of its own.
void bind_composite_ops(py::module_& m);
void bind_dense_grid_ops(py::module_& m);
void bind_hash_grid_ops(py::module_& m);
void bind_march_ops(py::module_& m);
void bind_mlp_ops(py::module_& m);
void bind_rows_ops(py::module_& m);
void bind_sg_ops(py::module_& m);
void bind_shade_ops(py::module_& m);
void bind_sparse_grid_ops(py::module_& m);
void bind_stereo_ops(py::module_& m);
void bind_visibility_ops(py::module_& m);

}  // namespace univoxel
