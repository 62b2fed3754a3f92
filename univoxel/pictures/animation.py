"""Pictures in files as one moving picture: GIF, or MP4 by ffmpeg."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from univoxel.data.images import image_size
from univoxel.errors import MissingExtra, UserError
from univoxel.files import replacing
from univoxel.names import ANIMATIONS

FRAMES_PER_SECOND = 25  # GIF counts in hundredths of a second


def require(kind: str) -> None:
    """Say before the work starts whether this kind can be written.

    Raises:
        UserError: another kind than gif and mp4.
        MissingExtra: mp4 without imageio-ffmpeg.
    """
    if kind not in ANIMATIONS:
        raise UserError(f"relight: animation must be gif or mp4, got {kind!r}", "animation")
    if kind == "mp4":
        _ffmpeg()


def write_animation(path: Path, pictures: Sequence[Path], rate: int = FRAMES_PER_SECOND) -> None:
    """Write pictures, on white where they are transparent, `rate` a second.

    Of differing sizes, they stand in the middle of frames that hold the largest. Whole or not at
    all; a GIF runs in a loop; an MP4 is H.264, cut to even sizes.

    Raises:
        OSError: a file cannot be read or written.
        MissingExtra: an MP4 without imageio-ffmpeg.
    """
    sizes = [image_size(picture) for picture in pictures]
    width, height = (max(size[i] for size in sizes) for i in (0, 1))
    frames = (_on_white(picture, width, height) for picture in pictures)
    with replacing(path) as temporary:
        if path.suffix == ".gif":
            first, *rest = (frame.convert("P", palette=Image.Palette.ADAPTIVE) for frame in frames)
            first.save(
                temporary,
                format="GIF",
                save_all=True,
                append_images=rest,
                duration=1000 // rate,
                loop=0,
            )
            return
        first = next(frames)
        width, height = width - width % 2, height - height % 2
        writer = _ffmpeg().write_frames(
            str(temporary),
            (width, height),
            fps=rate,
            codec="libx264",
            macro_block_size=2,
            output_params=["-f", "mp4", "-movflags", "+faststart"],
        )
        writer.send(None)
        for frame in (first, *frames):
            writer.send(np.ascontiguousarray(np.asarray(frame)[:height, :width]))
        writer.close()


def _on_white(path: Path, width: int, height: int) -> Image.Image:
    with Image.open(path) as image:
        picture = image.convert("RGBA")
    white = Image.new("RGBA", (width, height), "white")
    white.alpha_composite(picture, ((width - picture.width) // 2, (height - picture.height) // 2))
    return white.convert("RGB")


def _ffmpeg():
    try:
        import imageio_ffmpeg  # pyright: ignore[reportMissingImports]  the extra `video`
    except ImportError:
        raise MissingExtra(
            "an MP4 needs imageio-ffmpeg: pip install 'univoxel[video]', or choose gif"
        ) from None
    return imageio_ffmpeg
