"""The light at one point: what is drawn, beside the truth, and what is refused."""

import json
import shutil
from pathlib import Path

import pytest
import torch
from analytic import cameras_around, sphere_normals, sphere_scene, write_scene

from univoxel.cli.inspect import inspect, parse_pixel
from univoxel.data.images import read_exr, read_image, write_exr
from univoxel.errors import DataError
from univoxel.lights import EnvmapConfig, EnvmapSGConfig, MLPLightConfig, SHConfig
from univoxel.output.mesh_files import write_ply
from univoxel.render.light_at_point import irradiance
from univoxel.render.pipeline import extract_mesh
from univoxel.scene import save_scene
from univoxel.sphere import latlong_directions


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return write_scene(tmp_path_factory.mktemp("inspect") / "data", views=2)


def a_run(folder, data, light=None, sky_nodes=0):
    scene = sphere_scene(sky_nodes, light=light)
    scene.inv_s = 100.0
    save_scene(scene, folder, {})
    (folder / "config.json").write_text(json.dumps({"data": str(data)}))
    return scene


def channel(path, name):
    return torch.from_numpy(read_exr(path)[name].copy())


@pytest.mark.parametrize(
    ("light", "layers"),
    [
        (None, {"local_sg"}),
        (SHConfig(order=1), {"local_sh"}),
        (MLPLightConfig(rank=2), {"local_mlp"}),
        (EnvmapSGConfig(lobes=4), {"map"}),
        (EnvmapConfig(rows=8), {"map"}),
    ],
)
def test_every_light_is_drawn(tmp_path, data, light, layers):
    a_run(tmp_path, data, light)
    out = inspect(tmp_path, "r_1", (16, 16), height=32)
    assert out == tmp_path / "inspect" / "r_1_16_16.png"
    names = {name.split(".")[0] for name in read_exr(out.with_suffix(".exr"))}
    assert names == layers  # the data set has no truth
    assert read_image(out).shape == (64 + 18, 64 + 4 + 64, 3)


def test_the_hybrid_has_two_layers(tmp_path, data):
    scene = a_run(tmp_path, data, sky_nodes=128)
    out = inspect(tmp_path, "1", (16, 16), tmp_path / "new" / "light.png", height=32)
    names = {name.split(".")[0] for name in read_exr(out.with_suffix(".exr"))}
    assert names == {"local_sg", "map"}
    # On a ball, the sky is open above the horizon alone
    normal, _ = sphere_normals(cameras_around(2), 1)
    cosine = latlong_directions(32) @ normal[16, 16]
    open_ = channel(out.with_suffix(".exr"), "map.open")
    assert bool((open_[cosine > 0.1] == 1).all())
    assert bool((open_[cosine < -0.5] == 0).all())  # rays start above the surface
    found = channel(out.with_suffix(".exr"), "map.R")[cosine > 0.1]
    torch.testing.assert_close(found, scene.sky.latlong(32).detach()[..., 0][cosine > 0.1])


def test_the_truth_goes_beside(tmp_path, data):
    """The true ball under the very map: both layers agree above the horizon."""
    folder = Path(shutil.copytree(data, tmp_path / "data"))
    scene = a_run(tmp_path, folder, EnvmapConfig(rows=32))
    map = scene.light.latlong(32).detach() * (1 + latlong_directions(32)[..., 2:])
    (folder / "envmaps").mkdir()
    channels = dict(zip("RGB", map.unbind(2), strict=True))
    write_exr(folder / "envmaps" / "train.exr", channels, half=False)
    assert inspect(tmp_path, "0", (16, 16), height=32)  # a map alone is no truth
    exr = tmp_path / "inspect" / "r_0_16_16.exr"
    assert "truth.R" not in read_exr(exr)
    write_ply(folder / "mesh.ply", extract_mesh(scene))
    inspect(tmp_path, "0", (16, 16), height=32)
    normal, _ = sphere_normals(cameras_around(2), 0)
    cosine = latlong_directions(32) @ normal[16, 16]
    above = cosine > 0.2  # facets of the mesh are tilted against the ball
    found = channel(exr, "truth.G")[above]
    torch.testing.assert_close(found, map[..., 1][above], rtol=1e-4, atol=1e-5)
    assert bool((channel(exr, "truth.open")[cosine < -0.2] == 0).all())
    assert torch.equal(channel(exr, "truth.open")[above], channel(exr, "map.open")[above])
    (folder / "mesh.ply").write_text("nothing")
    with pytest.raises(DataError, match=r"mesh\.ply: expected a binary little-endian PLY"):
        inspect(tmp_path, "0", (16, 16))


def test_irradiance_of_an_even_sky():
    even = torch.full((64, 128, 3), 0.7)
    for normal in ([0.0, 0, 1], [0.6, 0, -0.8]):
        found = irradiance(even, torch.tensor(normal))
        torch.testing.assert_close(found, torch.full((3,), 0.7 * torch.pi), rtol=1e-3, atol=0)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("r_7", (1, 1)), r"view \(below 2\) or its name \(from r_0 to r_1\), got 'r_7'"),
        (("2", (1, 1)), r"view: expected the number of a view \(below 2\)"),
        (("0", (32, 1)), "pixel: expected a pixel of a 32x32 image, got 32,1"),
        (("0", (-1, 1)), "pixel: expected a pixel of a 32x32 image, got -1,1"),
        (("0", (0, 0)), "pixel: there is no surface under 0,0"),
        (("0", (16, 16), "a.jpg"), r"out: expected a name that ends in \.png, got a\.jpg"),
        (("0", (16, 16), None, 0), "height must be at least 1, got 0"),
    ],
)
def test_bad_arguments(tmp_path, data, arguments, message):
    a_run(tmp_path, data)
    view, pixel, *rest = arguments
    out = tmp_path / rest[0] if rest and rest[0] else None
    with pytest.raises(ValueError, match=message.replace("got a", "got .*a")):
        inspect(tmp_path, view, pixel, out, *rest[1:])
    assert not (tmp_path / "inspect").exists()
    assert parse_pixel("12,34") == (12, 34)
    for text in ("12", "a,b", "1,2,3", "1.5,2"):
        with pytest.raises(ValueError, match=f"pixel: expected COLUMN,ROW, got '{text}'"):
            parse_pixel(text)
