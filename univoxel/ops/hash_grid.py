"""Multiresolution hash encoding: features at points from small tables."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any, TypeAlias

import torch
from torch import Tensor

from univoxel.ops import native
from univoxel.ops.differentiable import check, check_numbers, differentiable
from univoxel.ops.grid import SparseGrad

PRIMES = (1, 2654435761, 805459861)
# Numbers of nodes of each level, the lower corner and voxel sizes, as the extension takes them
Place: TypeAlias = "tuple[list[list[int]], list[float], list[float]]"


def encode_hash(
    table: Tensor,  # [L * R, F]
    points: Tensor,  # [M, 3]
    lower: Sequence[float],
    upper: Sequence[float],
    voxel_sizes: Sequence[float],
    sparse_grad: bool = False,
    felt: int | None = None,
) -> Tensor:
    """Encode points in a box by L lattices whose nodes share tables of R rows.

    Level l has nodes at lower + voxel_sizes[l] * (i, j, k) up to the first at or beyond upper along
    each axis. If a level has at most R nodes, each node has a row of its own, with z as the fastest
    index; otherwise its row is

        (i xor 2654435761 j xor 805459861 k) mod R

    and several nodes may share a row. A level's output is the trilinear interpolant of the rows of
    the eight nodes around the point.

    A point outside is first moved to the nearest point on the level's border; along an axis on
    which it moved, derivatives with respect to the point are 0. A NaN point yields NaN and
    contributes to no gradient.

    Args:
        table: [L * R, F] level after level; R a power of two, at most 2^31.
        points: [M, 3] world.
        lower, upper: corners of the box, world: 3 finite numbers each, lower at most upper.
        voxel_sizes: L distances between nodes, world units, above 0.
        sparse_grad: return the gradient of table as a coalesced ``sparse_coo`` tensor that contains
            only the touched rows, as ``RowAdam`` takes it. Eager only: under torch.compile, use
            dense gradients.
        felt: number of levels, counted from the first, that pass gradients on to points; None: all.

    Returns:
        [M, L * F], level after level.

    Raises:
        TypeError, ValueError: an argument is no tensor, or of another size, dtype or device than
            above; corners or voxel_sizes out of range; rows per level that are no power of two.

    Differentiable in: table, points. Second order raises.
    Source: Mueller et al. 2022, "Instant Neural Graphics Primitives", section 3.
    """
    sizes = check("encode_hash", table=(table, "N F"), points=(points, "M 3"))
    check_levels("encode_hash", sizes["N"], lower, upper, voxel_sizes)
    levels = len(voxel_sizes)
    place = ([float(x) for x in lower], [float(x) for x in upper], [float(h) for h in voxel_sizes])
    felt = levels if felt is None else min(felt, levels)
    check_numbers("encode_hash", "at least 0", felt=felt)
    if native.serves(table):
        return _encode_hash(table.contiguous(), points.contiguous(), *place, sparse_grad, felt)
    if sparse_grad:
        table = SparseGrad.apply(table, 1)
    return encode_hash_reference(table, points, *place, felt)


def check_levels(
    op: str, rows: int, lower: Sequence[float], upper: Sequence[float], voxel_sizes: Sequence[float]
) -> None:
    """Check where the lattices of a table of that many rows lie.

    Raises:
        ValueError: corners or voxel_sizes out of range; rows that are no power of two a level.
    """
    levels = len(voxel_sizes)
    for name, corner in (("lower", lower), ("upper", upper)):
        if len(corner) != 3 or not all(math.isfinite(x) for x in corner):
            raise ValueError(f"{op}: {name} must be 3 finite numbers, got {list(corner)}")
    if any(a > b for a, b in zip(lower, upper, strict=True)):
        raise ValueError(f"{op}: lower must be at most upper, got {list(lower)} and {list(upper)}")
    if not levels or not all(0 < h < math.inf for h in voxel_sizes):
        raise ValueError(
            f"{op}: voxel_sizes must be one or more numbers above 0, got {list(voxel_sizes)}"
        )
    each = rows // levels
    if each * levels != rows or each < 1 or each & (each - 1) or each > 2**31:
        raise ValueError(
            f"{op}: the number of rows of table per level must be a power of two, got {rows} "
            f"rows for {levels} levels"
        )


def lattice_sizes(
    lower: Sequence[float], upper: Sequence[float], voxel_sizes: Sequence[float]
) -> list[list[int]]:
    """Nodes of every level along x, y and z."""
    extents = [b - a for a, b in zip(lower, upper, strict=True)]
    # A box that is a whole number of voxels up to rounding gets no node beyond it
    return [[math.ceil(e / h - 1e-6) + 1 for e in extents] for h in voxel_sizes]


def encode_hash_reference(
    table: Tensor,
    points: Tensor,
    lower: Sequence[float],
    upper: Sequence[float],
    voxel_sizes: Sequence[float],
    felt: int | None = None,
) -> Tensor:
    """Reference in eager PyTorch: level by level, corner by corner."""
    rows = len(table) // len(voxel_sizes)
    lost = points.isnan().any(1, keepdim=True)
    points = torch.where(lost, 0.0, points)
    outputs = []
    for level, (h, shape) in enumerate(
        zip(voxel_sizes, lattice_sizes(lower, upper, voxel_sizes), strict=True)
    ):
        points = points.detach() if level == felt else points
        total = table.new_zeros(len(points), table.shape[1])
        for row, weight in _corners(points, lower, h, shape, rows):
            total = total + weight[:, None] * table[level * rows + row]
        outputs.append(torch.where(lost, torch.nan, total))
    return torch.cat(outputs, 1)


def _corners(
    points: Tensor, lower: Sequence[float], h: float, shape: list[int], rows: int
) -> Iterator[tuple[Tensor, Tensor]]:
    """Row [M] in a level's table and weight [M] of each corner of the cells of points."""
    start = torch.tensor(lower, dtype=torch.float64, device=points.device)
    size = torch.tensor(shape, device=points.device)
    # Locate in double, so that a float32 point far from the box's corner keeps its fraction.
    at = (points.double() - start) * (1 / h)
    at = torch.minimum(at.clamp_min(0.0), (size - 1).double())
    cell = torch.minimum(at.detach().long(), (size - 2).clamp_min(0))
    t = (at - cell).to(points.dtype)
    for corner in torch.cartesian_prod(*[torch.arange(2, device=points.device)] * 3):
        weight = torch.where(corner == 1, t, 1 - t).prod(1)
        i, j, k = torch.minimum(cell + corner, size - 1).unbind(1)
        if math.prod(shape) <= rows:
            yield (i * shape[1] + j) * shape[2] + k, weight
        else:
            yield (i ^ (j * PRIMES[1]) ^ (k * PRIMES[2])) & (rows - 1), weight


def rows_read(
    table: Tensor,  # [L * R, F]
    points: Tensor,  # [M, 3]
    lower: Sequence[float],
    upper: Sequence[float],
    voxel_sizes: Sequence[float],
) -> Tensor:
    """Rows [K] int64 of the table that `encode_hash` reads for points, ascending.

    Args:
        table, points, lower, upper, voxel_sizes: as there. A NaN point reads none.

    Raises:
        TypeError, ValueError: as there.
    """
    sizes = check("rows_read", table=(table, "N F"), points=(points, "M 3"))
    check_levels("rows_read", sizes["N"], lower, upper, voxel_sizes)
    if native.serves(table):
        place = place_of([*lower], [*upper], [*voxel_sizes])
        return _touched(table.contiguous(), points.contiguous(), place)[1]
    rows = len(table) // len(voxel_sizes)
    points = points[~points.isnan().any(1)]
    levels = enumerate(zip(voxel_sizes, lattice_sizes(lower, upper, voxel_sizes), strict=True))
    found = [
        level * rows + row
        for level, (h, shape) in levels
        for row, _ in _corners(points, lower, h, shape, rows)
    ]
    return torch.cat(found).unique()


def place_of(lower: list[float], upper: list[float], voxel_sizes: list[float]) -> Place:
    """Levels as the extension takes them; none: no hash table."""
    return lattice_sizes(lower, upper, voxel_sizes), lower or [0.0] * 3, voxel_sizes


def _touched(table: Tensor, points: Tensor, place: Place) -> tuple[Any, Tensor]:
    """The rows that points read, as the extension has them, and as [K] int64, ascending."""
    touched = native.call("hash_rows", table, points, *place)
    rows = torch.empty(len(touched), dtype=torch.int64)
    native.call(touched.write, rows)
    return touched, rows


def gradients(
    table: Tensor,
    points: Tensor,
    grad_out: Tensor,
    place: Place,
    felt: int,
    needs: list[bool],
    sparse: bool,
) -> tuple[Tensor | None, Tensor | None]:
    """Gradients to table and points; None if not needed.

    Args:
        place: as the extension takes it.
        sparse: that to the table holds touched rows only.
    """
    touched = rows = of_table = None
    if needs[0] and sparse:
        touched, rows = _touched(table, points, place)
        of_table = table.new_empty(len(touched), table.shape[1])
    elif needs[0]:
        of_table = torch.empty_like(table)
    of_points = torch.empty_like(points) if needs[1] else None
    filled = of_table, touched, of_points
    native.call("encode_hash_backward", table, points, grad_out, *filled, *place, felt)
    if rows is not None and of_table is not None:
        # They are distinct, in order and inside by construction: checking costs more than they do
        of_table = torch.sparse_coo_tensor(
            rows[None], of_table, table.shape, is_coalesced=True, check_invariants=False
        )
    return of_table, of_points


def _forward(tensors: Sequence, options: Sequence, outputs: Sequence[Tensor]) -> None:
    native.call("encode_hash_forward", *tensors, *outputs, *place_of(*options[:3]))


def _backward(
    saved: Sequence, grads: Sequence[Tensor], options: Sequence, needs: list[bool]
) -> tuple[Tensor | None, Tensor | None]:
    (table, points), (lower, upper, voxel_sizes, sparse, felt) = saved, options
    place = place_of(lower, upper, voxel_sizes)
    return gradients(table, points, grads[0], place, felt, needs, sparse)


@differentiable(
    "table* points*",
    "float[] lower, float[] upper, float[] voxel_sizes, bool sparse_grad, int felt",
    forward=_forward,
    backward=_backward,
)
def _encode_hash(table, points, lower, upper, voxel_sizes, *_):
    return points.new_empty(len(points), len(voxel_sizes) * table.shape[1])
