"""Features, pairs, matches and models of a capture. Features go on where they stopped."""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import torch

from univoxel.capture import database
from univoxel.capture.config import CaptureConfig
from univoxel.capture.model import Model, read_models
from univoxel.capture.pairs import all_pairs, choose, features_each, similarities
from univoxel.capture.photographs import fitted
from univoxel.capture.prepare import Capture, Folders
from univoxel.capture.sfm import Request, run
from univoxel.files import replacing


def extract(capture: Capture, folders: Folders, config: CaptureConfig) -> Iterator[int]:
    """Find features, camera by camera; yields how many photographs have theirs."""
    pictures = capture.pictures
    for g, members in enumerate(capture.groups):
        names = [pictures[i] for i in members if (folders.pictures / pictures[i]).exists()]
        known = database.images(folders.database)
        done = database.feature_counts(folders.database) if known else {}
        left = [n for n in names if n not in known or known[n][0] not in done]
        if not left:
            continue
        first = next((known[n][1] for n in names if n in known), None)
        request = _request(
            "extract",
            capture,
            folders,
            config,
            names=tuple(left),
            parameters="" if first is not None else _parameters(capture, members, config),
            existing_camera=first,
        )
        yield from run(
            request,
            folders.work / f"extract{g}.log",
            lambda: database.count(folders.database, "descriptors"),
        )


def select(capture: Capture, folders: Folders, config: CaptureConfig) -> Iterator[int]:
    """Write which pairs to match; yields how many photographs were compared with all others."""
    pictures = capture.pictures
    numbers = database.images(folders.database)
    there = [i for i, name in enumerate(pictures) if name in numbers]
    if len(there) <= config.exhaustive:
        chosen = all_pairs(len(there))
    else:
        most = features_each(len(there), config)
        features = [
            database.largest_features(folders.database, numbers[pictures[i]][0], most)
            for i in there
        ]
        rows = []
        for row in similarities(features, config.ratio):
            rows.append(row)
            yield len(rows)
        chosen = choose(np.stack(rows), config)
    lines = [f"{pictures[there[i]]} {pictures[there[j]]}\n" for i, j in chosen]
    with replacing(folders.pairs) as temporary:
        temporary.write_text("".join(lines), encoding="utf-8")


def match(capture: Capture, folders: Folders, config: CaptureConfig) -> Iterator[int]:
    """Match the chosen pairs and verify them; yields how many are done."""
    yield from run(
        _request("match", capture, folders, config),
        folders.work / "match.log",
        lambda: database.count(folders.database, "two_view_geometries"),
    )


def pair_count(folders: Folders) -> int:
    """Pairs to match."""
    return len(folders.pairs.read_text(encoding="utf-8").splitlines())


def place(capture: Capture, folders: Folders, config: CaptureConfig) -> Iterator[int]:
    """Find the cameras; yields how many photographs were placed, in all tries together."""
    shutil.rmtree(folders.models, ignore_errors=True)
    folders.models.mkdir(parents=True)
    yield from run(_request("map", capture, folders, config), folders.work / "map.log")


def models(folders: Folders) -> list[Model]:
    """What `place` found, the largest first."""
    return read_models(folders.models)


def _request(step, capture: Capture, folders: Folders, config: CaptureConfig, **more) -> Request:
    def absolute(path: Path) -> str:
        return str(path.absolute())

    return Request(
        step=step,
        database=absolute(folders.database),
        pictures=absolute(folders.pictures),
        models=absolute(folders.models),
        pairs=absolute(folders.pairs),
        masks=absolute(folders.masks) if capture.masks is not None else "",
        features=config.features,
        first_octave=config.first_octave,
        seed=config.seed,
        threads=torch.get_num_threads(),
        seconds=config.base_seconds + config.photograph_seconds * len(capture.photographs),
        **more,
    )


def _parameters(capture: Capture, members: Sequence[int], config: CaptureConfig) -> str:
    """Focal length of the file, in the picture that features are sought in; centre; no bending."""
    photograph = capture.photographs[members[0]]
    if photograph.prior is None:
        return ""
    long, short = sorted((photograph.width, photograph.height), reverse=True)
    width, height = fitted(long, short, config.size)
    return f"{photograph.prior * width / long:.6g},{width / 2},{height / 2},0"
