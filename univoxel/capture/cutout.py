"""Masks for photographs whose cameras are known, and a page to check them."""

from __future__ import annotations

import functools
import shutil
import statistics
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor
from torch.nn.functional import interpolate

from univoxel.camera import Cameras, resize
from univoxel.capture.masks import (
    BESIDE,
    MISSING,
    Verdict,
    check_network,
    grown,
    iou,
    judge,
    mask_network,
    timed,
    voxel_pixels,
)
from univoxel.color import linear_to_srgb
from univoxel.core import log
from univoxel.core.choices import DEPTH, NETWORK, REMBG, NetworkName
from univoxel.core.files import write_text
from univoxel.core.html import DARK_STYLE, document, escape, image, paragraph
from univoxel.core.progress_bar import track
from univoxel.data import Photos, load_photos, splits_of
from univoxel.data.images import write_exr, write_png
from univoxel.data.transforms import write_cameras
from univoxel.errors import DataError, ExistingFile, UserError, some
from univoxel.preparation import object_shape
from univoxel.preparation.hull import mask_distances
from univoxel.preparation.standing_object import masks_by_depth
from univoxel.preparation.stereo import DepthMaps, depth_maps, small_cameras

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
    agreement: float | None  # IoU with the object's silhouette; None: there was none
    fault: str  # what is wrong with the mask, or nothing
    before: Tensor  # [h, w, 3] in [0, 1], from `darkened`
    after: Tensor | None  # the same with the repaired mask

    @property
    def title(self) -> str:
        return self.name + ("" if self.agreement is None else f"  {self.agreement:.2f}")


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
    """All of them in rows, in their order, before and after beside each other: [H, W, 3] uint8."""
    if not tiles:
        raise ValueError("mask_sheet: expected photographs, got none")
    pictures = [(tile, p) for tile in tiles for p in (tile.before, tile.after) if p is not None]
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
        words = "repaired" if after else tile.fault
        draw.text((x + 2, y + 1), tile.title, colour, font)
        draw.text((x + 2, y + 16), words, colour, font)
        sheet.paste(Image.fromarray(_bytes(picture).numpy()), (x, y + LABEL))
    return np.asarray(sheet)


def write_page(path: Path, tiles: Sequence[MaskTile], about: str) -> None:
    """Write a page that holds its pictures and needs no other file."""
    figures = []
    for tile in tiles:
        words = escape(f"{tile.title} {tile.fault}")
        images = [image(picture) for picture in (tile.before, tile.after) if picture is not None]
        kind = ' class="wrong"' if tile.fault else ""
        repaired = "" if tile.after is None else "; the corrected mask is on the right"
        caption = f"<figcaption>{words}{repaired}</figcaption>"
        figures.append(f"<figure{kind}>{''.join(images)}{caption}</figure>")
    main = "\n".join(["<main>", *figures, "</main>"])
    body = f"<h1>Masks</h1>\n{paragraph(about)}\n{main}"
    write_text(path, document("masks", _STYLE, body))


# Masks come from a network, from a folder, or from the depth that the photographs show, alone.
# Masks and depth tell the object in 3D, and masks that its silhouettes contradict are repaired.


# Photographs that masks are checked with, at least; fewer do not outvote one another
PHOTOGRAPHS = 12
# Voxels along a side of the grid whose silhouettes are masks themselves, and pixels that they are
# wide at most
FINE, WIDTH = 128, 500
# Share of the object's surface that depth shows, below which depth only has guessed its shape
GUESSED = 0.15
# Share of the object's surface that depth has to show for it to be believed against most masks
SURE = 0.5


@dataclass(frozen=True)
class _View:
    """One photograph of a data set, to which a mask [H, W] uint8 belongs."""

    split: str
    photos: Photos  # of the split
    number: int  # in it
    small: Cameras  # of the split, as large as masks are judged

    @property
    def name(self) -> str:
        return self.photos.names[self.number]


def cutout(
    data: str | Path,
    out: str | Path,
    source: str | Path = REMBG,
    downscale: int = 0,
    allow_outside: bool = False,
    *,
    network: NetworkName = NETWORK,
    box: Sequence[float] | None = None,
    keep_table: bool = False,
) -> Path:
    """Write the photographs of a data set with an alpha channel, and their cameras; return out.

    All splits are written, in the layout of NeRF-synthetic scenes and without lens distortion.
    masks.png and masks.html show the masks, worst first. The object is found from the training
    photographs only.

    Args:
        out: folder to write to.
        source: source of the masks: rembg (a network); none (depth maps, which show the object
            that stands on a table in the middle); or a folder of masks.
        downscale: photographs are reduced to 1/N; 0: as in `load_photos`.
        allow_outside: as in `load_photos`.
        network: rembg's network to use.
        box: X0 Y0 Z0 X1 Y1 Z1, a box around the object, in world coordinates of the new cameras.
        keep_table: with masks from depth, keep the part of the table that is inside the box.

    Raises:
        DataError: photographs or masks cannot be used, or depth separates no object.
        ExistingFile: out already exists.
        MissingExtra: the network is not installed.
        UserError: the masks have nothing in common, or arguments are inconsistent.
        OSError: a file cannot be written.
    """
    data, out, origin = Path(data), Path(out), str(source)
    if out.exists():
        raise ExistingFile(f"{out} already exists: choose another folder for out", "out")
    check_masks(origin, network, box, keep_table)
    corners = None if box is None else object_shape.box_corners(box)
    masked = mask_network(network) if origin == REMBG else None
    load = functools.partial(load_photos, data, allow_outside=allow_outside)
    photos = load("train", downscale, masks=False)
    splits = {
        name: photos if name == "train" else load(name, photos.downscale, masks=False)
        for name in splits_of(data)
    }
    log.info(photos.about)
    views = []
    for name, split in splits.items():  # train comes first
        small = small_cameras(split.cameras)
        views += [_View(name, split, v, small) for v in range(len(split))]
    if masked:
        masked = timed(masked, network, len(views))
        masks = [_bytes(masked(_encoded(v.photos, v.number))) for v in track(views, "masks")]
    elif origin == DEPTH:
        masks = _from_depth(splits, depth_maps(photos), corners, keep_table)
    else:  # of shrunk photographs those with masks are black outside of them
        read = {n: load(n, photos.downscale, masks=Path(origin)) for n in splits}
        masks = [_bytes(read[v.split].picture(v.number)[1]) for v in views]
    if origin == DEPTH:  # silhouettes have nothing to say against themselves
        verdicts, told = _as_they_are(masks), "masks from depth"
    else:
        if corners is not None:
            masks = [_within(v, m, corners) for v, m in zip(views, masks, strict=True)]
        verdicts, told = _judged(views, masks, corners)
    _write(out, views, masks, verdicts, told)
    return out


def check_masks(origin: str, network: str, box: Sequence[float] | None, keep_table: bool) -> None:
    """Refuse, by a UserError, an origin of masks and choices that are inconsistent."""
    check_network(network)
    if network != NETWORK and origin not in (REMBG, "auto"):
        raise UserError(
            f"network={network} applies only to masks from {REMBG}, but the source of the masks is "
            f"{origin}",
            "network",
        )
    if box is not None:
        object_shape.box_corners(box)
    if keep_table and (box is None or origin != DEPTH):
        got = "no box" if box is None else f"masks from {origin}"
        raise UserError(
            f"keep_table needs a box that bounds the table, and masks from depth (source: "
            f"{DEPTH}), got {got}",
            "keep_table",
        )


def _from_depth(
    splits: dict[str, Photos], maps: DepthMaps, box: Tensor | None, keep_table: bool
) -> list[Tensor]:
    """Masks of what stands out in depth."""
    small = masks_by_depth(maps, box, keep_table)
    if small is None and box is not None:
        raise object_shape.nothing_inside(box, "no surface has a known depth", maps.cameras)
    shape = None if small is None else object_shape.find_object(small, maps, FINE, box)
    if shape is None or shape.surface < GUESSED:
        raise DataError(
            f"{splits['train'].folder}: depth does not separate the object from its surroundings. "
            f"Depth needs a textured object and cameras all around it. If you do not have these, "
            f"use source={REMBG} or a folder of masks instead of source={DEPTH}",
            "source",
        )
    _tell_evidence(shape, 0, box)
    log.info("masks were made from depth: check them in masks.html")
    return [mask for split in splits.values() for mask in _silhouettes_of(shape, split)]


def _within(view: _View, mask: Tensor, box: Tensor) -> Tensor:
    """A mask that shows nothing beside the box."""
    shown = grown(object_shape.box_shown(view.small, view.number, box)).float()[None, None]
    return mask * interpolate(shown, (mask.shape[0], mask.shape[1]))[0, 0].byte()


def _tell_evidence(shape: object_shape.ObjectShape, count: int, box: Tensor | None) -> None:
    """Log what the object was told by, masks of so many photographs among it, and where it is."""
    by = [f"masks of {count} photographs"] if count else []
    by += [f"the depth of {shape.surface:.0%} of its surface"]
    by += [] if box is None else ["the box"]
    lower, upper = (
        object_shape.words_of(corner.tolist()) for corner in object_shape.inside_bounds(shape)
    )
    log.info(f"the object was found using {', '.join(by)}; it extends from {lower} to {upper}")


def _silhouettes_of(shape: object_shape.ObjectShape, photos: Photos) -> list[Tensor]:
    """The object's silhouettes as masks of photographs, their edges a pixel soft."""
    width = min(photos.cameras.width, WIDTH)
    found = []
    for view, shown in enumerate(object_shape.silhouettes(shape, resize(photos.cameras, width))):
        size = photos.cameras.size(view)[::-1]
        away = mask_distances(shown.float()[None]) * (size[1] / shown.shape[1])
        fine = interpolate(away[None], size, mode="bilinear")[0, 0]
        found.append(_bytes((0.5 - fine).clamp(0, 1)))
    return found


def _as_they_are(masks: Sequence[Tensor]) -> list[Verdict]:
    return [Verdict(None, "", mask) for mask in masks]


def _judged(
    views: Sequence[_View], masks: Sequence[Tensor], box: Tensor | None
) -> tuple[list[Verdict], str]:
    """What the object's silhouettes say about each mask, repaired if it may be, and what to tell
    people; a UserError where masks have nothing in common, or show nothing."""
    train = views[0].photos
    count = len(train)
    if count < PHOTOGRAPHS:
        for view, mask in zip(views, masks, strict=True):
            if not bool((mask >= 128).any()):
                where = "" if box is None else " inside the box"
                raise DataError(
                    f"{train.folder}: the mask of {view.name} is empty{where}: correct it"
                )
        log.warning(
            "masks are not checked, because this needs %d photographs and there are only %d",
            *(PHOTOGRAPHS, count),
        )
        return _as_they_are(masks), "masks are not checked, because there are too few photographs"
    coverage = [mask.float() / 255 for mask in masks]
    shape = object_shape.find_object(coverage[:count], depth_maps(train), box=box)
    _tell_evidence(shape, count, box)
    cameras = {view.split: view.small for view in views}
    shown = [one for those in cameras.values() for one in object_shape.silhouettes(shape, those)]
    agreements = [
        iou(object_shape.shrunk(mask, one.shape[1], one.shape[0]) >= 0.5, one)
        for mask, one in zip(coverage[:count], shown[:count], strict=True)
    ]
    usual = statistics.median(agreements)
    # All may keep the same table: then the box says what is wrong, and not the others
    expected = usual if box is None else 1.0
    verdicts = []
    for k, view in enumerate(track(views, "repairing masks")):
        voxel = voxel_pixels(shape.grid, view.small, view.number)
        found = judge(coverage[k], shown[k], expected, voxel)
        verdicts.append(replace(found, mask=_bytes(found.mask) if found.fault else masks[k]))
    wrong = sum(bool(v.fault) and (box is None or v.fault == MISSING) for v in verdicts[:count])
    told = _told(views, verdicts, usual)
    if 2 * wrong > count and shape.surface < SURE:
        told += "; no mask was corrected, because the estimated shape may be wrong"
        log.warning(
            f"{told}. Perhaps all masks have the same fault, or the cameras are wrong: check "
            "masks.html"
        )
        return [replace(v, mask=m) for v, m in zip(verdicts, masks, strict=True)], told
    if any(verdict.fault for verdict in verdicts):
        told += "; these were corrected from the other photographs, so check masks.html"
    log.info(told)
    return verdicts, told


def _told(views: Sequence[_View], verdicts: Sequence[Verdict], usual: float) -> str:
    """How many masks agree with the object's silhouettes, and what is wrong with the others."""
    said = {BESIDE: "include more than the object", MISSING: "miss part of the object"}
    parts = []
    for fault, words in said.items():
        stems = [v.name for v, found in zip(views, verdicts, strict=True) if found.fault == fault]
        parts += [f"{len(stems)} {words} ({some(stems)})"] if stems else []
    count, wrong = len(views), sum(bool(verdict.fault) for verdict in verdicts)
    told = f"masks: {count - wrong} of {count} agree with the object's silhouette (IoU {usual:.2f})"
    return f"{told}; {wrong} do not: {', '.join(parts)}" if wrong else told


def _write(
    out: Path,
    views: Sequence[_View],
    masks: Sequence[Tensor],
    verdicts: Sequence[Verdict],
    told: str,
) -> None:
    """The folder, whole or not at all: photographs, cameras, and the sheet of masks."""
    # Nothing half-written goes by the name of out
    partial = out.with_name(f".{out.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    tiles = []
    for k, view in enumerate(track(views, "writing")):
        place, before, verdict = partial / view.split, masks[k], verdicts[k]
        if not view.number:
            place.mkdir(parents=True)
            write_cameras(partial, view.split, view.photos.cameras, view.photos.names)
        write_photo(place / view.name, view.photos, view.number, verdict.mask.float() / 255)
        photograph = _encoded(view.photos, view.number)
        shown, after = darkened(photograph, before.float() / 255), None
        if not torch.equal(before, verdict.mask):
            after = darkened(photograph, verdict.mask.float() / 255)
        name = f"{view.split}/{view.name}"
        tiles.append(MaskTile(name, verdict.agreement, verdict.fault, shown, after))
    tiles = worst_first(tiles)
    write_png(partial / "masks.png", mask_sheet(tiles))
    write_page(partial / "masks.html", tiles, told)
    partial.rename(out)


def _encoded(photos: Photos, view: int) -> Tensor:
    """A photograph [H, W, 3] uint8, sRGB."""
    color, _ = photos.stored(view)
    return color if color.dtype == torch.uint8 else _bytes(linear_to_srgb(color).clamp(0, 1))


def _bytes(values: Tensor) -> Tensor:
    """Values in [0, 1] as uint8."""
    return (255 * values).round().to(torch.uint8)


def write_photo(stem: Path, photos: Photos, view: int, alpha: Tensor) -> None:
    """Write a photograph as STEM.png, or STEM.exr where it is linear, with that alpha."""
    color, _ = photos.stored(view)
    if color.dtype == torch.uint8:
        rgba = torch.cat([color, torch.round(255 * alpha)[..., None].byte()], -1)
        write_png(stem.with_name(f"{stem.name}.png"), rgba)
    else:
        planes = {c: color[..., i] * alpha for i, c in enumerate("RGB")}
        write_exr(stem.with_name(f"{stem.name}.exr"), {**planes, "A": alpha})
