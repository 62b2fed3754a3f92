"""Sampling of a sparse grid: against the dense one it stands for."""

from dataclasses import replace

import pytest
import torch
from bricks import cut
from check_op import check_op, grads_of, same_on_threads

from univoxel.core.records import Bricks
from univoxel.ops import sample_dense, sample_sparse, sample_sparse_reference

ORIGIN = [0.125, -0.25, 0.375]
H = 0.25


def case(shape=(9, 10, 11), channels=3, m=60, seed=0, margin=0.2, needs=(True, True, True)):
    """A plane of random bumps through the grid, and points of which some fall outside it."""
    g = torch.Generator().manual_seed(seed)
    nodes = torch.stack(
        torch.meshgrid(*[torch.arange(float(n)).double() for n in shape], indexing="ij"), -1
    )
    sdf = nodes @ torch.tensor([0.5, 0.4, 0.7]).double() - 0.25 * sum(shape)
    sdf = sdf + 0.3 * torch.randn(shape, generator=g, dtype=torch.float64)
    _, pool, bricks = cut(sdf, far=1.0)
    features = torch.randn(len(pool), channels, generator=g, dtype=torch.float64)
    features[:128] = 0
    extent = (torch.tensor(shape) - 1) * H
    points = torch.rand(m, 3, generator=g, dtype=torch.float64) * (1 + 2 * margin) - margin
    # On a float32 lattice, so that both precisions see the same points.
    points = (points * extent + torch.tensor(ORIGIN)).float().double()
    leaves = [t.requires_grad_(n) for t, n in zip((pool, features, points), needs, strict=True)]
    return (*leaves[:2], bricks, leaves[2], ORIGIN, H)


def as_dense(pool, features, bricks, points, *place):
    rows = bricks.grid_rows()
    return pool[rows], features[rows], points, *place


def split(arguments):
    """The same with rows of missing bricks as arguments of their own, without gradient."""
    pools = [a.detach() for a in arguments[:2]]
    leaves = [p[128:].requires_grad_() for p in pools]
    return (*[p[:128] for p in pools], *leaves, *arguments[2:])


def joined(op):
    """An op over what `split` gives: numerical differences see no more than backward does."""
    return lambda sdf, features, *rest: op(
        torch.cat([sdf, rest[0]]), torch.cat([features, rest[1]]), *rest[2:]
    )


def test_native_equals_reference():
    cases = [
        case((5, 6, 6), channels=2, m=20),
        case((1, 1, 1), channels=1, m=5),
        case((2, 1, 9), channels=0, m=10),
        case((4, 4, 3), channels=16, m=3),
        case((5, 4, 4), channels=1, m=5, margin=30.0),
        case((5, 4, 4), channels=1, m=0),
    ]
    check_op(joined(sample_sparse), joined(sample_sparse_reference), [split(c) for c in cases])


@pytest.mark.parametrize("shape", [(40, 35, 70), (17, 9, 10), (9, 33, 4)])
def test_the_same_as_the_dense_grid_it_stands_for(shape):
    """Several slabs, chunks and threads; gradients of missing nodes are 0."""
    arguments = case(shape, channels=8, m=5000)
    assert (arguments[2].table < 2).any()
    dense = [t.detach().requires_grad_() if isinstance(t, torch.Tensor) else t
             for t in as_dense(*arguments)]  # fmt: skip
    for a, b in zip(sample_sparse(*arguments), sample_dense(*dense), strict=True):
        torch.testing.assert_close(a, b)
    wanted, rows = grads_of(sample_dense, dense), arguments[2].grid_rows()
    stored = rows >= 128
    for options in ({}, {"sparse_grad": True}):
        got = same_on_threads(
            lambda o=options: [g.to_dense() for g in grads_of(sample_sparse, arguments, **o)]
        )
        for k in (0, 1):
            assert not got[k][:128].any()
            torch.testing.assert_close(got[k][rows][stored], wanted[k][stored])
        torch.testing.assert_close(got[2], wanted[2])


def test_sparse_rows_are_the_touched_ones():
    """One point in the middle: 8 rows of features, 32 of the sdf."""
    _, pool, bricks = cut(torch.linspace(-0.5, 0.5, 30)[:, None, None].expand(30, 30, 30), 1.0)
    pool, features = pool.requires_grad_(), torch.zeros(len(pool), 2, requires_grad=True)
    points = torch.tensor([[15.5, 7.5, 11.5]])  # across three borders of bricks
    arguments = (pool, features, bricks, points, (0, 0, 0), 1.0)
    g_sdf, g_features = grads_of(sample_sparse, arguments, sparse_grad=True)
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
