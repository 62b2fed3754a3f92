"""The lights that a page offers, and how they are written into it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d

from univoxel.data.maps import read_map
from univoxel.page.html import base64_text
from univoxel.page.transfer import DEGREE
from univoxel.records import HALF_MAX
from univoxel.sphere import (
    latlong_direction,
    latlong_directions,
    real_harmonics,
    texel_solid_angles,
)

BUNDLED = Path(__file__).parent.parent / "example_data" / "tiny" / "envmaps"
ROWS = 128  # of maps that the page makes itself
MOST_ROWS = 256  # of a map from a file


@dataclass(frozen=True)
class Light:
    """A map with the name that it goes by."""

    name: str
    radiance: Tensor  # [H, 2 H, 3] float32 linear, >= 0


def usual_lights() -> list[Light]:
    """Those that every page offers: two photographed, two made here."""
    photographed = [
        Light(name, read_map(BUNDLED / f"{name}.hdr").radiance) for name in PHOTOGRAPHED
    ]
    return [Light("studio", studio()), *photographed, Light("overcast", overcast())]


PHOTOGRAPHED = ("city", "sunset")


def light_of_file(path: Path) -> Light:
    """A map from a file, averaged to at most MOST_ROWS rows.

    Raises:
        DataError: it cannot be used as a map; OSError: it cannot be read.
    """
    radiance = read_map(path).radiance
    if len(radiance) > MOST_ROWS:
        size = (MOST_ROWS, 2 * MOST_ROWS)
        radiance = adaptive_avg_pool2d(radiance.movedim(2, 0), size).movedim(0, 2)
    return Light(path.stem, radiance.contiguous())


def studio() -> Tensor:
    """Three soft boxes in a dark room: a large key, a wide fill, a strip behind; [ROWS, 2 ROWS, 3].

    A white matte ball is about as bright as white paper on its brightest side.
    """
    direction = _fine_directions()
    room = torch.tensor([0.10, 0.10, 0.105]) * (0.6 + 0.4 * direction[..., 2:])
    radiance = room.expand_as(direction).clone()
    # azimuth, elevation, half width, half height (degrees), radiance, colour
    boxes = (
        (40.0, 38.0, 24.0, 20.0, 5.5, (1.0, 0.97, 0.93)),
        (-75.0, 15.0, 20.0, 32.0, 1.6, (0.92, 0.96, 1.0)),
        (170.0, 25.0, 7.0, 40.0, 5.0, (1.0, 1.0, 1.0)),
    )
    for azimuth, elevation, width, height, power, color in boxes:
        inside = _box(direction, azimuth, elevation, width, height)
        radiance += power * inside[..., None] * torch.tensor(color)
    return _averaged(radiance)


def overcast() -> Tensor:
    """A sky of clouds over grey ground, [ROWS, 2 ROWS, 3].

    Source of the sky: CIE standard overcast sky, Moon and Spencer 1942, (1 + 2 sin elevation) / 3.
    """
    up = latlong_directions(ROWS)[..., 2:]
    sky = 1.1 * (1 + 2 * up.clamp_min(0)) / 3 * torch.tensor([0.93, 0.98, 1.07])
    ground = torch.tensor([0.22, 0.21, 0.20])
    share = torch.sigmoid(up / 0.02)  # the horizon as wide as a texel or two
    return share * sky + (1 - share) * ground


def _fine_directions() -> Tensor:
    """Four directions a texel: [2 ROWS, 4 ROWS, 3]."""
    v = (torch.arange(2 * ROWS) + 0.5) / (2 * ROWS)
    u = (torch.arange(4 * ROWS) + 0.5) / (4 * ROWS)
    return latlong_direction(torch.stack(torch.meshgrid(v, u, indexing="ij")[::-1], -1))


def _averaged(radiance: Tensor) -> Tensor:
    """[2 H, 2 W, 3] to [H, W, 3]."""
    height, width, _ = radiance.shape
    size = (height // 2, width // 2)
    return adaptive_avg_pool2d(radiance.movedim(2, 0), size).movedim(0, 2).contiguous()


def _box(
    direction: Tensor, azimuth: float, elevation: float, width: float, height: float
) -> Tensor:
    """How much of a soft box lies in directions [..., 3], in [0, 1]; angles in degrees."""
    phi, up = math.radians(azimuth), math.radians(elevation)
    centre = [math.cos(up) * math.cos(phi), math.cos(up) * math.sin(phi), math.sin(up)]
    axes = [
        centre,
        [-math.sin(phi), math.cos(phi), 0.0],
        [-math.sin(up) * math.cos(phi), -math.sin(up) * math.sin(phi), math.cos(up)],
    ]
    forward, right, above = (direction @ direction.new_tensor(axes).T).unbind(-1)
    ahead = forward.clamp_min(1e-3)
    edges = (
        1 - (right / ahead).abs() / math.tan(math.radians(width)),
        1 - (above / ahead).abs() / math.tan(math.radians(height)),
    )
    inside = torch.stack([(edge / 0.15).clamp(0, 1) for edge in edges]).prod(0)
    # A diffuser is brightest in its middle
    return torch.where(forward > 0.05, inside * (0.75 + 0.25 * edges[0].clamp(0, 1)), 0.0)


def harmonics(radiance: Tensor) -> Tensor:
    """[25, 3]: integrals over the sphere of a map [H, 2 H, 3] times each real harmonic."""
    height, width, _ = radiance.shape
    basis = real_harmonics(DEGREE, latlong_directions(height))
    weighted = radiance * texel_solid_angles(height, width)[..., None]
    return torch.einsum("hwk,hwc->kc", basis, weighted)


def as_json(light: Light) -> dict[str, Any]:
    """A map as the page's script reads it: halves, row 0 on top, and its harmonics."""
    stored = light.radiance.clamp_max(HALF_MAX)
    return {
        "name": light.name,
        "height": len(stored),
        "texels": base64_text(stored.half().numpy().astype("<f2").tobytes()),
        "harmonics": [[round(x, 6) for x in row] for row in harmonics(stored).tolist()],
    }
