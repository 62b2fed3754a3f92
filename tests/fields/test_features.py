"""The hash field: the dense one's distances, features of a table of many resolutions."""

import copy
import math
from dataclasses import replace

import pytest
import torch
from torch import nn

from univoxel.core.records import Rays
from univoxel.fields import field as fields
from univoxel.fields.bricks import BrickDistances
from univoxel.fields.field import (
    COARSEST,
    PER_LEVEL,
    ROWS,
    Field,
    HashField,
    Levels,
    dense_field,
    hash_field,
)
from univoxel.fields.grid import GridShape
from univoxel.ops import encode_hash

GRID = GridShape((-0.7,) * 3, 1.4 / 39, (40, 40, 40))
COUNT = 4  # levels


def ball() -> Field:
    levels = Levels.of(GRID.bounds(), GRID.voxel_size, COUNT)
    field = hash_field(GRID, levels, GRID.nodes().norm(dim=-1) - 0.5)
    torch.manual_seed(0)
    nn.init.normal_(field.features)
    return field


def test_levels_go_from_coarse_to_fine():
    levels = Levels.of(GRID.bounds(), GRID.voxel_size, COUNT)
    sizes = torch.tensor(levels.voxel_sizes)
    assert sizes[0].item() == pytest.approx(1.4 / COARSEST)
    assert sizes[-1].item() == pytest.approx(GRID.voxel_size)
    ratios = sizes[1:] / sizes[:-1]
    assert torch.allclose(ratios, ratios[:1].expand(3))
    assert ratios[0] < 1
    assert Levels.of(GRID.bounds(), 1.0, 2).voxel_sizes == (1.0, 1.0)  # coarser than the coarsest
    assert len(Levels.of(GRID.bounds(), 0.1, 1).voxel_sizes) == 1


def test_distances_are_the_dense_fields_and_features_the_tables():
    field = ball()
    dense = dense_field(GRID, 1, field.sdf.detach().clone())
    points = 1.2 * torch.rand(200, 3) - 0.6
    found, wanted = field.sample(points), dense.sample(points)
    assert torch.equal(found.sdf, wanted.sdf)
    assert torch.equal(found.gradient, wanted.gradient)
    levels = field.levels
    table = encode_hash(field.features, points, levels.lower, levels.upper, levels.voxel_sizes)
    for level in range(COUNT):
        for k in range(PER_LEVEL):
            assert torch.equal(found.features[:, k * COUNT + level], table[:, 2 * level + k])
    vertices, faces = field.isosurface()
    assert (vertices.norm(dim=1) - 0.5).abs().max() < 0.01
    assert len(faces) > 1000


def test_held_channels_get_no_gradient():
    field = ball()
    points = torch.rand(100, 3) - 0.5
    field.features_at(points).square().sum().backward()
    whole = field.features.grad.to_dense()
    field.hold_channels_(COUNT + 1)  # the first of each level, and the second of the coarsest
    held = field.features.grad.to_dense().view(COUNT, ROWS, PER_LEVEL)
    whole = whole.view(COUNT, ROWS, PER_LEVEL)
    assert (held[:, :, 0] == 0).all()
    assert (held[0] == 0).all()
    assert torch.equal(held[1:, :, 1], whole[1:, :, 1])
    assert whole[0, :, 1].any()


def test_tables_may_be_smaller():
    levels = Levels.of(GRID.bounds(), GRID.voxel_size, COUNT, rows=2**10)
    field = hash_field(GRID, levels, GRID.nodes().norm(dim=-1) - 0.5)
    assert field.features.shape == (COUNT * 2**10, PER_LEVEL)
    field.features_at(torch.rand(500, 3) - 0.5).sum().backward()
    touched = field.features.grad.coalesce().indices()[0]
    assert touched.max() < COUNT * 2**10
    field.hold_channels_(COUNT)
    held = field.features.grad.to_dense().view(COUNT, -1, PER_LEVEL)
    assert (held[:, :, 0] == 0).all()
    assert all(level.any() for level in held[:, :, 1])


@pytest.mark.parametrize("finest", [1.0, 0.6, 0.4])  # voxels
def test_rows_near_are_all_that_points_near_the_surface_read(finest):
    field = ball()
    levels = replace(Levels.of(field.bounds(), finest * field.voxel_size, 4), rows=2**14)
    field = HashField(field.distances, levels)
    near = field.rows_near(1.5 * field.voxel_size)
    g = torch.Generator().manual_seed(0)
    direction = torch.nn.functional.normalize(torch.randn(1_000_000, 3, generator=g))
    away = 7 * torch.rand(1_000_000, generator=g) - 3.5  # voxels
    points = direction * (0.5 + field.voxel_size * away[:, None])
    # The node next to a point is up to 0.87 voxels away; and a cube around a near node reaches as
    # far beyond it
    rows = [rows_read(field, points[away.abs() < far]) for far in (0.6, 3.5)]
    assert near[rows[0]].all()
    read = torch.zeros(len(near), dtype=torch.bool)
    read[rows[1]] = True
    assert not (near & ~read).any()
    assert 0 < near.sum() < 0.9 * read.sum()
    assert field.rows_near(math.inf).all()


def rows_read(field: Field, points: torch.Tensor) -> torch.Tensor:
    """Rows of its table that have a say at points."""
    features = field.features_at(points)
    (grad,) = torch.autograd.grad(features.sum(), field.features)
    grad = grad.coalesce()
    return grad.indices()[0][grad.values().abs().sum(1) > 0]


def test_another_grid_keeps_the_features():
    field = ball()
    fine = GridShape((-0.7,) * 3, 1.4 / 79, (80, 80, 80))
    finer = field.resized(fine)
    points = torch.rand(100, 3) - 0.5
    assert torch.equal(finer.features_at(points), field.features_at(points))
    assert finer.sdf.shape == (80, 80, 80)
    assert finer.features.data_ptr() != field.features.data_ptr()
    assert finer.occupied().float().mean() < field.occupied().float().mean()


def test_smoothing_leaves_the_table():
    field = ball()
    before = field.features.detach().clone()
    field.features_at(torch.rand(10, 3)).sum().backward()
    field.smooth_features_(torch.arange(10), 0.1)
    assert torch.equal(field.features, before)


FINE = GridShape((-0.7,) * 3, 1.4 / 199, (200, 200, 200))


@pytest.fixture(scope="module")
def bricks():
    """The ball on a grid so fine that only bricks around its surface are stored."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fields, "DENSE_MOST", 1_000_000)
        return ball().resized(FINE)


def test_distances_of_a_fine_grid_lie_in_bricks(bricks):
    dense = ball()
    assert isinstance(bricks.distances, BrickDistances)
    assert bricks.sdf is bricks.distances.sdf
    assert bricks.sdf.numel() < 0.2 * FINE.nodes_count
    direction = torch.nn.functional.normalize(torch.randn(200, 3), dim=1)
    points = (0.49 + 0.02 * torch.rand(200, 1)) * direction
    found, wanted = bricks.sample(points), dense.sample(points)
    assert torch.equal(found.features, wanted.features)
    torch.testing.assert_close(found.sdf, wanted.sdf, atol=1e-3, rtol=0)  # a voxel is 0.036 there
    assert 0.01 < bricks.occupied().float().mean() < 0.1
    vertices, _ = bricks.isosurface()
    assert (vertices.norm(dim=1) - 0.5).abs().max() < 0.01


def test_bricks_learn_and_grow(bricks):
    """Gradients reach distances and table; where the surface moves, bricks follow."""
    bricks = copy.deepcopy(bricks)
    rays = Rays(torch.tensor([[0.0, 0.1, 2.0]]), torch.tensor([[0.0, 0.0, -1.0]]))
    samples = bricks.march(rays, torch.zeros(1), 2 / FINE.voxel_size)
    assert len(samples.t) > 2
    found = bricks.sample(rays.origin + samples.t[:, None] * rays.direction)
    (found.sdf.sum() + found.features.sum()).backward()
    assert bricks.sdf.grad.coalesce().values().any()
    assert bricks.features.grad.coalesce().values().any()
    before = len(bricks.sdf)
    with torch.no_grad():
        bricks.sdf[128:] -= 3 * FINE.voxel_size  # the ball grows by three voxels
    assert bricks.refresh()
    assert len(bricks.sdf) > before
    assert bricks.sdf is bricks.distances.sdf


def test_a_copy_stands_on_its_own(bricks):
    copied = copy.deepcopy(bricks)
    assert copied.sdf is copied.distances.sdf
    assert copied.sdf is not bricks.sdf
    assert torch.equal(copied.sdf, bricks.sdf)


def test_once_in_bricks_always_in_bricks(bricks):
    assert isinstance(bricks.resized(GRID).distances, BrickDistances)
