"""Photographs are read at once and in bands, and kept: nothing tells from the result."""

import os
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from layouts import HEIGHT, WIDTH, repainted, replaced, scene, write_nerf, write_nerfstudio
from PIL import Image
from safetensors import safe_open

from univoxel.data import keep_photos, load_images, load_photos
from univoxel.data.images import write_exr, write_png
from univoxel.data.lens import Lens, sources, straightened
from univoxel.errors import DataError

BENT = {"k1": -0.05, "p2": 0.01}


@pytest.fixture
def data(tmp_path):
    return write_nerfstudio(tmp_path / "data", scene(20, width=37, height=29), **BENT)


def same(one, other):
    return torch.equal(one.color, other.color) and torch.equal(one.alpha, other.alpha)


@pytest.mark.parametrize("downscale", [1, 2, 3])
@pytest.mark.parametrize("bent", [False, True])
def test_readers_and_bands_do_not_matter(tmp_path, monkeypatch, downscale, bent):
    written = scene(20, width=37, height=29)
    folder = write_nerfstudio(tmp_path, written, **(BENT if bent else {}))
    monkeypatch.setattr(load_images, "READERS", 1)
    wanted = load_photos(folder, downscale=downscale)
    assert wanted.color.shape[1:3] == (29 // downscale, 37 // downscale)
    for readers, band in ((4, 1 << 20), (4, 1), (1, 200)):
        monkeypatch.setattr(load_images, "READERS", readers)
        monkeypatch.setattr(load_images, "BAND", band)
        assert same(load_photos(folder, downscale=downscale), wanted)
    if not bent and downscale == 1:
        assert np.array_equal(wanted.color[0], written.pictures[1, ..., :3])


def test_pixels_are_decoded_in_bands(data, monkeypatch):
    """No more of a large photograph at once than the constant says, in linear light."""
    linear = Mock(wraps=load_images._premultiplied)
    monkeypatch.setattr(load_images, "_premultiplied", linear)
    monkeypatch.setattr(load_images, "BAND", 8 * 37)
    written = write_nerfstudio(data.parent / "plain", scene(3, width=37, height=29))
    load_photos(written, downscale=2)
    rows = [len(call.args[0]) for call in linear.call_args_list]
    assert max(rows) == 8
    assert sum(rows) == 2 * 28  # the row that is left over is cut off


@pytest.mark.parametrize("bent", [False, True])
@pytest.mark.parametrize("window", [(11, 20, 7, 25), (0, 9, 0, 12), (25, 31, 30, 40)])
@pytest.mark.parametrize("factor", [1, 3])
def test_only_what_a_mask_shows_is_decoded(monkeypatch, window, factor, bent):
    """Nothing tells: a square that is half hidden is the mean of what is shown of it."""
    top, bottom, left, right = window
    color = torch.randint(1, 256, (31, 40, 3), dtype=torch.uint8)
    alpha = torch.zeros(31, 40, dtype=torch.uint8)
    alpha[top:bottom, left:right] = 255
    lens = Lens(40, 31, (40.0, 40.0), (20.0, 15.5), (-0.3, 0.0, 0.0), (0.02, 0.01))
    grid = sources(lens, straightened(lens)) if bent else None
    found = load_images.resampled(color, alpha, factor, grid)
    monkeypatch.setattr(load_images, "_span", lambda there, factor: (0, len(there) // factor))
    wanted = load_images.resampled(color, alpha, factor, grid)
    assert 0 < (wanted[1] > 0).float().mean() < 0.6
    assert torch.equal(found[0], wanted[0])
    assert torch.equal(found[1], wanted[1])
    found = load_images.resampled(color, torch.zeros_like(alpha), 3)
    assert torch.equal(found[0], color[1:30:3, 1:39:3])  # the middle of a square stays
    assert not found[1].any()


@pytest.mark.parametrize("factor", [1, 3])
@pytest.mark.parametrize("bent", [False, True])
def test_surroundings_that_a_mask_hides_are_kept(factor, bent):
    """A turntable is told by them, and rough outlines are drawn again by their colours."""
    row, column = torch.meshgrid(torch.arange(90), torch.arange(120), indexing="ij")
    color = torch.stack([row, column, row + column], 2).byte()  # a ramp: a place by its colour
    alpha = torch.zeros(90, 120, dtype=torch.uint8)
    alpha[30:60, 40:80] = 255
    lens = Lens(120, 90, (120.0, 120.0), (60.0, 45.0), (-0.3 if bent else 0.0, 0.0, 0.0))
    grid = sources(lens, straightened(lens)) if bent else None
    found, covered = load_images.resampled(color, alpha, factor, grid)
    whole, _ = load_images.resampled(color, torch.full_like(alpha, 255), factor, grid)
    hidden = covered == 0
    assert 0.5 < hidden.float().mean() < 0.95
    # Of a square the mean, in linear light, is not its middle; a step is 255 grey levels here
    assert (found.int() - whole.int())[hidden].abs().max() <= (3 if factor > 1 else 2)
    assert torch.equal(found[covered == 255], whole[covered == 255])


def test_the_first_broken_photograph_is_named(data, monkeypatch):
    """However many are read at once, and whichever fails first."""
    for name in ("p_003", "p_010", "p_017"):
        (data / "images" / f"{name}.png").write_bytes((data / "images/p_001.png").read_bytes()[:80])
    for readers in (1, 4):
        monkeypatch.setattr(load_images, "READERS", readers)
        with pytest.raises(DataError, match=r"p_003\.png: expected a PNG or JPEG"):
            load_photos(data)


def test_masks_of_16_bits_may_come_later(tmp_path):
    """Alpha is float32 as soon as one mask is, wherever it stands."""
    folder = write_nerf(tmp_path, scene(10))
    before = load_photos(folder)
    alpha = np.full((HEIGHT, WIDTH), 0.25, np.float32)
    write_png(folder / "train" / "p_004.png", before.color[3].numpy())
    Image.fromarray((65535 * alpha).astype(np.uint16)).save(folder / "train" / "p_004_mask.png")
    after = load_photos(folder)
    assert after.alpha.dtype == torch.float32
    torch.testing.assert_close(after.alpha[0], before.alpha[0] / 255)
    torch.testing.assert_close(after.alpha[3], torch.from_numpy(alpha), atol=2e-5, rtol=0)


def load_kept(data, file, **options):
    photos = load_photos(data, kept=file, **options)
    keep_photos(photos, file)
    return photos


def test_what_was_kept_is_what_was_read(data, tmp_path, read):
    file = tmp_path / "kept"
    first = load_kept(data, file, downscale=2)
    assert len(read) == len(first) == 17
    stamp = file.stat().st_mtime_ns
    again = load_kept(data, file, downscale=2)
    assert len(read) == 17
    assert same(first, again)
    assert (again.names, again.about, again.downscale) == (first.names, first.about, 2)
    assert file.stat().st_mtime_ns == stamp  # not written again
    load_photos(data, downscale=2)
    assert len(read) == 2 * 17  # only where it was said
    plain = load_kept(write_nerf(tmp_path / "plain", scene()), tmp_path / "none")
    assert plain.origin == ""
    assert not (tmp_path / "none").exists()  # as they are they are there already


@pytest.mark.parametrize(
    "change",
    [
        lambda data: os.utime(data / "images" / "p_001.png", ns=(1, 1)),
        repainted("masks/p_001.png", np.full((29, 37), 255, np.uint8)),
        replaced("transforms.json", ('"p2": 0.01', '"p2": 0.02')),
    ],
)
def test_what_is_no_longer_so_is_read_again(data, tmp_path, read, change):
    file = tmp_path / "kept"
    load_kept(data, file, downscale=2)
    change(data)
    load_kept(data, file, downscale=2)
    assert len(read) == 2 * 17
    load_kept(data, file, downscale=2)
    assert len(read) == 2 * 17


@pytest.mark.parametrize(
    "options",
    [{"downscale": 3}, {"downscale": 2, "masks": False}, {"downscale": 2, "split": "test"}],
)
def test_what_is_wanted_otherwise_is_read(data, tmp_path, read, options):
    file = tmp_path / "kept"
    load_kept(data, file, downscale=2)
    assert same(load_photos(data, kept=file, **options), load_photos(data, **options))


def test_masks_beside_photographs_count(tmp_path, read):
    folder = write_nerf(tmp_path / "data", scene(10))
    for v in range(10):
        name = f"{'test' if v % 8 == 0 else 'train'}/p_{v:03d}"
        write_png(folder / f"{name}.png", scene(10).pictures[v, ..., :3])
        write_png(folder / f"{name}_alpha.png", scene(10).pictures[v, ..., 3])
    file = tmp_path / "kept"
    load_kept(folder, file, downscale=2)
    write_png(folder / "train/p_001_mask.png", np.full((HEIGHT, WIDTH), 9, np.uint8))
    assert load_kept(folder, file, downscale=2).alpha[0].unique().tolist() == [9]


@pytest.mark.parametrize(
    "harm",
    [
        lambda content: content[:-7],
        lambda content: b"something else",
        lambda content: b"",
        lambda content: content[:-9] + bytes([content[-9] ^ 4]) + content[-8:],
    ],
)
def test_broken_files_are_passed_over_and_written_anew(data, tmp_path, read, harm):
    file = tmp_path / "kept"
    wanted = load_kept(data, file, downscale=2)
    file.write_bytes(harm(file.read_bytes()))
    assert same(load_kept(data, file, downscale=2), wanted)
    assert len(read) == 2 * 17
    assert same(load_kept(data, file, downscale=2), wanted)
    assert len(read) == 2 * 17


def test_what_cannot_be_written_is_said_and_does_no_harm(data, tmp_path, caplog):
    caplog.set_level("INFO", "univoxel")
    photos = load_photos(data, downscale=2)
    keep_photos(photos, tmp_path / "nowhere" / "kept")
    assert "prepared photographs could not be stored " in caplog.text
    (tmp_path / "kept").mkdir()
    keep_photos(photos, tmp_path / "kept")
    assert same(load_photos(data, downscale=2, kept=tmp_path / "kept"), photos)
    assert [p.name for p in tmp_path.iterdir() if p.name.endswith(".tmp")] == []


def test_pictures_of_differing_sizes_and_linear_ones_are_kept(tmp_path, read):
    folder = write_nerf(tmp_path / "data", scene(10))
    for v in range(10):
        path = folder / ("test" if v % 8 == 0 else "train") / f"p_{v:03d}"
        path.with_suffix(".png").unlink()
        values = torch.rand(HEIGHT - v % 2, WIDTH - v % 3, 4) + 0.1
        write_exr(path.with_suffix(".exr"), dict(zip("RGBA", values.unbind(2), strict=True)))
    file = tmp_path / "kept"
    first, again = load_kept(folder, file, downscale=2), load_kept(folder, file, downscale=2)
    assert len(read) == 8
    assert first.color.dtype == torch.float32
    assert same(first, again)
    assert torch.equal(first.cameras.size_of_each(), again.cameras.size_of_each())
    assert first.cameras.sizes is not None
    with safe_open(file, "pt") as opened:
        assert set(opened.keys()) == {"color", "alpha"}
