"""What Stanford-ORB has beside its photographs, in the folders above a scene.

blender_HDR/<scene>/                                    photographs, in the layout of NeRF
ground_truth/<scene>/surface_normal/<name>.npy          [H, W, 3], axes of the camera
ground_truth/<scene>/z_depth/<name>.npy                 [H, W] along -Z; 0 or less: nothing there
ground_truth/<scene>/pseudo_gt_albedo/<name>.png        sRGB
ground_truth/<scene>/env_map/<name>.exr                 the light in which <name> was photographed,
                                                        around its camera: -Z in the middle, X to
                                                        the right, Y on top

Camera axes are x right, y up, z backwards.

Source: the public code of Kuang et al. 2023 (Stanford-ORB), README, scripts/preprocess and
orb/utils/env_map.py.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from univoxel.camera import Cameras
from univoxel.data.arrays import read_npy
from univoxel.data.base import Photos
from univoxel.data.maps import read_map
from univoxel.envmap import EnvMap, lookup
from univoxel.errors import DataError
from univoxel.sphere import latlong_directions

FILES = {
    "albedo": "pseudo_gt_albedo/{}.png",
    "normal": "surface_normal/{}.npy",
    "depth": "z_depth/{}.npy",
}


# From the axes of a camera to those of maps, where the middle is +X and the top +Z
TO_MAP = torch.tensor([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])


def scene_folders(folder: Path) -> tuple[Path, Path]:
    """The folder of a scene's linear photographs, and that of its truth.

    Raises:
        DataError: the folder is no scene of Stanford-ORB.
    """
    folder = folder.resolve()
    root = folder.parent.parent
    truth = root / "ground_truth" / folder.name
    if not truth.is_dir():
        raise DataError(f"{folder}: expected a scene of Stanford-ORB with {truth}, got none there")
    return root / "blender_HDR" / folder.name, truth


def orb_light(path: Path, camera: Cameras) -> EnvMap:
    """The light around a camera, in the world.

    Raises:
        DataError: the file cannot be used.
    """
    local = read_map(path)
    to_camera = camera.camera_to_world[0, :, :3].T
    direction = latlong_directions(len(local.radiance)) @ (TO_MAP @ to_camera).T
    return EnvMap(lookup(local, direction).clamp_min(0))


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
