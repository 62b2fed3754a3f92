"""What Stanford-ORB's benchmark reads of a run: files, sizes and axes."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from analytic import cameras_around
from layouts import scene as layout

from lab.submit import SIZE, orb_light, submit
from univoxel.camera import Cameras
from univoxel.cli import main
from univoxel.data.images import read_exr, write_exr
from univoxel.envmap import lookup
from univoxel.errors import DataError, ExistingFile, UserError

NAME, OTHER = "ball_scene001", "ball_scene002"


@pytest.fixture(scope="module")
def orb(tiny, tmp_path_factory):
    """A scene, another one with its light, and a run trained on the first for a moment."""
    root = tmp_path_factory.mktemp("orb")
    data = shutil.copytree(tiny / "data", root / "blender_LDR" / NAME)
    shutil.copytree(tiny / "run", root / "run")
    config = json.loads((root / "run" / "config.json").read_text()) | {"data": str(data)}
    (root / "run" / "config.json").write_text(json.dumps(config))
    shutil.copytree(data, root / "blender_LDR" / OTHER)
    test = json.loads((data / "transforms_test.json").read_text())
    frames = [{**f, "scene_name": OTHER, "camera_angle_x": 0.7} for f in test["frames"]]
    (data / "transforms_novel.json").write_text(json.dumps({"frames": frames}))
    (root / "ground_truth" / NAME).mkdir(parents=True)
    maps = root / "ground_truth" / OTHER / "env_map"
    maps.mkdir(parents=True)
    for view, power in ((0, 1.0), (1, 4.0)):
        planes = {c: np.full((8, 16), power, np.float32) for c in "RGB"}
        write_exr(maps / f"r_{view}.exr", planes)
    return root


def picture(path, channels="RGB"):
    return np.stack([read_exr(path)[c] for c in channels], -1)


def test_a_submission(orb, tmp_path, capsys):
    assert main(["submit", str(orb / "run"), "--out", str(tmp_path / "out"), "--samples", "4"]) == 0
    path = tmp_path / "out" / "submission.json"
    assert capsys.readouterr().out.strip().endswith(str(path))
    (scene, info), *others = json.loads(path.read_text())["info"].items()
    assert scene == NAME
    assert not others
    assert set(info) == {"view", "light", "geometry", "material", "shape"}
    assert [len(info[key]) for key in ("view", "light", "geometry", "material")] == [2] * 4

    targets = orb / "blender_HDR" / NAME, orb / "ground_truth" / NAME
    for v in range(2):
        view, geometry, material = (info[key][v] for key in ("view", "geometry", "material"))
        assert view["target_image"] == str(targets[0] / "test" / f"r_{v}.exr")
        assert geometry["target_depth"] == str(targets[1] / "z_depth" / f"r_{v}.npy")
        assert geometry["target_normal"] == str(targets[1] / "surface_normal" / f"r_{v}.npy")
        assert geometry["target_mask"] == str(targets[0] / "test_mask" / f"r_{v}.png")
        assert material["target_image"] == str(targets[1] / "pseudo_gt_albedo" / f"r_{v}.png")
        assert picture(view["output_image"]).shape == (SIZE, SIZE, 3)
        assert picture(material["output_image"]).shape == (SIZE, SIZE, 3)
        normal = picture(geometry["output_normal"])
        # The middle of a ball faces its camera. Its silhouette only has been trained on so far
        x, y, z = normal[SIZE // 2 - 32 : SIZE // 2 + 32, SIZE // 2 - 32 : SIZE // 2 + 32].mean(
            (0, 1)
        )
        assert z > 0.8 * np.linalg.norm([x, y, z])
        assert normal[SIZE // 2, SIZE // 2, 2] > 0.5
        depth = picture(geometry["output_depth"], "Z")[..., 0]
        distance = float(cameras_around(2, 16).camera_to_world[v, :, 3].norm())
        assert 0 < depth[SIZE // 2, SIZE // 2] < distance
        assert depth[0, 0] == 0
    assert info["shape"]["target_mesh"] == str(targets[1] / "mesh_blender" / "mesh.obj")
    assert Path(info["shape"]["output_mesh"]).read_text().count("\nv ") > 100


def test_each_view_is_in_its_own_light(orb, tmp_path):
    path = submit(orb / "run", tmp_path / "out", samples=4)
    light = json.loads(path.read_text())["info"][NAME]["light"]
    means = [picture(entry["output_image"]).mean() for entry in light]
    assert means[1] > 3 * means[0] > 0  # four times the light on the other side of the ball
    assert light[1]["target_image"] == str(orb / "blender_LDR" / OTHER / "test" / "r_1.png")


def test_runs_and_arguments_that_cannot_be_used(orb, tmp_path):
    with pytest.raises(ExistingFile, match="exists already: choose another folder for out"):
        submit(orb / "run", tmp_path)
    with pytest.raises(
        UserError, match="expected samples >= 1 and bounces >= 0, got samples=0 and bounces=2"
    ):
        submit(orb / "run", tmp_path / "out", samples=0, bounces=2)
    run = tmp_path / "run"
    shutil.copytree(orb / "run", run)
    data = shutil.copytree(orb / "blender_LDR" / OTHER, tmp_path / "a" / "b" / "c")
    config = json.loads((run / "config.json").read_text())
    (run / "config.json").write_text(json.dumps(config | {"data": str(data)}))
    with pytest.raises(DataError, match=r"c: expected a scene of Stanford-ORB with .*ground_truth"):
        submit(run, tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("column", [0, 8, 16, 24])
def test_light_is_around_the_camera(tmp_path, column):
    """From the left: behind, to the left, ahead and to the right of the camera."""
    radiance = np.full((16, 32, 3), 0.25, np.float32)
    radiance[7:9, column - 1 if column else -1] = radiance[7:9, column] = 4.0
    write_exr(tmp_path / "0000.exr", dict(zip("RGB", np.moveaxis(radiance, 2, 0), strict=True)))
    pose = torch.tensor(layout().poses[3], dtype=torch.float32)[None, :3]
    camera = Cameras(pose, torch.ones(1, 2), torch.ones(1, 2), 2, 2)
    light = orb_light(tmp_path / "0000.exr", camera)
    right, up, back = pose[0, :, :3].T
    seen = lookup(light, torch.stack([back, -right, -back, right, up, -up]))[:, 0]
    wanted = torch.full((6,), 0.25)
    wanted[column // 8] = 4.0
    # Interpolated twice, at texels of 11 degrees
    torch.testing.assert_close(seen, wanted, atol=0.9, rtol=0)
