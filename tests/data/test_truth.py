"""Ground truth beside the photographs: materials, relit views, points; there, missing, broken."""

import numpy as np
import pytest
import torch

from univoxel.data import DataError, load_points, load_relit, load_truth, relight_maps
from univoxel.data.images import write_png

WIDTH, HEIGHT = 6, 4


def rgba(seed=0, width=WIDTH):
    return np.random.default_rng(seed).integers(1, 256, (HEIGHT, width, 4), dtype=np.uint8)


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
    truth = load_truth(tmp_path, "r_0")
    assert truth.albedo.dtype == torch.float32
    assert truth.albedo.shape == (HEIGHT, WIDTH, 3)
    assert float(truth.roughness[1, 1]) == 0.25
    assert truth.normal[1, 1].tolist() == [0, 0, 1]
    assert float(truth.depth[1, 1]) == 4
    assert truth.mask.sum() == HEIGHT * WIDTH - 1
    assert not truth.mask[0, 0]


def test_truth_that_is_not_there(tmp_path):
    assert all(value is None for value in vars(load_truth(tmp_path, "r_0")).values())
    save_truth(tmp_path, albedo=None)
    assert load_truth(tmp_path, "r_0").albedo is None


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"alpha": None}, r"expected an array alpha \[H, W\], got albedo \[4, 6, 3\]"),
        ({"alpha": np.zeros(3, np.uint8)}, r"expected an array alpha \[H, W\]"),
        (
            {"albedo": np.zeros((HEIGHT, WIDTH))},
            r"expected finite albedo of shape \[4, 6, 3\], got \[4, 6\]",
        ),
        ({"roughness": np.full((HEIGHT, WIDTH), np.nan)}, "expected finite roughness"),
        ({"albedo": np.array([object()])}, "expected an npz file, could not read it: .*pickle"),
    ],
)
def test_broken_truth(tmp_path, change, message):
    save_truth(tmp_path, **change)
    with pytest.raises(DataError, match=rf"r_0\.npz: {message}"):
        load_truth(tmp_path, "r_0")


@pytest.mark.parametrize("keep", [0.0, 0.1, 0.9])
def test_truncated_truth(tmp_path, keep):
    path = save_truth(tmp_path)
    content = path.read_bytes()
    path.write_bytes(content[: int(keep * len(content))])
    with pytest.raises(DataError, match=r"r_0\.npz: expected an npz file"):
        load_truth(tmp_path, "r_0")


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
    color, alpha = load_relit(tmp_path, "city", ["r_1", "r_0"])
    assert np.array_equal(color[0].numpy(), rgba(4)[..., :3])
    assert np.array_equal(alpha[1].numpy(), rgba(3)[..., 3])


def test_broken_relit_views(tmp_path):
    (tmp_path / "relight" / "city").mkdir(parents=True)
    with pytest.raises(DataError, match=r"city: expected its map .*city\.hdr, got nothing there"):
        relight_maps(tmp_path)
    with pytest.raises(DataError, match=r"relight/city: no picture .*r_0"):
        load_relit(tmp_path, "city", ["r_0"])
    write_png(tmp_path / "relight" / "city" / "r_0.png", rgba())
    write_png(tmp_path / "relight" / "city" / "r_1.png", rgba(width=5))
    with pytest.raises(DataError, match="city/r_1: expected 6x4 pixels, got 5x4"):
        load_relit(tmp_path, "city", ["r_0", "r_1"])


def test_points(tmp_path):
    assert load_points(tmp_path) is None
    np.savez(tmp_path / "points.npz", points=np.eye(3))
    assert torch.equal(load_points(tmp_path), torch.eye(3))


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"vertices": np.eye(3)}, r"expected an array points \[P, 3\], got vertices \[3, 3\]"),
        ({"points": np.zeros((2, 2))}, r"got points \[2, 2\]"),
        ({"points": np.zeros((0, 3))}, r"got points \[0, 3\]"),
        ({"points": np.full((2, 3), np.inf)}, "points hold NaN or infinity"),
        ({}, "got no arrays"),
    ],
)
def test_broken_points(tmp_path, arrays, message):
    np.savez(tmp_path / "points.npz", **arrays)
    with pytest.raises(DataError, match=rf"points\.npz: .*{message}"):
        load_points(tmp_path)
