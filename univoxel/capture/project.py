"""The folder of a capture: its sources and its parts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from univoxel.capture import photographs
from univoxel.capture.photographs import find_photographs
from univoxel.core import files
from univoxel.core.files import read_json
from univoxel.data import has_cameras
from univoxel.errors import DataError, ExistingFile
from univoxel.scene import FILE

Kind = Literal["photographs", "scene", "run"]
# Steps of a capture, beside its files, that leave a word for later ones: the choice of masks, and
# that the object was turned before a still camera
FACTS = MASKS, TURNED = "masks", "turned"
SINGLE = "single masks"  # and which network made masks before there were cameras
RECORD_0_2 = "capture.json"  # what version 0.2 noted steps in


@dataclass(frozen=True)
class Given:
    """What a capture begins with."""

    path: Path
    kind: Kind  # a folder or a video; photographs with cameras; a trained run
    files: list[tuple[str, int]]  # names and bytes of photographs; else the folder only

    @property
    def words(self) -> str:
        return _words(self.files)


class Project:
    """Where the parts of a capture lie, all below one folder."""

    def __init__(self, out: Path) -> None:
        self.out: Path = out
        self.scene: Path = out / "scene"  # photographs and cameras, as `univoxel poses` writes them
        # Of single photographs, of a turntable, before there are cameras
        self.masks: Path = out / "masks"
        self.cut: Path = out / "cut"  # photographs with masks, as `univoxel cutout` writes them
        self.run: Path = out / "run"
        self.pictures: Path = out / "pictures"
        self.mesh: Path = out / f"{out.absolute().name}.glb"
        self.page: Path = out / "index.html"


def look_at(path: Path) -> Given:
    """What a capture can begin with there; a DataError where that is nothing."""
    if (path / FILE).is_file():
        return Given(path, "run", [(str(path.absolute()), 0)])
    if has_cameras(path):
        return Given(path, "scene", [(str(path.absolute()), 0)])
    if photographs.is_video(path):
        files = [path]
    elif path.is_dir():
        files, _, _ = find_photographs(path)
    else:
        came = "another kind of file" if path.exists() else "nothing there"
        raise DataError(f"{path}: expected a folder of photographs or a video, got {came}")
    return Given(path, "photographs", [(file.name, file.stat().st_size) for file in files])


def begin(project: Project, given: Given) -> None:
    """Make the folder of a capture, or continue with it; an ExistingFile where it holds the capture
    of something else, or other files."""
    out = project.out
    if out.exists() and not out.is_dir():
        raise ExistingFile(f"{out} is a file: choose another folder for out", "out")
    if (out / RECORD_0_2).exists():
        before = read_json(out / RECORD_0_2)
        files.adopt(out, {step: before[step] for step in ("files", *FACTS) if step in before})

    def other(files: list) -> ExistingFile:
        why = _difference(files, given.files)
        return ExistingFile(
            f"{out} contains a capture of {_words(files)}, but {why}: choose another folder as out",
            "out",
        )

    begun = files.done(out, "files", given.files, other)
    if out.exists() and not begun:
        foreign = sorted(p.name for p in out.iterdir() if p.suffix != ".tmp")
        if foreign:
            where = f"{out} contains other files ({foreign[0]})"
            raise ExistingFile(f"{where}: choose another folder for out", "out")
    out.mkdir(parents=True, exist_ok=True)
    for path in out.rglob(".*.tmp"):  # of `files.replacing`, whose process was killed
        path.unlink()
    if not begun:
        files.finish(out, "files", given.files)


def discard_older(folder: Path, than: Path) -> None:
    """Remove the files below a folder that are older than a file."""
    for path in folder.rglob("*"):
        if path.is_file() and path.stat().st_mtime_ns < than.stat().st_mtime_ns:
            path.unlink()


def _difference(before: Sequence[tuple[str, int]], now: Sequence[tuple[str, int]]) -> str:
    """The first file that tells them apart."""
    old, new = dict(before), dict(now)
    for name in sorted(old.keys() | new.keys()):
        if name not in old:
            return f"{name} is new"
        if name not in new:
            return f"{name} is missing"
        if old[name] != new[name]:
            return f"{name} has changed"
    return "their order has changed"


def _words(files: Sequence[tuple[str, int]]) -> str:
    if not files:
        return "none"
    more = f" and {len(files) - 1} others" if len(files) > 1 else ""
    return f"{files[0][0]}{more}"
