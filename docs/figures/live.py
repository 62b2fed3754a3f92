"""Draws docs/images/live.jpg: the live viewer in a browser, after a click on the object.

    python docs/figures/live.py RUN "A clay bird" docs/images

RUN is that of the tutorial "Your first object". It needs the extra `view` and a browser, which
scripts/browser.sh brings in.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

import numpy as np
from PIL import Image

sys.path.append(str(Path(__file__).parents[2] / "tests"))
from browser import browser

from univoxel.output.page import PageOptions
from univoxel.viewer.server import serving
from univoxel.viewer.viewer_scene import subject_of

WINDOW = (1160, 720)
PLACE = (400, 330)  # of the click: where the one hides the sky from the other
LEFT = (slice(0, 720), slice(0, 800))  # of the window, beside the controls
SECONDS = 30.0  # until there is little noise
# That WebGL is drawn in software says nothing of the viewer.
CLOSE = 'document.querySelectorAll(".mantine-Notification-closeButton").forEach((b) => b.click())'


def main(run: Path, title: str, out: Path) -> None:
    """Open the run, click, wait until there is little noise, and write the window."""
    with serving(subject_of(run), PageOptions(title=title), port=0) as address, browser() as tab:
        tab.open(address, *WINDOW)
        seen(tab, 5)
        tab.run(CLOSE)
        tab.mouse("mouseMoved", *PLACE)
        tab.mouse("mousePressed", *PLACE, button="left", clickCount=1)
        tab.mouse("mouseReleased", *PLACE, button="left", clickCount=1)
        picture = Image.fromarray(seen(tab, SECONDS))
    picture.save(out / "live.jpg", quality=88)


def seen(tab, seconds: float) -> np.ndarray:
    """The window, so long after the object has appeared in it."""
    while tab.screenshot()[LEFT].std() < 5:
        time.sleep(0.5)
    time.sleep(seconds)
    return tab.screenshot()


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2], Path(sys.argv[3]))
