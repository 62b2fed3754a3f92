"""Image files: PNG, JPEG, OpenEXR and Radiance, reading and writing."""

from __future__ import annotations

import io
import os
import re
import sys
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stdout
from pathlib import Path
from threading import Lock

import numpy as np
import OpenEXR
import torch
from PIL import ExifTags, Image, ImageCms, ImageFilter
from torch import Tensor

from univoxel.color import linear_to_srgb, srgb_to_linear
from univoxel.core.files import write_bytes
from univoxel.core.records import HALF_MAX
from univoxel.errors import DataError

SMALLEST = 2.0**-128  # what is darker has no exponent: black
# x and y of red, green, blue and white: of Rec. 709, which colours here are of, and of Radiance,
# whose writers state it whatever colours they have
REC_709 = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)
REC_2020 = (0.708, 0.292, 0.170, 0.797, 0.131, 0.046, 0.3127, 0.3290)
DISPLAY_P3 = (0.680, 0.320, 0.265, 0.690, 0.150, 0.060, 0.3127, 0.3290)
ADOBE_RGB = (0.64, 0.33, 0.21, 0.71, 0.15, 0.06, 0.3127, 0.3290)
OF_RADIANCE = (0.64, 0.33, 0.29, 0.60, 0.15, 0.06, 0.3333, 0.3333)
# By their numbers in ITU-T H.273: primaries, and curves of light that sRGB does not hold
CODED = {9: REC_2020, 12: DISPLAY_P3}
HDR_CURVES = {16: "PQ", 18: "HLG"}
HEAD = 4096  # bytes of a PNG that hold what is said of its colours
SRGB_POWER = 2.2  # which sRGB's curve is near
NODES = 33  # along a side of a table of colours
# Colours all over sRGB: a profile that changes none of them by more than SAME of 255 is sRGB's
PROBE: np.ndarray = np.stack(np.meshgrid(*3 * [np.arange(0, 256, 15)]), -1).reshape(18, -1, 3)
PROBE = PROBE.astype(np.uint8)
SAME = 2
NEAR = 2e-3  # by which primaries may differ and are the same
BRADFORD = np.array(
    [[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]]
)
LARGEST_RADIANCE = 255 * 2.0**119  # the largest number of the format


def read_radiance(path: Path) -> np.ndarray:
    """Linear RGB [H, W, 3] float32: mantissa * 2^(exponent - 136), exactly; 0 where exponent is 0.

    EXPOSURE lines are not applied, as in other readers. Colours of stated PRIMARIES become those of
    Rec. 709.

    Raises:
        DataError: not a Radiance RGBE picture, cut off, or of an orientation or encoding other than
            -Y +X rows, flat or with run lengths.
        OSError: the file cannot be read.

    Source: Ward 1991, "Real pixels" (Graphics Gems II), and the Radiance file format description.
    """
    data = path.read_bytes()
    if not data.startswith(b"#?"):
        raise DataError(f"{path}: expected a Radiance image (first bytes '#?'), got {data[:8]!r}")
    head, blank, rest = data.partition(b"\n\n")
    line, newline, body = rest.partition(b"\n")
    if not (blank and newline):
        raise DataError(f"{path}: expected a header and pixels, but the file is truncated")
    if form := re.search(rb"^FORMAT=(.*)$", head, re.MULTILINE):
        if form[1].strip() != b"32-bit_rle_rgbe":
            raise DataError(f"{path}: expected FORMAT=32-bit_rle_rgbe, got {form[1].strip()!r}")
    size = re.fullmatch(rb"\s*-Y\s+(\d{1,9})\s+\+X\s+(\d{1,9})\s*", line)
    if not size or not (int(size[1]) and int(size[2])):
        raise DataError(f"{path}: expected the size as '-Y height +X width', got {line[:40]!r}")
    height, width = int(size[1]), int(size[2])

    if height * width > LARGEST:
        raise DataError(f"{path}: expected at most {LARGEST} pixels, got {width}x{height}")
    # A flat file cannot start with the marker: its largest mantissa would be below 128.
    marker = bytes([2, 2, width >> 8 & 255, width & 255])
    if 8 <= width < 32768 and body.startswith(marker):
        planes = _run_lengths(path, body, marker, height, width)
    elif len(body) == 4 * height * width:
        planes = np.frombuffer(body, np.uint8).reshape(height, width, 4).swapaxes(1, 2)
    else:
        planes = _old_run_lengths(path, body, height, width).swapaxes(1, 2)
    scale = np.ldexp(np.ones(256, np.float32), np.arange(256) - 136)
    scale[0] = 0
    value, of_pixel = np.empty((height, width, 3), np.float32), scale[planes[:, 3]]
    for channel in range(3):
        np.multiply(planes[:, channel], of_pixel, out=value[..., channel], dtype=np.float32)
    stated = re.search(rb"^PRIMARIES=\s*((?:[-\d.]+\s+){7}[-\d.]+)\s*$", head, re.MULTILINE)
    return in_rec709(value, [float(x) for x in stated[1].split()]) if stated else value


def in_rec709(rgb: np.ndarray, stated: Sequence[float]) -> np.ndarray:
    """Linear colours [.., 3] float32 of stated primaries as those of Rec. 709, white as white; what
    only the wider space has becomes 0.

    Args:
        stated: x and y of red, green, blue and white. Numbers that are none change nothing.
    """
    if len(stated) != 8 or not np.isfinite(stated).all() or 0 in stated[1::2]:
        return rgb
    if any(np.allclose(stated, known, atol=NEAR) for known in (REC_709, OF_RADIANCE)):
        return rgb
    (theirs, white), (ours, d65) = _to_xyz(stated), _to_xyz(REC_709)
    scale = np.diag((BRADFORD @ d65) / (BRADFORD @ white))
    if not np.isfinite(theirs).all():  # of primaries on one line
        return rgb
    matrix = np.linalg.inv(ours) @ np.linalg.inv(BRADFORD) @ scale @ BRADFORD @ theirs
    return np.maximum(rgb @ matrix.T, 0).astype(np.float32)


def _to_xyz(primaries: Sequence[float]) -> tuple[np.ndarray, np.ndarray]:
    """From linear RGB of primaries to XYZ [3, 3], and the XYZ of their white [3]."""
    *colors, white = (
        np.array([x / y, 1, (1 - x - y) / y])
        for x, y in zip(primaries[::2], primaries[1::2], strict=True)
    )
    matrix = np.stack(colors, 1)
    if abs(np.linalg.det(matrix)) < 1e-9:
        return np.full((3, 3), np.nan), white
    return matrix * np.linalg.solve(matrix, white), white


def write_radiance(path: Path, radiance: np.ndarray) -> None:
    """Write linear RGB [H, W, 3], at least 0, as flat pixels, whole or not at all.

    A channel is off by at most 1/256 of the pixel's largest channel, as `read_radiance` reads it.
    """
    height, width, _ = radiance.shape
    value = np.minimum(radiance.astype(np.float64), LARGEST_RADIANCE)
    largest = value.max(2)
    _, exponent = np.frexp(largest)
    # Mantissas of 255.5 and more would round to 256
    exponent += np.rint(np.ldexp(largest, 8 - exponent)) > 255
    mantissa = np.rint(np.ldexp(value, 8 - exponent[..., None]))
    rgbe = np.concatenate([mantissa, exponent[..., None] + 128], 2)
    rgbe[largest < SMALLEST] = 0
    header = f"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y {height} +X {width}\n"
    write_bytes(path, header.encode("ascii") + rgbe.astype(np.uint8).tobytes())


def _run_lengths(path: Path, body: bytes, marker: bytes, height: int, width: int) -> np.ndarray:
    """Channels [H, 4, W] of rows that start with the marker and hold each channel as runs (> 128)
    and literals."""
    rows, at, size = bytearray(), 0, len(body)  # no memory for rows that a header alone promises
    for row in range(height):
        if body[at : at + 4] != marker:
            raise DataError(f"{path}: row {row} of {height} is missing or damaged")
        at += 4
        for _ in range(4):
            left = width
            while left > 0 and at < size:
                if (count := body[at]) > 128:
                    rows += body[at + 1 : at + 2] * (count - 128)
                    at, left = at + 2, left + 128 - count
                elif count:
                    rows += body[at + 1 : at + 1 + count]
                    at, left = at + 1 + count, left - count
                else:
                    break
            if left or at > size:
                raise DataError(f"{path}: row {row} of {height} is truncated or damaged")
    return np.frombuffer(rows, np.uint8).reshape(height, 4, width)


def _old_run_lengths(path: Path, body: bytes, height: int, width: int) -> np.ndarray:
    """Pixels [H, W, 4] of which 1 1 1 N says that the last one comes N times more; of several such
    in a row each counts 256 times the one before."""
    pixels = np.frombuffer(body, np.uint8, len(body) // 4 * 4).reshape(-1, 4)
    runs, place = (pixels[:, :3] == 1).all(1), np.arange(len(pixels))
    last = np.maximum.accumulate(np.where(runs, -1, place))
    power = 8 * (place - last - 1).clip(0, 3)
    count = np.where(runs, pixels[:, 3].astype(np.int64) << power, 1)
    if len(body) % 4 or not len(last) or last[0] < 0 or count.sum() != height * width:
        raise DataError(
            f"{path}: expected {width}x{height} pixels, as {4 * height * width} uncompressed bytes "
            f"or run-length encoded rows, got {len(body)} bytes"
        )
    return np.repeat(pixels[last], count, 0).reshape(height, width, 4)


_LIMIT = Lock()  # of Pillow, which is the process's
_OPENING = Lock()  # of an OpenEXR file: what it prints to is the process's, not the thread's
EXR_HEAD = b"v/1\x01"  # first bytes of an OpenEXR file
EXR_TELLS = "Warning: "  # how its lines begin
SUFFIXES = (".png", ".jpg", ".jpeg", ".exr", ".hdr", ".tif", ".tiff", ".webp")
# What Pillow may take a file for, whatever its name says
FORMATS = ("PNG", "JPEG", "TIFF", "WEBP")
KINDS = {".exr": "an OpenEXR file", ".tif": "a TIFF", ".tiff": "a TIFF", ".webp": "a WebP"}
# Axes that are flipped, by orientation in EXIF
FLIPPED: dict[int, tuple[int, ...]] = {2: (1,), 3: (0, 1), 4: (0,), 6: (1,), 7: (0, 1), 8: (0,)}
HEIF = (".heic", ".heif", ".avif")  # of phones
HEIF_BRANDS = (b"heic", b"heix", b"hevc", b"mif1", b"msf1", b"avif", b"avis")
LARGEST = 1 << 29  # pixels of a file: panoramas and the largest phones have 200 million
MOST_FRAMED = 1 << 29  # pixels of an EXR's display window, at most, where its data fill it in part
# Endings of pictures that are not read: names may be those of files before they were converted
FOREIGN = (*HEIF, ".hif", ".bmp", ".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2")


def read_image(path: str | Path, in_srgb: bool = False, infinite: bool = False) -> Tensor:
    """Read a picture, row 0 on top, channels in the order RGB(A) or grey.

    Args:
        in_srgb: turn colours of a profile that the file holds, as in phones, into sRGB.
        infinite: let an OpenEXR file hold infinity.

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
    suffix = kind_of(path)
    if suffix == ".hdr":
        return torch.from_numpy(read_radiance(path))
    if suffix == ".exr":
        channels, stated = _read_exr(path)
        names = [c for c in "RGBA" if c in channels] if "R" in channels else ["Y"]
        if names not in (["R", "G", "B"], ["R", "G", "B", "A"], ["Y"]) or names[0] not in channels:
            raise DataError(f"{path}: expected channels R, G, B, or Y, got {', '.join(channels)}")
        image = np.stack([channels[name] for name in names], -1)
        bad = np.isnan(image) | (image == -np.inf) if infinite else ~np.isfinite(image)
        if bad.any():
            row, column, _ = np.argwhere(bad)[0]
            raise DataError(f"{path}: NaN or infinity at row {row}, column {column}")
        if stated and image.shape[2] > 1:
            image[..., :3] = in_rec709(image[..., :3], stated)
        return torch.from_numpy(image)
    with opened(path) as image:
        return torch.from_numpy(as_array(image, path, in_srgb))


def kind_of(path: Path) -> str:
    """.exr or .hdr where a file is of that kind by its first bytes, otherwise what its name says; a
    DataError if there is no such file, it is empty, or its name is of no picture that is read."""
    if (suffix := path.suffix.lower()) not in SUFFIXES:
        hint = ": convert the photographs to JPEG, as `univoxel poses` does" * (suffix in HEIF)
        expected = f"expected an image ({' '.join(SUFFIXES)}), got '{path.suffix}'"
        raise DataError(f"{path}: {expected}{hint}")
    _require_file(path)
    with path.open("rb") as file:
        head = file.read(4)
    return ".exr" if head == EXR_HEAD else ".hdr" if head[:2] == b"#?" else path.suffix.lower()


def image_size(path: str | Path) -> tuple[int, int]:
    """Width and height of a picture that Pillow or OpenEXR reads, from its beginning only; a
    DataError as in `read_image`."""
    path = Path(path)
    if kind_of(path) != ".exr":
        with opened(path, whole=False) as image:
            return image.size
    try:
        with _exr(path, header_only=True) as file:
            low, high = file.header()["displayWindow"]
        return int(high[0] - low[0]) + 1, int(high[1] - low[1]) + 1
    except (OSError, ValueError, RuntimeError) as error:
        raise DataError(f"{path}: this OpenEXR file could not be read: {error}") from None


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
        f"; the EXIF orientation {found} of {path.name} is not applied, because cameras and "
        "masks refer to the stored pixels"
    )


def upright_from_stored(pixels: Tensor, turned: int) -> Tensor:
    """Pixels [H, W, ..] as they are looked at, from those of a file of that EXIF orientation."""
    if turned >= 5:
        pixels = pixels.transpose(0, 1)
    return pixels.flip(axes) if (axes := FLIPPED.get(turned)) else pixels


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
    """Channels as in `read_exr`, and the primaries that the file states, if any."""
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
        raise DataError(f"{path}: this OpenEXR file could not be read: {error}") from None
    if len(colored) > 1:
        raise DataError(
            f"{path}: expected one image, got several parts with colours ({names}): save the "
            "part that you want to a file of its own"
        )
    if len({pixels.shape for pixels in channels.values()}) != 1:
        raise DataError(f"{path}: expected channels of the same size, got subsampled ones")
    if not np.array_equal(data, shown):
        channels = {name: _framed(p, data, shown, path) for name, p in channels.items()}
    return {name: np.asarray(pixels, np.float32) for name, pixels in channels.items()}, stated


def _framed(
    pixels: np.ndarray, data: tuple[np.ndarray, ...], shown: tuple[np.ndarray, ...], path: Path
) -> np.ndarray:
    """Pixels of a data window in those of the display window."""
    width, height = (int(high - low) + 1 for low, high in zip(*shown, strict=True))
    if min(width, height) < 1 or width * height > MOST_FRAMED:
        raise DataError(f"{path}: expected a valid display window, got {width}x{height} pixels")
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
            raise ValueError(f"write_png: the image for {path} contains NaN")
        array = (array.clip(0, 1) * 255 + 0.5).astype(np.uint8)
    if array.dtype != np.uint8:
        raise ValueError(f"write_png: image must be uint8 or floating, got {array.dtype}")
    encoded = io.BytesIO()
    Image.fromarray(array).save(encoded, format="PNG")
    write_bytes(path, encoded.getbuffer())


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
        raise ValueError(f"write_exr: channels must all be [H, W] and of the same size, got {got}")
    if half:
        arrays = {name: array.clip(-HALF_MAX, HALF_MAX) for name, array in arrays.items()}
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    pixels = {n: np.ascontiguousarray(a.astype(kind)) for n, a in arrays.items()}
    # Not straight to the file: when the disk fills up while OpenEXR closes a file, it says nothing.
    encoded = io.BytesIO()
    OpenEXR.File(header, pixels).write(encoded)
    write_bytes(path, encoded.getbuffer())


@contextmanager
def _exr(path: Path, **options: bool) -> Iterator[OpenEXR.File]:
    """An open OpenEXR file; a RuntimeError, ValueError or TypeError where it is damaged.

    Of damage the library writes lines to stdout, from Python, and to stderr, from C. Here they
    become a ValueError, and what other threads print meanwhile is passed on.
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


def _require_file(path: Path) -> None:
    """OpenEXR prints to stderr about files that are not there; ask before."""
    if not path.is_file():
        what = "a folder" if path.is_dir() else "nothing there"
        raise DataError(f"{path}: expected a file, got {what}")
    if not path.stat().st_size:
        raise DataError(f"{path}: the file is empty")


def open_picture(path: Path, formats: Sequence[str]) -> Image.Image:
    """A file in Pillow's hands, whose own limit of size is too low for photographs; OSError,
    SyntaxError, ValueError or Image.DecompressionBombError where it is no such picture."""
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
    """A picture in Pillow's hands, its pixels read where `whole`; a DataError where the file is
    wrong, also where the block runs into it."""
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
        raise DataError(f"{path}: expected {kind}, but the palette is missing") from None
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise DataError(f"{path}: expected {kind}, {_what_it_is(path, error)}") from None


def as_array(image: Image.Image, path: Path, in_srgb: bool = False) -> np.ndarray:
    """Pixels [H, W, C] of a picture, as `read_image` has them; a DataError of numbers of 32 bits,
    of which nothing says how bright they are."""
    if image.mode.startswith("I;16"):
        return np.asarray(image, np.float32)[..., None] / 65535
    if image.mode in ("I", "F"):
        raise DataError(f"{path}: expected 8 or 16 bits per channel, got 32: convert the image")
    grey = image.mode in ("1", "L")
    mode = "L" if grey else "RGBA" if image.has_transparency_data else "RGB"
    source = image
    if image.mode not in (mode, "CMYK"):  # whose profile is of its own numbers
        image = image.convert(mode)
    if in_srgb and not grey:
        image = srgb_of(image, source)
    array = np.array(image if image.mode == mode else image.convert(mode))
    return array[..., None] if grey else array


def srgb_of(picture: Image.Image, source: Image.Image) -> Image.Image:
    """A picture RGB, RGBA or CMYK in the colours that its file states, as RGB or RGBA in sRGB.

    Telephones store colours of a wider space, with a profile; cameras set to Adobe RGB state it in
    EXIF, and PNG may have a gamma and primaries. One that is sRGB already, or whose profile is
    broken or of something else, stays as it is.

    Args:
        source: the picture as it was opened, which has what the file states.
    """
    profile, info = source.info.get("icc_profile"), source.info
    if profile:
        return _by_profile(picture, profile)
    if picture.mode == "CMYK":
        return picture
    gamma, primaries = 1 / SRGB_POWER, REC_709
    if source.getexif().get_ifd(ExifTags.IFD.Interop).get(1) == "R03":
        primaries = ADOBE_RGB
    elif "srgb" not in info:
        gamma = max(info.get("gamma") or gamma, 0.1)
        white_x, white_y, *colors = info.get("chromaticity") or (*REC_709[6:], *REC_709[:6])
        primaries = (*colors, white_x, white_y)
    path = Path(getattr(source, "filename", ""))
    if source.format == "PNG" and path.name and (code := _code_points(path)):
        gamma, primaries = 1 / SRGB_POWER, CODED.get(code[0], REC_709)
        if code[1] in HDR_CURVES:
            said = f"{path}: expected sRGB colours, got {HDR_CURVES[code[1]]} (HDR)"
            raise DataError(f"{said}: save the photographs without HDR")
    if primaries is ADOBE_RGB or abs(gamma * SRGB_POWER - 1) > 0.05:
        tone = 255 * linear_to_srgb((torch.arange(256) / 255) ** (1 / gamma))
        table, alpha = 3 * tone.round().int().tolist(), [*range(256)]
        picture = picture.point(table + (alpha if picture.mode == "RGBA" else []))
    axis = torch.linspace(0, 1, NODES)
    blue, green, red = torch.meshgrid(axis, axis, axis, indexing="ij")
    light = srgb_to_linear(torch.stack([red, green, blue], -1)).numpy()
    turned = in_rec709(light, primaries)
    if turned is light:
        return picture
    cube = linear_to_srgb(torch.from_numpy(turned)).flatten().tolist()
    return picture.filter(ImageFilter.Color3DLUT(NODES, cube))


def _code_points(path: Path) -> bytes:
    """Primaries and curve that a PNG states as videos do, by their numbers in ITU-T H.273."""
    with path.open("rb") as file:
        _, found, rest = file.read(HEAD).partition(b"\0\0\0\4cICP")
    return rest[:2] if found else b""


def _by_profile(picture: Image.Image, profile: bytes) -> Image.Image:
    """A picture as in `srgb_of`, by an ICC profile. What it is called says nothing."""
    alpha = picture.getchannel("A") if picture.mode == "RGBA" else None
    flat = picture.convert("RGB") if alpha else picture
    try:
        own = ImageCms.ImageCmsProfile(io.BytesIO(profile))
        srgb = ImageCms.createProfile("sRGB")
        turn = ImageCms.buildTransform(own, srgb, flat.mode, "RGB")
        probe = Image.fromarray(PROBE)
        if flat.mode == "RGB":
            seen = np.asarray(ImageCms.applyTransform(probe, turn), np.int16)
            if np.abs(seen - PROBE).max() <= SAME:
                return picture
        turned = ImageCms.applyTransform(flat, turn)
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
        return "but the file is HEIC or AVIF: convert it to JPEG, as `univoxel poses` does"
    with path.open("rb") as file:
        head = file.read(4)
    if head in (b"II*\0", b"MM\0*"):
        return f"but this TIFF could not be read: {error}: convert it to PNG or JPEG with 8 bits"
    return f"but it could not be read: {error}"
