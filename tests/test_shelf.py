"""Arrays on disk: the same numbers as in memory, and no memory of the process."""

import gc
import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from analytic import write_scene
from PIL import Image

from univoxel import shelf
from univoxel.data import kept, load_photos, shots
from univoxel.errors import DataError
from univoxel.preparation.hull import mask_distances
from univoxel.training import pixels as training_pixels
from univoxel.training.loop import batch_at
from univoxel.training.pixels import packed, split_pixels, unpacked

pytestmark = pytest.mark.skipif(shelf.DROP is None, reason="arrays on disk are of Linux")


def resident_mb() -> float:
    """Pages of files that this process holds."""
    lines = Path("/proc/self/status").read_text().splitlines()
    (line,) = [line for line in lines if line.startswith("RssFile")]
    return int(line.split()[1]) / 1024


def test_small_arrays_and_those_of_no_shelf_are_memory(tmp_path, monkeypatch):
    monkeypatch.setattr(shelf, "LARGE", 1000)
    assert not shelf.on_disk(shelf.zeros((2000,), torch.uint8))
    with shelf.shelved(tmp_path):
        assert not shelf.on_disk(shelf.zeros((999,), torch.uint8))
        assert shelf.on_disk(shelf.zeros((250,), torch.float32))
    assert not shelf.on_disk(shelf.zeros((2000,), torch.uint8))


def test_what_is_released_takes_no_memory_and_stays(tmp_path, monkeypatch):
    monkeypatch.setattr(shelf, "LARGE", 1000)
    with shelf.shelved(tmp_path / "new"):
        array = shelf.zeros((8, 1024, 1024), torch.float32)
    assert list((tmp_path / "new").iterdir()) == []  # a file without a name
    before = resident_mb()
    array += torch.arange(8.0)[:, None, None]
    assert resident_mb() > before + 30
    shelf.release(array[3])
    assert resident_mb() < before + 29
    shelf.release()
    assert resident_mb() < before + 2
    assert array[:, 5, 7].tolist() == list(range(8))
    del array
    gc.collect()
    assert not shelf._maps


def test_a_full_disk_is_said_at_once(tmp_path, monkeypatch):
    monkeypatch.setattr(shelf, "LARGE", 1000)
    with shelf.shelved(tmp_path), pytest.raises(OSError, match=r"no room for 1000000\.0 GB"):
        shelf.zeros((10**15,), torch.uint8)


@pytest.fixture
def scene(tmp_path):
    return write_scene(tmp_path / "scene", views=20, size=32)


def on_shelf(scene, run, monkeypatch, **more):
    monkeypatch.setattr(shelf, "LARGE", 1000)
    with shelf.shelved(run):
        return load_photos(scene, "train", kept=run / "kept.safetensors", **more)


def test_photographs_on_a_shelf_are_those_in_memory(scene, tmp_path, monkeypatch):
    usual = load_photos(scene, "train")
    read = on_shelf(scene, tmp_path / "run", monkeypatch)
    again = on_shelf(scene, tmp_path / "run", monkeypatch)
    for photos in (read, again):
        assert shelf.on_disk(photos.color)
        assert shelf.on_disk(photos.alpha)
        assert torch.equal(photos.color, usual.color)
        assert torch.equal(photos.alpha, usual.alpha)
    assert [p.name for p in (tmp_path / "run").iterdir()] == ["kept.safetensors"]
    kept.keep_photos(read, tmp_path / "run/kept.safetensors")  # it is there already
    monkeypatch.setattr(shelf, "LARGE", 1 << 28)
    unmapped = load_photos(scene, "train", kept=tmp_path / "run/kept.safetensors")
    assert torch.equal(unmapped.color, usual.color)


def test_reading_that_was_ended_goes_on(scene, tmp_path, monkeypatch):

    run, usual, names = tmp_path / "run", load_photos(scene, "train"), []
    read_photo = shots.read_photo

    def until(most):
        def read(path, *arguments):
            names.append(path.name)
            if len(names) > most:
                raise KeyboardInterrupt
            return read_photo(path, *arguments)

        return read

    monkeypatch.setattr(kept, "FLUSHED", 4)
    monkeypatch.setattr(shots, "READERS", 1)
    monkeypatch.setattr(shots, "read_photo", until(10))
    with pytest.raises(KeyboardInterrupt):
        on_shelf(scene, run, monkeypatch)
    names.clear()
    monkeypatch.setattr(shots, "read_photo", until(99))
    photos = on_shelf(scene, run, monkeypatch)
    assert len(names) == 20 - 8  # two times four were safe
    assert torch.equal(photos.color, usual.color)
    assert torch.equal(photos.alpha, usual.alpha)


@pytest.mark.parametrize(
    "damage",
    [
        lambda raw: raw[:-5000],
        lambda raw: raw[:5000] + bytes([raw[5000] ^ 1]) + raw[5001:],
        lambda raw: b"\xff" * 8 + raw[8:],
        lambda raw: raw[:8] + raw[8:].replace(b"[20, 32, 32, 3]", b'{"a": 1.0, "b"}', 1),
    ],
)
def test_a_broken_file_is_read_again(scene, tmp_path, monkeypatch, damage):
    usual = load_photos(scene, "train")
    on_shelf(scene, tmp_path / "run", monkeypatch)
    path = tmp_path / "run/kept.safetensors"
    path.write_bytes(damage(path.read_bytes()))
    again = on_shelf(scene, tmp_path / "run", monkeypatch)
    assert torch.equal(again.color, usual.color)
    assert torch.equal(again.alpha, usual.alpha)


def test_what_cannot_be_used_leaves_no_photographs(tmp_path, monkeypatch):

    scene = write_scene(tmp_path / "scene", views=4, size=32)
    for path in scene.rglob("*.png"):
        Image.fromarray(np.zeros((32, 32, 4), np.uint8)).save(path)
    with pytest.raises(DataError, match="fully transparent"):
        on_shelf(scene, tmp_path / "run", monkeypatch)
    assert list((tmp_path / "run").iterdir()) == []


def test_distances_and_pixels_are_those_of_memory(scene, tmp_path, monkeypatch):
    usual = load_photos(scene, "train")
    wanted = split_pixels(usual, mask_distances(usual.alpha, usual.cameras))
    photos = on_shelf(scene, tmp_path / "run", monkeypatch)
    with shelf.shelved(tmp_path / "run"):
        distance = mask_distances(photos.alpha, photos.cameras)
        assert shelf.on_disk(distance)
        got = split_pixels(photos, distance)
    assert torch.equal(got.held_out[:, :3], wanted.held_out)
    places = got.trained[:, :3]
    assert torch.equal(places.unique(dim=0), wanted.trained.unique(dim=0))
    assert len(places) == len(wanted.trained)
    one, other = batch_at(photos, got.trained), batch_at(usual, places)
    assert torch.equal(one.color, other.color)
    assert torch.equal(one.alpha, other.alpha)


@pytest.mark.parametrize("of_color", [torch.uint8, torch.float32])
@pytest.mark.parametrize("of_alpha", [torch.uint8, torch.float32])
def test_packed_pixels_are_the_stored_ones(scene, of_color, of_alpha):
    photos = load_photos(scene, "train")
    if of_color != torch.uint8:
        photos = replace(photos, color=photos.color.float() / 100)
    if of_alpha != torch.uint8:
        photos = replace(photos, alpha=photos.alpha.float() / 255)
    place = torch.randint(32, (50, 2), generator=torch.Generator().manual_seed(0))
    color, alpha = unpacked(photos, packed(photos, 2, place))
    expected = photos.pixels(torch.full((50,), 2), *place.unbind(1))
    assert torch.equal(color, expected[0])
    assert torch.equal(alpha, expected[1])


def test_of_very_many_pixels_some_are_drawn(scene, monkeypatch, caplog):
    caplog.set_level(logging.INFO)
    photos = load_photos(scene, "train")
    distance = mask_distances(photos.alpha, photos.cameras)
    whole = split_pixels(photos, distance)
    count = len(whole.trained) + len(whole.held_out)
    monkeypatch.setattr(training_pixels, "MOST", count // 3)
    some = split_pixels(photos, distance)
    drawn = torch.cat([some.trained, some.held_out])
    assert abs(len(drawn) - count // 3) <= len(photos)
    assert len(drawn.unique(dim=0)) == len(drawn)
    known = {tuple(row) for row in torch.cat([whole.trained, whole.held_out]).tolist()}
    assert {tuple(row) for row in drawn.tolist()} <= known
    of_view = torch.bincount(drawn[:, 0].long(), minlength=len(photos))
    assert int(of_view.min()) > 0
