"""The layout of NeRF-synthetic scenes as written from Blender, and of Synthetic4Relight.

transforms_<split>.json     camera_angle_x (or fl_x, fl_y, cx, cy), frames: file_path and
                            transform_matrix, camera-to-world with OpenGL axes
<file_path>[.png]           RGBA photograph, straight alpha, sRGB
<file_path>_rgba.png        the same
<file_path>_rgb.exr         linear photograph, with <file_path>_mask.png
test/gt/<name>.npz          ground truth of a test view
relight/<map>/<name>.png    test views under envmaps/<map>.hdr
points.npz                  points on the true surface
"""

from __future__ import annotations

import json
import math
import zipfile
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from univoxel.camera import Cameras
from univoxel.data.base import DataError, Photos, Truth
from univoxel.data.images import SUFFIXES, read_image

# How far the axes of a camera may be from orthonormal. Six printed digits give 1e-6; what is off
# by more than this was scaled or sheared.
RIGID_TOLERANCE = 1e-3
DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")


def load_blender(folder: str | Path, split: str = "train") -> Photos:
    """Read photographs and cameras of one split.

    Photographs are RGBA PNG (sRGB), or linear EXR with alpha or with a mask in PNG beside it. The
    colour of an EXR with alpha is premultiplied, as OpenEXR has it, and is divided; negative
    values, which denoisers and filters leave, become 0.

    Raises:
        DataError: one line that names the file, what was expected and what came.
    """
    folder = Path(folder)
    root, path = _read_transforms(folder, split)
    frames = root.get("frames")
    if not isinstance(frames, list) or not frames:
        raise DataError(f"{path}: expected a list of frames, got {_short(frames)}")

    names: list[str] = []
    colors: list[Tensor] = []
    alphas: list[Tensor] = []
    for index, frame in enumerate(frames):
        where = f"{path}: frame {index}"
        if not isinstance(frame, dict) or not isinstance(frame.get("file_path"), str):
            raise DataError(f"{where}: expected an object with a file_path, got {_short(frame)}")
        image = find_image(folder, frame["file_path"], where)
        name = _name(frame["file_path"])
        if name in names:
            raise DataError(f"{where}: the name {name} of {frame['file_path']} came before")
        color, alpha = read_photo(image)
        if colors and color.shape != colors[0].shape:
            raise DataError(
                f"{image}: expected {_size(colors[0])} pixels like {names[0]}, got {_size(color)}"
            )
        if colors and color.dtype != colors[0].dtype:
            raise DataError(f"{image}: expected the format of {names[0]} in all photographs")
        names.append(name)
        colors.append(color)
        alphas.append(alpha)
    _check_size(path, root, colors[0])
    if not any(bool(alpha.any()) for alpha in alphas):
        raise DataError(f"{path}: all {len(alphas)} pictures are fully transparent")
    if len({alpha.dtype for alpha in alphas}) > 1:
        alphas = [a if a.is_floating_point() else a / 255 for a in alphas]

    height, width = colors[0].shape[:2]
    return Photos(
        folder=folder,
        names=names,
        color=torch.stack(colors),
        alpha=torch.stack(alphas),
        cameras=_cameras(path, root, frames, width, height),
    )


def find_image(folder: Path, file_path: str, where: str) -> Path:
    """The picture that a frame's file_path means, with or without its extension."""
    endings = ("", ".png", "_rgba.png", "_rgb.exr", ".exr", ".jpg")
    for ending in endings:
        if (path := folder / (file_path + ending)).is_file():
            return path
    raise DataError(
        f"{where}: no picture {folder / file_path} (looked for the endings "
        f"{', '.join(ending or 'none' for ending in endings)})"
    )


def read_photo(path: Path) -> tuple[Tensor, Tensor]:
    """Colour [H, W, 3] and alpha [H, W] of one photograph, stored as in `Photos`."""
    image = read_image(path)
    channels = image.shape[-1]
    if channels not in (3, 4):
        raise DataError(f"{path}: expected a picture with 3 or 4 channels, got {channels}")
    color = image[..., :3]
    linear = image.is_floating_point()
    mask = path.with_name(path.stem.removesuffix("_rgb") + "_mask.png")
    if channels == 4:
        alpha = image[..., 3].clamp(0, 1) if linear else image[..., 3]
        if linear:
            color = torch.where(alpha[..., None] > 0, color / alpha[..., None], 0.0)
    elif mask.is_file():
        alpha = read_image(mask)[..., 0]
        if alpha.shape != color.shape[:2]:
            raise DataError(f"{mask}: expected {_size(color)} pixels, got {_size(alpha)}")
    else:
        raise DataError(f"{path}: expected an alpha channel or a mask {mask.name}, got neither")
    return (color.clamp_min(0) if linear else color).contiguous(), alpha.contiguous()


def load_truth(folder: str | Path, name: str) -> Truth:
    """Ground truth of a test view: test/gt/<name>.npz; an empty record where there is none.

    The mask is where alpha > 250 of 255, so that no silhouette pixel counts.
    """
    path = Path(folder) / "test" / "gt" / f"{name}.npz"
    if not path.is_file():
        return Truth()
    arrays = _read_npz(path)
    shape = arrays["alpha"].shape if "alpha" in arrays else None
    if shape is None or len(shape) != 2:
        raise DataError(f"{path}: expected an array alpha [H, W], got {_shapes(arrays)}")
    wanted = {"albedo": (*shape, 3), "roughness": shape, "normal": (*shape, 3), "depth": shape}
    fields: dict[str, Tensor] = {"mask": torch.from_numpy(arrays["alpha"] > 250)}
    for key, size in wanted.items():
        if key not in arrays:
            continue
        value = arrays[key].astype(np.float32)
        if value.shape != size or not np.isfinite(value).all():
            raise DataError(
                f"{path}: expected finite {key} of shape {list(size)}, got {list(value.shape)}"
            )
        fields[key] = torch.from_numpy(value)
    return Truth(**fields)


def relight_maps(folder: str | Path) -> dict[str, Path]:
    """The environment maps under which relit test views exist, by name; empty if there are none."""
    folder = Path(folder)
    maps = {}
    for pictures in sorted((folder / "relight").glob("*/")):
        found = [
            path
            for suffix in (".hdr", ".exr")
            if (path := folder / "envmaps" / (pictures.name + suffix)).is_file()
        ]
        if not found:
            raise DataError(
                f"{pictures}: expected its map {folder / 'envmaps' / pictures.name}.hdr, "
                f"got nothing there"
            )
        maps[pictures.name] = found[0]
    return maps


def load_relit(folder: str | Path, map: str, names: list[str]) -> tuple[Tensor, Tensor]:
    """Test views under another map: colour [V, H, W, 3] and alpha [V, H, W] as in `Photos`."""
    folder = Path(folder) / "relight" / map
    pictures = [read_photo(find_image(folder, name, f"{folder}")) for name in names]
    for name, (color, _) in zip(names, pictures, strict=True):
        if color.shape != pictures[0][0].shape:
            raise DataError(
                f"{folder / name}: expected {_size(pictures[0][0])} pixels, got {_size(color)}"
            )
    return torch.stack([c for c, _ in pictures]), torch.stack([a for _, a in pictures])


def load_points(folder: str | Path) -> Tensor | None:
    """Points [P, 3] float32 on the true surface, world: points.npz, or None where there is none."""
    path = Path(folder) / "points.npz"
    if not path.is_file():
        return None
    arrays = _read_npz(path)
    points = arrays.get("points")
    if points is None or points.ndim != 2 or points.shape[1] != 3 or not len(points):
        raise DataError(f"{path}: expected an array points [P, 3], got {_shapes(arrays)}")
    if not np.isfinite(points).all():
        raise DataError(f"{path}: points hold NaN or infinity")
    return torch.from_numpy(points.astype(np.float32))


def load_cameras(path: str | Path, size: int) -> tuple[list[str], Cameras]:
    """Names and cameras of a file in the form of transforms_<split>.json, without pictures.

    Args:
        size: pixels, width and height of the pictures to come where the file gives no w and h.

    Returns:
        A name for each frame, from its file_path or its number, and the cameras.

    Raises:
        DataError: one line that names the file, what was expected and what came.
    """
    path = Path(path)
    if not path.is_file():
        raise DataError(f"{path}: expected a file of cameras, got nothing there")
    root = _read_json(path)
    frames = root.get("frames")
    if not isinstance(frames, list) or not frames or not all(isinstance(f, dict) for f in frames):
        raise DataError(f"{path}: expected a list of frames, got {_short(frames)}")
    names = [_name(str(f.get("file_path", f"{i:04d}"))) for i, f in enumerate(frames)]
    if len(set(names)) != len(names):
        raise DataError(f"{path}: expected every frame under a name of its own")
    values = {"w": size, "h": size} | root
    width, height = (int(_number(values, key, str(path), 0, math.inf)) for key in ("w", "h"))
    return names, _cameras(path, root, frames, width, height)


def _read_transforms(folder: Path, split: str) -> tuple[dict, Path]:
    if not folder.is_dir():
        what = "a file" if folder.exists() else "nothing there"
        raise DataError(f"{folder}: expected a folder with a scene, got {what}")
    path = folder / f"transforms_{split}.json"
    if not path.is_file():
        files = sorted(p.name for p in folder.iterdir())
        raise DataError(
            f"{folder}: expected {path.name}, got "
            + (", ".join(files[:5]) + (", ..." if len(files) > 5 else "") or "an empty folder")
        )
    return _read_json(path), path


def _read_json(path: Path) -> dict:
    try:
        root = json.loads(path.read_text(encoding="utf-8"))
    except json.JSONDecodeError as error:
        raise DataError(
            f"{path}: broken JSON in line {error.lineno}, column {error.colno}: {error.msg}"
        ) from None
    except UnicodeDecodeError as error:
        raise DataError(f"{path}: expected text in UTF-8, got {error.reason}") from None
    if not isinstance(root, dict):
        raise DataError(f"{path}: expected a JSON object, got {_short(root)}")
    return root


def _cameras(path: Path, root: dict, frames: list[dict], width: int, height: int) -> Cameras:
    poses, focals, centres = [], [], []
    for index, frame in enumerate(frames):
        where = f"{path}: frame {index}"
        poses.append(_pose(frame.get("transform_matrix"), where))
        values = root | frame  # intrinsics may stand with a frame
        if bent := [key for key in DISTORTION if values.get(key)]:
            raise DataError(
                f"{where}: lens distortion ({', '.join(bent)}) is not supported: "
                f"undistort the pictures"
            )
        if "fl_x" in values:
            x = _number(values, "fl_x", where, 0.0, math.inf)
            y = _number(values, "fl_y", where, 0.0, math.inf) if "fl_y" in values else x
        else:
            angle = _number(values, "camera_angle_x", where, 0.0, math.pi)
            x = y = 0.5 * width / math.tan(0.5 * angle)
        focals.append((x, y))
        centres.append(
            (
                _number(values, "cx", where, -width, 2 * width) if "cx" in values else width / 2,
                _number(values, "cy", where, -height, 2 * height) if "cy" in values else height / 2,
            )
        )
    return Cameras(
        camera_to_world=torch.from_numpy(np.stack(poses).astype(np.float32)),
        focal=torch.tensor(focals, dtype=torch.float32),
        centre=torch.tensor(centres, dtype=torch.float32),
        width=width,
        height=height,
    )


def _pose(matrix: object, where: str) -> np.ndarray:
    """Camera-to-world [3, 4] with its axes made exactly orthonormal."""
    try:
        pose = np.array(matrix, np.float64)
    except (TypeError, ValueError):
        pose = np.empty(0)
    if pose.shape not in ((4, 4), (3, 4)) or not np.isfinite(pose).all():
        raise DataError(f"{where}: expected a finite 4x4 transform_matrix, got {_short(matrix)}")
    if len(pose) == 4 and not np.allclose(pose[3], [0, 0, 0, 1], atol=RIGID_TOLERANCE, rtol=0):
        raise DataError(f"{where}: expected the last row 0 0 0 1, got {pose[3].tolist()}")
    u, scale, v = np.linalg.svd(pose[:3, :3])
    if np.abs(scale - 1).max() > RIGID_TOLERANCE:
        raise DataError(
            f"{where}: expected a rigid transform_matrix (a rotation), got one that scales by "
            f"{scale[0]:.4g}, {scale[1]:.4g}, {scale[2]:.4g}"
        )
    if np.linalg.det(pose[:3, :3]) < 0:
        raise DataError(f"{where}: expected a rotation in transform_matrix, got a reflection")
    return np.concatenate([u @ v, pose[:3, 3:]], 1)


def _number(values: dict, key: str, where: str, low: float, high: float) -> float:
    value = values.get(key)
    if isinstance(value, bool) or not isinstance(value, int | float) or not low < value < high:
        came = "nothing" if value is None else _short(value)
        raise DataError(f"{where}: expected {key} between {low:.4g} and {high:.4g}, got {came}")
    return float(value)


def _check_size(path: Path, root: dict, color: Tensor) -> None:
    """w and h, where the file gives them, must be the pictures': focal lengths are in pixels."""
    height, width = color.shape[:2]
    if (root.get("w", width), root.get("h", height)) != (width, height):
        raise DataError(
            f"{path}: expected pictures of {root.get('w')}x{root.get('h')} pixels (w and h), "
            f"got {width}x{height}"
        )


def _name(file_path: str) -> str:
    """./train/r_000 and ./train/r_000.png are r_000; r_0.5 stays."""
    path = Path(file_path)
    name = path.stem if path.suffix.lower() in SUFFIXES else path.name
    return name.removesuffix("_rgba").removesuffix("_rgb")


def _read_npz(path: Path) -> dict[str, np.ndarray]:
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
            return {key: file[key] for key in file.files}
    except (OSError, ValueError, EOFError, AttributeError, zipfile.BadZipFile) as error:
        raise DataError(f"{path}: expected an npz file, could not read it: {error}") from None


def _shapes(arrays: dict[str, np.ndarray]) -> str:
    return ", ".join(f"{key} {list(value.shape)}" for key, value in arrays.items()) or "no arrays"


def _size(image: Tensor) -> str:
    return f"{image.shape[1]}x{image.shape[0]}"


def _short(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."
