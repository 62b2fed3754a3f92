"""Rough masks of a ball whose outline is known: what is doubted, and what is left."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from analytic import RADIUS, cameras_at, on_circle, photos_of
from scipy.spatial.transform import Rotation

from lab.stress.damage import turned
from univoxel.camera import Cameras
from univoxel.data import Photos
from univoxel.errors import DataError
from univoxel.fields.grid import fit_grid
from univoxel.preparation import pose_refinement, prepare
from univoxel.preparation.hull import hull_sdf, mask_distances
from univoxel.preparation.object_shape import ObjectShape, silhouettes
from univoxel.preparation.pose_refinement import MAX_CONTRADICTION, Belief, choose_masks_or_poses
from univoxel.preparation.rough_masks import doubt_masks, thick, undo_moves_
from univoxel.preparation.stereo import DepthMaps
from univoxel.presets import preset

VIEWS, SIZE = 24, 96
BOX = torch.full((3,), -0.7), torch.full((3,), 0.7)
ROUGH = Belief(BOX, False, 2, 5.0)
PIXEL = 2 * 1.8 / SIZE / 2  # world units, at the ball


@pytest.fixture(scope="module")
def photos():
    return photos_of(VIEWS, SIZE)


def without_a_part(photos: Photos, views: tuple[int, ...]) -> Photos:
    """Masks of some views that lack what lies above 0.2."""
    alpha = photos.alpha.clone()
    for view in views:
        alpha[view, : SIZE // 2 - 10] = 0
    return replace(photos, alpha=alpha)


def on_the_ball(radius: float) -> torch.Tensor:
    points = torch.randn(2000, 3, generator=torch.Generator().manual_seed(0))
    return radius * points / points.norm(dim=1, keepdim=True)


def test_a_part_that_a_mask_lacks_and_ground_that_one_keeps_are_doubted(photos):
    """And what is lacked is carved no more."""
    spoilt = without_a_part(photos, (3,))
    spoilt.alpha[5, -30:, 20:60] = 1
    distance = mask_distances(spoilt.alpha)
    found = doubt_masks(spoilt, distance, ROUGH)
    assert found.belief.votes == 1
    assert found.belief.off <= MAX_CONTRADICTION
    lost = (photos.alpha > 0.5) & (spoilt.alpha < 0.5)
    kept = (photos.alpha < 0.5) & (spoilt.alpha > 0.5)
    assert found.pixels[lost].float().mean() > 0.9
    assert found.pixels[kept].float().mean() > 0.9
    assert found.pixels[~lost & ~kept].float().mean() < 2e-3
    held = hull_sdf(distance, photos.cameras, on_the_ball(RADIUS))
    exact = hull_sdf(mask_distances(photos.alpha), photos.cameras, on_the_ball(RADIUS))
    assert (held - exact).abs().quantile(0.99) < PIXEL
    assert held.max() < PIXEL  # nothing is bitten off


def test_what_two_masks_lack_together_comes_back(photos):
    alpha = photos.alpha.clone()
    alpha[11:13, :, : SIZE // 2 - 5] = 0  # seen from directions that are 137 degrees apart
    spoilt = replace(photos, alpha=alpha)
    distance = mask_distances(alpha)
    doubt_masks(spoilt, distance, ROUGH)
    bitten, whole = (
        hull_sdf(d, photos.cameras, on_the_ball(0.9 * RADIUS), votes=2)
        for d in (mask_distances(alpha), distance)
    )
    assert bitten.max() > 0.1 * RADIUS
    assert whole.max() < 0


def test_what_all_masks_show_is_nowhere_doubted(photos):
    assert not doubt_masks(photos, mask_distances(photos.alpha), ROUGH).pixels.any()


def test_of_plain_objects_silhouettes_alone_tell_masks_from_cameras(photos, caplog, monkeypatch):
    """Cameras that are off can be put right; masks with holes and stains agree from nowhere."""
    monkeypatch.setattr(pose_refinement, "STEPS", 60)
    cameras = turned(photos.cameras, 2.0, np.random.default_rng(0))
    distance = mask_distances(photos.alpha)
    assert choose_masks_or_poses(replace(photos, cameras=cameras), distance, "auto", "auto").refined
    alpha, pixel = photos.alpha.clone(), torch.arange(SIZE)
    generator = torch.Generator().manual_seed(0)
    for mask in alpha:
        for shows in (0.0, 1.0, 0.0, 1.0):
            row, column = torch.randint(10, SIZE - 10, (2,), generator=generator).tolist()
            mask[((pixel[:, None] - row) ** 2 + (pixel - column) ** 2) < 6**2] = shows
    spoilt, distance = replace(photos, alpha=alpha), mask_distances(alpha)
    with caplog.at_level("INFO"):
        found = choose_masks_or_poses(spoilt, distance, "auto", "auto")
    assert not found.refined
    assert found.votes > 1
    assert "pose refinement does not help: the masks are assumed to be rough" in caplog.text
    # What is told is believed
    assert choose_masks_or_poses(spoilt, distance, "refined", "auto").refined
    assert choose_masks_or_poses(spoilt, distance, "auto", "given").refined


def test_jagged_edges_are_not_doubted():
    differs = torch.zeros(40, 40, dtype=torch.bool)
    differs[10, :], differs[20:30, 20:30] = True, True
    found = thick(differs)
    assert not found[10].any()
    assert found[20:30, 20:30].all()
    assert not thick(differs & False).any()


def test_silhouettes_in_which_nothing_lies(photos, tmp_path):
    cfg = preset("fast", tmp_path / "data", tmp_path / "run")
    with pytest.raises(DataError, match=r"data: .*(have no common volume|do not overlap anywhere)"):
        prepare.find_silhouettes(replace(photos, alpha=torch.zeros_like(photos.alpha)), cfg)


def test_preparation_doubts_what_contradicts_and_starts_from_what_agrees(
    photos, tmp_path, caplog, monkeypatch
):
    monkeypatch.setattr(
        prepare, "choose_masks_or_poses", lambda *_: ROUGH
    )  # of the plain ball no match tells
    spoilt = without_a_part(photos, (3, 9))
    cfg = preset("fast", tmp_path, tmp_path / "run")
    with caplog.at_level("INFO"):
        found = prepare.find_silhouettes(spoilt, cfg)
    assert "of the pixels are uncertain" in caplog.text
    assert found.shape is not None
    assert found.doubted.any()
    assert not found.edges_given
    asked_of = []
    monkeypatch.setattr(
        prepare, "varying_and_gains", lambda photos, *_: asked_of.append(photos) or ("none", None)
    )
    hull = prepare.prepare(found, cfg).hull
    assert hull.min() < 0 < hull.max()
    [seen] = asked_of
    assert not seen.alpha[found.doubted].any()
    assert torch.equal(seen.alpha[~found.doubted], spoilt.alpha[~found.doubted])
    # Where depth was not asked, concavities are still to be found
    carved = []
    monkeypatch.setattr(prepare, "carve_within_time", lambda hull, *_: carved.append(1) or hull)
    for surface in (0.5, 0.0):
        asked = replace(found, shape=replace(found.shape, surface=surface))
        prepare.prepare(asked, cfg)
        assert len(carved) == (surface == 0)


def turned_over(first: int, second: int) -> Cameras:
    """Two rings of level cameras: the object was turned over between them."""
    cameras = cameras_at(torch.cat([on_circle(n, 3.0, 1.5) for n in (first, second)]), SIZE, 160)
    over = torch.from_numpy(Rotation.from_rotvec([2.8, 0.2, 0.0]).as_matrix()).float()
    cameras.camera_to_world[first:] = over @ cameras.camera_to_world[first:]
    return cameras


def ball_with_a_lid(cameras: Cameras, lid: tuple[float, float, float]) -> list[torch.Tensor]:
    """Masks [SIZE, SIZE] of a ball, and of a small one beside it."""
    grid = fit_grid(*BOX, 64**3)
    small = 0.18 - (grid.nodes() - torch.tensor(lid)).norm(dim=-1)
    shape = ObjectShape(grid, torch.maximum(0.4 - grid.nodes().norm(dim=-1), small), 0.0)
    return [shown.float() for shown in silhouettes(shape, cameras)]


def moved_in(
    cameras: Cameras, masks: list[torch.Tensor]
) -> tuple[list[torch.Tensor], list[torch.Tensor], torch.Tensor]:
    """What `undo_moves_` finds, the masks that it leaves, and where depth stays known."""
    maps = DepthMaps(cameras, torch.ones(len(masks), SIZE, SIZE), torch.ones(1).bool(), 0.1)
    known, masks = torch.ones(len(masks), SIZE, SIZE, dtype=torch.bool), list(masks)
    return undo_moves_(masks, replace(maps, known=known), BOX), masks, known


@pytest.mark.parametrize("narrower", [0, 8])
def test_a_part_that_moved_stays_where_most_photographs_show_it(narrower, caplog):
    cameras = turned_over(16, 12)
    if narrower:  # every other picture
        sizes = [[SIZE - narrower * (view % 2), SIZE] for view in range(28)]
        cameras = replace(cameras, sizes=torch.tensor(sizes))
    here, there = (ball_with_a_lid(cameras, lid) for lid in ((0.5, 0.0, 0.0), (0.0, 0.5, 0.0)))
    with caplog.at_level("INFO"):
        moved, masks, known = moved_in(cameras, here[:16] + there[16:])
    assert "12 of 28 photographs show it elsewhere" in caplog.text
    assert not any(pixels.any() for pixels in moved[:16])
    for view, (made, true) in enumerate(zip(masks, here, strict=True)):
        assert not thick(made != true).any()
        assert torch.equal(cameras.cut(view, known[view]), ~moved[view])
    for shown, true, pixels in zip(there[16:], here[16:], moved[16:], strict=True):
        assert pixels[shown != true].float().mean() > 0.9


def test_nothing_moves_where_all_photographs_agree_or_no_position_is_known():
    cameras = turned_over(16, 12)
    same = ball_with_a_lid(cameras, (0.5, 0.0, 0.0))
    assert not any(pixels.any() for pixels in moved_in(cameras, same)[0])
    only = cameras.of(torch.arange(16))
    assert not any(pixels.any() for pixels in moved_in(only, same[:16])[0])
    # Where most of the object seems to have moved, cameras are wrong
    masks = same[:16] + [torch.roll(mask, 25, 1) for mask in same[16:]]
    assert not any(pixels.any() for pixels in moved_in(cameras, masks)[0])
