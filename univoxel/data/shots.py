"""From posed files to `Photos`: what the loaders of all layouts share."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from univoxel.camera import Cameras
from univoxel.color import linear_to_srgb, srgb_to_linear
from univoxel.data.base import Photos, decode
from univoxel.data.images import read_image
from univoxel.data.lens import Lens, shrink, shrunk, sources, straighten, straightened
from univoxel.data.masks import masks_by_stem, read_mask
from univoxel.errors import DataError, UserError

LARGE = 200_000_000  # pixels in all photographs, from where on their size must be chosen
TRAINING_BYTES = 25  # of memory that training takes for each of them, about
SUGGESTED = 1000  # pixels along the longer side
TEST_EVERY = 8
LINEAR = srgb_to_linear(torch.arange(256) / 255).numpy()  # of bytes
# How far +Z may be from the cameras' common up direction in a world that is taken as upright:
# cameras are held askew and lean over, but worlds that are not upright are turned by much more.
LEAN = math.radians(30)
HOW_TO_MASK = "cut the object out with `univoxel cutout`, or see docs/guide/masks.md"


@dataclass(frozen=True)
class Shot:
    """A photograph in a file, and its camera."""

    name: str
    where: str  # for messages: what says that it is there
    image: Path
    mask: Path | None  # a picture of its own, or None: alpha in the photograph, or beside it
    pose: np.ndarray  # [3, 4] camera-to-world, axes as of `Cameras`
    lens: Lens


def read_shots(
    folder: Path,
    kind: str,
    split: str,
    shots: Sequence[Shot],
    downscale: int = 0,
    remarks: Sequence[str] = (),
    masks: bool | Path = True,
) -> Photos:
    """Photographs as pinholes see them, all of one size.

    Distortion is taken out, and pixels are averaged, in linear light with premultiplied alpha.

    Args:
        kind: of the data set, for people.
        downscale: means over squares of so many pixels; 0 for 1, refused where that is large.
        remarks: on how the files were read, for people.
        masks: False for photographs as they are, the whole picture opaque; or a folder of masks,
            which takes the place of what the layout names.

    Raises:
        DataError: one line that names the file, what was expected and what came.
    """
    if isinstance(masks, Path):
        found = masks_by_stem(masks, [(shot.name, shot.image) for shot in shots])
        shots = [replace(shot, mask=mask) for shot, mask in zip(shots, found, strict=True)]
        masks = True
    if downscale < 0:
        raise ValueError(f"downscale must be at least 1, got {downscale}")
    _check(folder, shots, downscale)
    factor = downscale or 1
    colors: list[Tensor] = []
    alphas: list[Tensor] = []
    lenses: list[Lens] = []
    last, grid = None, None
    for shot in shots:
        color, alpha = read_photo(shot.image, shot.mask, masks)
        if colors and color.dtype != colors[0].dtype:
            raise DataError(
                f"{shot.image}: expected the format of {shots[0].name} in all photographs"
            )
        if shot.lens != last:  # one lens often took all photographs
            last, grid = shot.lens, None
            try:
                pinhole = straightened(shot.lens)
            except UserError as error:
                raise DataError(f"{shot.where}: {error}") from None
            if shot.lens.bent:
                grid = sources(shot.lens, pinhole)
        if grid is not None or factor > 1:
            color, alpha = resampled(color, alpha, factor, grid)
        colors.append(color)
        alphas.append(alpha)
        lenses.append(shrunk(pinhole, factor))
    if len({alpha.dtype for alpha in alphas}) > 1:
        alphas = [a if a.is_floating_point() else a / 255 for a in alphas]
    if not any(bool(alpha.any()) for alpha in alphas):
        raise DataError(f"{folder}: all {len(alphas)} pictures are fully transparent")
    if masks and all(
        bool((alpha == (1 if alpha.is_floating_point() else 255)).all()) for alpha in alphas
    ):
        raise DataError(f"{folder}: all {len(alphas)} pictures are fully opaque: {HOW_TO_MASK}")

    told = [f"{len(shots)} photographs of {lenses[0].width}x{lenses[0].height} pixels in {split}"]
    told += ["lens distortion taken out"] if any(shot.lens.bent for shot in shots) else []
    told += [f"shrunk to 1/{factor}"] if factor > 1 else []
    return Photos(
        folder=folder,
        names=[shot.name for shot in shots],
        color=torch.stack(colors),
        alpha=torch.stack(alphas),
        cameras=cameras_of([shot.pose for shot in shots], lenses),
        about=f"{folder}: {kind}, {', '.join([*told, *remarks])}",
        downscale=factor,
    )


def cameras_of(poses: Sequence[np.ndarray], lenses: Sequence[Lens]) -> Cameras:
    """Pinholes of one picture size."""
    return Cameras(
        camera_to_world=torch.from_numpy(np.stack(poses).astype(np.float32)),
        focal=torch.tensor([lens.focal for lens in lenses], dtype=torch.float32),
        centre=torch.tensor([lens.centre for lens in lenses], dtype=torch.float32),
        width=lenses[0].width,
        height=lenses[0].height,
    )


def read_photo(path: Path, mask: Path | None = None, masks: bool = True) -> tuple[Tensor, Tensor]:
    """Colour [H, W, 3] and alpha [H, W] of one photograph, stored as in `Photos`.

    Without a mask: its alpha channel, or <name>_mask.png or <name>_alpha.png beside it. The colour
    of an EXR with alpha is premultiplied, as OpenEXR has it, and is divided; negative values, which
    denoisers and filters leave, become 0.

    Args:
        masks: False to look for none: alpha is 1 everywhere.
    """
    image = read_image(path)
    channels = image.shape[-1]
    if channels not in (3, 4):
        raise DataError(f"{path}: expected a picture with 3 or 4 channels, got {channels}")
    color, linear = image[..., :3], image.is_floating_point()
    alpha = image[..., 3] if channels == 4 else None
    if linear and alpha is not None:
        alpha = alpha.clamp(0, 1)
        color = torch.where(alpha[..., None] > 0, color / alpha[..., None], 0.0)
    if not masks:
        alpha, mask = torch.full_like(color[..., 0], 1 if linear else 255), None
    stem = path.stem.removesuffix("_rgb")
    beside = [path.with_name(f"{stem}_{what}.png") for what in ("mask", "alpha")]
    if mask is None and alpha is None:
        mask = next((file for file in beside if file.is_file()), None)
    if mask is not None:
        alpha = read_mask(mask, color.shape[1], color.shape[0])
    if alpha is None:
        raise DataError(
            f"{path}: expected an alpha channel or a mask {beside[0].name}, got neither: "
            f"{HOW_TO_MASK}"
        )
    return (color.clamp_min(0) if linear else color).contiguous(), alpha.contiguous()


def resampled(
    color: Tensor, alpha: Tensor, factor: int, grid: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Stored colour and alpha, straightened and then shrunk in linear light; stored as before."""
    encoded = color.dtype == torch.uint8
    if encoded:  # a table is many times as fast as the curve
        color = torch.from_numpy(LINEAR[color.numpy()])
    linear, coverage = decode(color, alpha)
    picture = torch.cat([linear * coverage[..., None], coverage[..., None]], -1)
    if grid is not None:
        picture = straighten(picture, grid)
    picture = shrink(picture, factor)
    linear, coverage = picture[..., :3], picture[..., 3]
    linear = torch.where(coverage[..., None] > 0, linear / coverage[..., None], 0.0)
    if encoded:
        linear = (255 * linear_to_srgb(linear)).round().to(torch.uint8)
    if alpha.dtype == torch.uint8:
        coverage = (255 * coverage).round().to(torch.uint8)
    return linear.contiguous(), coverage.contiguous()


def find_mask(folder: Path, image: str) -> Path | None:
    """The mask of a photograph in COLMAP's naming: masks/<image>.png; or with its ending replaced.

    Args:
        image: path of the photograph within its folder.
    """
    names = f"{image}.png", str(Path(image).with_suffix(".png"))
    return next((path for n in names if (path := folder / "masks" / n).is_file()), None)


def every_eighth(folder: Path, shots: Sequence[Shot], split: str) -> list[Shot]:
    """The test split: the first of every eight photographs in order of names; train: the others."""
    if split not in ("train", "test"):
        raise DataError(f"{folder}: expected split train or test, got {split}")
    ordered = sorted(shots, key=lambda shot: shot.name)
    chosen = [s for i, s in enumerate(ordered) if (i % TEST_EVERY == 0) == (split == "test")]
    if not chosen:
        raise DataError(f"{folder}: expected two photographs at least, got {len(ordered)}")
    return chosen


def upright(shots: Sequence[Shot]) -> tuple[list[Shot], list[str]]:
    """The shots in a world whose +Z is up, and what was done.

    The world of structure from motion has any direction. Cameras are held level, mostly: their
    right axes then lie in the horizontal plane, and up is what is across to all of them. A world
    that is upright already, to within LEAN, stays as it is; and one whose cameras do not agree.
    """
    axes = np.stack([shot.pose[:, :3] for shot in shots])
    right, mean_up = axes[:, :, 0], axes[:, :, 1].mean(0)
    _, spread, directions = np.linalg.svd(right, full_matrices=True)
    up = directions[2] * (1 if directions[2] @ mean_up >= 0 else -1)
    if len(spread) < 2 or spread[1] < 0.1 * spread[0] or up @ mean_up < math.sin(LEAN):
        return list(shots), ["world as in the files: its cameras do not say what is up"]
    if up[2] >= math.cos(LEAN):
        return list(shots), []
    turn = _turn(up)
    return [replace(shot, pose=turn @ shot.pose) for shot in shots], ["world turned to +Z up"]


def size_of(image: Tensor) -> str:
    return f"{image.shape[1]}x{image.shape[0]}"


def _turn(up: np.ndarray) -> np.ndarray:
    """The smallest rotation that takes a unit vector to +Z."""
    if up[2] < -1 + 1e-9:
        return np.diag([1.0, -1.0, -1.0])
    x, y, z = up
    cross = np.array([[0, 0, -x], [0, 0, -y], [x, y, 0]])
    return np.eye(3) + cross + cross @ cross / (1 + z)


def _check(folder: Path, shots: Sequence[Shot], downscale: int) -> None:
    """Names, sizes and memory, before anything large is read."""
    names: set[str] = set()
    width, height = shots[0].lens.width, shots[0].lens.height
    for shot in shots:
        if shot.name in names:
            raise DataError(f"{shot.where}: the name {shot.name} of {shot.image} came before")
        names.add(shot.name)
        if (shot.lens.width, shot.lens.height) != (width, height):
            raise DataError(
                f"{shot.image}: expected {width}x{height} pixels like {shots[0].name}, "
                f"got {shot.lens.width}x{shot.lens.height}"
            )
    if not downscale and (pixels := len(shots) * width * height) > LARGE:
        factor = math.ceil(max(width, height) / SUGGESTED)
        raise DataError(
            f"{folder}: {len(shots)} photographs of {width}x{height} pixels take about "
            f"{pixels * TRAINING_BYTES / 1e9:.0f} GB of memory in training: choose a size, such as "
            f"downscale={factor} for {width // factor}x{height // factor}, or downscale=1 to keep "
            "theirs",
            "downscale",
        )
    if downscale > min(width, height):
        raise DataError(
            f"{folder}: downscale={downscale} leaves nothing of {width}x{height}", "downscale"
        )
