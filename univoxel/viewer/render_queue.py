"""The render thread, which serves moving clients first; and orbits around the object."""

from __future__ import annotations

import math
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import torch
from torch import Tensor

from univoxel.camera import Cameras, resize
from univoxel.core import log
from univoxel.core.choices import Animation
from univoxel.data.images import write_png
from univoxel.errors import MissingExtra, UserError
from univoxel.output.timelapse import require, write_animation
from univoxel.viewer.frames import Look, quick_picture, refined_pictures
from univoxel.viewer.viewer_scene import Subject

QUICK_SECONDS = 0.07  # that a picture may take while something moves: 10 a second, sent and all
QUICK_WIDTHS = (64, 384)  # pixels, between which its width is chosen
FIRST_WIDTH = 160  # pixels, before any was timed
REST_WIDTH = 640  # most pixels along the width at rest
REST_SECONDS = 0.25  # without a change, after which a view rests
VIEW = "view"  # the chore that shows pictures
DONE = object()  # what a chore yields no more


@dataclass
class Viewer:
    """One client's view; changed by `Studio` alone."""

    show: Callable[[Tensor], None]  # takes a picture [H, W, 4], sRGB with straight alpha
    complain: Callable[[str], None]  # takes one line for people
    width: int = FIRST_WIDTH  # of quick pictures
    changed: float = 0.0  # when it was last asked for something
    stale: bool = False  # whether a quick picture is due
    chores: dict[str, Iterator[None]] = field(default_factory=dict)  # by what they make
    gone: bool = False


class Studio:
    """Renders for any number of viewers in a thread of its own, until `stop`."""

    def __init__(self, subject: Subject) -> None:
        self._subject = subject
        self._viewers: list[Viewer] = []
        self._news = threading.Condition()
        self._ended = False
        self._thread = threading.Thread(target=self._run, name="univoxel studio", daemon=True)
        self._thread.start()

    def join(self, viewer: Viewer) -> None:
        """Take a viewer in."""
        with self._news:
            self._viewers.append(viewer)

    def leave(self, viewer: Viewer) -> None:
        """Let a viewer go; a picture that is being made for it is dropped."""
        with self._news:
            viewer.gone = True
            viewer.chores.clear()
            self._viewers = [other for other in self._viewers if other is not viewer]

    def ask(self, viewer: Viewer, cameras: Cameras, look: Look) -> None:
        """Show a viewer view 0 of cameras as large as its window, from now on."""
        with self._news:
            viewer.stale, viewer.changed = True, time.monotonic()
            self.do(viewer, VIEW, self._pictures(viewer, cameras, look))

    def do(self, viewer: Viewer, name: str, steps: Iterator[None]) -> None:
        """Run something for a viewer, step by step, where nobody's view moves.

        Args:
            name: another chore of this name is dropped for it.
            steps: each of about 0.1 s. A UserError or OSError becomes one line for the viewer.
        """
        with self._news:
            if not viewer.gone:
                viewer.chores[name] = steps
                self._news.notify()

    def stop(self) -> None:
        """End the thread after the step that it is in."""
        with self._news:
            self._ended = True
            self._news.notify()
        self._thread.join(10)

    def _run(self) -> None:
        turn = 0
        while True:
            with self._news:
                work = None
                while not self._ended and (work := self._next(turn)) is None:
                    resting = any(VIEW in viewer.chores for viewer in self._viewers)
                    self._news.wait(REST_SECONDS / 4 if resting else None)
                if self._ended or work is None:
                    return
            turn += 1
            self._work(*work)

    def _next(self, turn: int) -> tuple[Viewer, str] | None:
        """The viewer whose turn it is, and its chore; None: all are served."""
        for viewer in self._viewers:
            if viewer.stale:
                return viewer, VIEW
        rested = time.monotonic() - REST_SECONDS
        able = [
            (viewer, name)
            for viewer in self._viewers
            for name in viewer.chores
            if name != VIEW or viewer.changed <= rested
        ]
        return able[turn % len(able)] if able else None

    def _work(self, viewer: Viewer, name: str) -> None:
        """One step of a chore."""
        with self._news:
            steps = viewer.chores.get(name, iter(()))  # the viewer may have left
            if name == VIEW:
                viewer.stale = False
        line = None
        try:
            if next(steps, DONE) is not DONE:
                return
        except (UserError, OSError) as error:
            line = str(error)
        except Exception:
            log.exception("rendering failed")  # a fault of the program: its traceback
            line = "rendering failed: see the terminal of univoxel"
        with self._news:
            if viewer.chores.get(name) is steps:  # and not another that took its place
                del viewer.chores[name]
        if line is not None and not viewer.gone:
            viewer.complain(line)

    def _pictures(self, viewer: Viewer, cameras: Cameras, look: Look) -> Iterator[None]:
        """The chore VIEW: a quick picture, and where the view rests better and better ones."""
        begin = time.monotonic()
        picture = quick_picture(self._subject, resize(cameras, viewer.width), look)
        if not viewer.gone:
            viewer.show(picture)
        share = QUICK_SECONDS / max(time.monotonic() - begin, 1e-3)
        low, high = QUICK_WIDTHS
        viewer.width = round(min(max(viewer.width * min(max(share, 0.5), 1.2) ** 0.5, low), high))
        yield
        at_rest = resize(cameras, min(cameras.width, REST_WIDTH))
        for picture in refined_pictures(self._subject, at_rest, look):
            if picture is not None and not (viewer.gone or viewer.stale):  # of an older view
                viewer.show(picture)
            yield


# A turn around the object as a moving picture, from where a camera stands.


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
    """Cameras carried around a vertical axis through a point [3], by radians counter-clockwise seen
    from above."""
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
    """
    frames = frames or FRAMES
    low, high = subject.bounds
    small = resize(cameras, min(cameras.width, WIDTH))
    with tempfile.TemporaryDirectory() as name:
        pictures = []
        for frame in range(frames):
            stand = turned_about(small, (low + high) / 2, 2 * math.pi * frame / frames)
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
