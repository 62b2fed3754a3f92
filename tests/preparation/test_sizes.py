"""Photographs of differing sizes say what the same photographs say that were not cut."""

import dataclasses

import pytest
import torch
from analytic import photos_of
from cropped import cropped, windows

from univoxel.camera import pixel_rays
from univoxel.color import linear_to_srgb
from univoxel.fields.grid import fit_grid
from univoxel.ops import VisibilityScene
from univoxel.preparation import masks, pose_refinement
from univoxel.preparation.hull import estimate_bounds, hull_sdf, mask_distances, visual_hull
from univoxel.preparation.masks import fitted_masks
from univoxel.preparation.pose_refinement import Edges, contradiction, registered_poses
from univoxel.preparation.prepare import brightness_of, log_gains
from univoxel.render.observations import observe
from univoxel.training.loop import batch_at
from univoxel.training.pixels import split_pixels

VIEWS, SIZE = 16, 64
BOX = torch.full((3,), -0.7), torch.full((3,), 0.7)


@pytest.fixture(scope="module")
def whole():
    photos = photos_of(VIEWS, SIZE)
    return dataclasses.replace(photos, color=photos.color / 4)


@pytest.fixture(scope="module")
def cut(whole):
    photos = cropped(whole)
    assert len(photos.cameras.size_of_each().unique(dim=0)) >= 4
    return photos


def distances(photos):
    return mask_distances(photos.coverage(), photos.cameras)


def test_distances_are_those_of_whole_pictures(whole, cut):
    found, wanted = distances(cut), distances(whole)
    for view, where in enumerate(windows(whole.alpha)):
        assert torch.equal(cut.cameras.cut(view, found[view]), wanted[view][where])
    width, height = cut.cameras.size(1)
    assert found[1, height:].isinf().all()
    assert found[2, :, cut.cameras.size(2)[0] :].isinf().all()
    assert (width, height) != (cut.cameras.width, cut.cameras.height)


def test_the_hull_is_that_of_whole_pictures(whole, cut):
    """Also beyond what the cut ones show: where they end, their silhouettes stay clear."""
    grid = fit_grid(torch.full((3,), -1.0), torch.full((3,), 1.0), 60_000)
    found, wanted = (
        hull_sdf(distances(p), p.cameras, grid.nodes().reshape(-1, 3)) for p in (cut, whole)
    )
    assert torch.equal(found <= 0, wanted <= 0)
    near = wanted.abs() < 3 * grid.voxel_size  # far outside what is not seen is a bound
    torch.testing.assert_close(found[near], wanted[near], atol=1e-5, rtol=0)


def test_the_box_is_that_of_whole_pictures(whole, cut):
    found, wanted = (torch.stack(estimate_bounds(distances(p), p.cameras)) for p in (cut, whole))
    # The first box is as large as pictures are: its grid has nodes at other places
    torch.testing.assert_close(found, wanted, atol=0.03, rtol=0)


@pytest.mark.parametrize("bits", [True, False])
def test_masks_that_are_too_wide_are_taken_in_alike(bits, monkeypatch):
    """Wide masks and a bright background; what is beyond a picture is no background."""
    monkeypatch.setattr(masks, "MIN_PIXELS", 5)
    sharp = photos_of(VIEWS, SIZE)
    wide = (0.5 + 4 - mask_distances(sharp.alpha)).clamp(0, 1)
    behind = 0.5 + 0.4 * torch.rand(sharp.color.shape, generator=torch.Generator().manual_seed(0))
    color = torch.lerp(behind, sharp.color / 4, sharp.alpha[..., None])
    if bits:
        color, wide = (255 * linear_to_srgb(color)).byte(), (255 * wide).round().byte()
    whole = dataclasses.replace(sharp, color=color, alpha=wide)
    cut = cropped(whole)
    (wanted, far), (found, near) = (fitted_masks(p, "auto") for p in (whole, cut))
    assert not torch.equal(wanted.alpha, whole.alpha)
    for view, where in enumerate(windows(whole.alpha)):
        assert torch.equal(found.stored(view)[1], wanted.alpha[view][where])
        assert torch.equal(cut.cameras.cut(view, near[view]), far[view][where])
    width, _ = cut.cameras.size(2)
    assert not found.alpha[2, :, width:].any()  # beyond a picture
    _, as_given = fitted_masks(cut, "given")
    assert as_given[2, :, width:].isinf().all()


def test_contradictions_are_those_of_whole_pictures(whole, cut, monkeypatch):
    generator = torch.Generator().manual_seed(0)
    shift = 0.02 * torch.randn(VIEWS, 3, generator=generator)
    pairs = []
    for photos in (cut, whole):
        pose = photos.cameras.camera_to_world.clone()
        pose[:, :, 3] += shift
        moved = dataclasses.replace(photos.cameras, camera_to_world=pose)
        pairs.append((distances(photos), moved))
    found, wanted = (contradiction(*pair, BOX) for pair in pairs)
    assert wanted > 0.5
    assert found == pytest.approx(wanted, abs=0.01)
    (one, near), (other, far) = ((Edges(d, BOX), cameras) for d, cameras in pairs)
    assert len(one.pixels) == len(other.pixels)
    views = torch.arange(VIEWS)
    less, more = one.missed(near, one.pixels, views), other.missed(far, other.pixels, views)
    # Where a picture ends it no longer says that a point is outside
    assert (less < more + 1e-3).float().mean() > 0.99
    assert ((less - more).abs() < 1e-3).float().mean() > 0.9
    # A ball may be turned as it likes, so its cameras end at other places, but as well
    for name, few in {"STEPS": 60, "RAYS": 128, "VIEWS": 16}.items():
        monkeypatch.setattr(pose_refinement, name, few)
    rest = [contradiction(d, registered_poses(d, c, BOX).corrected(c), BOX) for d, c in pairs]
    assert rest[0] == pytest.approx(rest[1], abs=0.05)
    assert rest[1] < 0


def test_edges_at_a_border_have_the_nearest_distance_beyond_it(cut):
    """As lookups in pictures of one size have it."""
    found = Edges(distances(cut), BOX).extended
    assert found.isfinite().all()
    width, height = cut.cameras.size(2)
    assert torch.equal(
        found[2, :height, width:],
        found[2, :height, width - 1 : width].expand(-1, found.shape[2] - width),
    )


def test_exposures_are_those_of_whole_pictures(whole, cut):
    gains = torch.linspace(-0.5, 0.5, VIEWS)[torch.arange(VIEWS) * 7 % VIEWS]
    grid = fit_grid(*BOX, 20_000)
    hull = visual_hull(distances(whole), whole.cameras, grid)
    found, wanted = (
        log_gains(
            brightness_of(
                dataclasses.replace(p, color=p.color * gains.exp()[:, None, None, None]), hull, grid
            )
        )
        for p in (cut, whole)
    )
    torch.testing.assert_close(found, wanted, atol=1e-5, rtol=0)
    assert wanted.std() > 0.2


def test_points_beyond_a_cut_picture_are_not_seen(whole, cut):
    """A ball that is larger than the object, all opaque: whole pictures see more of it."""
    points = torch.nn.functional.normalize(
        torch.randn(500, 3, generator=torch.Generator().manual_seed(0)), dim=1
    )
    empty = VisibilityScene(
        torch.tensor([[9.0, 9, 9], [9, 9.1, 9], [9, 9, 9.1]]),
        torch.tensor([[0, 1, 2]], dtype=torch.int32),
    )
    opaque = [dataclasses.replace(p, alpha=torch.ones_like(p.alpha)) for p in (whole, cut)]
    more, fewer = (observe(0.75 * points, points, p, empty, 0.01) for p in opaque)
    counts = [torch.bincount(seen.view, minlength=VIEWS) for seen in (fewer, more)]
    assert (counts[0][:3] < counts[1][:3]).all()
    assert torch.equal(counts[0][3::4], counts[1][3::4])  # those that were not cut
    # Of what both see, the same
    keys = [
        seen.view * 500 + torch.repeat_interleave(seen.offsets.diff()) for seen in (fewer, more)
    ]
    both = torch.isin(keys[1], keys[0])
    assert both.sum() == len(keys[0])
    torch.testing.assert_close(fewer.color, more.color[both], atol=1e-5, rtol=0)


def test_what_is_trained_on_is_what_whole_pictures_show(whole, cut):
    split, wanted = (split_pixels(p, distances(p)) for p in (cut, whole))
    for mine, of_whole in ((split.trained, wanted.trained), (split.held_out, wanted.held_out)):
        assert torch.equal(mine[:, 0], of_whole[:, 0])
        one, other = batch_at(cut, mine), batch_at(whole, of_whole)
        assert torch.equal(one.color, other.color)
        assert torch.equal(one.alpha, other.alpha)
        torch.testing.assert_close(one.rays.direction, other.rays.direction, atol=1e-6, rtol=0)
    width, height = cut.cameras.size_of_each().unbind(1)
    view, row, column = split.trained.unbind(1)
    assert ((row < height[view]) & (column < width[view])).all()
    corner = pixel_rays(cut.cameras, torch.tensor(2), torch.tensor([0.5, 0.5]))
    rows, columns = windows(whole.alpha)[2]
    there = torch.tensor([columns.start + 0.5, rows.start + 0.5])
    torch.testing.assert_close(
        corner.direction, pixel_rays(whole.cameras, torch.tensor(2), there).direction
    )
