"""From rays to surfaces: a sphere's geometry comes back, and points see their own scene."""

import pytest
import torch
from analytic import RADIUS, cameras_around, sphere_normals
from asymmetric_scene import lopsided
from balls import surface_at, views

from univoxel.camera import image_rays
from univoxel.color import srgb_to_linear
from univoxel.fields.field import dense_field
from univoxel.fields.grid import fit_grid
from univoxel.lights import EnvmapConfig
from univoxel.lights.quadrature import half_sphere
from univoxel.render import pipeline
from univoxel.render.pipeline import TRACED_AT_ONCE, occlusion, outgoing, shade
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


# On the large ball of lopsided.BALLS, beside the small one, and far from both
POINTS = torch.tensor([[0.28, 0.28, 0.06], [-0.4, 0.0, 0.0]])


def surface(points):
    normal = torch.nn.functional.normalize(points, dim=1)
    return surface_at(points, normal, features=torch.zeros(len(points), 4))


@pytest.fixture(scope="module")
def traced() -> Scene:
    return lopsided(light=EnvmapConfig(rows=8, directions=256, directions_eval=1024))


def test_a_neighbour_hides_what_lies_behind_it(traced):
    s = surface(POINTS)
    rotation = torch.tensor([0.3, 1.0])
    seen = occlusion(traced, s, 1024, rotation)
    assert torch.equal(seen.rotation, rotation)
    assert bool((seen.visibility[1] == 1).all())  # nothing there
    # The small ball's cap, as an eye at the ray's start sees it
    start = POINTS[0] + traced.field.voxel_size * s.normal[0]
    to_ball = torch.tensor([0.35, 0.1, 0.0]) - start
    wi = half_sphere(s, 1024, rotation)[0]
    along = wi @ to_ball
    miss = (to_ball.square().sum() - along.square()).clamp_min(0).sqrt()
    expected = (along > 0) & (miss < 0.2)
    assert 50 < int(expected.sum()) < 1000
    clear = (miss - 0.2).abs() > 0.02  # the mesh has voxels of 0.02
    assert torch.equal((seen.visibility[0] == 0)[clear], expected[clear])


def test_blocked_light_is_what_the_radiance_head_says(traced):
    s = surface(POINTS[:1])
    rotation = torch.zeros(1)
    seen = occlusion(traced, s, 256, rotation)
    blocked = seen.visibility[0] == 0
    assert bool((seen.indirect[0][~blocked] == 0).all())
    wi = half_sphere(s, 256, rotation)[0]
    start = (POINTS + traced.field.voxel_size * surface(POINTS).normal)[0].expand(256, 3)
    hit = traced.occluder().closest_hit(start.contiguous(), wi)
    places = start + hit.t[:, None] * wi
    wanted = outgoing(traced, places[blocked], -wi[blocked])
    torch.testing.assert_close(seen.indirect[0][blocked], wanted)
    # and the head is asked with the features and the normal of the place
    sample = traced.field.sample(places[blocked])
    normal = torch.nn.functional.normalize(sample.gradient, dim=1)
    head = srgb_to_linear(traced.radiance(sample.features, normal, -wi[blocked]))
    torch.testing.assert_close(wanted, head)


def test_shading_takes_the_traced_light(traced):
    s = surface(POINTS)
    wo = views(s)
    seen = occlusion(traced, s, 1024, torch.zeros(2))
    got = shade(traced, s, wo)
    torch.testing.assert_close(got, traced.light.reflected(s, wo, seen))
    bare = traced.light.reflected(s, wo)
    assert (got - bare)[0].abs().max() > 1e-3
    torch.testing.assert_close(got[1], bare[1])


def test_many_points_are_done_in_parts(traced):
    count = 2 * TRACED_AT_ONCE // 1024 + 3
    s = surface(POINTS[1:].expand(count, 3).contiguous())
    got = shade(traced, s, s.normal)
    assert got.shape == (count, 3)
    torch.testing.assert_close(got, got[:1].expand(count, 3))
    assert shade(traced, surface(POINTS[:0]), POINTS[:0]).shape == (0, 3)


def test_a_generator_turns_the_directions(traced):
    s = surface(POINTS)
    one, two = (shade(traced, s, s.normal, torch.Generator().manual_seed(i)) for i in (0, 1))
    assert not torch.equal(one[0], two[0])
    torch.testing.assert_close(one, two, rtol=0.05, atol=0)  # 1024 directions
