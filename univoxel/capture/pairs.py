"""Which photographs may show the same: a coarse look that chooses the pairs to match in full."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from univoxel.capture.config import CaptureConfig


def features_each(photographs: int, config: CaptureConfig) -> int:
    """Features of each photograph to compare, so that the time of all pairs is bounded."""
    share = min(1.0, config.coarse_photographs / photographs)
    return max(16, int(config.coarse_features * share))


def similarities(features: Sequence[np.ndarray], ratio: float) -> Iterator[np.ndarray]:
    """For each photograph its mutual matches [N] with all: best of each other, by a clear margin.

    Args:
        features: unit descriptors [F, D] of each photograph.
        ratio: of the distances to the best and second best, below which a match counts.
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
                    found[j] = _mutual(block[:, : len(features[j])], ratio)
        yield found


def _mutual(cosine: np.ndarray, ratio: float) -> int:
    best, back = cosine.argmax(1), cosine.argmax(0)
    rows = np.arange(len(cosine))
    top = cosine[rows, best]
    rest = cosine.copy()
    rest[rows, best] = -1
    second = rest.max(1)
    # Squared distances of unit vectors
    clear = (2 - 2 * top) < ratio**2 * (2 - 2 * second)
    return int(((back[best] == rows) & clear).sum())


def choose(similar: np.ndarray, config: CaptureConfig) -> list[tuple[int, int]]:
    """Pairs (i, j), i < j: the best partners of each photograph and the next ones by name.

    Args:
        similar: matches [N, N] of the coarse look, of photographs in order of their names.
    """
    pairs = set()
    for i, row in enumerate(similar):
        partners = [j for j in np.argsort(-row, kind="stable")[: config.partners] if j != i]
        neighbours = range(i + 1, min(i + 1 + config.neighbours, len(similar)))
        pairs |= {(min(i, int(j)), max(i, int(j))) for j in (*partners, *neighbours)}
    return sorted(pairs)


def all_pairs(photographs: int) -> list[tuple[int, int]]:
    return [(i, j) for i in range(photographs) for j in range(i + 1, photographs)]
