"""Make the figures of the pages, all of one version: what lies directly in results/.

    python benchmarks/figures.py DATA [--only NAME ...] [--work build/figures] [--list]

DATA holds the scenes sneaker, tea_table and chrome_bottle, and real/ with captures. What is of this
version is not made again, and what was interrupted continues, so the same command may be given as
often as it takes. Times are measured: nothing else should run. Then `scripts/docs --write` puts the
figures into the pages. The folders in results/ are experiments, each of the version that it was
made with.
"""

from __future__ import annotations

import argparse
import json
import shlex
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

from made import made

from lab import plots
from lab.record import result_text

ROOT = Path(__file__).parent.parent
RESULTS = ROOT / "benchmarks" / "results"


@dataclass(frozen=True)
class Figure:
    """A result, and how it is made."""

    name: str  # NAME.json in results/, and NAME.png where there is a picture
    minutes: int  # on two cores, about
    # {work} is a folder to keep things in; {sneaker}, {tea_table}, {metals}, {tiny} are scenes
    commands: tuple[str, ...]
    written: str = ""  # what they write in {work}, without its suffix (default: NAME)


def script(name: str, minutes: int, arguments: str = "--out {work}/{name}.json") -> Figure:
    """A figure that the script of its own name makes."""
    command = f"python benchmarks/{name}.py {arguments.replace('{name}', name)}"
    return Figure(name, minutes, (command,))


STRESS = "univoxel lab stress --out {work}/stress --jobs 2"
ALL = "{sneaker} {tea_table} {metals}"
CAPACITY = "ball {tiny} {sneaker} {tea_table}"
KEPT = "--work {work}/{name} --out {work}/{name}.json"

FIGURES = [
    Figure(
        "stress_hybrid",
        50,
        # The trainings of both tables lie in one folder: seed 0 of hybrid is made once.
        (STRESS + " --light hybrid --seeds 3",),
        "stress/stress",
    ),
    Figure(
        "chart",
        45,
        (f"univoxel lab chart {ALL} --out {{work}}/chart --only draft fast full --seeds 3",),
        "chart/chart",
    ),
    script("threads", 8, "{sneaker} --preset fast --out {work}/threads.json"),
    Figure(
        "profile",
        4,
        ("python benchmarks/profile_run.py {sneaker} --cpu --out {work}/profile.json",),
    ),
    Figure(
        "lights",
        50,
        (f"univoxel lab compare {ALL} --preset fast --minutes 60 --out {{work}}/lights",),
        "lights/compare",
    ),
    Figure("stress", 45, (STRESS + " --light hybrid sg sh envmap --seeds 1",), "stress/stress"),
    Figure(
        "ops",
        10,
        (
            "python benchmarks/ops.py --out {work}/ops.json",
            "python benchmarks/charts.py {work}/ops.json",
        ),
    ),
    script("scaling", 4),
    script("train_step", 4),
    script("approximations", 1),
    script("field_scaling", 5, "--sizes 64 128 256 512 --steps 9 --out {work}/{name}.json"),
    script("capacity", 20, f"{CAPACITY} {KEPT}"),
    script("varying", 15, "{tiny} " + KEPT),
    script("priors", 5, "{tiny} --priors smooth " + KEPT),
    script("relight", 4, "{work}/relight.json --data {sneaker} --size 96"),
    script(
        "relight_runs",
        4,
        "{work}/{name}.json {work}/chart/sneaker/full/run {work}/chart/tea_table/full/run "
        "--every 5",
    ),
    Figure(
        "demo",
        3,
        (
            "univoxel demo --out {work}/demo",
            "univoxel eval {work}/demo/run --json {work}/demo.json",
        ),
    ),
    Figure(
        "viewer",
        2,
        (
            "python benchmarks/live_latency.py {work}/demo/run {work}/chart/sneaker/fast/run "
            "--out {work}/viewer.json",
        ),
    ),
    script("captures", 25, "{real} " + KEPT),
]


def make(figure: Figure, places: dict[str, Path]) -> None:
    """Run the commands of a figure and take over what they wrote.

    Raises:
        subprocess.CalledProcessError: a command failed.
        OSError: it did not write its result.
    """
    for command in figure.commands:
        program, *rest = shlex.split(command)
        start = ["-m", "univoxel.cli"] if program == "univoxel" else []
        arguments = [part.format(**places) for part in rest]
        subprocess.run([sys.executable, *start, *arguments], cwd=ROOT, check=True)
    written = places["work"] / f"{figure.written or figure.name}.json"
    about = made() | {"machine": plots.machine()}
    record = about | json.loads(written.read_text(encoding="utf-8"))
    (RESULTS / f"{figure.name}.json").write_text(result_text(record), encoding="utf-8")
    if (picture := written.with_suffix(".png")).is_file():
        shutil.copy(picture, RESULTS / f"{figure.name}.png")


def version_of(name: str) -> str | None:
    """The commit that a figure is of; None if there is none yet."""
    path = RESULTS / f"{name}.json"
    return json.loads(path.read_text(encoding="utf-8"))["commit"] if path.is_file() else None


def main() -> int:
    """Make what is not of this version; returns 1 if something failed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("--only", nargs="+", choices=[f.name for f in FIGURES], metavar="NAME")
    parser.add_argument("--work", type=Path, default=ROOT / "build/figures")
    parser.add_argument("--list", action="store_true", help="say what would be made, and end")
    options = parser.parse_args()
    version, data = made()["commit"], options.data.resolve()
    places = {name: data / name for name in ("sneaker", "tea_table", "real")}
    places |= {"metals": data / "chrome_bottle", "tiny": ROOT / "univoxel/example_data/tiny"}
    places["work"] = options.work.resolve() / version
    failed = []
    for figure in FIGURES:
        if options.only and figure.name not in options.only:
            continue
        if (old := version_of(figure.name)) == version:
            continue
        print(f"{figure.name}: of {old}, to be of {version}; {figure.minutes} min", flush=True)
        if options.list:
            continue
        places["work"].mkdir(parents=True, exist_ok=True)
        try:
            make(figure, places)
        except (subprocess.CalledProcessError, OSError) as error:
            print(f"{figure.name}: {error}", file=sys.stderr)
            failed.append(figure.name)
    return bool(failed)


if __name__ == "__main__":
    sys.exit(main())
