"""Pictures in files: PNG, JPEG, TIFF, WebP, OpenEXR and Radiance in; PNG and OpenEXR out."""

from __future__ import annotations

import io
import os
import sys
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stdout
from pathlib import Path
from threading import Lock

import numpy as np
import OpenEXR
import torch
from PIL import ExifTags, Image, ImageCms
from torch import Tensor

from univoxel.data.radiance import in_rec709, read_radiance
from univoxel.errors import DataError
from univoxel.files import replacing
from univoxel.records import HALF_MAX

_LIMIT = Lock()  # of Pillow, which is the process's
_OPENING = Lock()  # of an OpenEXR file: what it prints to is the process's, not the thread's
EXR_TELLS = "Warning: "  # how its lines begin
SUFFIXES = (".png", ".jpg", ".jpeg", ".exr", ".hdr", ".tif", ".tiff", ".webp")
# What Pillow may take a file for, whatever its name says
FORMATS = ("PNG", "JPEG", "TIFF", "WEBP")
KINDS = {".exr": "an OpenEXR file", ".tif": "a TIFF", ".tiff": "a TIFF", ".webp": "a WebP"}
HEIF = (".heic", ".heif", ".avif")  # of telephones
HEIF_BRANDS = (b"heic", b"heix", b"hevc", b"mif1", b"msf1", b"avif", b"avis")
LARGEST = 1 << 29  # pixels of a file: panoramas and the largest telephones have 200 million
MOST_FRAMED = 1 << 29  # pixels of an EXR's display window, at most, where its data fill it in part
# Endings of pictures that are not read: names may be those of files before they were converted
FOREIGN = (*HEIF, ".hif", ".bmp", ".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2")


def read_image(path: str | Path, in_srgb: bool = False) -> Tensor:
    """Read a picture, row 0 on top, channels in the order RGB(A) or grey.

    Args:
        in_srgb: turn colours of a profile that the file holds, as of telephones, into sRGB.

    Returns:
        [H, W, C]: uint8 as stored for files of 8 bits; float32 in [0, 1], still encoded as
        stored, for grey of 16 bits (colour PNG of 16 bits is cut to 8); float32 linear for EXR
        (channels R, G, B and A if there, or Y) and Radiance .hdr, whose colours of stated
        primaries become those of Rec. 709.

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
        channels, stated = _read_exr(path)
        names = [c for c in "RGBA" if c in channels] if "R" in channels else ["Y"]
        if names not in (["R", "G", "B"], ["R", "G", "B", "A"], ["Y"]) or names[0] not in channels:
            raise DataError(f"{path}: expected channels R, G, B or Y, got {', '.join(channels)}")
        image = np.stack([channels[name] for name in names], -1)
        if not np.isfinite(image).all():
            row, column, _ = np.argwhere(~np.isfinite(image))[0]
            raise DataError(f"{path}: NaN or infinity at row {row}, column {column}")
        if stated and image.shape[2] > 1:
            image[..., :3] = in_rec709(image[..., :3], stated)
        return torch.from_numpy(image)
    with opened(path) as image:
        return torch.from_numpy(as_array(image, path, in_srgb))


def image_size(path: str | Path) -> tuple[int, int]:
    """Width and height of a picture that Pillow or OpenEXR reads, from its beginning alone.

    Raises:
        DataError: the file is missing, empty, or not what its name says.
    """
    path = Path(path)
    _refuse_heif(path)
    if path.suffix.lower() != ".exr":
        with opened(path, whole=False) as image:
            return image.size
    _require_file(path)
    try:
        with _exr(path, header_only=True) as file:
            low, high = file.header()["displayWindow"]
        return int(high[0] - low[0]) + 1, int(high[1] - low[1]) + 1
    except (OSError, ValueError, RuntimeError) as error:
        raise DataError(f"{path}: expected an OpenEXR file, could not read it: {error}") from None


def orientation(path: Path) -> int:
    """How a picture says it is to be turned before it is looked at: EXIF's 1 to 8; 1 is not at all.

    Nothing here turns it: pixels are those of the file, which the cameras beside it are of.
    """
    if path.suffix.lower() not in (".jpg", ".jpeg", ".tif", ".tiff", ".webp"):
        return 1
    try:
        with open_picture(path, FORMATS) as image:
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


def upright_from_stored(pixels: Tensor, turned: int) -> Tensor:
    """Pixels [H, W, ..] as they are looked at, from those of a file of that EXIF orientation."""
    match turned:
        case 2:
            return pixels.flip(1)
        case 3:
            return pixels.flip(0, 1)
        case 4:
            return pixels.flip(0)
        case 5:
            return pixels.transpose(0, 1)
        case 6:
            return pixels.transpose(0, 1).flip(1)
        case 7:
            return pixels.transpose(0, 1).flip(0, 1)
        case 8:
            return pixels.transpose(0, 1).flip(0)
    return pixels


def stored_from_upright(pixels: Tensor, turned: int) -> Tensor:
    """What `upright_from_stored` makes such pixels of."""
    return upright_from_stored(pixels, {6: 8, 8: 6}.get(turned, turned))


def read_exr(path: str | Path) -> dict[str, np.ndarray]:
    """All channels of an OpenEXR file, [H, W] float32 each; of several parts, those of the only one
    with colours, or of the first.

    The picture is the display window: 0 where a smaller data window ends, as renderers cut away
    what is empty, and without what a larger one has around it.

    Raises:
        DataError: the file is missing, empty, cut off, no EXR file, has subsampled channels or
            several parts with colours.
    """
    return _read_exr(Path(path))[0]


def _read_exr(path: Path) -> tuple[dict[str, np.ndarray], Sequence[float]]:
    """Channels as of `read_exr`, and the primaries that the file states, if any."""
    _require_file(path)
    try:
        with _exr(path, separate_channels=True) as file:
            colored = [i for i, part in enumerate(file.parts) if "R" in part.channels]
            names = ", ".join(part.name() for part in file.parts)
            header = file.header(part := colored[0] if colored else 0)
            data, shown = (header[f"{what}Window"] for what in ("data", "display"))
            stated = header.get("chromaticities", ())
            channels = {name: channel.pixels for name, channel in file.channels(part).items()}
    except (RuntimeError, ValueError, TypeError) as error:
        raise DataError(f"{path}: expected an OpenEXR file, could not read it: {error}") from None
    if len(colored) > 1:
        raise DataError(
            f"{path}: expected one picture, got parts with colours: {names}: write the one that is "
            "meant into a file of its own"
        )
    if len({pixels.shape for pixels in channels.values()}) != 1:
        raise DataError(f"{path}: expected channels of one size, got subsampled ones")
    if not np.array_equal(data, shown):
        channels = {name: _framed(p, data, shown, path) for name, p in channels.items()}
    return {name: np.asarray(pixels, np.float32) for name, pixels in channels.items()}, stated


def _framed(
    pixels: np.ndarray, data: tuple[np.ndarray, ...], shown: tuple[np.ndarray, ...], path: Path
) -> np.ndarray:
    """Pixels of a data window in those of the display window."""
    width, height = (int(high - low) + 1 for low, high in zip(*shown, strict=True))
    if min(width, height) < 1 or width * height > MOST_FRAMED:
        raise DataError(f"{path}: expected a display window of pixels, got {width}x{height}")
    framed = np.zeros((height, width), pixels.dtype)
    x, y = (int(d - s) for d, s in zip(data[0], shown[0], strict=True))
    into = framed[max(y, 0) : max(y + pixels.shape[0], 0), max(x, 0) : max(x + pixels.shape[1], 0)]
    inner = pixels[max(-y, 0) :, max(-x, 0) :]
    into[:] = inner[: into.shape[0], : into.shape[1]]
    return framed


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


def open_picture(path: Path, formats: Sequence[str]) -> Image.Image:
    """A file in Pillow's hands, whose own limit of size is too low for photographs.

    Raises:
        OSError, Image.DecompressionBombError, ValueError, SyntaxError: it is no such picture.
    """
    with _LIMIT, warnings.catch_warnings():
        warnings.simplefilter("ignore", Image.DecompressionBombWarning)
        usual = Image.MAX_IMAGE_PIXELS
        try:
            Image.MAX_IMAGE_PIXELS = usual and max(usual, LARGEST // 2)  # it refuses twice as many
            return Image.open(path, formats=list(formats))
        finally:
            Image.MAX_IMAGE_PIXELS = usual


@contextmanager
def opened(path: Path, whole: bool = True) -> Iterator[Image.Image]:
    """A picture in Pillow's hands, its pixels read where `whole`.

    Raises:
        DataError: what is wrong with the file, where the block runs into it, too.
    """
    kind = KINDS.get(path.suffix.lower(), "a PNG or JPEG")
    _require_file(path)
    try:
        with open_picture(path, FORMATS) as image:
            if whole:
                image.load()
            yield image
    except DataError:
        raise
    except AssertionError:  # Pillow's own, of what it takes for granted
        raise DataError(f"{path}: expected {kind}, got one without its palette") from None
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise DataError(f"{path}: expected {kind}, {_what_it_is(path, error)}") from None


def as_array(image: Image.Image, path: Path, in_srgb: bool = False) -> np.ndarray:
    """Pixels [H, W, C] of a picture, as `read_image` has them.

    Raises:
        DataError: numbers of 32 bits, of which nothing says how bright they are.
    """
    if image.mode.startswith("I;16"):
        return np.asarray(image, np.float32)[..., None] / 65535
    if image.mode in ("I", "F"):
        raise DataError(f"{path}: expected a picture of 8 or 16 bits, got one of 32: write it as 8")
    grey = image.mode in ("1", "L")
    mode = "L" if grey else "RGBA" if image.has_transparency_data else "RGB"
    profile = image.info.get("icc_profile") if in_srgb and not grey else None
    if image.mode not in (mode, "CMYK"):  # whose profile is of its own numbers
        image = image.convert(mode)
    if profile:
        image = srgb_of(image, profile)
    array = np.array(image if image.mode == mode else image.convert(mode))
    return array[..., None] if grey else array


def srgb_of(picture: Image.Image, profile: bytes) -> Image.Image:
    """A picture RGB, RGBA or CMYK in the colours of a profile, as RGB or RGBA in sRGB.

    Telephones store colours of a wider space. One in sRGB, or whose profile is broken or of
    something else, stays as it is.
    """
    try:
        own = ImageCms.ImageCmsProfile(io.BytesIO(profile))
        if "sRGB" in ImageCms.getProfileDescription(own):
            return picture
        alpha = picture.getchannel("A") if picture.mode == "RGBA" else None
        flat = picture.convert("RGB") if alpha else picture
        srgb = ImageCms.createProfile("sRGB")
        turned = ImageCms.profileToProfile(flat, own, srgb, outputMode="RGB")
    except (ImageCms.PyCMSError, OSError, ValueError, TypeError):
        return picture
    assert turned is not None  # as it is not converted in place
    if alpha is not None:
        turned.putalpha(alpha)
    return turned


def is_heif(path: Path) -> bool:
    """Whether a file is HEIC or AVIF by its first bytes, whatever its name says."""
    with path.open("rb") as file:
        head = file.read(12)
    return head[4:8] == b"ftyp" and head[8:] in HEIF_BRANDS


def _what_it_is(path: Path, error: Exception) -> str:
    """Why a file could not be read: it may be of another kind than its name says."""
    if is_heif(path):
        return "got HEIC or AVIF under that name: convert it to JPEG, as `univoxel poses` does"
    with path.open("rb") as file:
        head = file.read(4)
    if head in (b"II*\0", b"MM\0*"):
        return f"could not read this TIFF: {error}: convert it to PNG or JPEG of 8 bits"
    return f"could not read it: {error}"
