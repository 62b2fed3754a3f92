"""examples/blender_run.py: what it writes for Blender; and Blender itself, where it is.

The latter is no part of CI. It needs a Python that has bpy:

    python -m venv blender && blender/bin/pip install bpy
    BLENDER_PYTHON=blender/bin/python pytest tests/test_blender_run.py
"""

import importlib.util
import json
import os
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from analytic import sphere_scene, write_scene
from PIL import Image
from torch.nn.functional import avg_pool2d

import univoxel
from univoxel.camera import Cameras, project, resize
from univoxel.color import linear_to_srgb
from univoxel.data import load_photos
from univoxel.data.images import read_image
from univoxel.render.metrics import psnr
from univoxel.scene import save_scene

EXAMPLE = Path(__file__).parents[1] / "examples" / "blender_run.py"
BLENDER = os.environ.get("BLENDER_PYTHON")


@pytest.fixture(scope="module")
def example():
    spec = importlib.util.spec_from_file_location("blender_run", EXAMPLE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    data = write_scene(folder / "data", views=3)
    scene = sphere_scene(256)
    with torch.no_grad():  # a light with a side
        scene.sky.log_radiance += 2 * scene.sky.direction[:, :1]
    scene.inv_s = 600.0  # a silhouette as sharp as after a training
    save_scene(scene, folder, {})
    (folder / "config.json").write_text(json.dumps({"data": str(data)}))
    return folder


@pytest.fixture(scope="module")
def prepared(example, run, tmp_path_factory):
    example.FACES = 2000
    folder = tmp_path_factory.mktemp("prepared")
    example.main(["prepare", str(run), str(folder)])
    return folder


@pytest.mark.parametrize("focal", [(150.0, 150.0), (150.0, 120.0), (120.0, 150.0)])
@pytest.mark.parametrize("centre", [(80.0, 45.0), (60.0, 55.0)])
def test_a_lens_in_the_words_of_blender(example, focal, centre):
    """Blender's own view plane, of its manual, against our cameras."""
    width, height = size = (160, 90)
    lens = example.lens_of(focal, centre, size)
    point = torch.randn(50, 3, generator=torch.Generator().manual_seed(0)) - torch.tensor(
        [0, 0, 5.0]
    )
    pose = torch.eye(3, 4)[None]
    camera = Cameras(pose, torch.tensor([focal]), torch.tensor([centre]), width, height)
    expected, _ = project(camera, 0, point)
    x, y = (point[:, :2] / -point[:, 2:]).T.numpy()
    # On the sensor, in widths of the picture; shifts move the picture over it
    across = x * lens["lens"] / 36 - lens["shift_x"]
    up = y * lens["lens"] / 36 - lens["shift_y"]
    aspect = lens["aspect_y"] / lens["aspect_x"]
    found = np.stack([width * (0.5 + across), height / 2 - width * up / aspect], 1)
    np.testing.assert_allclose(found, expected.numpy(), atol=1e-3)
    assert min(lens["aspect_x"], lens["aspect_y"]) == 1  # Blender takes no less


def test_what_is_written(prepared, run):
    views = json.loads((prepared / "cameras.json").read_text())["views"]
    photos = load_photos(run / "data", "train")
    assert [view["name"] for view in views] == photos.names
    for index, view in enumerate(views):
        picture = np.asarray(Image.open(prepared / view["picture"]))
        assert np.array_equal(picture[..., :3], photos.color[index].numpy())
        assert np.array_equal(picture[..., 3], photos.alpha[index].numpy())
        pose = torch.tensor(view["camera_to_world"])
        torch.testing.assert_close(pose, photos.cameras.camera_to_world[index])
        assert tuple(view["size"]) == photos.cameras.size(index)
    assert (prepared / "object.glb").read_bytes().startswith(b"glTF")
    light = univoxel.open_run(run).light()
    assert torch.equal(read_image(prepared / "light.exr"), light.radiance)


@pytest.mark.skipif(not BLENDER, reason="BLENDER_PYTHON names no Python with bpy")
@pytest.mark.parametrize("shifted", [False, True])
def test_blender_renders_what_univoxel_does(example, prepared, run, tmp_path, shifted):
    """30 dB: they differ in noise, and in that a volume has no sharp edge.

    Blender averages over a pixel; so does a picture four times as wide that is shrunk.
    """
    file = prepared / "cameras.json"
    before = file.read_text()
    view = json.loads(before)["views"][1]
    cameras = load_photos(run / "data", "train").cameras.of(torch.tensor([1]))
    if shifted:
        focal, centre, size = (60.0, 50.0), (20.0, 30.0), (48, 40)
        view |= example.lens_of(focal, centre, size) | {"size": size}
        focal, centre = torch.tensor([focal]), torch.tensor([centre])
        cameras = replace(cameras, focal=focal, centre=centre, width=48, height=40)
    file.write_text(json.dumps({"views": [view]}))
    out = tmp_path / "out.exr"
    command = [BLENDER, EXAMPLE, prepared, "--render", view["name"], out, "--samples", "64"]
    try:
        subprocess.run(command, check=True, capture_output=True, timeout=600)
    finally:
        file.write_text(before)
    light, large = prepared / "light.exr", resize(cameras, 4 * cameras.width)
    ours = univoxel.open_run(run).relight(light, large, samples=16)
    ours = avg_pool2d(ours.movedim(3, 1), 4)[0].movedim(0, 2)
    both = [linear_to_srgb(p[..., :3].clamp_min(0)) for p in (read_image(out), ours)]
    assert psnr(*both) >= 30
