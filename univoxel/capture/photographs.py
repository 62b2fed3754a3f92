"""Photographs of any format: which there are, what they say of their camera, their pixels upright.

Formats: JPEG, PNG, TIFF, WebP, AVIF; HEIC with pillow-heif; RAW with rawpy.
"""

from __future__ import annotations

import importlib.util
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image, ImageOps

from univoxel.data.images import is_heif, open_picture, srgb_of
from univoxel.data.masks import without_masks
from univoxel.errors import DataError, MissingExtra

PLAIN = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".webp", ".avif")
HEIF = (".heic", ".heif", ".hif")
# What Pillow may take a file for, whatever its name says: it would start Ghostscript for PostScript
FORMATS = ("JPEG", "MPO", "PNG", "TIFF", "WEBP", "AVIF", "HEIF")
RAW = (
    *(".dng", ".cr2", ".cr3", ".crw", ".nef", ".nrw", ".arw", ".sr2", ".raf", ".orf", ".rw2"),
    *(".pef", ".srw", ".3fr", ".iiq", ".erf", ".mrw", ".x3f"),
)
# Of one photograph in several formats the first is taken
ORDER = (".jpg", ".jpeg", *HEIF, ".png", ".tif", ".tiff", ".webp", ".avif", *RAW)
FEWEST = 3  # pictures that are a capture; fewer beside a folder of them are previews
NAMED = 5  # folders in a message, at most
DIAGONAL_35MM = math.hypot(36, 24)  # millimetres
T = Image.Transpose
TURNS = {5: T.TRANSPOSE, 6: T.ROTATE_270, 7: T.TRANSVERSE, 8: T.ROTATE_90}  # to upright, by EXIF
SIDEWAYS = tuple(TURNS)  # orientations that swap width and height
MAKE, MODEL, ORIENTATION, DETAILS = 0x010F, 0x0110, 0x0112, 0x8769
FOCAL, FOCAL_35MM, EXIF_WIDTH, EXIF_HEIGHT = 0x920A, 0xA405, 0xA002, 0xA003
SRGB_GAMMA = (2.4, 12.92)  # of a RAW's development
BROKEN = (OSError, SyntaxError, ValueError, Image.DecompressionBombError, EOFError)


@dataclass(frozen=True)
class Photograph:
    """A photograph in a file, and what the file says of its camera."""

    path: Path
    width: int  # pixels, upright
    height: int
    camera: str = ""  # maker and model
    focal: tuple[float, float] = (0.0, 0.0)  # millimetres: as it is, and for 35 mm film; 0 unknown
    whole: bool = False  # whether the file is as the camera took it, not cropped or shrunk
    turned: int = 1  # how the stored pixels must be turned, as of EXIF

    @property
    def name(self) -> str:
        return self.path.stem

    @property
    def portrait(self) -> bool:
        return self.height > self.width

    @property
    def prior(self) -> float | None:
        """Focal length in pixels, as far as the file can be believed.

        Of a cropped file it is wrong by the crop.
        """
        if not self.whole or not self.focal[1] > 0:
            return None
        return self.focal[1] / DIAGONAL_35MM * math.hypot(self.width, self.height)


def find_photographs(folder: Path) -> tuple[list[Path], list[str], int]:
    """The photographs of a folder by name, names of files that are none, and how many came twice.

    Where the folder has none or a few beside a folder `images`, those of that. Of a photograph in
    two formats, as many cameras write it, one is taken. Masks beside photographs are none.

    Raises:
        DataError: no photographs.
    """
    for place in (folder, folder / "images"):
        pictures, others = _pictures(place)
        if len(pictures) < FEWEST and place == folder and _pictures(folder / "images")[0]:
            continue
        if not pictures:
            continue
        best: dict[str, Path] = {}
        for path in sorted(pictures, key=lambda p: ORDER.index(p.suffix.lower())):
            best.setdefault(path.stem, path)
        return sorted(best.values()), others, len(pictures) - len(best)
    inner = [p for p in sorted(folder.rglob("*")) if p.is_dir() and len(_pictures(p)[0]) >= FEWEST]
    where = ", ".join(str(p.relative_to(folder)) for p in inner[:NAMED])
    raise DataError(
        f"{folder}: expected photographs ({' '.join((*PLAIN, *HEIF))} or RAW), got none"
        + (f" but in {where}: give that folder, or put all into one" if inner else "")
    )


def _pictures(folder: Path) -> tuple[list[Path], list[str]]:
    """The photographs of one folder, and names of files that are none."""
    if not folder.is_dir():
        return [], []
    files = sorted(p for p in folder.iterdir() if p.is_file() and not p.name.startswith("."))
    pictures = without_masks([p for p in files if p.suffix.lower() in ORDER])
    return pictures, [p.name for p in files if p not in set(pictures)]


def require_readers(paths: list[Path]) -> None:
    """Say before anything is read whether a package is missing for some of the files.

    Raises:
        MissingExtra: it is.
    """
    for suffixes, module, package, kind in (
        (HEIF, "pillow_heif", "pillow-heif", "HEIC"),
        (RAW, "rawpy", "rawpy", "RAW"),
    ):
        found = next((p for p in paths if p.suffix.lower() in suffixes), None)
        if found and importlib.util.find_spec(module) is None:
            raise MissingExtra(
                f"{found.name}: {kind} needs {package}: pip install 'univoxel[capture]'"
            )


def describe(path: Path) -> Photograph:
    """Size and camera of a photograph, from its beginning alone.

    Raises:
        DataError: it cannot be read.
    """
    try:
        if path.suffix.lower() in RAW:
            return _describe_raw(path)
        with _open(path) as image:
            exif = image.getexif()
            details = exif.get_ifd(DETAILS)
            turned = int(exif.get(ORIENTATION, 1) or 1)
            width, height = image.size
            stated = sorted(_number(details.get(tag)) for tag in (EXIF_WIDTH, EXIF_HEIGHT))
            camera = " ".join(str(exif.get(tag, "")).strip("\0 ") for tag in (MAKE, MODEL))
            focal = _number(details.get(FOCAL)), _number(details.get(FOCAL_35MM))
    except BROKEN as error:
        raise DataError(f"{path}: expected a photograph, could not read it: {error}") from None
    whole = stated == sorted((width, height))
    if turned in SIDEWAYS:
        width, height = height, width
    return Photograph(path, width, height, camera.strip(), focal, whole, turned)


def read_upright(path: Path, longest: int = 0) -> Image.Image:
    """The picture as it is meant to be looked at, sRGB: RGB, or RGBA where it has transparency.

    Args:
        longest: shrink it to at most so many pixels along the longer side; 0 for its own size.

    Raises:
        DataError: it cannot be read to its end.
    """
    try:
        if path.suffix.lower() in RAW:
            return shrunk_to(_develop(path, longest), longest)
        with _open(path) as image:
            if longest:  # JPEG decodes to 1/2, 1/4 or 1/8 at a fraction of the time
                size = fitted(image.width, image.height, longest)
                image.draft(None, size)
            image.load()
            profile = image.info.get("icc_profile")
            picture = shrunk_to(_eight_bits(image), longest)
            orientation = image.getexif().get(ORIENTATION, 1)
    except BROKEN as error:
        raise DataError(f"{path}: expected a photograph, could not read it: {error}") from None
    picture = srgb_of(picture, profile) if profile else picture
    picture.info.pop("icc_profile", None)
    picture.getexif()[ORIENTATION] = orientation
    return ImageOps.exif_transpose(picture)


def fitted(width: int, height: int, longest: int) -> tuple[int, int]:
    """The size with at most so many pixels along the longer side; 0 for as it is."""
    side = max(width, height)
    if not longest or side <= longest:
        return width, height
    return max(1, round(width * longest / side)), max(1, round(height * longest / side))


def shrunk_to(picture: Image.Image, longest: int) -> Image.Image:
    size = fitted(picture.width, picture.height, longest)
    if size == picture.size:
        return picture
    return picture.resize(size, Image.Resampling.LANCZOS, reducing_gap=3.0)


def _can_read_heif() -> bool:
    return importlib.util.find_spec("pillow_heif") is not None


def _open(path: Path) -> Image.Image:
    if path.suffix.lower() in HEIF or (_can_read_heif() and is_heif(path)):
        import pillow_heif  # pyright: ignore[reportMissingImports]  the extra `capture`

        pillow_heif.register_heif_opener()
    Image.init()  # builds of Pillow differ in formats, and it knows none before
    return open_picture(path, [name for name in FORMATS if name in Image.OPEN])


def _eight_bits(image: Image.Image) -> Image.Image:
    if image.mode.startswith(("I", "F")):  # grey of 16 bits
        array = np.asarray(image, np.float32)
        top = 65535 if array.max() > 255 else 255
        return Image.fromarray((array * (255 / top)).clip(0, 255).astype(np.uint8)).convert("RGB")
    return image.convert("RGBA" if image.has_transparency_data else "RGB")


def _describe_raw(path: Path) -> Photograph:
    raw = _raw(path)
    try:
        sizes = raw.sizes
    finally:
        raw.close()
    width, height = sizes.width, sizes.height
    if sizes.flip in (5, 6):
        width, height = height, width
    return Photograph(path, width, height)


def _develop(path: Path, longest: int) -> Image.Image:
    raw = _raw(path)
    try:
        half = 0 < 2 * longest <= max(raw.sizes.width, raw.sizes.height)
        # The brightness as it was taken: otherwise each photograph has an exposure of its own
        array = raw.postprocess(
            use_camera_wb=True, no_auto_bright=True, gamma=SRGB_GAMMA, half_size=half
        )
    except Exception as error:
        raise OSError(str(error)) from None  # rawpy's errors have no common root but Exception
    finally:
        raw.close()
    return Image.fromarray(array)


def _raw(path: Path):
    import rawpy  # pyright: ignore[reportMissingImports]  the extra `capture`

    try:
        return rawpy.imread(str(path))
    except rawpy.LibRawError as error:  # pyright: ignore[reportAttributeAccessIssue]
        raise OSError(str(error)) from None


def _number(value: object) -> float:
    try:
        number = float(value)  # pyright: ignore[reportArgumentType]
    except (TypeError, ValueError, ZeroDivisionError):
        return 0.0
    return number if math.isfinite(number) else 0.0
