"""Sampling of fields: what all samplers share, and definitions of each."""

from dataclasses import replace

import pytest
import torch
from bricks import cut
from op_cases import (
    CASES,
    H,
    doubled,
    flat,
    fresh,
    function,
    grid,
    hash_grid,
    leaves_of,
    projection,
    uniform,
)
from torch import Tensor

from univoxel.core.records import Bricks
from univoxel.ops import (
    encode_hash,
    sample_dense,
    sample_dense_reference,
    sample_sparse,
    use_backend,
)
from univoxel.ops.hash_grid import lattice_sizes, rows_read

POINTS = ["sample_dense", "sample_sparse", "encode_hash"]
SAMPLERS = [*POINTS, "composite_field", "composite_field of bricks"]
BACKENDS = pytest.mark.parametrize("backend", ["native", "reference"])


def gradients(case: str, arguments: dict, **options) -> dict[str, Tensor]:
    arguments, leaves = fresh(case, arguments, **options)
    out = [o.nan_to_num() for o in flat(function(case)(**arguments))]
    return dict(zip(leaves_of(case), torch.autograd.grad(projection(out), leaves), strict=True))


def tables(case: str) -> list[str]:
    """Arguments that have a sparse gradient."""
    return [name for name in leaves_of(case) if name in ("sdf", "features", "table")]


@BACKENDS
@pytest.mark.parametrize("case", SAMPLERS)
def test_sparse_gradients_are_the_dense_ones(case, backend):
    given = doubled(CASES[case](20))
    with use_backend(backend):
        dense, sparse = (gradients(case, given, sparse_grad=s) for s in (False, True))
    for name, wanted in dense.items():
        got = sparse[name]
        assert got.is_sparse == (name in tables(case))
        if got.is_sparse:
            assert got.is_coalesced()
            assert got.dense_dim() == (name != "sdf")
            checked = torch.sparse_coo_tensor(
                got.indices(), got.values(), got.shape, check_invariants=True
            )
            assert torch.equal(checked.coalesce().indices(), got.indices()), "double or unsorted"
        torch.testing.assert_close(got.to_dense(), wanted, rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("sparse", [False, True])
@pytest.mark.parametrize("case", SAMPLERS)
def test_a_gradient_alone_is_as_among_others(case, sparse):
    given = doubled(CASES[case](20))
    for name in leaves_of(case):
        alone, among = (fresh(case, given, sparse_grad=sparse)[0] for _ in range(2))
        for other in leaves_of(case):
            alone[other].requires_grad_(other == name)
        outputs, wanted = (flat(function(case)(**a)) for a in (alone, among))
        wanted = [w for w, out in zip(wanted, outputs, strict=True) if out.requires_grad]
        (got,) = torch.autograd.grad(projection(outputs), alone[name])
        (wanted,) = torch.autograd.grad(projection(wanted), among[name])
        assert got.is_sparse == (sparse and name in tables(case))
        torch.testing.assert_close(got.to_dense(), wanted.to_dense())


@BACKENDS
@pytest.mark.parametrize("sparse", [False, True])
@pytest.mark.parametrize("case", POINTS)
def test_points_that_are_nowhere(case, sparse, backend):
    """What is no number stays at its point; what is infinitely far is at the border."""
    given = CASES[case](50)
    given["points"][3, 1], given["points"][7] = torch.nan, torch.nan
    given["points"][9, 0], given["points"][11] = torch.inf, -torch.inf
    lost = torch.zeros(50, dtype=torch.bool)
    lost[[3, 7]] = True
    with use_backend(backend):
        for out in flat(function(case)(**given)):
            assert torch.equal(out.reshape(50, -1).isnan().any(1), lost)
            assert torch.equal(out.reshape(50, -1).isnan().all(1), lost)
        found = gradients(case, given, sparse_grad=sparse)
    assert all(g.to_dense().isfinite().all() for g in found.values())
    assert not found["points"][[3, 7, 11]].any()


@pytest.mark.parametrize("case", SAMPLERS)
def test_sparse_gradients_accumulate(case):
    given = doubled(CASES[case](20))
    once = gradients(case, given)
    arguments, _ = fresh(case, given, sparse_grad=True)
    for _ in range(2):
        projection(flat(function(case)(**arguments))).backward()
    for name in tables(case):
        torch.testing.assert_close(arguments[name].grad.to_dense(), 2 * once[name])


ONE = (0.0, 0.0, 0.0), 1.0  # a grid whose nodes are integers


def test_definition_of_a_dense_grid():
    """Value is linear, gradient the central difference of the interpolant, borders clamped."""
    given = grid(200, (4, 5, 6), channels=2, margin=0.3)
    sdf, features, points = (given[k].double() for k in ("sdf", "features", "points"))
    low = torch.tensor(given["origin"]).double()
    value, gradient, feature = sample_dense(sdf, features, points, given["origin"], H)
    high = low + (torch.tensor(sdf.shape) - 1) * H
    inside = torch.minimum(torch.maximum(points, low), high)

    def interpolant(p):
        at = ((p - low) / (high - low) * 2 - 1).flip(-1)[None, None, None]
        options = {"align_corners": True, "padding_mode": "border"}
        return torch.nn.functional.grid_sample(sdf[None, None], at, **options).flatten()

    torch.testing.assert_close(value, interpolant(points))
    for axis in range(3):
        step = torch.zeros(3).double()
        step[axis] = H
        central = (interpolant(inside + step) - interpolant(inside - step)) / (2 * H)
        torch.testing.assert_close(gradient[:, axis], central)
    alone, *_ = sample_dense(features[..., 1], features, points, given["origin"], H)
    torch.testing.assert_close(feature[:, 1], alone)


def test_sparse_rows_of_a_dense_grid_are_the_touched_ones():
    """One point in the middle: 8 rows of features, 32 of the sdf, none of the far grid."""
    leaves = uniform(30, 30, 30).requires_grad_(), uniform(30, 30, 30, 3).requires_grad_()
    points = torch.tensor([[12.5, 7.5, 15.5]])  # across three brick borders
    out = sample_dense(*leaves, points, *ONE, sparse_grad=True)
    g_sdf, g_features = torch.autograd.grad(sum(o.square().sum() for o in out), leaves)
    assert g_sdf._nnz() == 32
    assert g_features._nnz() == 8
    assert g_features.indices().T.tolist() == [
        [x, y, z] for x in (12, 13) for y in (7, 8) for z in (15, 16)
    ]


def test_far_origin_keeps_the_fraction_of_a_float32_point():
    given = grid(40, (6, 6, 6))
    sdf, features, far = given["sdf"], given["features"], given["points"] + 100
    origin = [99.0] * 3
    value = sample_dense(sdf, features, far, origin, H)[0]
    double = (t.double() for t in (sdf, features, far))
    expected = sample_dense_reference(*double, origin, H)[0]
    torch.testing.assert_close(value.double(), expected, rtol=1e-5, atol=1e-6)


def test_sparse_rows_of_bricks_are_the_touched_ones():
    """One point in the middle: 8 rows of features, 32 of the sdf."""
    _, pool, bricks = cut(torch.linspace(-0.5, 0.5, 30)[:, None, None].expand(30, 30, 30), 1.0)
    pool, features = pool.requires_grad_(), torch.ones(len(pool), 2, requires_grad=True)
    points = torch.tensor([[15.5, 7.5, 11.5]])  # across three borders of bricks
    arguments = (pool, features, bricks, points, (0, 0, 0), 1.0)
    out = sum(o.square().sum() for o in sample_sparse(*arguments, sparse_grad=True))
    g_sdf, g_features = torch.autograd.grad(out, (pool, features))
    assert g_sdf._nnz() == 32
    nodes = torch.tensor([[x, y, z] for x in (15, 16) for y in (7, 8) for z in (11, 12)])
    assert set(bricks.rows(nodes).tolist()) == set(g_features.indices()[0].tolist())


def test_a_missing_node_is_far_and_without_features():
    """Deep outside, inside, and where a sample meets both a stored and a missing brick."""
    x = torch.arange(20.0)[:, None, None].expand(20, 4, 4)
    _, pool, bricks = cut(x - 9.5, far=1.0)  # bricks 2 (nodes 8 .. 11) alone is stored
    assert (bricks.table >= 2).sum() == 1
    features = torch.ones(len(pool), 1)
    features[:128] = 0
    points = torch.tensor([[15.0, 1.0, 1.0], [2.0, 1.0, 1.0], [11.25, 1.0, 1.0]])
    value, gradient, feature = sample_sparse(pool, features, bricks, points, (0, 0, 0), 1.0)
    assert value.tolist() == [1.0, -1.0, 1.0]
    assert not gradient[:2].any()
    assert feature[:, 0].tolist() == [0.0, 0.0, 0.75]


BRICKS = Bricks(
    torch.tensor([[[0, 2], [3, 1]]]).int(), torch.tensor([-1, -1, 1, 2]).int(), (3, 8, 5)
)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"table": BRICKS.table.long()}, r"table must be \[1, 2, 2\] int32"),
        ({"size": (5, 8, 5)}, r"table must be \[2, 2, 2\] int32 for size \[5, 8, 5\], got"),
        ({"place": torch.zeros(1).int()}, r"place must be \[2\] int32"),
        ({"table": torch.tensor([[[0, 2], [4, 1]]]).int()}, "table must hold each of 4 bricks"),
        ({"table": torch.tensor([[[0, 2], [2, 1]]]).int()}, "table must hold each of 4 bricks"),
        ({"table": torch.tensor([[[-1, 2], [3, 1]]]).int()}, "table must hold each of 4 bricks"),
        ({"place": torch.tensor([-1, -1, 2, 1]).int()}, "table must hold each of 4 bricks"),
    ],
)
def test_bricks_that_do_not_fit(change, message):
    with pytest.raises(ValueError, match=message):
        replace(BRICKS, **change)


def test_rows_and_corners():
    assert BRICKS.corners(torch.tensor([2, 3])).tolist() == [[0, 0, 4], [0, 4, 0]]
    assert BRICKS.rows(torch.tensor([[2, 7, 1], [0, 0, 0]])).tolist() == [3 * 64 + 32 + 12 + 1, 0]
    assert BRICKS.grid_rows().shape == (3, 8, 5)


LOWER, UPPER = [0.125, -0.25, 0.375], [1.125, 0.5, 1.875]


def case(voxel_sizes, rows=32, features=2, m=30):
    """A random table, and points of which some fall outside the box, in double."""
    table = hash_grid(1, voxel_sizes, rows, features)["table"].double().requires_grad_()
    lower, upper = torch.tensor(LOWER), torch.tensor(UPPER)
    share = 1.4 * torch.rand(m, 3, generator=torch.Generator().manual_seed(0)) - 0.2
    points = (lower + (upper - lower) * share).double().requires_grad_()
    return table, points, LOWER, UPPER, list(voxel_sizes)


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
    table, points, *place, sizes = case((0.5, 0.2, 0.1))
    pull = torch.randn(30, 6, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    with use_backend(backend):
        got, wanted = (
            torch.autograd.grad(
                encode_hash(table, points, *place, sizes, **o), (table, points), pull
            )
            for o in ({"felt": felt}, {})
        )
    assert torch.equal(got[0], wanted[0])
    # By parts: a level's own output, with the gradient that the whole has there
    total = torch.zeros_like(points)
    for level in range(min(felt, 3)):
        rows = table[32 * level : 32 * level + 32]
        out = encode_hash(rows, points, *place, [sizes[level]])
        total += torch.autograd.grad(out, points, pull[:, 2 * level : 2 * level + 2])[0]
    torch.testing.assert_close(got[1], total)


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
