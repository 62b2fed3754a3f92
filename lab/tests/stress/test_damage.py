"""What befalls photographs, against its definition."""

import json
import math

import numpy as np
import pytest
import torch
from scipy import ndimage

from lab.stress import damage as module
from lab.stress import render, scenes
from lab.stress.damage import Damage, damaged
from lab.stress.scenes import Spec
from univoxel.camera import image_rays
from univoxel.color import linear_to_srgb
from univoxel.data import load_photos, load_truth
from univoxel.data.images import read_image, write_exr
from univoxel.envmap import EnvMap, lookup

SPEC = Spec(size=24, views=6, tests=2)
MODES = ("train", "test", "relight/dusk", "relight/studio")


def random(seed=0):
    return np.random.default_rng(seed)


def write_scene(folder, level=0.5):
    """A scene as render.py writes it, of one grey disc in every picture; no renderer is needed."""
    folder.mkdir()
    render.write_known(SPEC, folder, scenes.parts_of(SPEC))
    y, x = np.mgrid[:24, :24] - 11.5
    alpha = np.clip(8.5 - np.hypot(x, y), 0, 1)
    for mode in MODES:
        (folder / mode).mkdir(parents=True, exist_ok=True)
        for view in range(SPEC.views if mode == "train" else SPEC.tests):
            rgb = level * (1 + 0.1 * view) * alpha
            channels = {"R": rgb, "G": 0.5 * rgb, "B": 2.2 * rgb, "A": alpha}
            write_exr(folder / mode / f"{render.name_of(view)}.exr", channels)
    return folder


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return write_scene(tmp_path_factory.mktemp("damage") / "scene")


def test_poses_turn_about_their_own_centres_by_so_much():
    cameras = scenes.train_cameras(Spec(views=2000))
    turned = module.turned(cameras, 0.5, random())
    before, after = (c.camera_to_world.double() for c in (cameras, turned))
    torch.testing.assert_close(after[:, :, 3], before[:, :, 3])
    between = before[:, :, :3].transpose(1, 2) @ after[:, :, :3]
    vector = torch.stack(
        [between[:, 2, 1], between[:, 0, 2], between[:, 1, 0]], 1
    ).rad2deg()  # small angles: the sine is the angle
    # 2000 normal numbers: their deviation is known to 1.6 %, their mean to 0.011; four sigma
    assert vector.std(0) == pytest.approx([0.5] * 3, rel=0.065)
    assert vector.mean(0).abs().max() < 0.045
    assert np.corrcoef(vector.T.numpy())[np.triu_indices(3, 1)] == pytest.approx([0] * 3, abs=0.09)
    eye = torch.eye(3, dtype=torch.float64).expand(2000, 3, 3)
    torch.testing.assert_close(
        after[:, :, :3] @ after[:, :, :3].transpose(1, 2), eye, atol=1e-6, rtol=0
    )
    same = module.turned(cameras, 0.0, random()).camera_to_world
    torch.testing.assert_close(same, cameras.camera_to_world)


def test_exposures_are_even_in_stops():
    stops = module.exposures(4000, 1.5, random()).log2()
    assert stops.abs().max() <= 1.5
    # Of an even distribution: 1.5 / sqrt(3), known to 1 %
    assert stops.std() == pytest.approx(1.5 / math.sqrt(3), rel=0.04)
    assert stops.mean() == pytest.approx(0, abs=0.06)
    assert (module.exposures(5, 0.0, random()) == 1).all()


def test_a_photograph_is_clipped_and_rounded():
    linear = torch.tensor([0.0, 0.2, 0.999, 1.0, 7.0]).expand(3, 5).T.reshape(1, 5, 3)
    found = module.photographed(linear, 0.0, random())
    wanted = (255 * linear_to_srgb(linear)).round().byte()
    assert found.dtype == torch.uint8
    assert (found == wanted).all()
    assert (found[0, 3:] == 255).all()


def test_noise_is_of_srgb_and_clipped_after():
    grey = torch.full((200, 200, 3), 0.2)
    found = module.photographed(grey, 0.05, random()).double() / 255
    assert found.std() == pytest.approx(0.05, rel=0.02)  # 120,000 numbers, and rounding to 1/255
    assert found.mean() == pytest.approx(float(linear_to_srgb(torch.tensor(0.2))), abs=1e-3)
    white = module.photographed(torch.full((200, 200, 3), 3.0), 0.05, random())
    assert (white == 255).float().mean() == pytest.approx(0.5, abs=0.03)  # half of it is above
    assert white.max() == 255


def test_a_mask_grows_and_shows_what_is_behind(scene):
    photos = load_photos(scene, "train")
    color, alpha = photos.picture(0)
    shown, grown = module.masked(photos, 0, 2.0)
    reach = ndimage.distance_transform_edt(alpha.numpy() == 0)
    assert ((grown > 0).numpy() == (reach <= 2)).all()
    assert (grown >= alpha).all()
    beyond = alpha == 0
    rays = image_rays(photos.cameras, 0)
    behind = scenes.radiance("room", rays.direction.double().numpy()).reshape(24, 24, 3)
    # Soft windows of 4 degrees, seen through texels of 1.4
    np.testing.assert_allclose(shown.numpy()[beyond], behind[beyond], rtol=0.15, atol=0.15)
    torch.testing.assert_close(shown[alpha == 1], color[alpha == 1])


def test_a_damaged_scene(scene, tmp_path):
    out = damaged(scene, tmp_path / "out", Damage(views=4))
    photos, before = load_photos(out, "train"), load_photos(scene, "train")
    assert photos.names == before.names[:4]
    torch.testing.assert_close(photos.cameras.camera_to_world, before.cameras.camera_to_world[:4])
    assert photos.color.dtype == torch.uint8
    color, alpha = photos.picture(2)
    wanted, coverage = before.picture(2)
    torch.testing.assert_close(alpha, coverage, atol=0.003, rtol=0)
    inside = coverage > 0.5
    # Half a step of 8 bits where sRGB is flattest
    torch.testing.assert_close(color[inside], wanted[inside].clamp_max(1), atol=0.006, rtol=0)
    for name in ("points.npz", "test/gt/r_000.npz", "envmaps/dusk.exr", "relight/dusk/r_001.exr"):
        assert (out / name).read_bytes() == (scene / name).read_bytes()
    assert module.clipped(out) == pytest.approx(1)  # blue is 1.1 and more
    truth = load_truth(load_photos(out, "test"), 1)
    assert truth.mask.any()
    assert truth.albedo.max() > 0.3


def test_exposure_reaches_the_test_views_but_not_the_relit_ones(scene, tmp_path):
    out = damaged(scene, tmp_path / "out", Damage(views=2, exposure=-2.0))
    name = "test/r_000.exr"
    torch.testing.assert_close(
        read_image(out / name)[..., :3], read_image(scene / name)[..., :3] / 4
    )
    assert (read_image(out / name)[..., 3] == read_image(scene / name)[..., 3]).all()
    name = "relight/dusk/r_000.exr"
    assert (out / name).read_bytes() == (scene / name).read_bytes()
    color, _ = load_photos(out, "train").picture(0)
    assert color[12, 12, 0] == pytest.approx(0.125, abs=2e-3)
    assert module.clipped(out) == 0


def test_pictures_differ_in_exposure_and_light_by_seed(scene, tmp_path):
    second = write_scene(tmp_path / "second", level=0.1)
    dark = Damage(views=6, light=1.0)
    found = [damaged(scene, tmp_path / f"{s}", dark, s, second) for s in (0, 0, 1)]
    reds = [load_photos(f, "train").pixels(torch.arange(6), 12, 12)[0][:, 0] for f in found]
    assert (reds[0] == reds[1]).all()
    assert (reds[0] - reds[2]).abs().max() > 0.02
    own = 0.5 * (1 + 0.1 * torch.arange(6))
    share = (own - reds[0]) / (0.8 * own)
    assert share == pytest.approx(random().uniform(size=6), abs=0.03)
    few = damaged(scene, tmp_path / "few", Damage(views=2, light=1.0), 0, second)
    assert len(load_photos(few, "train")) == 2
    with pytest.raises(ValueError, match="light above 0 needs a scene under a second light"):
        damaged(scene, tmp_path / "x", dark)
    with pytest.raises(ValueError, match="expected 9 photographs, got 6"):
        damaged(scene, tmp_path / "x", Damage(views=9))
    assert not (tmp_path / "x").exists()


def test_test_cameras_stay_true(scene, tmp_path):
    out = damaged(scene, tmp_path / "out", Damage(views=3, pose=2.0))
    cameras = [json.loads((f / "transforms_test.json").read_text()) for f in (scene, out)]
    assert cameras[0] == cameras[1]
    train = [load_photos(f, "train").cameras.camera_to_world for f in (scene, out)]
    assert (train[0][:3] - train[1]).abs().max() > 0.01


def test_what_is_behind_turns_with_the_light(scene):
    photos = load_photos(scene, "train")
    shown, alpha = module.masked(photos, 0, 0.0, turn=0.7)
    direction = image_rays(photos.cameras, 0).direction
    azimuth = torch.atan2(direction[:, 1], direction[:, 0]) - 0.7  # where it was before
    across = direction[:, :2].norm(dim=1)
    before = torch.stack([across * azimuth.cos(), across * azimuth.sin(), direction[:, 2]], 1)
    behind = lookup(EnvMap(read_image(scene / "envmaps" / "train.exr")), before)
    empty = alpha.flatten() == 0
    torch.testing.assert_close(shown.reshape(-1, 3)[empty], behind[empty], rtol=1e-3, atol=1e-3)


def test_jpeg_changes_a_picture_a_little():
    picture = torch.from_numpy(random().integers(90, 110, (32, 32, 3)).astype(np.uint8))
    found = module.compressed(picture, 90)
    assert found.shape == picture.shape
    assert 0 < (found.float() - picture.float()).abs().mean() < 10
