"""Relit points: furnaces, closed forms, quadrature with the torch BRDF, convergence."""

import math

import pytest
import torch
from integrator_scenes import WHITE, octahedron, shade, sphere_points

from univoxel import brdf
from univoxel.core.records import Mesh
from univoxel.envmap import EnvMap, lookup
from univoxel.ops import VisibilityScene, occluded_reference, use_backend
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


def test_no_points():
    none = torch.empty(0, 3)
    assert shade(*octahedron(), WHITE, none, none).shape == (0, 3)


def test_there_is_no_reference():
    mesh, scene = octahedron()
    with (
        use_backend("reference"),
        pytest.raises(RuntimeError, match="runs on the native backend only"),
    ):
        shade(mesh, scene, WHITE, *sphere_points(2))
