"""The path tracer against Mitsuba 3, an independent renderer, given our BRDF and the same rays."""

import math
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from univoxel import brdf
from univoxel.core.records import Mesh
from univoxel.envmap import EnvMap, tables
from univoxel.ops import VisibilityScene, relight

SIZE = 24  # pixels along the picture
ALBEDO = torch.tensor([[0.8, 0.3, 0.2], [0.5, 0.6, 0.7]])  # of the sphere and of the plane
ROUGHNESS = torch.tensor([0.4, 0.6])


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
        Mesh(vertices, faces, normals, ALBEDO[part], ROUGHNESS[part]),
        tables(EnvMap(sky_map(256, math.pi / 2 - math.pi * (torch.arange(256) + 0.5) / 256))),
        origin[met] - hit.t[met, None] * wo,
        normal,
        wo,
        ALBEDO[kind],
        ROUGHNESS[kind],
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
        albedo=ALBEDO,
        roughness=ROUGHNESS,
        layer=torch.stack([brdf.specular_albedo(cosine, r.expand(1025)) for r in ROUGHNESS]),
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
