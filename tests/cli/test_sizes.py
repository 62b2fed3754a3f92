"""From photographs of differing sizes to pictures of theirs: what each command makes of them."""

import math
import shutil

import numpy as np
import pytest
import torch
from analytic import write_scene
from cropped import windows, write_cropped
from PIL import Image
from plain import plain_stage, plain_training

from univoxel.capture import cutout as task
from univoxel.cli.evaluate import evaluate
from univoxel.cli.inspect import inspect
from univoxel.cli.relight import relight_images, relight_to_files
from univoxel.cli.trainer import train
from univoxel.data import load_photos, load_truth
from univoxel.data.images import image_size, read_exr, read_image, write_exr, write_png
from univoxel.errors import DataError, UserError
from univoxel.lights import SGConfig
from univoxel.output import timelapse
from univoxel.run import photos_of as photos_of_run
from univoxel.scene import SceneConfig

VIEWS, SIZE = 12, 40


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    return write_scene(tmp_path_factory.mktemp("whole") / "data", VIEWS, SIZE)


@pytest.fixture(scope="module")
def data(whole, tmp_path_factory):
    return write_cropped(whole, tmp_path_factory.mktemp("cut") / "data")


@pytest.fixture(scope="module")
def kept(whole):
    """Rows and columns of the test views that were not cut away."""
    return windows(load_photos(whole, "test").alpha)


@pytest.fixture(scope="module")
def runs(data, whole, tmp_path_factory):
    """Trained on the cut and on the whole photographs."""
    out = tmp_path_factory.mktemp("runs")
    light = SGConfig(lobes=2, hidden=8, directions=16, directions_eval=16)
    stage = plain_stage(voxels=0.02, iterations=60, share=1.0, rays=256, physical_from=0.5)
    sizes = SceneConfig(4, material_channels=2, hidden=8, sky_nodes=16, light=light)
    options = {"minutes": 2.0, "scene": sizes, "voxel_pixels": 0.0}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(timelapse, "FRAMES", 1e9)
        return [
            train(
                plain_training(folder, out / name, (stage,), **options),
                timelapse=out / f"{name}.gif",
            )
            for folder, name in ((data, "cut"), (whole, "whole"))
        ]


def sizes(cameras):
    return [tuple(size) for size in cameras.size_of_each().tolist()]


def test_sizes_are_read_and_told(data):
    photos = load_photos(data)
    named = sizes(photos.cameras)
    assert len(set(named)) == 4
    assert named == [image_size(data / "train" / f"{name}.png") for name in photos.names]
    assert f"{VIEWS} photographs of 4 sizes up to {SIZE}x{SIZE} pixels in train" in photos.about
    width, height = named[2]
    assert not photos.alpha[2, height:].any()
    assert not photos.color[2, :, width:].any()
    two = load_photos(data, "test")
    (w0, h0), (w1, h1) = sizes(two.cameras)
    words = [f"{w0}x{h0} (1) and {w1}x{h1} (1)", f"{w1}x{h1} (1) and {w0}x{h0} (1)"]
    assert any(f"2 photographs of {said} pixels in test" in two.about for said in words)
    half = load_photos(data, downscale=2)
    assert sizes(half.cameras) == [(w // 2, h // 2) for w, h in named]
    torch.testing.assert_close(half.cameras.centre * 2, photos.cameras.centre)


def test_training_goes_as_with_whole_photographs(runs, data, whole):
    """Both runs on the same test views: they differ by what chance does."""
    found, wanted = (evaluate(run, data=whole)["nvs_psnr"] for run in runs)
    assert wanted > 18
    assert found == pytest.approx(wanted, abs=1.5)
    assert (runs[0] / "preview.png").is_file()
    width, height = photos_of_run(runs[0]).cameras.size(0)
    with Image.open(runs[0].parent / "cut.gif") as film:
        assert film.size == (3 * width, height + timelapse.LABEL)


def test_test_views_are_rendered_in_their_sizes(runs, data, whole, kept, tmp_path):
    """The same run on whole and on cut test views: the same pixels, as far as they are there."""
    views = load_photos(data, "test")
    for name in views.names:  # with what is measured beside the novel views
        for folder in (whole, data):
            picture = read_image(folder / "test" / f"{name}.png")
            (folder / "relight" / "white").mkdir(parents=True, exist_ok=True)
            write_png(folder / "relight" / "white" / f"{name}.png", picture)
            write_png(folder / "test" / f"{name}_albedo.png", picture)
    for folder in (whole, data):
        (folder / "envmaps").mkdir(exist_ok=True)
        write_exr(folder / "envmaps" / "white.exr", {c: torch.ones(4, 8) for c in "RGB"})
    wanted = evaluate(runs[0], data=whole, save=tmp_path / "whole", samples=4)
    found = evaluate(runs[0], save=tmp_path / "cut", samples=4)
    # Errors lie in the part that both have
    area = [math.prod(size) / SIZE**2 for size in sizes(views.cameras)]
    fewer = sum(10 * math.log10(share) for share in area) / len(area)
    assert fewer < -0.1
    assert found["nvs_psnr"] == pytest.approx(wanted["nvs_psnr"] + fewer, abs=1e-2)
    assert found["albedo_psnr_fg"] == pytest.approx(wanted["albedo_psnr_fg"], abs=1e-2)
    assert found["relit_psnr"] == pytest.approx(wanted["relit_psnr"] + fewer, abs=0.5)  # noise
    for view, name in enumerate(views.names):
        mine, theirs = (read_exr(tmp_path / d / f"{name}.exr") for d in ("cut", "whole"))
        assert mine["alpha"].shape == tuple(reversed(views.cameras.size(view)))
        for channel in ("rgb.R", "albedo.G", "depth", "normal.Z"):
            np.testing.assert_allclose(
                mine[channel], theirs[channel][kept[view]], atol=2e-2, err_msg=channel
            )
    assert read_image(tmp_path / "cut" / "contact_sheet.png").shape[0] < SIZE * 2 + 40
    folder = shutil.copytree(data, tmp_path / "data")
    write_png(folder / "test" / f"{views.names[0]}_albedo.png", torch.zeros(SIZE + 1, SIZE, 3))
    with pytest.raises(DataError, match=r"_albedo\.png: expected .* pixels as in the photograph"):
        load_truth(load_photos(folder, "test"), 0)


def test_relit_test_views_have_their_sizes(runs, data, kept, tmp_path):
    light = tmp_path / "white.exr"
    write_exr(light, {c: torch.ones(4, 8) for c in "RGB"})
    options = {"samples": 16, "bounces": 0, "progress": False, "animation": ("gif",)}
    relight_to_files(runs[0], light, tmp_path / "cut", **options)
    views = photos_of_run(runs[0])
    for view, name in enumerate(views.names):
        assert image_size(tmp_path / "cut" / f"{name}.png") == views.cameras.size(view)
    with Image.open(tmp_path / "cut" / "animation.gif") as film:
        assert (film.n_frames, film.size) == (2, (views.cameras.width, views.cameras.height))
    stacked = relight_images(runs[0], light, samples=16, bounces=0)
    cameras = load_photos(data, "test").cameras
    of_cameras = relight_images(runs[0], light, cameras, samples=16, bounces=0)
    assert torch.equal(stacked, of_cameras)
    width, height = views.cameras.size(1)
    assert not stacked[1, height:].any()
    assert not stacked[1, :, width:].any()
    assert stacked[1, :height, :width, 3].max() > 0.9
    # Half as wide: each view half its own size
    options = {"resolution": views.cameras.width // 2, "samples": 4, "bounces": 0}
    relight_to_files(runs[0], light, tmp_path / "half", **options, progress=False)
    for view, name in enumerate(views.names):
        wide, high = (round(n / 2) for n in views.cameras.size(view))
        assert image_size(tmp_path / "half" / f"{name}.png") == (wide, high)


def test_a_pixel_is_one_of_its_view(runs, data):
    views = photos_of_run(runs[0])
    view = 1
    width, height = views.cameras.size(view)
    assert width < views.cameras.width or height < views.cameras.height
    with pytest.raises(UserError, match=f"expected a pixel of a {width}x{height}"):
        inspect(runs[0], str(view), (width, height - 1))
    assert inspect(runs[0], str(view), (width // 2, height // 2), height=8).is_file()


def test_photographs_are_cut_out_in_their_sizes(data, tmp_path, monkeypatch):
    before = load_photos(data, masks=False)
    monkeypatch.setattr(
        task, "mask_network", lambda name: lambda photo: (photo.sum(-1) > 0).float()
    )
    out = task.cutout(data, tmp_path / "out")
    after = load_photos(out)
    assert sizes(after.cameras) == sizes(before.cameras)
    assert torch.equal(after.stored(2)[0], before.stored(2)[0])
    torch.testing.assert_close(after.cameras.centre, before.cameras.centre)
