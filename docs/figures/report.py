"""Draws docs/images/report.jpg: the first section of a report, what to photograph next.

    python benchmarks/advice.py univoxel/example_data/tiny WORK
    univoxel report WORK/before
    python docs/figures/report.py WORK/before/report.html docs/images

It needs a browser, which scripts/browser.sh brings in.
"""

from __future__ import annotations

import sys
from pathlib import Path

from PIL import Image

sys.path.append(str(Path(__file__).parents[2] / "tests"))
from browser import browser

DESK = (1180, 1200)
MARGIN = 8  # pixels around the section


def main(page: Path, out: Path) -> None:
    """Take a screenshot, and cut the section out."""
    with browser() as tab:
        tab.open(page.resolve().as_uri(), *DESK)
        box = "document.querySelector('section').getBoundingClientRect()"
        x, y, width, height = tab.run(f"(r => [r.x, r.y, r.width, r.height])({box})")
        shot = Image.fromarray(tab.screenshot())
    edges = (x - MARGIN, y - MARGIN, x + width + MARGIN, y + height + MARGIN)
    picture = shot.crop(tuple(round(edge) for edge in edges))
    picture.save(out / "report.jpg", quality=88)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
