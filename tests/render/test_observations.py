"""What sees a surface, what it sees, and what photographs say of its points."""

import math
from dataclasses import replace

import pytest
import torch
from analytic import RADIUS, photos_of, sphere_scene
from observed_points import facing, problem_on_a_sphere
from torch.nn.functional import normalize

from univoxel.camera import project
from univoxel.color import linear_to_srgb, srgb_to_linear
from univoxel.core.records import Mesh
from univoxel.ops import VisibilityScene, shade_map
from univoxel.render import observations
from univoxel.render.observations import (
    MIN_COSINE,
    POINTS_AT_ONCE,
    Observations,
    mean_colors,
    observe,
    prefiltered_roughness,
    sample_observations,
    surface_points,
    trace,
)
from univoxel.render.pipeline import extract_mesh
from univoxel.sphere import fibonacci_sphere


def test_of_a_large_mesh_some_vertices_tell_for_all(monkeypatch):
    """The ball is red on +X and blue on -X, brighter above: neighbours look alike."""
    scene, photos = sphere_scene(8), photos_of(12, 32)
    mesh = extract_mesh(scene)
    whole = observations.vertex_colors(scene, mesh, photos, len(mesh.vertices))
    looked_at, observe = [], observations.observe

    def noted(position, *arguments):
        looked_at.append(len(position))
        return observe(position, *arguments)

    monkeypatch.setattr(observations, "observe", noted)
    some = observations.vertex_colors(scene, mesh, photos, len(mesh.vertices) // 3)
    assert looked_at[0] <= len(mesh.vertices) // 3
    assert some.shape == whole.shape
    near_the_seam = mesh.vertices[:, 0].abs() < 0.1
    assert (some - whole)[~near_the_seam].abs().mean() < 0.02  # of 0.4 in the mean


def test_prefiltered_lobes_cover_the_gap_between_nodes():
    roughness = torch.tensor([0.05, 0.3, 1.0])
    wide = prefiltered_roughness(roughness, 64)
    assert torch.allclose(wide**4 - roughness**4, torch.full((3,), 1 / 64), rtol=1e-4)
    # The mean over a gap of what point lights of 64 nodes make of a mirror: near the right one
    direction, normal = fibonacci_sphere(64), normalize(torch.randn(500, 3), dim=1)
    wo = facing(normal, 0.5)
    albedo, one = torch.zeros(500, 3), torch.ones(64, 3)
    seen = shade_map(
        one, torch.ones(500, 64), torch.zeros(500, 64, 3), torch.arange(500), normal, wo, albedo,
        wide[:1].expand(500), direction, 4 * math.pi / 64,
    )[:, 0]  # fmt: skip
    assert seen.std() < 0.5 * seen.mean()


def test_samples_are_points_that_are_seen_and_their_own_observations():
    torch.manual_seed(0)
    problem = problem_on_a_sphere(6, 1, 8)
    counts = torch.tensor([3, 0, 1, 0, 0, 5])
    offsets = torch.cat([torch.zeros(1, dtype=torch.int64), counts.cumsum(0)])
    seen = replace(problem.observations, offsets=offsets)
    problem = replace(problem, observations=seen)
    point, observation = sample_observations(problem, 300, 4)
    assert point.shape == observation.shape == (1200,)
    assert (point.view(300, 4) == point.view(300, 4)[:, :1]).all()
    owner = torch.repeat_interleave(counts)
    assert torch.equal(owner[observation], point)
    assert set(observation.tolist()) == set(range(9))  # each is drawn at times


OFFSET = 0.05
EMPTY = VisibilityScene(torch.zeros(0, 3), torch.zeros(0, 3, dtype=torch.int32))


def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def quad(a, b, c, d) -> tuple[torch.Tensor, torch.Tensor]:
    vertices = torch.tensor([a, b, c, d], dtype=torch.float32)
    return vertices, torch.tensor([[0, 1, 2], [0, 2, 3]], dtype=torch.int32)


@pytest.fixture(scope="module")
def sphere() -> Mesh:
    return extract_mesh(sphere_scene(sky_nodes=0))


@pytest.fixture(scope="module")
def photos():
    return photos_of(views=8, size=64)


def test_points_follow_the_area():
    # Two triangles of areas 3 and 1, in two planes
    vertices = torch.tensor([[0.0, 0, 0], [3, 0, 0], [0, 2, 0], [0, 0, 5], [1, 0, 5], [0, 2, 5]])
    faces = torch.tensor([[0, 1, 2], [3, 4, 5]], dtype=torch.int32)
    normals = normalize(torch.tensor([[0.0, 0, 1], [1, 0, 1], [0, 1, 1]]), dim=1).repeat(2, 1)
    point, normal = surface_points(Mesh(vertices, faces, normals), 4000, generator())
    first = point[:, 2] < 1
    assert abs(int(first.sum()) - 3000) <= 1  # stratified: only the share on the border is open
    height = torch.where(first, 0.0, 5.0)
    assert torch.allclose(point[:, 2], height, atol=1e-5)
    inside = point[first]
    assert (inside[:, :2] >= 0).all()
    assert (inside[:, 0] / 3 + inside[:, 1] / 2 <= 1 + 1e-6).all()
    # Means over 3000 uniform points stray by sqrt(1/18) of the edge / sqrt(3000) = 0.013 at most
    assert torch.allclose(inside.mean(0), vertices[:3].mean(0), atol=4 * 0.013)
    assert torch.allclose(normal.norm(dim=1), torch.ones(4000), atol=1e-6)
    weight = torch.stack(
        [1 - inside[:, 0] / 3 - inside[:, 1] / 2, inside[:, 0] / 3, inside[:, 1] / 2], 1
    )
    assert torch.allclose(normal[first], normalize(weight @ normals[:3], dim=1), atol=1e-5)


def test_observations_of_a_sphere(sphere, photos):
    position, normal = surface_points(sphere, 600, generator())
    tracer = VisibilityScene(sphere.vertices, sphere.faces)
    seen = observe(position, normal, photos, tracer, OFFSET)
    view, point = views_of(seen, photos.cameras)
    assert seen.offsets[0] == 0
    assert seen.offsets[-1] == len(seen.wo) == len(seen.color) > 600
    cosine = (normal[point] * seen.wo).sum(1)
    assert cosine.min() > MIN_COSINE
    # None is missed: a sphere hides nothing of itself that faces the camera
    eye = photos.cameras.camera_to_world[:, :, 3]
    towards = normalize(eye[None] - position[:, None], dim=2)
    facing = (normal[:, None] * towards).sum(2) > 0.4  # farther in than the pixels of the edge
    found = torch.zeros_like(facing)
    found[point, view] = True
    assert facing.any()
    assert (found | ~facing).all()
    assert int(found.sum()) == len(point)  # and none comes twice
    assert torch.allclose(seen.wo, towards[point, view], atol=1e-5)


def test_colours_are_the_photographs_at_the_projected_place(sphere, photos):
    position, normal = surface_points(sphere, 300, generator())
    tracer = VisibilityScene(sphere.vertices, sphere.faces)
    seen = observe(position, normal, photos, tracer, OFFSET)
    stored = (255 * linear_to_srgb(photos.color)).round().to(torch.uint8)
    encoded = observe(position, normal, replace(photos, color=stored), tracer, OFFSET)
    view, point = views_of(seen, photos.cameras)
    for v in range(len(photos)):
        mine = (view == v).nonzero()[:, 0]
        pixel, _ = project(photos.cameras, v, position[point[mine]])
        x, y = (pixel - 0.5).unbind(1)  # centres of pixels lie at halves
        assert torch.allclose(seen.color[mine], bilinear(photos.color[v], x, y), atol=1e-4)
        expected = srgb_to_linear(bilinear(stored[v].float(), x, y) / 255)
        assert torch.allclose(encoded.color[mine], expected, atol=1e-4)
    # and so they are what the sphere looks like there, away from where its colour jumps
    away = position[point][:, 0].abs() > 0.1
    n = position[point][away] / RADIUS
    red, blue = torch.tensor([0.7, 0.2, 0.2]), torch.tensor([0.2, 0.2, 0.7])
    expected = torch.where(n[:, :1] > 0, red, blue) * (0.6 + 0.4 * n[:, 2:])
    assert torch.allclose(seen.color[away], expected, atol=0.01)


def test_what_stands_between_hides(sphere, photos):
    position, normal = surface_points(sphere, 300, generator())
    right, up, back, eye = photos.cameras.camera_to_world[2].unbind(1)
    middle = eye - 0.3 * back  # close to one camera and out of the sight of others
    corner = [(middle + 0.2 * (i * right + j * up)).tolist() for i, j in SQUARE]
    plate, faces = quad(*corner)
    with_plate = VisibilityScene(
        torch.cat([sphere.vertices, plate]), torch.cat([sphere.faces, faces + len(sphere.vertices)])
    )
    free = observe(position, normal, photos, VisibilityScene(sphere.vertices, sphere.faces), OFFSET)
    hidden = observe(position, normal, photos, with_plate, OFFSET)
    kept = views_of(free, photos.cameras)[0] != 2
    assert 0 < int((~kept).sum()) < len(kept)
    assert torch.equal(hidden.wo, free.wo[kept])
    assert torch.equal(hidden.color, free.color[kept])


def test_what_lies_behind_the_camera_hides_nothing(sphere, photos):
    position, normal = surface_points(sphere, 100, generator())
    right, up, back, eye = photos.cameras.camera_to_world[2].unbind(1)
    plate = quad(*((eye + 1.2 * back + (i * right + j * up)).tolist() for i, j in SQUARE))
    behind = observe(position, normal, photos, VisibilityScene(*plate), OFFSET)
    free = observe(position, normal, photos, EMPTY, OFFSET)
    assert torch.equal(behind.offsets, free.offsets)


def test_mean_colors():
    color = torch.tensor([[0.2, 0.4, 0.6], [0.4, 0.4, 0.0], [1.0, 2.0, 3.0]])
    nothing = torch.zeros(3, 3)
    view = torch.zeros(3, dtype=torch.int64)
    seen = Observations(nothing, nothing, torch.tensor([0, 2, 2, 3]), nothing, color, view, nothing)
    expected = torch.tensor([[0.3, 0.4, 0.3], [0.0, 0.0, 0.0], [1.0, 2.0, 3.0]])
    assert torch.allclose(mean_colors(seen), expected)


def test_a_sphere_sees_the_whole_sky(sphere):
    position, normal = surface_points(sphere, POINTS_AT_ONCE + 50, generator())  # in two parts
    tracer = VisibilityScene(sphere.vertices, sphere.faces)
    direction = fibonacci_sphere(128)
    white = torch.ones_like(sphere.vertices)
    arrived = trace(
        points(position, normal), tracer, sphere, white, direction, 1, OFFSET, generator()
    )
    cosine = normal @ direction.T
    # From OFFSET above, the sphere's edge lies 25 degrees below the horizon: 4 times the jitter
    # of nodes this coarse
    visibility = arrived.visibility.float() / 255
    assert visibility[cosine > 0.1].mean() > 0.9999
    spread = math.sqrt(4 * math.pi / 128) / 2
    assert (arrived.visibility[cosine < -spread - 1e-6] == 0).all()
    assert (arrived.indirect[cosine > 0.1].float().mean(1) <= 1e-4).float().mean() > 0.9999
    assert (arrived.indirect[cosine < -spread - 1e-6] == 0).all()


def test_half_a_ceiling_takes_its_solid_angle_and_shines_in_its_colour():
    # A plate above everything on the side of +X: a quarter of the sphere, half the irradiance
    far = 1e4
    vertices, faces = quad([0, -far, 1], [far, -far, 1], [far, far, 1], [0, far, 1])
    color = torch.tensor([0.5, 1.0, 0.25])
    position, normal = torch.zeros(2, 3), torch.tensor([[0.0, 0, 1], [1.0, 0, 0]])
    # offset 0 keeps both points right under the edge of the plate
    direction, rays = fibonacci_sphere(1024), 8
    arrived = trace(
        points(position, normal),
        VisibilityScene(vertices, faces),
        Mesh(vertices, faces),
        color.expand(4, 3),
        direction,
        rays,
        0.0,
        generator(),
    )
    x, _, z = direction.unbind(1)
    visibility, indirect = arrived.visibility.float() / 255, arrived.indirect.float()
    assert (arrived.visibility[0, (x > 0.2) & (z > 0.2)] == 0).all()
    assert (arrived.visibility[0, (x < -0.2) & (z > 0.2)] == 255).all()
    assert torch.allclose(indirect[0, (x > 0.2) & (z > 0.2)], color, rtol=1e-3)
    assert (indirect[0, (x < -0.2) & (z > 0.2)] == 0).all()
    traced = (normal @ direction.T) > 0.1
    blocked = (1 - visibility)[..., None] * color
    # uint8 of a share of 8 rays and half floats: 1/510 and 2^-11
    assert torch.allclose(indirect[traced], blocked[traced], atol=3e-3)

    solid = 4 * math.pi / len(direction)
    above = z > 0
    assert ((1 - visibility[0, above]).sum() * solid).item() == pytest.approx(math.pi, rel=0.03)
    # For the point that looks along +X: what is below the plate's plane is open, what is above not
    ahead = x > 0
    assert ((1 - visibility[1, ahead]).sum() * solid).item() == pytest.approx(math.pi, rel=0.03)
    irradiance = (z.clamp_min(0)[:, None] * indirect[0]).sum(0) * solid
    assert torch.allclose(irradiance, math.pi / 2 * color, rtol=0.03)


SQUARE = ((-1, -1), (1, -1), (1, 1), (-1, 1))


def points(position: torch.Tensor, normal: torch.Tensor) -> Observations:
    nothing = torch.zeros(0, 3)
    offsets = torch.zeros(len(position) + 1, dtype=torch.int64)
    return Observations(position, normal, offsets, nothing, nothing, offsets[:0], nothing)


def views_of(seen: Observations, cameras) -> tuple[torch.Tensor, torch.Tensor]:
    """Which view each observation is from, by its direction, and its point."""
    point = torch.repeat_interleave(seen.offsets.diff())
    eye = cameras.camera_to_world[:, :, 3]
    towards = normalize(eye[None] - seen.position[point][:, None], dim=2)
    cosine = (towards * seen.wo[:, None]).sum(2)
    assert cosine.max(1).values.min() > 1 - 1e-5
    return cosine.argmax(1), point


def bilinear(picture: torch.Tensor, x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
    i, j = x.floor().long(), y.floor().long()
    fx, fy = (x - i)[:, None], (y - j)[:, None]
    upper = (1 - fx) * picture[j, i] + fx * picture[j, i + 1]
    lower = (1 - fx) * picture[j + 1, i] + fx * picture[j + 1, i + 1]
    return (1 - fy) * upper + fy * lower


def test_observations_of_some_points_are_theirs_in_their_order():
    torch.manual_seed(0)
    offsets = torch.tensor([0, 2, 2, 5, 6])
    wo, color, view = torch.randn(6, 3), torch.rand(6, 3), torch.arange(6)
    everything = Observations(
        torch.randn(4, 3), torch.randn(4, 3), offsets, wo, color, view, torch.zeros(1, 3)
    )
    some = everything.at(torch.tensor([2, 0, 1, 2]))
    assert torch.equal(some.position, everything.position[[2, 0, 1, 2]])
    assert torch.equal(some.normal, everything.normal[[2, 0, 1, 2]])
    assert some.offsets.tolist() == [0, 3, 5, 5, 8]
    index = [2, 3, 4, 0, 1, 2, 3, 4]
    for part, whole in ((some.wo, wo), (some.color, color), (some.view, view)):
        assert torch.equal(part, whole[index])
    none = everything.at(torch.tensor([], dtype=torch.int64))
    assert none.offsets.tolist() == [0]
    assert not len(none.wo)
