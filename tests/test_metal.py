"""Metal from the material head to relit pictures and exported files."""

import io
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from asymmetric_scene import albedo, lopsided
from balls import surface_at
from integrator_scenes import WHITE, octahedron, sphere_points
from PIL import Image

from univoxel import brdf
from univoxel.camera import Cameras
from univoxel.cli import export as task
from univoxel.core.records import Mesh
from univoxel.envmap import EnvMap, lookup, tables
from univoxel.ops import VisibilityScene
from univoxel.render import relight
from univoxel.render.pipeline import at_rays, extract_mesh, surface_of_view
from univoxel.sphere import fibonacci_sphere

BASE = torch.tensor([0.95, 0.6, 0.3])  # copper, about


class HalfMetal(torch.nn.Module):
    """The features are the materials; metal where red is above one half."""

    def forward(self, features):
        return features[:, :3], features[:, 3], (features[:, 0] > 0.5).float()


@pytest.fixture(scope="module")
def scene():
    scene = lopsided(voxels=24**3)
    scene.material = HalfMetal()
    return scene


def smooth_map(height=32):
    phi = math.pi - 2 * math.pi * (torch.arange(2 * height) + 0.5) / (2 * height)
    theta = math.pi / 2 - math.pi * (torch.arange(height) + 0.5) / height
    light = 2.5 + theta.sin()[:, None] + theta.cos()[:, None] * (phi + 0.5).cos()
    return EnvMap((light[..., None] * torch.tensor([1.0, 0.8, 0.5])).float())


def a_sphere(n, metallic, roughness):
    normal, wo = sphere_points(n, seed=3, facing=0.5)
    return surface_at(normal, normal, BASE, roughness, metallic=metallic), wo


def test_a_base_colour_is_split_as_gltf_says():
    diffuse, f0 = brdf.split(BASE.expand(3, 3), torch.tensor([0.0, 1.0, 0.5]))
    assert isinstance(f0, torch.Tensor)
    torch.testing.assert_close(diffuse, BASE * torch.tensor([[1.0], [0.0], [0.5]]))
    torch.testing.assert_close(f0[0], torch.full((3,), 0.04))
    torch.testing.assert_close(f0[1:], torch.stack([BASE, 0.02 + 0.5 * BASE]))
    same, number = brdf.split(BASE, None)
    assert same is BASE
    assert number == 0.04
    assert brdf.metal_or_none(torch.tensor([0.0, 0.49 / 255])) is None
    metallic = torch.tensor([0.0, 0.51 / 255])
    assert brdf.metal_or_none(metallic) is metallic
    assert brdf.metal_or_none(torch.empty(0)) is None


@pytest.mark.parametrize("metallic", [1.0, 0.4])
@pytest.mark.parametrize("roughness", [0.25, 0.7])
def test_a_metal_sphere_equals_quadrature(metallic, roughness):
    surface, wo = a_sphere(8, torch.full((8,), metallic), roughness)
    lights, directions = smooth_map(), fibonacci_sphere(100_000)
    traced = relight.TracedMesh(*octahedron(), 0.01)
    got = relight.relight_surface(
        surface, wo, traced, relight.Lighting(tables(lights)), samples=16384, bounces=0
    )
    diffuse, f0 = brdf.split(surface.albedo, surface.metallic)
    assert isinstance(f0, torch.Tensor)
    light = lookup(lights, directions) * (4 * math.pi / len(directions))
    wanted = torch.empty_like(got)
    for i, (n, o) in enumerate(zip(surface.normal, wo, strict=True)):
        cosine = (directions @ n).clamp_min(0)
        rough = surface.roughness[i].expand(len(directions))
        for c in range(3):
            f = brdf.evaluate(n, o, directions, diffuse[i], rough, float(f0[i, c]))[:, c]
            wanted[i, c] = (f * light[:, c] * cosine).sum()
    # Noise at 16384 samples; a metal taken for a dielectric would be off by half.
    torch.testing.assert_close(got, wanted, rtol=0.004, atol=0)


def test_metal_that_light_bounces_off():
    """Under a mirror-like ceiling of copper a white floor turns copper; grey metal is no metal."""
    corner = torch.tensor([[-9.0, -9, 1], [9, -9, 1], [9, 9, 1], [-9, 9, 1]])
    faces = torch.tensor([[0, 2, 1], [0, 3, 2]], dtype=torch.int32)
    down = torch.tensor([[0.0, 0, -1]]).expand(4, 3)
    mesh = Mesh(corner, faces, down, BASE.expand(4, 3), torch.full((4,), 0.5), torch.ones(4))
    surface, _ = a_sphere(1, None, 1.0)
    up = torch.tensor([[0.0, 0.0, 1.0]])
    surface = replace(surface, position=0 * up, normal=up, albedo=torch.ones(1, 3))
    traced = relight.TracedMesh(mesh, VisibilityScene(corner, faces), 0.0)
    light = relight.Lighting(tables(WHITE))

    def lit(mesh):
        here = replace(traced, mesh=mesh)
        return relight.relight_surface(surface, up, here, light, samples=4096, bounces=1)[0]

    metal = lit(mesh)
    plastic = lit(replace(mesh, metallic=torch.zeros(4)))
    torch.testing.assert_close(plastic, lit(replace(mesh, metallic=None)))
    # All but 1 % of its sky is the ceiling, which sends E(F0) of the white light from below; the
    # floor weighs directions by their cosine.
    cosine = ((torch.arange(200) + 0.5) / 200).sqrt()
    layer = torch.stack(
        [brdf.specular_albedo(cosine, torch.tensor(0.5), float(c)).mean() for c in BASE]
    )
    torch.testing.assert_close(metal, layer, rtol=0.03, atol=0)
    assert plastic[0] > metal[0] + 0.03  # a base under the layer, and the layer


def test_views_and_pictures_carry_it(scene):
    pose = torch.tensor([[[1.0, 0, 0, 0], [0, 0, -1, -3], [0, 1, 0, 0]]])
    cameras = Cameras(pose, torch.full((1, 2), 60.0), torch.full((1, 2), 16.0), 32, 32)
    surface, wo = surface_of_view(scene, cameras, 0)
    assert surface.metallic is not None
    there = surface.opacity > 0.99
    expected = (surface.albedo[:, 0] > 0.5).float()
    assert torch.equal(surface.metallic[there], expected[there])
    assert torch.equal(at_rays(surface, there).metallic, surface.metallic[there])
    mesh = extract_mesh(scene)
    traced = relight.TracedMesh(mesh, VisibilityScene(mesh.vertices, mesh.faces), 0.02)
    light = relight.Lighting(tables(smooth_map()))
    quality = relight.Quality(samples=16, bounces=1)
    with_metal = relight.render_picture(surface, wo, cameras, 0, traced, light, quality)
    without = relight.render_picture(
        replace(surface, metallic=None), wo, cameras, 0, traced, light, quality
    )
    shown = relight.channels(with_metal)["metallic"].flatten()
    torch.testing.assert_close(shown[there], expected[there] * surface.opacity[there])
    assert "metallic" not in relight.channels(without)
    metal = there & (expected > 0)
    differ = (with_metal.rgb - without.rgb).flatten(0, 1).abs().amax(1)
    assert (differ[metal] > 1e-3).float().mean() > 0.95


def test_files_hold_it(scene, tmp_path, monkeypatch):
    pygltflib = pytest.importorskip("pygltflib")
    trimesh = pytest.importorskip("trimesh")
    monkeypatch.setattr("univoxel.scene.load_scene", lambda run: scene)
    for name in ("a.glb", "a.obj", "a.ply"):
        task.export("run", tmp_path / name, faces=500, texture_size=64)
    file = pygltflib.GLTF2().load(str(tmp_path / "a.glb"))
    slots = file.materials[0].pbrMetallicRoughness
    assert slots.metallicFactor == 1
    view = file.bufferViews[file.images[slots.metallicRoughnessTexture.index].bufferView]
    part = file.binary_blob()[view.byteOffset :][: view.byteLength]
    packed = np.asarray(Image.open(io.BytesIO(part)))
    color = np.asarray(Image.open(tmp_path / "a_albedo.png"))
    metal = np.asarray(Image.open(tmp_path / "a_metallic.png"))
    assert np.array_equal(packed[..., 2], metal)
    # Red of one half is 188 in sRGB
    clear = np.abs(color[..., 0].astype(int) - 188) > 1
    assert np.array_equal(metal[clear] == 255, color[clear][:, 0] > 188)
    assert 0.1 < (metal == 255).mean() < 0.9
    assert "Pm 1\nmap_Pm a_metallic.png" in (tmp_path / "a.mtl").read_text()
    loaded = trimesh.load(tmp_path / "a.ply", process=False)
    vertex = loaded.metadata["_ply_raw"]["vertex"]["data"]
    on = torch.tensor(np.asarray(loaded.vertices)).float()
    red = albedo(on)[:, 0]
    clear = (red - 0.5).abs() > 0.02  # decimation leaves vertices up to a voxel off the surface
    assert np.array_equal(vertex["metallic"].ravel()[clear] > 0.5, (red > 0.5).numpy()[clear])
