"""The recovered environment map of a scene, and its difference from the true one."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from univoxel.color import linear_to_srgb, luminance
from univoxel.errors import UserError
from univoxel.render import metrics
from univoxel.render.pictures import BLOCK, grey_ball, mirror_ball, summed_light
from univoxel.scene import Scene
from univoxel.sphere import fibonacci_sphere

BLUR = math.radians(10.0)  # before the brightest direction is looked for: a light, not a texel
NORMALS = 2048  # on the whole ball
BALL = 200  # pixels of the chrome sphere's diameter


@dataclass(frozen=True)
class Comparison:
    """A recovered map against the true one, after one factor per channel."""

    ball_psnr: float  # dB, sRGB of a grey ball seen from everywhere, brightest 1 under the truth
    brightest_degrees: float  # between the brightest directions
    mirror_psnr: float  # dB, sRGB of a chrome sphere seen from +X, as the picture has it


@torch.no_grad()
def recovered_map(scene: Scene, run: Path, height: int) -> Tensor:
    """The map of a scene [height, 2 height, 3], in the light that it shows; a UserError, which
    names the folder of the run, if it has none."""
    sky = scene.environment()
    if sky is None:
        raise UserError(
            f"{run}: this run has no environment map, because it was trained with local light "
            f"({scene.cfg.light.kind})"
        )
    return scene.exposed(sky.latlong(height))


def compare(recovered: Tensor, true: Tensor) -> Comparison:
    """Compare two maps [H, 2 H, 3] of the same scale; their sizes may differ."""
    normal = fibonacci_sphere(NORMALS)
    balls = torch.stack([grey_ball(m, normal) for m in (recovered, true)])
    encoded = linear_to_srgb(balls / balls[1].max())
    a, b = brightest(recovered), brightest(true)
    angle = 2 * torch.atan2((a - b).norm(), (a + b).norm())  # exact at small angles too
    psnr = metrics.psnr(encoded[0][None], encoded[1][None])
    exposure = exposure_of(true)
    mirrors = [linear_to_srgb(mirror_ball(m * exposure, BALL)) for m in (recovered, true)]
    inside = torch.linspace(-1, 1, BALL).square()
    disc = inside[:, None] + inside < 1
    return Comparison(psnr, float(angle.rad2deg()), metrics.psnr(mirrors[0], mirrors[1], disc))


def exposure_of(map: Tensor) -> Tensor:
    """What a map is multiplied by to be looked at."""
    return 1 / luminance(map).quantile(0.9).clamp_min(1e-6)


def brightest(map: Tensor) -> Tensor:
    """Unit direction [3] of the brightest place after a Gaussian blur."""
    direction, light = summed_light(map)
    place = fibonacci_sphere(2 * NORMALS)
    bright = luminance(light)
    near = [((part @ direction.T - 1) / BLUR**2).exp_() @ bright for part in place.split(BLOCK)]
    return place[torch.cat(near).argmax()]


def scale_to(recovered: Tensor, true: Tensor) -> Tensor:
    """The factor [3] that brings the diffuse sphere's light to the true one."""
    normal = fibonacci_sphere(NORMALS)
    truth, ball = grey_ball(true, normal), grey_ball(recovered, normal)
    return metrics.albedo_scale(truth, ball, torch.ones(NORMALS, dtype=torch.bool))
