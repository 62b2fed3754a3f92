"""Masks in files of their own: found by the names of the photographs, brought to their size."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor
from torch.nn.functional import interpolate

from univoxel.data.images import SUFFIXES, read_image
from univoxel.errors import DataError

ENDINGS = ("_mask", "_alpha")  # that a mask's name may have beyond the photograph's
SKEW = 0.01  # by which width over height of a mask and its photograph may differ
NAMED = 5  # photographs in a message, at most


def masks_by_stem(folder: Path, photographs: Sequence[tuple[str, Path]]) -> list[Path]:
    """The mask of each photograph in a folder of them.

    That of IMG_1.jpg is IMG_1.png, IMG_1.jpg.png, IMG_1_mask.png or IMG_1_alpha.png, with any
    ending of a picture. Where photographs lie in folders, the masks may lie in the same ones.

    Args:
        photographs: name within the data set, and file.

    Raises:
        DataError: there is no such folder, a photograph has none in it, or has several.
    """
    if not folder.is_dir():
        what = "a file" if folder.exists() else "nothing there"
        raise DataError(f"{folder}: expected a folder of masks, got {what}")
    files = [p for p in sorted(folder.rglob("*")) if p.suffix.lower() in SUFFIXES]
    if not files:
        raise DataError(f"{folder}: expected masks ({' '.join(SUFFIXES)}), got no picture")
    known: dict[str, list[Path]] = {}
    for path in files:
        inside = path.relative_to(folder).with_suffix("")
        for name in {inside.as_posix(), inside.name}:
            known.setdefault(_stem(name), []).append(path)
    found, without = [], []
    for name, image in photographs:
        candidates = known.get(_stem(name)) or known.get(_stem(image.stem)) or []
        if len(candidates) > 1:
            raise DataError(
                f"{image}: expected one mask, got {' and '.join(map(str, candidates[:2]))}"
            )
        found += candidates
        without += [] if candidates else [image.name]
    if without:
        more = ", ..." if len(without) > NAMED else ""
        raise DataError(
            f"{folder}: expected a mask for each of {len(photographs)} photographs, got none for "
            f"{len(without)}: {', '.join(without[:NAMED])}{more} (looked for "
            f"{Path(without[0]).stem}.png)"
        )
    return found


def read_mask(path: Path, width: int, height: int, note: str = "") -> Tensor:
    """A mask [height, width], uint8 or float32 as stored: its alpha, or its first channel.

    One of another size but the same shape is resized; rows and columns that an original of N times
    the size has left over are cut off.

    Args:
        note: on the size, added to the message that it is another one.

    Raises:
        DataError: it cannot be read, or its shape is another.
    """
    image = read_image(path)
    channels = image.shape[-1]
    mask = image[..., 3 if channels == 4 else 0]
    if mask.shape == (height, width):
        return mask
    factor = max(mask.shape[0] // height, 1)
    if (mask.shape[0] // factor, mask.shape[1] // factor) == (height, width):
        mask = mask[: factor * height, : factor * width]  # what an original has left over
    if abs(mask.shape[1] * height / (mask.shape[0] * width) - 1) > SKEW:
        came = f"{mask.shape[1]}x{mask.shape[0]}"
        raise DataError(f"{path}: expected {width}x{height} pixels, got {came}{note}")
    mode = "area" if mask.shape[1] > width else "bilinear"
    resized = interpolate(mask[None, None].float(), (height, width), mode=mode)[0, 0]
    return resized if mask.is_floating_point() else resized.round().to(torch.uint8)


def _stem(name: str) -> str:
    """The name without endings of pictures, and without those of masks."""
    while (shorter := _shorter(name)) != name:
        name = shorter
    return name


def _shorter(name: str) -> str:
    if Path(name).suffix.lower() in SUFFIXES:
        return str(Path(name).with_suffix(""))
    return next((name.removesuffix(e) for e in ENDINGS if name.endswith(e)), name)
