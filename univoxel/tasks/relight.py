"""A trained scene under new light, from the test views, an orbit or given cameras."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import torch
from rich.progress import Progress
from torch import Tensor

from univoxel import envmap as env
from univoxel.camera import Cameras
from univoxel.checkpoint import load_scene
from univoxel.data.images import write_exr, write_png
from univoxel.data.maps import read_map
from univoxel.errors import UserError
from univoxel.ops import Lamp, Sun
from univoxel.pictures.animation import require, write_animation
from univoxel.pictures.viewpoints import ELEVATION, Frame, frames_of, views_of
from univoxel.records import Surface
from univoxel.render.frame import Background, Picture, Quality, channels, render_picture, rgba, srgb
from univoxel.render.pipeline import extract_mesh, surface_of_view
from univoxel.render.relight import Lighting, Stage, stage, turned
from univoxel.scene import Scene

NO_MAP = "lights"  # name of light without a map
Ground = float | Literal["lowest"] | None


def relight(
    run: Path,
    envmap: Path | Sequence[Path],
    out: Path,
    *,
    cameras: str | Path = "test",
    elevation: float = ELEVATION,
    turn: int | None = None,
    resolution: int | None = None,
    rotate: float = 0.0,
    exposure: float = 1.0,
    suns: Sequence[Sun] = (),
    lamps: Sequence[Lamp] = (),
    samples: int = 64,
    noise: float | None = None,
    bounces: int = 2,
    background: Background = "transparent",
    ground: Ground = None,
    animation: Sequence[str] = (),
    resume: bool = False,
    progress: bool = True,
) -> None:
    """Render a trained scene under new light, a PNG and an EXR file per frame.

    The PNG is sRGB, clipped at 1; over a transparent background its alpha is straight and holds
    the ground's shadow. The EXR holds half floats: rgb.* linear, composited on the background
    (premultiplied where that is transparent); albedo.* linear and composited on black; normal.*
    (world) and depth along -Z, 0 where nothing is; alpha of the object; with a ground, shadow.
    Over a plate: rgb + (1 - alpha) (1 - shadow) plate. Files appear whole or not at all.

    Args:
        run: folder of the trained scene.
        envmap: an equirectangular map, or several: each then gets a folder of its name in `out`.
            An empty sequence leaves the suns and lamps.
        out: folder for the pictures.
        cameras: "test" for the test views of the data trained on, "orbit" or "orbit N" for N frames
            around the object, else a file in the form of transforms_test.json.
        elevation: of an orbit's cameras, degrees in (-90, 90).
        turn: frames of a turn of the light, maps and suns, seen by the first camera.
        resolution: pixels along the width; as in the data when left out (an orbit: 512).
        rotate: turns the maps and suns counter-clockwise about +Z, degrees.
        exposure: factor on all light.
        suns, lamps: lights besides the map.
        samples: light samples per pixel; noise falls with the root of it or faster.
        noise: instead, samples until the relative noise that `render.relight.relight_until` defines
            is below this, such as 0.02.
        bounces: reflections between parts of the object, 0 for direct light only.
        background: what stands behind the object; "map" is the light itself.
        ground: z of a floor that catches the object's shadow, or "lowest" for its lowest point.
        animation: "gif" or "mp4" or both: the frames as animation.gif and so on beside them.
        resume: keep frames whose two files are there already.
        progress: show a bar.

    Raises:
        UserError: the run, a map or the cameras cannot be used, or a number is out of
            range.
        MissingExtra: an MP4 without imageio-ffmpeg.
        OSError: a file cannot be read or written.
    """
    several = not isinstance(envmap, (str, Path))
    paths = [Path(path) for path in envmap] if several else [Path(envmap)]
    if len({path.stem for path in paths}) != len(paths):
        raise UserError(
            "relight: expected environment maps of different names, got "
            f"{[str(path) for path in paths]}"
        )
    for kind in animation:
        require(kind)
    light = {"rotate": rotate, "exposure": exposure, "suns": suns, "lamps": lamps}
    lights = {path.stem: lighting(path, **light) for path in paths}
    if not paths:
        lights = {NO_MAP: lighting(None, **light)}
    quality = Quality(samples, noise, bounces, background)
    studio = _studio(run, cameras, resolution, elevation, quality, ground)
    frames = frames_of(studio.names, lights, turn)
    folders = {name: out / name if several and paths else out for name in lights}
    files = {frame: folders[frame.light] / frame.stem for frame in frames}
    missing = [f for f in frames if not (resume and all(p.is_file() for p in _pair(files[f])))]
    with Progress(disable=not progress) as bar:
        task = bar.add_task("relighting", total=len(frames), completed=len(frames) - len(missing))

        def report(share: float) -> None:
            bar.update(task, completed=len(frames) - len(missing) + share)

        for frame, made in _pictures(studio, missing, lights, report):
            png, exr = _pair(files[frame])
            png.parent.mkdir(parents=True, exist_ok=True)
            write_exr(exr, channels(made))
            write_png(png, srgb(made))
    for name, folder in folders.items():
        shown = [_pair(files[frame])[0] for frame in frames if frame.light == name]
        for kind in animation:
            write_animation(folder / f"animation.{kind}", shown)


def images(
    run: Path | str,
    envmap: Path | str | env.EnvMap | None = None,
    cameras: Path | str | Cameras = "test",
    *,
    elevation: float = ELEVATION,
    turn: int | None = None,
    resolution: int | None = None,
    rotate: float = 0.0,
    exposure: float = 1.0,
    suns: Sequence[Sun] = (),
    lamps: Sequence[Lamp] = (),
    samples: int = 64,
    noise: float | None = None,
    bounces: int = 2,
    background: Background = "transparent",
    ground: Ground = None,
) -> Tensor:
    """Render a trained scene under new light: [F, H, W, 4] linear RGBA, premultiplied.

    Arguments and errors as of `relight`, and besides:

    Args:
        envmap: a file, a map, or None for the suns and lamps alone.
        cameras: as of `relight`, or the cameras themselves.
    """
    light = lighting(envmap, rotate=rotate, exposure=exposure, suns=suns, lamps=lamps)
    quality = Quality(samples, noise, bounces, background)
    studio = _studio(Path(run), cameras, resolution, elevation, quality, ground)
    frames = frames_of(studio.names, [NO_MAP], turn)
    return torch.stack([rgba(made) for _, made in _pictures(studio, frames, {NO_MAP: light})])


def lighting(
    envmap: Path | str | env.EnvMap | None,
    *,
    rotate: float = 0.0,
    exposure: float = 1.0,
    suns: Sequence[Sun] = (),
    lamps: Sequence[Lamp] = (),
) -> Lighting:
    """Light of a map, if any, suns and lamps; rotation and exposure go for all of it.

    Raises:
        DataError: the map cannot be used; the message names its file.
        UserError: there is no light, or a number is out of range.
    """
    if envmap is None and not suns and not lamps:
        raise UserError("relight: expected an environment map, a sun or a point light, got none")
    if not math.isfinite(rotate):
        raise UserError(f"relight: rotate must be finite, got {rotate}", "rotate")
    if not 0 <= exposure < math.inf:
        raise UserError(
            f"relight: exposure must be finite and at least 0, got {exposure}", "exposure"
        )
    if envmap is None:
        envmap = env.EnvMap(torch.zeros(1, 2, 3))
    elif not isinstance(envmap, env.EnvMap):
        envmap = read_map(Path(envmap))
    times = lambda power: tuple(exposure * x for x in power)  # noqa: E731
    lights = Lighting(
        env.tables(replace(envmap, exposure=exposure * envmap.exposure)),
        tuple(replace(sun, irradiance=times(sun.irradiance)) for sun in suns),
        tuple(replace(lamp, intensity=times(lamp.intensity)) for lamp in lamps),
    )
    return turned(lights, rotate)


@dataclass(frozen=True)
class _Studio:
    """What stays the same from frame to frame."""

    scene: Scene
    stage: Stage
    names: list[str]  # of the views
    views: Cameras
    quality: Quality


def _studio(
    run: Path,
    cameras: Path | str | Cameras,
    resolution: int | None,
    elevation: float,
    quality: Quality,
    ground: Ground,
) -> _Studio:
    """Load the scene and its mesh, and build the mesh's ray hierarchy."""
    scene = load_scene(run)
    mesh = extract_mesh(scene)
    names, views = views_of(run, cameras, resolution, elevation, mesh)
    if ground == "lowest":
        ground = float(mesh.vertices[:, 2].min())
    quality = replace(quality, ground=ground)
    return _Studio(scene, stage(mesh, scene.field.voxel_size), names, views, quality)


def _pictures(
    studio: _Studio,
    frames: Sequence[Frame],
    lights: dict[str, Lighting],
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
                studio.stage,
                turned(lights[frame.light], frame.turn),
                studio.quality,
                seed=frame.view,
                report=lambda share, number=number: report(number + share),
            ),
        )
        report(number + 1)


def _pair(stem: Path) -> tuple[Path, Path]:
    """The PNG and the EXR file of a frame; names may hold dots."""
    return stem.with_name(f"{stem.name}.png"), stem.with_name(f"{stem.name}.exr")
