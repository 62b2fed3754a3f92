"""From posed image files to `Photos`: code that the loaders of all layouts share."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Generator, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from statistics import median

import numpy as np
import torch
from torch import Tensor

from univoxel.camera import Cameras, sizes_of
from univoxel.color import linear_to_srgb, srgb_to_linear
from univoxel.core import log, system
from univoxel.data.image_cache import Reading, kept_pixels, origin_of, to_be_kept
from univoxel.data.images import orientation, read_image
from univoxel.data.lens import Lens, shrink, shrunk, sources, straighten, straightened
from univoxel.data.masks import (
    find_masks,
    made_upright,
    masks_beside,
    masks_in,
    premultiplied,
    read_mask,
    require_all,
    require_fit,
)
from univoxel.data.path_sandbox import FEWEST, inside, left_out
from univoxel.data.photos import Photos, coverage_of, decode
from univoxel.errors import DataError, UserError, WithoutMasks, some

# Pixels along the longer side that photographs are shrunk to, about. An object that fills half of
# it is 500 pixels wide, the finest grid of the presets some 160 voxels: pixels stay finer
FINE = 1000
LARGE = 200_000_000  # pixels in all photographs, at most: training takes 25 bytes for each, about
READERS = 4  # photographs that are read at once, at most: each may take 0.4 GB while it is shrunk
BAND = 1 << 18  # pixels of a file, about, that are shrunk at once
SIZES_TOLD = 3  # of the photographs, that are named one by one, at most
TEST_EVERY = 8
LINEAR = srgb_to_linear(torch.arange(256) / 255).numpy()  # of bytes
# How far +Z may be from the cameras' common up direction in a world that is taken as upright:
# cameras are held askew and lean over, but worlds that are not upright are turned by much more.
LEAN = math.radians(30)
# Distance of cameras from the origin, in their distances from one another, beyond which float32
# loses what they see: it has 7 digits, and pixels need 4
FAR = 1000
OPAQUE = 0.98  # of alpha: some programs write 254 where there is nothing but the object
LOOKED_AT = 12  # photographs, at most, on which it is tried whether masks can be right
HOW_TO_MASK = "cut out the object with `univoxel cutout`, or see docs/guide/masks.md"


@dataclass(frozen=True)
class Shot:
    """A photograph in a file, and its camera."""

    name: str
    where: str  # for messages: what says that it is there
    image: Path
    mask: Path | None  # a picture of its own that the data name; None: `read_shots` looks for it
    pose: np.ndarray  # [3, 4] camera-to-world, axes as in `Cameras`
    lens: Lens
    beside: Path | None = None  # a mask that counts where the photograph has no alpha
    moved: np.ndarray | None = None  # [3, 4] from the files' world to `pose`'s, as in `Photos`


@dataclass(frozen=True)
class Listed:
    """The photographs of one split that a data set lists."""

    kind: str  # of the data set, for people
    shots: Sequence[Shot]
    remarks: Sequence[str] = ()  # on how the files were read, for people


def present(
    where: Path, found: Iterable[Shot | str | Path], looked: str = ""
) -> tuple[list[Shot], list[str]]:
    """Photographs that a file or folder lists, but for those that are not there: in their place
    stands a name. Returns remarks on them, too; arguments and errors as in `left_out`."""
    found = list(found)
    shots = [shot for shot in found if isinstance(shot, Shot)]
    missing = [name for name in found if not isinstance(name, Shot)]
    return shots, left_out(str(where), missing, len(found), looked)


def read_shots(
    folder: Path, split: str, listed: Listed, downscale: int = 0, masks: bool | Path = True
) -> Photos:
    """Photographs as pinholes see them, each in its own size.

    Distortion is taken out, and pixels are averaged, in linear light with premultiplied alpha.
    Pixels are those of the file: an orientation in its EXIF is not looked at.

    Args:
        downscale: means over squares of so many pixels; 0: what `fitting_downscale` says.
        masks: False for photographs as they are, the whole picture opaque; or a folder of masks,
            which takes the place of what the layout names.
    """
    if downscale < 0:
        raise ValueError(f"downscale must be at least 1, got {downscale}")
    shots = listed.shots
    named = masks if isinstance(masks, Path) else None
    if named is None and masks:
        shots = _with_masks(folder, shots)
    for shot in shots:
        for path in _files(shot):
            inside(path, shot.where)
    if named is not None:  # by the caller: they may lie anywhere
        found = masks_in(named, [(shot.name, shot.image) for shot in shots])
        shots = [replace(shot, mask=mask) for shot, mask in zip(shots, found, strict=True)]
    masks = bool(masks)
    _check(folder, shots, downscale)
    if split == "train" and len(shots) < FEWEST:
        count = "one photograph is" if len(shots) == 1 else "two photographs are"
        log.warning("%s: %s not enough for a shape: at least %d are needed", folder, count, FEWEST)
    factor = downscale or fitting_downscale(shots)
    pinholes = _pinholes(shots)
    cameras = cameras_of([s.pose for s in shots], [shrunk(lens, factor) for lens in pinholes])
    origin = ""
    large = to_be_kept(len(cameras), cameras.height, cameras.width)
    if factor > 1 or large or any(shot.lens.bent for shot in shots):
        lenses = [(shot.lens, pinhole) for shot, pinhole in zip(shots, pinholes, strict=True)]
        origin = origin_of([f for shot in shots for f in _files(shot)], lenses, factor, masks)
    pixels = kept_pixels(origin) if origin else None
    color, alpha = pixels or _read_all(folder, shots, pinholes, cameras, factor, masks, origin)

    told = [f"{len(shots)} photographs of {_words(cameras)} pixels in {split}"]
    told += ["lens distortion removed"] if any(shot.lens.bent for shot in shots) else []
    told += [f"downscaled to 1/{factor}"] if factor > 1 else []
    return Photos(
        folder=folder,
        names=[shot.name for shot in shots],
        color=color,
        alpha=alpha,
        cameras=cameras,
        about=f"{folder}: {listed.kind}, {', '.join([*told, *listed.remarks])}",
        downscale=factor,
        origin=origin,
        readers=tuple(
            partial(_reread, shot, pinhole) for shot, pinhole in zip(shots, pinholes, strict=True)
        ),
        moved=shots[0].moved,
    )


def _reread(shot: Shot, pinhole: Lens, factor: int) -> Tensor:
    """Stored colour [H // factor, W // factor, 3] of a photograph's file, without its mask; a
    DataError where it cannot be read any more, or has another size."""
    color, alpha = read_photo(shot.image, masks=False)
    if color.shape[:2] != (shot.lens.height, shot.lens.width):
        raise DataError(
            f"{shot.image}: expected {shot.lens.width}x{shot.lens.height} pixels, as when the "
            f"file was first read, got {size_of(color)}"
        )
    grid = sources(shot.lens, pinhole) if shot.lens.bent else None
    return resampled(color, alpha, factor, grid)[0]


def fitting_downscale(shots: Sequence[Shot]) -> int:
    """The side of the squares of pixels whose means are as much as grids and memory can use.

    The longer side of the median photograph is then FINE pixels, about, and all photographs
    together are LARGE at most. Those of 1499 pixels and fewer stay as they are, unless they are
    very many.
    """
    sizes = [(shot.lens.width, shot.lens.height) for shot in shots]
    most = min(map(min, sizes))
    factor = min(max(1, round(median(map(max, sizes)) / FINE)), most)
    while factor < most and sum((w // factor) * (h // factor) for w, h in sizes) > LARGE:
        factor += 1
    return factor


def _pinholes(shots: Sequence[Shot]) -> list[Lens]:
    """The pinhole that each photograph is turned into."""
    known: dict[Lens, Lens] = {}  # one lens often took all photographs
    for shot in shots:
        try:
            known[shot.lens] = known.get(shot.lens) or straightened(shot.lens)
        except UserError as error:
            raise DataError(f"{shot.where}: {error}") from None
    return [known[shot.lens] for shot in shots]


def _with_masks(folder: Path, shots: Sequence[Shot]) -> list[Shot]:
    """The shots with the masks that lie in folders of masks and beside photographs; a DataError
    where some have one in such a folder, and others none at all."""
    photographs = [(shot.name, shot.image) for shot in shots]
    found, beside = find_masks(folder, photographs), masks_beside(photographs)
    masked = [
        replace(shot, mask=shot.mask or mask, beside=other)
        for shot, mask, other in zip(shots, found, beside, strict=True)
    ]
    place = next((mask.parent for mask in found if mask), None)
    if place and not all(shot.mask for shot in masked):
        there = [bool(s.mask or s.beside) or _is_cut_out(s.image) for s in masked]
        require_all(place, photographs, there)
    return masked


def _is_cut_out(path: Path) -> bool:
    """Whether a photograph has an alpha that says something."""
    image = read_image(path)
    return image.shape[-1] == 4 and bool((image[..., 3] < image[..., 3].max()).any())


def _files(shot: Shot) -> list[Path]:
    """The files that say what a photograph looks like."""
    return [shot.image, *(mask for mask in (shot.mask or shot.beside,) if mask)]


def _read_all(
    folder: Path,
    shots: Sequence[Shot],
    pinholes: Sequence[Lens],
    cameras: Cameras,
    factor: int,
    masks: bool,
    origin: str,
) -> tuple[Tensor, Tensor]:
    """Colour [V, H, W, 3] and alpha [V, H, W] of all photographs as `Photos` has them."""
    pairs = [(s.image, mask) for s in shots if masks and (mask := s.mask or s.beside)]
    upright = made_upright(pairs)
    if upright is not None:
        turned = sum(orientation(image) != 1 for image, _ in pairs)
        log.info(
            "%d photographs have an EXIF orientation, and their masks seem to match %s",
            *(turned, "the upright image" if upright else "the stored pixels"),
        )
    reading = Reading.resumed(origin)
    begin = reading.read if reading else 0
    # Closed here: a reader left to the garbage collector would be waited for in any thread, even in
    # one that holds what the reader's end waits for
    arguments = factor, masks, bool(upright)
    with closing(_read_each(shots[begin:], pinholes[begin:], *arguments)) as pictures:
        for view, (color, alpha) in enumerate(pictures, begin):
            if reading is None:
                size = len(shots), cameras.height, cameras.width
                reading = Reading.begun(origin, color, alpha, size)
            if color.dtype != reading.color.dtype:
                raise DataError(
                    f"{shots[view].image}: expected all photographs to have the same "
                    f"format as {shots[0].name}"
                )
            if alpha.dtype != reading.alpha.dtype:
                # In memory, as `keep_photos` may keep it at the end: masks stored in ways that
                # differ are rare
                reading.drop()
                whole = coverage_of(reading.alpha)
                alpha, reading = coverage_of(alpha), replace(reading, alpha=whole, partial=None)
            reading.empty &= not alpha.any()
            most = OPAQUE * (1 if alpha.is_floating_point() else 255)
            reading.opaque &= bool((alpha >= most).all())
            cameras.cut(view, reading.color[view]).copy_(color)
            cameras.cut(view, reading.alpha[view]).copy_(alpha)
            reading.done(view)
    assert reading is not None
    if reading.empty or (masks and reading.opaque):
        reading.drop()
    if reading.empty:
        raise DataError(f"{folder}: all {len(shots)} images are fully transparent")
    if masks and reading.opaque:
        raise WithoutMasks(f"{folder}: all {len(shots)} images are fully opaque: {HOW_TO_MASK}")
    if masks:
        looked = range(0, len(shots), -(-len(shots) // LOOKED_AT))
        some = [[cameras.cut(v, r[v]) for r in (reading.color, reading.alpha)] for v in looked]
        try:
            require_fit(folder, [(color, coverage_of(alpha)) for color, alpha in some])
        except DataError:
            reading.drop()
            raise
        _tell_odd(folder, shots, [cameras.cut(v, a) for v, a in enumerate(reading.alpha)])
        if premultiplied(some):
            log.warning(
                "%s: the colours seem to be premultiplied by alpha, so they are dark along the "
                "object's edge. Save the photographs with straight alpha",
                folder,
            )
    return reading.finished()


def _tell_odd(folder: Path, shots: Sequence[Shot], alphas: Sequence[Tensor]) -> None:
    """Log which photographs show nothing of the object by their masks, and which nothing else."""
    nothing = [not bool(a.any()) for a in alphas]
    alone = [bool(a.min() > 0) and bool(a.min() == a.max()) for a in alphas]
    for what, odd in (("nothing of the object", nothing), ("nothing but the object", alone)):
        names = [shot.name for shot, said in zip(shots, odd, strict=True) if said]
        if names:
            log.warning(
                "%s: according to their masks, %d of %d photographs show %s: %s",
                *(folder, len(names), len(shots), what, some(names)),
            )


def _read_each(
    shots: Sequence[Shot], pinholes: Sequence[Lens], factor: int, masks: bool, upright: bool
) -> Generator[tuple[Tensor, Tensor], None, None]:
    """Colour and alpha of each photograph, in order; some are read at once."""
    grid_of = lru_cache(2)(sources)  # one lens often took all photographs, upright and across

    def read(shot: Shot, pinhole: Lens) -> tuple[Tensor, Tensor]:
        color, alpha = read_photo(shot.image, shot.mask, masks, shot.beside, upright)
        grid = grid_of(shot.lens, pinhole) if shot.lens.bent else None
        return resampled(color, alpha, factor, grid)

    pool = ThreadPoolExecutor(min(READERS, os.cpu_count() or 1))
    try:
        yield from pool.map(read, shots, pinholes)
    finally:
        pool.shutdown(cancel_futures=True)


def _words(cameras: Cameras) -> str:
    """The size of the pictures; of several, how many have which."""
    sizes, counts = cameras.size_of_each().unique(dim=0, return_counts=True)
    order = counts.argsort(descending=True, stable=True).tolist()
    if len(order) == 1:
        return f"{cameras.width}x{cameras.height}"
    if len(order) > SIZES_TOLD:
        return f"{len(order)} sizes up to {cameras.width}x{cameras.height}"
    *first, last = (f"{sizes[i, 0]}x{sizes[i, 1]} ({counts[i]})" for i in order)
    return f"{', '.join(first)} and {last}"


def cameras_of(poses: Sequence[np.ndarray], lenses: Sequence[Lens]) -> Cameras:
    """Pinholes, each with its picture's size."""
    pose = torch.from_numpy(np.stack(poses).astype(np.float32))
    focal = torch.tensor([lens.focal for lens in lenses], dtype=torch.float32)
    centre = torch.tensor([lens.centre for lens in lenses], dtype=torch.float32)
    return Cameras(pose, focal, centre, *sizes_of([(lens.width, lens.height) for lens in lenses]))


def read_photo(
    path: Path,
    mask: Path | None = None,
    masks: bool = True,
    beside: Path | None = None,
    upright: bool = False,
) -> tuple[Tensor, Tensor]:
    """Colour [H, W, 3] and alpha [H, W] of one photograph, stored as in `Photos`.

    Without a mask: its alpha channel, or the mask beside it where that is the same all over or not
    there. The colour of an EXR with alpha is premultiplied, as OpenEXR has it, and is divided;
    negative values, which denoisers and filters leave, become 0.

    Args:
        masks: False to look for none: alpha is 1 everywhere.
        upright: as in `masks.laid_over`.
    """
    image = read_image(path, in_srgb=True)
    channels = image.shape[-1]
    if channels not in (3, 4):
        raise DataError(f"{path}: expected an image with 3 or 4 channels, got {channels}")
    color, linear = image[..., :3], image.is_floating_point()
    alpha = image[..., 3] if channels == 4 else None
    opaque = 1 if linear else 255
    tells = alpha is not None and bool((alpha < alpha.max()).any())
    if linear and alpha is not None and (tells or (mask or beside) is None):
        alpha = alpha.clamp(0, 1)
        color = torch.where(alpha[..., None] > 0, color / alpha[..., None], 0.0)
    if not masks:
        alpha, mask = torch.full_like(color[..., 0], opaque), None
    elif mask is None and not tells:
        mask = beside
    if mask is not None:
        alpha = read_mask(mask, color.shape[1], color.shape[0], path, upright)
    if alpha is None:
        stem = path.stem.removesuffix("_rgb")
        raise WithoutMasks(
            f"{path}: expected an alpha channel or a mask {stem}_mask.png, got neither: "
            f"{HOW_TO_MASK}"
        )
    return (color.clamp_min(0) if linear else color).contiguous(), alpha.contiguous()


def resampled(
    color: Tensor, alpha: Tensor, factor: int, grid: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Stored colour and alpha, straightened and then shrunk in linear light; stored as before, and
    as they are where there is neither to do.

    What a mask hides keeps single colours, that of a pixel near the middle of each square: how the
    surroundings look is asked, and not how exactly.
    """
    if factor == 1 and grid is None:
        return color, alpha
    height, width = (n // factor for n in alpha.shape)
    colors, alphas = color.new_zeros(height, width, 3), alpha.new_zeros(height, width)
    there = alpha > 0 if grid is None else _looked_up(alpha > 0, grid)
    top, bottom = _span(there.any(1), factor)
    left, right = _span(there.any(0), factor)
    whole = color if grid is None else _premultiplied(color, alpha)
    rows = max(1, BAND // (factor * color.shape[1]))  # in bands, to save memory
    for row in range(top, bottom, rows):
        into = slice(row, min(row + rows, bottom)), slice(left, right)
        of = tuple(slice(factor * s.start, factor * s.stop) for s in into)
        if grid is None:
            part = _premultiplied(color[of], alpha[of])
        else:
            part = straighten(whole, grid[of])
        colors[into], alphas[into] = _stored(shrink(part, factor), color.dtype, alpha.dtype)
    hidden = alphas == 0
    colors[hidden] = _picked(color, factor, grid)[hidden]
    return colors, alphas


def _picked(color: Tensor, factor: int, grid: Tensor | None) -> Tensor:
    """Stored colours [H // factor, W // factor, 3] of pixels near the middles of squares."""
    height, width = color.shape[:2]
    middle = slice(factor // 2, None, factor)
    if grid is None:
        return color[middle, middle][: height // factor, : width // factor]
    size = torch.tensor([width, height])
    column, row = ((grid[middle, middle] + 1) / 2 * size).long().unbind(-1)
    picked = color[row.clamp(0, height - 1), column.clamp(0, width - 1)]
    return picked[: height // factor, : width // factor]


def _looked_up(there: Tensor, grid: Tensor) -> Tensor:
    """Where lookups [H, W, 2] of `straighten` may find what is true in a picture: [H, W]."""
    inside = torch.ones(grid.shape[:2], dtype=torch.bool)
    for axis, found in enumerate((there.any(0), there.any(1))):
        first, end = _span(found, 1)
        # The centre of a pixel may be one from that of the next. Beyond the border is the border
        low = 2 * (first - 1) / len(found) - 1 if first else -torch.inf
        high = 2 * (end + 1) / len(found) - 1 if end < len(found) else torch.inf
        inside &= (grid[..., axis] > low) & (grid[..., axis] < high)
    return inside if there.any() else torch.zeros_like(inside)


def _span(there: Tensor, factor: int) -> tuple[int, int]:
    """The first and the end of the blocks of `factor` numbers [N] of which one is true."""
    found = there.nonzero()[:, 0]
    if not len(found):
        return 0, 0
    return int(found[0]) // factor, min(int(found[-1]) // factor + 1, len(there) // factor)


def _premultiplied(color: Tensor, alpha: Tensor) -> Tensor:
    """Stored colour and alpha as linear light times coverage, and coverage: [H, W, 4] float32.

    Channel by channel in memory, as what comes next wants it.
    """
    if color.dtype == torch.uint8:  # a table is many times as fast as the curve
        color = torch.from_numpy(LINEAR[color.numpy()])
    linear, coverage = decode(color, alpha)
    planes = torch.empty(4, *alpha.shape)
    for plane, channel in zip(planes, linear.unbind(-1), strict=False):
        torch.mul(channel, coverage, out=plane)
    planes[3] = coverage
    return planes.movedim(0, -1)


def _stored(picture: Tensor, of_color: torch.dtype, of_alpha: torch.dtype) -> tuple[Tensor, Tensor]:
    """Straight colour and alpha of a picture from `_premultiplied`, as files have them."""
    linear, coverage = picture[..., :3], picture[..., 3]
    linear = torch.where(coverage[..., None] > 0, linear / coverage[..., None], 0.0)
    if of_color == torch.uint8:
        linear = (255 * linear_to_srgb(linear)).round().to(torch.uint8)
    if of_alpha == torch.uint8:
        coverage = (255 * coverage).round().to(torch.uint8)
    return linear.contiguous(), coverage.contiguous()


def every_eighth(folder: Path, shots: Sequence[Shot], split: str) -> list[Shot]:
    """The test split: the first of every eight photographs in order of names; train: the others."""
    if split not in ("train", "test"):
        raise DataError(f"{folder}: expected train or test as the split, got {split}")
    ordered = sorted(shots, key=lambda shot: shot.name)
    chosen = [s for i, s in enumerate(ordered) if (i % TEST_EVERY == 0) == (split == "test")]
    if not chosen:
        raise DataError(f"{folder}: expected at least two photographs, found {len(ordered)}")
    return chosen


def near_origin(shots: Sequence[Shot], places: np.ndarray) -> tuple[list[Shot], list[str]]:
    """The shots in a world that float32 can hold, and what was done.

    Surveyed worlds have coordinates of the Earth, with cameras millions of metres from the origin.
    Such a world is moved by whole units, so that the cameras' mean is near its origin.

    Args:
        places: [N, 3] of the cameras that say so, of all splits or of one.
    """
    middle = places.mean(0)
    apart = np.linalg.norm(places - middle, axis=1).mean()
    if not apart or np.linalg.norm(middle) <= FAR * apart:
        return list(shots), []
    shift = -np.round(middle)
    moved = in_moved_world(shots, np.column_stack([np.eye(3), shift]))
    return moved, ["world moved by " + " ".join(str(int(x)) for x in shift)]


def in_moved_world(shots: Sequence[Shot], motion: np.ndarray) -> list[Shot]:
    """The shots in a world that a rotation and a translation [3, 4] lead to."""
    return [
        replace(
            shot,
            pose=after(motion, shot.pose),
            moved=motion if shot.moved is None else after(motion, shot.moved),
        )
        for shot in shots
    ]


def after(motion: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """A pose or motion [3, 4], and then another motion."""
    turned = motion[:, :3] @ pose
    return np.column_stack([turned[:, :3], turned[:, 3] + motion[:, 3]])


def upright(shots: Sequence[Shot]) -> tuple[list[Shot], list[str]]:
    """The shots in a world whose +Z is up and whose origin is not far away, and what was done.

    The world of structure from motion has any direction. Cameras are held level, mostly, or a
    quarter turn from that, as EXIF then says: what is to the right in their photographs lies in the
    horizontal plane, and up is what is across to all of that. A world
    that is upright already, to within LEAN, stays as it is; and one whose cameras do not agree.
    """
    shots, moved = near_origin(shots, np.stack([shot.pose[:, 3] for shot in shots]))
    held = np.stack([_right_and_up(shot) for shot in shots])
    up = up_direction(held)
    if up is None:
        return shots, [*moved, "world not rotated, because the cameras do not show which way is up"]
    if up[2] >= math.cos(LEAN):
        return shots, moved
    turned = in_moved_world(shots, np.column_stack([turn_to_z(up), np.zeros(3)]))
    return turned, [*moved, "world rotated so that +Z is up"]


def turned_up(
    folder: Path,
    split: str,
    kind: str,
    shots: Sequence[Shot],
    remarks: Sequence[str] = (),
    chosen: Callable[[Path, Sequence[Shot], str], list[Shot]] = every_eighth,
) -> Listed:
    """The `chosen` split of photographs whose world is turned so that +Z is up, where it is not
    yet.

    The world keeps its scale, and its origin, too, unless that is far away.
    """
    shots, moved = upright(shots)
    return Listed(kind, chosen(folder, shots, split), [*remarks, *moved])


def listed_split(folder: Path, shots: Sequence[Shot], split: str) -> list[Shot]:
    """The split of train_id.txt and test_id.txt, as in Stanford-ORB; without, every eighth."""
    files = {name: folder / f"{name}_id.txt" for name in ("train", "test")}
    if split not in files or not all(file.is_file() for file in files.values()):
        return every_eighth(folder, shots, split)
    path, by_name = files[split], {shot.image.stem: shot for shot in shots}
    text = inside(path, str(path)).read_text(encoding="utf-8", errors="replace")
    lines = text.splitlines()
    names = [line.strip() for line in lines if line.strip()]
    found = [by_name[stem] for name in names if (stem := Path(name).stem) in by_name]
    missing = [name for name in names if Path(name).stem not in by_name]
    if not names:
        raise DataError(f"{path}: expected names of photographs, but the file is empty")
    left_out(str(path), missing, len(names))
    return found


def size_of(image: Tensor) -> str:
    return f"{image.shape[1]}x{image.shape[0]}"


def _right_and_up(shot: Shot) -> np.ndarray:
    """To the right and up, in the world, of a photograph as it is looked at: [2, 3]."""
    right, up = shot.pose[:, 0], shot.pose[:, 1]
    match orientation(shot.image):  # 2, 4, 5 and 7 are mirrored: no camera makes them
        case 3:
            right, up = -right, -up
        case 6:
            right, up = up, -right
        case 8:
            right, up = -up, right
    return np.stack([right, up])


def turn_to_z(up: np.ndarray) -> np.ndarray:
    """The smallest rotation that takes a unit vector to +Z."""
    if up[2] < -1 + 1e-9:
        return np.diag([1.0, -1.0, -1.0])
    x, y, z = up
    cross = np.array([[0, 0, -x], [0, 0, -y], [x, y, 0]])
    return np.eye(3) + cross + cross @ cross / (1 + z)


def up_direction(held: np.ndarray) -> np.ndarray | None:
    """The unit vector that is across to what is to the right in all photographs, if there is one.

    Args:
        held: [V, 2, 3] to the right and up, in the world, of each photograph as it is looked at.
    """
    right, mean_up = held[:, 0], held[:, 1].mean(0)
    _, spread, directions = np.linalg.svd(right, full_matrices=True)
    up = directions[2] * (1 if directions[2] @ mean_up >= 0 else -1)
    if len(spread) < 2 or spread[1] < 0.1 * spread[0] or up @ mean_up < math.sin(LEAN):
        return None
    return up


def check_name(name: str, where: str) -> None:
    """Refuse, by a DataError, names of views with which files would not stay in their folder."""
    if name in ("", "..") or Path(name).name != name or not system.can_be_a_name(name):
        raise DataError(f"{where}: expected a name that is valid as a file name, got {name!r}")


def _check(folder: Path, shots: Sequence[Shot], downscale: int) -> None:
    """Names and sizes, before anything large is read."""
    names: set[str] = set()
    for shot in shots:
        check_name(shot.name, shot.where)
        if (key := system.file_key(shot.name)) in names:
            raise DataError(f"{shot.where}: the name {shot.name} of {shot.image} occurs twice")
        names.add(key)
        width, height = shot.lens.width, shot.lens.height
        if downscale > min(width, height):
            raise DataError(
                f"{folder}: downscale={downscale} is too large for {width}x{height} images",
                "downscale",
            )
