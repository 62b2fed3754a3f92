"""Ground truth of a data set: materials, normals, relit views, points and meshes of the surface."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from univoxel.camera import stacked
from univoxel.color import srgb_to_linear
from univoxel.core.records import Mesh
from univoxel.data.images import read_image
from univoxel.data.lens import shrink
from univoxel.data.load_images import read_photo, resampled, size_of
from univoxel.data.path_sandbox import read_npy, read_npz
from univoxel.data.photos import Photos, Truth
from univoxel.data.research import is_tensoir, photographed
from univoxel.data.transforms import find_image
from univoxel.errors import DataError

# What Stanford-ORB has beside its photographs, in ../../ground_truth/<scene>.
#
# Source: the public code of Kuang et al. 2023 (Stanford-ORB), README and scripts/preprocess.


FILES = {
    "albedo": "pseudo_gt_albedo/{}.png",  # sRGB
    "normal": "surface_normal/{}.npy",  # [H, W, 3], axes of the camera: x right, y up, z backwards
    "depth": "z_depth/{}.npy",  # [H, W] along -Z; 0 or less: nothing there
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
            f"{path}: expected finite values {shape}, got {list(array.shape)} of {array.dtype}"
        )
    value = torch.from_numpy(array.astype(np.float32))
    if key == "depth":
        return value.clamp_min(0), (value > 0).float()
    there = value.norm(dim=-1) > 0.5  # unit, or 0
    world = torch.nn.functional.normalize(value, dim=-1) @ camera_to_world[:, :3].T
    return world * there[..., None], there.float()


# Triangle meshes in PLY files.


_TYPES = {"char": "<i1", "uchar": "<u1", "short": "<i2", "ushort": "<u2"}
_TYPES |= {"int": "<i4", "uint": "<u4", "float": "<f4", "double": "<f8"}
_TYPES |= {np.dtype(kind).name: kind for kind in _TYPES.values()}  # int8, uint8 and so on


def read_ply(path: Path) -> Mesh:
    """Vertices and faces of a binary little-endian PLY file of triangles; the rest is passed over.
    A DataError where it cannot be read, or holds other polygons or places that are not finite."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {error.strerror}") from None
    head, mark, body = data.partition(b"end_header\n")
    lines = [line.split() for line in head.decode("ascii", "replace").splitlines()]
    if lines[:1] != [["ply"]] or not mark or ["format", "binary_little_endian", "1.0"] not in lines:
        raise DataError(f"{path}: expected a binary little-endian PLY file")
    counts: dict[str, int] = {}
    fields: dict[str, list[tuple]] = {}
    try:
        for word, *rest in (line for line in lines if line):
            if word == "element":
                counts[rest[0]], fields[rest[0]] = int(rest[1]), []
                if counts[rest[0]] < 0:
                    raise ValueError(f"{rest[1]} of {rest[0]}")
            elif word == "property" and rest[0] == "list":
                row = ("count", _TYPES[rest[1]]), ("corner", _TYPES[rest[2]], (3,))
                fields[list(fields)[-1]] += row
            elif word == "property":
                fields[list(fields)[-1]].append((rest[1], _TYPES[rest[0]]))
        if list(counts)[:2] != ["vertex", "face"]:
            raise KeyError("vertex and face first")
        vertex = np.frombuffer(body, np.dtype(fields["vertex"]), counts["vertex"])
        face = np.frombuffer(body[vertex.nbytes :], np.dtype(fields["face"]), counts["face"])
        corner = np.stack([vertex[axis] for axis in "xyz"], -1).astype(np.float32)
        index, sides = face["corner"].astype(np.int32), face["count"]
    except (KeyError, IndexError, ValueError, OverflowError) as error:
        raise DataError(
            f"{path}: expected vertices x y z and triangles, but could not read them: {error}"
        ) from None
    if (sides != 3).any() or (len(index) and not 0 <= index.min() <= index.max() < len(corner)):
        raise DataError(f"{path}: expected triangles with vertex indices below {len(corner)}")
    if not np.isfinite(corner).all():
        raise DataError(f"{path}: expected finite vertices, got NaN or infinity")
    return Mesh(torch.from_numpy(corner), torch.from_numpy(index))


# Ground truth beside the photographs: materials, normals, relit views, points on the surface.


WHOLE = 250 / 255  # coverage above which a pixel is well inside the object
MAP_ENDINGS = (".hdr", ".exr")


def load_truth(photos: Photos, view: int) -> Truth:
    """Ground truth of a test view; an empty record if there is none.

    The mask is where alpha > 250 of 255, so that no silhouette pixel counts: that of the npz, or of
    the photograph.

    Raises:
        DataError: one line that names the file, what was expected and what came.
    """
    name = photos.names[view]
    path = photos.folder / "test" / "gt" / f"{name}.npz"
    if path.is_file():
        return _arrays(path, photos.downscale)
    return _pictures(photos, view)


def relight_maps(folder: str | Path) -> dict[str, Path]:
    """The environment maps under which relit test views exist, by name; empty if there are none.

    relight/<map> must have its map. Data sets of others come apart from their maps: there, it is
    the maps that are found in the folder or the one above, or in envmaps/ of either.
    """
    folder = Path(folder)
    maps = {}
    for pictures in sorted((folder / "relight").glob("*/")):
        found = map_file(folder / "envmaps", pictures.name)
        if found is None:
            raise DataError(
                f"{pictures}: expected the environment map of these images, "
                f"{folder / 'envmaps' / pictures.name}.hdr, but it does not exist"
            )
        maps[pictures.name] = found
    if maps:
        return maps
    names = {path.name.partition("_")[0] for path in (folder / "test_rli").glob("*_*.png")}
    if is_tensoir(folder, "test"):
        pictures = set(folder.glob("test_*/rgba_*.png"))
        lights = {p.stem.partition("_")[2] for p in pictures if p.name != photographed(folder)}
        names |= lights
    places = [p / sub for p in (folder, folder.resolve().parent) for sub in ("envmaps", ".")]
    for name in sorted(names):
        found = next((path for place in places if (path := map_file(place, name))), None)
        if found is not None:
            maps[name] = found
    return maps


def load_relit(photos: Photos, map: str) -> tuple[Tensor, Tensor]:
    """Test views under another map: colour [V, H, W, 3] and alpha [V, H, W] as in `Photos`."""
    pictures: list[tuple[Tensor, Tensor]] = []
    for view, name in enumerate(photos.names):
        path = _relit(photos.folder, name, map)
        color, alpha = read_photo(path)
        found = tuple(n // photos.downscale for n in reversed(alpha.shape))
        if found != (size := photos.cameras.size(view)):
            raise DataError(
                f"{path}: expected {size[0]}x{size[1]} pixels as in the test view, got "
                f"{found[0]}x{found[1]}"
            )
        pictures.append(resampled(color, alpha, photos.downscale))
    return stacked([c for c, _ in pictures]), stacked([a for _, a in pictures])


def load_points(folder: str | Path) -> Tensor | None:
    """Points [P, 3] float32 on the true surface, world: points.npz, or None if there is none."""
    path = Path(folder) / "points.npz"
    if not path.is_file():
        return None
    arrays = read_npz(path)
    points = arrays.get("points")
    if points is None or points.ndim != 2 or points.shape[1] != 3 or not len(points):
        raise DataError(f"{path}: expected an array points of shape [P, 3], got {_shapes(arrays)}")
    return _finite(path, "points", points)


def map_file(folder: Path, name: str) -> Path | None:
    return next((p for end in MAP_ENDINGS if (p := folder / (name + end)).is_file()), None)


def _relit(folder: Path, name: str, map: str) -> Path:
    for path in (folder / "test_rli" / f"{map}_{name}.png", folder / name / f"rgba_{map}.png"):
        if path.is_file():
            return path
    return find_image(folder / "relight" / map, name, f"{folder / 'relight' / map}")


def _arrays(path: Path, factor: int) -> Truth:
    arrays = read_npz(path)
    shape = arrays["alpha"].shape if "alpha" in arrays else None
    if shape is None or len(shape) != 2:
        raise DataError(f"{path}: expected an array alpha of shape [H, W], got {_shapes(arrays)}")
    wanted = {"albedo": (*shape, 3), "roughness": shape, "normal": (*shape, 3), "depth": shape}
    alpha = torch.from_numpy(arrays["alpha"].astype(np.float32) / 255)
    fields: dict[str, Tensor] = {"mask": shrink(alpha[..., None], factor)[..., 0] > WHOLE}
    for key, size in wanted.items():
        if key not in arrays:
            continue
        if (shape := arrays[key].shape) != size:
            raise DataError(f"{path}: expected {key} of size {list(size)}, got {list(shape)}")
        fields[key] = _shrunk(key, _finite(path, key, arrays[key]), alpha, factor)
    return Truth(**fields)


def _finite(path: Path, key: str, array: np.ndarray) -> Tensor:
    """An array of a file in float32, or a DataError."""
    with np.errstate(over="ignore"):  # what is infinite then is refused
        values = array.astype(np.float32)
    if not np.isfinite(values).all():
        raise DataError(f"{path}: expected finite {key}, got NaN or infinity")
    return torch.from_numpy(values)


def _pictures(photos: Photos, view: int) -> Truth:
    """Truth from pictures of the data sets in the field.

    The albedo is sRGB in Synthetic4Relight and linear in TensoIR-Synthetic; normals are 1/2 + n/2
    in the world; roughness is as it is. Of Stanford-ORB, the albedo is sRGB.
    """
    folder, name = photos.folder, photos.names[view]
    orb = orb_files(photos, view)
    files = {
        "albedo": (
            folder / "test" / f"{name}_albedo.png",
            orb.get("albedo", folder),
            folder / name / "albedo.png",
        ),
        "roughness": (folder / "test" / f"{name}_rough.png",),
        "normal": (folder / "test" / f"{name}_normal.png", folder / name / "normal.png"),
    }
    _, coverage = photos.picture(view)
    fields: dict[str, Tensor] = {}
    for key, paths in files.items():
        path = next((path for path in paths if path.is_file()), None)
        if path is None:
            continue
        value, alpha = _channels(path)
        if key == "roughness":
            value = value[..., 0]
        elif value.shape[2] != 3:
            raise DataError(f"{path}: expected an image with 3 or 4 channels, got 1")
        elif key == "normal":
            value = 2 * value - 1
        elif path in paths[:2]:
            value = srgb_to_linear(value)
        fields[key] = _fitting(path, _shrunk(key, value, alpha, photos.downscale), coverage)
    for key in {"normal", "depth"} & orb.keys():
        value, there = orb_geometry(orb[key], key, photos.cameras.camera_to_world[view])
        fields[key] = _fitting(orb[key], _shrunk(key, value, there, photos.downscale), coverage)
    return Truth(**fields, mask=coverage > WHOLE) if fields else Truth()


def _fitting(path: Path, value: Tensor, coverage: Tensor) -> Tensor:
    """A layer of truth where the photograph has something, if their sizes are the same."""
    if value.shape[:2] != coverage.shape:
        raise DataError(
            f"{path}: expected {size_of(coverage)} pixels as in the photograph, got "
            f"{size_of(value)}"
        )
    return value * (coverage > 0).view(*coverage.shape, *[1] * (value.dim() - 2))


def _channels(path: Path) -> tuple[Tensor, Tensor]:
    """A picture's colour or grey [H, W, 3 or 1] as stored, and its alpha [H, W], 1 without one."""
    image = read_image(path)
    image = image.float() / 255 if image.dtype == torch.uint8 else image
    if image.shape[2] == 4:
        return image[..., :3], image[..., 3]
    return image, torch.ones(image.shape[:2])


def _shrunk(key: str, value: Tensor, alpha: Tensor, factor: int) -> Tensor:
    """Means weighted by coverage; of normals, their direction."""
    flat = value.view(*alpha.shape, -1)
    if factor > 1:
        total = shrink(alpha[..., None], factor)
        flat = shrink(flat * alpha[..., None], factor) / total.clamp_min(1e-6)
    if key == "normal":
        flat = torch.nn.functional.normalize(flat, dim=-1)
    return flat if value.dim() == 3 else flat[..., 0]


def _shapes(arrays: dict[str, np.ndarray]) -> str:
    return ", ".join(f"{key} {list(value.shape)}" for key, value in arrays.items()) or "no arrays"
