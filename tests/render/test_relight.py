"""Noise limits, shadows on a floor and backgrounds, on scenes with known answers."""

import math

import pytest
import torch
from balls import surface_at
from integrator_scenes import DARK, WHITE, octahedron, sphere_points

from univoxel.camera import Cameras
from univoxel.core.records import Mesh, Rays
from univoxel.envmap import EnvMap, tables
from univoxel.ops import PointLight, Sun, VisibilityScene
from univoxel.render import relight as task
from univoxel.render.relight import Quality, channels, render_picture, rgba, srgb

SUN = Sun((0.0, 0.0, 1.0), (2.0, 2.0, 2.0), 0.0)


def a_traced_mesh():
    mesh, scene = octahedron(0.5)
    return task.TracedMesh(mesh, scene, 0.01)


def a_surface(n=300, **opacity):
    normal, wo = sphere_points(n)
    return surface_at(normal, normal, **opacity), wo


def a_bright_spot(height=16):
    radiance = torch.full((height, 2 * height, 3), 0.2)
    radiance[height // 4, height // 2] = 60.0
    return task.Lighting(tables(EnvMap(radiance)))


def test_the_noise_limit_holds_and_its_estimate_is_honest():
    """Over many seeds, the root mean square error against a long render is what was promised."""
    surface, wo = a_surface()
    lighting, errors, told = a_bright_spot(), [], []
    truth = task.relight_surface(
        surface, wo, a_traced_mesh(), lighting, samples=16384, bounces=1, seed=99
    )
    for seed in range(4):
        rgb, noise, samples = task.relight_until(
            surface, wo, a_traced_mesh(), lighting, noise=0.1, bounces=1, seed=seed
        )
        assert noise <= 0.1
        assert samples >= 2 * task.FIRST_PASS
        luma = torch.tensor([0.2126, 0.7152, 0.0722])
        error = ((rgb - truth) @ luma).square().mean().sqrt() / (truth @ luma).mean()
        errors.append(float(1.96 * error))
        told.append(noise)
    # An estimate from 300 pixels with long tails: a third of room.
    assert sum(errors) == pytest.approx(sum(told), rel=0.33)


def test_passes_report_their_share_and_end_where_no_light_is():
    surface, wo = a_surface(50)
    shares = []
    _, _, samples = task.relight_until(
        surface, wo, a_traced_mesh(), a_bright_spot(), noise=0.05, bounces=0, report=shares.append
    )
    assert shares
    assert all(0 < share < 1 for share in shares)
    dark = task.Lighting(tables(DARK))
    rgb, noise, few = task.relight_until(surface, wo, a_traced_mesh(), dark, noise=0.01, bounces=0)
    assert (noise, few) == (0.0, 2 * task.FIRST_PASS)
    assert few < samples
    assert rgb.eq(0).all()
    with pytest.raises(ValueError, match="noise must be above 0, got 0"):
        task.relight_until(surface, wo, a_traced_mesh(), dark, noise=0, bounces=0)


def test_turned_light_turns_map_and_suns_but_not_lamps():
    lighting = task.Lighting(
        tables(EnvMap(torch.ones(2, 4, 3), 10.0)),
        (Sun((1.0, 0.0, 1.0), (1, 1, 1)),),
        (PointLight((1, 0, 0), (1, 1, 1)),),
    )
    turned = task.rotated(lighting, 90.0)
    assert turned.tables.rotation == pytest.approx(math.radians(100))
    assert turned.suns[0].direction == pytest.approx((0.0, 1.0, 1.0), abs=1e-12)
    assert turned.point_lights == lighting.point_lights


def lid(size=1.0, height=0.5):
    """A black square above the floor."""
    corner = size * torch.tensor([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    corner = corner + torch.tensor([0.0, 0, height])
    faces = torch.tensor([[0, 1, 2], [0, 2, 3]], dtype=torch.int32)
    up = torch.tensor([0.0, 0, 1]).repeat(4, 1)
    mesh = Mesh(corner, faces, up, torch.zeros(4, 3), torch.ones(4))
    return task.TracedMesh(mesh, VisibilityScene(corner, faces), 0.01)


def falling(points):
    origin = torch.tensor(points) + torch.tensor([0.0, 0.0, 5.0])
    return Rays(origin, torch.tensor([0.0, 0, -1]).expand_as(origin).contiguous())


def test_a_hard_shadow_is_black_and_sharp():
    rays = falling([[0.0, 0, 0], [0.9, 0, 0], [1.1, 0, 0], [5.0, 0, 0]])
    lighting = task.Lighting(tables(DARK), (SUN,))
    shadow = task.ground_shadow(rays, 0.0, lid(), lighting, samples=1, bounces=0)
    assert shadow.tolist() == [1, 1, 0, 0]
    hidden = torch.tensor([True, False, False, False])
    shadow = task.ground_shadow(rays, 0.0, lid(), lighting, samples=1, bounces=0, hidden=hidden)
    assert shadow.tolist() == [0, 1, 0, 0]
    # Rays that miss the floor, and light that comes back
    up = Rays(torch.tensor([[0.0, 0, 5], [0, 0, -5]]), torch.tensor([[0.0, 0, 1], [0, 0, 1]]))
    lighting = task.Lighting(tables(WHITE))
    shadow = task.ground_shadow(up, 0.0, lid(), lighting, samples=4, bounces=0)
    assert shadow.eq(0).all()


def test_a_soft_shadow_is_the_sky_that_is_hidden():
    """Under an even sky the shadow is the form factor of the square above the point."""
    rays = falling([[0.0, 0, 0], [40.0, 0, 0]])
    shadow = task.ground_shadow(
        rays, 0.0, lid(1.0, 1.0), task.Lighting(tables(WHITE)), samples=4096, bounces=0
    )
    # Point to parallel rectangle over its corner, four of them (Howell, B-3), with sides = height.
    quarter = 2 / (2 * math.pi) * math.atan(1 / math.sqrt(2)) / math.sqrt(2)
    # The floor's BRDF is not quite Lambertian at grazing light: 2 %.
    assert float(shadow[0]) == pytest.approx(4 * quarter, rel=0.02)
    assert float(shadow[1]) < 1e-3


def pictures(background, ground, opacity=0.5):
    pose = torch.tensor([[[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 5]]])
    cameras = Cameras(pose, torch.full((1, 2), 8.0), torch.full((1, 2), 2.0), 4, 4)
    n = 16
    surface, _ = a_surface(n, opacity=torch.tensor([opacity, 0.0]).repeat(n // 2))
    wo = torch.tensor([0.0, 0, 1]).repeat(n, 1)
    quality = Quality(samples=16, bounces=0, background=background, ground=ground)
    lighting = task.Lighting(tables(WHITE), (SUN,))
    return render_picture(surface, wo, cameras, 0, lid(), lighting, quality)


def test_backgrounds_and_alpha():
    plain, black, map_ = (pictures(b, None) for b in ("transparent", "black", "map"))
    torch.testing.assert_close(plain.rgb, black.rgb)
    torch.testing.assert_close(map_.rgb, plain.rgb + (1 - plain.alpha[..., None]))
    assert torch.equal(rgba(plain)[..., 3], plain.alpha)
    assert rgba(black)[..., 3].eq(1).all()
    assert srgb(plain).shape == (4, 4, 4)
    assert srgb(map_).shape == (4, 4, 3)
    assert "shadow" not in channels(plain)


def test_shadow_goes_into_alpha_and_darkens_the_background():
    plain, map_ = pictures("transparent", 0.0), pictures("map", 0.0)
    shadow = plain.shadow
    assert shadow.max() == pytest.approx(1, abs=0.6)
    assert shadow.min() >= 0
    clear = (1 - plain.alpha) * (1 - shadow)
    torch.testing.assert_close(rgba(plain)[..., 3], 1 - clear)
    torch.testing.assert_close(map_.rgb, plain.rgb + clear[..., None])
    assert torch.equal(channels(plain)["shadow"], shadow)
