"""Rows of tables and nodes of grids: Adam on some of them, sums of gradients, smoothing."""

import dataclasses

import pytest
import torch
from bricks import cut
from op_cases import lists

from univoxel.ops import (
    adam_rows_,
    diffuse_rows_,
    diffuse_rows_reference_,
    smooth_rows_,
    smooth_rows_reference_,
    sum_rows,
    sum_rows_reference,
)


@pytest.mark.parametrize(("lr", "eps"), [(0.1, 1.0), (0.1, 0.0), (0.0, 1.0)])
def test_first_step_of_adam_in_closed_form(lr, eps):
    """From zero moments the corrected ones are g and g^2: the step is lr g / (|g| + eps)."""
    param, grad = torch.zeros(3, 1).double(), torch.tensor([[4.0], [-2.0]]).double()
    moments, rows = torch.zeros(2, 3, 1).double(), torch.tensor([2, 0])
    numbers = {"lr": lr, "beta1": 0.9, "beta2": 0.99, "eps": eps, "step": 1}
    adam_rows_(param, *moments.unbind(), rows, grad, **numbers)
    assert param[:, 0].tolist() == pytest.approx([lr * 2 / (2 + eps), 0.0, -lr * 4 / (4 + eps)])


def test_a_sum_of_rows_is_that_of_sparse_tensors():
    given = lists(1, (100_003,), (0.03, 0.5))
    parts = [
        torch.sparse_coo_tensor(r[None], v, (100_003, 2), check_invariants=True)
        for r, v in zip(given["rows"], given["values"], strict=True)
    ]
    whole = (parts[0] + parts[1]).coalesce()
    row, total = sum_rows(**given)
    assert torch.equal(row, whole.indices())
    torch.testing.assert_close(total, whole.values())


@pytest.mark.parametrize("row", [[5, 5], [5, 4], [-1, 3], [3, 10]])
def test_the_reference_refuses_rows_that_do_not_ascend_in_the_table(row):
    with pytest.raises(ValueError, match=r"rows must be in ascending order in \[0, 10\)"):
        sum_rows_reference([torch.tensor(row)], [torch.ones(2, 3)], [10])


@pytest.mark.parametrize("order", [1, 2])
def test_rows_come_in_any_order_and_others_stay(order):
    grid = torch.randn(6, 5, 45, 3)
    nodes = grid[..., 0].numel()
    rows = torch.randperm(nodes)[: nodes // 2]
    got, ordered = (smooth_rows_(grid.clone(), r, 0.3, order) for r in (rows, rows.sort().values))
    assert torch.equal(got, ordered)
    # 25 products of numbers of order 1 in float32
    wanted = smooth_rows_reference_(grid.clone(), rows, 0.3, order)
    torch.testing.assert_close(got, wanted, rtol=0, atol=2e-6)
    untouched = torch.ones(nodes, dtype=torch.bool).index_fill_(0, rows, False)
    assert torch.equal(got.view(nodes, -1)[untouched], grid.view(nodes, -1)[untouched])


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
    shuffled = rows[torch.randperm(len(rows))]
    one, other = (smooth_rows_(pool.clone(), r, 0.3, order, bricks) for r in (rows, shuffled))
    assert torch.equal(one, other)


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
