"""What the layouts of other programs share: axes, names, sizes, worlds far away."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from univoxel.data.images import image_size, turn_note
from univoxel.data.inside import inside
from univoxel.data.lens import Lens, checked
from univoxel.data.missing import left_out
from univoxel.data.shots import Shot, every_eighth
from univoxel.data.transforms import listed_image, short
from univoxel.errors import DataError, UserError

TO_OPENGL = np.diag([1.0, -1.0, -1.0])  # of camera axes: x right, y down, z forward in OpenCV
TALLER = 0.01  # share by which a shrunk picture may be taller or wider than its original
SKEW = 0.5  # pixels by which lines may lean and are taken as upright: no mask is as sharp
# Distance of cameras from the origin, in their distances from one another, beyond which float32
# loses what they see: it has 7 digits, and pixels need 4
FAR = 1000


def find_photo(folder: Path, name: str, where: str) -> Path | None:
    """A photograph by its name in a list of them: in images/ or in the folder itself."""
    return listed_image(folder / "images", name, where) or listed_image(folder, name, where)


def listed_split(folder: Path, shots: Sequence[Shot], split: str) -> list[Shot]:
    """The split of train_id.txt and test_id.txt, as of Stanford-ORB; without, every eighth."""
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
        raise DataError(f"{path}: expected names of photographs, got an empty file")
    left_out(str(path), missing, len(names))
    return found


def fitted(lens: Lens, picture: Path, where: str) -> Lens:
    """The lens of a picture that may be smaller than those that the lens was found with.

    Raises:
        DataError: the picture has another shape.
    """
    w, h = image_size(picture)
    across, down = w / lens.width, h / lens.height
    if abs(across / down - 1) > TALLER + 1 / min(w, h):
        raise DataError(
            f"{picture}: expected a picture of the shape {lens.width:g}x{lens.height:g} as in "
            f"{where}, got {w}x{h}{turn_note(picture)}"
        )
    (fx, fy), (cx, cy) = lens.focal, lens.centre
    focal, centre = (fx * across, fy * down), (cx * across, cy * down)
    try:
        return checked(replace(lens, width=w, height=h, focal=focal, centre=centre))
    except UserError as error:
        raise DataError(f"{where}: {error}") from None


def check_skew(skew: float, lens: Lens, where: str) -> None:
    """Raise where x and y axes of a camera's pixels are not square to one another.

    Args:
        skew: pixels along x for each focal length along y, as in a matrix of intrinsics.
    """
    lean = abs(skew) * lens.height / 2 / lens.focal[1]
    if not lean <= SKEW:
        raise DataError(
            f"{where}: expected pixels with axes square to one another, got some that lean by "
            f"{lean:.3g} pixels (skew {skew:.4g})"
        )


def near_origin(shots: Sequence[Shot]) -> tuple[list[Shot], list[str]]:
    """The shots in a world that float32 can hold, and what was done.

    Surveyed worlds have coordinates of the Earth, with cameras millions of metres from the origin.
    Such a world is moved by whole units, so that the cameras' mean is near its origin.
    """
    places = np.stack([shot.pose[:, 3] for shot in shots])
    middle = places.mean(0)
    if np.linalg.norm(middle) <= FAR * np.linalg.norm(places - middle, axis=1).mean():
        return list(shots), []
    offset = np.round(middle)
    moved = [
        replace(s, pose=np.column_stack([s.pose[:, :3], s.pose[:, 3] - offset])) for s in shots
    ]
    return moved, ["world moved by " + " ".join(f"{-x:.0f}" for x in offset)]


def parsed(text: str | None, what: str, where: str) -> float:
    """A finite number from text.

    Raises:
        DataError: it is missing or no such number.
    """
    try:
        value = float(text) if text is not None else math.nan
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        came = "nothing" if text is None else short(text)
        raise DataError(f"{where}: expected a number as {what}, got {came}")
    return value
