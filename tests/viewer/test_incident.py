"""The light at a point against cameras that stand there, and against sums by hand."""

import math

import pytest
import torch
from asymmetric_scene import BALLS, subject_of

from univoxel.camera import Cameras, image_rays
from univoxel.core.records import Rays
from univoxel.envmap import EnvMap, lookup
from univoxel.ops import Sun
from univoxel.output.viewpoints import lighting
from univoxel.render.relight import relight_surface
from univoxel.sphere import latlong_directions, texel_solid_angles
from univoxel.viewer.viewer_scene import (
    incident_light,
    incident_picture,
    point_on_mesh,
    surface_along,
)

ROWS = 32


@pytest.fixture(scope="module")
def subject(balls):
    return subject_of(balls)


@pytest.fixture(scope="module")
def crease(subject):
    """On the large ball beside the upper one, which hides a part of the sky."""
    return seen_from(subject, torch.tensor([0.0, -0.13, 3.0]), (0.0, -0.13, 0.0))


def seen_from(subject, origin, towards):
    way = torch.nn.functional.normalize(torch.tensor(towards) - origin, dim=0)
    return point_on_mesh(subject, Rays(origin[None], way[None]))


def uneven():
    """A map that is another in every direction."""
    direction = latlong_directions(64)
    return EnvMap(1 + 0.9 * direction.roll(1, -1))


def test_a_point_is_where_the_ray_first_meets_the_mesh(subject, crease):
    distance = ((crease.position - BALLS[:, :3]).norm(dim=1) - BALLS[:, 3]).min()
    assert abs(distance) < subject.scene.field.voxel_size
    ball = ((crease.position - BALLS[:, :3]).norm(dim=1) - BALLS[:, 3]).argmin()
    outwards = torch.nn.functional.normalize(crease.position - BALLS[ball, :3], dim=0)
    assert outwards @ crease.normal > 0.97
    assert crease.position[2] > 0.3  # the near side
    ray = Rays(torch.tensor([[0.0, -3.0, 2.0]]), torch.tensor([[0.0, 1.0, 0.0]]))
    assert point_on_mesh(subject, ray) is None


def test_a_free_point_sees_the_map(subject):
    """From the top of the upper ball nothing of the object is above the horizon."""
    top = seen_from(subject, torch.tensor([0.0, 0.1, 3.0]), (0.0, 0.1, 0.0))
    light = incident_light(subject, top, lighting(uneven()), ROWS)
    direction = latlong_directions(ROWS)
    up = direction @ top.normal
    free = up > 0.1  # the curved triangles beside it may stand a little higher
    expected = 1 + 0.9 * direction.roll(1, -1)
    assert (light - expected)[free].abs().max() < 0.01  # interpolation of the map
    assert (light[up < 0] == 0).all()


def test_what_hides_the_sky_is_seen_as_a_camera_there_sees_it(subject, crease):
    """Pixels of a camera at the point, rendered as the viewer renders, on every blocked texel."""
    light_of = lighting(uneven(), suns=[Sun((1, -1, 1), (2.0, 1.0, 0.5))])
    found = incident_light(subject, crease, light_of, ROWS, samples=512)
    eye = crease.position + subject.traced.offset * crease.normal
    back = torch.tensor([0.0, -1.0, 0.0])  # it looks at the upper ball
    right, up = torch.tensor([1.0, 0.0, 0.0]), torch.tensor([0.0, 0.0, 1.0])
    size = 101
    pose = torch.stack([right, up, back, eye], 1)[None]
    focal = torch.full((1, 2), size / 2 / math.tan(math.radians(60)))
    camera = Cameras(pose, focal, torch.full((1, 2), size / 2), size, size)
    surface, wo, hit = surface_along(subject, image_rays(camera, 0))
    rgb = relight_surface(surface, wo, subject.traced, light_of, samples=512, bounces=1)
    above = -wo @ crease.normal > 0.1
    blocked = ((hit.face >= 0) & above).nonzero()[:, 0]
    assert 100 < len(blocked) < 0.9 * size * size
    # Texels of 5.6 degrees; at their borders another is the nearest
    cosine = -wo[blocked] @ latlong_directions(ROWS).reshape(-1, 3).T
    texel = found.reshape(-1, 3)[cosine.argmax(1)]
    difference = (texel - rgb[blocked]).abs().amax(1)
    assert difference.median() < 0.03
    sky = lookup(uneven(), -wo[blocked])
    assert (sky - rgb[blocked]).abs().amax(1).median() > 0.3  # else the test tells nothing


def test_a_sun_adds_its_irradiance_or_hides(subject, crease):
    dark = EnvMap(torch.zeros(2, 4, 3))
    towards = crease.normal.tolist()
    sun = Sun(tuple(towards), (3.0, 2.0, 1.0))
    light = incident_light(subject, crease, lighting(dark, suns=[sun]), ROWS)
    angle = texel_solid_angles(ROWS, 2 * ROWS)[..., None]
    free = latlong_directions(ROWS) @ crease.normal > math.cos(math.radians(5))
    summed = (light * angle)[free].sum(0)
    torch.testing.assert_close(summed, torch.tensor([3.0, 2.0, 1.0]), rtol=0.02, atol=0)
    below = Sun((-towards[0], -towards[1], -towards[2]), (3.0, 2.0, 1.0))
    light = incident_light(subject, crease, lighting(dark, suns=[below]), ROWS)
    assert light.max() < 0.1  # what the object's lit side sends
    behind = Sun((0.0, 1.0, 0.1), (3.0, 2.0, 1.0))  # the upper ball
    light = incident_light(subject, crease, lighting(dark, suns=[behind]), ROWS)
    assert light.max() < 1


def test_a_picture_of_it_has_the_exposure_and_its_size():
    light = torch.rand(4, 8, 3)
    one, two = incident_picture(light, 0.0, 3), incident_picture(2 * light, -1.0, 3)
    assert one.shape == (12, 24, 3)
    assert torch.equal(one, two)
    assert one.min() >= 0
    assert one.max() <= 1
