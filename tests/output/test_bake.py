"""Textures hold what the field says at the surface beside the mesh."""

import pytest
import torch
from asymmetric_scene import albedo, lopsided, roughness

from univoxel.core.records import Mesh
from univoxel.ops.charts import corner_weights, rasterise
from univoxel.output.mesh import bake, in_frame, nearest_surface, with_materials
from univoxel.output.topology import clean, simplify


def ball(nodes, _):
    return 1.5 * (nodes.norm(dim=-1) - 0.4)  # a slope of 1.5: no true distance


@pytest.fixture(scope="module")
def scene():
    return lopsided(change=ball)


@pytest.fixture(scope="module")
def mesh(scene):
    return simplify(clean(Mesh(*scene.field.isosurface())), 600)


def test_points_go_to_the_surface_but_not_far(scene):
    generator = torch.Generator().manual_seed(0)
    way = torch.nn.functional.normalize(torch.randn(200, 3, generator=generator), dim=1)
    voxel = scene.field.voxel_size
    off = voxel * torch.linspace(-1.5, 1.5, 200)[:, None]
    x, at = nearest_surface(scene.field, way * (0.4 + off))
    # Trilinear interpolation lets the level bulge by voxel^2 / (8 * 0.4) = 0.007 voxel an axis
    assert (x.norm(dim=1) - 0.4).abs().max() < 0.03 * voxel
    assert at.sdf.abs().max() < 1e-4 * voxel
    far, _ = nearest_surface(scene.field, way * (0.4 - 6 * voxel))
    torch.testing.assert_close(
        far.norm(dim=1), torch.full((200,), 0.4 - 4 * voxel), rtol=0, atol=1e-3
    )


def test_vertices_take_the_materials_of_the_surface(scene, mesh):
    out = with_materials(scene, mesh)
    on = 0.4 * torch.nn.functional.normalize(mesh.vertices, dim=1)
    assert torch.equal(out.vertices, mesh.vertices)
    torch.testing.assert_close(out.albedo, albedo(on), rtol=0, atol=1e-3)
    torch.testing.assert_close(out.roughness, roughness(on), rtol=0, atol=1e-3)
    assert ((out.normals * on).sum(1) > 0.4 * 0.9995).all()  # 1.8 degrees


def test_texels_take_the_materials_and_the_normal(scene, mesh, monkeypatch):
    size = 128
    out = bake(scene, mesh, size)
    assert ((out.uv >= 0) & (out.uv <= 1)).all()
    texel, face, barycentric = rasterise(out.uv, out.faces, size)
    weight = corner_weights(barycentric)
    corner = out.faces[face].long()
    point, n, t = (
        torch.einsum("kc,kcd->kd", weight, v[corner])
        for v in (out.vertices, out.normals, out.tangents)
    )
    on = 0.4 * torch.nn.functional.normalize(point, dim=1)
    # Newton's way to the surface is not radial where a coarse triangle cuts below: 0.1 voxel
    near = {"rtol": 0, "atol": 0.1 * scene.field.voxel_size}
    torch.testing.assert_close(out.albedo.reshape(-1, 3)[texel], albedo(on), **near)
    torch.testing.assert_close(out.roughness.reshape(-1)[texel], roughness(on), **near)
    relief = out.relief.reshape(-1, 3)[texel]
    b = t[:, 3:] * torch.linalg.cross(n, t[:, :3])
    normal = relief[:, :1] * t[:, :3] + relief[:, 1:2] * b + relief[:, 2:] * n
    cosine = torch.nn.functional.cosine_similarity(normal, on)
    assert torch.rad2deg(cosine.clamp(-1, 1).acos()).max() < 2.0
    # The triangles alone are far off: the map does the work.
    a, b, c = out.vertices[out.faces.long()].unbind(1)
    flat = torch.linalg.cross(b - a, c - a)[face]
    assert torch.rad2deg(torch.nn.functional.cosine_similarity(flat, on).acos()).max() > 4.0
    torch.testing.assert_close(out.relief.norm(dim=2), torch.ones(size, size))
    assert (out.relief[..., 2] > 0).all()
    # The background holds only colours of the object
    known = {tuple(c) for c in out.albedo.reshape(-1, 3)[texel].tolist()}
    assert {tuple(c) for c in out.albedo.reshape(-1, 3).tolist()} == known
    nothing = torch.empty(0, dtype=torch.int64)
    nowhere = nothing, nothing, torch.empty(0, 2)
    monkeypatch.setattr("univoxel.output.mesh.rasterise", lambda *_: nowhere)
    with pytest.raises(ValueError, match="texture of 16 x 16 is too small for"):
        bake(scene, mesh, 16)


def test_frame_coordinates_solve_a_skewed_frame():
    generator = torch.Generator().manual_seed(1)
    n = torch.randn(50, 3, generator=generator)
    t = torch.cat([torch.randn(50, 3, generator=generator), torch.ones(50, 1)], 1)
    t[25:, 3] = -1
    local = torch.nn.functional.normalize(torch.rand(50, 3, generator=generator) + 0.1, dim=1)
    b = t[:, 3:] * torch.linalg.cross(n, t[:, :3])
    direction = local[:, :1] * t[:, :3] + local[:, 1:2] * b + local[:, 2:] * n
    torch.testing.assert_close(in_frame(direction, n, t), local, rtol=0, atol=1e-4)
    below = in_frame(-n, n, t)
    assert (below[:, 2] > 0).all()
    torch.testing.assert_close(below.norm(dim=1), torch.ones(50))
