"""A trained scene under new light, from the test views, an orbit or given cameras."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from univoxel import envmap as env
from univoxel.bars import bar
from univoxel.camera import Cameras, stacked
from univoxel.checkpoint import load_scene
from univoxel.data.images import write_exr, write_png
from univoxel.data.maps import read_map
from univoxel.errors import UserError
from univoxel.names import BOUNCES, ELEVATION, SAMPLES, Background, Ground
from univoxel.ops import PointLight, Sun
from univoxel.pictures.animation import require, write_animation
from univoxel.pictures.viewpoints import Frame, frames_of, views_of
from univoxel.records import Surface
from univoxel.render.frame import Picture, Quality, channels, render_picture, rgba, srgb
from univoxel.render.pipeline import extract_mesh, surface_of_view
from univoxel.render.relight import Lighting, TracedMesh, rotated, traced_mesh
from univoxel.scene import Scene

NO_MAP = "lights"  # name of light without a map


@dataclass(frozen=True)
class RelightOptions:
    """How relit pictures are made.

    Raises:
        UserError: a number is out of range.
    """

    # "test" for the test views of the data trained on, "orbit" or "orbit N" for N frames around
    # the object, a file in the form of transforms_test.json, or the cameras themselves
    cameras: str | Path | Cameras = "test"
    elevation: float = ELEVATION  # of an orbit's cameras, degrees in (-90, 90)
    turn: int | None = None  # frames of a turn of maps and suns, seen by the first camera; >= 1
    resolution: int | None = None  # pixels along the width; None: as the data's, an orbit's 512
    rotate: float = 0.0  # turns maps and suns counter-clockwise about +Z, degrees
    exposure: float = 1.0  # factor on all light, >= 0
    suns: Sequence[Sun] = ()  # besides the map
    point_lights: Sequence[PointLight] = ()  # besides the map
    samples: int = SAMPLES  # of the light, per pixel, >= 1; noise falls with their root or faster
    # Instead, samples until the relative noise that `render.relight.relight_until` defines is
    # below this, such as 0.02; > 0
    noise: float | None = None
    bounces: int = BOUNCES  # reflections between parts of the object, >= 0
    background: Background = "transparent"  # what stands behind; "map" is the light itself
    ground: Ground = None  # z of a floor that catches the shadow, or "lowest" for the lowest point

    def __post_init__(self) -> None:
        if not math.isfinite(self.rotate):
            raise UserError(f"relight: rotate must be finite, got {self.rotate}", "rotate")
        if not 0 <= self.exposure < math.inf:
            raise UserError(
                f"relight: exposure must be finite and at least 0, got {self.exposure}", "exposure"
            )
        self.quality()

    def quality(self) -> Quality:
        """How a frame is rendered; a ground at the lowest point is left to the mesh."""
        ground = None if self.ground == "lowest" else self.ground
        return Quality(self.samples, self.noise, self.bounces, self.background, ground)


def relight_to_files(
    run: str | Path,
    envmap: str | Path | Sequence[str | Path],
    out: str | Path,
    *,
    animation: Sequence[str] = (),
    resume: bool = False,
    progress: bool = True,
    **options: Any,
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
            An empty sequence leaves the suns and point lights.
        out: folder for the pictures.
        animation: "gif" or "mp4" or both: the frames as animation.gif and so on beside them.
        resume: keep frames whose two files are there already.
        progress: show a bar.
        options: fields of `RelightOptions`.

    Raises:
        UserError: the run, a map or the cameras cannot be used, or a number is out of range.
        MissingExtra: an MP4 without imageio-ffmpeg.
        OSError: a file cannot be read or written.
    """
    run, out, chosen = Path(run), Path(out), RelightOptions(**options)
    several = not isinstance(envmap, str | Path)
    paths = [Path(path) for path in envmap] if several else [Path(envmap)]
    if len({path.stem for path in paths}) != len(paths):
        raise UserError(
            "relight: expected environment maps of different names, got "
            f"{[str(path) for path in paths]}"
        )
    for kind in animation:
        require(kind)
    lights = {path.stem: lighting(path, chosen) for path in paths}
    if not paths:
        lights = {NO_MAP: lighting(None, chosen)}
    studio = _studio(run, chosen)
    frames = frames_of(studio.names, lights, chosen.turn)
    folders = {name: out / name if several and paths else out for name in lights}
    files = {frame: folders[frame.light] / frame.stem for frame in frames}
    missing = [f for f in frames if not (resume and all(p.is_file() for p in _pair(files[f])))]
    with bar(shown=progress) as shown:
        done = len(frames) - len(missing)
        task = shown.add_task("relighting", total=len(frames), completed=done)

        def report(share: float) -> None:
            shown.update(task, completed=done + share)

        for frame, picture in _pictures(studio, missing, lights, report):
            png, exr = _pair(files[frame])
            png.parent.mkdir(parents=True, exist_ok=True)
            write_exr(exr, channels(picture))
            write_png(png, srgb(picture))
    for name, folder in folders.items():
        pngs = [_pair(files[frame])[0] for frame in frames if frame.light == name]
        for kind in animation:
            write_animation(folder / f"animation.{kind}", pngs)


def relight_images(
    run: str | Path,
    envmap: str | Path | env.EnvMap | None = None,
    cameras: str | Path | Cameras = "test",
    **options: Any,
) -> Tensor:
    """Render a trained scene under new light: [F, H, W, 4] linear RGBA, premultiplied.

    Of cameras with pictures of differing sizes, the smaller ones have nothing but 0 below and to
    the right of them.

    Args:
        run: folder of the trained scene.
        envmap: a file, a map, or None for the suns and point lights alone.
        cameras, options: fields of `RelightOptions`.

    Raises:
        UserError: as of `relight_to_files`.
    """
    chosen = RelightOptions(cameras=cameras, **options)
    light = lighting(envmap, chosen)
    studio = _studio(Path(run), chosen)
    frames = frames_of(studio.names, [NO_MAP], chosen.turn)
    pictures = _pictures(studio, frames, {NO_MAP: light})
    return stacked([rgba(picture) for _, picture in pictures])


def lighting(
    envmap: str | Path | env.EnvMap | None, options: RelightOptions = RelightOptions()
) -> Lighting:
    """Light of a map, if any, suns and point lights; rotation and exposure go for all of it.

    Raises:
        DataError: the map cannot be used; the message names its file.
        UserError: there is no light.
    """
    suns, point_lights, exposure = options.suns, options.point_lights, options.exposure
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
    return rotated(lights, options.rotate)


@dataclass(frozen=True)
class _Studio:
    """What stays the same from frame to frame."""

    scene: Scene
    traced: TracedMesh
    names: list[str]  # of the views
    views: Cameras
    quality: Quality


def _studio(run: Path, options: RelightOptions) -> _Studio:
    """Load the scene and its mesh, and build the mesh's ray hierarchy."""
    scene = load_scene(run)
    mesh = extract_mesh(scene)
    names, views = views_of(run, options.cameras, options.resolution, options.elevation, mesh)
    quality = options.quality()
    if options.ground == "lowest":
        quality = replace(quality, ground=float(mesh.vertices[:, 2].min()))
    return _Studio(scene, traced_mesh(mesh, scene.field.voxel_size), names, views, quality)


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
                studio.traced,
                rotated(lights[frame.light], frame.turn),
                studio.quality,
                seed=frame.view,
                report=lambda share, number=number: report(number + share),
            ),
        )
        report(number + 1)


def _pair(stem: Path) -> tuple[Path, Path]:
    """The PNG and the EXR file of a frame; names may hold dots."""
    return stem.with_name(f"{stem.name}.png"), stem.with_name(f"{stem.name}.exr")
