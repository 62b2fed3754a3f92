"""What the photographs say of the surface's points."""

import math
from dataclasses import replace

import torch
from analytic import photos_of, sphere_scene
from observed_points import facing, problem_on_a_sphere
from torch.nn.functional import normalize

from univoxel.ops import shade_map
from univoxel.render import observations
from univoxel.render.observations import prefiltered_roughness, sample_observations
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
