"""Animations as GIF or MP4, and a view of a scene during training."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from univoxel.camera import Cameras, resize
from univoxel.color import linear_to_srgb
from univoxel.config import JointConfig, StageConfig, TrainConfig
from univoxel.core.choices import ANIMATIONS
from univoxel.core.files import replacing
from univoxel.data import load_photos
from univoxel.data.images import image_size, write_png
from univoxel.envmap import EnvMap, tables
from univoxel.errors import DataError, MissingExtra, UserError
from univoxel.render.pipeline import extract_mesh, radiance_of, shade_hits, surface_of_view
from univoxel.render.relight import Lighting, relight_surface, traced_mesh
from univoxel.scene import Scene
from univoxel.training.clock import Clock

FRAMES_PER_SECOND = 25  # GIF counts in hundredths of a second


def require(kind: str) -> None:
    """Say before the work starts whether this kind can be written: a UserError of another kind than
    gif and mp4, a MissingExtra of mp4 without imageio-ffmpeg."""
    if kind not in ANIMATIONS:
        raise UserError(f"relight: animation must be gif or mp4, got {kind!r}", "animation")
    if kind == "mp4":
        _ffmpeg()


def write_animation(path: Path, pictures: Sequence[Path], rate: int = FRAMES_PER_SECOND) -> None:
    """Write pictures, on white where they are transparent, `rate` a second.

    Of differing sizes, they are in the middle of frames that hold the largest. Whole or not at all;
    a GIF runs in a loop; an MP4, which needs imageio-ffmpeg, is H.264, cut to even sizes.
    """
    sizes = [image_size(picture) for picture in pictures]
    width, height = (max(size[i] for size in sizes) for i in (0, 1))
    frames = (_on_white(picture, width, height) for picture in pictures)
    with replacing(path) as temporary:
        if path.suffix == ".gif":
            first, *rest = (frame.convert("P", palette=Image.Palette.ADAPTIVE) for frame in frames)
            timing = {"duration": 1000 // rate, "loop": 0}
            first.save(temporary, format="GIF", save_all=True, append_images=rest, **timing)
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
            "an MP4 needs imageio-ffmpeg: pip install 'univoxel[video]', or use gif"
        ) from None
    return imageio_ffmpeg


# One view of a scene while it is trained: render, albedo and normal side by side.


FRAMES = 60  # of a training, at equal shares of its work
TIMELAPSE_FRAMES_PER_SECOND = 10
SIZE = 256  # pixels along a picture, at most
LABEL = 18  # pixels above the pictures
LAYERS = ("render", "albedo", "normal")  # of a frame
MAP_ROWS, SAMPLES, BOUNCES = 64, 16, 1  # of light from the map


class Timelapse:
    """Takes frames by the clock of training, and makes one file of them."""

    def __init__(self, path: str | Path, cfg: TrainConfig) -> None:
        """
        Args:
            path: .gif or .mp4, or a folder for PNG files: a name without an ending, or with / at
                its end.

        Raises:
            UserError: another ending.
            MissingExtra: an MP4 without imageio-ffmpeg.
            DataError: the photographs cannot be used.
        """
        kind = Path(path).suffix
        folder = str(path).endswith("/") or not kind
        if not folder and kind[1:] not in ANIMATIONS:
            raise UserError(
                f"timelapse: expected a name that ends in .gif, .mp4 or / (a folder), got {path}",
                "timelapse",
            )
        if not folder:
            require(kind[1:])
        self.file: Path | None = None if folder else Path(path)
        self.folder: Path = Path(path) if folder else cfg.out / "timelapse"
        size, outside = cfg.downscale, cfg.allow_outside
        try:
            cameras = load_photos(cfg.data, "test", size, allow_outside=outside).cameras
        except DataError:
            cameras = load_photos(cfg.data, "train", size, allow_outside=outside).cameras
        self.cameras: Cameras = resize(cameras, min(cameras.width, SIZE))
        self._next = 0.0  # share of the training at which the next frame is due

    def take_frame(self, scene: Scene, clock: Clock, last: bool = False) -> None:
        """Take a frame if it is time for one. The scene and the random numbers stay as they are."""
        if clock.work_done < self._next and not last:
            return
        self._next = clock.work_done + 1 / FRAMES
        self.folder.mkdir(parents=True, exist_ok=True)
        with torch.random.fork_rng(devices=[]):
            picture = frame(scene, self.cameras, *shown(clock))
        path = self.folder / f"step_{clock.step:06d}.png"
        write_png(path, labelled(picture, (f"{clock.seconds:.1f} s", *LAYERS[1:])))

    def finish(self, scene: Scene, clock: Clock) -> None:
        """Take the last frame, and make the file of all; where it cannot be written the frames
        stay."""
        self.take_frame(scene, clock, last=True)
        if self.file is None:
            return
        self.file.parent.mkdir(parents=True, exist_ok=True)
        write_animation(self.file, sorted(self.folder.glob("*.png")), TIMELAPSE_FRAMES_PER_SECOND)
        shutil.rmtree(self.folder)


def shown(clock: Clock) -> tuple[bool, bool]:
    """Whether the render is lit at all, by the radiance head alone before; and by the map."""
    if clock.stage == len(clock.cfg.stages):
        return True, False
    now = clock.cfg.stages[clock.stage]
    if isinstance(now, StageConfig):
        return clock.done >= now.physical_from, False
    return True, isinstance(now, JointConfig)


@torch.no_grad()
def frame(
    scene: Scene, cameras: Cameras, lit: bool, by_map: bool, photograph: int | None = None
) -> Tensor:
    """LAYERS of the first of some cameras [H, 3 W, 3], sRGB on black.

    Args:
        lit: by the physically based render, not by the radiance head.
        by_map: light is the distant map, by tracing paths: while it is solved for, the local light
            does not follow the materials.
        photograph: that was trained on, in whose light and exposure it is shown; None: the mean.
    """
    training = scene.training
    scene.eval()
    surface, wo = surface_of_view(scene, cameras, 0)
    opacity = surface.opacity[:, None]
    if by_map:
        assert scene.sky is not None
        lighting = Lighting(tables(EnvMap(scene.sky.latlong(MAP_ROWS))))
        traced = traced_mesh(extract_mesh(scene), scene.field.voxel_size)
        sent = relight_surface(surface, wo, traced, lighting, samples=SAMPLES, bounces=BOUNCES)
        render = linear_to_srgb(sent * opacity)
    elif lit:
        render = linear_to_srgb(shade_hits(scene, surface, wo, photograph))
    else:
        render = radiance_of(scene, surface, wo, photograph) * opacity
    scene.train(training)
    albedo = linear_to_srgb(surface.albedo * opacity)
    normal = (0.5 + 0.5 * surface.normal) * opacity
    width, height = cameras.size(0)
    return torch.cat([tile.reshape(height, width, 3) for tile in (render, albedo, normal)], 1)


def labelled(picture: Tensor, names: Sequence[str]) -> np.ndarray:
    """[H + LABEL, W, 3] uint8: tiles beside one another, a picture [H, W, 3], under their names."""
    height, width, _ = picture.shape
    pixels = (picture.clamp(0, 1) * 255 + 0.5).to(torch.uint8).numpy()
    image = Image.new("RGB", (width, height + LABEL), (32, 32, 32))
    image.paste(Image.fromarray(pixels), (0, LABEL))
    drawing, font = ImageDraw.Draw(image), ImageFont.load_default(12)
    for k, text in enumerate(names):
        drawing.text((4 + k * width // len(names), 2), text, "white", font)
    return np.asarray(image)
