"""Draws docs/images/page.jpg: the page of a run in a browser, on a desk and on a phone.

    univoxel view RUN --html RUN/page.html --title "A clay bird"
    python docs/figures/page.py RUN/page.html docs/images

RUN is that of the tutorial "Your first object". It needs a browser, which scripts/browser.sh brings
in.
"""

from __future__ import annotations

import sys
from pathlib import Path

from PIL import Image

sys.path.append(str(Path(__file__).parents[2] / "tests"))
from browser import browser

DESK, PHONE = (1160, 720), (360, 720)
GAP = 12  # pixels between them


def main(page: Path, out: Path) -> None:
    """Take both screenshots and put them side by side."""
    shots = []
    with browser() as tab:
        for size, change in ((DESK, "{light: 1}"), (PHONE, '{layer: "normal"}')):
            tab.open(page.resolve().as_uri(), *size, phone=size is PHONE)
            tab.run(f"univoxel.ready.then(() => univoxel.set({change}))")
            tab.run("new Promise((done) => setTimeout(done, 1000))")
            shots.append(Image.fromarray(tab.screenshot()))
    picture = Image.new("RGB", (DESK[0] + GAP + PHONE[0], DESK[1]), "white")
    picture.paste(shots[0], (0, 0))
    picture.paste(shots[1], (DESK[0] + GAP, 0))
    picture.save(out / "page.jpg", quality=88)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
