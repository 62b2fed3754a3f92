"""What holds for all ops: references, what they refuse, strides, threads, what torch asks of an op.

Declarations of sizes are read from the ops themselves, by looking on as a call is checked.
"""

import dataclasses
import inspect
import math
import re
import sys
from typing import Any

import pytest
import torch
from op_cases import (
    CASES,
    CHANGED,
    DIFFERENTIABLE,
    LEVELS,
    RAYS,
    doubled,
    flat,
    fresh,
    function,
    leaves_of,
    projection,
    results,
    same_on_threads,
    soup,
)
from torch import Tensor
from torch.autograd import forward_ad
from torch.nn.functional import normalize

from univoxel import ops
from univoxel.core.records import Bricks, Mesh
from univoxel.ops import differentiable, native
from univoxel.ops.differentiable import Differentiable

ANOTHER = {
    torch.float32: torch.float64,
    torch.int64: torch.int32,
    torch.int32: torch.int16,
    torch.uint8: torch.int16,
    torch.bool: torch.uint8,
}
NAN, INF = math.nan, math.inf

# Sizes and options beside those of the cases: none, one, and a rest in every kernel's loops
SHADED = [
    {"n": 0},
    {"n": 1, "directions": 1},
    {"n": 3, "directions": 37},
    {"n": 4, "directions": 64, "smooth": 0.05, "rough": 0.2},
    {"n": 3, "directions": 20, "behind": True},
]
LOBES = [{"n": 2, "lobes": 0}, {"n": 1, "lobes": 1, "directions": 1}]
PLAIN = [{"n": 3, "f0": 0.5}, {"n": 4, "directions": 64, "smooth": 0.05, "rough": 0.2, "f0": 0.0}]
GRIDS = [
    {"n": 0},
    {"n": 5, "shape": (1, 1, 1), "channels": 1},
    {"n": 10, "shape": (2, 1, 9), "channels": 0},
    {"n": 40, "shape": (1, 4, 3), "channels": 8},
    {"n": 40, "shape": (5, 6, 6), "channels": 12},
    {"n": 3, "shape": (3, 4, 3), "channels": 16},
    {"n": 20, "shape": (3, 3, 3), "channels": 2, "margin": 30.0},
]
EDGES = {
    "composite": [
        *({"counts": counts} for counts in ([3, 0, 1, 7], [0, 0], [])),
        *({"counts": [4, 9], "channels": channels} for channels in (1, 17)),
        {"counts": [40, 30, 20], "early_stop": 0.05},
    ],
    "sample_dense": GRIDS,
    "sample_sparse": GRIDS,
    "encode_hash": [
        {"n": 0},
        {"voxel_sizes": (0.5,), "rows": 256, "features": 4},  # every node has a row of its own
        {"voxel_sizes": (0.9, 0.4, 0.15), "rows": 2, "features": 3},  # many nodes share one
        {"voxel_sizes": (5.0,), "rows": 8, "features": 1},  # one cell
    ],
    "composite_field": [{"min_share": 0.3}, {"hashed": True}, {"hashed": True, "min_share": 0.3}],
    "composite_field of bricks": [
        {"hashed": hashed, "min_share": share} for hashed in (True, False) for share in (0.0, 0.3)
    ],
    "brick_minimum": [
        {"n": 9, "shape": (5, 6)}, {"n": 4, "shape": (13, 2)}, {"n": 1, "shape": (1, 1)},
    ],
    "shade_sg": SHADED + LOBES,
    "shade_sg of dielectrics": SHADED + LOBES + PLAIN,
    "shade_radiance": SHADED,
    "shade_radiance of dielectrics": SHADED + PLAIN,
    "shade_map": [*SHADED, {"stored": True}],
    "shade_map of dielectrics": [*SHADED, *PLAIN, {"stored": True}],
    "specular_response": [{"n": 40, "directions": 96, "f0": f0} for f0 in (0.0, 0.04, 1.0)],
    "decode_lobes": [{"n": 0}, *({"n": 11, "size": size} for size in (0.1, 2.0, 20.0))],
    "mlp": [
        {"n": 0},
        {"n": 1, "sizes": (1, 1)},
        {"n": 3, "sizes": (2, 7, 5, 3, 1)},
        {"n": 9, "sizes": (40, 17)},  # panels and blocks with a rest, of any instruction set
        {"n": 13, "sizes": (33, 65, 16)},
    ],
    "patch_correlation": [
        {"n": 0}, {"n": 2, "others": 0}, {"n": 3, "others": 1, "side": 1},
        {"n": 40, "others": 4}, {"side": 5},
    ],
    "semi_global": [{"small": 0.0, "large": 0.0}, {"small": 0.3, "large": 5.0}],
    "smooth_rows_": [
        {"order": order, **sizes} for order in (1, 2)
        # Runs longer than a tile of 16 numbers; several chunks of rows
        for sizes in ({"n": 2, "shape": (1, 4)}, *({"n": 20, "shape": (15, 45), "channels": c}
                                                   for c in (1, 2, 12)))
    ],
    "smooth_rows_ of bricks": [{"order": 1}],
    "diffuse_rows_": [{"n": 2, "shape": (1, 4)}, {"n": 9, "shape": (8, 70), "every": 2}],
    "adam_rows_": [
        {"n": n, "channels": channels, "table": rows}
        for rows, channels, n in ((50, 8, 20), (50, 1, 50), (9, 5, 0), (9, 0, 3), (0, 4, 0))
    ],
    "sum_rows": [
        {"shape": shape, "counts": counts, "channels": channels}
        for shape in ((100_003,), (7, 13, 1097))  # no multiple of 64, and several chunks
        for counts in ((0.4, 0.07, 0.3), (1e-5,), (0.0, 5e-5), (0.0,), (1.0, 1.0))
        for channels in (0, 1, 2, 12)
    ],
}  # fmt: skip
# Largest relative L2 error of a float32 op against its reference in double. float32 carries 6e-8
# per operation; sums of some hundred terms and one division keep below the first. Of shading: sums
# over exp of -60 .. 0 whose argument is a difference of terms up to 30, and D's denominator at low
# roughness. Of patches: slopes of the picture change from cell to cell. Below a hundredth is what
# terms of order 1 leave of one another
RTOL = {"shade": 1e-4, "specular": 1e-4, "patch": 2e-4, "": 1e-5}


def agree(case: str, got: list[Tensor], wanted: list[Tensor], dtype: torch.dtype) -> None:
    rtol = next(value for name, value in RTOL.items() if case.startswith(name))
    rtol = rtol if dtype == torch.float32 else 1e-11
    for i, (a, b) in enumerate(zip(got, wanted, strict=True)):
        what = f"{i} of {len(wanted)} values and gradients, {dtype}"
        assert a.shape == b.shape, what
        if not b.is_floating_point():
            assert torch.equal(a, b), what
            continue
        assert a.dtype == dtype, what
        error, size = (a.double() - b).norm(), b.norm()
        size = size.clamp_min(0.01) if dtype == torch.float32 else size
        assert error <= rtol * size or error < 1e-30, f"{what}: {error:.2e} of {size:.2e}"


def without_kinks(case: str, given: dict, found: list[Tensor]) -> list[Tensor]:
    """Without gradients to distances cut off far away: opacity has a kink where two are equal."""
    if case != "composite_field of bricks":
        return found
    inner = given["sdf"].abs() < given["sdf"].abs().max()
    return [x[inner] if x.shape == inner.shape else x for x in found]


def as_function(case: str, given: dict, names: list[str]):
    """The op of its named arguments' tensors; numerical differences keep normals of unit length."""

    def call(*tensors):
        left, changed = iter(tensors), {}
        for name in names:
            several = isinstance(given[name], list)
            changed[name] = [next(left) for _ in given[name]] if several else next(left)
        if "normal" in names:
            changed["normal"] = normalize(changed["normal"], dim=-1)
        out = flat(function(case)(**given | changed))
        return tuple(o for o in out if o.is_floating_point())

    return call


@pytest.mark.skipif(native.core is None, reason="there is nothing to compare")
@pytest.mark.parametrize(
    ("case", "sizes"),
    [
        (case, sizes)
        for case in CASES
        if case in DIFFERENTIABLE or case in EDGES
        for sizes in ({}, *EDGES.get(case, ()))
    ],
)
def test_values_and_gradients_are_those_of_the_reference(case, sizes):
    """In both precisions, and what is changed in place; and gradients are those of differences."""
    given = CASES[case](**{"n": 6} | sizes)
    exact = doubled(given) if case != "semi_global" else given  # which takes no double
    with ops.use_backend("reference"):
        wanted = results(case, exact)
    for dtype in (torch.float32, torch.float64) if exact is not given else (torch.float32,):
        mine = exact if dtype == torch.float64 else given
        got = same_on_threads(lambda m=mine: results(case, m), (1, 2))
        agree(case, *(without_kinks(case, given, x) for x in (got, wanted)), dtype)
    # Missing bricks are seen by differences alone, and get no gradient
    arguments, _ = fresh(case, exact)
    names = [
        name
        for name in leaves_of(case)
        if not isinstance(arguments[name], float)
        and not ("bricks" in given and len(arguments[name]) == len(given["sdf"]))
    ]
    leaves = [t for name in names for t in flat(arguments[name])]
    if sum(t.numel() for t in leaves) and len(wanted[0]):
        call = as_function(case, arguments, names)
        assert torch.autograd.gradcheck(call, leaves, fast_mode=True)


def declared(case: str, arguments: dict) -> dict[str, tuple[list[str], torch.dtype | None]]:
    """Sizes and dtype of each tensor as a call checks them."""
    found, modules = {}, [m for k, m in sys.modules.items() if k.startswith("univoxel.ops.")]

    def looked_at(op, *bricks, **named):
        if op == case.split()[0]:
            named_sizes = {k: (s.split(), *dtype, None)[:2] for k, (_, s, *dtype) in named.items()}
            found.update(named_sizes)
        return differentiable.check(op, *bricks, **named)

    with pytest.MonkeyPatch.context() as patch:
        for module in modules:
            if module is not differentiable and hasattr(module, "check"):
                patch.setattr(module, "check", looked_at)
        function(case)(**fresh(case, arguments)[0])
    return found


def of(arguments: dict, name: str) -> Tensor:
    """The tensor that a declaration names: an argument, one of a list, or the field of a record."""
    key, _, index = name.partition("[")
    if key in arguments:
        return arguments[key][int(index[:-1])] if index else arguments[key]
    return getattr(arguments[record_with(arguments, name)], name.removeprefix("mesh_"))


def record_with(arguments: dict, name: str) -> str:
    """The argument that has it as a field."""
    field = name.removeprefix("mesh_")
    return next(
        k for k, v in arguments.items() if dataclasses.is_dataclass(v) and hasattr(v, field)
    )


def instead(arguments: dict, name: str, value: Any) -> dict:
    """The same arguments with another value there."""
    key, _, index = name.partition("[")
    if index:
        several = list(arguments[key])
        several[int(index[:-1])] = value
        return arguments | {key: several}
    if key in arguments:
        return arguments | {key: value}
    record = record_with(arguments, name)
    change = {name.removeprefix("mesh_"): value}
    return arguments | {record: dataclasses.replace(arguments[record], **change)}


def longer(tensor: Tensor, axis: int) -> Tensor:
    return torch.cat([tensor, tensor.narrow(axis, 0, 1)], axis)


def wrong_values(name: str, tensor: Tensor, sizes: list[str], dtype, everything: str):
    """(fault, value): all that a declaration excludes.

    Args:
        everything: sizes of all arguments; a letter that stands there once may have any size.
    """
    yield "another dtype", tensor.to(ANOTHER[dtype] if dtype else torch.int64)
    yield "another rank", tensor[None]
    yield "another rank", tensor[0]
    if len(everything.split("|")) > 1:
        yield "another device", tensor.to("meta")
        if not dtype and len(re.findall("floating", everything)) > 1:
            yield "another dtype", tensor.double()
    for axis, word in enumerate(sizes):
        letter = word.partition("+")[0]
        if word.isdigit() or len(re.findall(rf"\b{letter}\b", everything)) > 1:
            yield f"another {word}", longer(tensor, axis)


@pytest.mark.parametrize("case", CASES)
def test_tensors_that_do_not_fit_are_refused(case):
    arguments = CASES[case](6)
    found, op = declared(case, arguments), case.split()[0]
    everything = "|".join(f"{' '.join(s)} {d or 'floating'}" for s, d in found.values())
    for name, (sizes, dtype) in found.items():
        if name == "mesh_vertices":  # of the scene, checked as that is made
            continue
        tensor = of(arguments, name)
        wanted = rf"{op}: ({re.escape(name)} must be a|f0 must be a number or a) tensor, got list"
        with pytest.raises(TypeError, match=wanted):
            function(case)(**instead(arguments, name, tensor.tolist()))
        for fault, value in wrong_values(name, tensor, sizes, dtype, everything):
            message = refusal(case, instead(arguments, name, value))
            assert re.match(f"{op}: .* must .* got ", message), f"{name} of {fault}: {message}"


def refusal(case: str, arguments: dict) -> str:
    try:
        function(case)(**arguments)
    except ValueError as error:
        return str(error)
    return "taken"


@pytest.mark.parametrize("case", [c for c in CASES if hasattr(ops, c) and c != "mlp"])
def test_sizes_are_checked_as_documented(case):
    """By the comments of the signature and by the docstring, letter by letter."""
    op = function(case)
    found = {name: sizes for name, (sizes, _) in declared(case, CASES[case](6)).items()}
    parameters = inspect.signature(op).parameters
    tensors = {name for name, p in parameters.items() if p.annotation == "Tensor"}
    assert tensors <= {*found}
    text = inspect.getsource(op)
    documented = re.findall(r"^    (\w+): Tensor.*,  # \[([^]]+)\]", text, re.MULTILINE)
    documented += re.findall(r"^ {8}([\w, ]+): \[([^]]+)\]", text, re.MULTILINE)
    assert tensors <= {name for names, _ in documented for name in names.split(", ")} | {
        "brick_min"
    }
    for names, sizes in documented:
        for name in tensors & {*names.split(", ")}:
            if "*" not in sizes:  # levels and their rows are told apart by voxel_sizes
                assert [re.sub(r"\s", "", word) for word in sizes.split(",")] == found[name], name


EMPTY = Bricks(torch.zeros(0, 1, 1).int(), torch.full((4,), -1).int(), (0, 4, 4))
F0 = [
    ({"f0": 1.5}, r"f0 must be in \[0, 1\], got 1.5"),
    ({"f0": NAN}, r"f0 must be in \[0, 1\], got nan"),
    ({"f0": [0.04]}, "f0 must be a number or a tensor, got list"),
]
LIT = [
    *F0,
    ({"solid_angle": 0.0}, "solid_angle must be above 0, got 0.0"),
    ({"wo": torch.rand(6, 3, requires_grad=True)}, "gradients for wo are not supported"),
]
PLACE = [
    ({"origin": (0.0, 1.0)}, "origin must be 3 finite numbers, got"),
    ({"origin": (0.0, 1.0, NAN)}, "origin must be 3 finite numbers"),
    ({"voxel_size": 0.0}, "voxel_size must be above 0, got 0.0"),
    ({"voxel_size": INF}, "voxel_size must be above 0, got inf"),
    ({"points": torch.rand(1, 3).expand(2**31, 3)}, r"points must be fewer than 2\^31"),
]
# Beside sizes: changes of good arguments, and what the error says
REFUSED = {
    "composite": [
        *(({"offsets": torch.tensor(x)}, "offsets must rise from 0") for x in (
            *([0, 12, 6, 18], [0, 6, 17], [-4, 18], [0, -1, 18], [0, 19], [0, 2**62, 18]),
            *([4, 18], [0], [-(2**63), 18]),
        )),
        ({"offsets": torch.tensor([], dtype=torch.int64)}, "offsets must be"),
        ({"early_stop": 1.5}, r"early_stop must be in \[0, 1\], got 1.5"),
    ],
    "sample_dense": [
        *PLACE,
        ({"sdf": torch.rand(4, 0, 6), "features": torch.rand(4, 0, 6, 2)}, "sdf must not be empty"),
    ],
    "sample_sparse": [
        *PLACE,
        ({"bricks": None}, "bricks must be of the type Bricks, got NoneType"),
        (
            {"bricks": EMPTY, "sdf": torch.rand(256), "features": torch.rand(256, 2)},
            r"bricks must not be empty, got size \[0, 4, 4\]",
        ),
    ],
    "encode_hash": [
        ({"table": torch.rand(63, 2)}, "must be a power of two, got 63 rows for 2 levels"),
        ({"table": torch.rand(24, 2)}, "a power of two, got 24 rows"),
        ({"table": torch.rand(0, 2)}, "a power of two, got 0 rows"),
        ({"lower": (0.0, 1.0)}, "lower must be 3 finite numbers"),
        ({"upper": (0.0, 1.0, NAN)}, "upper must be 3 finite numbers"),
        ({"lower": (9.0, 0.0, 0.0)}, "lower must be at most upper"),
        ({"voxel_sizes": ()}, "voxel_sizes must be one or more numbers above 0"),
        ({"voxel_sizes": (0.5, 0.0)}, "voxel_sizes must be one or more numbers above 0"),
        ({"felt": -1}, "felt must be at least 0, got -1"),
    ],
    "composite_field": [
        ({"sdf": torch.rand(0, 8, 9), "features": torch.rand(0, 8, 9, 2)}, "sdf must not be empty"),
        ({"inv_s": 0.0}, "inv_s must be above 0, got 0.0"),
        ({"min_share": 1.0}, r"min_share must be in \[0, 1\), got 1.0"),
        ({"voxel_size": -1.0}, "voxel_size must be above 0"),
        ({"levels": LEVELS}, r"features must be \[T, F\]"),
        ({"levels": LEVELS, "features": torch.rand(6, 2)}, "a power of two"),
    ],
    "march": [
        ({"brick_min": torch.zeros(4, 3, 3)}, "brick_min does not belong to this sdf"),
        ({"voxel_size": 0.0}, "voxel_size must be above 0"),
        ({"step": 0.0}, "step must be above 0, got 0.0"),
        ({"inv_s": NAN}, "inv_s must be above 0"),
        ({"min_weight": -1.0}, r"min_weight must be in \[0, 1\]"),
        ({"early_stop": 2.0}, r"early_stop must be in \[0, 1\]"),
    ],
    "shade_sg": [*F0, ({"directions": torch.rand(0, 3)}, "at least one direction")],
    "shade_radiance": [
        *LIT,
        ({"directions": torch.rand(0, 3), "radiance": torch.rand(6, 0, 3)}, "at least one direct"),
    ],
    "shade_map": [
        *LIT,
        ({"visibility": torch.rand(5, 16, requires_grad=True)}, "gradients for visibility are not"),
        ({"indirect": torch.rand(5, 16, 3, requires_grad=True)}, "gradients for indirect are not"),
        ({"visibility": torch.ones(5, 7).byte()}, r"visibility must be \[P, D\] uint8"),
        ({"indirect": torch.rand(5, 16).half()}, r"indirect must be \[P, D, 3\] float16"),
        ({"index": torch.tensor([0, 1, 5, 0, 0, 0])}, r"index must lie in \[0, P=5\)"),
        ({"index": torch.tensor([0, 1, -1, 0, 0, 0])}, r"index must lie in \[0, P=5\)"),
        (
            {"directions": torch.rand(0, 3), "map": torch.rand(0, 3),
             "visibility": torch.rand(5, 0), "indirect": torch.rand(5, 0, 3)},
            "at least one direction",
        ),
    ],
    "specular_response": [
        ({"solid_angle": 0.0}, "solid_angle must be above 0, got 0"),
        ({"f0": 1.5}, r"f0 must be in \[0, 1\], got 1.5"),
    ],
    "decode_lobes": [
        *(({"min_sharpness": x}, "min_sharpness must be at least 0") for x in (-0.1, NAN)),
        *(({"max_sharpness": x}, "max_sharpness must be above 0") for x in (0.0, INF)),
    ],
    "mlp": [
        ({"biases": [torch.rand(8)]}, "as many weights as biases, .* got 2 weights and 1 biases"),
        ({"weights": [], "biases": []}, "got 0 weights and 0 biases"),
        (
            {"x": torch.rand(5, 0), "weights": [torch.rand(2, 0)], "biases": [torch.rand(2)]},
            "every layer must be at least 1 wide, got H0=0",
        ),
    ],
    "patch_correlation": [
        ({"brightness": torch.zeros(4, 1, 48)}, "at least 2 rows and columns"),
        ({"brightness": torch.zeros(2, 9, 9).half()}, r"projection must be \[V, 3, 4\]"),
        ({"own": torch.zeros(6, 24)}, "n x n pixels per patch, with an odd n, got 24"),
        ({"own": torch.zeros(6, 16)}, "n x n pixels per patch, with an odd n, got 16"),
        *(({"views": torch.full((6, 2), x)}, r"views must lie in \[0, V=4\)") for x in (4, -1)),
        *(({"noise": x}, f"noise must be above 0, got {x}") for x in (0.0, NAN)),
    ],
    "match_cost": [
        *(({"best": x}, rf"best must lie in \[1, 4\], got {x}") for x in (0, 5)),
        ({"steps": 0}, "steps >= 1 and radius >= 0, got steps=0 and radius=1"),
        ({"radius": -1}, "got steps=7 and radius=-1"),
        ({"others": torch.tensor([1, 2, 3, 5])}, r"others must lie in \[0, 5\)"),
        ({"rows": torch.zeros(2, 6, dtype=torch.int64)}, "rows must contain each of the"),
    ],
    "semi_global": [
        ({"small": 0.2, "large": 0.1}, "0 <= small <= large must hold, got 0.2 and 0.1"),
        ({"small": -0.1}, "got -0.1 and 0.2"),
        ({"rows": torch.full((2, 6), -1)}, "rows must contain each of the"),
    ],
    "smooth_rows_": [
        *(({"rows": torch.tensor([x])}, r"rows must lie in \[0, 180\)")
          for x in (-1, 180, 2**40, -(2**63))),
        ({"amount": 2.0}, r"amount must be in \[0, 1\], got 2.0"),
        ({"order": 3}, "order must be 1 or 2, got 3"),
        ({"grid": torch.zeros(3, 3, 3, 4)[..., ::2]}, "it must be contiguous"),
    ],
    "smooth_rows_ of bricks": [
        *(({"rows": torch.tensor([x])}, "rows must be of bricks that stand somewhere")
          for x in (0, 127, 64 * 1000, -1)),
        ({"grid": torch.zeros(64, 1)}, r"grid must be \[R, C\] .* with n=\d+, R=\d+, got"),
    ],
    "diffuse_rows_": [
        *(
            ({"rows": torch.tensor(x), "values": torch.ones(2)}, "ascend")
            for x in ([1, 0], [0, 180])
        ),
        ({"amount": 1.5}, "amount must be in"),
        ({"passes": -1}, "passes must be at least 0"),
        ({"size": (2, 2)}, "size must be the size"),
        ({"values": torch.ones(354)[::2]}, "they must be contiguous"),
    ],
    "adam_rows_": [
        ({"param": torch.zeros(4, 12).T}, "param must be contiguous, got strides"),
        ({"exp_avg_sq": torch.zeros(4, 12).T}, "exp_avg_sq must be contiguous"),
        ({"rows": torch.arange(7, 13)}, r"rows must lie in \[0, R=12\)"),
        ({"rows": torch.arange(-1, 5)}, r"rows must lie in \[0, R=12\)"),
        ({"lr": -1.0}, "lr must be at least 0, got -1.0"),
        ({"beta1": 1.0}, r"beta1 must be in \[0, 1\), got 1.0"),
        ({"beta2": -0.1}, r"beta2 must be in \[0, 1\), got -0.1"),
        ({"eps": NAN}, "eps must be at least 0, got nan"),
        ({"step": 0}, "step must be at least 1, got 0"),
    ],
    "sum_rows": [
        ({"rows": [], "values": []}, "at least one"),
        ({"rows": [torch.tensor([1, 2])]}, "as many rows as values"),
        *(({"rows": [torch.tensor(x)], "values": [torch.ones(2, 3)]}, "rows must ascend in")
          for x in ([5, 5], [5, 4], [-1, 3], [3, 12])),
        *(({"shape": x}, "every size in shape must be at least 1") for x in ((), (4, 0))),
    ],
}  # fmt: skip
if RAYS:
    vertices, faces = soup(6)
    rays = [
        ({"t_min": -1.0}, "0 <= t_min <= t_max must hold, got -1.0"),
        ({"t_min": 2.0, "t_max": 1.0}, "0 <= t_min <= t_max must hold"),
        ({"t_max": NAN}, "0 <= t_min <= t_max must hold"),
        ({"origin": torch.rand(6, 3).to("meta"), "direction": torch.rand(6, 3).to("meta")}, "cpu"),
    ]
    REFUSED |= {
        "VisibilityScene": [
            ({"faces": faces + 1}, "index the 18 vertices, got indices 1 to 18"),
            ({"faces": faces - 1}, "index the 18 vertices, got indices -1 to 16"),
            ({"faces": faces.long() + 2**32}, "index the 18 vertices"),
            ({"vertices": vertices * NAN}, "vertices must be finite, got .*nan.* row 0"),
            ({"vertices": vertices.to("meta"), "faces": faces.to("meta")}, "must be on the cpu"),
        ],
        "occluded": rays,
        "closest_hit": rays,
        "relight": [
            ({"offset": -1.0}, "offset must be finite and at least 0, got -1.0"),
            ({"offset": NAN}, "offset must be finite"),
            ({"samples": 0}, "samples must be at least 1, got 0"),
            ({"bounces": -1}, "bounces must be at least 0, got -1"),
            ({"first": -1}, "first must be at least 0"),
            ({"first": 2**31}, r"first \+ samples must be at most 2\^31"),
            ({"seed": -1}, "seed must be in"),
            ({"strategy": "best"}, "strategy must be mis, map or brdf, got 'best'"),
            ({"mesh": Mesh(vertices, faces)}, "bounces need a mesh with"),
            ({"scene": ops.VisibilityScene(vertices, faces)}, "mesh_normals"),
        ],
    }  # fmt: skip


@pytest.mark.parametrize(
    ("case", "change", "message"), [(c, *row) for c, rows in REFUSED.items() for row in rows]
)
@pytest.mark.skipif(native.core is None, reason="rows and offsets are checked by the kernels")
def test_values_out_of_range_are_refused(case, change, message):
    arguments = fresh(case, CASES[case](6))[0] | change
    with pytest.raises((TypeError, ValueError, NotImplementedError), match=message):
        function(case)(**arguments)


def scattered(tensor: Tensor) -> Tensor:
    """The same numbers in a larger storage, behind an offset, with strides of their own."""
    room = tensor.new_full([2 * n + 3 for n in reversed(tensor.shape)], 77)
    view = room[tuple(slice(3, None, 2) for _ in tensor.shape)]
    return view.permute(*reversed(range(tensor.dim()))).copy_(tensor)


@pytest.mark.parametrize("case", CASES)
def test_strides_and_offsets_of_storage_change_nothing(case):
    given = CASES[case](40)
    moved = {
        k: scattered(v) if isinstance(v, Tensor) and k not in CHANGED.get(case.split()[0], ())
        else [scattered(t) for t in v] if isinstance(v, list) else v
        for k, v in given.items()
    }  # fmt: skip
    for a, b in zip(results(case, moved), results(case, given), strict=True):
        assert torch.equal(a, b)


SAMPLERS = [case for case in CASES if case.startswith(("sample", "encode", "composite_field"))]
SLABS = [{"n": 5000, "shape": s, "channels": 8}
         for s in ((40, 35, 70), (17, 9, 10), (26, 3, 130), (9, 33, 2))]  # fmt: skip


@pytest.mark.skipif(native.core is None, reason="without the extension")
@pytest.mark.parametrize(
    ("case", "sizes"),
    [
        *((case, {}) for case in CASES),
        *((c, s) for c in ("sample_dense", "sample_sparse") for s in SLABS),
    ],
)
def test_more_work_than_one_chunk(case, sizes):
    """It equals the reference, and its bits do not depend on the number of threads."""
    given = CASES[case](**{"n": 3000} | sizes)
    same_on_threads(lambda: results(case, given))
    if case not in DIFFERENTIABLE:
        return
    given = doubled(given)
    with ops.use_backend("reference"):
        wanted = results(case, given)
    sparse = [False, True] if case in SAMPLERS else [None]
    for one in sparse:
        options = {} if one is None else {"sparse_grad": one}
        got = same_on_threads(lambda o=options: results(case, given, **o))
        agree(case, *(without_kinks(case, given, x) for x in (got, wanted)), torch.float64)


@pytest.mark.parametrize("loss", [lambda o: o.square().sum(), Tensor.sum], ids=["square", "sum"])
@pytest.mark.parametrize("case", DIFFERENTIABLE)
def test_second_order_raises(case, loss):
    """Whatever the loss, and whoever asks: a gradient that counts for nothing would be silent."""
    arguments, leaves = fresh(case, CASES[case](6))
    out = sum(loss(o) for o in flat(function(case)(**arguments)) if o.requires_grad)
    first = torch.autograd.grad(out, leaves, create_graph=True)
    for gradient in first:
        with pytest.raises(RuntimeError, match="differentiate twice"):
            torch.autograd.grad(gradient.square().sum() + 0 * out, leaves, retain_graph=True)
    with pytest.raises(RuntimeError, match="differentiate twice"):
        sum(g.square().sum() for g in first).backward()


@pytest.mark.skipif(native.core is None, reason="the reference has them")
@pytest.mark.parametrize("case", DIFFERENTIABLE)
def test_forward_mode_raises(case):
    """Where the library is asked it would be 0, and nothing said."""
    arguments, _ = fresh(case, CASES[case](6))
    name = leaves_of(case)[0]
    given = [t.detach() for t in flat(arguments[name])]
    tangents, op = [torch.ones_like(t) for t in given], as_function(case, arguments, [name])

    def dual():
        with forward_ad.dual_level():
            op(*map(forward_ad.make_dual, given, tangents))

    for ask in (lambda: torch.func.jvp(op, tuple(given), tuple(tangents)), dual):
        with pytest.raises(NotImplementedError, match="forward mode"):
            ask()


@pytest.mark.parametrize("case", DIFFERENTIABLE)
def test_a_whole_graph_compiles(case):
    """To kernels of the machine for one of them: what they hold is no op's affair."""
    arguments, leaves = fresh(case, CASES[case](6))

    def loss():
        return projection(flat(function(case)(**arguments)))

    torch.compiler.reset()
    backend = "inductor" if case == "composite" else "aot_eager"
    got = torch.autograd.grad(torch.compile(loss, fullgraph=True, backend=backend)(), leaves)
    torch.testing.assert_close(got, torch.autograd.grad(loss(), leaves))


@pytest.mark.skipif(native.core is None, reason="without the extension")
@pytest.mark.parametrize("case", [*DIFFERENTIABLE, "adam_rows_"])
def test_torch_knows_the_op_in_full(case, monkeypatch):
    """Schema, sizes without values and gradients of it, and of its backward pass."""
    called = {}
    for kind in (native.Operator, Differentiable):

        def recorded(self, *inputs, call=kind.__call__):
            called[self] = inputs
            return call(self, *inputs)

        monkeypatch.setattr(kind, "__call__", recorded)
    arguments, _ = fresh(case, CASES[case](6))
    function(case)(**arguments)
    monkeypatch.undo()
    ((op, inputs),) = called.items()
    torch.library.opcheck(op.defined, inputs)
    if isinstance(op, Differentiable) and not op._traced:
        held, shown = op._held, op._shown
        saved = [[t.detach() for t in x] if isinstance(x, list) else x.detach()
                 for x in inputs[: op._tensors]]  # fmt: skip
        out = op(*saved, *inputs[op._tensors :])
        out = [out] if isinstance(out, Tensor) else list(out)
        pulls = [torch.ones_like(o) for o in out[:shown]]
        asked = [t.requires_grad for t in flat([inputs[i] for i in op._to])]
        for needs in (asked, [i == 0 for i in range(len(asked))]):
            given = (*saved, *out[shown : shown + held], *pulls, *inputs[op._tensors :], needs)
            torch.library.opcheck(op.backward.defined, given)
