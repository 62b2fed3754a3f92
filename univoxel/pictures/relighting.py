"""A scene under new light, frame after frame, and the light."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from univoxel import envmap as env
from univoxel.camera import Cameras
from univoxel.checkpoint import load_scene
from univoxel.data.maps import read_map
from univoxel.errors import UserError
from univoxel.ops import PointLight, Sun
from univoxel.pictures.viewpoints import Frame, views_of
from univoxel.records import Surface
from univoxel.render.frame import Picture, Quality, render_picture
from univoxel.render.pipeline import extract_mesh, surface_of_view
from univoxel.render.relight import Lighting, TracedMesh, rotated, traced_mesh
from univoxel.scene import Scene


def lighting(
    envmap: str | Path | env.EnvMap | None,
    suns: Sequence[Sun] = (),
    point_lights: Sequence[PointLight] = (),
    rotate: float = 0.0,
    exposure: float = 1.0,
) -> Lighting:
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
    lights = Lighting(
        env.tables(replace(envmap, exposure=exposure * envmap.exposure)),
        tuple(replace(sun, irradiance=times(sun.irradiance)) for sun in suns),
        tuple(replace(light, intensity=times(light.intensity)) for light in point_lights),
    )
    return rotated(lights, rotate)


@dataclass(frozen=True)
class Studio:
    """What stays the same from frame to frame."""

    scene: Scene
    traced: TracedMesh
    names: list[str]  # of the views
    views: Cameras


def open_studio(
    run: Path, cameras: str | Path | Cameras, resolution: int | None, elevation: float
) -> Studio:
    """Load the scene and its mesh, and build the mesh's ray hierarchy; views as of `views_of`."""
    scene = load_scene(run)
    mesh = extract_mesh(scene)
    names, views = views_of(run, cameras, resolution, elevation, mesh)
    return Studio(scene, traced_mesh(mesh, scene.field.voxel_size), names, views)


def pictures_of(
    studio: Studio,
    frames: Sequence[Frame],
    lights: dict[str, Lighting],
    quality: Quality,
    report: Callable[[float], None] = lambda done: None,
) -> Iterator[tuple[Frame, Picture]]:
    """Frames and their pictures; report is called with the number done, parts of one included."""
    seen: tuple[int, Surface, Tensor] | None = None
    for number, frame in enumerate(frames):
        if seen is None or seen[0] != frame.view:
            seen = (frame.view, *surface_of_view(studio.scene, studio.views, frame.view))
        yield (
            frame,
            render_picture(
                *seen[1:],
                studio.views,
                frame.view,
                studio.traced,
                rotated(lights[frame.light], frame.turn),
                quality,
                seed=frame.view,
                report=lambda share, number=number: report(number + share),
            ),
        )
        report(number + 1)
