"""Which photographs share a camera: one lens at one zoom setting, held either way."""

from __future__ import annotations

from collections.abc import Sequence

from univoxel.capture.photographs import Photograph


def group(photographs: Sequence[Photograph]) -> list[list[int]]:
    """Indices of photographs with one camera, model, focal length and size; the largest first.

    Portrait and landscape are one camera. Without anything in the file, the size decides.
    """
    groups: dict[tuple, list[int]] = {}
    for i, p in enumerate(photographs):
        key = (p.camera, p.focal, max(p.width, p.height), min(p.width, p.height))
        groups.setdefault(key, []).append(i)
    return sorted(groups.values(), key=lambda g: (-len(g), g[0]))


def in_words(photographs: Sequence[Photograph], groups: Sequence[Sequence[int]]) -> str:
    """What was photographed with what, for people."""
    first = photographs[groups[0][0]]
    portrait = sum(p.portrait for p in photographs)
    long, short = max(first.width, first.height), min(first.width, first.height)
    told = f"{len(photographs)} photographs"
    if len(groups) == 1:
        told += f" of {first.camera} ({long}x{short})" if first.camera else f" of {long}x{short}"
    else:
        zooms = {photographs[g[0]].focal for g in groups}
        sizes = {tuple(sorted((p.width, p.height))) for p in photographs}
        cameras = {p.camera for p in photographs}
        of = [
            f"{len(found)} {what}"
            for found, what in ((cameras, "models"), (zooms, "zoom settings"), (sizes, "sizes"))
            if len(found) > 1
        ]
        told += f" of {len(groups)} cameras ({', '.join(of)})"
    if 0 < portrait < len(photographs):
        told += f", {portrait} of them portrait"
    return told
