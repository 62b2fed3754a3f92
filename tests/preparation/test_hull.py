"""Bounds and visual hull from silhouettes of a sphere."""

from dataclasses import replace

import pytest
import torch
from analytic import RADIUS, cameras_around, sphere_normals

from univoxel.camera import Cameras
from univoxel.fields.grid import GridShape, fit_grid, resample
from univoxel.preparation import hull, object_shape
from univoxel.preparation.stereo import DepthMaps


@pytest.fixture(scope="module")
def silhouettes():
    cameras = cameras_around(24, size=64)
    alpha = torch.stack([sphere_normals(cameras, v)[1] for v in range(24)]).float()
    return hull.mask_distances(alpha), cameras


def test_mask_distance_is_signed_and_subpixel():
    alpha = torch.zeros(1, 9, 9)
    alpha[:, 2:7, 2:7] = 1
    alpha[:, 2:7, 7] = 0.25
    d = hull.mask_distances(alpha)[0]
    assert d[4, 4] == -2.5  # the middle of a square of side 5
    assert d[4, 0] == 1.5  # two pixels left of the first covered one, whose edge is half nearer
    assert d[4, 7] == 0.25  # a quarter covered: the edge lies a quarter pixel inwards of its middle
    assert (hull.mask_distances(torch.zeros(1, 4, 6)) == 6).all()
    # The edge of a picture is no silhouette
    alpha = torch.zeros(3, 8, 12)
    alpha[0, 3:] = 1  # leaves the picture below, left and right
    alpha[1] = 1
    alpha[2, 2:6, 4:8] = 1
    d = hull.mask_distances(alpha)
    assert (d[0, 7] == -4.5).all()  # as deep as the one edge is far
    assert (d[1] == -12).all()
    assert (d[0].abs() < 1).sum() == 24  # the rows at that edge
    assert d[2, 3, 5] == -1.5


def test_votes_keep_what_one_mask_lacks(silhouettes):
    distance, cameras = silhouettes
    bitten = distance.clone()
    bitten[5] = 64.0  # a view that shows nothing
    points = torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.0, 1.5 * RADIUS]])
    assert (hull.hull_sdf(bitten, cameras, points) > 0).all()
    inside, outside = hull.hull_sdf(bitten, cameras, points, votes=2)
    assert inside < 0 < outside
    # The second largest of the views' values, by definition
    each = torch.stack(
        [hull.hull_sdf(bitten[v : v + 1], cameras.of(torch.tensor([v])), points) for v in range(24)]
    )
    torch.testing.assert_close(
        hull.hull_sdf(bitten, cameras, points, votes=2), each.sort(0, descending=True).values[1]
    )


def test_as_many_votes_are_needed_as_bad_masks_are_outvoted_by():
    assert [hull.votes_needed(n) for n in (1, 4, 6, 12, 40, 135)] == [1, 1, 2, 2, 3, 9]
    assert hull.views_needed(100, 1) == 1
    assert hull.views_needed(100, 7) == 25
    assert hull.views_needed(2, 2) == 1


def test_bounds_enclose_the_sphere_with_little_to_spare(silhouettes):
    lower, upper = hull.estimate_bounds(*silhouettes)
    assert (lower < -RADIUS).all()
    assert (upper > RADIUS).all()
    # margin: 3 % of the diagonal and a voxel, on top of a hull that is somewhat larger
    assert (upper - lower).max() < 2 * RADIUS * 1.35
    distance, cameras = silhouettes
    with pytest.raises(ValueError, match="silhouettes of the photographs have no common volume"):
        hull.estimate_bounds(torch.full_like(distance, 5.0), cameras)


def test_hull_is_the_sphere_up_to_its_facets(silhouettes):
    grid = fit_grid(torch.full((3,), -0.7), torch.full((3,), 0.7), 40**3)
    sdf = hull.visual_hull(*silhouettes, grid)
    true = grid.nodes().norm(dim=-1) - RADIUS
    near = true.abs() < 0.1
    # One pixel is 2 / (64 * 2 / 1.8) = 0.028 wide at the sphere; 24 facets bulge by about as much.
    assert (sdf - true)[near].abs().max() < 0.06
    assert (sdf - true)[near].mean().abs() < 0.02
    assert (sdf[true > 0.15] > 0).all()
    assert (sdf[true < -0.05] < 0).all()


def test_points_that_no_view_sees_are_outside(silhouettes):
    behind_everything = torch.tensor([[0.0, 0.0, 50.0], [0.0, 0.0, 0.0]])
    sdf = hull.hull_sdf(*silhouettes, behind_everything)
    assert sdf[0] > 0
    assert sdf[1] < 0


def test_a_silhouette_cut_by_the_border_says_nothing_beyond_it(silhouettes):
    distance, cameras = silhouettes
    pose, focal, centre = cameras.camera_to_world, cameras.focal, cameras.centre
    one = Cameras(pose[:1], focal[:1], centre[:1], 64, 64)
    beside = -1.5 * pose[:1, :, 0]  # left of the picture
    assert hull.hull_sdf(distance[:1], one, beside) > 0
    assert hull.hull_sdf(torch.full((1, 64, 64), -3.0), one, torch.zeros(1, 3)) < 0
    assert hull.hull_sdf(torch.full((1, 64, 64), -3.0), one, beside) == torch.inf  # nobody sees it


def test_fit_grid_has_cubic_voxels_and_covers_the_box():
    grid = fit_grid(torch.tensor([-1.0, 0.0, 0.0]), torch.tensor([1.0, 1.0, 0.5]), 1000)
    upper = torch.tensor(grid.origin) + grid.voxel_size * (torch.tensor(grid.size) - 1)
    assert (torch.tensor(grid.origin) <= torch.tensor([-1.0, 0.0, 0.0]) + 1e-6).all()
    assert (upper >= torch.tensor([1.0, 1.0, 0.5]) - 1e-6).all()
    assert 1000 <= (torch.tensor(grid.size) - 1).prod() <= 1800


def test_resampling_keeps_a_linear_function():
    source = GridShape((-1.0, 0.0, 0.5), 0.25, (9, 6, 5))
    target = GridShape((-0.9, 0.1, 0.6), 0.1, (15, 11, 8))
    weights = torch.tensor([1.0, -2.0, 0.5])
    values = source.nodes() @ weights
    torch.testing.assert_close(resample(values, source, target), target.nodes() @ weights)
    two = torch.stack([values, 3 * values], -1)
    torch.testing.assert_close(
        resample(two, source, target)[..., 1], 3 * (target.nodes() @ weights)
    )


def test_what_few_views_see_is_carved_by_half_of_them_and_ends_where_too_few_do(silhouettes):
    """Beyond the pictures of most, as with masks that are cut off by their edges."""
    distance, cameras = silhouettes
    few = cameras.of(torch.tensor([0, 1, 2]))
    above = torch.tensor([[0.0, 0.0, 1.5 * RADIUS]])  # in the pictures of all
    ball = torch.zeros(1, 3)
    assert (hull.hull_sdf(distance[:3], few, above, votes=8) > 0).all()  # eight there are not
    assert (hull.hull_sdf(distance[:3], few, ball, votes=8) < 0).all()
    assert (hull.hull_sdf(distance[:3], few, ball, votes=8, seen_by=3) < 0).all()
    assert hull.hull_sdf(distance[:3], few, ball, votes=8, seen_by=4).isposinf().all()


def test_distances_of_large_pictures_are_those_of_smaller_ones():
    """Of a disk, whose distance is known; half-covered pixels on its edge."""
    side, radius = 1200, 350.0
    place = torch.arange(side) + 0.5 - side / 2
    true = (place[:, None].square() + place.square()).sqrt() - radius
    found = hull.mask_distances((0.5 - true).clamp(0, 1)[None])[0]
    near = true.abs() < 5
    off = (found - true).abs()
    assert off[near].max() < 1  # half a pixel of the smaller picture, and its distance's own error
    assert off[near].median() < 0.25
    assert abs(float((found - true)[near].mean())) < 0.05
    assert off.max() < 2  # of hundreds
    kept = hull.mask_distances((0.5 - true).clamp(0, 1)[None, 101:1100, 101:1100])[0]
    assert (kept - true[101:1100, 101:1100]).abs().max() < 0.51  # of 999 pixels: not shrunk


@pytest.mark.parametrize("votes", [1, 3])
def test_kernels_of_points_are_as_their_references(votes):
    """With cut silhouettes, pictures of two sizes and points beside, behind and in the object."""
    generator = torch.Generator().manual_seed(0)
    cameras = cameras_around(7, 40)
    cameras = replace(cameras, sizes=torch.tensor([[40, 40], [40, 31]]).repeat(4, 1)[:7])
    distance = torch.randn(7, 40, 40, generator=generator) * 20 + 5
    distance[:3, [0, -1]] = distance[:3, :, [0, -1]] = 3.0  # these stay clear of the border
    points = 3 * torch.randn(5000, 3, generator=generator)
    for seen_by, wider in ((1, 0.0), (4, 1.5)):
        given = distance, cameras, points, votes, seen_by, wider
        one, two = hull.hull_sdf(*given), hull.hull_sdf_reference(*given)
        # Where a point is just on a picture's border, or depths are tiny, rounding decides
        close = torch.isclose(one, two, rtol=1e-4, atol=1e-4) | (one == two)
        assert close.float().mean() > 0.998
    grid = fit_grid(torch.tensor([-1.02, -0.93, -1.07]), torch.full((3,), 1.01), 4000)
    known = torch.rand(7, 40, 40, generator=generator) > 0.3
    maps = DepthMaps(cameras, 2 + torch.rand(7, 40, 40, generator=generator), known, 0.1)
    masks = [cameras.cut(v, known[v]).float() for v in range(7)]
    found = object_shape.votes(masks, maps, grid)
    nodes, band = grid.nodes().reshape(-1, 3), object_shape.BAND * grid.voxel_size
    sums = object_shape.votes_reference(masks, maps, nodes, band)
    for one, two in zip(vars(found).values(), sums, strict=True):
        assert torch.isclose(one.flatten(), two, atol=1e-4).float().mean() > 0.998
        assert two.any()
