"""Photographs darkened outside of their masks, to look through: a picture and a page."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor
from torch.nn.functional import interpolate

from univoxel.page.html import DARK_STYLE, document, escape, image, paragraph, write_html

TILE = 240  # pixels of the longer side
GAP, LABEL = 6, 34  # pixels
COLUMNS = 6  # tiles in a row of the picture, at most
DARK = 0.25  # of the light is left outside of a mask

_STYLE = f"""{DARK_STYLE}
main {{ display: flex; flex-wrap: wrap; gap: 16px }}
figure {{ margin: 0 }}
figure.wrong figcaption {{ color: #ffb347 }}"""


@dataclass(frozen=True)
class MaskTile:
    """A photograph and its mask."""

    name: str
    agreement: float | None  # IoU with the silhouette that the others vote for; None: no vote
    fault: str  # what is wrong with the mask, or nothing
    before: Tensor  # [h, w, 3] in [0, 1], from `darkened`
    after: Tensor | None  # the same with the mended mask


def darkened(photograph: Tensor, mask: Tensor) -> Tensor:
    """A small picture [h, w, 3] in [0, 1] of a photograph [H, W, 3], dark outside its mask [H, W].

    Args:
        photograph: sRGB, uint8 or in [0, 1].
    """
    scale = 1 if photograph.is_floating_point() else 255
    picture = torch.cat([photograph.float() / scale, mask[..., None]], -1).permute(2, 0, 1)
    share = min(1.0, TILE / max(mask.shape))
    height, width = (max(1, round(share * n)) for n in mask.shape)
    small = interpolate(picture[None], (height, width), mode="area")[0].permute(1, 2, 0)
    return small[..., :3].clamp(0, 1) * (DARK + (1 - DARK) * small[..., 3:])


def worst_first(tiles: Sequence[MaskTile]) -> list[MaskTile]:
    """Those with a fault first, then by how little they agree, then by name."""
    return sorted(tiles, key=lambda t: (not t.fault, t.agreement or 0.0, t.name))


def mask_sheet(tiles: Sequence[MaskTile]) -> np.ndarray:
    """All of them in rows, in their order, before and after beside each other: [H, W, 3] uint8.

    Raises:
        ValueError: there are none.
    """
    if not tiles:
        raise ValueError("mask_sheet: expected photographs, got none")
    pictures = [
        (tile, picture)
        for tile in tiles
        for picture in (tile.before, tile.after)
        if picture is not None
    ]
    columns = min(COLUMNS, len(pictures))
    width = max(picture.shape[1] for _, picture in pictures)
    width = max(width, TILE) + GAP  # the words need their room
    height = max(picture.shape[0] for _, picture in pictures) + LABEL + GAP
    rows = -(-len(pictures) // columns)
    sheet = Image.new("RGB", (columns * width, rows * height), (32, 32, 32))
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(12)
    for k, (tile, picture) in enumerate(pictures):
        x, y = k % columns * width, k // columns * height
        after = picture is tile.after
        colour = "orange" if tile.fault and not after else "white"
        words = "mended" if after else tile.fault
        draw.text((x + 2, y + 1), f"{tile.name}{_number(tile)}", colour, font)
        draw.text((x + 2, y + 16), words, colour, font)
        sheet.paste(Image.fromarray(_bytes(picture)), (x, y + LABEL))
    return np.asarray(sheet)


def write_page(path: Path, tiles: Sequence[MaskTile], about: str) -> None:
    """A page that holds its pictures and needs no other file.

    Raises:
        OSError: it cannot be written.
    """
    figures = []
    for tile in tiles:
        words = escape(f"{tile.name}{_number(tile)} {tile.fault}")
        images = [image(picture) for picture in (tile.before, tile.after) if picture is not None]
        kind = ' class="wrong"' if tile.fault else ""
        mended = "" if tile.after is None else "; mended on the right"
        caption = f"<figcaption>{words}{mended}</figcaption>"
        figures.append(f"<figure{kind}>{''.join(images)}{caption}</figure>")
    main = "\n".join(["<main>", *figures, "</main>"])
    body = f"<h1>Masks</h1>\n{paragraph(about)}\n{main}"
    write_html(path, document("masks", _STYLE, body))


def _number(tile: MaskTile) -> str:
    return "" if tile.agreement is None else f"  {tile.agreement:.2f}"


def _bytes(picture: Tensor) -> np.ndarray:
    return (picture.numpy() * 255 + 0.5).astype(np.uint8)
