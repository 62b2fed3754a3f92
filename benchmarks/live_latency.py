"""How long a browser waits for a frame of the live viewer after a hand has moved something.

    python benchmarks/live_latency.py RUN [RUN ...] [--moves 20] [--out FILE.json]

A headless Chromium opens the viewer of each run. Time goes from an event of the mouse that drags
the camera to the moment at which the page has decoded the next quick picture. Pictures of a view
at rest are larger, and do not count. It needs the extra `view` and a browser, which
scripts/browser.sh brings in. The browser draws in software on the same cores: with a graphics card
it waits less.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from pathlib import Path
from typing import Any

sys.path.append(str(Path(__file__).parents[1] / "tests"))
from browser import browser
from made import made

from univoxel.experiments.record import result_text
from univoxel.viewer.server import serving
from univoxel.viewer.studio import QUICK_WIDTHS
from univoxel.viewer.subject import subject_of

WINDOW = (1160, 720)
PATIENCE = 60.0  # seconds
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


def measured(run: Path, moves: int) -> dict[str, Any]:
    """A row of a run: the frame after a move, in milliseconds."""
    subject = subject_of(run)
    with serving(subject, port=0) as address, browser() as tab:
        tab.open(address, *WINDOW)
        tab.run(HOOK.replace("QUICK", str(QUICK_WIDTHS[1])))
        time.sleep(5)
        waits(tab, 5)  # the width of quick pictures settles
        found = sorted(waits(tab, moves))
    return {
        "run": run.resolve().parent.name if run.name == "run" else run.resolve().name,
        "triangles": len(subject.traced.mesh.faces),
        "median ms": round(statistics.median(found), 1),
        "90 % ms": round(found[int(0.9 * (len(found) - 1))], 1),
        "longest ms": round(found[-1], 1),
    }


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
        title = "From a move of the mouse to the frame, in headless Chromium"
        written = made() | {"title": title, "columns": list(rows[0]), "rows": rows}
        options.out.write_text(result_text(written), encoding="utf-8")


if __name__ == "__main__":
    main()
