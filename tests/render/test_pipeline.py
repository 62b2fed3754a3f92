"""From rays to surfaces: a sphere's field gives the sphere's geometry back."""

import pytest
import torch
from analytic import RADIUS, cameras_around, sphere_normals

from univoxel.camera import image_rays
from univoxel.fields.field import dense_field
from univoxel.fields.grid import fit_grid
from univoxel.render import pipeline
from univoxel.scene import Scene, SceneConfig


@pytest.fixture(scope="module")
def scene():
    torch.manual_seed(0)
    grid = fit_grid(torch.full((3,), -0.7), torch.full((3,), 0.7), 48**3)
    field = dense_field(grid, 4, grid.nodes().norm(dim=-1) - RADIUS)
    torch.nn.init.normal_(field.features)
    return Scene(
        SceneConfig(channels=4, material_channels=2, hidden=8), field, inv_s=2 / grid.voxel_size
    ).eval()


def test_surface_is_the_sphere(scene):
    cameras = cameras_around(3, size=40)
    normal, hit = sphere_normals(cameras, 1)
    surface, wo = pipeline.surface_of_view(scene, cameras, 1)
    # away from the silhouette, where the density's width lets rays through
    inner = ((normal.reshape(-1, 3) * wo).sum(1) > 0.6) & hit.reshape(-1)
    voxel = scene.field.voxel_size
    assert (surface.opacity[inner] > 0.99).all()
    # a fifth of a voxel: trilinear interpolation of a curved sdf, and the density's width
    assert (surface.position[inner].norm(dim=1) - RADIUS).abs().max() < 0.2 * voxel
    cosine = (surface.normal * normal.reshape(-1, 3)).sum(1)[inner]
    assert torch.rad2deg(cosine.clamp(-1, 1).acos()).max() < 1.0
    rays = image_rays(cameras, 1)
    b = (rays.origin * rays.direction).sum(1)
    closest = (rays.origin.square().sum(1) - b.square()).sqrt()
    # 8 s, the band outside of which the density is taken for empty, are 4 voxels here
    assert (surface.opacity[closest > RADIUS + 5 * voxel] == 0).all()


def test_gradients_reach_field_and_heads(scene):
    rays = image_rays(cameras_around(2, size=16), 0)
    surface = pipeline.surface_at(scene, rays, torch.rand(256))
    hit = (surface.opacity > 0.5).nonzero()[:, 0]
    rgb = pipeline.shade(scene, pipeline.at_rays(surface, hit), -rays.direction[hit])
    radiance = scene.radiance(surface.features, surface.normal, -rays.direction)
    (rgb.square().sum() + radiance.square().sum() + surface.depth.sum()).backward()
    for name, p in scene.named_parameters():
        if name.startswith("sky."):  # no part of the pipeline
            assert p.grad is None
            continue
        grad = p.grad.coalesce().values() if p.grad.is_sparse else p.grad
        assert grad.isfinite().all(), name
        if not name.startswith(("light.head", "mirrored.net")):  # their last layers start at 0
            assert grad.abs().sum() > 0, name
    scene.zero_grad()


def test_shading_a_picture_is_black_where_nothing_is(scene):
    cameras = cameras_around(2, size=24)
    surface, wo = pipeline.surface_of_view(scene, cameras, 0)
    rgb = pipeline.shade_hits(scene, surface, wo)
    assert (rgb[surface.opacity == 0] == 0).all()
    assert (rgb[surface.opacity > 0.9] > 0).all()


def test_mesh_lies_on_the_surface_and_faces_outwards(scene):
    mesh = pipeline.extract_mesh(scene)
    assert (mesh.vertices.norm(dim=1) - RADIUS).abs().max() < 0.1 * scene.field.voxel_size
    a, b, c = mesh.vertices[mesh.faces.long()].unbind(1)
    outward = (torch.linalg.cross(b - a, c - a) * (a + b + c)).sum(1)
    assert (outward > 0).all()
    assert ((mesh.normals * mesh.vertices).sum(1) > 0.9 * RADIUS).all()
    assert ((mesh.albedo >= 0) & (mesh.albedo <= 1)).all()
    assert mesh.faces.dtype == torch.int32


def test_a_field_without_surface_has_no_mesh(scene):
    grid = fit_grid(torch.full((3,), -0.7), torch.full((3,), 0.7), 8**3)
    empty = Scene(
        SceneConfig(channels=4, material_channels=2, hidden=8),
        dense_field(grid, 4, torch.ones(grid.size)),
    )
    with pytest.raises(ValueError, match="no surface: its sdf does not change sign"):
        pipeline.extract_mesh(empty)


def test_resizing_keeps_what_is_seen(scene):
    cameras = cameras_around(2, size=24)
    before, _ = pipeline.surface_of_view(scene, cameras, 0)
    finer = Scene(scene.cfg, scene.field, scene.inv_s)
    finer.load_state_dict(scene.state_dict())
    lower, upper = scene.field.bounds()
    finer.field = scene.field.resized(fit_grid(lower, upper, 80**3))
    after, _ = pipeline.surface_of_view(finer, cameras, 0)
    inner = (before.opacity > 0.99) & (after.opacity > 0.99)
    assert inner.sum() > 50
    assert (before.depth - after.depth)[inner].abs().max() < 0.2 * scene.field.voxel_size
