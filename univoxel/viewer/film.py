"""A turn around the object as a moving picture, from where a camera stands."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from univoxel.camera import Cameras, resize
from univoxel.data.images import write_png
from univoxel.errors import MissingExtra
from univoxel.names import Animation
from univoxel.pictures.animation import require, write_animation
from univoxel.viewer.frames import Look, refined_pictures
from univoxel.viewer.subject import Subject

FRAMES = 50  # two seconds of a GIF or MP4 at its usual rate
WIDTH = 320  # most pixels: some seconds a frame on two cores
SAMPLES = 16  # of the light per pixel


def kind() -> Animation:
    """MP4 where its encoder is installed, or else GIF."""
    try:
        require("mp4")
    except MissingExtra:
        return "gif"
    return "mp4"


def turned_about(cameras: Cameras, middle: Tensor, angle: float) -> Cameras:
    """Cameras carried around a vertical axis, counter-clockwise seen from above.

    Args:
        middle: [3], a point of the axis.
        angle: radians.
    """
    c, s = math.cos(angle), math.sin(angle)
    turn = torch.tensor([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    pose = cameras.camera_to_world.clone()
    pose[..., 3] = (pose[..., 3] - middle) @ turn.T + middle
    pose[..., :3] = turn @ pose[..., :3]
    return replace(cameras, camera_to_world=pose)


def film(
    subject: Subject,
    cameras: Cameras,
    look: Look,
    done: Callable[[bytes], None],
    report: Callable[[float], None] = lambda share: None,
    frames: int = 0,
    samples: int = SAMPLES,
) -> Iterator[None]:
    """Make a moving picture in steps of about 0.1 s; done takes the file, report the share made.

    View 0 goes once around the middle of the mesh; where it is transparent, the film is white.

    Args:
        frames: of the turn; 0: FRAMES.
        samples: of the light per pixel.

    Raises:
        OSError: there is no room for the pictures.
    """
    frames = frames or FRAMES
    vertices = subject.traced.mesh.vertices
    middle = (vertices.amin(0) + vertices.amax(0)) / 2
    small = resize(cameras, min(cameras.width, WIDTH))
    with tempfile.TemporaryDirectory() as name:
        pictures = []
        for frame in range(frames):
            stand = turned_about(small, middle, 2 * math.pi * frame / frames)
            picture = None
            for better in refined_pictures(subject, stand, look, samples):
                picture = picture if better is None else better
                yield
            assert picture is not None
            pictures.append(Path(name) / f"{frame:04d}.png")
            write_png(pictures[-1], picture)
            report((frame + 1) / frames)
        path = Path(name) / f"film.{kind()}"
        write_animation(path, pictures)
        done(path.read_bytes())
