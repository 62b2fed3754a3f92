"""Frames of a video: the sharpest of each short while."""

from __future__ import annotations

import importlib.util
import logging
import re
import subprocess
from itertools import pairwise
from pathlib import Path

import numpy as np

from univoxel.errors import DataError, MissingExtra

SUFFIXES = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".mts", ".3gp")
# What SUFFIXES hold. Formats that only name other files, such as lists of them, are not among these
FORMATS = "mov,mp4,m4a,3gp,3g2,mj2,avi,matroska,webm,mpegts"
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
    allowed = ["-protocol_whitelist", "file", "-format_whitelist", FORMATS]
    return [*allowed, "-i", f"file:{video}"]


def _program() -> str:
    import imageio_ffmpeg  # pyright: ignore[reportMissingImports]  the extra `capture`

    return imageio_ffmpeg.get_ffmpeg_exe()
