"""The extension takes an array as it is or refuses it: pybind11 would otherwise copy one of another
dtype or stride, fill the copy and drop it."""

import re
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from univoxel.ops import native

pytestmark = pytest.mark.skipif(native.core is None, reason="without the extension")

WITHOUT_ARRAYS = {"embree_version", "DenseGrid", "Charts.count"}
WRONG = {
    "dtype": lambda array: array.astype(np.int16),
    "stride": lambda array: np.repeat(array, 2, 0)[::2],
}


def bound() -> Iterator[tuple[str, Callable]]:
    """Names and functions of the extension: those of the module, constructors and methods."""
    for name, member in vars(native.core).items():
        if name.startswith("_") or name == "Strategy":
            continue
        if not isinstance(member, type):
            yield name, member
            continue
        if "_core." in (member.__init__.__doc__ or ""):  # the others are made by functions
            yield name, member
        for method, function in vars(member).items():
            if not method.startswith("_"):
                yield f"{name}.{method}", function


def signatures(function: Callable) -> Iterator[list[str]]:
    """Types of the arguments, one list an overload, from the text that pybind11 writes."""
    constructor = isinstance(function, type)
    text = function.__init__.__doc__ if constructor else function.__doc__
    for line in (text or "").splitlines():
        arguments = re.fullmatch(r"(?:\d+\. )?\w+\((.+)\) -> .+", line)
        if arguments and arguments[1] != "*args, **kwargs":
            parts = re.split(r", (?=\w+: )", arguments[1])
            yield [part.partition(": ")[2] for part in parts[constructor:]]


def example(kind: str):
    """Something that an argument of this type takes."""
    if array := re.match(r"(?:list\[)?numpy\.typing\.NDArray\[numpy\.(\w+)\]", kind):
        values = np.ones((2, 2), array[1])
        return [values] if kind.startswith("list") else values
    if kind.startswith("univoxel._core."):
        return instances()[kind.removeprefix("univoxel._core.")]
    if kind.startswith("collections.abc.Sequence[typing.Annotated"):
        return [[2, 2, 2]]
    if kind.startswith("typing.Annotated"):
        return [2, 2, 2]
    if kind.startswith("collections.abc.Sequence"):
        return [1.0]
    return {"bool": False}.get(kind, 1)


def instances() -> dict[str, object]:
    core = native.require()
    table = np.zeros((1, 1, 1), np.int32)
    dense = core.DenseGrid([2, 2, 2], [0.0, 0.0, 0.0], 1.0)
    sparse = core.SparseGrid(table, [2, 2, 2], [0.0, 0.0, 0.0], 1.0)
    point, order = np.zeros((1, 3), np.float32), np.zeros(1, np.int32)
    rows = core.hash_rows(np.zeros((2, 1), np.float32), point, [[2, 2, 2]], [0.0] * 3, [1.0], 1)
    known = {
        "DenseGrid": dense,
        "SparseGrid": sparse,
        "TouchedRows": core.touched_rows(dense, point, order, 8, True, False, 1)[0],
        "RowSet": core.touched_rows(sparse, point, order, 128, True, False, 1)[0],
        "Charts": core.find_charts(
            np.eye(3, dtype=np.float32), np.array([[0, 1, 2]], np.int32), order, 8, 1
        ),
        "HashRows": rows,
        "Strategy": core.Strategy.mis,
    }
    if core.embree_version():
        known["VisibilityScene"] = core.VisibilityScene(
            np.eye(3, dtype=np.float32), np.array([[0, 1, 2]], np.int32), 1
        )
    return known


@pytest.mark.parametrize("name", [name for name, _ in bound()])
def test_arrays_are_not_converted(name):
    function = dict(bound())[name]
    kinds = [kind for overload in signatures(function) for kind in overload]
    assert any("NDArray" in kind for kind in kinds) == (name not in WITHOUT_ARRAYS)
    assert not [kind for kind in kinds if "ArrayLike" in kind], "converted by pybind11"


@pytest.mark.parametrize("fault", WRONG)
@pytest.mark.parametrize("name", [name for name, _ in bound()])
def test_an_array_that_does_not_fit_is_refused(name, fault):
    function = dict(bound())[name]
    if not native.require().embree_version() and ("Scene" in name or name == "relight"):
        pytest.skip("built without Embree")
    for overload in signatures(function):
        arguments = [example(kind) for kind in overload]
        for i, argument in enumerate(arguments):
            if isinstance(argument, np.ndarray):
                wrong = WRONG[fault](argument)
            elif isinstance(argument, list) and isinstance(argument[0], np.ndarray):
                wrong = [WRONG[fault](argument[0])]
            else:
                continue
            with pytest.raises(TypeError, match="incompatible"):
                function(*arguments[:i], wrong, *arguments[i + 1 :])
