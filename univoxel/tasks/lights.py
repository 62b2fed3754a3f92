"""Lights and the ground as the command line writes them."""

from __future__ import annotations

import math
from typing import Literal

from univoxel.ops import Lamp, Sun


def sun_light(values: tuple[float, ...]) -> Sun:
    """A white sun from azimuth and elevation in degrees, irradiance and, perhaps, its angle.

    Raises:
        ValueError: not 3 or 4 numbers, or one out of range.
    """
    if len(values) not in (3, 4):
        raise ValueError(f"--sun: expected AZIMUTH ELEVATION IRRADIANCE [ANGLE], got {values}")
    azimuth, elevation = (math.radians(x) for x in values[:2])
    across = math.cos(elevation)
    direction = (across * math.cos(azimuth), across * math.sin(azimuth), math.sin(elevation))
    return Sun(direction, (values[2], values[2], values[2]), *values[3:])


def point_light(values: tuple[float, float, float, float]) -> Lamp:
    """A white lamp from x, y, z and its intensity."""
    x, y, z, intensity = values
    return Lamp((x, y, z), (intensity, intensity, intensity))


def parse_ground(text: str | None) -> float | Literal["lowest"] | None:
    """A height, the word lowest, or nothing.

    Raises:
        ValueError: another text.
    """
    if text is None or text == "lowest":
        return text
    try:
        return float(text)
    except ValueError:
        raise ValueError(f"--ground: expected lowest or a height, got {text!r}") from None
