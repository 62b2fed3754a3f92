"""Steps of structure from motion in processes of their own: pycolmap's, or those of COLMAP."""

from __future__ import annotations

import importlib.util
import json
import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from typing import Literal

from univoxel.errors import MissingExtra, ProcessFailed

Engine = Literal["pycolmap", "colmap"]
MODEL = "SIMPLE_RADIAL"  # OPENCV begins with too much freedom: it placed 2 of 66 photographs
POLL = 0.5  # seconds between looks at a running step
GRACE = 60.0  # seconds beyond its limit that mapping has to write what it found
REGISTERING = re.compile(rb"Registering (?:frame|image)|Initializing with")
STEPS = {"extract": "feature_extractor", "match": "matches_importer", "map": "mapper"}


@dataclass(frozen=True)
class Request:
    """What one step is told. Paths are absolute."""

    step: Literal["extract", "match", "map"]
    database: str
    pictures: str  # folder of the pictures of all groups
    models: str  # folder that the models are written to, numbered
    pairs: str = ""  # file of two names a line
    masks: str = ""  # folder of NAME.png, or empty
    names: tuple[str, ...] = ()  # pictures of one camera, for extraction
    parameters: str = ""  # camera parameters to begin with, or empty
    existing_camera: int | None = None  # of the database, where extraction goes on
    model: str = MODEL
    features: int = 4096
    first_octave: int = -1
    seed: int = 0
    threads: int = 2
    seconds: float = 600.0  # limit


def find_engine() -> Engine:
    """pycolmap if it is installed, or else a `colmap` on the path.

    Raises:
        MissingExtra: neither.
    """
    if importlib.util.find_spec("pycolmap") is not None:
        return "pycolmap"
    if shutil.which("colmap"):
        return "colmap"
    raise MissingExtra(
        "finding cameras needs pycolmap: pip install 'univoxel[capture]', or put a `colmap` on the "
        "PATH"
    )


def run(
    engine: Engine, request: Request, log: Path, done: Callable[[], int] | None = None
) -> Iterator[int]:
    """Run one step and yield, while it runs, how much of it is done. It ends with this process.

    Args:
        log: file for what the process says.
        done: counts what is done; by default pictures that the log says were placed.

    Raises:
        ProcessFailed: it did not end well, or not in time.
    """
    count = done or (lambda: len(REGISTERING.findall(log.read_bytes())))
    begin = time.monotonic()
    grace = GRACE if request.step == "map" else 0.0
    with log.open("wb") as file:
        guard = [sys.executable, "-m", "univoxel.guard", str(os.getpid())]
        process = subprocess.Popen(
            [*guard, *command_of(engine, request, log)],
            **{"stdin": subprocess.DEVNULL, "stdout": file, "stderr": file},
        )
        try:
            while process.poll() is None:
                time.sleep(POLL)
                yield count()
                if time.monotonic() - begin > request.seconds + grace:
                    raise ProcessFailed(
                        f"{request.step}: {engine} was stopped after {request.seconds:.0f} seconds"
                    )
        finally:
            if process.poll() is None:
                process.kill()
                process.wait()
    if process.returncode:
        said = log.read_text("utf-8", "replace").strip().splitlines() or ["it said nothing"]
        raise ProcessFailed(
            f"{request.step}: {engine} ended with {process.returncode}: {said[-1]} (see {log})"
        )
    yield count()


def command_of(engine: Engine, request: Request, log: Path) -> list[str]:
    """The command line of one step; what does not fit there stands in files beside the log."""
    if engine == "pycolmap":
        asked = log.with_suffix(".json")
        asked.write_text(json.dumps(asdict(request)), encoding="utf-8")
        return [sys.executable, "-m", "univoxel.capture.sfm", str(asked)]
    Path(request.models).mkdir(parents=True, exist_ok=True)
    command = STEPS[request.step]
    known = _options(command)
    line = ["colmap", command, "--database_path", request.database]
    match request.step:
        case "extract":
            names = log.with_suffix(".txt")
            names.write_text("".join(f"{n}\n" for n in request.names), encoding="utf-8")
            line += ["--image_path", request.pictures, "--image_list_path", str(names)]
        case "match":
            line += ["--match_list_path", request.pairs, "--match_type", "pairs"]
        case "map":
            line += ["--image_path", request.pictures, "--output_path", request.models]
    for names, value in _wanted(request):
        # Versions name an option differently, or lack it
        option = next((name for name in names if f"--{name}" in known), None)
        if option and value not in (None, ""):
            line += [f"--{option}", str(value)]
    return line


def _wanted(request: Request) -> list[tuple[tuple[str, ...], object]]:
    """Options of COLMAP, each under all of its names."""
    seed = (("random_seed", "Mapper.random_seed"), request.seed)
    match request.step:
        case "extract":
            return [
                seed,
                (("FeatureExtraction.use_gpu", "SiftExtraction.use_gpu"), 0),
                (("FeatureExtraction.num_threads", "SiftExtraction.num_threads"), request.threads),
                (("SiftExtraction.max_num_features",), request.features),
                (("SiftExtraction.first_octave",), request.first_octave),
                (("ImageReader.single_camera",), 1 if request.existing_camera is None else None),
                (("ImageReader.camera_model",), request.model),
                (("ImageReader.camera_params",), request.parameters),
                (("ImageReader.existing_camera_id",), request.existing_camera),
                (("ImageReader.mask_path",), request.masks),
            ]
        case "match":
            return [
                seed,
                (("FeatureMatching.use_gpu", "SiftMatching.use_gpu"), 0),
                (("FeatureMatching.num_threads", "SiftMatching.num_threads"), request.threads),
            ]
        case _:
            return [
                seed,
                (("Mapper.num_threads",), request.threads),
                (("Mapper.max_runtime_seconds",), int(request.seconds)),
            ]


@lru_cache
def _options(command: str) -> str:
    """The help of a command of COLMAP, which lists its options."""
    # Its programs look for a display even where they need none
    surroundings = {**os.environ, "QT_QPA_PLATFORM": "offscreen"}
    told = subprocess.run(
        ["colmap", command, "--help"],
        **{"capture_output": True, "text": True, "check": False, "env": surroundings},
    )
    return told.stdout + told.stderr
