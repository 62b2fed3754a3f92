"""Conventions that layouts of other programs share: axes, names, numbers."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from univoxel.data.lens import Lens
from univoxel.data.load_images import Listed, Shot, every_eighth, upright
from univoxel.data.path_sandbox import inside, left_out
from univoxel.data.transforms import listed_image, short
from univoxel.errors import DataError

TO_OPENGL = np.diag([1.0, -1.0, -1.0])  # of camera axes: x right, y down, z forward in OpenCV
SKEW = 0.5  # pixels by which lines may lean and are taken as upright: no mask is as sharp


def find_photo(folder: Path, name: str, where: str) -> Path | None:
    """A photograph by its name in a list of them: in images/ or in the folder itself."""
    return listed_image(folder / "images", name, where) or listed_image(folder, name, where)


def turned_up(
    folder: Path,
    split: str,
    kind: str,
    shots: Sequence[Shot],
    remarks: Sequence[str] = (),
    chosen: Callable[[Path, Sequence[Shot], str], list[Shot]] = every_eighth,
) -> Listed:
    """A split of photographs whose world is turned so that +Z is up, where it is not yet.

    The world keeps its scale, and its origin, too, unless that is far away.

    Args:
        chosen: the shots of a split.
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


def check_skew(skew: float, lens: Lens, where: str) -> None:
    """Raise where x and y axes of a camera's pixels are not square to one another.

    Args:
        skew: pixels along x for each focal length along y, as in a matrix of intrinsics.
    """
    lean = abs(skew) * lens.height / 2 / lens.focal[1]
    if not lean <= SKEW:
        raise DataError(
            f"{where}: expected perpendicular rows and columns of pixels, got rows shifted by up "
            f"to {lean:.3g} pixels (skew {skew:.4g})"
        )


def parsed(text: str | None, what: str, where: str) -> float:
    """A finite number from text; a DataError where it is missing or another text."""
    try:
        value = float(text) if text is not None else math.nan
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        came = "nothing" if text is None else short(text)
        raise DataError(f"{where}: expected a number for {what}, got {came}")
    return value
