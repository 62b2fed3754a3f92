"""The light that reaches one point of a trained scene, as an image."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from univoxel.cli.parsing import File, LightOf, Run, takes, written
from univoxel.core.choices import MAP_ROWS
from univoxel.errors import UserError, demand

MIN_OPACITY = 0.5  # of a pixel that has a surface

if TYPE_CHECKING:
    Pixel = str | tuple[int, int]
else:  # what the command line reads
    Pixel = Annotated[str, written("COLUMN,ROW")]


@dataclass(frozen=True)
class InspectOptions:
    run: Run
    """folder of a trained run"""
    view: Annotated[str, written("VIEW")]
    """test view, by name or number"""
    pixel: Pixel
    """pixel of the surface point; 0,0 is the top left"""
    out: Annotated[File | None, written("FILE.png", "in RUN/inspect")] = None
    """image to write; its layers are written beside it as .exr"""
    height: Annotated[int, written("ROWS")] = MAP_ROWS
    """number of rows of the environment maps in the image"""
    light_of: LightOf = None
    """training view (name or number) whose light to draw; see train --varying"""


@takes(InspectOptions, gradients=False)
def inspect(asked: InspectOptions) -> Path:
    """Draw the light that reaches one point of the surface.

    If the data set has ground truth, the true light is drawn beside the recovered light.

    Raises:
        DataError: the run or its data cannot be read.
        UserError: the view or pixel does not exist, there is no surface under the pixel, another
            argument is out of range, or the run has no light for light_of.
        OSError: a file cannot be written.
    """
    # The PNG holds a lat-long picture for each thing the scene knows: its local light, its distant
    # map as the object itself hides it, with what hides it lit as the radiance head says; and the
    # truth, where the data set has mesh.ply and envmaps/train.hdr or .exr: the true map as the true
    # mesh hides it, with the same bounces. Each is brought to the truth's irradiance by a factor
    # per channel, that photographs hardly fix. Directions from below the horizon are dimmed. On the
    # left the photograph, with the point marked. The EXR beside it holds everything as it is:
    # <layer>.R .G .B, <layer>.open.
    from univoxel.data.images import write_exr, write_png
    from univoxel.lights.views import view_number
    from univoxel.render.light_at_point import arriving, ray_of, sheet, true_light
    from univoxel.render.pipeline import surface_at
    from univoxel.run import photos_of
    from univoxel.scene import load_scene

    run, height = Path(asked.run), asked.height
    out = None if asked.out is None else Path(asked.out)
    pixel = parse_pixel(asked.pixel) if isinstance(asked.pixel, str) else asked.pixel
    demand(height >= 1, "height", "at least 1", height)
    if out is not None and out.suffix.lower() != ".png":
        raise UserError(f"out: expected a name that ends in .png, got {out}", "out")
    scene = load_scene(run)
    scene.show_light_of(asked.light_of)
    photos = photos_of(run)
    index = view_number(photos.names, asked.view, "view")
    rays = ray_of(photos, index, pixel)
    surface = surface_at(scene, rays)
    if not surface.opacity[0] > MIN_OPACITY:
        raise UserError(f"pixel: there is no surface under {pixel[0]},{pixel[1]}", "pixel")
    layers = arriving(scene, surface, height)
    truth = true_light(scene, photos.folder, rays, height)
    out = out or run / "inspect" / f"{photos.names[index]}_{pixel[0]}_{pixel[1]}.png"
    out.parent.mkdir(parents=True, exist_ok=True)
    channels = {}
    for layer in [*layers, *([truth] if truth else [])]:
        key = layer.title.replace(" ", "_")
        channels |= {f"{key}.{c}": x for c, x in zip("RGB", layer.radiance.unbind(2), strict=True)}
        if layer.visible is not None:
            channels[f"{key}.open"] = layer.visible.float()
    write_exr(out.with_suffix(".exr"), channels, half=False)
    write_png(out, sheet(photos, index, pixel, surface, layers, truth))
    return out


command = inspect


def parse_pixel(text: str) -> tuple[int, int]:
    """Column and row as the command line writes them; a UserError for other text."""
    try:
        column, row = (int(part) for part in text.split(","))
    except ValueError:
        raise UserError(f"pixel: expected COLUMN,ROW, got {text!r}", "pixel") from None
    return column, row
