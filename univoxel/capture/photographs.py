"""Photographs of any format and sharp frames of a video: listing, metadata, upright pixels."""

from __future__ import annotations

import importlib.util
import math
import re
import subprocess
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import ExifTags, Image, ImageOps
from scipy.ndimage import laplace

from univoxel.color import linear_to_srgb, srgb_to_linear
from univoxel.core import log
from univoxel.data.images import (
    DISPLAY_P3,
    REC_709,
    REC_2020,
    in_rec709,
    is_heif,
    open_picture,
    srgb_of,
)
from univoxel.data.masks import without_masks
from univoxel.errors import DataError, MissingExtra

# Formats of photographs: JPEG, PNG, TIFF, WebP, AVIF; HEIC with pillow-heif; RAW with rawpy.


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
SIDEWAYS = (5, 6, 7, 8)  # orientations of EXIF that swap width and height
Tag = ExifTags.Base
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
    turned: int = 1  # how the stored pixels must be turned, as in EXIF

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
    """The photographs of a folder by name, names of files that are none, and how many came twice; a
    DataError without any.

    Where the folder has none or a few beside a folder `images`, those of that. Of a photograph in
    two formats, as many cameras write it, one is taken. Masks beside photographs are none.
    """
    pictures, others = _pictures(folder)
    if len(pictures) < FEWEST and (beside := _pictures(folder / "images"))[0]:
        pictures, others = beside
    if pictures:
        best: dict[str, Path] = {}
        for path in sorted(pictures, key=lambda p: ORDER.index(p.suffix.lower())):
            best.setdefault(path.stem, path)
        return sorted(best.values()), others, len(pictures) - len(best)
    inner = [p for p in sorted(folder.rglob("*")) if p.is_dir() and len(_pictures(p)[0]) >= FEWEST]
    where = ", ".join(str(p.relative_to(folder)) for p in inner[:NAMED])
    raise DataError(
        f"{folder}: expected photographs ({' '.join((*PLAIN, *HEIF))} or RAW), got none"
        + (f", but {where} has some: pass that folder, or move all files into one" if inner else "")
    )


def _pictures(folder: Path) -> tuple[list[Path], list[str]]:
    """The photographs of one folder, and names of files that are none."""
    if not folder.is_dir():
        return [], []
    files = sorted(p for p in folder.iterdir() if p.is_file() and not p.name.startswith("."))
    pictures = without_masks([p for p in files if p.suffix.lower() in ORDER])
    return pictures, [p.name for p in files if p not in set(pictures)]


def require_readers(paths: list[Path]) -> None:
    """Raise a MissingExtra, before anything is read, where files need a package that is missing."""
    for suffixes, module, package, kind in (
        (HEIF, "pillow_heif", "pillow-heif", "HEIC"),
        (RAW, "rawpy", "rawpy", "RAW"),
    ):
        found = next((p for p in paths if p.suffix.lower() in suffixes), None)
        if found and importlib.util.find_spec(module) is None:
            raise MissingExtra(
                f"{found.name}: reading {kind} needs {package}: pip install 'univoxel[capture]'"
            )


def describe(path: Path) -> Photograph:
    """Size and camera of a photograph, from its beginning only; a DataError if it is damaged."""
    try:
        if path.suffix.lower() in RAW:
            with _raw(path) as raw:
                width, height = raw.sizes.width, raw.sizes.height
                across = raw.sizes.flip in (5, 6)
            return Photograph(path, *((height, width) if across else (width, height)))
        with _open(path) as image:
            exif = image.getexif()
            details = exif.get_ifd(ExifTags.IFD.Exif)
            turned = int(exif.get(Tag.Orientation, 1) or 1)
            width, height = image.size
            sides = Tag.ExifImageWidth, Tag.ExifImageHeight
            stated = sorted(_number(details.get(tag)) for tag in sides)
            camera = " ".join(str(exif.get(tag, "")).strip("\0 ") for tag in (Tag.Make, Tag.Model))
            lengths = Tag.FocalLength, Tag.FocalLengthIn35mmFilm
            focal, on_film = (_number(details.get(tag)) for tag in lengths)
    except BROKEN as error:
        raise DataError(f"{path}: this photograph could not be read: {error}") from None
    whole = stated == sorted((width, height))
    if turned in SIDEWAYS:
        width, height = height, width
    return Photograph(path, width, height, camera.strip(), (focal, on_film), whole, turned)


def read_upright(path: Path, longest: int = 0) -> Image.Image:
    """The picture as it is meant to be looked at, sRGB: RGB, or RGBA where it has transparency; at
    most so many pixels along the longer side, or 0 for its own size. A DataError where it cannot be
    read to its end."""
    try:
        if path.suffix.lower() in RAW:
            return shrunk_to(_develop(path, longest), longest)
        with _open(path) as image:
            if longest:  # JPEG decodes to 1/2, 1/4 or 1/8 at a fraction of the time
                size = fitted(image.width, image.height, longest)
                image.draft(None, size)
            image.load()
            picture = srgb_of(shrunk_to(_eight_bits(image), longest), image)
            orientation = image.getexif().get(Tag.Orientation, 1)
    except BROKEN as error:
        raise DataError(f"{path}: this photograph could not be read: {error}") from None
    picture.info.pop("icc_profile", None)
    picture.getexif()[Tag.Orientation] = orientation
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


def _open(path: Path) -> Image.Image:
    readable = importlib.util.find_spec("pillow_heif") is not None
    if path.suffix.lower() in HEIF or (readable and is_heif(path)):
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


def _develop(path: Path, longest: int) -> Image.Image:
    with _raw(path) as raw:
        half = 0 < 2 * longest <= max(raw.sizes.width, raw.sizes.height)
        # The brightness as it was taken: otherwise each photograph has an exposure of its own
        array = raw.postprocess(
            use_camera_wb=True, no_auto_bright=True, gamma=SRGB_GAMMA, half_size=half
        )
    return Image.fromarray(array)


@contextmanager
def _raw(path: Path) -> Iterator[Any]:
    import rawpy  # pyright: ignore[reportMissingImports]  the extra `capture`

    try:
        with rawpy.imread(str(path)) as raw:
            yield raw
    except Exception as error:  # rawpy's errors have no common root but this
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
PAPER = 203.0  # cd/m2 of white paper in them
# x and y of red, green, blue and white, by ffmpeg's names
PRIMARIES = {
    "bt2020": REC_2020,
    "smpte432": DISPLAY_P3,
    "smpte431": (0.680, 0.320, 0.265, 0.690, 0.150, 0.060, 0.3140, 0.3510),
    "smpte170m": (0.630, 0.340, 0.310, 0.595, 0.155, 0.070, 0.3127, 0.3290),
    "smpte240m": (0.630, 0.340, 0.310, 0.595, 0.155, 0.070, 0.3127, 0.3290),
    "bt470bg": (0.640, 0.330, 0.290, 0.600, 0.150, 0.060, 0.3127, 0.3290),
}
# Of a video that states primaries only
MATRIX_OF = {"bt709": "bt709", "bt2020": "bt2020", "smpte432": "bt709"}
MATRIX_OF |= dict.fromkeys(("smpte170m", "bt470bg"), "bt601")
OTHER_MATRICES = ("bt2020c", "ictcp", "ipt-c2", "ycgco", "smpte2085")  # that ffmpeg does not undo
FIELDS = ("progressive", "top first", "bottom first", "top coded first (swapped)")
NODES = 65  # along a side of a table of colours
TABLE = "colours.cube"
STILL = 0.25  # of 255, by which frames of a picture that stands still may differ


def is_video(path: Path) -> bool:
    return path.is_file() and path.suffix.lower() in SUFFIXES


def require_ffmpeg() -> None:
    """Raise a MissingExtra, before anything is read, where videos cannot be."""
    if importlib.util.find_spec("imageio_ffmpeg") is None:
        raise MissingExtra("reading a video needs imageio-ffmpeg: pip install 'univoxel[capture]'")


def write_frames(video: Path, folder: Path, every: float | None = None) -> int:
    """Write frames as FOLDER/frame_00000.jpg ..., turned as the video says; return how many. A
    DataError where the video cannot be read.

    The sharpest of each `every` seconds is taken, of LOOKS that are looked at, and none twice where
    the picture stands still. By default so many seconds that KEPT are.
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
    kept = chosen[:1]
    for frame in chosen[1:]:
        change = np.abs(pictures[frame].astype(np.int16) - pictures[kept[-1]])
        kept += [frame] if change.mean() > STILL else []
    if not kept:
        raise DataError(f"{video}: no frame of this video could be read")
    folder.mkdir(parents=True, exist_ok=True)
    which = "+".join(f"eq(n\\,{n})" for n in kept)
    target = str(folder.absolute() / "frame").replace("%", "%%") + "_%05d.jpg"
    with tempfile.TemporaryDirectory() as place:
        _ffmpeg(
            video,
            f"{rate},select='{which}',{_to_jpeg(video, Path(place))}",
            *("-fps_mode", "passthrough", "-q:v", str(JPEG_QUALITY), "-start_number", "0"),
            target,
            place=place,
        )
    return len(kept)


def _to_jpeg(video: Path, folder: Path) -> str:
    """The filter that makes of a video what readers of JPEG expect: square pixels of Rec. 709's
    colours, in BT.601 of full range. Without it ffmpeg writes other colours' numbers as they are.

    Args:
        folder: for the table that the filter reads where colours are not those of Rec. 709.
    """
    found = re.search(r"Video: .*?, \w+(?:\(([^)]*)\))?, (\d+)x(\d+)", _about(video))
    words = re.split(", *", found[1] or "") if found else []
    tags = next((w for w in words if w not in ("tv", "pc") and w not in FIELDS), "unknown")
    matrix, primaries, curve = tags.split("/") if tags.count("/") == 2 else [tags] * 3
    if matrix in OTHER_MATRICES:
        log.warning("%s: %s colours may come out wrong: record in BT.709", video.name, matrix)
    if primaries == "unknown" and (curve in HDR or matrix.startswith("bt2020")):
        primaries = "bt2020"
    if matrix == "unknown":
        large = found is not None and min(int(found[2]), int(found[3])) >= HD
        matrix = MATRIX_OF.get(primaries, "bt709" if large else "auto")
    else:
        matrix = "auto"
    table = ""
    stated = PRIMARIES.get(primaries, REC_709)
    if stated != REC_709 or curve in (*HDR, "linear"):
        _write_table(folder / TABLE, stated, curve)
        table = f",lut3d=file={TABLE}:interp=tetrahedral"
    if curve in HDR:
        said = "%s: %s colours (HDR) were tone mapped, so most detail above white is lost"
        log.warning(said, video.name, HDR[curve])
    exact = "flags=bicubic+accurate_rnd+full_chroma_int"
    return (
        f"scale=w='iw*max(sar,1)':h='ih/min(sar,1)':in_color_matrix={matrix}:{exact},setsar=1,"
        f"format=gbrp16le{table},"
        f"scale=out_color_matrix=bt601:out_range=pc:{exact},format=yuvj420p"
    )


def _write_table(path: Path, primaries: Sequence[float], curve: str) -> None:
    """A cube of colours for ffmpeg: from numbers in a video to those in Rec. 709.

    HDR is scaled so that paper is white, and goes over to white above three quarters of that, by
    the largest channel: hues stay.

    Source: ITU-R BT.2100, BT.2408 (paper has 203 cd/m2); BT.709's curve, also of BT.601 and 2020.
    """
    axis = np.linspace(0, 1, NODES)
    code = np.stack(np.meshgrid(axis, axis, axis, indexing="ij")[::-1], -1).reshape(-1, 3)
    match curve:
        case "smpte2084":
            power = code ** (32 / 2523)
            light = (power - 0.8359375).clip(0) / (18.8515625 - 18.6875 * power)
            light = light ** (16384 / 2610) * 10000 / PAPER
        case "arib-std-b67":
            a, b, c = 0.17883277, 0.28466892, 0.55991073
            scene = np.where(code <= 0.5, code**2 / 3, (np.exp((code - c) / a) + b) / 12)
            bright = (scene @ [0.2627, 0.6780, 0.0593])[:, None]
            light = scene * bright.clip(1e-9) ** 0.2 * 1000 / PAPER
        case "linear":
            light = code
        case "iec61966-2-1":
            light = srgb_to_linear(torch.from_numpy(code)).numpy()
        case _:
            light = np.where(code < 0.081, code / 4.5, ((code + 0.099) / 1.099) ** (1 / 0.45))
    light = in_rec709(light, primaries)
    if curve in HDR:
        largest = light.max(1, keepdims=True).clip(1e-9)
        light = light * np.where(largest < 0.75, 1, (1 - 0.25 * np.exp(3 - 4 * largest)) / largest)
    if curve in (*HDR, "linear", "iec61966-2-1"):
        shown = linear_to_srgb(torch.from_numpy(light)).numpy()
    else:
        shown = np.where(light < 0.018, 4.5 * light, 1.099 * light.clip(1e-9) ** 0.45 - 0.099)
    with path.open("w", encoding="ascii") as file:
        file.write(f"LUT_3D_SIZE {NODES}\n")
        np.savetxt(file, shown.clip(0, 1), "%.6f")


def sharpest(scores: list[float], looks: int) -> list[int]:
    """Index of the best of each group of so many in a row; the last group may be smaller."""
    groups = [range(i, min(i + looks, len(scores))) for i in range(0, len(scores), looks)]
    return [max(members, key=scores.__getitem__) for members in groups]


def sharpness(picture: np.ndarray) -> float:
    """Variance of the Laplacian of a grey picture [H, W]: to compare neighbouring frames by.

    It says nothing of frames that show something else: smooth sides have little of it.
    """
    return float(laplace(picture.astype(np.float32))[1:-1, 1:-1].var())


def seconds(video: Path) -> float:
    """Length of a video; a DataError where it does not say."""
    clock = r"(\d+):(\d+):(\d+\.?\d*)"
    found = re.findall(f"Duration: {clock}", _about(video))
    if not found:  # of recordings that were written as they came: the time of the last frame
        found = re.findall(f"time={clock}", _about(video, "-c", "copy", "-f", "null", "-"))
    if not found:
        raise DataError(f"{video}: this video could not be read")
    hours, minutes, rest = found[-1]
    return 3600 * int(hours) + 60 * int(minutes) + float(rest)


def _about(video: Path, *output: str) -> str:
    """What ffmpeg says of a video."""
    command = [_program(), "-hide_banner", "-nostdin", *_opened(video), *output]
    return subprocess.run(command, capture_output=True, check=False).stderr.decode(
        "utf-8", "replace"
    )


def _ffmpeg(video: Path, filters: str, *output: str, place: str | None = None) -> bytes:
    command = [_program(), "-v", "error", "-nostdin", *_opened(video), "-vf", filters, *output]
    done = subprocess.run(command, capture_output=True, check=False, cwd=place)
    if done.returncode:
        said = done.stderr.decode("utf-8", "replace").strip().splitlines() or ["no reason given"]
        raise DataError(f"{video}: this video could not be read: {said[-1]}")
    return done.stdout


def _opened(video: Path) -> list[str]:
    """Arguments that open a video only: no file that it names, nothing over a network."""
    allowed = ["-protocol_whitelist", "file", "-format_whitelist", VIDEO_FORMATS]
    return [*allowed, "-i", f"file:{video.absolute()}"]


def _program() -> str:
    import imageio_ffmpeg  # pyright: ignore[reportMissingImports]  the extra `capture`

    return imageio_ffmpeg.get_ffmpeg_exe()
