"""Commands that use a run: eval, relight, export, view, envmap, report, inspect, info."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import rich
from rich.text import Text
from tyro.conf import arg

from univoxel.commands.arguments import STDOUT, JsonFile, LightOf, Points, Run, Suns, json_file
from univoxel.errors import UserError
from univoxel.names import (
    BOUNCES,
    ELEVATION,
    MAP_ROWS,
    SAMPLES,
    TEXTURE_QUALITY,
    TEXTURE_SIZE,
    Animation,
    Background,
    Behind,
    Ground,
    Origin,
    TextureFormat,
)

if TYPE_CHECKING:
    from univoxel.ops import PointLight, Sun


def sun_light(values: tuple[float, ...]) -> Sun:
    """A white sun from azimuth and elevation in degrees, irradiance and, perhaps, its angle.

    Raises:
        UserError: not 3 or 4 numbers, or one out of range.
    """
    from univoxel.ops import Sun

    if len(values) not in (3, 4):
        raise UserError(f"--sun: expected AZIMUTH ELEVATION IRRADIANCE [ANGLE], got {values}")
    azimuth, elevation = (math.radians(x) for x in values[:2])
    across = math.cos(elevation)
    direction = (across * math.cos(azimuth), across * math.sin(azimuth), math.sin(elevation))
    try:
        return Sun(direction, (values[2], values[2], values[2]), *values[3:])
    except ValueError as error:
        raise UserError(f"--{error}") from None


def point_light(values: tuple[float, float, float, float]) -> PointLight:
    """A white point light from x, y, z and its intensity.

    Raises:
        UserError: a number is out of range.
    """
    from univoxel.ops import PointLight

    x, y, z, intensity = values
    try:
        return PointLight((x, y, z), (intensity, intensity, intensity))
    except ValueError as error:
        raise UserError(f"--point: {error}") from None


def parse_ground(text: str | None) -> Ground:
    """A height, the word lowest, or nothing.

    Raises:
        UserError: another text.
    """
    if text is None or text == "lowest":
        return text
    try:
        return float(text)
    except ValueError:
        raise UserError(f"--ground: expected lowest or a height, got {text!r}") from None


def evaluate(
    run: Run,
    /,
    data: Annotated[
        Path | None, arg(metavar="DATA", help_behavior_hint="(default: the data trained on)")
    ] = None,
    save: Annotated[
        Path | None, arg(metavar="DIR", help_behavior_hint="(default: none are written)")
    ] = None,
    json: JsonFile = None,
    samples: int = SAMPLES,
    bounces: int = BOUNCES,
    light_of: LightOf = None,
    test_every: Annotated[
        int | None, arg(metavar="N", help_behavior_hint="(default: the test split)")
    ] = None,
    background: Behind = "black",
    fit_light: bool = False,
) -> None:
    """Measure a run on the test views and print the table.

    Args:
        run: folder of a trained run
        data: folder of the photographs
        save: folder for the rendered pictures
        json: file for the measures; - prints them in place of the table
        samples: of the light, per pixel of relit pictures
        bounces: reflections between parts of the object in relit pictures, 0 for none
        light_of: training view, by name or number, in whose light novel views are rendered, where
            the run was trained with --varying
        test_every: measure the first of every so many photographs, in order of all names; none of
            them may have been trained on
        background: what novel views are composited on
        fit_light: render each novel view in the light in which it looks most like its photograph,
            as the field does where light differs from photograph to photograph
    """
    from univoxel.tasks import evaluate as task

    with json_file(json) as file:
        measures = task.evaluate(
            run,
            data=data,
            save=save,
            json=file,
            samples=samples,
            bounces=bounces,
            light_of=light_of,
            test_every=test_every,
            background=background,
            fit_light=fit_light,
        )
    if json != STDOUT:
        rich.print(task.table(measures))


def relight(
    run: Run,
    /,
    envmap: Annotated[
        tuple[Path, ...],
        arg(metavar="MAP [MAP ...]", help_behavior_hint="(default: none)"),
    ] = (),
    sun: Suns = (),
    point: Points = (),
    out: Annotated[
        Path | None, arg(metavar="DIR", help_behavior_hint="(default: in RUN/relight)")
    ] = None,
    cameras: Annotated[str, arg(metavar="test|orbit|FILE")] = "test",
    orbit: Annotated[int | None, arg(metavar="FRAMES")] = None,
    elevation: Annotated[float, arg(metavar="DEGREES")] = ELEVATION,
    turn: Annotated[int | None, arg(metavar="FRAMES")] = None,
    resolution: Annotated[
        int | None, arg(metavar="PIXELS", help_behavior_hint="(default: the data's; orbits: 512)")
    ] = None,
    rotate: Annotated[float, arg(metavar="DEGREES")] = 0.0,
    exposure: Annotated[float, arg(metavar="FACTOR")] = 1.0,
    samples: int = SAMPLES,
    noise: Annotated[float | None, arg(metavar="SHARE")] = None,
    bounces: int = BOUNCES,
    background: Background = "transparent",
    ground: Annotated[str | None, arg(metavar="lowest|HEIGHT")] = None,
    animation: Annotated[tuple[Animation, ...], arg(help_behavior_hint="(default: none)")] = (),
    resume: bool = False,
) -> None:
    """Render a run under other light: environment maps, suns, points.

    Args:
        run: folder of a trained run
        envmap: equirectangular maps, twice as wide as high, .exr or .hdr, linear radiance
        sun: a far light: degrees from +X counter-clockwise and above the horizon, irradiance,
            degrees across (0.53 if not given; 0: hard shadows); repeatable
        point: a near light: where it stands, irradiance at distance 1; repeatable
        out: folder for the pictures, with a folder for each map where there are several
        cameras: the test views, an orbit around the object, or a path in a transforms.json
        orbit: frames of an orbit; the same as --cameras "orbit FRAMES"
        elevation: of an orbit above the horizon, degrees
        turn: frames of a turn of the light under the first camera
        resolution: width of the pictures
        rotate: turn maps and suns counter-clockwise about +Z, degrees
        exposure: factor on all light
        samples: of the light, per pixel
        noise: instead of --samples: as many as bring the relative noise below this, such as 0.02
        bounces: reflections between parts of the object
        background: what stands behind the object
        ground: z of a floor that catches the object's shadow, or lowest for its lowest point
        animation: the frames as a moving picture too
        resume: keep the frames that are there
    """
    from univoxel.tasks import relight as task

    if orbit is not None and cameras != "test":
        raise UserError(f"expected --orbit or --cameras, got {orbit} and {cameras}")
    if out is None:
        out = run / "relight" / envmap[0].stem if len(envmap) == 1 else run / "relight"
    task.relight_to_files(
        run,
        envmap[0] if len(envmap) == 1 else envmap,
        out,
        animation=animation,
        resume=resume,
        suns=[sun_light(values) for values in sun],
        point_lights=[point_light(values) for values in point],
        cameras=cameras if orbit is None else f"orbit {orbit}",
        elevation=elevation,
        turn=turn,
        resolution=resolution,
        rotate=rotate,
        exposure=exposure,
        samples=samples,
        noise=noise,
        bounces=bounces,
        background=background,
        ground=parse_ground(ground),
    )
    print(out)


def export(
    run: Run,
    /,
    mesh: Annotated[Path, arg(metavar="FILE.glb|usdz|obj|ply")],
    faces: Annotated[
        int | None,
        arg(metavar="N", help_behavior_hint="(default: 20000 with textures, all without)"),
    ] = None,
    texture_size: Annotated[int, arg(metavar="TEXELS")] = TEXTURE_SIZE,
    watertight: bool = False,
    texture_format: TextureFormat = "png",
    quality: Annotated[int, arg(metavar="1-95")] = TEXTURE_QUALITY,
    size: Annotated[
        float | None, arg(metavar="METRES", help_behavior_hint="(default: as photographed)")
    ] = None,
    origin: Origin = "world",
    lods: Annotated[int, arg(metavar="N")] = 0,
) -> None:
    """Write the surface as a mesh with its materials, for any renderer.

    Args:
        run: folder of a trained run
        mesh: the file to write: .glb, .usdz and .obj hold textures, .ply materials at the vertices
        faces: most triangles, at least 4
        texture_size: width of the square textures, a power of 2 up to 4096
        watertight: close holes, or fail
        texture_format: png loses nothing, jpeg is smaller
        quality: of textures as jpeg
        size: what the longest side of the object becomes
        origin: what lies at 0: the origin of the data set, the middle of the object's floor, or its
            centre
        lods: coarser levels of detail to write beside, FILE_lod1 and so on: each has a quarter of
            the triangles, and textures of half the width
    """
    from univoxel.tasks import export as task

    for path in task.export(
        run,
        mesh,
        faces=faces,
        texture_size=texture_size,
        watertight=watertight,
        texture_format=texture_format,
        quality=quality,
        size=size,
        origin=origin,
        lods=lods,
    ):
        print(path)


def view(
    run: Run,
    /,
    html: Annotated[
        Path | None, arg(metavar="FILE.html", help_behavior_hint="(default: a server)")
    ] = None,
    envmap: Annotated[
        tuple[Path, ...],
        arg(metavar="MAP [MAP ...]", help_behavior_hint="(default: the usual ones alone)"),
    ] = (),
    title: Annotated[
        str | None, arg(metavar="TEXT", help_behavior_hint="(default: the folder's name)")
    ] = None,
    host: Annotated[str, arg(metavar="ADDRESS")] = "127.0.0.1",
    port: Annotated[int, arg(metavar="N")] = 8080,
) -> None:
    """Look at a run in a browser and turn its light; or write it as one web page to send.

    Args:
        run: folder of a trained run
        html: write this page, which needs no network, instead of serving
        envmap: equirectangular maps to offer, before the usual ones
        title: what stands above the object
        host: address to listen on; the default is reached from this machine alone
        port: port to listen on; 0 is any free one
    """
    from univoxel.tasks import view as task

    page = task.view(run, html, envmap=envmap, title=title, host=host, port=port)
    if page is not None:
        print(page)


def envmap(
    run: Run,
    /,
    out: Annotated[Path, arg(metavar="FILE.exr|hdr")],
    height: Annotated[int, arg(metavar="ROWS")] = MAP_ROWS,
    light_of: LightOf = None,
) -> None:
    """Write the light of the photographs as an environment map.

    Args:
        run: folder of a trained run
        out: the map, linear radiance, in 32 bits a channel as .exr, a pixel as .hdr; a picture of
            it goes beside, with the true map if the data set has it
        height: rows of the map; it is twice as wide
        light_of: training view, by name or number, whose map it is, where the run was trained with
            --varying
    """
    from univoxel.tasks import envmap as task

    found = task.envmap(run, out, height=height, light_of=light_of)
    print(out)
    if found:
        print(f"grey ball under it: PSNR {found.ball_psnr:.1f} dB, a scale per channel")
        print(f"mirror ball under it: PSNR {found.mirror_psnr:.1f} dB")
        print(f"brightest directions: {found.brightest_degrees:.1f} degrees apart")


def report(
    run: Run,
    /,
    html: Annotated[
        Path | None, arg(metavar="FILE.html", help_behavior_hint="(default: RUN/report.html)")
    ] = None,
    data: Annotated[
        Path | None, arg(metavar="DATA", help_behavior_hint="(default: the data trained on)")
    ] = None,
    views: Annotated[int, arg(metavar="N")] = 4,
    title: Annotated[
        str | None, arg(metavar="TEXT", help_behavior_hint="(default: the folder's name)")
    ] = None,
) -> None:
    """Say how good a run is, and what to photograph next, on one web page.

    Photographs beside their render, doubt painted on the object, materials, light, the course of
    training, and directions from which more photographs would help. It needs no truth.

    Args:
        run: folder of a trained run
        html: the page to write, which needs no network
        data: folder of the photographs, where they were moved
        views: photographs beside their render, the worst first
        title: what stands above it
    """
    from univoxel.tasks import report as task

    print(task.report(run, html, data=data, views=views, title=title))


def inspect(
    run: Run,
    /,
    view: Annotated[str, arg(metavar="VIEW")],
    pixel: Annotated[str, arg(metavar="COLUMN,ROW")],
    out: Annotated[
        Path | None,
        arg(metavar="FILE.png", help_behavior_hint="(default: in RUN/inspect)"),
    ] = None,
    light_of: LightOf = None,
) -> None:
    """Draw the light that falls on one point of the surface.

    The truth stands beside it where it is known.

    Args:
        run: folder of a trained run
        view: name or number of a test view
        pixel: whose surface point; 0,0 is the top left
        out: the picture; an .exr file with the layers goes beside
        light_of: training view, by name or number, whose light it is, where the run was trained
            with --varying
    """
    from univoxel.tasks import inspect as task

    print(task.inspect(run, view, task.parse_pixel(pixel), out, light_of=light_of))


def info(
    run: Run,
    /,
    json: JsonFile = None,
    picture: Annotated[
        Path | None, arg(metavar="FILE.png", help_behavior_hint="(default: none)")
    ] = None,
) -> None:
    """Say what a model consists of, and what was chosen for it.

    Parameters and bytes by part, and sizes. Also whether points that are matched between the
    photographs lie where the cameras put them.

    Args:
        run: folder of a trained run
        json: file for the numbers; - prints them in place of tables
        picture: where the grid's nodes are that hold features, and a bar of bytes by part
    """
    from univoxel.tasks import info as task

    with json_file(json) as file:
        found = task.info(run, json=file, picture=picture)
    if json == STDOUT:
        return
    for table in task.tables(found):
        rich.print(table)
    for choice in found["chosen"]:
        rich.print(Text(choice["said"]))
