"""Cameras of relit frames: test views, an orbit, a path from a file; and the frames they make."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import torch

from univoxel.camera import Cameras, resize
from univoxel.data import load_cameras
from univoxel.errors import UserError
from univoxel.names import ELEVATION
from univoxel.records import Mesh
from univoxel.run import photos_of

ORBIT_FRAMES = 60
VIEW_ANGLE = 40.0  # degrees, of an orbit's cameras
ORBIT_SIZE = 512  # pixels along an orbit's pictures
MARGIN = 1.05  # room that an orbit leaves around the object


@dataclass(frozen=True)
class Frame:
    """One picture to make."""

    stem: str  # of its files
    view: int  # which camera
    light: str  # which map, by name
    turn: float = 0.0  # of the light, degrees counter-clockwise about +Z


def frames_of(names: list[str], lights: Iterable[str], turn: int | None) -> list[Frame]:
    """Frames by view, so that a view's surface serves all its lights.

    Args:
        turn: frames of a turn of the light seen by the first camera alone; None for every camera
            under still light.
    """
    if turn is not None and turn < 1:
        raise UserError(f"relight: turn must be at least 1 frame, got {turn}", "turn")
    if turn is None:
        return [Frame(name, view, light) for view, name in enumerate(names) for light in lights]
    return [
        Frame(f"turn_{i:04d}", 0, light, 360 * i / turn) for i in range(turn) for light in lights
    ]


def orbit(
    mesh: Mesh, frames: int, size: int, elevation: float = ELEVATION, start: float = 0.0
) -> Cameras:
    """Cameras on a circle around a mesh that see all of it, counter-clockwise.

    Args:
        start: azimuth of the first, degrees from +X.
    """
    low, high = mesh.vertices.amin(0), mesh.vertices.amax(0)
    middle = (low + high) / 2
    radius = MARGIN * (mesh.vertices - middle).norm(dim=1).max()
    half = math.radians(VIEW_ANGLE / 2)
    phi = math.radians(start) + 2 * math.pi * torch.arange(frames) / frames
    up = torch.full_like(phi, math.radians(elevation))
    back = torch.stack([up.cos() * phi.cos(), up.cos() * phi.sin(), up.sin()], -1)
    right = torch.stack([-phi.sin(), phi.cos(), torch.zeros_like(phi)], -1)
    position = middle + back * radius / math.sin(half)
    pose = torch.stack([right, torch.linalg.cross(back, right), back, position], -1)
    focal = torch.full((frames, 2), size / 2 / math.tan(half))
    return Cameras(pose, focal, torch.full((frames, 2), size / 2), size, size)


def views_of(
    run: Path,
    cameras: str | Path | Cameras,
    resolution: int | None,
    elevation: float,
    mesh: Mesh,
) -> tuple[list[str], Cameras]:
    """Names of the views, and their cameras; arguments as of `cli.relight.RelightOptions`.

    Raises:
        UserError: the cameras cannot be used.
    """
    if resolution is not None and resolution < 1:
        raise UserError(f"relight: resolution must be at least 1, got {resolution}", "resolution")
    if isinstance(cameras, Cameras):
        names = [f"{i:04d}" for i in range(len(cameras))]
        return names, resize(cameras, resolution or cameras.width)
    word, _, count = str(cameras).partition(" ")
    if word == "orbit":
        if count and not (count.isdigit() and int(count)):
            raise UserError(
                f"relight: cameras: expected orbit or orbit N, N frames, got {str(cameras)!r}",
                "cameras",
            )
        if not -90 < elevation < 90:
            raise UserError(
                f"relight: elevation must be in (-90, 90) degrees, got {elevation}", "elevation"
            )
        frames = int(count or ORBIT_FRAMES)
        names = [f"orbit_{i:04d}" for i in range(frames)]
        return names, orbit(mesh, frames, resolution or ORBIT_SIZE, elevation)
    if word == "test":
        photos = photos_of(run)
        names, views = photos.names, photos.cameras
    else:
        names, views = load_cameras(cameras, ORBIT_SIZE)
    return names, resize(views, resolution or views.width)
