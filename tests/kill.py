"""Commands that are ended at any moment: what is there afterwards is whole, and the rest is made.

    python tests/kill.py [--kills N] [--only COMMAND ..] [--seed FIRST]

A command runs in a process of its own and gets SIGKILL, SIGTERM or SIGINT at a random moment. Then
all files that it left are read, and the same command, with --resume where it has that, has to end
well, with the result of an undisturbed one. The table at the end counts kills and what they cost;
the exit code is 1 where a file was broken, a command was refused, or more was lost than allowed.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import OpenEXR
from PIL import Image
from safetensors import safe_open

from univoxel.data.images import read_image

SCENE = Path(__file__).resolve().parents[1] / "univoxel/example_data/tiny"
SIGNALS = signal.SIGKILL, signal.SIGTERM, signal.SIGINT
LOST_SECONDS = 30.0  # of training, at most
# How far measures of a run may be from those of an undisturbed one: Adam begins anew at a kill
SCATTER_DB = 1.5
# Enough for a training with all of its stages
WORK = (
    *("stages.0.voxels=0.1", "stages.0.iterations=120", "stages.0.rays=512"),
    *("stages.1.voxels=0.2", "stages.1.iterations=160", "stages.1.rays=512"),
    *("stages.2.iterations=120", "stages.2.rays=1024", "stages.2.points=3000"),
    *("stages.3.voxels=0.2", "stages.3.iterations=60", "stages.3.rays=512"),
)


@dataclass(frozen=True)
class Command:
    """What is ended: its arguments, those that go on with it, and what it leaves."""

    arguments: tuple[str, ...]
    again: tuple[str, ...]
    makes: Path  # a file that is there when it has ended well


@dataclass
class Toll:
    """What kills of a command cost."""

    kills: int = 0
    broken: list[str] = field(default_factory=list)  # files that cannot be read, or were left over
    refused: list[str] = field(default_factory=list)  # commands that did not go on
    differing: list[str] = field(default_factory=list)  # results that are not the undisturbed ones
    lost: float = 0.0  # seconds of training, at most

    @property
    def bad(self) -> bool:
        return bool(self.broken or self.refused or self.differing) or self.lost > LOST_SECONDS


def commands(place: Path, run: Path) -> dict[str, Command]:
    """All that are ended, in a folder of theirs.

    Args:
        run: of an undisturbed training.
    """
    trained, masked = place / "run", place / "masked"
    train = ("train", str(masked), "--out", str(trained), "--minutes", "3")
    train += tuple(f"--set={change}" for change in WORK)
    relight = ("relight", str(run), "--envmap", str(SCENE / "envmaps/city.hdr"))
    relight += ("--out", str(place / "relit"), "--cameras", "orbit 12", "--samples", "16")
    evaluate = ("eval", str(run), "--save", str(place / "views"), "--samples", "4")
    evaluate += ("--json", str(place / "measures.json"))
    export = ("export", str(run), "--mesh", str(place / "mesh.glb"))
    view = ("view", str(run), "--html", str(place / "page.html"))
    cutout = ("cutout", str(masked), "--out", str(place / "cut"), "--from", str(masked / "masks"))
    return {
        "train": Command(train, (*train, "--resume"), trained / "trust.txt"),
        "cutout": Command(cutout, cutout, place / "cut/masks.html"),
        "eval": Command(evaluate, evaluate, place / "measures.json"),
        "relight": Command(relight, (*relight, "--resume"), place / "relit/orbit_0011.png"),
        "export": Command(export, export, place / "mesh.glb"),
        "view": Command(view, view, place / "page.html"),
    }


def write_photographs(folder: Path) -> None:
    """The bundled photographs as opaque ones in front of grey, and their masks beside them."""
    shutil.copytree(SCENE, folder, ignore=shutil.ignore_patterns("relight", "envmaps"))
    (folder / "masks").mkdir()
    for path in sorted((folder / "train").glob("*.png")):
        with Image.open(path) as picture:
            alpha = picture.convert("RGBA").getchannel("A")
        alpha.save(folder / "masks" / path.name)


def start(arguments: Sequence[str]) -> subprocess.Popen[str]:
    """The command line, in a process of its own."""
    line = [sys.executable, "-m", "univoxel.cli", *arguments]
    pipe = subprocess.PIPE
    return subprocess.Popen(line, stdout=pipe, stderr=pipe, text=True)


def ended(arguments: Sequence[str], after: float, what: signal.Signals) -> bool:
    """Start a command and end it after so many seconds; whether it was still running."""
    with start(arguments) as process:
        try:
            process.communicate(timeout=after)
        except subprocess.TimeoutExpired:
            process.send_signal(what)
            process.communicate(timeout=60)
            return True
    return False


def broken_files(folder: Path) -> list[str]:
    """Files that cannot be read, or that nobody will: temporary ones that lie about."""
    found = []
    for path in sorted(p for p in folder.rglob("*") if p.is_file()):
        try:
            _read(path)
        except Exception as error:  # of any library
            found.append(f"{path.relative_to(folder)}: {error}")
    return found


def _read(path: Path) -> None:
    match path.suffix:
        case ".safetensors":
            with safe_open(path, "np") as file:
                for name in file.keys():
                    file.get_tensor(name)
        case ".json":
            json.loads(path.read_text(encoding="utf-8"))
        case ".jsonl":
            lines = path.read_text(encoding="utf-8").splitlines()
            for line in lines:
                json.loads(line)
        case ".png":
            read_image(path)
        case ".exr":
            with OpenEXR.File(str(path)) as file:
                file.channels()
        case ".glb":
            data = path.read_bytes()
            assert data[:4] == b"glTF", "no GLB"
            assert int.from_bytes(data[8:12], "little") == len(data), "of another length"
        case ".html":
            assert path.read_text(encoding="utf-8").rstrip().endswith("</html>"), "truncated"


def left_over(folder: Path) -> list[str]:
    """Temporary files that a command which went on has left."""
    names = (str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file())
    return [name for name in names if ".tmp" in name or name.endswith("~")]


def lost_seconds(run: Path, killed: float) -> float:
    """Seconds of training between what a run has saved and when it was killed (time.time)."""
    log = run / "log.jsonl"
    if not log.is_file():
        return 0.0
    told = json.loads(log.read_text(encoding="utf-8").splitlines()[-1])["seconds"]
    now = told + killed - log.stat().st_mtime
    saved = 0.0
    with contextlib.suppress(FileNotFoundError), safe_open(run / "scene.safetensors", "np") as file:
        saved = json.loads(file.metadata()["univoxel"])["state"]["seconds"]
    return max(now - saved, 0.0)


def measure(run: Path) -> float:
    """Novel views of a run, dB."""
    place = run.parent / "measured.json"
    done = start(("eval", str(run), "--samples", "1", "--json", str(place)))
    said = done.communicate()[1]
    assert done.returncode == 0, said
    return json.loads(place.read_text())["nvs_psnr"]


def pictures_differ(one: Path, other: Path) -> list[str]:
    """Pictures of a folder that another does not have alike."""
    found = []
    for path in sorted(one.rglob("*.png")):
        beside = other / path.relative_to(one)
        if not beside.exists() or not np.array_equal(read_image(path), read_image(beside)):
            found.append(str(path.relative_to(one)))
    return found


def kill(name: str, kills: int, first: int, run: Path, place: Path, quality: float) -> Toll:
    """End a command so many times; each run of it at most three times, then it may end well."""
    toll, draw = Toll(), random.Random(first)
    whole = place / "whole"
    whole.mkdir(parents=True)
    write_photographs(whole / "masked")
    undisturbed = commands(whole, run)[name]
    begin = time.monotonic()
    done = start(undisturbed.arguments)
    said = done.communicate()[1]
    length = time.monotonic() - begin
    assert done.returncode == 0, f"{name} does not work at all: {said[-2000:]}"
    while toll.kills < kills:
        folder = place / f"{name}-{toll.kills}"
        folder.mkdir()
        write_photographs(folder / "masked")
        command = commands(folder, run)[name]
        arguments = command.arguments
        for _ in range(min(3, kills - toll.kills)):
            what = draw.choice(SIGNALS)
            if not ended(arguments, draw.uniform(0.0, length), what):
                break
            toll.kills += 1
            if name == "train":  # the moment of the kill, from here on by less than a second
                toll.lost = max(toll.lost, lost_seconds(folder / "run", time.time()))
            toll.broken += [f"{what.name}: {line}" for line in broken_files(folder)]
            arguments = command.again
        # What cutout has made whole it never writes over
        if name != "cutout" or not command.makes.exists():
            done = start(command.again)  # also where it ended before the kill
            said = done.communicate()[1]
            if done.returncode or not command.makes.exists():
                toll.refused.append(said.strip()[-500:])
        toll.broken += [f"left over: {line}" for line in left_over(folder)]
        if name == "train" and not done.returncode:
            now = measure(folder / "run")
            if abs(now - quality) > SCATTER_DB:
                toll.differing.append(f"{now:.2f} dB, undisturbed {quality:.2f}")
        if name in ("relight", "cutout"):
            made = {"relight": "relit", "cutout": "cut"}[name]
            toll.differing += pictures_differ(whole / made, folder / made)
        shutil.rmtree(folder)
        print(f"{name}: {toll.kills} of {kills} kills", file=sys.stderr, flush=True)
    return toll


def main() -> int:
    """Parse, kill, print a table; 1 where something is bad."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    names = list(commands(Path(), Path()))
    parser.add_argument("--kills", type=int, default=10, help="of each command")
    parser.add_argument("--only", nargs="*", default=names, choices=names)
    parser.add_argument("--seed", type=int, default=1, help="of moments and signals")
    chosen = parser.parse_args()
    os.environ.setdefault("OMP_NUM_THREADS", "2")
    with tempfile.TemporaryDirectory() as temporary:
        place = Path(temporary)
        write_photographs(place / "masked")
        training = commands(place, place)["train"]
        done = start(training.arguments)
        said = done.communicate()[1]
        assert done.returncode == 0, said
        quality = measure(place / "run")
        tolls = {
            name: kill(name, chosen.kills, chosen.seed, place / "run", place / name, quality)
            for name in chosen.only
        }
    return report(tolls)


def report(tolls: dict[str, Toll]) -> int:
    """Print what kills cost; 1 where something is bad."""
    heads = "kills", "broken", "refused", "differing", "lost, s"
    print(" " * 10 + "".join(f"{head:>11}" for head in heads))
    for name, toll in tolls.items():
        bad = [len(x) for x in (toll.broken, toll.refused, toll.differing)]
        print(
            f"{name:>10}" + "".join(f"{n:>11}" for n in (toll.kills, *bad)) + f"{toll.lost:>11.1f}"
        )
        for line in (*toll.broken, *toll.refused, *toll.differing):
            print(f"    {line}")
    return int(any(toll.bad for toll in tolls.values()))


if __name__ == "__main__":
    sys.exit(main())
