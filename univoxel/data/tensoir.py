"""The layout of TensoIR-Synthetic, and of NeRFactor's scenes.

<split>_NNN/metadata.json       imw, imh, cam_angle_x, cam_transform_mat: 16 numbers with commas
<split>_NNN/rgba_<light>.png    photograph under a light, straight alpha, sRGB; or rgba.png
"""

from __future__ import annotations

import math
from pathlib import Path

from univoxel.data.base import Photos
from univoxel.data.images import image_size
from univoxel.data.inside import inside
from univoxel.data.missing import left_out
from univoxel.data.shots import Shot, read_shots
from univoxel.data.transforms import lens_of, number, pose_of, short
from univoxel.errors import DataError
from univoxel.files import read_json

LIGHT = "sunset"  # of the photographs that the data set is trained on, where there are several


def is_tensoir(folder: Path, split: str) -> bool:
    return any(folder.glob("*_[0-9][0-9][0-9]/metadata.json"))


def load_tensoir(
    folder: Path, split: str = "train", downscale: int = 0, masks: bool | Path = True
) -> Photos:
    """Photographs and cameras of one split, under the light of the training views.

    Raises:
        DataError: one line that names the file, what was expected and what came.
    """
    views = sorted(path.parent for path in folder.glob(f"{split}_*/metadata.json"))
    if not views:
        raise DataError(f"{folder}: expected {split}_000/metadata.json and more, got none")
    picture = photographed(folder)
    there = [view for view in views if (view / picture).is_file()]
    missing = [view / picture for view in views if view not in there]
    remarks = left_out(str(folder), missing, len(views))
    shots = [_shot(view, picture) for view in there]
    kind = f"TensoIR layout ({picture})"
    return read_shots(folder, kind, split, shots, downscale, remarks, masks)


def photographed(folder: Path) -> str:
    """Name of the pictures that are trained on: rgba.png, rgba_sunset.png or the only one."""
    views = sorted(path.parent for path in folder.glob("*_[0-9][0-9][0-9]/metadata.json"))
    views.sort(key=lambda view: not view.name.startswith("train_"))
    first = next((view for view in views if any(view.glob("rgba*.png"))), views[0])
    names = sorted(path.name for path in first.glob("rgba*.png"))
    for name in ("rgba.png", f"rgba_{LIGHT}.png"):
        if name in names:
            return name
    if len(names) != 1:
        raise DataError(
            f"{first}: expected rgba.png, rgba_{LIGHT}.png or one rgba_<light>.png, got "
            + (", ".join(names) or "none")
        )
    return names[0]


def _shot(view: Path, picture: str) -> Shot:
    path = view / "metadata.json"
    try:
        meta = read_json(inside(path, str(path)))
        text = meta["cam_transform_mat"]
        values = [float(value) for value in text.split(",")]
    except DataError:
        raise
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise DataError(
            f"{path}: expected JSON with cam_transform_mat, numbers between commas, got {error!r}"
        ) from None
    if len(values) != 16:
        raise DataError(f"{path}: expected 16 numbers in cam_transform_mat, got {short(text)}")
    image = view / picture
    angle = number(meta, "cam_angle_x", str(path), 0.0, math.pi)
    camera = {"camera_angle_x": angle}
    camera |= {to: meta[key] for to, key in (("w", "imw"), ("h", "imh")) if key in meta}
    return Shot(
        name=view.name,
        where=str(path),
        image=image,
        mask=None,
        pose=pose_of([values[i : i + 4] for i in range(0, 16, 4)], str(path)),
        lens=lens_of(camera, str(path), *image_size(image)),
    )
