"""Masks found where there are none: a sphere in a room."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from analytic import cameras_around, photograph, write_scene
from PIL import Image

from univoxel.camera import image_rays
from univoxel.color import linear_to_srgb
from univoxel.data import Photos, load_photos
from univoxel.data.shots import read_photo
from univoxel.errors import DataError
from univoxel.tasks import cutout as task

VIEWS, SIZE = 16, 40


def behind(rays, room):
    """Waves of colour, infinitely far or on a sphere of radius `room` around the origin."""
    where = rays.direction
    if room:
        half = (rays.origin * where).sum(1)
        t = (half.square() - rays.origin.square().sum(1) + room**2).sqrt() - half
        where = (rays.origin + t[:, None] * where) / room
    phase = torch.tensor([0.0, 2.0, 4.0])
    return 0.4 + 0.2 * torch.sin(7 * where + phase) + 0.2 * torch.sin(11 * where.roll(1, 1) - phase)


def photographs(tmp_path, room=None) -> Photos:
    cameras = cameras_around(VIEWS, SIZE)
    colors = []
    for view in range(VIEWS):
        color, alpha = photograph(cameras, view)
        back = behind(image_rays(cameras, view), room).reshape(SIZE, SIZE, 3)
        colors.append(alpha[..., None] * color + (1 - alpha[..., None]) * back)
    encoded = (255 * linear_to_srgb(torch.stack(colors))).round().byte()
    whole = torch.full((VIEWS, SIZE, SIZE), 255, dtype=torch.uint8)
    return Photos(tmp_path, [f"r_{v}" for v in range(VIEWS)], encoded, whole, cameras)


def overlap(found, true) -> float:
    """Intersection over union."""
    found, true = found > 0.5, true > 0.5
    return float((found & true).sum() / (found | true).sum())


def stages(steps):
    coarse, fine = task.STAGES
    return (
        replace(coarse, voxels=0.03, iterations=steps, rays=512),
        replace(fine, voxels=0.06, iterations=steps // 5, rays=1024),
    )


@pytest.fixture
def quick(monkeypatch):
    """Stages that suffice for a sphere of 20 pixels."""
    monkeypatch.setattr(task, "STAGES", stages(300))


@pytest.fixture
def hasty(monkeypatch):
    """Stages that leave little more than the ball that the object is at first."""
    monkeypatch.setattr(task, "STAGES", stages(20))


def test_a_sphere_is_told_from_what_is_behind(tmp_path, quick):
    photos = photographs(tmp_path, room=4.0)
    true = torch.stack([photograph(photos.cameras, v)[1] for v in range(VIEWS)])

    def masks(scene):
        return torch.stack([task.mask(scene, photos, v) for v in range(VIEWS)])

    torch.manual_seed(0)
    box, seen = (torch.tensor([-0.9, -0.6, -0.7]), torch.tensor([0.6, 0.9, 0.8])), []
    found = task.find_object(photos, *box, seen.append)
    # Balls in the middle of that box have 0.5 and 0.6
    assert overlap(masks(found), true) > 0.85
    assert len(seen) == 2 * 300 + 60
    assert np.mean(seen[-20:]) > np.mean(seen[:20]) + 3


def test_a_start_that_vanishes_is_none(tmp_path, hasty, monkeypatch):
    """The others count; where all vanish, nothing was found."""
    photos, asked = photographs(tmp_path), []

    def separate(scene, field, *_):
        asked.append(field)
        if len(asked) < 2 or len(asked) > 3:
            raise task.NothingFound
        return 20.0

    monkeypatch.setattr(task, "separate", separate)
    task.find_object(photos, *task.surroundings(photos.cameras), lambda _: None)
    assert len(asked) == 3
    with pytest.raises(ValueError, match=r"no object was found .* --box"):
        task.find_object(photos, *task.surroundings(photos.cameras), lambda _: None)


@pytest.mark.parametrize("quality", [(30.0, 20.0), (20.0, 30.0)])
def test_the_start_that_draws_the_photographs_better_is_kept(tmp_path, hasty, monkeypatch, quality):
    photos, left = photographs(tmp_path), [*quality, 25.0]
    monkeypatch.setattr(task, "separate", lambda *_: left.pop(0))
    lower, upper = task.surroundings(photos.cameras)
    found = task.find_object(photos, lower, upper, lambda _: None)
    radius = found.field.isosurface()[0].norm(dim=1).mean()  # nothing was fitted: a ball is left
    kept = task.STARTS[quality.index(30.0)] * float(upper[0] - lower[0]) / 2
    assert radius == pytest.approx(kept, rel=0.05)  # of the two, which differ by 0.3


def test_what_cannot_be_written_leaves_nothing_behind_that_looks_whole(tmp_path, monkeypatch):
    def full(*_):
        raise OSError("no space left")

    data, out = write_scene(tmp_path / "data", 3, 8), tmp_path / "cut"
    monkeypatch.setattr(task, "find_object", lambda *_: None)
    monkeypatch.setattr(task, "mask", lambda scene, photos, view: torch.ones(8, 8))
    with monkeypatch.context() as patch:
        patch.setattr(task, "write_cameras", full)
        with pytest.raises(OSError, match="no space left"):
            task.cutout(data, out)
    assert not out.exists()
    assert task.cutout(data, out).is_dir()  # what was begun is not in the way


def test_a_field_without_an_inside_is_nothing():
    grid = task.fit_grid(-torch.ones(3), torch.ones(3), 10**3)
    with pytest.raises(task.NothingFound, match="no object was found"):
        task.redistance(task.dense_field(grid, 1, torch.ones(grid.size)))


def test_what_cameras_look_at_is_the_box():
    cameras = cameras_around(VIEWS, SIZE)
    lower, upper = task.surroundings(cameras)
    torch.testing.assert_close(lower, -upper, atol=1e-4, rtol=0)
    assert 0.8 < float(upper[0]) < 0.9  # a sphere of 0.8 is seen whole, at distance 2


def test_small_parts_are_chaff():
    grid = task.fit_grid(-torch.ones(3), torch.ones(3), 20**3)
    node = grid.nodes()
    ball = (node - torch.tensor([0.3, 0.0, 0.0])).norm(dim=-1) - 0.4
    speck = (node + torch.tensor([0.8, 0.0, 0.0])).norm(dim=-1) - 0.08
    field = task.dense_field(grid, 1, torch.minimum(ball, speck))
    near = ball.abs() < 0.1
    task.redistance(field)
    assert (field.sdf[speck < 0] < 0).all()
    task.redistance(field, whole=True)
    assert (field.sdf[speck < 0] > 0).all()
    assert torch.equal(field.sdf[near], ball[near])
    # Distances to the centres of voxels are off by up to half a diagonal
    assert (field.sdf - ball).abs().max() < 0.9 * grid.voxel_size


def test_what_is_written_can_be_trained_on(tmp_path, hasty, capsys):
    data = write_scene(tmp_path / "data", VIEWS, SIZE)
    photos = photographs(tmp_path)
    for view, name in enumerate(photos.names):  # no alpha at all
        Image.fromarray(photos.color[view].numpy()).save(data / "train" / f"{name}.png")
    with pytest.raises(DataError, match="univoxel cutout"):
        load_photos(data)
    out = tmp_path / "cut"
    assert task.cutout(data, out) == out
    assert "photographs of 40x40 pixels" in capsys.readouterr().out
    for split, count in (("train", VIEWS), ("test", 2)):
        cut, source = load_photos(out, split), load_photos(data, split, masks=False)
        assert len(cut) == count
        assert torch.equal(cut.color, source.color)
        torch.testing.assert_close(cut.cameras.focal, source.cameras.focal)
        torch.testing.assert_close(cut.cameras.camera_to_world, source.cameras.camera_to_world)
        true = torch.stack([photograph(source.cameras, v)[1] for v in range(count)])
        assert overlap(cut.coverage(), true) > 0.6  # each mask with its photograph
    with pytest.raises(FileExistsError, match="cut is there already: choose another --out"):
        task.cutout(data, out)


def test_linear_photographs_stay_linear(tmp_path):
    photos = photographs(tmp_path)
    linear = replace(photos, color=torch.rand(VIEWS, SIZE, SIZE, 3), alpha=photos.alpha / 255)
    alpha = torch.full((SIZE, SIZE), 0.5)
    task.write_photo(tmp_path / "r_3", linear, 3, alpha)
    color, found = read_photo(tmp_path / "r_3.exr")
    torch.testing.assert_close(color, linear.color[3], atol=1e-3, rtol=1e-3)  # half floats
    assert torch.equal(found, alpha)


def test_a_data_set_without_test_views(tmp_path, hasty):
    data = write_scene(tmp_path / "data", VIEWS, SIZE)
    (data / "transforms_test.json").unlink()
    out = task.cutout(data, tmp_path / "cut")
    assert sorted(path.name for path in out.iterdir()) == ["train", "transforms_train.json"]


@pytest.mark.parametrize(
    "box", [(0, 0, 0, 1, 1), (0, 0, 0, 1, 1, 0), (0, 0, 0, 1, 1, float("nan"))]
)
def test_boxes_that_are_none(tmp_path, box):
    with pytest.raises(ValueError, match="--box: expected X Y Z of the lower corner"):
        task.corners(box)


def test_a_box_that_is_one():
    lower, upper = task.corners((0.0, 1.0, 2.0, 3.0, 4.0, 5.0))
    assert lower.tolist() == [0, 1, 2]
    assert upper.tolist() == [3, 4, 5]
