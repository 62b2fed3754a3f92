"""Render a trained scene under new light, from the test views, an orbit or given cameras."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from univoxel.cli.parsing import ADVANCED, Run, takes, written
from univoxel.core.choices import BOUNCES, ELEVATION, SAMPLES, Animation, Background, Ground
from univoxel.errors import UserError, demand

if TYPE_CHECKING:
    from torch import Tensor

    from univoxel.camera import Cameras
    from univoxel.envmap import EnvMap
    from univoxel.ops import PointLight, Sun
    from univoxel.output.viewpoints import Studio
    from univoxel.render.relight import Lighting, Quality

NO_MAP = "lights"  # name of light without a map


@dataclass(frozen=True, kw_only=True)
class Where:
    """The run and its light, and where to write the images."""

    run: Run
    """folder of a trained run"""
    envmap: Annotated[tuple[Path, ...], written("MAP [MAP ...]", "none")] = ()
    """equirectangular environment maps, .exr or .hdr, in linear radiance"""
    out: Annotated[Path | None, written("DIR", "in RUN/relight")] = None
    """folder to write to, with a subfolder for each map if there are several"""


@dataclass(frozen=True, kw_only=True)
class RelightOptions:
    """How images are relit; a UserError for a number out of range."""

    # In the library the first four may be objects too: `Sun`, `PointLight`, `Cameras`, a number
    suns: Annotated[
        tuple[tuple[float, ...], ...],
        written("AZIMUTH ELEVATION IRRADIANCE [ANGLE]", name="sun", repeatable=True),
    ] = ()
    """distant light; angles in degrees; ANGLE: its diameter, default 0.53; repeatable"""
    point_lights: Annotated[
        tuple[tuple[float, float, float, float], ...],
        written("X Y Z INTENSITY", name="point", repeatable=True),
    ] = ()
    """point light at X Y Z; INTENSITY is its irradiance at distance 1; repeatable"""
    cameras: Annotated[str, written("test|orbit|FILE")] = "test"
    """test views, an orbit around the object, or a path from a transforms.json"""
    ground: Annotated[str | None, written("lowest|HEIGHT")] = None
    """add a floor that receives shadows, at this height or at the lowest point"""
    elevation: Annotated[float, written("DEGREES", advanced=True)] = ELEVATION
    """elevation of an orbit above the horizon"""
    turn: Annotated[int | None, written("FRAMES", advanced=True)] = None
    """use the first camera, and rotate the light once around in this many frames"""
    resolution: Annotated[int | None, written("PIXELS", "as photographed; orbits: 512")] = None
    """width of the images"""
    rotate: Annotated[float, written("DEGREES", advanced=True)] = 0.0
    """rotate maps and suns counter-clockwise about +Z"""
    exposure: Annotated[float, written("FACTOR", advanced=True)] = 1.0
    """multiply all light by this factor"""
    samples: int = SAMPLES
    """light samples per pixel"""
    noise: Annotated[float | None, written("SHARE", advanced=True)] = None
    """instead of --samples: add samples until the relative noise is below SHARE"""
    bounces: Annotated[int, ADVANCED] = BOUNCES
    """number of reflections between parts of the object"""
    background: Background = "transparent"
    """background of the images"""

    def __post_init__(self) -> None:
        demand(math.isfinite(self.rotate), "rotate", "finite", self.rotate)
        bright = 0 <= self.exposure < math.inf
        demand(bright, "exposure", "finite and at least 0", self.exposure)

    def quality(self) -> Quality:
        """How a frame is rendered; a ground at the lowest point is left to the mesh. Numbers out of
        range are a UserError."""
        from univoxel.render.relight import Quality

        ground = parse_ground(self.ground)
        ground = None if ground == "lowest" else ground
        return Quality(self.samples, self.noise, self.bounces, self.background, ground)

    def lighting(self, envmap: str | Path | EnvMap | None) -> Lighting:
        """All light, that of a map too, if there is one. A UserError if there is none, or a number
        or the map cannot be used."""
        from univoxel.output.viewpoints import lighting

        suns = [sun_light(values) for values in self.suns]
        point_lights = [point_light(values) for values in self.point_lights]
        return lighting(envmap, suns, point_lights, self.rotate, self.exposure)

    def studio(self, run: Path) -> tuple[Studio, Quality]:
        """The scene of a run, ready for frames, and how they are rendered."""
        from univoxel.detail.texture import albedo_near
        from univoxel.output.viewpoints import open_studio

        quality = self.quality()
        studio = open_studio(run, self.cameras, self.resolution, self.elevation)
        studio = replace(studio, albedo_near=albedo_near(run))
        if self.ground == "lowest":
            quality = replace(quality, ground=float(studio.traced.mesh.vertices[:, 2].min()))
        return studio, quality


@dataclass(frozen=True, kw_only=True)
class Relight(RelightOptions, Where):  # whose fields come first
    orbit: Annotated[int | None, written("FRAMES")] = None
    """orbit around the object once in this many frames"""
    animation: Annotated[tuple[Animation, ...], written(default="none")] = ()
    """also write the frames as an animation"""
    resume: bool = False
    """keep frames that already exist, and render only the others"""


@takes(Relight)
def command(asked: Relight) -> Path:
    """Render a run under environment maps, suns and point lights."""
    run, envmap, out = Path(asked.run), asked.envmap, asked.out
    options = {field.name: getattr(asked, field.name) for field in fields(RelightOptions)}
    if asked.orbit is not None:
        if asked.cameras != "test":
            raise UserError("expected --orbit or --cameras, but not both")
        options["cameras"] = f"orbit {asked.orbit}"
    if out is None:
        out = run / "relight" / envmap[0].stem if len(envmap) == 1 else run / "relight"
    maps = envmap[0] if len(envmap) == 1 else envmap
    relight_to_files(run, maps, out, animation=asked.animation, resume=asked.resume, **options)
    return out


def sun_light(values: tuple[float, ...] | Sun) -> Sun:
    """A white sun from azimuth and elevation in degrees, irradiance and, perhaps, its angle; a
    UserError for other numbers."""
    from univoxel.ops import Sun
    from univoxel.sphere import direction_at

    if isinstance(values, Sun):
        return values
    if len(values) not in (3, 4):
        raise UserError(f"--sun: expected AZIMUTH ELEVATION IRRADIANCE [ANGLE], got {values}")
    try:
        return Sun(direction_at(*values[:2]), (values[2], values[2], values[2]), *values[3:])
    except ValueError as error:
        raise UserError(f"--{error}") from None


def point_light(values: tuple[float, float, float, float] | PointLight) -> PointLight:
    """A white point light from x, y, z and its intensity; a UserError for a number out of range."""
    from univoxel.ops import PointLight

    if isinstance(values, PointLight):
        return values
    x, y, z, intensity = values
    try:
        return PointLight((x, y, z), (intensity, intensity, intensity))
    except ValueError as error:
        raise UserError(f"--point: {error}") from None


def parse_ground(text: str | float | None) -> Ground:
    """A height, the word lowest, or nothing; a UserError for other text."""
    if text is None or text == "lowest":
        return text
    try:
        return float(text)
    except ValueError:
        raise UserError(f"--ground: expected a height or the word lowest, got {text!r}") from None


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
    from univoxel.core.progress_bar import bar
    from univoxel.data.images import write_exr, write_png
    from univoxel.output.timelapse import require, write_animation
    from univoxel.output.viewpoints import frames_of, pictures_of
    from univoxel.render.relight import channels, srgb

    run, out, chosen = Path(run), Path(out), RelightOptions(**options)
    chosen.quality()  # now, and not after maps are read
    several = not isinstance(envmap, str | Path)
    paths = [Path(path) for path in envmap] if several else [Path(envmap)]
    if len({path.stem for path in paths}) != len(paths):
        raise UserError(
            "relight: expected environment maps with different names, got "
            f"{[str(path) for path in paths]}"
        )
    for kind in animation:
        require(kind)
    lights = {path.stem: chosen.lighting(path) for path in paths}
    if not paths:
        lights = {NO_MAP: chosen.lighting(None)}
    studio, quality = chosen.studio(run)
    frames = frames_of(studio.names, lights, chosen.turn)
    folders = {name: out / name if several and paths else out for name in lights}
    files = {frame: folders[frame.light] / frame.stem for frame in frames}
    missing = [f for f in frames if not (resume and all(p.is_file() for p in _pair(files[f])))]
    with bar(shown=progress) as shown:
        done = len(frames) - len(missing)
        task = shown.add_task("relighting", total=len(frames), completed=done)

        def report(share: float) -> None:
            shown.update(task, completed=done + share)

        for frame, picture in pictures_of(studio, missing, lights, quality, report):
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
    envmap: str | Path | EnvMap | None = None,
    cameras: str | Path | Cameras = "test",
    **options: Any,
) -> Tensor:
    """Render a trained scene under new light: [F, H, W, 4] linear RGBA, premultiplied.

    If the images differ in size, the smaller ones are padded with 0 below and to the right.

    Args:
        run: folder of the trained scene.
        envmap: a file, a map, or None for the suns and point lights only.
        cameras, options: fields of `RelightOptions`.

    Raises:
        UserError: as in `relight_to_files`.
    """
    from univoxel.camera import stacked
    from univoxel.output.viewpoints import frames_of, pictures_of
    from univoxel.render.relight import rgba

    options["cameras"] = cameras
    chosen = RelightOptions(**options)
    chosen.quality()  # now, and not after maps are read
    light = chosen.lighting(envmap)
    studio, quality = chosen.studio(Path(run))
    frames = frames_of(studio.names, [NO_MAP], chosen.turn)
    pictures = pictures_of(studio, frames, {NO_MAP: light}, quality)
    return stacked([rgba(picture) for _, picture in pictures])


def _pair(stem: Path) -> tuple[Path, Path]:
    """The PNG and the EXR file of a frame; names may hold dots."""
    return stem.with_name(f"{stem.name}.png"), stem.with_name(f"{stem.name}.exr")
