"""Draws the diagrams of docs/method: stages, joint optimisation, carving, fields, layers.

    python docs/figures/diagrams.py docs/images

Each is an SVG file. With --png the same pictures are written as PNG, to look at.
"""

from __future__ import annotations

import argparse
import sys
from bisect import bisect_right
from collections.abc import Callable
from pathlib import Path

import matplotlib
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch, Rectangle

sys.path.append(str(Path(__file__).parents[2] / "tests"))
from layers import LAYERS

INK, SOFT, PALE = "#22333b", "#5b6f7a", "#eef2f4"
BLUE, GREEN, ORANGE, RED = "#3a6ea5", "#4f8f5b", "#c9822b", "#b0413e"
MIDDLE = 11.5  # nodes, of the shape in the section
COMMANDS = "tasks" if any("tasks" in row for row in LAYERS) else "cli"
# What the layers are for: name, a module of the lowest layer, colour; from the bottom up
BANDS = (
    ("plain things", "core", BLUE),
    ("one scene", "data", GREEN),
    ("configuration", "config", SOFT),
    ("training", "preparation", ORANGE),
    ("after training", "output", RED),
    ("what a person runs", "cli", SOFT),
)
STYLE = {
    "font.family": "sans-serif",
    "font.size": 9,
    "svg.fonttype": "none",
    "svg.hashsalt": "univoxel",
    "text.color": INK,
    "axes.edgecolor": SOFT,
}


def blank(width: float, height: float) -> tuple[Figure, Axes]:
    """A figure of inches whose axes count inches, without a frame."""
    figure = plt.figure(figsize=(width, height), facecolor="white")
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set_xlim(0, width)
    axes.set_ylim(0, height)
    axes.axis("off")
    return figure, axes


def box(
    axes: Axes, at: tuple[float, float], size: tuple[float, float], title: str, *lines: str, color
) -> None:
    """A rounded box with its lower left corner at `at`, a bold title and lines below it."""
    (x, y), (width, height) = at, size
    shape = FancyBboxPatch(
        at, width, height, boxstyle="round,pad=0,rounding_size=0.08", fc=PALE, ec=color, lw=1.6
    )
    axes.add_patch(shape)
    top = y + height - 0.17 if lines else y + height / 2
    axes.text(x + width / 2, top, title, ha="center", va="center", weight="bold", color=color)
    for k, line in enumerate(lines):
        axes.text(x + width / 2, top - 0.22 - 0.185 * k, line, ha="center", va="center", size=8)


def arrow(
    axes: Axes,
    begin: tuple[float, float],
    end: tuple[float, float],
    bend: float = 0.0,
    color: str = SOFT,
) -> None:
    style = f"arc3,rad={bend}"
    axes.add_patch(
        FancyArrowPatch(
            begin, end, arrowstyle="-|>", mutation_scale=11, color=color, connectionstyle=style
        )
    )


def stages() -> Figure:
    """What follows what in a training with the hybrid light."""
    figure, axes = blank(9.4, 3.5)
    size, y = (1.36, 1.5), 1.25
    parts = [
        ("prepare", SOFT, "masks", "cameras", "visual hull", "exposures", "carving"),
        ("coarse", BLUE, "StageConfig", "few voxels", "radiance head", "and silhouettes"),
        ("fine", BLUE, "StageConfig", "fine voxels", "then local light", "and materials"),
        ("joint", ORANGE, "JointConfig", "one map, traced", "materials", "and normals"),
        ("refit", GREEN, "StageConfig", "materials stay", "light, radiance,", "silhouettes follow"),
        ("compression", RED, "fewer rows", "fewer nodes", "smaller file"),
    ]
    for k, (title, color, *lines) in enumerate(parts):
        x = 0.12 + 1.56 * k
        box(axes, (x, y), size, title, *lines, color=color)
        if k:
            arrow(axes, (x - 0.2, y + 0.75), (x, y + 0.75))
    axes.plot([1.68, 7.72], [3.0, 3.0], color=SOFT, lw=1)
    axes.text(4.7, 3.16, "TrainConfig.stages, within TrainConfig.minutes", ha="center", color=SOFT)
    arrow(axes, (4.7, 0.62), (4.7, y - 0.02), color=RED)
    axes.text(4.7, 0.5, "capacity: mirror levels", ha="center", color=RED, size=8)
    axes.text(0.8, 0.5, "no gradient yet", ha="center", color=SOFT, size=8)
    axes.text(8.6, 0.5, "nothing is trained", ha="center", color=SOFT, size=8)
    axes.text(
        4.7,
        0.14,
        "validation pixels set the size",
        ha="center",
        color=RED,
        size=8,
        style="italic",
    )
    return figure


def joint_solve() -> Figure:
    """The order of the joint optimisation."""
    figure, axes = blank(9.0, 3.3)
    box(
        axes,
        (0.15, 1.9),
        (1.75, 1.1),
        "observe",
        "points, photographs",
        "visibility",
        "traced once",
        color=SOFT,
    )
    box(
        axes,
        (2.35, 1.9),
        (1.75, 1.1),
        "multi-start",
        "hypotheses on metal",
        "unused observations",
        "decide",
        color=RED,
    )
    box(
        axes,
        (4.55, 1.9),
        (1.75, 1.1),
        "sun",
        "entropy prior",
        "compares skies",
        "with and without",
        color=RED,
    )
    arrow(axes, (1.9, 2.45), (2.35, 2.45))
    arrow(axes, (4.1, 2.45), (4.55, 2.45))
    box(
        axes,
        (0.55, 0.3),
        (1.75, 0.95),
        "Newton",
        "log map; albedo",
        "and roughness follow",
        color=ORANGE,
    )
    box(axes, (2.75, 0.3), (1.75, 0.95), "entropy", "slow changes", "of the map", color=RED)
    box(
        axes,
        (4.95, 0.3),
        (1.75, 0.95),
        "metal classes",
        "two fits a point;",
        "labels for the head",
        color=BLUE,
    )
    box(
        axes, (7.1, 0.3), (1.75, 0.95), "Adam", "materials, normals,", "the map slowly", color=GREEN
    )
    for x in (2.3, 4.5, 6.7):
        arrow(axes, (x, 0.77), (x + (0.45 if x < 6 else 0.4), 0.77))
    arrow(axes, (4.95, 1.9), (1.2, 1.27), bend=-0.05)
    arrow(axes, (7.97, 1.26), (1.75, 1.27), bend=0.13, color=ORANGE)
    axes.text(7.4, 1.75, "next round", color=ORANGE, ha="center", size=8)
    return figure


def carving() -> Figure:
    """A cup in section: what silhouettes leave full, and how depths open it."""
    figure, panels = plt.subplots(1, 3, figsize=(9.0, 3.3), facecolor="white")
    outer = np.array([[-1, 0], [1, 0], [1, 1.6], [-1, 1.6]])
    inner = np.array([[-0.72, 1.6], [-0.72, 0.35], [0.72, 0.35], [0.72, 1.6]])
    eyes = [(-2.1, 3.3), (0.0, 3.8), (2.1, 3.3)]
    titles = ("visual hull", "depths of the views", "after carving")
    for k, (axes, title) in enumerate(zip(panels, titles, strict=True)):
        axes.set_title(title, size=10, color=INK)
        axes.set_xlim(-2.2, 2.6)
        axes.set_ylim(-0.1, 3.9)
        axes.set_aspect("equal")
        axes.axis("off")
        axes.fill(*outer.T, color=BLUE, alpha=0.25 if k == 0 else 0.12, lw=0)
        wall = np.concatenate([outer[[3, 0, 1, 2]], inner[::-1]])
        if k:
            axes.fill(*wall.T, color=BLUE, alpha=0.45, lw=0)
        axes.plot(*wall[[0, 1, 2, 3]].T, color=INK, lw=1.5)
        axes.plot(*inner.T, color=INK, lw=1.5, ls="-" if k == 2 else ":")
        if k == 0:
            axes.plot([-1, 1], [1.6, 1.6], color=INK, lw=1.5)
            axes.text(0, 0.95, "full up\nto the rim", ha="center", size=8)
        for eye in eyes:
            axes.plot(*eye, marker="o", color=INK, ms=5)
            if k == 0:
                for corner in ((-1.0, 1.6), (1.0, 1.6)):
                    axes.plot([eye[0], corner[0]], [eye[1], corner[1]], color=SOFT, lw=0.7)
        if k == 1:
            ends = {
                eyes[0]: [(0.72, 1.05), (0.3, 0.35)],
                eyes[1]: [(-0.4, 0.35), (0.4, 0.35)],
                eyes[2]: [(-0.72, 1.05), (-0.3, 0.35)],
            }
            for eye, points in ends.items():
                for point in points:
                    axes.plot([eye[0], point[0]], [eye[1], point[1]], color=ORANGE, lw=1)
                    axes.plot(*point, marker="o", color=RED, ms=4)
            axes.plot(0.05, 1.1, marker="s", color=GREEN, ms=8)
            axes.text(
                1.1,
                0.75,
                "this node lies in\nfront of the depths\nof all views",
                size=8,
                color=GREEN,
            )
        if k == 2:
            axes.text(0, 0.95, "open", ha="center", size=8)
    figure.tight_layout()
    return figure


def fields() -> Figure:
    """Where distances and features are kept, in section."""
    figure, panels = plt.subplots(1, 3, figsize=(9.0, 3.3), facecolor="white")
    angle = np.linspace(0, 2 * np.pi, 400)
    radius = 8.4 + 1.2 * np.cos(3 * angle)
    curve = MIDDLE + radius * np.cos(angle), MIDDLE + radius * np.sin(angle)
    x, y = np.meshgrid(np.arange(24), np.arange(24))
    theta = np.arctan2(y - MIDDLE, x - MIDDLE)
    distance = np.hypot(x - MIDDLE, y - MIDDLE) - (8.4 + 1.2 * np.cos(3 * theta))
    titles = ("dense: all nodes", "sparse: bricks at the surface", "hash: distances and a table")
    for k, (axes, title) in enumerate(zip(panels, titles, strict=True)):
        axes.set_title(title, size=10, color=INK)
        axes.set_aspect("equal")
        axes.axis("off")
        axes.set_xlim(-0.7, 23.7)
        axes.set_ylim(-0.7, 23.7)
        axes.plot(*curve, color=RED, lw=1.8)
        if k == 0:
            axes.scatter(x, y, s=5, c=distance, cmap="coolwarm", vmin=-8, vmax=8, rasterized=True)
        if k == 1:
            for bx in range(0, 24, 4):
                for by in range(0, 24, 4):
                    part = distance[by : by + 4, bx : bx + 4]
                    kept = np.abs(part).min() < 1.0
                    color = PALE if not kept else "#cfe0ee"
                    axes.add_patch(
                        Rectangle((bx - 0.5, by - 0.5), 4, 4, fc=color, ec="white", lw=2)
                    )
                    if kept:
                        px, py = np.meshgrid(np.arange(bx, bx + 4), np.arange(by, by + 4))
                        axes.scatter(
                            px, py, s=5, c=part, cmap="coolwarm", vmin=-8, vmax=8, rasterized=True
                        )
                    else:
                        sign = "+" if part.mean() > 0 else "-"
                        axes.text(bx + 1.5, by + 1.5, sign, ha="center", va="center", color=SOFT)
        if k == 2:
            near = np.abs(distance) < 2.0
            axes.scatter(
                x[near],
                y[near],
                s=5,
                c=distance[near],
                cmap="coolwarm",
                vmin=-8,
                vmax=8,
                rasterized=True,
            )
            for step, color in ((12, BLUE), (6, GREEN), (3, ORANGE)):
                at = float(curve[0][205]), float(curve[1][205])
                corner = tuple(step * np.floor(np.array(at) / step))
                axes.add_patch(Rectangle(corner, step, step, fc="none", ec=color, lw=1.8))
            axes.plot(*at, marker="o", color=INK, ms=5)
    figure.tight_layout()
    return figure


def layers() -> Figure:
    """The folders of the package, from the bottom up, as tests/layers.py has them."""
    rows = LAYERS
    begins = [next(k for k, row in enumerate(rows) if first in row) for _, first, _ in BANDS]
    height = 0.3
    figure, axes = blank(7.9, height * len(rows) + 0.75)
    for k, names in enumerate(rows):
        y = 0.55 + height * k
        color = BANDS[bisect_right(begins, k) - 1][2]
        axes.add_patch(Rectangle((0.7, y), 5.4, height - 0.05, fc=PALE, ec=color, lw=1.2))
        text = ", ".join(sorted(names))
        size = 9 if len(text) < 90 else 5.5
        axes.text(3.4, y + height / 2 - 0.03, text, ha="center", va="center", size=size)
    axes.add_patch(Rectangle((0.7, 0.1), 5.4, 0.3, fc="#dfe6ea", ec=INK, lw=1.2))
    axes.text(3.4, 0.25, "csrc: C++ kernels, loaded by ops.native alone", ha="center", va="center")
    arrow(axes, (0.4, 0.5 + height * len(rows)), (0.4, 0.5), color=INK)
    axes.text(
        0.22,
        0.5 + height * len(rows) / 2,
        "imports",
        rotation=90,
        va="center",
        ha="center",
        color=INK,
    )
    ends = [*begins[1:], len(rows)]
    for (name, _, color), begin, end in zip(BANDS, begins, ends, strict=True):
        y = 0.55 + height * (begin + end) / 2 - 0.03
        axes.text(6.2, y, name, va="center", color=color, size=8)
    return figure


DIAGRAMS: dict[str, Callable[[], Figure]] = {
    "stages": stages,
    "joint_solve": joint_solve,
    "carving": carving,
    "fields": fields,
    "layers": layers,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--png", action="store_true")
    args = parser.parse_args()
    matplotlib.use("agg")
    with plt.rc_context(STYLE):
        for name, draw in DIAGRAMS.items():
            figure = draw()
            suffix = "png" if args.png else "svg"
            metadata = None if args.png else {"Date": None, "Creator": None}
            figure.savefig(args.out / f"{name}.{suffix}", dpi=110, metadata=metadata)
            plt.close(figure)


if __name__ == "__main__":
    main()
