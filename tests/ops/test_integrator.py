"""Relit points: furnaces, closed forms, quadrature with the torch BRDF, and Mitsuba 3, an
independent renderer, given our BRDF and the same rays."""

import math
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from integrator_scenes import DARK, WHITE, octahedron, shade, sphere_points

from univoxel import brdf
from univoxel.core.records import Mesh
from univoxel.envmap import EnvMap, lookup, tables
from univoxel.ops import PointLight, Sun, VisibilityScene, occluded_reference, relight, use_backend
from univoxel.sphere import fibonacci_sphere


@pytest.mark.parametrize("roughness", [0.1, 0.4, 0.8, 1.0])
def test_white_furnace(roughness):
    """In white light albedo 1 sends (1 - E) + E = 1, a grey base (1 - E) albedo + E."""
    mesh, scene = octahedron()
    normal, wo = sphere_points(100)
    layer = brdf.specular_albedo((normal * wo).sum(1), torch.tensor(roughness))[:, None]
    for albedo in (1.0, 0.3):
        rgb = shade(mesh, scene, WHITE, normal, wo, albedo, roughness, samples=2048, bounces=8)
        # The fit of E is good to 0.005, noise comes on top; over many points both average out.
        torch.testing.assert_close(
            rgb.mean(0), ((1 - layer) * albedo + layer).mean().expand(3), rtol=0, atol=2e-3
        )
        assert (rgb - (1 - layer) * albedo - layer).abs().max() < 0.012


def test_furnace_of_many_bounces_between_surfaces():
    """Albedo 1 in white light shows white through any number of reflections; a bowl has many."""
    n = 24
    phi, theta = torch.meshgrid(
        2 * math.pi * torch.arange(n + 1) / n, math.pi / 2 * torch.arange(n + 1) / n, indexing="ij"
    )
    point = -torch.stack([theta.sin() * phi.cos(), theta.sin() * phi.sin(), theta.cos()], -1)
    i = ((n + 1) * torch.arange(n)[:, None] + torch.arange(n)).reshape(-1)
    quads = torch.stack([i, i + 1, i + n + 2, i, i + n + 2, i + n + 1], 1).reshape(-1, 3)
    corner = point.reshape(-1, 3)[quads].reshape(-1, 3)  # flat faces: smooth ones lose light
    normal = torch.linalg.cross(corner[1::3] - corner[::3], corner[2::3] - corner[::3])
    normal = torch.nn.functional.normalize(normal, dim=1, eps=1e-12).repeat_interleave(3, 0)
    normal = torch.where((normal * corner).sum(1, keepdim=True) > 0, -normal, normal)
    faces = torch.arange(len(corner), dtype=torch.int32).reshape(-1, 3)
    mesh = Mesh(corner, faces, normal, torch.ones_like(corner), torch.full((len(corner),), 0.5))
    scene = VisibilityScene(corner, faces)
    up = torch.tensor([[0.0, 0.0, 1.0]]).expand(64, 3)
    start = {"position": torch.tensor([[0.0, 0.0, -0.95]]).expand(64, 3), "samples": 256}
    direct = shade(mesh, scene, WHITE, up, up, **start)
    assert direct.mean() < 0.95  # part of the sky is hidden by the bowl
    full = shade(mesh, scene, WHITE, up, up, bounces=64, **start)
    assert full.mean() == pytest.approx(1.0, abs=5e-3)
    once = shade(mesh, scene, WHITE, up, up, bounces=1, **start)
    assert direct.mean() < once.mean() < full.mean()


def spotted_map(height=16, seed=3):
    g = torch.Generator().manual_seed(seed)
    radiance = torch.rand(height, 2 * height, 3, generator=g) ** 3
    radiance[height // 4, height // 3] = 40.0  # a small sun, 70 times what is around it
    return EnvMap(radiance, rotation=50.0, exposure=0.8)


def quadrature(envmap, position, normal, wo, albedo, roughness, visible):
    """The rendering equation summed over 200,000 directions with the torch BRDF."""
    wi = fibonacci_sphere(200_000)
    light = lookup(envmap, wi) * (4 * math.pi / len(wi))
    out = []
    for p, n, o in zip(position, normal, wo, strict=True):
        f = brdf.evaluate(n, o, wi, albedo, roughness.expand(len(wi)))
        cosine = (wi @ n).clamp_min(0) * visible(p, wi)
        out.append((f * light * cosine[:, None]).sum(0))
    return torch.stack(out)


@pytest.mark.parametrize("strategy", ["mis", "map", "brdf"])
@pytest.mark.parametrize("blocked", [False, True])
def test_direct_light_equals_quadrature(strategy, blocked):
    """Every strategy has the mean that the rendering equation gives, occluder or none."""
    mesh, scene = octahedron()
    normal, wo = sphere_points(6, seed=5)
    position = normal
    visible = lambda p, wi: torch.ones(len(wi))  # noqa: E731
    if blocked:  # a square over the points takes a part of their sky
        corner = torch.tensor([[-2.0, -2, 0], [2.0, -2, 0], [2.0, 2, 0], [-2.0, 2, 0]])
        vertices = corner + torch.tensor([0.7, 0.0, 1.6])
        faces = torch.tensor([[0, 1, 2], [0, 2, 3]], dtype=torch.int32)
        scene = VisibilityScene(vertices, faces)

        def visible(p, wi):
            return (~occluded_reference(vertices, faces, p.expand_as(wi), wi)).float()

    albedo, roughness, envmap = torch.tensor([0.7, 0.4, 0.2]), torch.tensor(0.4), spotted_map()
    wanted = quadrature(envmap, position, normal, wo, albedo, roughness, visible)
    got = shade(
        mesh, scene, envmap, normal, wo, albedo, roughness,
        samples=65536, strategy=strategy, offset=0.0 if blocked else 0.01,
    )  # fmt: skip
    # One strategy alone is noisy where the other is good; none is off by more than its noise.
    assert (got - wanted).norm() / wanted.norm() < (0.003 if strategy == "mis" else 0.01)


def test_points_off_the_surface_do_not_shade_themselves():
    """A start just inside the mesh sees the sky once the offset carries it out."""
    mesh, scene = octahedron()
    normal = mesh.normals[::3]
    inside = mesh.vertices.reshape(8, 3, 3).mean(1) - 0.01 * normal
    lit = shade(mesh, scene, WHITE, normal, normal, position=inside, offset=0.02)
    dark = shade(mesh, scene, WHITE, normal, normal, position=inside, offset=0.001)
    assert lit.mean() == pytest.approx(1.0, abs=0.02)
    assert dark.mean() < 0.01


def test_both_sides_reflect():
    """Seen against its winding and its normals a mesh sends on the same light."""
    normal, wo = sphere_points(50)
    position = 0.9 * normal
    results = [
        shade(*octahedron(0.8, inside_out=flip), WHITE, -normal, -wo, position=position, bounces=2)
        for flip in (False, True)
    ]
    torch.testing.assert_close(*results)


def test_there_is_no_reference():
    mesh, scene = octahedron()
    with (
        use_backend("reference"),
        pytest.raises(RuntimeError, match="runs on the native backend only"),
    ):
        shade(mesh, scene, WHITE, *sphere_points(2))


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
    """A disc of 60 degrees overhead, whose mean cosine is 0.93: were its radiance taken for its
    irradiance, that would be missing."""
    mesh, scene = octahedron()
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


SIZE = 24  # pixels along the picture
ALBEDOS = torch.tensor([[0.8, 0.3, 0.2], [0.5, 0.6, 0.7]])  # of the sphere and of the plane
ROUGHNESSES = torch.tensor([0.4, 0.6])


def sky(direction):
    """A smooth map with a soft sun: [..., 3] -> [..., 3], the same to both renderers."""
    sun = torch.nn.functional.normalize(torch.tensor([0.5, -0.6, 0.7]), dim=0)
    glow = torch.exp(30 * (direction @ sun - 1))[..., None] * torch.tensor([20.0, 16.0, 10.0])
    z = direction[..., 2:]
    return glow + (1 + z) * torch.tensor([0.2, 0.3, 0.5]) + 0.2 * (1 + direction[..., :1])


def sky_map(height, theta):
    phi = math.pi - 2 * math.pi * (torch.arange(2 * height) + 0.5) / (2 * height)
    theta, phi = torch.meshgrid(theta, phi, indexing="ij")
    return sky(
        torch.stack([theta.cos() * phi.cos(), theta.cos() * phi.sin(), theta.sin()], -1)
    ).float()


def sphere_on_plane():
    """A sphere of 96 x 48 quads over a square: vertices, faces, normals, and 0 or 1 by vertex."""
    n, m = 96, 48
    phi, theta = torch.meshgrid(
        2 * math.pi * torch.arange(n) / n, math.pi * torch.arange(m + 1) / m, indexing="ij"
    )
    ball = torch.stack([theta.sin() * phi.cos(), theta.sin() * phi.sin(), theta.cos()], -1)
    i, j = torch.meshgrid(torch.arange(n), torch.arange(m), indexing="ij")
    a, b = i * (m + 1) + j, (i + 1) % n * (m + 1) + j
    faces = torch.cat([torch.stack([a, a + 1, b + 1], -1), torch.stack([a, b + 1, b], -1)])
    faces = faces.reshape(-1, 3)
    square = torch.tensor([[-3.0, -3, -1.1], [3, -3, -1.1], [3, 3, -1.1], [-3, 3, -1.1]])
    first = n * (m + 1)
    ground = torch.tensor([[0, 1, 2], [0, 2, 3]]) + first
    vertices = torch.cat([ball.reshape(-1, 3), square]).float()
    normals = torch.cat([ball.reshape(-1, 3), torch.tensor([[0.0, 0, 1]]).expand(4, 3)]).float()
    part = (torch.arange(len(vertices)) >= first).long()
    return vertices, torch.cat([faces, ground]).int(), normals, part


def by_mitsuba(folder, **scene):
    """What mitsuba_reference.py makes of the same scene; skips where it cannot run."""
    np.savez(folder / "in.npz", **{k: np.asarray(v) for k, v in scene.items()})
    script = Path(__file__).parent.parent / "mitsuba_reference.py"
    command = [sys.executable, str(script), str(folder / "in.npz"), str(folder / "out.npy")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode == 77 or done.returncode < 0:  # below 0: an LLVM too old aborts
        pytest.skip(f"mitsuba cannot run here: {done.stderr.strip()[:200]}")
    assert done.returncode == 0, done.stderr
    return torch.from_numpy(np.load(folder / "out.npy"))


@pytest.mark.parametrize("bounces", [0, 3])
def test_as_mitsuba_renders_it(bounces, tmp_path):
    vertices, faces, normals, part = sphere_on_plane()
    y, x = torch.meshgrid(*[torch.linspace(-0.45, 0.45, SIZE)] * 2, indexing="ij")
    direction = torch.nn.functional.normalize(
        torch.stack([x, torch.full_like(x, 1.0), -0.25 - y], -1).reshape(-1, 3), dim=1
    )
    origin = torch.tensor([0.0, -5.0, 0.9]).expand(len(direction), 3).contiguous()
    scene = VisibilityScene(vertices, faces)
    hit = scene.closest_hit(origin, direction)
    met = hit.face >= 0
    assert 0.5 < met.float().mean() <= 1
    corner = faces.long()[hit.face[met]]
    u, v = hit.barycentric[met].unbind(1)
    weight = torch.stack([1 - u - v, u, v], 1)[..., None]
    normal = torch.nn.functional.normalize((weight * normals[corner]).sum(1), dim=1)
    wo = -direction[met]
    kind = part[corner[:, 0]]
    ours = relight(
        scene,
        Mesh(vertices, faces, normals, ALBEDOS[part], ROUGHNESSES[part]),
        tables(EnvMap(sky_map(256, math.pi / 2 - math.pi * (torch.arange(256) + 0.5) / 256))),
        origin[met] - hit.t[met, None] * wo,
        normal,
        wo,
        ALBEDOS[kind],
        ROUGHNESSES[kind],
        offset=1e-3,
        samples=2048,
        bounces=bounces,
    )
    cosine = torch.linspace(0, 1, 1025)
    theirs = by_mitsuba(
        tmp_path,
        vertices=vertices,
        faces=faces,
        normals=normals,
        part=part,
        albedo=ALBEDOS,
        roughness=ROUGHNESSES,
        layer=torch.stack([brdf.specular_albedo(cosine, r.expand(1025)) for r in ROUGHNESSES]),
        radiance=sky_map(256, math.pi / 2 - math.pi * torch.arange(256) / 255),  # rows end on poles
        origin=origin[met],
        direction=direction[met],
        bounces=bounces,
        samples=16384,
    )
    ours, theirs = ours.clamp_max(1), theirs.clamp_max(1)
    psnr = -10 * math.log10((ours - theirs).square().mean())
    assert psnr > 40  # what is left is noise, most of it theirs
    assert ours.mean() == pytest.approx(theirs.mean().item(), rel=2e-3)
