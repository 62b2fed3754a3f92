"""Features, pairs, matches and models of a capture. An interrupted extraction is resumed."""

from __future__ import annotations

import itertools
import shutil
from collections.abc import Iterator, Sequence

import numpy as np
import torch

from univoxel.capture import model
from univoxel.capture.config import CaptureConfig
from univoxel.capture.photographs import fitted
from univoxel.capture.prepare import Capture, Folders
from univoxel.capture.sfm import Request, run
from univoxel.core.files import write_text

COARSE_FEATURES = 512  # largest features that pairs are chosen by
# Photographs up to which so many are compared: beyond, fewer of each, for the time of the
# comparison grows with the square of photographs and of features
COARSE_PHOTOGRAPHS = 150
RATIO = 0.8  # of the distances to the best and second best feature, below which a match counts
NEIGHBOURS = 3  # next photographs by name that are matched as well
BASE_SECONDS, PHOTOGRAPH_SECONDS = 120.0, 30.0  # limit of one step, and for each photograph


def extract(capture: Capture, folders: Folders, config: CaptureConfig) -> Iterator[int]:
    """Find features, camera by camera; yields how many photographs have theirs."""
    pictures = capture.pictures
    for g, members in enumerate(capture.groups):
        names = [pictures[i] for i in members if (folders.pictures / pictures[i]).exists()]
        known = model.images(folders.database)
        done = model.feature_counts(folders.database) if known else {}
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
            lambda: model.count(folders.database, "descriptors"),
        )


def select(capture: Capture, folders: Folders, config: CaptureConfig) -> Iterator[int]:
    """Write which pairs to match; yields how many photographs were compared with all others."""
    pictures = capture.pictures
    numbers = model.images(folders.database)
    there = [i for i, name in enumerate(pictures) if name in numbers]
    if len(there) <= config.exhaustive:
        chosen = list(itertools.combinations(range(len(there)), 2))
    else:
        most = features_each(len(there))
        features = [
            model.largest_features(folders.database, numbers[pictures[i]][0], most) for i in there
        ]
        rows = []
        for row in similarities(features):
            rows.append(row)
            yield len(rows)
        chosen = choose(np.stack(rows), config.partners)
    lines = [f"{pictures[there[i]]} {pictures[there[j]]}\n" for i, j in chosen]
    write_text(folders.pairs, "".join(lines))


def features_each(photographs: int) -> int:
    """Features of each photograph to compare, so that the time of all pairs is bounded."""
    share = min(1.0, COARSE_PHOTOGRAPHS / photographs)
    return max(16, int(COARSE_FEATURES * share))


def similarities(features: Sequence[np.ndarray]) -> Iterator[np.ndarray]:
    """For each photograph its mutual matches [N] with all: best of each other, by a clear margin.

    Args:
        features: unit descriptors [F, D] of each photograph.
    """
    most = max((len(f) for f in features), default=0)
    width = features[0].shape[1] if features else 0
    others = np.zeros((len(features), max(most, 2), width), np.float32)
    for row, f in zip(others, features, strict=True):
        row[: len(f)] = f
    flat = others.reshape(-1, width)
    for i, own in enumerate(features):
        found = np.zeros(len(features), int)
        if len(own):
            # Padding has cosine 0, which is no more than the least of real descriptors
            cosine = (own @ flat.T).reshape(len(own), len(features), -1).swapaxes(0, 1)
            for j, block in enumerate(cosine):
                if j != i and len(features[j]) > 1:
                    found[j] = _mutual(block[:, : len(features[j])])
        yield found


def _mutual(cosine: np.ndarray) -> int:
    best, back = cosine.argmax(1), cosine.argmax(0)
    rows = np.arange(len(cosine))
    top = cosine[rows, best]
    rest = cosine.copy()
    rest[rows, best] = -1
    second = rest.max(1)
    # Squared distances of unit vectors
    clear = (2 - 2 * top) < RATIO**2 * (2 - 2 * second)
    return int(((back[best] == rows) & clear).sum())


def choose(similar: np.ndarray, partners: int) -> list[tuple[int, int]]:
    """Pairs (i, j), i < j: the best partners of each photograph and the next ones by name.

    Args:
        similar: matches [N, N] of the coarse look, of photographs in order of their names.
    """
    pairs = set()
    for i, row in enumerate(similar):
        best = [j for j in np.argsort(-row, kind="stable")[:partners] if j != i]
        neighbours = range(i + 1, min(i + 1 + NEIGHBOURS, len(similar)))
        pairs |= {(min(i, int(j)), max(i, int(j))) for j in (*best, *neighbours)}
    return sorted(pairs)


def match(capture: Capture, folders: Folders, config: CaptureConfig) -> Iterator[int]:
    """Match the chosen pairs and verify them; yields how many are done."""
    yield from run(
        _request("match", capture, folders, config),
        folders.work / "match.log",
        lambda: model.count(folders.database, "two_view_geometries"),
    )


def place(capture: Capture, folders: Folders, config: CaptureConfig) -> Iterator[int]:
    """Find the cameras; yields how many photographs were placed, in all tries together."""
    shutil.rmtree(folders.models, ignore_errors=True)
    folders.models.mkdir(parents=True)
    yield from run(_request("map", capture, folders, config), folders.work / "map.log")


def _request(step, capture: Capture, folders: Folders, config: CaptureConfig, **more) -> Request:
    folders = Folders(folders.work.absolute())
    return Request(
        step=step,
        database=str(folders.database),
        pictures=str(folders.pictures),
        models=str(folders.models),
        pairs=str(folders.pairs),
        masks=str(folders.masks) if capture.masks is not None else "",
        features=config.features,
        first_octave=config.first_octave,
        seed=config.seed,
        threads=torch.get_num_threads(),
        seconds=BASE_SECONDS + PHOTOGRAPH_SECONDS * len(capture.photographs),
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
