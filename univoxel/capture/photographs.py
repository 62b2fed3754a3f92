"""Photographs of any format, and sharp frames of a video: which there are, what they say of
their camera, their pixels upright."""

from __future__ import annotations

import importlib.util
import logging
import math
import re
import subprocess
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from PIL import Image, ImageOps

from univoxel.data.images import is_heif, open_picture, srgb_of
from univoxel.data.masks import without_masks
from univoxel.errors import DataError, MissingExtra

# Photographs of any format: which there are, what they say of their camera, their pixels upright.
#
# Formats: JPEG, PNG, TIFF, WebP, AVIF; HEIC with pillow-heif; RAW with rawpy.


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


# Frames of a video: the sharpest of each short while.


SUFFIXES = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".mts", ".3gp")
# What SUFFIXES hold. Formats that only name other files, such as lists of them, are not among these
VIDEO_FORMATS = "mov,mp4,m4a,3gp,3g2,mj2,avi,matroska,webm,mpegts"
LOOKS = 5  # frames that are looked at for each that is kept
KEPT = 80  # frames of a video, unless it is told otherwise
FASTEST = 6.0  # frames a second to keep at most, by default
LOOKED_AT = (640, 360)  # pixels, in which sharpness is compared
JPEG_QUALITY = 2  # of ffmpeg: 1 to 31, lower is better
HD = 720  # pixels of the shorter side from which colours are BT.709, where a video does not say
HDR = {"arib-std-b67": "HLG", "smpte2084": "PQ"}  # curves of colours that no JPEG has

log: logging.Logger = logging.getLogger("univoxel")


def is_video(path: Path) -> bool:
    return path.is_file() and path.suffix.lower() in SUFFIXES


def require_ffmpeg() -> None:
    """Say before anything is read whether videos can be.

    Raises:
        MissingExtra: they cannot.
    """
    if importlib.util.find_spec("imageio_ffmpeg") is None:
        raise MissingExtra("a video needs imageio-ffmpeg: pip install 'univoxel[capture]'")


def write_frames(video: Path, folder: Path, every: float | None = None) -> int:
    """Write frames as FOLDER/frame_00000.jpg ..., turned as the video says; return how many.

    The sharpest of each `every` seconds is taken, of LOOKS that are looked at, and none twice where
    the picture stands still. By default so many seconds that KEPT are.

    Raises:
        DataError: the video cannot be read.
    """
    if every is None:
        every = max(1 / FASTEST, seconds(video) / KEPT)
    rate = f"fps={LOOKS / every:.6f}"
    width, height = LOOKED_AT
    looked = _ffmpeg(
        video, f"{rate},scale={width}:{height}", "-f", "rawvideo", "-pix_fmt", "gray", "-"
    )
    pictures = np.frombuffer(looked, np.uint8).reshape(-1, height, width)
    chosen = sharpest([sharpness(picture) for picture in pictures], LOOKS)
    again = [np.array_equal(pictures[a], pictures[b]) for a, b in pairwise(chosen)]
    chosen = chosen[:1] + [n for n, same in zip(chosen[1:], again, strict=True) if not same]
    if not chosen:
        raise DataError(f"{video}: expected a video, got none of its frames")
    folder.mkdir(parents=True, exist_ok=True)
    which = "+".join(f"eq(n\\,{n})" for n in chosen)
    target = str(folder / "frame").replace("%", "%%") + "_%05d.jpg"
    _ffmpeg(
        video,
        f"{rate},select='{which}',{_to_jpeg(video)}",
        *("-fps_mode", "passthrough", "-q:v", str(JPEG_QUALITY), "-start_number", "0"),
        target,
    )
    return len(chosen)


def _to_jpeg(video: Path) -> str:
    """The filter that turns a video's colours into those that readers of JPEG expect: BT.601 in
    full range. Without it ffmpeg writes the numbers of HD colours as they are."""
    found = re.search(r"Video: .*?, \w+(?:\(([^)]*)\))?, (\d+)x(\d+)", _about(video))
    tags = re.split("[,/ ]+", found[1] or "") if found else []
    if curve := next((HDR[tag] for tag in tags if tag in HDR), None):
        log.warning("%s: colours of %s (HDR) come out flat: record without HDR", video.name, curve)
    stated = any(tag.startswith(("bt", "smpte", "fcc", "gbr")) for tag in tags)
    large = found is not None and min(int(found[2]), int(found[3])) >= HD
    origin = "bt709" if large and not stated else "auto"
    return f"scale=in_color_matrix={origin}:out_color_matrix=bt601:out_range=pc,format=yuvj420p"


def sharpest(scores: list[float], looks: int) -> list[int]:
    """Index of the best of each group of so many in a row; the last group may be smaller."""
    groups = [range(i, min(i + looks, len(scores))) for i in range(0, len(scores), looks)]
    return [max(members, key=scores.__getitem__) for members in groups]


def sharpness(picture: np.ndarray) -> float:
    """Variance of the Laplacian of a grey picture [H, W]: to compare neighbouring frames by.

    It says nothing of frames that show something else: smooth sides have little of it.
    """
    p = picture.astype(np.float32)
    inner = p[1:-1, 1:-1]
    laplacian = p[:-2, 1:-1] + p[2:, 1:-1] + p[1:-1, :-2] + p[1:-1, 2:] - 4 * inner
    return float(laplacian.var())


def seconds(video: Path) -> float:
    """Length of a video.

    Raises:
        DataError: it does not say.
    """
    clock = r"(\d+):(\d+):(\d+\.?\d*)"
    found = re.findall(f"Duration: {clock}", _about(video))
    if not found:  # of recordings that were written as they came: the time of the last frame
        found = re.findall(f"time={clock}", _about(video, "-c", "copy", "-f", "null", "-"))
    if not found:
        raise DataError(f"{video}: expected a video, could not read it")
    hours, minutes, rest = found[-1]
    return 3600 * int(hours) + 60 * int(minutes) + float(rest)


def _about(video: Path, *output: str) -> str:
    """What ffmpeg says of a video."""
    command = [_program(), "-hide_banner", "-nostdin", *_opened(video), *output]
    return subprocess.run(command, capture_output=True, check=False).stderr.decode(
        "utf-8", "replace"
    )


def _ffmpeg(video: Path, filters: str, *output: str) -> bytes:
    command = [_program(), "-v", "error", "-nostdin", *_opened(video), "-vf", filters, *output]
    done = subprocess.run(command, capture_output=True, check=False)
    if done.returncode:
        said = done.stderr.decode("utf-8", "replace").strip().splitlines() or ["no reason given"]
        raise DataError(f"{video}: expected a video, could not read it: {said[-1]}")
    return done.stdout


def _opened(video: Path) -> list[str]:
    """Arguments that open a video alone: no file that it names, nothing over a network."""
    allowed = ["-protocol_whitelist", "file", "-format_whitelist", VIDEO_FORMATS]
    return [*allowed, "-i", f"file:{video}"]


def _program() -> str:
    import imageio_ffmpeg  # pyright: ignore[reportMissingImports]  the extra `capture`

    return imageio_ffmpeg.get_ffmpeg_exe()
