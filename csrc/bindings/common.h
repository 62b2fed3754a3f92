// NumPy arrays -> structs of pointers, with the GIL released. No mathematics here.
//
// The Python side checks shapes; here only extents that a wrong call would overrun.
#pragma once

#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include <algorithm>
#include <iterator>
#include <optional>
#include <sstream>
#include <stdexcept>
#include <string>
#include <tuple>
#include <type_traits>
#include <utility>
#include <variant>
#include <vector>

namespace univoxel {

namespace py = pybind11;

template <class T>
using array = py::array_t<T, py::array::c_style>;

// Arguments of a bound function. References: a copy would count references without the GIL.
template <class T>
using In = const array<T>&;
template <class T>
using Out = array<T>&;
template <class T>
using OptionalIn = const std::optional<array<T>>&;
template <class T>
using OptionalOut = std::optional<array<T>>&;  // None: not wanted

/// Whether an argument is an array or holds some.
template <class A>
struct HoldsArrays : std::false_type {};
template <class T, int kFlags>
struct HoldsArrays<py::array_t<T, kFlags>> : std::true_type {};
template <class A>
struct HoldsArrays<std::optional<A>> : HoldsArrays<A> {};
template <class A>
struct HoldsArrays<std::vector<A>> : HoldsArrays<A> {};
template <class... A>
struct HoldsArrays<std::variant<A...>> : std::disjunction<HoldsArrays<A>...> {};

/// An array as the pointer to its numbers, null where there is none; all else as it is.
template <class A>
A raw(const A& other) {
    return other;
}
template <class T>
const T* raw(In<T> a) {
    return a.data();
}
template <class T>
T* raw(Out<T> a) {
    return a.mutable_data();
}
template <class T>
const T* raw(OptionalIn<T> a) {
    return a ? a->data() : nullptr;
}
template <class T>
T* raw(OptionalOut<T> a) {
    return a ? a->mutable_data() : nullptr;
}

/// A structure of pointers and numbers.
template <class S, class... A>
S make(A&&... members) {
    return S{raw(members)...};
}

inline void require(bool ok, const std::string& message) {
    if (!ok) throw std::invalid_argument(message);
}

/// Whether f holds for all numbers of an array.
template <class T, class F>
bool all_of(In<T> a, F&& f) {
    return std::all_of(a.data(), a.data() + a.size(), f);
}

template <class F>
struct Signature : Signature<decltype(&F::operator())> {};
template <class F, class R, class... A>
struct Signature<R (F::*)(A...) const> {
    static constexpr size_t kCount = sizeof...(A);

    /// The argument called `name`. Arrays are noconvert: pybind11 would otherwise copy one of
    /// another dtype or stride, fill the copy and drop it.
    template <size_t kI>
    static py::arg argument(const std::string& name) {
        using Argument = std::tuple_element_t<kI, std::tuple<std::decay_t<A>...>>;
        return py::arg(name.c_str()).noconvert(HoldsArrays<Argument>::value);
    }
};

template <class S, size_t kFirst, size_t... kI, class F>
void with_arguments(const std::vector<std::string>& names, std::index_sequence<kI...>, F&& f) {
    f(S::template argument<kFirst + kI>(names[kI])...);
}

/// Call f with a py::arg for each of these names: those of the arguments of F from kFirst on.
template <class F, size_t kFirst, class Call>
void with_named_arguments(const char* names, Call&& call) {
    using S = Signature<F>;
    std::istringstream words(names);
    const std::vector<std::string> list{std::istream_iterator<std::string>(words), {}};
    if (list.size() != S::kCount - kFirst)
        throw std::logic_error("as many names as arguments are needed: " + std::string(names));
    with_arguments<S, kFirst>(list, std::make_index_sequence<S::kCount - kFirst>(), call);
}

/// Bind f, which runs without the GIL, as a function of the module; `names` are its arguments'.
template <class F>
void def(py::module_& m, const char* function, const char* names, F f) {
    with_named_arguments<F, 0>(names, [&](const auto&... argument) {
        m.def(function, f, argument..., py::call_guard<py::gil_scoped_release>());
    });
}

/// The same as a method, whose first argument, the object, has no name.
template <class C, class F>
void def(py::class_<C>& c, const char* method, const char* names, F f) {
    with_named_arguments<F, 1>(names, [&](const auto&... argument) {
        c.def(method, f, argument..., py::call_guard<py::gil_scoped_release>());
    });
}

/// Bind f, which makes an object, as the constructor. It holds the GIL: the object is registered.
template <class C, class F, class... Extra>
void def_init(py::class_<C>& c, const char* names, F f, const Extra&... extra) {
    with_named_arguments<F, 0>(
        names, [&](const auto&... argument) { c.def(py::init(f), argument..., extra...); });
}

/// Add the functions of one family to the module; each in a file of its own.
void bind_chart_ops(py::module_& m);
void bind_composite_ops(py::module_& m);
void bind_composite_field_ops(py::module_& m);
void bind_grid_ops(py::module_& m);
void bind_hash_grid_ops(py::module_& m);
void bind_march_ops(py::module_& m);
void bind_mlp_ops(py::module_& m);
void bind_rows_ops(py::module_& m);
void bind_sg_ops(py::module_& m);
void bind_shade_ops(py::module_& m);
void bind_stereo_ops(py::module_& m);
void bind_visibility_ops(py::module_& m);

}  // namespace univoxel
