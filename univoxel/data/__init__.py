"""Photographs, cameras and ground truth from files."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from univoxel.data import colmap, photogrammetry, research, transforms
from univoxel.data.image_cache import keep_photos, looking_in
from univoxel.data.load_images import Listed, read_shots
from univoxel.data.path_sandbox import staying_in
from univoxel.data.photos import Photos, Truth
from univoxel.data.transforms import load_cameras
from univoxel.data.truth import load_points, load_relit, load_truth, relight_maps
from univoxel.errors import DataError, some

__all__ = [
    "DataError",
    "Photos",
    "Truth",
    "has_cameras",
    "keep_photos",
    "load_cameras",
    "load_photos",
    "load_points",
    "load_relit",
    "load_truth",
    "relight_maps",
    "splits_of",
]


def _file(*names: str) -> Callable[[Path, str], Path | None]:
    """Finds the first of some files in a folder."""
    return lambda folder, _: next((p for name in names if (p := folder / name).is_file()), None)


# What a folder of a layout is told by, for a split; and, of what that finds, the photographs of the
# split, or a DataError. In this order: data sets with splits of their own come first
_LAYOUTS: tuple[tuple[Callable[[Path, str], Any], Callable[[Path, str, Any], Listed]], ...] = (
    (transforms.is_blender, transforms.list_blender),
    (_file("transforms.json"), transforms.list_nerfstudio),
    (colmap.models_in, colmap.list_colmap),
    (_file("poses_bounds.npy"), research.list_llff),
    (_file("cameras_sphere.npz", "cameras.npz", "cameras_large.npz"), research.list_idr),
    (_file("inputs/sfm_scene.json"), research.list_neilf),
    (photogrammetry.polycam_place, photogrammetry.list_polycam),
    (photogrammetry.metashape_file, photogrammetry.list_metashape),
    (photogrammetry.realitycapture_file, photogrammetry.list_realitycapture),
    (research.is_tensoir, research.list_tensoir),
)


def load_photos(
    folder: str | Path,
    split: str = "train",
    downscale: int = 0,
    masks: bool | Path = True,
    kept: Path | None = None,
    allow_outside: bool = False,
) -> Photos:
    """Read the photographs of one split; the layout of the folder is detected.

    Lens distortion is removed. docs/reference/data-sets.md describes the layouts.

    Args:
        downscale: reduce photographs to 1/N, >= 1; 0: to what grids can use, 1 for photographs of
            up to 1499 pixels.
        masks: False: whole images, without masks; or a folder of masks with the same stems.
        kept: a file of `keep_photos`, which may not exist yet. If it has these photographs and
            their files are unchanged, the pixels are read from it.
        allow_outside: whether files and links may lead outside the folder.

    Raises:
        DataError: one line that names the file, and what was expected and found.
    """
    folder = Path(folder)
    if not folder.is_dir():
        what = "a file" if folder.exists() else "nothing there"
        raise DataError(f"{folder}: expected a folder with a scene, got {what}")
    for find, listed in _LAYOUTS:
        if found := find(folder, split):
            with looking_in(kept), staying_in(None if allow_outside else folder):
                return read_shots(folder, split, listed(folder, split, found), downscale, masks)
    files = sorted(path.name for path in folder.iterdir())
    raise DataError(
        f"{folder}: expected photographs with their cameras, got "
        f"{some(files) or 'an empty folder'}. If these are photographs without cameras, run "
        f"`univoxel capture {folder} --out DIR` (looked for transforms_{split}.json, "
        "transforms.json, a COLMAP model (cameras and images, .bin or .txt) in sparse/0, "
        "sparse, colmap/sparse/0 or the folder itself, poses_bounds.npy, cameras_sphere.npz, "
        "inputs/sfm_scene.json, keyframes/corrected_cameras, Metashape XML, RealityCapture CSV, "
        f"{split}_000/metadata.json)"
    )


def has_cameras(folder: Path) -> bool:
    """Whether a folder has one of the layouts: photographs whose cameras are known."""
    return folder.is_dir() and any(find(folder, "train") for find, _ in _LAYOUTS)


def splits_of(folder: Path) -> list[str]:
    """The splits that a folder has: train, and test unless its transforms name none."""
    named = [(folder / f"transforms_{split}.json").is_file() for split in ("train", "test")]
    return ["train"] if named == [True, False] else ["train", "test"]
