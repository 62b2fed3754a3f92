"""One step of structure from motion with pycolmap, in a process of its own.

    python -m univoxel.capture.sfm REQUEST.json

pycolmap brings symbols of zlib along: imported before zlib it ends Python, and beside torch it is
not tried. So nothing but this process imports it, it gives its memory back, and can be stopped. The
request is a record `Request`. Progress is in the database and in the log on stderr.
"""

from __future__ import annotations

import json
import sys
import zlib  # noqa: F401  before pycolmap
from pathlib import Path
from typing import Any


def main(path: str) -> None:
    """Do what the request says."""
    import pycolmap  # pyright: ignore[reportMissingImports]  the extra `capture`

    request = json.loads(Path(path).read_text(encoding="utf-8"))
    pycolmap.set_random_seed(request["seed"])
    {"extract": _extract, "match": _match, "map": _map}[request["step"]](pycolmap, request)


def _extract(pycolmap: Any, request: dict) -> None:
    options = pycolmap.FeatureExtractionOptions()
    options.num_threads, options.use_gpu = request["threads"], False
    options.sift.max_num_features = request["features"]
    options.sift.first_octave = request["first_octave"]
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = request["model"]
    reader.camera_params = request["parameters"]
    if request["existing_camera"] is not None:
        reader.existing_camera_id = request["existing_camera"]
    if request["masks"]:
        reader.mask_path = request["masks"]
    pycolmap.extract_features(
        request["database"],
        request["pictures"],
        image_names=request["names"],
        camera_mode=pycolmap.CameraMode.SINGLE,
        reader_options=reader,
        extraction_options=options,
        device=pycolmap.Device.cpu,
    )


def _match(pycolmap: Any, request: dict) -> None:
    matching = pycolmap.FeatureMatchingOptions()
    matching.num_threads, matching.use_gpu = request["threads"], False
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = request["pairs"]
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = request["seed"]
    pycolmap.match_image_pairs(
        request["database"],
        matching_options=matching,
        pairing_options=pairing,
        verification_options=verification,
        device=pycolmap.Device.cpu,
    )


def _map(pycolmap: Any, request: dict) -> None:
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads, options.random_seed = request["threads"], request["seed"]
    options.max_runtime_seconds = int(request["seconds"])
    options.mapper.random_seed = options.triangulation.random_seed = request["seed"]
    pycolmap.incremental_mapping(
        request["database"], request["pictures"], request["models"], options=options
    )


if __name__ == "__main__":
    main(sys.argv[1])
