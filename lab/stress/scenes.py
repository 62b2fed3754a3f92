"""Scenes of the stress suite: an object, cameras around it, the light, and the truth of a view."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from lab.stress.shapes import Part, build
from univoxel.camera import Cameras, pixel_rays
from univoxel.ops import VisibilityScene
from univoxel.sphere import latlong_directions, texel_solid_angles

DISTANCE = 3.0  # of the cameras from what they look at
VIEW_DEGREES = 36.0  # across a picture: a ball of radius 0.92 about the middle is seen whole
HEIGHTS = {"box": (0.4, 0.95)}  # z of the directions to the cameras; a box is looked into
OTHER_HEIGHTS = (-0.4, 0.95)
RING_HEIGHTS = (0.0, 0.7)
MAP_HEIGHT = 128  # of environment maps
RELIGHT = ("dusk", "studio")  # maps of the relit test views
BRIGHTNESS = 1.0  # irradiance over pi from above, of every map
SUN_SHARPNESS = 1100.0  # of exp(s (cos - 1)): 4 degrees across at half its height
GRID = 3  # the truth of a pixel is the mean over GRID x GRID rays
POINTS = 20000


@dataclass(frozen=True)
class Spec:
    """What a rendered scene is; renderings of equal specs are equal but for noise."""

    shape: str = "figure"
    amount: float = 0.0  # see shapes.build
    roughness: float = 0.6
    metals: int = 0
    sun: float = 0.0  # share of the light's power that comes from a small sun, in [0, 1)
    shift: float = 0.0  # how far the object is from where the cameras to train on look, world units
    light: str = "room"  # that the photographs are taken in: room or dusk
    rings: int = 0  # heights of cameras in level rings; 0: they are spread over a sphere
    turning: bool = False  # whether the light turns with the camera, as on a turntable
    views: int = 40  # to train on
    tests: int = 6  # 0: photographs to train on alone
    size: int = 96  # pixels
    samples: int = 24  # paths per pixel; test views take more


def parts_of(spec: Spec) -> list[Part]:
    return build(spec.shape, spec.amount, spec.roughness, spec.metals)


def train_cameras(spec: Spec) -> Cameras:
    """Cameras on a sphere, of which the first of many are as evenly spread as all; or in rings."""
    index = np.arange(spec.views)
    if spec.rings:
        place, ring = index // spec.rings, index % spec.rings
        share = (ring + 0.5) / spec.rings
        turn = 2 * math.pi * (place + ring / spec.rings) / (spec.views / spec.rings)
        return _cameras(spec, share, turn, np.zeros(3))
    share = np.array([int(f"{i:032b}"[::-1], 2) / 2**32 for i in index])  # van der Corput
    away = spec.shift * np.array([1.0, 1.0, 1.0]) / math.sqrt(3)
    return _cameras(spec, share, index * math.pi * (3 - math.sqrt(5)), -away)


def test_cameras(spec: Spec) -> Cameras:
    """Cameras between those to train on, that see the object in the middle."""
    index = np.arange(spec.tests)
    return _cameras(spec, (index + 0.5) / max(spec.tests, 1), 0.7 + 2.4 * index, np.zeros(3))


def light_azimuths(spec: Spec, cameras: Cameras) -> np.ndarray | None:
    """How far the light of the photographs has turned about +Z, radians [V], since the first of
    those to train on; None: it stands still."""
    if not spec.turning:
        return None
    x, y, _ = cameras.camera_to_world[:, :, 3].double().numpy().T
    first, other, _ = train_cameras(spec).camera_to_world[0, :, 3].double().numpy()
    return np.arctan2(y, x) - np.arctan2(other, first)


def radiance(name: str, direction: np.ndarray, sun: float = 0.0) -> np.ndarray:
    """Light [..., 3] from unit directions [..., 3]: room, dusk or studio."""
    grid = latlong_directions(64).double().numpy()
    weight = texel_solid_angles(64, 128).double().numpy()[..., None]
    above = _soft_light(name, grid) * np.maximum(grid[..., 2:], 0) * weight
    scale = BRIGHTNESS * math.pi / above.sum((0, 1)).mean()
    found = scale * _soft_light(name, direction)
    if not sun:
        return found
    power = scale * (_soft_light(name, grid) * weight).sum((0, 1)).mean()
    towards = unit_direction(60, 50)
    peak = power * SUN_SHARPNESS / (2 * math.pi) * np.array([1.1, 1.0, 0.85])
    shape = np.exp(SUN_SHARPNESS * (direction @ towards - 1))[..., None]
    return (1 - sun) * found + sun * peak * shape


def environment(spec: Spec, name: str, poles: bool = False) -> np.ndarray:
    """A map [H, 2H, 3] float32, as in docs/reference/conventions.md.

    Args:
        poles: whether its first and last row lie on the poles.
    """
    sun = spec.sun if name == spec.light else 0.0
    return radiance(name, directions_of_map(MAP_HEIGHT, poles), sun).astype(np.float32)


def directions_of_map(height: int, poles: bool) -> np.ndarray:
    """Unit directions [H, 2H, 3] of a map's texels; `poles` as in `environment`."""
    if not poles:
        return latlong_directions(height).double().numpy()
    theta = math.pi / 2 - math.pi * np.arange(height) / (height - 1)
    phi = math.pi - math.pi * (np.arange(2 * height) + 0.5) / height
    t, p = np.meshgrid(theta, phi, indexing="ij")
    return np.stack([np.cos(t) * np.cos(p), np.cos(t) * np.sin(p), np.sin(t)], -1)


def truth_of_view(parts: Sequence[Part], cameras: Cameras, view: int) -> dict[str, np.ndarray]:
    """Means over the rays of each pixel, as test/gt/NAME.npz has them.

    Returns:
        alpha uint8 [H, W]; albedo [H, W, 3] linear base colour; roughness and metallic [H, W];
        normal [H, W, 3] unit; depth [H, W] along -Z; float16, 0 where nothing is; and part uint8
        [H, W], the number of the one that the middle of the pixel shows, or 255.
    """
    mesh = joined(parts)
    height, width = cameras.height, cameras.width
    y, x, j, i = torch.meshgrid(
        *(torch.arange(n) for n in (height, width, GRID, GRID)), indexing="ij"
    )
    pixel = torch.stack([x + (i + 0.5) / GRID, y + (j + 0.5) / GRID], -1).reshape(-1, 2).float()
    rays = pixel_rays(cameras, torch.full((len(pixel),), view), pixel)
    hit = VisibilityScene(mesh["vertices"], mesh["faces"]).closest_hit(rays.origin, rays.direction)
    met = hit.face >= 0
    corner = mesh["faces"].long()[hit.face.clamp_min(0)]
    u, v = hit.barycentric.unbind(1)
    weight = torch.stack([1 - u - v, u, v], 1)[..., None]
    cosine = -rays.direction @ cameras.camera_to_world[view, :, 2]
    values = {
        "albedo": (weight * mesh["base"][corner]).sum(1),
        "normal": (weight * mesh["normals"][corner]).sum(1),
        "roughness": (weight * mesh["roughness"][corner]).sum(1),
        "metallic": (weight * mesh["metallic"][corner]).sum(1),
        "depth": (hit.t * cosine)[:, None],
    }
    share = met.float().reshape(height, width, -1).mean(2)

    def mean(value: Tensor) -> Tensor:
        total = (
            torch.where(met[:, None], value, 0.0).reshape(height, width, GRID * GRID, -1).mean(2)
        )
        return total / share.clamp_min(1e-6)[..., None]

    found = {key: mean(value) for key, value in values.items()}
    found["normal"] = torch.nn.functional.normalize(found["normal"], dim=-1)
    arrays = {key: value.squeeze(-1).half().numpy() for key, value in found.items()}
    part = torch.where(met, mesh["part"][corner[:, 0], 0], 255.0)
    part = part.reshape(height, width, -1)[..., GRID * GRID // 2]
    whole = {"alpha": (255 * share).round(), "part": part}
    return arrays | {key: value.to(torch.uint8).numpy() for key, value in whole.items()}


def surface_points(parts: Sequence[Part], count: int = POINTS) -> np.ndarray:
    """Points [P, 3] float32 on what can be seen of the surface from far away, by area."""
    mesh = joined(parts)
    corners = mesh["vertices"][mesh["faces"].long()]
    normal = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    generator = torch.Generator().manual_seed(0)
    face = torch.multinomial(normal.norm(dim=1), 2 * count, True, generator=generator)
    u, v = torch.rand(2, 2 * count, generator=generator)
    flip = u + v > 1
    u, v = torch.where(flip, 1 - u, u), torch.where(flip, 1 - v, v)
    a, b, c = corners[face].unbind(1)
    points = a + u[:, None] * (b - a) + v[:, None] * (c - a)
    # Parts are in one another: what no ray leaves is inside
    scene = VisibilityScene(mesh["vertices"], mesh["faces"])
    start = points + 1e-3 * torch.nn.functional.normalize(normal[face], dim=1)
    seen = torch.zeros(len(points), dtype=torch.bool)
    for _ in range(32):
        way = torch.nn.functional.normalize(torch.randn(len(points), 3, generator=generator), dim=1)
        way = torch.where((way * normal[face]).sum(1, keepdim=True) < 0, -way, way)
        seen |= scene.closest_hit(start, way).face < 0
    return points[seen][:count].numpy()


def joined(parts: Sequence[Part]) -> dict[str, Tensor]:
    """All parts as one mesh: vertices, normals, base [P, 3], roughness, metallic, and part, the
    index of each vertex's [P, 1], faces [F, 3]."""
    starts = np.cumsum([0, *(len(p.vertices) for p in parts[:-1])])
    faces = np.concatenate([p.faces + s for p, s in zip(parts, starts, strict=True)])

    def values(each: Sequence[float | np.ndarray]) -> np.ndarray:
        full = [
            np.broadcast_to(np.float32(v), len(p.vertices))
            for p, v in zip(parts, each, strict=True)
        ]
        return np.concatenate(full)[:, None]

    arrays = {
        key: np.concatenate([getattr(p, key) for p in parts])
        for key in ("vertices", "normals", "base")
    }
    arrays |= {key: values([getattr(p, key) for p in parts]) for key in ("roughness", "metallic")}
    arrays |= {"part": values(range(len(parts))), "faces": faces.astype(np.int32)}
    return {key: torch.from_numpy(value) for key, value in arrays.items()}


def _cameras(spec: Spec, share: np.ndarray, phi: np.ndarray, target: np.ndarray) -> Cameras:
    low, high = RING_HEIGHTS if spec.rings else HEIGHTS.get(spec.shape, OTHER_HEIGHTS)
    z = low + (high - low) * share
    r = np.sqrt(1 - z**2)
    back = np.stack([r * np.cos(phi), r * np.sin(phi), z], -1)
    return looking(back, target + DISTANCE * back, spec.size)


def looking(back: np.ndarray, place: np.ndarray, size: int) -> Cameras:
    """Cameras at places [V, 3] that look against unit directions back [V, 3], with +Z upwards."""
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right, axis=-1, keepdims=True)
    pose = np.stack([right, np.cross(back, right), back, place], -1)
    focal = size / 2 / math.tan(math.radians(VIEW_DEGREES / 2))
    return Cameras(
        torch.from_numpy(pose.astype(np.float32)),
        torch.full((len(pose), 2), focal),
        torch.full((len(pose), 2), size / 2),
        size,
        size,
    )


def _soft_light(name: str, direction: np.ndarray) -> np.ndarray:
    """Light without a sun, of any brightness."""
    z = direction[..., 2:]

    def window(azimuth: float, elevation: float, half: tuple[float, float], color) -> np.ndarray:
        """A bright rectangle with soft edges; degrees."""
        phi = np.degrees(np.arctan2(direction[..., 1], direction[..., 0]))
        across = np.abs((phi - azimuth + 180) % 360 - 180) - half[0]
        along = np.abs(np.degrees(np.arcsin(np.clip(z[..., 0], -1, 1))) - elevation) - half[1]
        edges = np.clip(0.5 - across / 4, 0, 1) * np.clip(0.5 - along / 4, 0, 1)
        return edges[..., None] * np.array(color)

    def gradient(low, high) -> np.ndarray:
        return np.array(low) + (np.array(high) - np.array(low)) * np.clip(0.5 + 0.5 * z, 0, 1)

    match name:
        case "room":
            windows = window(40, 35, (18, 18), [9.0, 8.6, 8.0])
            windows = windows + window(200, 20, (12, 22), [5.0, 5.6, 6.4])
            return gradient([0.25, 0.21, 0.18], [0.55, 0.65, 0.8]) + windows
        case "dusk":
            glow = np.exp(12 * (direction @ unit_direction(-70, 12) - 1))[..., None]
            return gradient([0.1, 0.08, 0.08], [0.2, 0.3, 0.5]) + glow * np.array([6.0, 3.4, 1.6])
        case "studio":
            boxes = window(120, 50, (25, 20), [8.0, 8.0, 8.0])
            boxes = boxes + window(-20, 10, (10, 30), [2.0, 3.0, 5.0])
            return gradient([0.12, 0.12, 0.12], [0.2, 0.2, 0.2]) + boxes
        case _:
            raise ValueError(f"light must be room, dusk or studio, got {name!r}")


def unit_direction(azimuth: float, elevation: float) -> np.ndarray:
    """Direction of degrees from +X and above the horizon."""
    a, e = math.radians(azimuth), math.radians(elevation)
    return np.array([math.cos(e) * math.cos(a), math.cos(e) * math.sin(a), math.sin(e)])
