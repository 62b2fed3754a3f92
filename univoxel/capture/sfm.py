"""Steps of structure from motion with pycolmap, each in its own process.

    python -m univoxel.capture.sfm REQUEST.json

pycolmap brings symbols of zlib along: imported before zlib it ends Python, and beside torch it is
not tried. So nothing but this process imports it, it gives its memory back, and can be stopped. The
request is a record `Request`. Progress is in the database and in the log on stderr.
"""

from __future__ import annotations

import importlib.util
import json
import re
import sys
import time
import zlib  # noqa: F401  before pycolmap
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from univoxel.core import guard
from univoxel.errors import MissingExtra, ProcessFailed

MODEL = "SIMPLE_RADIAL"  # OPENCV begins with too much freedom: it placed 2 of 66 photographs
POLL = 0.5  # seconds between looks at a running step
GRACE = 60.0  # seconds beyond its limit that mapping has to write what it found
REGISTERING = re.compile(rb"Registering (?:frame|image)|Initializing with")


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
    existing_camera: int | None = None  # of the database, where extraction continues
    features: int = 4096
    first_octave: int = -1
    seed: int = 0
    threads: int = 2
    seconds: float = 600.0  # limit


def require_pycolmap() -> None:
    """Raise a MissingExtra, before anything is read, where cameras cannot be found."""
    if importlib.util.find_spec("pycolmap") is None:
        raise MissingExtra("finding cameras needs pycolmap: pip install 'univoxel[capture]'")


def run(request: Request, log: Path, done: Callable[[], int] | None = None) -> Iterator[int]:
    """Run one step and yield, while it runs, how much of it is done. It ends with this process; a
    ProcessFailed where it does not end well, or not in time.

    Args:
        log: file for what the process says; the request is written beside it.
        done: counts what is done; by default pictures that the log says were placed.
    """
    count = done or (lambda: len(REGISTERING.findall(log.read_bytes())))
    asked = log.with_suffix(".json")
    asked.write_text(json.dumps(asdict(request)), encoding="utf-8")
    limit = request.seconds + (GRACE if request.step == "map" else 0.0)
    begin = time.monotonic()
    arguments = "-m", "univoxel.capture.sfm", str(asked)
    with log.open("wb") as file, guard.guarded(arguments, file) as process:
        while process.poll() is None:
            time.sleep(POLL)
            yield count()
            if time.monotonic() - begin > limit:
                raise ProcessFailed(
                    f"{request.step}: pycolmap was stopped after {request.seconds:.0f} s"
                )
    if process.returncode:
        said = guard.last_words(log.read_bytes()) or "no message"
        raise ProcessFailed(
            f"{request.step}: pycolmap failed ({process.returncode}): {said} (see {log})"
        )
    yield count()


def main(path: str) -> None:
    """Do what the request says."""
    import pycolmap  # pyright: ignore[reportMissingImports]  the extra `capture`

    request = Request(**json.loads(Path(path).read_text(encoding="utf-8")))
    pycolmap.set_random_seed(request.seed)
    {"extract": _extract, "match": _match, "map": _map}[request.step](pycolmap, request)


def _extract(pycolmap: Any, request: Request) -> None:
    options = pycolmap.FeatureExtractionOptions()
    options.num_threads, options.use_gpu = request.threads, False
    options.sift.max_num_features = request.features
    options.sift.first_octave = request.first_octave
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = MODEL
    reader.camera_params = request.parameters
    if request.existing_camera is not None:
        reader.existing_camera_id = request.existing_camera
    if request.masks:
        reader.mask_path = request.masks
    pycolmap.extract_features(
        request.database,
        request.pictures,
        image_names=request.names,
        camera_mode=pycolmap.CameraMode.SINGLE,
        reader_options=reader,
        extraction_options=options,
        device=pycolmap.Device.cpu,
    )


def _match(pycolmap: Any, request: Request) -> None:
    matching = pycolmap.FeatureMatchingOptions()
    matching.num_threads, matching.use_gpu = request.threads, False
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = request.pairs
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = request.seed
    pycolmap.match_image_pairs(
        request.database,
        matching_options=matching,
        pairing_options=pairing,
        verification_options=verification,
        device=pycolmap.Device.cpu,
    )


def _map(pycolmap: Any, request: Request) -> None:
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads, options.random_seed = request.threads, request.seed
    options.max_runtime_seconds = int(request.seconds)
    options.mapper.random_seed = options.triangulation.random_seed = request.seed
    pycolmap.incremental_mapping(
        request.database, request.pictures, request.models, options=options
    )


if __name__ == "__main__":
    main(sys.argv[1])
