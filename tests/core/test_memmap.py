"""Arrays on disk: the same numbers as in memory."""

import gc
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from analytic import write_scene
from PIL import Image

from univoxel.core import memmap, system
from univoxel.data import image_cache, load_images, load_photos
from univoxel.data.photos import packed, unpacked
from univoxel.errors import DataError
from univoxel.preparation.hull import mask_distances
from univoxel.training.loop import batch_at
from univoxel.training.pixels import split_pixels

pytestmark = pytest.mark.skipif(not system.can_map(), reason="Windows has no arrays on disk")


def test_small_arrays_and_those_of_no_folder_are_memory(tmp_path, monkeypatch):
    monkeypatch.setattr(memmap, "LARGE", 1000)
    assert not memmap.on_disk(memmap.zeros((2000,), torch.uint8))
    with memmap.large_arrays_in(tmp_path):
        assert not memmap.on_disk(memmap.zeros((999,), torch.uint8))
        assert memmap.on_disk(memmap.zeros((250,), torch.float32))
    assert not memmap.on_disk(memmap.zeros((2000,), torch.uint8))
    # A full disk is said at once
    with (
        memmap.large_arrays_in(tmp_path),
        pytest.raises(OSError, match=r"no space left for 1000000\.0 GB"),
    ):
        memmap.zeros((10**15,), torch.uint8)


def test_a_large_array_is_a_file_without_a_name(tmp_path, monkeypatch):
    monkeypatch.setattr(memmap, "LARGE", 1000)
    with memmap.large_arrays_in(tmp_path / "new"):
        array = memmap.zeros((8, 1024, 1024), torch.float32)
    assert list((tmp_path / "new").iterdir()) == []
    assert open_files(tmp_path) == 0  # mapped, and closed
    assert str(tmp_path) in Path("/proc/self/maps").read_text()
    array += torch.arange(8.0)[:, None, None]
    assert memmap.on_disk(array[3].flatten())
    assert array[:, 5, 7].tolist() == list(range(8))
    del array
    gc.collect()
    assert str(tmp_path) not in Path("/proc/self/maps").read_text()


def open_files(folder: Path) -> int:
    """Files below a folder that this process holds open."""
    links = [f"/proc/self/fd/{name}" for name in os.listdir("/proc/self/fd")]
    return sum(os.readlink(p).startswith(str(folder)) for p in links if os.path.lexists(p))


def test_an_array_in_a_file_changes_the_file(tmp_path):
    path = tmp_path / "file"
    path.write_bytes(bytes(8 + 12))
    array = memmap.mapped(path, 8, (1, 3), torch.float32)
    array[0, 1] = 2.5
    assert np.frombuffer(path.read_bytes()[8:], np.float32).tolist() == [0, 2.5, 0]
    with pytest.raises(ValueError, match="offset 9 is not a multiple of 4 bytes"):
        memmap.mapped(path, 9, (1, 2), torch.float32)
    with pytest.raises(ValueError, match="expected 24 bytes, got 20"):
        memmap.mapped(path, 8, (1, 4), torch.float32)
    assert path.stat().st_size == 20


@pytest.fixture
def scene(tmp_path):
    return write_scene(tmp_path / "scene", views=20, size=32)


def in_files(scene, run, monkeypatch, **more):
    monkeypatch.setattr(memmap, "LARGE", 1000)
    with memmap.large_arrays_in(run):
        return load_photos(scene, "train", kept=run / "kept.safetensors", **more)


def test_photographs_in_a_file_are_those_in_memory(scene, tmp_path, monkeypatch):
    usual = load_photos(scene, "train")
    read = in_files(scene, tmp_path / "run", monkeypatch)
    again = in_files(scene, tmp_path / "run", monkeypatch)
    for photos in (read, again):
        assert memmap.on_disk(photos.color)
        assert memmap.on_disk(photos.alpha)
        assert torch.equal(photos.color, usual.color)
        assert torch.equal(photos.alpha, usual.alpha)
    assert [p.name for p in (tmp_path / "run").iterdir()] == ["kept.safetensors"]
    image_cache.keep_photos(read, tmp_path / "run/kept.safetensors")  # it is there already
    monkeypatch.setattr(memmap, "LARGE", 1 << 28)
    unmapped = load_photos(scene, "train", kept=tmp_path / "run/kept.safetensors")
    assert torch.equal(unmapped.color, usual.color)


def test_reading_that_was_ended_goes_on(scene, tmp_path, monkeypatch):

    run, usual, names = tmp_path / "run", load_photos(scene, "train"), []
    read_photo = load_images.read_photo

    def until(most):
        def read(path, *arguments):
            names.append(path.name)
            if len(names) > most:
                raise KeyboardInterrupt
            return read_photo(path, *arguments)

        return read

    monkeypatch.setattr(image_cache, "FLUSHED", 4)
    monkeypatch.setattr(load_images, "READERS", 1)
    monkeypatch.setattr(load_images, "read_photo", until(10))
    with pytest.raises(KeyboardInterrupt):
        in_files(scene, run, monkeypatch)
    names.clear()
    monkeypatch.setattr(load_images, "read_photo", until(99))
    photos = in_files(scene, run, monkeypatch)
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
    in_files(scene, tmp_path / "run", monkeypatch)
    path = tmp_path / "run/kept.safetensors"
    path.write_bytes(damage(path.read_bytes()))
    again = in_files(scene, tmp_path / "run", monkeypatch)
    assert torch.equal(again.color, usual.color)
    assert torch.equal(again.alpha, usual.alpha)


def test_what_cannot_be_used_leaves_no_photographs(tmp_path, monkeypatch):

    scene = write_scene(tmp_path / "scene", views=4, size=32)
    for path in scene.rglob("*.png"):
        Image.fromarray(np.zeros((32, 32, 4), np.uint8)).save(path)
    with pytest.raises(DataError, match="fully transparent"):
        in_files(scene, tmp_path / "run", monkeypatch)
    assert list((tmp_path / "run").iterdir()) == []


def test_distances_and_pixels_are_those_of_memory(scene, tmp_path, monkeypatch):
    usual = load_photos(scene, "train")
    wanted = split_pixels(usual, mask_distances(usual.alpha, usual.cameras))
    photos = in_files(scene, tmp_path / "run", monkeypatch)
    with memmap.large_arrays_in(tmp_path / "run"):
        distance = mask_distances(photos.alpha, photos.cameras)
        assert memmap.on_disk(distance)
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


def test_of_very_many_pixels_some_are_drawn(scene):
    photos = load_photos(scene, "train")
    distance = mask_distances(photos.alpha, photos.cameras)
    whole = split_pixels(photos, distance)
    count = len(whole.trained) + len(whole.held_out)
    some = split_pixels(photos, distance, most=count // 3)
    drawn = torch.cat([some.trained, some.held_out])
    assert abs(len(drawn) - count // 3) <= len(photos)
    assert len(drawn.unique(dim=0)) == len(drawn)
    known = {tuple(row) for row in torch.cat([whole.trained, whole.held_out]).tolist()}
    assert {tuple(row) for row in drawn.tolist()} <= known
    of_view = torch.bincount(drawn[:, 0].long(), minlength=len(photos))
    assert int(of_view.min()) > 0
