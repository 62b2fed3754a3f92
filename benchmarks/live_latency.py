"""How long the live viewer takes for a frame, and for a clean picture at rest.

    python benchmarks/live_latency.py RUN [RUN ...] [--moves 20] [--out FILE.json]

A headless Chromium opens the viewer of each run. Its mouse drags the camera, then the slider that
turns the light. Two times are taken of each move. *Frame* goes from the arrival of the page's
message to the moment at which the next picture is on its way back. *Decoded* goes from the event
of the mouse that drags the camera to the moment at which the page has decoded that picture. The
browser draws the page in software on the same cores: with a graphics card, or on another machine,
*decoded* takes less. Pictures of a view at rest are larger, and do not count as decoded.

*At rest* is the time from a move until the picture is within 38 dB of one of 1024 samples. It needs
the extra `view` and a browser, which scripts/browser.sh brings in.
"""

from __future__ import annotations

import argparse
import contextlib
import statistics
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

sys.path.append(str(Path(__file__).parents[1] / "tests"))
from browser import browser
from made import made

from lab.record import result_text
from univoxel import envmap
from univoxel.camera import Cameras, resize
from univoxel.output.page import PageOptions, lights_of
from univoxel.output.viewpoints import orbit
from univoxel.render.metrics import psnr
from univoxel.render.relight import Lighting
from univoxel.run import trained_on
from univoxel.viewer import frames
from univoxel.viewer.frames import Look, refined_pictures
from univoxel.viewer.render_queue import QUICK_WIDTHS, REST_SECONDS, REST_WIDTH, Studio
from univoxel.viewer.server import serving
from univoxel.viewer.viewer_scene import Subject, subject_of

WINDOW = (1160, 720)
PATIENCE = 60.0  # seconds
REST_DECIBELS = 38.0
COLUMNS = [
    {"name": "run"},
    {"name": "triangles"},
    {"name": "camera to frame", "unit": "ms", "digits": 0},
    {"name": "light to frame", "unit": "ms", "digits": 0},
    {"name": "camera to decoded", "unit": "ms", "digits": 0},
    {"name": "at rest to 38 dB", "unit": "s", "digits": 1},
]
# When the page decoded quick pictures, in milliseconds of its clock
HOOK = """
window.decoded = [];
const note = (width) => { if (width <= QUICK) window.decoded.push(performance.now()); };
const described = Object.getOwnPropertyDescriptor(HTMLImageElement.prototype, "src");
Object.defineProperty(HTMLImageElement.prototype, "src", {
    ...described,
    set(url) {
        this.addEventListener("load", () => note(this.naturalWidth));
        described.set.call(this, url);
    },
});
const bitmap = window.createImageBitmap;
window.createImageBitmap = (...given) => bitmap(...given).then((made) => {
    note(made.width);
    return made;
});
"""


class Answers:
    """Milliseconds from a message to the frame that answers it, while its block runs."""

    def __init__(self) -> None:
        self.found: list[float] = []
        self._asked: float | None = None

    @contextlib.contextmanager
    def taken(self) -> Iterator[None]:
        """Take the times of every panel."""
        ask, show = Studio.ask, Studio._show

        def asked(studio: Studio, *given: Any) -> None:
            self._asked = self._asked or time.monotonic()
            ask(studio, *given)

        def shown(studio: Studio, *given: Any) -> None:
            show(studio, *given)
            if self._asked:
                self.found.append(1000 * (time.monotonic() - self._asked))
            self._asked = None

        Studio.ask, Studio._show = asked, shown
        try:
            yield
        finally:
            Studio.ask, Studio._show = ask, show


def waits(tab: Any, moves: int) -> list[float]:
    """Milliseconds to the first frame after each of some moves of the camera."""
    found = []
    for move in range(moves):
        x = 300 + 15 * (move % 8)
        tab.mouse("mouseMoved", x, 360)
        tab.mouse("mousePressed", x, 360, button="left", clickCount=1)
        tab.run("window.decoded.length = 0")
        begin = tab.run("performance.now()")
        tab.mouse("mouseMoved", x + 12, 362, button="left", buttons=1)
        end = time.monotonic() + PATIENCE
        while not (at := tab.run("window.decoded[0] || 0")):
            if time.monotonic() > end:
                raise TimeoutError("no frame came")
            time.sleep(0.002)
        found.append(at - begin)
        tab.mouse("mouseReleased", x + 12, 362, button="left", clickCount=1)
        time.sleep(0.3)
    return found


def turn_light(tab: Any, moves: int) -> None:
    """Click along the slider that turns the light."""
    slider = """(() => {
        const label = [...document.querySelectorAll("label")].find((l) => l.textContent == "turn");
        let around = label;
        while (!around.querySelector("[class*=Slider-track]")) around = around.parentElement;
        const track = around.querySelector("[class*=Slider-track]");
        const box = track.getBoundingClientRect();
        return [box.left, box.top + box.height / 2, box.width];
    })()"""
    left, top, width = tab.run(slider)
    for move in range(moves):
        x = left + width * (0.2 + 0.6 * (move % 7) / 6)
        tab.mouse("mouseMoved", x, top)
        tab.mouse("mousePressed", x, top, button="left", clickCount=1)
        tab.mouse("mouseReleased", x, top, button="left", clickCount=1)
        time.sleep(0.6)


def rest_seconds(subject: Subject) -> float | None:
    """From a move to a picture at rest within REST_DECIBELS of one of MOST_SAMPLES."""
    light = lights_of(subject.scene, PageOptions())[0]
    lighting = Lighting(envmap.tables(envmap.EnvMap(light.radiance)))
    view = orbit(subject.traced.mesh, 8, REST_WIDTH)
    cameras = resize(
        Cameras(
            view.camera_to_world[1:2], view.focal[1:2], view.centre[1:2], view.width, view.height
        ),
        REST_WIDTH,
    )
    plain = Look(lighting)
    *_, best = (x for x in refined_pictures(subject, cameras, plain) if x is not None)
    begin = time.monotonic()
    for picture in refined_pictures(subject, cameras, Look(lighting, denoise=frames.available())):
        if picture is None:
            continue
        quality = float(psnr(picture[..., :3] * picture[..., 3:], best[..., :3] * best[..., 3:]))
        if quality >= REST_DECIBELS:
            return REST_SECONDS + time.monotonic() - begin
    return None


def measured(run: Path, moves: int) -> list[str | float | None]:
    """A row of a run, with a value for each of COLUMNS."""
    subject = subject_of(run)
    camera, light = Answers(), Answers()
    with serving(subject, port=0) as address, browser() as tab:
        tab.open(address, *WINDOW)
        tab.run(HOOK.replace("QUICK", str(QUICK_WIDTHS[1])))
        time.sleep(5)
        waits(tab, 5)  # the width of quick pictures settles
        with camera.taken():
            decoded = waits(tab, moves)
        time.sleep(1)
        with light.taken():
            turn_light(tab, moves)
    assert min(len(camera.found), len(light.found)) > moves / 2, "moves were not answered"
    medians = [statistics.median(found) for found in (camera.found, light.found, decoded)]
    return [trained_on(run).name, len(subject.traced.mesh.faces), *medians, rest_seconds(subject)]


def main() -> None:
    """Measure each run, print the rows, and write them if asked."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run", type=Path, nargs="+")
    parser.add_argument("--moves", type=int, default=20)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    rows = []
    for run in options.run:
        rows.append(measured(run, options.moves))
        print(rows[-1])
    if options.out:
        title = "The live viewer in headless Chromium on the same cores"
        written = made() | {"title": title, "columns": COLUMNS, "rows": rows}
        options.out.write_text(result_text(written), encoding="utf-8")


if __name__ == "__main__":
    main()
