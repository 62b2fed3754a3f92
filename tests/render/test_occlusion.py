"""What surface points see of their own scene, where geometry says what must come out."""

import pytest
import torch
from asymmetric_scene import lopsided
from balls import surface_at, views

from univoxel.color import srgb_to_linear
from univoxel.lights import EnvmapConfig
from univoxel.lights.quadrature import half_sphere
from univoxel.render.pipeline import TRACED_AT_ONCE, occlusion, outgoing, shade
from univoxel.scene import Scene

# On the large ball of lopsided.BALLS, beside the small one, and far from both
POINTS = torch.tensor([[0.28, 0.28, 0.06], [-0.4, 0.0, 0.0]])


def surface(points):
    normal = torch.nn.functional.normalize(points, dim=1)
    return surface_at(points, normal, features=torch.zeros(len(points), 4))


@pytest.fixture(scope="module")
def scene() -> Scene:
    return lopsided(light=EnvmapConfig(rows=8, directions=256, directions_eval=1024))


def test_a_neighbour_hides_what_lies_behind_it(scene):
    s = surface(POINTS)
    rotation = torch.tensor([0.3, 1.0])
    seen = occlusion(scene, s, 1024, rotation)
    assert torch.equal(seen.rotation, rotation)
    assert bool((seen.visibility[1] == 1).all())  # nothing there
    # The small ball's cap, as an eye at the ray's start sees it
    start = POINTS[0] + scene.field.voxel_size * s.normal[0]
    to_ball = torch.tensor([0.35, 0.1, 0.0]) - start
    wi = half_sphere(s, 1024, rotation)[0]
    along = wi @ to_ball
    miss = (to_ball.square().sum() - along.square()).clamp_min(0).sqrt()
    expected = (along > 0) & (miss < 0.2)
    assert 50 < int(expected.sum()) < 1000
    clear = (miss - 0.2).abs() > 0.02  # the mesh has voxels of 0.02
    assert torch.equal((seen.visibility[0] == 0)[clear], expected[clear])


def test_blocked_light_is_what_the_radiance_head_says(scene):
    s = surface(POINTS[:1])
    rotation = torch.zeros(1)
    seen = occlusion(scene, s, 256, rotation)
    blocked = seen.visibility[0] == 0
    assert bool((seen.indirect[0][~blocked] == 0).all())
    wi = half_sphere(s, 256, rotation)[0]
    start = (POINTS + scene.field.voxel_size * surface(POINTS).normal)[0].expand(256, 3)
    hit = scene.occluder().closest_hit(start.contiguous(), wi)
    places = start + hit.t[:, None] * wi
    wanted = outgoing(scene, places[blocked], -wi[blocked])
    torch.testing.assert_close(seen.indirect[0][blocked], wanted)
    # and the head is asked with the features and the normal of the place
    sample = scene.field.sample(places[blocked])
    normal = torch.nn.functional.normalize(sample.gradient, dim=1)
    head = srgb_to_linear(scene.radiance(sample.features, normal, -wi[blocked]))
    torch.testing.assert_close(wanted, head)


def test_shading_takes_the_traced_light(scene):
    s = surface(POINTS)
    wo = views(s)
    seen = occlusion(scene, s, 1024, torch.zeros(2))
    got = shade(scene, s, wo)
    torch.testing.assert_close(got, scene.light.reflected(s, wo, seen))
    bare = scene.light.reflected(s, wo)
    assert (got - bare)[0].abs().max() > 1e-3
    torch.testing.assert_close(got[1], bare[1])


def test_many_points_are_done_in_parts(scene):
    count = 2 * TRACED_AT_ONCE // 1024 + 3
    s = surface(POINTS[1:].expand(count, 3).contiguous())
    got = shade(scene, s, s.normal)
    assert got.shape == (count, 3)
    torch.testing.assert_close(got, got[:1].expand(count, 3))
    assert shade(scene, surface(POINTS[:0]), POINTS[:0]).shape == (0, 3)


def test_a_generator_turns_the_directions(scene):
    s = surface(POINTS)
    one, two = (shade(scene, s, s.normal, torch.Generator().manual_seed(i)) for i in (0, 1))
    assert not torch.equal(one[0], two[0])
    torch.testing.assert_close(one, two, rtol=0.05, atol=0)  # 1024 directions
