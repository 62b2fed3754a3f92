"""Fields of distances that are kept so; boxes."""

import pytest
import torch
from analytic import cameras_around
from sphere_in_room import SIZE, VIEWS

from univoxel.errors import NothingFound
from univoxel.fields.field import dense_field
from univoxel.grid import fit_grid
from univoxel.segmentation import distances


def test_a_field_without_an_inside_is_nothing():
    grid = fit_grid(-torch.ones(3), torch.ones(3), 10**3)
    with pytest.raises(NothingFound, match="no object was found"):
        distances.redistance_(dense_field(grid, 1, torch.ones(grid.size)))


def test_what_cameras_look_at_is_the_box():
    cameras = cameras_around(VIEWS, SIZE)
    lower, upper = distances.surroundings(cameras)
    torch.testing.assert_close(lower, -upper, atol=1e-4, rtol=0)
    assert 0.8 < float(upper[0]) < 0.9  # a sphere of 0.8 is seen whole, at distance 2


def test_small_parts_are_chaff():
    grid = fit_grid(-torch.ones(3), torch.ones(3), 20**3)
    node = grid.nodes()
    ball = (node - torch.tensor([0.3, 0.0, 0.0])).norm(dim=-1) - 0.4
    speck = (node + torch.tensor([0.8, 0.0, 0.0])).norm(dim=-1) - 0.08
    field = dense_field(grid, 1, torch.minimum(ball, speck))
    near = ball.abs() < 0.1
    distances.redistance_(field)
    assert (field.sdf[speck < 0] < 0).all()
    distances.redistance_(field, whole=True)
    assert (field.sdf[speck < 0] > 0).all()
    assert torch.equal(field.sdf[near], ball[near])
    # Distances to the centres of voxels are off by up to half a diagonal
    assert (field.sdf - ball).abs().max() < 0.9 * grid.voxel_size


@pytest.mark.parametrize(
    "box", [(0, 0, 0, 1, 1), (0, 0, 0, 1, 1, 0), (0, 0, 0, 1, 1, float("nan"))]
)
def test_boxes_that_are_none(box):
    with pytest.raises(ValueError, match="box: expected X Y Z of the lower corner"):
        distances.corners(box)


def test_a_box_that_is_one():
    lower, upper = distances.corners((0.0, 1.0, 2.0, 3.0, 4.0, 5.0))
    assert lower.tolist() == [0, 1, 2]
    assert upper.tolist() == [3, 4, 5]
