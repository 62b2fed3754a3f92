"""Ground truth beside the photographs: materials, relit views, points; there, missing, broken."""

import numpy as np
import pytest
import torch

from univoxel.camera import Cameras
from univoxel.color import srgb_to_linear
from univoxel.data import Photos, load_points, load_relit, load_truth, relight_maps
from univoxel.data.images import write_png
from univoxel.errors import DataError

WIDTH, HEIGHT = 6, 4


def rgba(seed=0, width=WIDTH):
    return np.random.default_rng(seed).integers(1, 256, (HEIGHT, width, 4), dtype=np.uint8)


def photos(folder, *names, alpha=None, downscale=1):
    """Photographs without colour, whose truth is asked for."""
    names = names or ("r_0",)
    if alpha is None:
        alpha = torch.full((HEIGHT // downscale, WIDTH // downscale), 255, dtype=torch.uint8)
    alpha = alpha.expand(len(names), *alpha.shape)
    height, width = alpha.shape[1:]
    cameras = Cameras(torch.eye(4)[None, :3], torch.ones(1, 2), torch.ones(1, 2), width, height)
    color = torch.zeros(*alpha.shape, 3, dtype=torch.uint8)
    return Photos(folder, list(names), color, alpha, cameras, downscale=downscale)


def save_truth(folder, **change):
    arrays = {
        "albedo": np.full((HEIGHT, WIDTH, 3), 0.5, np.float16),
        "roughness": np.full((HEIGHT, WIDTH), 0.25, np.float16),
        "normal": np.broadcast_to(np.float16([0, 0, 1]), (HEIGHT, WIDTH, 3)),
        "depth": np.full((HEIGHT, WIDTH), 4.0, np.float32),
        "alpha": np.full((HEIGHT, WIDTH), 251, np.uint8),
    }
    arrays |= change
    (folder / "test" / "gt").mkdir(parents=True, exist_ok=True)
    path = folder / "test" / "gt" / "r_0.npz"
    np.savez(path, **{name: a for name, a in arrays.items() if a is not None})
    return path


def test_truth(tmp_path):
    alpha = np.full((HEIGHT, WIDTH), 251, np.uint8)
    alpha[0, 0] = 250
    save_truth(tmp_path, alpha=alpha)
    truth = load_truth(photos(tmp_path), 0)
    assert truth.albedo.dtype == torch.float32
    assert truth.albedo.shape == (HEIGHT, WIDTH, 3)
    assert float(truth.roughness[1, 1]) == 0.25
    assert truth.normal[1, 1].tolist() == [0, 0, 1]
    assert float(truth.depth[1, 1]) == 4
    assert truth.mask.sum() == HEIGHT * WIDTH - 1
    assert not truth.mask[0, 0]
    save_truth(tmp_path, albedo=None)
    assert load_truth(photos(tmp_path), 0).albedo is None
    assert all(v is None for v in vars(load_truth(photos(tmp_path, "r_1"), 0)).values())


def test_points(tmp_path):
    assert load_points(tmp_path) is None
    for arrays, message in (
        ({"vertices": np.eye(3)}, r"expected an array points of shape .*, got vertices \[3, 3\]"),
        ({"points": np.zeros((2, 2))}, r"got points \[2, 2\]"),
        ({"points": np.zeros((0, 3))}, r"got points \[0, 3\]"),
        ({"points": np.full((2, 3), np.inf)}, "expected finite points"),
        ({}, "got no arrays"),
    ):
        np.savez(tmp_path / "points.npz", **arrays)
        with pytest.raises(DataError, match=rf"points\.npz: .*{message}"):
            load_points(tmp_path)
    np.savez(tmp_path / "points.npz", points=np.eye(3))
    assert torch.equal(load_points(tmp_path), torch.eye(3))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"alpha": None}, r"expected an array alpha of shape \[H, W\], got albedo \[4, 6, 3\]"),
        ({"alpha": np.zeros(3, np.uint8)}, r"expected an array alpha of shape \[H, W\]"),
        ({"albedo": np.zeros((HEIGHT, WIDTH))}, r"expected albedo of size \[4, 6, 3\], got"),
        ({"roughness": np.full((HEIGHT, WIDTH), np.nan)}, "expected finite roughness"),
        ({"albedo": np.array([object()])}, "this npz file could not be read: .*pickle"),
    ],
)
def test_broken_truth(tmp_path, change, message):
    save_truth(tmp_path, **change)
    with pytest.raises(DataError, match=rf"r_0\.npz: {message}"):
        load_truth(photos(tmp_path), 0)


def test_relit_views(tmp_path):
    assert relight_maps(tmp_path) == {}
    (tmp_path / "envmaps").mkdir()
    for name, suffix in (("city", ".hdr"), ("beach", ".exr")):
        (tmp_path / "relight" / name).mkdir(parents=True)
        (tmp_path / "envmaps" / (name + suffix)).write_bytes(b"")
    write_png(tmp_path / "relight" / "city" / "r_0.png", rgba(3))
    write_png(tmp_path / "relight" / "city" / "r_1.png", rgba(4))
    (tmp_path / "relight" / "notes.txt").write_text("not a map")
    maps = relight_maps(tmp_path)
    assert list(maps) == ["beach", "city"]
    assert maps["city"] == tmp_path / "envmaps" / "city.hdr"
    assert maps["beach"] == tmp_path / "envmaps" / "beach.exr"
    color, alpha = load_relit(photos(tmp_path, "r_1", "r_0"), "city")
    assert np.array_equal(color[0].numpy(), rgba(4)[..., :3])
    assert np.array_equal(alpha[1].numpy(), rgba(3)[..., 3])


def test_broken_relit_views(tmp_path):
    (tmp_path / "relight" / "city").mkdir(parents=True)
    with pytest.raises(DataError, match=r"city: expected the environment map .*city\.hdr, but"):
        relight_maps(tmp_path)
    with pytest.raises(DataError, match=r"relight/city: the image .*r_0 does not exist"):
        load_relit(photos(tmp_path), "city")
    write_png(tmp_path / "relight" / "city" / "r_0.png", rgba())
    write_png(tmp_path / "relight" / "city" / "r_1.png", rgba(width=5))
    with pytest.raises(DataError, match=r"city/r_1\.png: expected 6x4 pixels as .*, got 5x4"):
        load_relit(photos(tmp_path, "r_0", "r_1"), "city")


# Truth as the data sets of the field have it


def gray(value, channels=4, width=WIDTH, height=HEIGHT):
    picture = np.full((height, width, channels), value, np.uint8)
    if channels == 4:
        picture[..., 3] = 255
    return picture


@pytest.mark.parametrize("channels", [3, 4])
def test_synthetic4relight_truth(tmp_path, channels):
    (tmp_path / "test").mkdir()
    write_png(tmp_path / "test" / "r_0_albedo.png", gray(128, channels))
    write_png(tmp_path / "test" / "r_0_rough.png", gray(51, channels))
    alpha = torch.full((HEIGHT, WIDTH), 255, dtype=torch.uint8)
    alpha[0, 0], alpha[0, 1] = 0, 250
    truth = load_truth(photos(tmp_path, alpha=alpha), 0)
    assert float(truth.albedo[1, 1, 0]) == pytest.approx(
        float(srgb_to_linear(torch.tensor(128 / 255)))
    )
    assert float(truth.roughness[1, 1]) == pytest.approx(0.2)
    assert truth.albedo[0, 0].tolist() == [0, 0, 0]
    assert truth.mask.sum() == HEIGHT * WIDTH - 2
    assert truth.normal is None
    assert truth.depth is None


def test_truth_of_tensoir_and_shiny_blender(tmp_path):
    """Albedo is linear; pictures have to fit."""
    (tmp_path / "test_000").mkdir()
    write_png(tmp_path / "test_000" / "albedo.png", gray(102))
    write_png(tmp_path / "test_000" / "normal.png", encoded_normal([0.6, 0.0, 0.8]))
    truth = load_truth(photos(tmp_path, "test_000"), 0)
    torch.testing.assert_close(truth.albedo, torch.full((HEIGHT, WIDTH, 3), 0.4))
    # Half a step of 8 bits over a unit vector
    torch.testing.assert_close(truth.normal[2, 3], torch.tensor([0.6, 0.0, 0.8]), atol=6e-3, rtol=0)
    torch.testing.assert_close(truth.normal.norm(dim=-1), torch.ones(HEIGHT, WIDTH))
    assert truth.roughness is None
    (tmp_path / "test").mkdir()
    write_png(tmp_path / "test" / "r_0_normal.png", encoded_normal([0.0, -1.0, 0.0]))
    truth = load_truth(photos(tmp_path), 0)
    wanted = torch.tensor([0.0, -1.0, 0.0])
    torch.testing.assert_close(truth.normal[0, 0], wanted, atol=6e-3, rtol=0)
    assert bool(truth.mask.all())
    assert truth.albedo is None
    for file, picture, message in (
        ("normal", gray(1)[..., 0], "expected an image with 3 or 4 channels, got 1"),
        ("albedo", gray(1, width=5), "expected 6x4 pixels as in the photograph, got 5x4"),
    ):
        write_png(tmp_path / "test" / f"r_0_{file}.png", picture)
        with pytest.raises(DataError, match=rf"r_0_{file}\.png: {message}"):
            load_truth(photos(tmp_path), 0)


def encoded_normal(normal):
    return np.broadcast_to(
        (255 * (np.array(normal) / 2 + 0.5)).round().astype(np.uint8), (HEIGHT, WIDTH, 3)
    )


def test_truth_is_shrunk_by_coverage(tmp_path):
    alpha = np.full((HEIGHT, WIDTH), 255, np.uint8)
    alpha[0, 0] = 0
    roughness = np.full((HEIGHT, WIDTH), 0.25, np.float32)
    roughness[0, 0], roughness[2, 2] = 1.0, 0.45
    normal = np.zeros((HEIGHT, WIDTH, 3), np.float32)
    normal[..., 2] = 1
    normal[2, 2:4] = [1, 0, 0]
    save_truth(tmp_path, alpha=alpha, roughness=roughness, normal=normal)
    truth = load_truth(photos(tmp_path, downscale=2), 0)
    assert truth.albedo.shape == (2, 3, 3)
    assert truth.mask.tolist() == [[False, True, True], [True, True, True]]
    assert float(truth.roughness[0, 0]) == pytest.approx(0.25)  # its transparent pixel says nothing
    assert float(truth.roughness[1, 1]) == pytest.approx(0.3)
    torch.testing.assert_close(truth.normal[1, 1], torch.tensor([0.5, 0.0, 0.5]) * 2**0.5)


def test_maps_of_synthetic4relight(tmp_path):
    """Those that are found in the scene's folder or beside it; the set comes without them."""
    scene = tmp_path / "hotdog"
    (scene / "test_rli").mkdir(parents=True)
    for name in ("envmap6", "envmap12"):
        write_png(scene / "test_rli" / f"{name}_r_0.png", rgba(len(name)))
    assert relight_maps(scene) == {}
    (tmp_path / "envmap12.exr").touch()
    (scene / "envmaps").mkdir()
    (scene / "envmaps" / "envmap6.exr").touch()
    (tmp_path / "envmap3.exr").touch()  # without pictures
    maps = relight_maps(scene)
    assert list(maps) == ["envmap12", "envmap6"]
    assert maps["envmap6"].parent.name == "envmaps"
    color, alpha = load_relit(photos(scene), "envmap12")
    assert np.array_equal(color[0].numpy(), rgba(8)[..., :3])
    assert np.array_equal(alpha[0].numpy(), rgba(8)[..., 3])
    assert load_relit(photos(scene, downscale=2), "envmap6")[0].shape == (1, 2, 3, 3)


def test_maps_of_tensoir(tmp_path):
    """The light of the training views is none of them."""
    view = tmp_path / "lego" / "test_000"
    view.mkdir(parents=True)
    (view / "metadata.json").touch()
    for light in ("city", "bridge", "sunset"):
        write_png(view / f"rgba_{light}.png", rgba(len(light)))
        (tmp_path / f"{light}.hdr").touch()
    (tmp_path / "bridge.hdr").unlink()
    assert list(relight_maps(tmp_path / "lego")) == ["city"]
    color, _ = load_relit(photos(tmp_path / "lego", "test_000"), "city")
    assert np.array_equal(color[0].numpy(), rgba(4)[..., :3])
