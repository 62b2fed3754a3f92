"""What Stanford-ORB has beside its photographs, in the folders above a scene.

blender_HDR/<scene>/                                    photographs, in the layout of NeRF
ground_truth/<scene>/surface_normal/<name>.npy          [H, W, 3], axes of the camera
ground_truth/<scene>/z_depth/<name>.npy                 [H, W] along -Z; 0 or less: nothing there
ground_truth/<scene>/pseudo_gt_albedo/<name>.png        sRGB

Camera axes are x right, y up, z backwards.

Source: the public code of Kuang et al. 2023 (Stanford-ORB), README and
scripts/preprocess.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from univoxel.data.arrays import read_npy
from univoxel.data.base import Photos
from univoxel.errors import DataError

FILES = {
    "albedo": "pseudo_gt_albedo/{}.png",
    "normal": "surface_normal/{}.npy",
    "depth": "z_depth/{}.npy",
}


def orb_files(photos: Photos, view: int) -> dict[str, Path]:
    """The files of truth of a view, by what they hold, as far as there are any."""
    folder = photos.folder.resolve()
    truth = folder.parent.parent / "ground_truth" / folder.name
    found = {key: truth / name.format(photos.names[view]) for key, name in FILES.items()}
    return {key: path for key, path in found.items() if path.is_file()}


def orb_geometry(path: Path, key: str, camera_to_world: Tensor) -> tuple[Tensor, Tensor]:
    """A file of normals or depths: its values, normals in the world, and where there are any.

    Args:
        camera_to_world: [3, 4] of its view.

    Returns:
        [H, W, 3] or [H, W] float32, 0 where there is nothing, and [H, W] float32 of 0 and 1.
    """
    array = read_npy(path)
    shape = "[H, W, 3]" if key == "normal" else "[H, W]"
    fits = array.ndim == 3 and array.shape[2] == 3 if key == "normal" else array.ndim == 2
    if not fits or array.dtype.kind != "f" or not np.isfinite(array).all():
        raise DataError(
            f"{path}: expected finite {shape}, got {list(array.shape)} of {array.dtype}"
        )
    value = torch.from_numpy(array.astype(np.float32))
    if key == "depth":
        return value.clamp_min(0), (value > 0).float()
    there = value.norm(dim=-1) > 0.5  # unit, or 0
    world = torch.nn.functional.normalize(value, dim=-1) @ camera_to_world[:, :3].T
    return world * there[..., None], there.float()
