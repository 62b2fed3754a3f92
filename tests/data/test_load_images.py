"""What all loaders share: size of photographs, masks, memory, pixels in linear float."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from layouts import HEIGHT, WIDTH, Scene, scene, write_colmap, write_nerf, write_nerfstudio

from univoxel.camera import Cameras, project
from univoxel.color import linear_to_srgb, srgb_to_linear
from univoxel.data import Photos, load_images, load_photos, splits_of
from univoxel.data.images import write_exr, write_png
from univoxel.data.lens import Lens
from univoxel.data.load_images import Shot
from univoxel.errors import DataError
from univoxel.presets import PRESETS


@pytest.mark.parametrize("writer", [write_nerf, write_nerfstudio, write_colmap])
def test_downscale(tmp_path, writer):
    """Means in linear light, weighted by alpha; the same points in pictures of half the size."""
    written = scene()
    photos = load_photos(writer(tmp_path, written), "test", downscale=2)
    assert photos.about.endswith("6x4 pixels in test, downscaled to 1/2")
    assert photos.downscale == 2
    stored = torch.from_numpy(written.pictures[written.split("test")]).double() / 255
    linear, alpha = srgb_to_linear(stored[..., :3]), stored[..., 3:]
    blocks = torch.cat([linear * alpha, alpha], -1).view(2, HEIGHT // 2, 2, WIDTH // 2, 2, 4)
    mean = blocks.mean((2, 4))
    alpha = (255 * mean[..., 3]).round()
    color = (255 * linear_to_srgb(mean[..., :3] / mean[..., 3:])).round()
    # float32 against double: a value that lies on the border of two steps
    assert (photos.alpha - alpha).abs().max() <= 1
    assert (photos.color - color).abs().max() <= 1
    assert ((photos.color - color) == 0).float().mean() > 0.99

    whole = load_photos(tmp_path, "test")
    point = torch.tensor([[0.2, -0.1, 0.3]])
    for view in range(2):
        pixel, depth = project(photos.cameras, view, point)
        other, there = project(whole.cameras, view, point)
        torch.testing.assert_close(2 * pixel, other)
        torch.testing.assert_close(depth, there)


def test_linear_photographs_stay_linear(tmp_path):
    written = scene()
    write_nerf(tmp_path, written)
    values = np.random.default_rng(1).random((HEIGHT, WIDTH, 4)).astype(np.float32)
    values[..., :3] *= 5 * values[..., 3:]  # premultiplied, brighter than 1
    for name in ("p_000", "p_008"):
        (tmp_path / "test" / f"{name}.png").unlink()
        channels = dict(zip("RGBA", np.moveaxis(values, 2, 0), strict=True))
        write_exr(tmp_path / "test" / f"{name}.exr", channels, half=False)
    photos = load_photos(tmp_path, "test", downscale=4)
    mean = values.reshape(2, 4, 3, 4, 4).mean((1, 3))
    assert photos.color.dtype == torch.float32
    np.testing.assert_allclose(photos.color[0], mean[..., :3] / mean[..., 3:], rtol=1e-5)
    np.testing.assert_allclose(photos.alpha[0], mean[..., 3], rtol=1e-5)


def test_what_is_hidden_does_not_bleed_in(tmp_path):
    """Red on the object, bright green behind it: means over both are red."""
    picture = np.zeros((2, HEIGHT, WIDTH, 4), np.uint8)
    picture[..., 1] = 255
    picture[:, :, 5:] = [200, 0, 0, 255]
    photos = load_photos(write_colmap(tmp_path, Scene(scene(2).poses, picture)), "test", 4)
    assert photos.color[0, 0].tolist() == [[0, 255, 0], [200, 0, 0], [200, 0, 0]]
    assert photos.alpha[0, 0].tolist() == [0, 191, 255]


@pytest.mark.parametrize(
    ("width", "factor"), [(800, 1), (1499, 1), (1501, 2), (2499, 2), (4032, 4), (8000, 8)]
)
def test_photographs_are_shrunk_to_what_grids_can_use(width, factor):
    lens = Lens(width, 3 * width // 4, (500.0, 500.0), (0.0, 0.0))
    across = replace(lens, width=lens.height, height=lens.width)
    shot = Shot("", "", Path(), None, np.eye(4)[:3], lens)
    set_ = [replace(shot, lens=lens), replace(shot, lens=across)] * 5
    assert load_images.fitting_downscale(set_) == factor
    # Presets use no more, even where the object fills no more than half of the longer side
    finest = max(1e6 * work.voxels for work in PRESETS.values())
    assert finest ** (1 / 3) < load_images.FINE / 2


def test_very_many_photographs_are_shrunk_further(tmp_path, monkeypatch):
    write_nerf(tmp_path, scene())
    monkeypatch.setattr(load_images, "LARGE", 8 * WIDTH * HEIGHT)
    assert load_photos(tmp_path).downscale == 1
    monkeypatch.setattr(load_images, "LARGE", 8 * WIDTH * HEIGHT - 1)
    assert load_photos(tmp_path).downscale == 2
    assert load_photos(tmp_path, "test").downscale == 1
    assert load_photos(tmp_path, downscale=1).cameras.width == WIDTH
    monkeypatch.setattr(load_images, "LARGE", 0)
    assert load_photos(tmp_path).downscale == HEIGHT  # a pixel is left


def test_downscales_out_of_range(tmp_path):
    write_nerf(tmp_path, scene())
    with pytest.raises(ValueError, match="downscale must be at least 1, got -1"):
        load_photos(tmp_path, downscale=-1)
    with pytest.raises(DataError, match="downscale=9 is too large for 12x8"):
        load_photos(tmp_path, downscale=9)


def test_a_mask_beside_the_photograph_or_in_a_folder_beside(tmp_path):
    written = scene(2)
    write_nerf(tmp_path / "folder", written)
    (tmp_path / "folder/test_mask").mkdir()
    mask = np.full((HEIGHT, WIDTH), 209, np.uint8)
    write_png(tmp_path / "folder/test_mask/p_000.png", mask)
    assert load_photos(tmp_path / "folder", "test").alpha.unique().tolist() == [209]
    assert np.array_equal(load_photos(tmp_path / "folder").alpha[0], written.pictures[1, ..., 3])
    write_nerf(tmp_path, written)
    for what in ("alpha", "mask"):  # the second is looked for first
        write_png(tmp_path / "test" / "p_000.png", written.pictures[0, ..., :3])
        write_png(tmp_path / "test" / f"p_000_{what}.png", np.full((HEIGHT, WIDTH), 209, np.uint8))
        assert load_photos(tmp_path, "test").alpha.unique().tolist() == [209]
        write_png(tmp_path / "test" / "p_000_alpha.png", np.full((HEIGHT, WIDTH), 207, np.uint8))


@pytest.mark.parametrize("writer", [write_nerf, write_nerfstudio, write_colmap])
def test_photographs_as_they_are(tmp_path, writer):
    """Without masks the whole picture is opaque, in every layout, and no colour changes."""
    written = scene()
    writer(tmp_path, written)
    plain, masked = (load_photos(tmp_path, masks=masks) for masks in (False, True))
    assert plain.alpha.unique().tolist() == [255]
    assert torch.equal(plain.color, masked.color)
    assert not torch.equal(plain.alpha, masked.alpha)


@pytest.mark.parametrize(
    ("files", "splits"),
    [
        (("transforms_train.json", "transforms_test.json"), ["train", "test"]),
        (("transforms_train.json",), ["train"]),
        (("transforms.json",), ["train", "test"]),
    ],
)
def test_splits(tmp_path, files, splits):
    for file in files:
        (tmp_path / file).write_text("{}")
    assert splits_of(tmp_path) == splits


# Pixels of stored photographs in linear float, whatever they are stored as


def photos(color, alpha):
    views, height, width = alpha.shape
    pose = torch.eye(4)[:3].expand(views, 3, 4)
    cameras = Cameras(pose, torch.ones(views, 2), torch.ones(views, 2), width, height)
    return Photos(Path("nowhere"), [f"r_{v}" for v in range(views)], color, alpha, cameras)


@pytest.fixture
def stored():
    generator = torch.Generator().manual_seed(0)
    return photos(
        torch.randint(0, 256, (2, 3, 4, 3), dtype=torch.uint8, generator=generator),
        torch.randint(0, 256, (2, 3, 4), dtype=torch.uint8, generator=generator),
    )


def test_bytes_are_srgb_and_coverage(stored):
    color, alpha = stored.picture(1)
    torch.testing.assert_close(color, srgb_to_linear(stored.color[1].float() / 255))
    torch.testing.assert_close(alpha, stored.alpha[1].float() / 255)
    assert len(stored) == 2
    torch.testing.assert_close(stored.coverage()[1], alpha)


def test_floats_are_linear_already(stored):
    color, alpha = 7 * torch.rand(2, 3, 4, 3), torch.rand(2, 3, 4)  # radiance may exceed 1
    linear = photos(color, alpha)
    assert torch.equal(linear.picture(0)[0], color[0])
    assert torch.equal(linear.picture(0)[1], alpha[0])
    assert torch.equal(linear.coverage(), alpha)


def test_single_pixels_are_those_of_the_picture(stored):
    view, row, column = torch.tensor([0, 1, 1]), torch.tensor([2, 0, 2]), torch.tensor([3, 1, 0])
    color, alpha = stored.pixels(view, row, column)
    for i in range(3):
        whole = stored.picture(int(view[i]))
        # The power of the sRGB curve rounds as the length of the vector says.
        torch.testing.assert_close(color[i], whole[0][row[i], column[i]])
        assert torch.equal(alpha[i], whole[1][row[i], column[i]])
