"""Real photographs: how near a model comes to those that it has not seen.

    python benchmarks/captures.py REAL [--work build/captures] [--out FILE.json]

REAL holds ethiopian_head and statue_of_liberty, photographs and masks. The cameras of the head are
found anew: seven of the published ones are wrong. `fast`, all steps. Of every eight photographs one
is kept back. They are measured on black; and the first of every sixteen on white, as the field
does, where light varies also in the light that is fitted to each of them. What is done already in
--work is not done again.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from made import made

from lab.record import result_text
from univoxel.capture.poses import poses
from univoxel.cli.evaluate import evaluate
from univoxel.cli.trainer import train
from univoxel.presets import preset
from univoxel.scene import FILE

FIELD = {"test_every": 16, "background": "white"}  # its protocol
COLUMNS = [
    {"name": "capture"},
    {"name": "`--varying`"},
    {"name": "test views"},
    {"name": "in light"},
    {"name": "novel views", "unit": "dB", "digits": 1},
    {"name": "SSIM", "digits": 3},
]


@dataclass(frozen=True)
class Case:
    """A training, and the ways in which it is measured."""

    folder: str
    varying: str
    # Test views and the light that they are shown in, in words, and arguments of `evaluate`
    measured: tuple[tuple[str, str, dict[str, Any]], ...]
    own_poses: bool = False


ON_BLACK = ("every 8th, on black", "as trained", {})
ON_WHITE = ("every 16th, on white", "as trained", FIELD)
FITTED = ("every 16th, on white", "fitted to each", FIELD | {"fit_light": True})
CASES = [
    Case("ethiopian_head", "auto", (ON_BLACK, ON_WHITE), own_poses=True),
    Case("statue_of_liberty", "auto", (ON_BLACK, ON_WHITE, FITTED)),
    Case("statue_of_liberty", "light", (ON_BLACK, ON_WHITE, FITTED)),
]


def rows_of(case: Case, real: Path, work: Path) -> list[list[str | float]]:
    """Train a case, as far as that is not done, and measure it: a value for each of COLUMNS."""
    data = real / case.folder
    if case.own_poses:
        data = work / f"{case.folder}_data"
        poses(real / case.folder / "images", data, masks=real / case.folder / "masks")
    run = work / f"{case.folder}_{case.varying}"
    config = replace(preset("fast", data, run, varying=case.varying), minutes=60.0)
    train(config, resume=(run / FILE).is_file())
    rows = []
    for views, light, arguments in case.measured:
        found = evaluate(run, **arguments)
        measures = [found["nvs_psnr"], found["nvs_ssim"]]
        rows.append([case.folder, f"`{case.varying}`", views, light, *measures])
        print(rows[-1], flush=True)
    return rows


def main() -> None:
    """Measure all cases and write the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("real", type=Path)
    parser.add_argument("--work", type=Path, default=Path("build/captures"))
    default = Path(__file__).parent / "results" / "captures.json"
    parser.add_argument("--out", type=Path, default=default)
    options = parser.parse_args()
    rows = [row for case in CASES for row in rows_of(case, options.real, options.work)]
    about = {"title": "Photographs of real objects, `fast`, all steps", **made()}
    options.out.write_text(result_text(about | {"columns": COLUMNS, "rows": rows}))


if __name__ == "__main__":
    main()
