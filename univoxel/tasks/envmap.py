"""The recovered environment map as a file, and how far it is from the true one."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from univoxel import metrics
from univoxel.checkpoint import load_scene
from univoxel.color import linear_to_srgb, luminance
from univoxel.data.images import write_exr, write_png
from univoxel.data.maps import true_map
from univoxel.data.radiance import write_radiance
from univoxel.errors import UserError
from univoxel.names import MAP_ROWS
from univoxel.pictures.balls import BLOCK, grey_ball, map_and_balls, mirror_ball, summed_light
from univoxel.run import trained_on
from univoxel.scene import Scene
from univoxel.sphere import fibonacci_sphere

BLUR = math.radians(10.0)  # before the brightest direction is looked for: a light, not a texel
NORMALS = 2048  # on the whole ball
BALL = 200  # pixels of the mirror ball's diameter


@dataclass(frozen=True)
class Comparison:
    """A recovered map against the true one, after one factor per channel."""

    ball_psnr: float  # dB, sRGB of a grey ball seen from everywhere, brightest 1 under the truth
    brightest_degrees: float  # between the brightest directions
    mirror_psnr: float  # dB, sRGB of a mirror ball seen from +X, as the picture has it


@torch.no_grad()
def envmap(
    run: str | Path, out: str | Path, height: int = MAP_ROWS, light_of: str | None = None
) -> Comparison | None:
    """Write the recovered map of a run, and a picture of it beside; compare it with the true one.

    Light and albedo share a factor per channel that photographs hardly fix; the comparison takes it
    out, the file holds the map as it is. The true map is envmaps/train.hdr or .exr in the data set.

    Args:
        run: folder of a trained run.
        out: .exr, [height, 2 height] of 32-bit linear R, G, B, or .hdr, of 8 bits and a common
            exponent; the picture goes to the same name with .png: a row for the recovered map and
            one for the true map, each with a grey and a mirror ball seen from +X, +Z up.
        height: rows of the map, >= 1.
        light_of: training view, by name or number, whose light it is, where light varies; their
            mean when left out.

    Returns:
        None where the data set has no true map.

    Raises:
        DataError: run or true map cannot be read.
        UserError: the run has no map; an argument out of range; light_of is no training view, or
            light does not vary.
        OSError: a file cannot be written.
    """
    run, out = Path(run), Path(out)
    if height < 1:
        raise UserError(f"height must be at least 1, got {height}", "height")
    if out.suffix.lower() not in (".exr", ".hdr"):
        raise UserError(f"out: expected a name that ends in .exr or .hdr, got {out}", "out")
    scene = load_scene(run)
    scene.show_light_of(light_of)
    recovered, true = recovered_map(scene, run, height), true_map(trained_on(run))
    out.parent.mkdir(parents=True, exist_ok=True)
    if out.suffix.lower() == ".hdr":
        write_radiance(out, recovered.numpy())
    else:
        write_exr(out, dict(zip("RGB", recovered.unbind(2), strict=True)), half=False)
    rows, result = [recovered], None
    if true is not None:
        recovered = recovered * _scale(recovered, true)
        rows, result = [recovered, true], compare(recovered, true)
    exposure = _exposure(rows[-1])
    picture = [torch.cat(map_and_balls(row * exposure, height), 1) for row in rows]
    write_png(out.with_suffix(".png"), linear_to_srgb(torch.cat(picture)))
    return result


@torch.no_grad()
def recovered_map(scene: Scene, run: Path, height: int) -> Tensor:
    """The map of a scene [height, 2 height, 3], in the light that it shows.

    Args:
        run: its folder, for the message.

    Raises:
        UserError: the scene has none.
    """
    sky = scene.environment()
    if sky is None:
        raise UserError(
            f"{run}: this run has no environment map: it was trained with {scene.cfg.light.kind} "
            "light alone"
        )
    return scene.exposed(sky.latlong(height))


def compare(recovered: Tensor, true: Tensor) -> Comparison:
    """Maps [H, 2 H, 3] of any two sizes, of one scale."""
    normal = fibonacci_sphere(NORMALS)
    balls = torch.stack([grey_ball(m, normal) for m in (recovered, true)])
    encoded = linear_to_srgb(balls / balls[1].max())
    a, b = brightest(recovered), brightest(true)
    angle = 2 * torch.atan2((a - b).norm(), (a + b).norm())  # exact at small angles too
    psnr = metrics.psnr(encoded[0][None], encoded[1][None])
    exposure = _exposure(true)
    mirrors = [linear_to_srgb(mirror_ball(m * exposure, BALL)) for m in (recovered, true)]
    inside = torch.linspace(-1, 1, BALL).square()
    disc = inside[:, None] + inside < 1
    return Comparison(psnr, float(angle.rad2deg()), metrics.psnr(mirrors[0], mirrors[1], disc))


def _exposure(map: Tensor) -> Tensor:
    """What a map is multiplied by to be looked at."""
    return 1 / luminance(map).quantile(0.9).clamp_min(1e-6)


def brightest(map: Tensor) -> Tensor:
    """Unit direction [3] of the brightest place after a Gaussian blur."""
    direction, light = summed_light(map)
    place = fibonacci_sphere(2 * NORMALS)
    bright = luminance(light)
    near = [((part @ direction.T - 1) / BLUR**2).exp_() @ bright for part in place.split(BLOCK)]
    return place[torch.cat(near).argmax()]


def _scale(recovered: Tensor, true: Tensor) -> Tensor:
    """The factor [3] that brings the grey ball's light to the true one."""
    normal = fibonacci_sphere(NORMALS)
    truth, ball = grey_ball(true, normal), grey_ball(recovered, normal)
    return metrics.albedo_scale(truth, ball, torch.ones(NORMALS, dtype=torch.bool))
