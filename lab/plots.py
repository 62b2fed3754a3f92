"""What the pictures of experiments share: measures, the Pareto front, figures in files."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import torch

from univoxel import __version__
from univoxel.core.files import write_bytes
from univoxel.core.machine import processor
from univoxel.errors import MissingExtra

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Told apart by colour-blind readers too (Okabe and Ito)
COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000")


@dataclass(frozen=True)
class Measure:
    """A column of a table, a panel of a picture."""

    key: str  # in Outcome.measures
    title: str
    more: bool  # whether more is better
    digits: str = ".2f"  # how it is written


NVS = Measure("nvs_psnr", "novel views, dB", True)
ALBEDO = Measure("albedo_psnr_3ch", "albedo, scaled per channel, dB", True)
ALBEDO_1CH = Measure("albedo_psnr_1ch", "albedo, scaled by one factor, dB", True)
ROUGHNESS = Measure("roughness_mse", "roughness MSE", False, ".4f")
RELIT = Measure("relit_psnr", "relit, dB", True)
NORMAL = Measure("normal_mae_deg", "normals, degrees", False)
MAP = Measure("map_ball_psnr", "diffuse sphere under the map, dB", True)
SECONDS = Measure("train_seconds", "training, s", False, ".0f")
STEPS = Measure("steps_made", "planned steps completed", True, ".0%")
MEMORY = Measure("peak_rss_mb", "peak memory, MB", False, ".0f")
PARAMETERS = Measure("parameters", "parameters", False, ",.0f")


def color(number: int) -> str:
    """Of a line or a kind of dots, by its number."""
    return COLORS[number % len(COLORS)]


def require() -> None:
    """Say before the work starts whether pictures can be drawn.

    Raises:
        ImportError: matplotlib is missing.
    """
    try:
        import matplotlib
    except ImportError:
        raise MissingExtra("the images need matplotlib: pip install 'univoxel[chart]'") from None
    matplotlib.use("agg")


def save_figure(figure: Figure, stem: Path) -> list[Path]:
    """Write a figure as STEM.png and STEM.svg, each whole or not at all.

    Raises:
        OSError: a file cannot be written.
    """
    paths = [stem.with_name(f"{stem.name}{suffix}") for suffix in (".png", ".svg")]
    for path in paths:
        encoded = io.BytesIO()
        figure.savefig(encoded, format=path.suffix[1:], dpi=110, bbox_inches="tight")
        write_bytes(path, encoded.getvalue())
    return paths


def pareto(points: Sequence[tuple[float, float]], more: bool) -> list[int]:
    """Numbers of the points (seconds, value) that no other beats, by seconds.

    A point is beaten by one that is no slower and no worse, and better in one of both.
    """
    order = sorted(range(len(points)), key=lambda i: (points[i][0], -points[i][1] * (2 * more - 1)))
    front: list[int] = []
    for i in order:
        gain = (points[i][1] - points[front[-1]][1]) * (2 * more - 1) if front else 1.0
        if gain > 0:
            front.append(i)
    return front


def machine() -> dict[str, str | int]:
    """What figures were made with."""
    return {
        "univoxel": __version__,
        "torch": torch.__version__,
        "threads": torch.get_num_threads(),
        "processor": processor(),
    }
