"""Cameras of relit frames (test views, an orbit, a path from a file) and the frames."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from univoxel import envmap as env
from univoxel.camera import Cameras, resize
from univoxel.core.choices import ELEVATION
from univoxel.core.records import AlbedoNear, Mesh, Surface
from univoxel.data import load_cameras
from univoxel.envmap import read_map
from univoxel.errors import UserError
from univoxel.ops import PointLight, Sun
from univoxel.render import relight
from univoxel.render.pipeline import extract_mesh, surface_of_view
from univoxel.run import load_world, photos_of
from univoxel.scene import Scene, load_scene

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
        turn: frames of a turn of the light seen by the first camera only; None for every camera
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
    """Cameras on a circle around a mesh that see all of it, counter-clockwise from `start`, degrees
    from +X."""
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
    run: Path, cameras: str | Path | Cameras, resolution: int | None, elevation: float, mesh: Mesh
) -> tuple[list[str], Cameras]:
    """Names of the views, and their cameras; arguments as in `cli.relight.RelightOptions`, which a
    UserError refuses."""
    if resolution is not None and resolution < 1:
        raise UserError(f"relight: resolution must be at least 1, got {resolution}", "resolution")
    if isinstance(cameras, Cameras):
        names = [f"{i:04d}" for i in range(len(cameras))]
        return names, resize(cameras, resolution or cameras.width)
    word, _, count = str(cameras).partition(" ")
    if word == "orbit":
        if count and not (count.isdigit() and int(count)):
            raise UserError(
                f"relight: cameras: expected orbit, or orbit N for N frames, got {str(cameras)!r}",
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
        names, views = load_cameras(cameras, ORBIT_SIZE, load_world(run))
    return names, resize(views, resolution or views.width)


# A scene under new light, frame after frame, and the light.


def lighting(
    envmap: str | Path | env.EnvMap | None,
    suns: Sequence[Sun] = (),
    point_lights: Sequence[PointLight] = (),
    rotate: float = 0.0,
    exposure: float = 1.0,
) -> relight.Lighting:
    """Light of a map, if any, suns and point lights.

    Args:
        rotate: turns all of it counter-clockwise about +Z, degrees.
        exposure: factor on all of it, >= 0.

    Raises:
        DataError: the map cannot be used; the message names its file.
        UserError: there is no light.
    """
    if envmap is None and not suns and not point_lights:
        raise UserError("relight: expected an environment map, a sun or a point light, got none")
    if envmap is None:
        envmap = env.EnvMap(torch.zeros(1, 2, 3))
    elif not isinstance(envmap, env.EnvMap):
        envmap = read_map(Path(envmap))
    times = lambda power: tuple(exposure * x for x in power)  # noqa: E731
    lights = relight.Lighting(
        env.tables(replace(envmap, exposure=exposure * envmap.exposure)),
        tuple(replace(sun, irradiance=times(sun.irradiance)) for sun in suns),
        tuple(replace(light, intensity=times(light.intensity)) for light in point_lights),
    )
    return relight.rotated(lights, rotate)


@dataclass(frozen=True)
class Studio:
    """What stays the same from frame to frame."""

    scene: Scene
    traced: relight.TracedMesh
    names: list[str]  # of the views
    views: Cameras
    albedo_near: AlbedoNear | None = None  # what gives the albedo, in place of the field


def open_studio(
    run: Path, cameras: str | Path | Cameras, resolution: int | None, elevation: float
) -> Studio:
    """Load the scene and its mesh, and build the mesh's ray hierarchy; views as in `views_of`."""
    scene = load_scene(run)
    mesh = extract_mesh(scene)
    names, views = views_of(run, cameras, resolution, elevation, mesh)
    return Studio(scene, relight.traced_mesh(mesh, scene.field.voxel_size), names, views)


def pictures_of(
    studio: Studio,
    frames: Sequence[Frame],
    lights: dict[str, relight.Lighting],
    quality: relight.Quality,
    report: Callable[[float], None] = lambda done: None,
) -> Iterator[tuple[Frame, relight.Picture]]:
    """Frames and their pictures; report is called with the number done, parts of one included."""
    seen: tuple[int, Surface, Tensor] | None = None
    for number, frame in enumerate(frames):
        if seen is None or seen[0] != frame.view:
            found = surface_of_view(studio.scene, studio.views, frame.view, studio.albedo_near)
            seen = (frame.view, *found)
        picture = relight.render_picture(
            *seen[1:],
            studio.views,
            frame.view,
            studio.traced,
            relight.rotated(lights[frame.light], frame.turn),
            quality,
            seed=frame.view,
            report=lambda share, number=number: report(number + share),
        )
        yield frame, picture
        report(number + 1)
