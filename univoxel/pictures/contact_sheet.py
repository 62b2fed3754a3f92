"""One picture that shows a whole evaluation: estimate, truth and error side by side."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

TILE = 160  # pixels; larger pictures are shrunk
GAP, LABEL = 4, 18  # pixels
# A ramp that also rises in brightness, so that it reads without colour.
HEAT = np.array(
    [[0, 0, 0], [0.35, 0.05, 0.45], [0.85, 0.2, 0.25], [1, 0.7, 0.1], [1, 1, 0.9]], np.float32
)


@dataclass(frozen=True)
class Panel:
    """One quantity of one view."""

    title: str  # such as albedo
    estimate: Tensor  # [H, W, 3] sRGB in [0, 1]
    truth: Tensor | None  # [H, W, 3], or nothing to compare with
    error: Tensor | None  # [H, W] >= 0
    limit: float  # the error that is drawn brightest
    unit: str = ""  # of the error
    heads: tuple[str, str] = ("truth", "error")  # of the second and third column


def heat(error: Tensor, limit: float) -> np.ndarray:
    """Errors [H, W] as colours [H, W, 3] in [0, 1]: black is 0, near white is `limit` or more."""
    x = np.clip(error.numpy() / limit, 0, 1) * (len(HEAT) - 1)
    low = np.minimum(x.astype(np.int64), len(HEAT) - 2)
    f = (x - low)[..., None]
    return (1 - f) * HEAT[low] + f * HEAT[low + 1]


def contact_sheet(rows: list[tuple[str, list[Panel]]]) -> np.ndarray:
    """Draw views as rows and, for each quantity, estimate, truth and error as columns.

    Args:
        rows: the name and the panels of each view; all views have the same quantities.

    Returns:
        [H, W, 3] uint8 sRGB.

    Raises:
        ValueError: no rows, or rows with differing quantities.
    """
    titles = [[panel.title for panel in panels] for _, panels in rows]
    if not rows or any(t != titles[0] for t in titles) or not titles[0]:
        raise ValueError(f"contact_sheet: expected rows of the same quantities, got {titles}")
    sizes = [_tile_size(panels[0].estimate) for _, panels in rows]
    cell = max(TILE, *(width for width, _ in sizes)) + GAP  # titles need their room, too
    margin = 8 + 8 * max(len(name) for name, _ in rows)
    sheet = Image.new(
        "RGB",
        (margin + 3 * cell * len(titles[0]), LABEL + sum(height + GAP for _, height in sizes)),
        (32, 32, 32),
    )
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(12)
    for column, panel in enumerate(rows[0][1]):
        second, third = panel.heads
        texts = (panel.title, second, f"{third}, 0 to {panel.limit:g}{panel.unit}")
        for k, text in enumerate(texts):
            draw.text((margin + (3 * column + k) * cell, 2), text, "white", font)
    y = LABEL
    for (name, panels), (width, height) in zip(rows, sizes, strict=True):
        draw.text((4, y + height // 2 - 6), name, "white", font)
        for column, panel in enumerate(panels):
            error = None if panel.error is None else heat(panel.error, panel.limit)
            tiles = (panel.estimate.numpy(), panel.truth, error)
            for k, tile in enumerate(tiles):
                if tile is not None:
                    x = margin + (3 * column + k) * cell
                    sheet.paste(_tile(np.asarray(tile), width, height), (x, y))
        y += height + GAP
    return np.asarray(sheet)


def shrink(panel: Panel) -> Panel:
    """The panel at about the size it is drawn in, so that sheets of large views fit in memory."""
    every = max(1, min(panel.estimate.shape[:2]) // (2 * TILE))

    def small(x: Tensor | None) -> Tensor | None:
        return None if x is None else x[::every, ::every].clone()

    return replace(
        panel,
        estimate=panel.estimate[::every, ::every].clone(),
        truth=small(panel.truth),
        error=small(panel.error),
    )


def _tile_size(picture: Tensor) -> tuple[int, int]:
    """Width and height that a picture [H, W, 3] is drawn in."""
    scale = min(1.0, TILE / max(picture.shape[:2]))
    height, width = (max(1, round(scale * n)) for n in picture.shape[:2])
    return width, height


def _tile(picture: np.ndarray, width: int, height: int) -> Image.Image:
    bytes_ = (np.clip(picture, 0, 1) * 255 + 0.5).astype(np.uint8)
    return Image.fromarray(bytes_).resize((width, height), Image.Resampling.BOX)
