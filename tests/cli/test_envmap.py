"""The recovered map in a file, and its comparison with the true one."""

import json
import math

import pytest
import torch
from analytic import sphere_scene
from torch.nn.functional import normalize

from univoxel.cli.envmap import envmap
from univoxel.data.images import read_image, write_exr
from univoxel.errors import DataError
from univoxel.evaluation.recovered_map import compare
from univoxel.lights import EnvmapConfig, EnvmapSGConfig
from univoxel.render.pictures import GREY, grey_ball
from univoxel.scene import save_scene
from univoxel.sphere import fibonacci_sphere

LAMP = normalize(torch.tensor([1.0, -0.5, 0.7]), dim=0)


def write_map(path, map) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    write_exr(path, dict(zip("RGB", map.unbind(2), strict=True)), half=False)


@pytest.fixture
def run(tmp_path):
    """A run whose map has one lamp; its data set holds no truth yet."""
    scene = sphere_scene(256)
    with torch.no_grad():
        scene.sky.log_radiance += 3 * (8 * (scene.sky.direction @ LAMP - 1)).exp()[:, None]
        scene.sky.log_radiance[:, 2] -= 0.3
    save_scene(scene, tmp_path, {})
    (tmp_path / "config.json").write_text(json.dumps({"data": str(tmp_path / "data")}))
    return tmp_path, scene.sky.latlong(32).detach()


def test_the_map_is_written_as_it_is(run):
    folder, map = run
    out = folder / "new" / "map.exr"
    assert envmap(folder, out, height=32) is None
    assert torch.equal(read_image(out), map)
    assert read_image(out.with_suffix(".png")).shape == (32, 4 * 32, 3)
    # Pixels of a common exponent: off by half of 1/128 of the largest channel at most
    assert envmap(folder, folder / "map.hdr", height=32) is None
    error = (read_image(folder / "map.hdr") - map).abs()
    assert (error <= map.amax(2, keepdim=True) / 256).all()
    assert error.max() > 0


@pytest.mark.parametrize("light", [EnvmapConfig(rows=32), EnvmapSGConfig(lobes=8)])
def test_the_map_of_a_light_alone(tmp_path, light):
    scene = sphere_scene(0, light=light)
    map = scene.light.latlong(32).detach()
    save_scene(scene, tmp_path, {})
    (tmp_path / "config.json").write_text(json.dumps({"data": str(tmp_path / "data")}))
    write_map(tmp_path / "data" / "envmaps" / "train.exr", map)
    assert envmap(tmp_path, tmp_path / "map.exr", height=32).ball_psnr > 60
    torch.testing.assert_close(read_image(tmp_path / "map.exr"), map)


def test_the_truth_in_another_colour_is_met(run):
    folder, map = run
    write_map(folder / "data" / "envmaps" / "train.exr", map * torch.tensor([3.0, 2.0, 5.0]))
    found = envmap(folder, folder / "map.exr", height=32)
    assert found.ball_psnr > 60
    assert found.mirror_psnr > 60
    assert found.brightest_degrees < 1e-3
    assert torch.equal(read_image(folder / "map.exr"), map)  # only the comparison is scaled
    picture = read_image(folder / "map.png").int()
    assert picture.shape == (64, 4 * 32, 3)
    assert (picture[:32] - picture[32:]).abs().max() <= 1


def test_a_turned_light_is_noticed(run):
    folder, map = run
    write_map(folder / "data" / "envmaps" / "train.exr", map.roll(-16, 1))  # a quarter turn
    found = envmap(folder, folder / "map.exr", height=32)
    across = math.asin(LAMP[2])
    angle = 2 * math.asin(math.cos(across) * math.sin(math.pi / 4))
    assert abs(found.brightest_degrees - math.degrees(angle)) < 5  # places lie 3 degrees apart
    assert found.ball_psnr < 30
    assert found.mirror_psnr < 30
    fine = map.repeat_interleave(4, 0).repeat_interleave(4, 1)  # of another size
    found = compare(map, fine)
    assert found.ball_psnr > 45
    assert found.brightest_degrees < 4


def test_a_mirror_ball_tells_what_a_grey_one_does_not():
    """The same light, in stripes that are finer than what a matte ball tells apart."""
    flat = torch.full((128, 256, 3), 0.5)
    striped = flat * torch.tensor([0.6, 1.4]).repeat_interleave(4).repeat(32)[:, None]
    found = compare(striped, flat)
    assert found.ball_psnr > 40
    assert found.mirror_psnr < 20
    lower = flat.clone()
    lower[:64] = 0.25
    # Half of the ball's mirrored directions look up; 0.25 against 0.5, of which 0.5 is drawn as 1
    light = [0.5, 1.0]
    half = float(torch.tensor(light).pow(1 / 2.4).mul(1.055).sub(0.055).diff())
    expected = -10 * math.log10(half**2 / 2)
    assert compare(lower, flat).mirror_psnr == pytest.approx(expected, abs=0.5)


def test_a_grey_ball_under_known_light():
    normal = fibonacci_sphere(150)  # more than a block
    flat = torch.full((128, 256, 3), 0.7)  # more texels than are summed over
    assert torch.allclose(grey_ball(flat, normal), torch.tensor(GREY * 0.7), rtol=2e-3)
    upper = flat.clone()
    upper[64:] = 0
    expected = GREY * 0.7 * (0.5 + 0.5 * normal[:, 2:]).expand(-1, 3)
    assert torch.allclose(grey_ball(upper, normal), expected, atol=2e-3)


def test_the_picture_shows_the_light_where_it_is(run):
    folder, _ = run
    envmap(folder, folder / "map.exr", height=32)
    picture = read_image(folder / "map.png").float().sum(2)
    grey, mirror = picture[:, 64:96], picture[:, 96:]
    # The lamp is seen from +X to the left (-Y) and above
    for ball in (grey, mirror):
        assert ball[:16, :16].mean() > ball[16:, 16:].mean()
        assert ball[:16, 16:].mean() > ball[16:, :16].mean()  # and farther above than to the left
        assert ball[0, 0] == 0
    assert picture[:16, 32:64].mean() > picture[:16, :32].mean()  # right of the centre: -Y


def test_what_has_no_map_or_none_to_compare(run):
    folder, map = run
    out, path = folder / "map.exr", folder / "data" / "envmaps" / "train.exr"
    with pytest.raises(ValueError, match=r"a name that ends in \.exr or \.hdr, got .*map\.png"):
        envmap(folder, folder / "map.png")
    with pytest.raises(ValueError, match="height must be at least 1, got 0"):
        envmap(folder, out, height=0)
    write_map(path, map[:, :40])
    said = r"train\.exr: environment map: expected an array .H, W, 3. with W = 2 H"
    with pytest.raises(DataError, match=said):
        envmap(folder, out)
    path.write_bytes(b"nothing")
    with pytest.raises(DataError, match=r"train\.exr: this OpenEXR file could not be read"):
        envmap(folder, out)
    out.unlink(missing_ok=True)
    save_scene(sphere_scene(0), folder, {})
    said = r"has no environment map, because it was trained with local light \(sg\)"
    with pytest.raises(ValueError, match=said):
        envmap(folder, out)
    assert not out.exists()
