"""Smoothing at chosen nodes."""

import dataclasses

import pytest
import torch
from bricks import cut
from check_op import same_on_threads

from univoxel.ops import (
    diffuse_rows_,
    diffuse_rows_reference_,
    smooth_rows_,
    smooth_rows_reference_,
)


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("shape", [(6, 5, 7, 3), (2, 1, 4, 1)])
def test_native_equals_reference(order, shape):
    grid = torch.randn(shape, dtype=torch.float64)
    nodes = grid[..., 0].numel()
    rows = torch.randperm(nodes)[: nodes // 2]
    got = smooth_rows_(grid.clone(), rows, 0.3, order)
    torch.testing.assert_close(got, smooth_rows_reference_(grid.clone(), rows, 0.3, order))
    untouched = torch.ones(nodes, dtype=torch.bool).index_fill_(0, rows, False)
    assert torch.equal(got.view(nodes, -1)[untouched], grid.view(nodes, -1)[untouched])


def smoothed_alike(grid, rows, *options):
    """The smoothed grid: the same on any number of threads, of rows in any order."""
    orders = iter([rows, rows, rows[torch.randperm(len(rows))]])
    (found,) = same_on_threads(lambda: [smooth_rows_(grid.clone(), next(orders), 0.3, *options)])
    return found


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("channels", [1, 2, 12])
def test_runs_of_rows_and_shuffled_rows_give_the_same_bits(order, channels):
    # Runs longer than a tile of 16 numbers, up to the end of the grid; several chunks of rows.
    grid = torch.randn(20, 15, 45, channels)
    rows = torch.arange(grid[..., 0].numel())[3:]
    found = smoothed_alike(grid, rows, order)
    wanted = smooth_rows_reference_(grid.clone(), rows, 0.3, order)
    # 25 products of numbers of order 1 in float32
    torch.testing.assert_close(found, wanted, rtol=0, atol=2e-6)


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("shape", [(23, 18, 21), (6, 5, 3)])
@pytest.mark.parametrize("channels", [1, 5])
def test_a_sparse_grid_is_smoothed_as_the_dense_one(order, shape, channels):
    x = [torch.arange(float(n)).double() for n in shape]
    sdf = 0.3 * (x[0][:, None, None] + x[1][:, None] + x[2]) - 0.15 * sum(shape)
    _, pool, bricks = cut(sdf + 0.2 * torch.randn(shape).double(), far=1.0)
    pool = pool[:, None] * torch.linspace(1, 2, channels).double()
    node_rows = bricks.grid_rows()
    stored = (node_rows >= 128) & (torch.rand(shape) < 0.6)
    rows = node_rows[stored].sort().values
    dense = smooth_rows_(pool[node_rows], stored.flatten().nonzero()[:, 0], 0.3, order)
    for found in (
        smooth_rows_(pool.clone(), rows, 0.3, order, bricks),
        smooth_rows_reference_(pool.clone(), rows, 0.3, order, bricks),
    ):
        torch.testing.assert_close(found[node_rows], dense)
        untouched = torch.ones(len(pool), dtype=torch.bool).index_fill_(0, rows, False)
        assert torch.equal(found[untouched], pool[untouched])
    smoothed_alike(pool, rows, order, bricks)


def test_thin_plate_keeps_a_plane_and_lowers_a_bump():
    x = torch.arange(9.0)
    plane = (2 * x[:, None, None] - x[None, :, None] + 0.5 * x).expand(9, 9, 9)[..., None]
    bump = plane.clone()
    bump[4, 4, 4] += 1
    middle = torch.tensor([(4 * 9 + 4) * 9 + 4])
    torch.testing.assert_close(smooth_rows_(plane.clone(), middle, 0.4, 2), plane.contiguous())
    # L L f at the bump is 1 + 6/36
    change = smooth_rows_(bump.clone(), middle, 0.4, 2)[4, 4, 4, 0] - bump[4, 4, 4, 0]
    assert change.item() == pytest.approx(-0.4 * (1 + 1 / 6), rel=1e-5)


@pytest.mark.parametrize("shape", [(9, 8, 70), (2, 1, 4)])
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_diffusion_equals_reference(shape, dtype):
    n = torch.Size(shape).numel()
    rows = torch.randperm(n)[: n // 2].sort().values
    values = torch.randn(len(rows), dtype=dtype)
    found = [
        op(values.clone(), rows, shape, 0.8, 3) for op in (diffuse_rows_, diffuse_rows_reference_)
    ]
    torch.testing.assert_close(*found)
    assert not torch.equal(found[0], values)


def test_diffusion_in_bricks_equals_that_in_the_dense_grid():
    shape = (10, 9, 13)
    x = [torch.arange(float(n)).double() for n in shape]
    sdf = 0.3 * (x[0][:, None, None] + x[1][:, None] + x[2]) - 0.15 * sum(shape)
    _, _, bricks = cut(sdf, far=1.0)
    node_rows = bricks.grid_rows()
    stored = (node_rows >= 128) & (torch.rand(shape) < 0.6)
    of_bricks, order = node_rows[stored].sort()
    values = torch.randn(len(of_bricks)).double()
    dense = torch.empty_like(values)
    dense[order] = values
    diffuse_rows_(dense, stored.flatten().nonzero()[:, 0], shape, 0.8, 4)
    for op in (diffuse_rows_, diffuse_rows_reference_):
        found = op(values.clone(), of_bricks, shape, 0.8, 4, bricks)
        torch.testing.assert_close(found, dense[order])


def test_diffusion_of_nothing_and_of_no_pass_changes_nothing():
    none = torch.zeros(0, dtype=torch.int64)
    assert diffuse_rows_(torch.zeros(0), none, (2, 2, 2), 0.5, 2).numel() == 0
    values = torch.randn(2)
    assert torch.equal(diffuse_rows_(values.clone(), torch.tensor([1, 2]), (2, 2, 2), 1, 0), values)


def test_diffusion_refuses_what_does_not_fit_its_bricks():
    one, rows = torch.ones(1), torch.tensor([128])
    _, _, bricks = cut(torch.linspace(-1, 1, 512).view(8, 8, 8), far=1.0)
    with pytest.raises(ValueError, match="size must be the size"):
        diffuse_rows_(one, rows, (8, 8, 9), 0.5, 1, bricks)
    spare = torch.cat([bricks.place, bricks.place.new_full((1,), -1)])
    wider = dataclasses.replace(bricks, place=spare)
    with pytest.raises(ValueError, match="bricks that stand somewhere"):
        diffuse_rows_(one, torch.tensor([64 * len(bricks.place)]), (8, 8, 8), 0.5, 1, wider)
