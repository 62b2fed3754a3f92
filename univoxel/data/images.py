"""Pictures in files: PNG, JPEG, OpenEXR and Radiance in; PNG and OpenEXR out."""

from __future__ import annotations

import io
import os
import sys
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, redirect_stdout
from pathlib import Path
from threading import Lock

import numpy as np
import OpenEXR
import torch
from PIL import ExifTags, Image
from torch import Tensor

from univoxel.data.radiance import read_radiance
from univoxel.errors import DataError
from univoxel.files import replacing
from univoxel.records import HALF_MAX

_OPENING = Lock()  # of an OpenEXR file: what it prints to is the process's, not the thread's
EXR_TELLS = "Warning: "  # how its lines begin
SUFFIXES = (".png", ".jpg", ".jpeg", ".exr", ".hdr")
HEIF = (".heic", ".heif", ".avif")  # of telephones


def read_image(path: str | Path) -> Tensor:
    """Read a picture, row 0 on top, channels in the order RGB(A) or grey.

    Returns:
        [H, W, C]: uint8 as stored for PNG and JPEG of 8 bits; float32 in [0, 1], still encoded as
        stored, for grey PNG of 16 bits (colour PNG of 16 bits is cut to 8); float32 linear for EXR
        (channels R, G, B and A if there, or Y) and Radiance .hdr.

    Raises:
        DataError: the file is missing, empty, cut off, not what its name says, of an unsupported
            kind, or holds NaN or infinity.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    _refuse_heif(path)
    if suffix not in SUFFIXES:
        raise DataError(f"{path}: expected a picture ({' '.join(SUFFIXES)}), got '{path.suffix}'")
    if suffix == ".hdr":
        _require_file(path)
        return torch.from_numpy(read_radiance(path))
    if suffix == ".exr":
        channels = read_exr(path)
        names = [c for c in "RGBA" if c in channels] if "R" in channels else ["Y"]
        if names not in (["R", "G", "B"], ["R", "G", "B", "A"], ["Y"]) or names[0] not in channels:
            raise DataError(f"{path}: expected channels R, G, B or Y, got {', '.join(channels)}")
        image = np.stack([channels[name] for name in names], -1)
        if not np.isfinite(image).all():
            row, column, _ = np.argwhere(~np.isfinite(image))[0]
            raise DataError(f"{path}: NaN or infinity at row {row}, column {column}")
        return torch.from_numpy(image)
    return torch.from_numpy(_read_pillow(path))


def image_size(path: str | Path) -> tuple[int, int]:
    """Width and height of a PNG, JPEG or EXR, from its beginning alone.

    Raises:
        DataError: the file is missing, empty, or not what its name says.
    """
    path = Path(path)
    _refuse_heif(path)
    _require_file(path)
    try:
        if path.suffix.lower() == ".exr":
            with _exr(path, header_only=True) as file:
                low, high = file.header()["dataWindow"]
            return int(high[0] - low[0]) + 1, int(high[1] - low[1]) + 1
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            with Image.open(path, formats=["PNG", "JPEG"]) as image:
                return image.size
    except (OSError, SyntaxError, ValueError, RuntimeError, Image.DecompressionBombError) as error:
        kind = "an OpenEXR file" if path.suffix.lower() == ".exr" else "a PNG or JPEG"
        raise DataError(f"{path}: expected {kind}, could not read it: {error}") from None


def orientation(path: Path) -> int:
    """How a JPEG says it is to be turned before it is looked at: EXIF's 1 to 8; 1 is not at all.

    Nothing here turns it: pixels are those of the file, which the cameras beside it are of.
    """
    if path.suffix.lower() not in (".jpg", ".jpeg"):
        return 1
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with Image.open(path, formats=["JPEG"]) as image:
                found = image.getexif().get(ExifTags.Base.Orientation, 1)
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError):
        return 1
    return found if found in range(1, 9) else 1


def turn_note(path: Path) -> str:
    """What is to be said of a picture whose size is not as expected, where its EXIF may be why."""
    found = orientation(path)
    if found < 5:  # no quarter turn
        return ""
    return (
        f"; EXIF orientation {found} of {path.name} is not applied: cameras and masks are those of "
        "the pixels as they are stored"
    )


def read_exr(path: str | Path) -> dict[str, np.ndarray]:
    """All channels of the first part of an OpenEXR file, [H, W] float32 each.

    Raises:
        DataError: the file is missing, empty, cut off, no EXR file, or has subsampled channels or a
            data window unlike its display window.
    """
    path = Path(path)
    _require_file(path)
    try:
        with _exr(path, separate_channels=True) as file:
            crop = not np.array_equal(file.header()["dataWindow"], file.header()["displayWindow"])
            channels = {name: channel.pixels for name, channel in file.channels().items()}
    except (RuntimeError, ValueError, TypeError) as error:
        raise DataError(f"{path}: expected an OpenEXR file, could not read it: {error}") from None
    if crop:
        raise DataError(f"{path}: expected a data window like the display window, got a crop")
    if len({pixels.shape for pixels in channels.values()}) != 1:
        raise DataError(f"{path}: expected channels of one size, got subsampled ones")
    return {name: np.asarray(pixels, np.float32) for name, pixels in channels.items()}


def write_png(path: str | Path, image: Tensor | np.ndarray) -> None:
    """Write [H, W], [H, W, 3] or [H, W, 4] as 8-bit PNG, whole or not at all.

    Args:
        image: uint8, or floating in [0, 1] as it shall be stored (sRGB for colours); floating
            values are clipped and rounded.

    Raises:
        OSError: the file cannot be written; nothing is left behind.
        ValueError: another shape or type, or NaN.
    """
    array = np.asarray(image)
    if array.ndim not in (2, 3) or (array.ndim == 3 and array.shape[2] not in (3, 4)):
        raise ValueError(f"write_png: image must be [H, W(, 3 or 4)], got {list(array.shape)}")
    if np.issubdtype(array.dtype, np.floating):
        if np.isnan(array).any():
            raise ValueError(f"write_png: image for {path} holds NaN")
        array = (array.clip(0, 1) * 255 + 0.5).astype(np.uint8)
    if array.dtype != np.uint8:
        raise ValueError(f"write_png: image must be uint8 or floating, got {array.dtype}")
    encoded = io.BytesIO()
    Image.fromarray(array).save(encoded, format="PNG")
    with replacing(path) as temporary:
        temporary.write_bytes(encoded.getbuffer())


def write_exr(
    path: str | Path, channels: Mapping[str, Tensor | np.ndarray], half: bool = True
) -> None:
    """Write [H, W] channels of one size as an OpenEXR file, whole or not at all.

    Args:
        channels: by name, such as R, rgb.R or depth.
        half: 16-bit floats (values above 65504 become 65504), else 32-bit.

    Raises:
        OSError: the file cannot be written; nothing is left behind.
        ValueError: no channels, or channels of differing or empty shape.
    """
    kind = np.float16 if half else np.float32
    arrays = {name: np.asarray(value, np.float32) for name, value in channels.items()}
    shapes = {array.shape for array in arrays.values()}
    if len(shapes) != 1 or len(shape := shapes.pop()) != 2 or 0 in shape:
        got = {name: list(array.shape) for name, array in arrays.items()}
        raise ValueError(f"write_exr: channels must be [H, W] of one size, got {got}")
    if half:
        arrays = {name: array.clip(-HALF_MAX, HALF_MAX) for name, array in arrays.items()}
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    pixels = {n: np.ascontiguousarray(a.astype(kind)) for n, a in arrays.items()}
    # Not straight to the file: when the disk fills up while OpenEXR closes a file, it says nothing.
    encoded = io.BytesIO()
    OpenEXR.File(header, pixels).write(encoded)
    with replacing(path) as temporary:
        temporary.write_bytes(encoded.getbuffer())


@contextmanager
def _exr(path: Path, **options: bool) -> Iterator[OpenEXR.File]:
    """An open OpenEXR file.

    Of damage the library writes lines to stdout, from Python, and to stderr, from C. Here they
    become the error, and what other threads print meanwhile is passed on.

    Raises:
        RuntimeError, ValueError, TypeError: as the library raises them; ValueError too where it
            only tells.
    """
    told = io.StringIO()
    with _OPENING, redirect_stdout(told), _without_stderr():
        file = OpenEXR.File(str(path), **options)
    lines = told.getvalue().splitlines(keepends=True)
    sys.stdout.write("".join(line for line in lines if not line.startswith(EXR_TELLS)))
    damage = [line.strip() for line in lines if line.startswith(EXR_TELLS)]
    with file:
        if damage:
            raise ValueError(damage[0].removeprefix(EXR_TELLS))
        yield file


@contextmanager
def _without_stderr() -> Iterator[None]:
    """A block whose C code writes nothing to stderr, nor anything else of the process."""
    try:
        kept = os.dup(2)
    except OSError:  # there is none
        yield
        return
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)


def _refuse_heif(path: Path) -> None:
    if path.suffix.lower() in HEIF:
        raise DataError(
            f"{path}: expected a picture ({' '.join(SUFFIXES)}), got '{path.suffix}': convert the "
            "photographs to JPEG, as `univoxel poses` does"
        )


def _require_file(path: Path) -> None:
    """OpenEXR prints to stderr about files that are not there; ask before."""
    if not path.is_file():
        what = "a folder" if path.is_dir() else "nothing there"
        raise DataError(f"{path}: expected a file, got {what}")
    if not path.stat().st_size:
        raise DataError(f"{path}: the file is empty")


def _read_pillow(path: Path) -> np.ndarray:
    """[H, W, C] uint8, or float32 for 16-bit grey."""
    _require_file(path)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            with Image.open(path, formats=["PNG", "JPEG"]) as image:
                image.load()
                if image.mode.startswith("I;16"):
                    return np.asarray(image, np.float32)[..., None] / 65535
                grey = image.mode in ("1", "L")
                transparent = image.has_transparency_data
                mode = "L" if grey else "RGBA" if transparent else "RGB"
                array = np.array(image if image.mode == mode else image.convert(mode))
    except AssertionError:  # Pillow's own, of what it takes for granted
        raise DataError(f"{path}: expected a PNG or JPEG, got one without its palette") from None
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise DataError(f"{path}: expected a PNG or JPEG, could not read it: {error}") from None
    return array[..., None] if grey else array
