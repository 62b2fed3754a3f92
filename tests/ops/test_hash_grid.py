"""Hash encoding: native against reference, definitions."""

import pytest
import torch
from check_op import check_op, grads_of

from univoxel.ops import encode_hash, encode_hash_reference, use_backend
from univoxel.ops.hash_grid import lattice_sizes, rows_read

LOWER, UPPER = [0.125, -0.25, 0.375], [1.125, 0.5, 1.875]


def case(voxel_sizes=(0.5, 0.2), rows=32, features=2, m=30, seed=0, needs=(True, True)):
    """A random table, and points of which some fall outside the box."""
    g = torch.Generator().manual_seed(seed)
    table = torch.randn(len(voxel_sizes) * rows, features, generator=g, dtype=torch.float64)
    lower, upper = torch.tensor(LOWER), torch.tensor(UPPER)
    points = lower + (upper - lower) * (1.4 * torch.rand(m, 3, generator=g) - 0.2)
    # On a float32 lattice, so that both precisions see the same points.
    leaves = [t.requires_grad_(n) for t, n in zip((table, points.double()), needs, strict=True)]
    return (*leaves, LOWER, UPPER, list(voxel_sizes))


def test_native_equals_reference():
    check_op(
        encode_hash,
        encode_hash_reference,
        [
            case(),
            case((0.3,), rows=512, features=4),  # every node has a row of its own
            case((0.9, 0.4, 0.15), rows=2, features=3),  # many nodes share one
            case((5.0,), rows=8, features=1),  # one cell
            case(needs=(True, False)),
            case(m=0),
        ],
    )


def test_a_level_that_fits_is_a_dense_grid():
    """Its value is torch's own trilinear lookup, clamped to the border."""
    h, rows = 0.25, 512
    table, points, *_ = case((h,), rows=rows, features=3, m=200)
    shape = lattice_sizes(LOWER, UPPER, [h])[0]
    assert shape == [5, 4, 7]
    grid = table[: 5 * 4 * 7].view(5, 4, 7, 3).permute(3, 0, 1, 2)[None].detach()
    low, high = torch.tensor(LOWER).double(), torch.tensor(UPPER).double()
    at = ((points - low) / (high - low) * 2 - 1).flip(-1)[None, None, None].detach()
    wanted = torch.nn.functional.grid_sample(
        grid, at, align_corners=True, padding_mode="border"
    ).flatten(1)[:3]
    got = encode_hash(table, points, LOWER, UPPER, [h])
    torch.testing.assert_close(got, wanted.view(3, -1).T)


def test_hash_of_a_node():
    """A point on a node reads the row that the formula names."""
    table = torch.arange(16.0)[:, None]
    node = (3, 5, 2)
    row = (node[0] ^ node[1] * 2654435761 ^ node[2] * 805459861) % 16
    point = torch.tensor([node], dtype=torch.float32)
    assert encode_hash(table, point, [0] * 3, [9] * 3, [1.0]).item() == row


@pytest.mark.parametrize(
    ("backend", "felt"),
    [("native", 0), *((b, n) for b in ("native", "reference") for n in (1, 2, 5))],
)
def test_only_the_levels_that_are_felt_move_points(backend, felt):
    arguments = case((0.5, 0.2, 0.1))
    with use_backend(backend):
        table, points = grads_of(encode_hash, arguments, felt=felt)
        wanted = grads_of(encode_hash, arguments)
    assert torch.equal(table, wanted[0])
    # By parts: a level's own output, with the gradient that the whole has there
    pull = torch.randn(30, 6, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    total = torch.zeros_like(points)
    for level in range(min(felt, 3)):
        rows = arguments[0][32 * level : 32 * level + 32]
        out = encode_hash(rows, arguments[1], LOWER, UPPER, [arguments[4][level]])
        (alone,) = torch.autograd.grad(out, arguments[1], pull[:, 2 * level : 2 * level + 2])
        total += alone
    torch.testing.assert_close(points, total)


@pytest.mark.parametrize("backend", ["native", "reference"])
def test_rows_read_are_those_that_get_a_gradient(backend):
    arguments = case((0.5, 0.05), rows=4096, m=40)
    points = arguments[1].detach()
    inside = points.clone()
    points[7] = torch.nan
    with use_backend("native"):
        (grad,) = torch.autograd.grad(
            encode_hash(arguments[0], points, *arguments[2:], sparse_grad=True).nansum(),
            arguments[0],
        )
    with use_backend(backend):
        got = rows_read(arguments[0], points, *arguments[2:])
        more = rows_read(arguments[0], inside, *arguments[2:])
        none = rows_read(arguments[0], points[:0], *arguments[2:])
    assert torch.equal(got, grad.indices()[0])
    assert len(more) > len(got)
    assert (none.dtype, len(none)) == (torch.int64, 0)
    with pytest.raises(ValueError, match="rows_read: lower must be at most upper"):
        rows_read(arguments[0], points, [9.0] * 3, [0.0] * 3, [0.5])
