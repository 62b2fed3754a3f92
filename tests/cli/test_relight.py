"""Relit frames of a stand-in scene: a grey sphere that needs no training."""

import json
import math
from types import SimpleNamespace

import pytest
import torch
from balls import surface_at

from univoxel.camera import image_rays, project
from univoxel.cli import relight as task
from univoxel.color import linear_to_srgb
from univoxel.core.records import Mesh
from univoxel.data.images import read_exr, read_image, write_exr
from univoxel.envmap import EnvMap
from univoxel.errors import DataError
from univoxel.ops import Sun, VisibilityScene
from univoxel.output import viewpoints
from univoxel.output.viewpoints import orbit

SIZE, RADIUS, ALBEDO = 24, 0.5, 0.6


def sphere(n=40):
    """A closed mesh of the sphere, wound outwards, with one grey material."""
    phi, theta = torch.meshgrid(
        2 * math.pi * torch.arange(n + 1) / n, math.pi * torch.arange(n + 1) / n, indexing="ij"
    )
    normal = torch.stack([theta.sin() * phi.cos(), theta.sin() * phi.sin(), theta.cos()], -1)
    normal = normal.reshape(-1, 3)
    i = ((n + 1) * torch.arange(n)[:, None] + torch.arange(n)).reshape(-1)
    faces = torch.stack([i, i + 1, i + n + 2, i, i + n + 2, i + n + 1], 1).reshape(-1, 3).int()
    albedo = torch.full_like(normal, ALBEDO)
    return Mesh(RADIUS * normal, faces, normal, albedo, torch.full((len(normal),), 0.7))


def surface_of_view(scene, cameras, view, albedo_near=None):
    rays = image_rays(cameras, view)
    mesh = sphere()
    hit = VisibilityScene(mesh.vertices, mesh.faces).closest_hit(rays.origin, rays.direction)
    met = hit.face >= 0
    depth = torch.where(met, hit.t, 0.0)
    position = rays.origin + depth[:, None] * rays.direction
    normal = torch.nn.functional.normalize(position, dim=1)
    surface = surface_at(position, normal, ALBEDO, 0.7, opacity=met.float(), depth=depth)
    return surface, -rays.direction


@pytest.fixture
def run(tmp_path, monkeypatch):
    """A run whose data has two test cameras at +X and +Y, and three maps beside it."""
    scene = SimpleNamespace(field=SimpleNamespace(voxel_size=0.02))
    monkeypatch.setattr(viewpoints, "load_scene", lambda run: scene)
    monkeypatch.setattr(viewpoints, "extract_mesh", lambda scene: sphere())
    monkeypatch.setattr(viewpoints, "surface_of_view", surface_of_view)
    poses = [
        [[0, 0, 1, 2], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]],
        [[-1, 0, 0, 0], [0, 0, 1, 2], [0, 1, 0, 0], [0, 0, 0, 1]],
    ]
    frames = [{"file_path": f"./test/r_{i}", "transform_matrix": p} for i, p in enumerate(poses)]
    cameras = {"camera_angle_x": 0.7, "w": SIZE, "h": SIZE, "frames": frames}
    (tmp_path / "cameras.json").write_text(json.dumps(cameras))
    (tmp_path / "run").mkdir()
    white, sun = torch.ones(4, 8), torch.zeros(16, 32)
    sun[7:9, 15:17] = 50.0  # at +X
    for name, radiance in (("white", white), ("dim", 0.25 * white), ("sun", sun)):
        write_exr(tmp_path / f"{name}.exr", dict.fromkeys("RGB", radiance))
    return tmp_path


def frames(run, out="out", maps="white", **kwargs):
    cameras = kwargs.pop("cameras", str(run / "cameras.json"))
    options = {"samples": 32, "bounces": 1, "progress": False}
    envmap = [run / f"{m}.exr" for m in maps] if isinstance(maps, list) else run / f"{maps}.exr"
    task.relight_to_files(run / "run", envmap, run / out, cameras=cameras, **(options | kwargs))
    return sorted(p.relative_to(run / out).as_posix() for p in (run / out).rglob("*.*"))


def test_files_and_layers(run):
    assert frames(run, samples=256) == ["r_0.exr", "r_0.png", "r_1.exr", "r_1.png"]
    layers = {k: torch.from_numpy(v) for k, v in read_exr(run / "out" / "r_0.exr").items()}
    expected = [f"{n}.{c}" for n in ("rgb", "albedo") for c in "RGB"]
    assert sorted(layers) == sorted([*expected, *(f"normal.{c}" for c in "XYZ"), "depth", "alpha"])
    inside = layers["alpha"] > 0
    assert 0.1 < inside.float().mean() < 0.9
    for name, values in layers.items():
        assert values[~inside].eq(0).all(), name
    # In white light: (1 - E) albedo + E, with E of a rough surface a few percent.
    assert layers["rgb.R"][inside].mean() == pytest.approx(ALBEDO + 0.02, abs=0.03)
    torch.testing.assert_close(layers["albedo.G"][inside], layers["alpha"][inside] * ALBEDO,
                               rtol=1e-3, atol=1e-3)  # fmt: skip
    middle = SIZE // 2
    assert layers["depth"][middle, middle] == pytest.approx(2 - RADIUS, abs=0.02)
    assert layers["normal.X"][middle, middle] > 0.99
    png = read_image(run / "out" / "r_0.png")
    assert png.shape == (SIZE, SIZE, 4)
    stored = (255 * linear_to_srgb(layers["rgb.R"]))[inside]
    # Half a step of rounding in each file; the EXR's half floats come first.
    torch.testing.assert_close(png[..., 0][inside].float(), stored, rtol=0, atol=1.0)
    assert torch.equal(png[..., 3] == 255, inside)


def test_exposure_and_several_maps(run):
    names = frames(run, maps=["white", "dim"], exposure=2.0)
    assert names == [f"{m}/r_{i}.{s}" for m in ("dim", "white") for i in (0, 1)
                     for s in ("exr", "png")]  # fmt: skip
    white, dim = (read_exr(run / "out" / m / "r_0.exr")["rgb.G"].sum() for m in ("white", "dim"))
    assert dim == pytest.approx(white / 4, rel=1e-2)
    frames(run, out="plain")
    plain = read_exr(run / "plain" / "r_0.exr")
    assert white > plain["rgb.G"].sum() * 1.9
    frames(run, out="small", resolution=12)
    small = read_exr(run / "small" / "r_0.exr")["alpha"]
    assert small.shape == (12, 12)
    assert small.mean() == pytest.approx(plain["alpha"].mean(), abs=0.06)


def test_rotation_moves_the_light(run):
    """A sun at +X lights the view from +X; turned by 90 degrees it lights the one from +Y."""
    lit = []
    for rotate in (0.0, 90.0):
        frames(run, out=f"turned{rotate}", maps="sun", rotate=rotate)
        lit.append(
            [read_exr(run / f"turned{rotate}" / f"r_{i}.exr")["rgb.R"].sum() for i in (0, 1)]
        )
    assert lit[0][0] > 2 * lit[0][1]
    assert lit[1] == pytest.approx(lit[0][::-1], rel=0.1)


def test_resume_keeps_what_is_there(run):
    frames(run)
    (run / "out" / "r_0.png").write_bytes(b"mine")
    (run / "out" / "r_1.exr").unlink()
    frames(run, resume=True)
    assert (run / "out" / "r_0.png").read_bytes() == b"mine"
    assert (run / "out" / "r_1.exr").exists()
    frames(run)
    assert (run / "out" / "r_0.png").read_bytes() != b"mine"


def test_orbit_sees_all_of_the_object(run):
    names = frames(run, cameras="orbit 3", resolution=16)
    assert names == [f"orbit_{i:04d}.{s}" for i in range(3) for s in ("exr", "png")]
    cameras = orbit(sphere(), 5, 64)
    assert len(cameras) == 5
    for view in range(5):
        pixel, depth = project(cameras, view, sphere().vertices)
        assert depth.gt(0).all()
        assert pixel.min() > 0
        assert pixel.max() < 64
        assert pixel.max() > 55  # and fills the picture
        pose = cameras.camera_to_world[view, :, :3]
        torch.testing.assert_close(pose.T @ pose, torch.eye(3))
        assert torch.det(pose) > 0


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"samples": 0}, ValueError, "samples must be at least 1, got 0"),
        ({"samples": 2**31 + 1}, ValueError, r"samples must be at most 2\^31, got 2147483649"),
        ({"resolution": 0}, ValueError, "resolution must be at least 1, got 0"),
        ({"bounces": -1}, ValueError, "bounces must be at least 0, got -1"),
        ({"exposure": -1.0}, ValueError, "exposure must be finite and at least 0, got -1.0"),
        ({"maps": ["white", "white"]}, ValueError, "maps with different names"),
        ({"maps": []}, ValueError, "expected an environment map, a sun or a point light, got none"),
        ({"rotate": math.inf}, ValueError, "rotate must be finite"),
        ({"noise": 0.0}, ValueError, "noise must be above 0, got 0.0"),
        ({"turn": 0}, ValueError, "turn must be at least 1 frame, got 0"),
        ({"background": "white"}, ValueError, "background must be .*, got 'white'"),
        ({"ground": math.nan}, ValueError, "ground must be finite, got nan"),
        ({"animation": ["avi"]}, ValueError, "animation must be gif or mp4, got 'avi'"),
        ({"cameras": "orbit 2", "elevation": 90.0}, ValueError, r"elevation must be in \(-90, 90"),
        ({"cameras": "orbit many"}, ValueError, "expected orbit, or orbit N"),
        ({"cameras": "nowhere.json"}, DataError, r"nowhere\.json: this camera file does not exist"),
    ],
)
def test_bad_arguments(run, options, error, message):
    with pytest.raises(error, match=message):
        frames(run, **options)


def test_bad_files_are_named(run):
    write_exr(run / "square.exr", {c: torch.ones(4, 4) for c in "RGB"})
    with pytest.raises(DataError, match=r"square\.exr: .*with W = 2 H, got \[4, 4, 3\]"):
        frames(run, maps="square")
    for content, message in (
        ("{}", "expected a list of frames"),
        ('{"frames": [{"transform_matrix": 1}]}', "transform_matrix"),
        ('{"frames": [{"file_path": "a"}, {"file_path": "a"}]}', "unique names"),
    ):
        (run / "bad.json").write_text(content)
        with pytest.raises(DataError, match=rf"bad\.json.*{message}"):
            frames(run, cameras=str(run / "bad.json"))
    config = run / "run" / "config.json"
    with pytest.raises(DataError, match=r"a run, but config\.json is missing"):
        frames(run, cameras="test")
    for content, message in (
        ("{}", r"config\.json: expected data to be a folder"),
        (json.dumps({"data": str(run / "none")}), "none"),
    ):
        config.write_text(content)
        with pytest.raises(DataError, match=message):
            frames(run, cameras="test")


def test_light_turns_under_a_still_camera(run):
    names = frames(run, maps="sun", turn=4, animation=["gif"])
    assert names == ["animation.gif", *(f"turn_{i:04d}.{s}" for i in range(4)
                                        for s in ("exr", "png"))]  # fmt: skip
    lit = [read_exr(run / "out" / f"turn_{i:04d}.exr")["rgb.R"].sum() for i in range(4)]
    assert lit[0] > 2 * lit[1] > 2 * lit[2]  # towards the camera, beside, behind
    assert lit[1] == pytest.approx(lit[3], rel=0.2)
    seen = [read_exr(run / "out" / f"turn_{i:04d}.exr")["alpha"] for i in range(4)]
    assert all((s == seen[0]).all() for s in seen)


def test_suns_alone_and_a_floor(run):
    sun = Sun((1.0, 0.0, 1.0), (3.0, 3.0, 3.0), 0.0)
    names = frames(run, maps=[], suns=[sun], ground="lowest", samples=2)
    assert names == ["r_0.exr", "r_0.png", "r_1.exr", "r_1.png"]
    layers = read_exr(run / "out" / "r_0.exr")
    assert layers["rgb.R"].max() > 0.1
    assert set(layers["shadow"].ravel().tolist()) == {0.0, 1.0}  # a hard sun: all or nothing


def test_pictures_as_tensors(run):
    white = EnvMap(torch.ones(4, 8, 3))
    made = task.relight_images(run / "run", white, str(run / "cameras.json"), samples=8, noise=0.2)
    assert made.shape == (2, SIZE, SIZE, 4)
    inside = made[..., 3] > 0
    assert made[inside][:, 0].mean() == pytest.approx(ALBEDO + 0.02, abs=0.05)
    assert made[~inside].eq(0).all()
    cameras = orbit(sphere(), 2, 16)
    options = {"samples": 1, "background": "map"}
    again = task.relight_images(str(run / "run"), str(run / "white.exr"), cameras, **options)
    assert again.shape == (2, 16, 16, 4)
    assert again[..., 3].eq(1).all()
    torch.testing.assert_close(again[:, 0, 0, :3], torch.ones(2, 3))
    with pytest.raises(TypeError, match="moons"):
        task.relight_images(run / "run", None, str(run / "cameras.json"), moons=[])


def test_a_killed_run_leaves_no_half_frames(run, monkeypatch):
    """Killed between the two files of a frame, the frame is made anew."""
    monkeypatch.setattr(
        "univoxel.data.images.write_png", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt)
    )
    with pytest.raises(KeyboardInterrupt):
        frames(run)
    monkeypatch.undo()
    assert [p.name for p in (run / "out").iterdir()] == ["r_0.exr"]
