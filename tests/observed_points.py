"""Observations of the sphere for tests of the joint solve, rendered by the shading op."""

import dataclasses
import math
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import torch
from analytic import RADIUS, cameras_around, scene_of, sphere_normals
from torch.nn.functional import normalize

from univoxel import brdf
from univoxel.color import linear_to_srgb, linear_to_srgb_unclipped
from univoxel.data import Photos
from univoxel.lights.latlong import DistantLight
from univoxel.lights.views import Flash
from univoxel.ops import shade_map
from univoxel.render.observations import (
    JointProblem,
    MaterialLabels,
    Observations,
    Transport,
    prefiltered_roughness,
)
from univoxel.scene import Scene
from univoxel.sphere import fibonacci_sphere
from univoxel.training.equations import LinearTransport


def facing(normal: torch.Tensor, least: float) -> torch.Tensor:
    """Random unit directions [N, 3] at a cosine of at least about `least` to the normals."""
    wo = normalize(torch.randn_like(normal), dim=1)
    wo = wo * (wo * normal).sum(1, keepdim=True).sign()
    return normalize(wo + least * normal, dim=1)


def problem_on_a_sphere(
    points: int, views: int, nodes: int, scene: Scene | None = None
) -> JointProblem:
    """Points that see everything above their horizon, and black photographs of them.

    Args:
        scene: whose map is solved for; None: one of its own.
    """
    normal = normalize(torch.randn(points, 3), dim=1)
    wo = facing(normal.repeat_interleave(views, 0), 0.3)
    offsets = torch.arange(points + 1) * views
    black = torch.zeros(points * views, 3)
    view = torch.arange(points * views) % views
    observations = Observations(RADIUS * normal, normal, offsets, wo, black, view, wo[:views])
    visibility = torch.full((points, nodes), 255, dtype=torch.uint8)
    indirect = torch.zeros(points, nodes, 3, dtype=torch.float16)
    transport = Transport(fibonacci_sphere(nodes), visibility, indirect)
    sky = DistantLight(nodes) if scene is None else scene.sky
    return JointProblem(observations, transport, black, 0.05, sky)


def no_metal(problem: JointProblem) -> MaterialLabels:
    """Nothing is decided yet, and nothing is metal."""
    return MaterialLabels(torch.zeros(len(problem.observations.position), dtype=torch.bool))


def photographed(problem: JointProblem, map, albedo, roughness, f0=None) -> JointProblem:
    """The same with the observations that a map [D, 3] and materials [P, 3], [P] make."""
    point = torch.repeat_interleave(problem.observations.offsets.diff())
    t, seen = problem.transport, problem.observations
    color = shade_map(
        map, t.visibility, t.indirect, point, seen.normal[point], seen.wo, albedo[point],
        roughness[point], t.direction, problem.solid_angle, brdf.F0 if f0 is None else f0[point],
    )  # fmt: skip
    seen = replace(seen, color=color)
    return replace(problem, observations=seen, target=linear_to_srgb_unclipped(color))


def random_problem(
    points: int = 5, views: int = 4, nodes: int = 12, scene: Scene | None = None
) -> JointProblem:
    """With half-open directions and light from what blocks them."""
    torch.manual_seed(1)
    problem = problem_on_a_sphere(points, views, nodes, scene)
    visibility = torch.randint(0, 256, (points, nodes), dtype=torch.uint8)
    indirect = torch.rand(points, nodes, 3).half()
    transport = Transport(problem.transport.direction, visibility, indirect)
    return replace(problem, transport=transport)


def in_double(transport: LinearTransport) -> LinearTransport:
    values = {f.name: getattr(transport, f.name) for f in dataclasses.fields(transport)}
    whole = {k: values.pop(k) for k in ("view", "flash")}
    return LinearTransport(**{k: v.double() for k, v in values.items()}, **whole)


class Steps:
    """A progress, and its clock, that let a stage run through."""

    finished, over, pace, reserved = False, False, 1.0, math.inf
    stage = step = 0

    def __init__(self, count: int, rooms: Sequence[int] = ()):
        self.count, self.rooms, self.asked = count, list(rooms), []
        self.troubles, self.said, self.abandoned, self.within = [], [], False, None

    def steps(self, apart):
        assert 0 <= apart < 1
        for i in range(self.count):
            if self.abandoned:
                return
            self.step = i
            yield i / self.count

    @property
    def clock(self) -> "Steps":
        return self

    def off_pace(self):
        return nullcontext()

    def blocks_that_fit(self, blocks):
        self.asked.append(blocks)
        return self.rooms.pop(0) if self.rooms else blocks

    def due(self) -> bool:
        return False

    def checkpoint_due(self) -> bool:
        return False

    def trouble(self, what: str) -> None:
        self.troubles.append(what)

    def say(self, what: str) -> None:
        self.said.append(what)

    def abandon(self) -> None:
        self.abandoned = True


RED, BLUE = torch.tensor([0.6, 0.2, 0.15]), torch.tensor([0.15, 0.25, 0.6])


def lamps(nodes: int) -> torch.Tensor:
    """A grey map [D, 3] with three lamps that make highlights."""
    direction = fibonacci_sphere(nodes)
    map = torch.full((nodes, 3), 0.35)
    for axis in ([1.0, -1.0, 1.0], [-1.0, 0.2, 0.5], [0.0, 1.0, 0.3]):
        lobe = (12 * (direction @ normalize(torch.tensor(axis), dim=0) - 1)).exp()
        map += lobe[:, None] * torch.tensor([3.3, 3.0, 2.7])
    return map


NODES, COUNT = 128, 800  # of the map and the points of `sphere_of`


def sphere_of(base, metallic, roughness, views=12, noise=0.0):
    """A scene with the map known and the material not, and photographs of a sphere [COUNT]."""
    torch.manual_seed(1)
    map = lamps(NODES)
    scene = scene_of((0.5, 0.5, 0.5), 0.5, NODES, map)
    problem = problem_on_a_sphere(COUNT, views, NODES, scene)
    metallic = (
        metallic(problem.observations.normal)
        if callable(metallic)
        else torch.full((COUNT,), metallic)
    )
    diffuse, f0 = brdf.split(torch.tensor(base).expand(COUNT, 3), metallic)
    shown = prefiltered_roughness(torch.full((COUNT,), roughness), NODES)
    problem = photographed(problem, map, diffuse, shown, f0)
    target = problem.target + noise * torch.randn_like(problem.target)
    return scene, replace(problem, target=target.clamp(0, 1))


def photographs_under(
    maps: torch.Tensor,
    roughness: float,
    views: int = 16,
    size: int = 48,
    flash: Flash | None = None,
) -> Photos:
    """The sphere, red on +X and blue on -X, under a map [D, 3], or one for each view [V, D, 3], and
    a flash."""
    cameras = cameras_around(views, size)
    direction = fibonacci_sphere(maps.shape[-2])
    color, alpha = [], []
    for v, map in enumerate(maps.expand(views, -1, -1)):
        normal, hit = sphere_normals(cameras, v)
        n = normal[hit]
        away = cameras.camera_to_world[v, :, 3] - RADIUS * n
        wo = normalize(away, dim=1)
        count = len(n)
        albedo = torch.where(n[:, :1] > 0, RED, BLUE)
        shown = prefiltered_roughness(torch.full((count,), roughness), len(map))
        rgb = shade_map(
            map, torch.full((count, len(map)), 255, dtype=torch.uint8),
            torch.zeros(count, len(map), 3).half(), torch.arange(count), n, wo, albedo,
            shown, direction, 4 * math.pi / len(map),
        )  # fmt: skip
        if flash is not None:
            f0 = torch.full_like(albedo, brdf.F0)
            seen = n, wo, away.norm(dim=1)
            rgb += flash.reflected(*seen, albedo, torch.full((count,), roughness), f0).detach()
        picture = torch.zeros(size, size, 3)
        picture[hit] = rgb
        color.append((255 * linear_to_srgb(picture)).round().to(torch.uint8))
        alpha.append(hit.float())
    names = [f"r_{v}" for v in range(views)]
    return Photos(Path("sphere"), names, torch.stack(color), torch.stack(alpha), cameras)
