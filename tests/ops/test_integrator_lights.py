"""Suns, point lights and coloured F0 in the path tracer: closed forms, shadows, bounces."""

import math

import pytest
import torch
from integrator_scenes import DARK, WHITE, octahedron, shade, sphere_points

from univoxel import brdf
from univoxel.core.records import Mesh
from univoxel.ops import PointLight, Sun, VisibilityScene

ALBEDO, ROUGHNESS = torch.tensor([0.7, 0.4, 0.2]), torch.tensor(0.5)
UP = torch.tensor([[0.0, 0, 1]])


def lit(normal, wo, *, suns=(), point_lights=(), envmap=DARK, **kwargs):
    mesh, scene = octahedron()
    return shade(mesh, scene, envmap, normal, wo, ALBEDO, ROUGHNESS, suns=suns,
                 point_lights=point_lights, **{"samples": 1, **kwargs})  # fmt: skip


def test_a_hard_sun_is_one_look_at_the_brdf():
    normal, wo = sphere_points(200, seed=2)
    direction = torch.nn.functional.normalize(torch.tensor([0.3, -0.5, 0.8]), dim=0)
    power = torch.tensor([3.0, 2.0, 1.0])
    got = lit(normal, wo, suns=[Sun((0.6, -1.0, 1.6), tuple(power.tolist()), 0.0)])
    cosine = normal @ direction
    f = brdf.evaluate(normal, wo, direction.expand_as(wo), ALBEDO, ROUGHNESS)
    wanted = f * power * cosine.clamp_min(0)[:, None]
    # The octahedron inscribed in the sphere hides nothing of what lies above a point's horizon
    # but grazing rays, which the offset does not lift over its corners.
    clear = cosine > 0.5
    torch.testing.assert_close(got[clear], wanted[clear], rtol=1e-4, atol=1e-5)
    assert got[cosine < 0].eq(0).all()


def test_a_wide_sun_has_the_light_of_a_narrow_one():
    """A disc of 60 degrees overhead: the cosine alone changes, by its mean over the disc."""
    mesh, scene = octahedron()
    half = math.radians(30)
    ratio = (1 + math.cos(half)) / 2  # mean cosine over the disc
    start = {"position": 3 * UP, "offset": 0.0, "samples": 4096}
    rough = torch.tensor(1.0)
    wide, narrow = (
        shade(mesh, scene, DARK, UP, UP, 1.0, rough, suns=[Sun((0, 0, 1), (1, 1, 1), angle)],
              f0=torch.zeros(1, 3), **start)
        for angle in (60.0, 0.0)
    )  # fmt: skip
    # irradiance is given as a facing surface sees it: no change; to 1e-3 of noise and of the
    # specular layer, which F0 = 0 leaves only at grazing angles.
    torch.testing.assert_close(wide, narrow, rtol=5e-3, atol=0)
    assert ratio < 0.95  # a disc whose radiance were taken for its irradiance would fail


def test_lamp_falls_with_the_square_and_stands_before_what_is_behind_it():
    mesh, _ = octahedron()
    corner = torch.tensor([[-9.0, -9, 3], [9, -9, 3], [0, 9, 3]])
    scene = VisibilityScene(corner, torch.tensor([[0, 1, 2]], dtype=torch.int32))  # a ceiling
    start = {"position": torch.zeros(1, 3), "offset": 0.0, "samples": 1}
    near, far, above = (
        shade(mesh, scene, DARK, UP, UP, ALBEDO, ROUGHNESS,
              point_lights=[PointLight((0, 0, z), (4, 4, 4))], **start)
        for z in (1.0, 2.0, 4.0)
    )  # fmt: skip
    torch.testing.assert_close(near, 4 * far)
    assert near.gt(0).all()
    assert above.eq(0).all()  # the ceiling is in between
    at_it = shade(mesh, scene, DARK, UP, UP, ALBEDO, ROUGHNESS,
                  point_lights=[PointLight((0, 0, 0), (1, 1, 1))], **start)  # fmt: skip
    assert at_it.eq(0).all()


def test_bounced_sunlight_has_its_closed_form():
    """A point light near a wide wall: the light that comes back from it, against quadrature."""
    side, n = 40.0, 400
    corner = torch.tensor([[-side, -side, 1], [side, -side, 1], [side, side, 1], [-side, side, 1]])
    faces = torch.tensor([[0, 2, 1], [0, 3, 2]], dtype=torch.int32)
    down = torch.tensor([0.0, 0, -1])
    mesh = Mesh(corner, faces, down.repeat(4, 1), torch.full((4, 3), 0.5), torch.ones(4))
    scene = VisibilityScene(corner, faces)
    point_light = PointLight((0.0, 0.0, 0.5), (10.0, 10.0, 10.0))
    common = {"position": torch.zeros(1, 3), "offset": 0.0, "point_lights": [point_light],
              "f0": torch.zeros(1, 3), "mesh_f0": torch.zeros(4, 3), "samples": 65536}  # fmt: skip
    args = (mesh, scene, DARK, UP, UP, 1.0, torch.tensor(1.0))
    bounced = shade(*args, bounces=1, **common) - shade(*args, bounces=0, **common)
    # Rings on the wall: they get 10 cos / d^2 from the light and send it down, by our BRDF.
    radius = torch.linspace(0, 1, n + 1)[:-1].double() + 0.5 / n
    theta = radius * math.pi / 2
    point = torch.stack([theta.tan(), torch.zeros(n).double(), torch.ones(n).double()], 1)
    to_lamp = torch.tensor([0.0, 0, 0.5]).double() - point
    distance = to_lamp.norm(dim=1)
    eye = -torch.nn.functional.normalize(point, dim=1)
    facing = down.double().expand(n, 3)
    rough, grey = torch.ones(n).double(), torch.full((n, 3), 0.5).double()
    f_wall = brdf.evaluate(facing, eye, to_lamp / distance[:, None], grey, rough, f0=0.0)
    cosine = 0.5 / distance
    radiance = f_wall * (10 * cosine / distance**2)[:, None]
    up = UP.double().expand(n, 3)
    f_floor = brdf.evaluate(up, up, -eye, torch.ones(n, 3).double(), rough, f0=0.0)
    weight = 2 * math.pi * theta.sin() * theta.cos() * (math.pi / 2 / n)
    wanted = (f_floor * radiance * weight[:, None]).sum(0).float()
    torch.testing.assert_close(bounced[0], wanted, rtol=5e-3, atol=0)  # noise of 65536 paths


def test_calls_that_go_on_make_one_sequence():
    mesh, scene = octahedron()
    normal, wo = sphere_points(20)
    whole = shade(mesh, scene, WHITE, normal, wo, samples=32, bounces=1)
    halves = [shade(mesh, scene, WHITE, normal, wo, samples=16, bounces=1, first=k)
              for k in (0, 16)]  # fmt: skip
    torch.testing.assert_close((halves[0] + halves[1]) / 2, whole)
    assert not torch.equal(*halves)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Sun((0, 0, 0), (1, 1, 1)), "direction must not be zero"),
        (lambda: Sun((0, 0, 1), (1, -1, 1)), "sun: irradiance must be finite and at least 0"),
        (lambda: Sun((0, 0, 1), (1, 1, 1), 180.0), r"angle must be in \[0, 180\) degrees"),
        (lambda: PointLight((0, math.nan, 0), (1, 1, 1)), "point light: position must be finite"),
        (lambda: PointLight((0, 0, 0), (math.inf, 1, 1)), "point light: intensity must be finite"),
    ],
)
def test_bad_lights(make, message):
    with pytest.raises(ValueError, match=message):
        make()
