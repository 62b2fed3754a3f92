"""Draws docs/images/flame.png: the flame graph of `make profile`, as a browser shows it.

    make profile SCENE=sneaker PRESET=fast PROFILE=benchmarks/results
    python docs/figures/flame.py benchmarks/results/flame.svg docs/images

It needs a browser, which scripts/browser.sh brings in.
"""

from __future__ import annotations

import sys
from pathlib import Path

from PIL import Image

sys.path.append(str(Path(__file__).parents[2] / "tests"))
from browser import browser

SIZE = (1600, 1000)  # below lie rows of a few calls each
COLORS = 256


def main(graph: Path, out: Path) -> None:
    """Take the screenshot."""
    with browser() as tab:
        tab.open(graph.resolve().as_uri(), *SIZE)
        tab.run("new Promise((done) => setTimeout(done, 1000))")  # it fits names into its boxes
        shot = Image.fromarray(tab.screenshot())
    shot.convert("RGB").quantize(COLORS).save(out / "flame.png", optimize=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
