"""Triangle meshes in PLY files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from univoxel.errors import DataError
from univoxel.records import Mesh

_TYPES = {
    **dict.fromkeys(("char", "int8"), "<i1"),
    **dict.fromkeys(("uchar", "uint8"), "<u1"),
    **dict.fromkeys(("short", "int16"), "<i2"),
    **dict.fromkeys(("ushort", "uint16"), "<u2"),
    **dict.fromkeys(("int", "int32"), "<i4"),
    **dict.fromkeys(("uint", "uint32"), "<u4"),
    **dict.fromkeys(("float", "float32"), "<f4"),
    **dict.fromkeys(("double", "float64"), "<f8"),
}


def read_ply(path: Path) -> Mesh:
    """Vertices and faces of a binary little-endian PLY file of triangles; the rest is passed over.

    Raises:
        DataError: the file is missing, cut off, of another kind, or holds other polygons or
            places that are not finite.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {error.strerror}") from None
    head, mark, body = data.partition(b"end_header\n")
    lines = [line.split() for line in head.decode("ascii", "replace").splitlines()]
    if lines[:1] != [["ply"]] or not mark or ["format", "binary_little_endian", "1.0"] not in lines:
        raise DataError(f"{path}: expected a binary little-endian PLY file")
    counts: dict[str, int] = {}
    fields: dict[str, list[tuple]] = {}
    try:
        for word, *rest in (line for line in lines if line):
            if word == "element":
                counts[rest[0]], fields[rest[0]] = int(rest[1]), []
                if counts[rest[0]] < 0:
                    raise ValueError(f"{rest[1]} of {rest[0]}")
            elif word == "property" and rest[0] == "list":
                row = ("count", _TYPES[rest[1]]), ("corner", _TYPES[rest[2]], (3,))
                fields[list(fields)[-1]] += row
            elif word == "property":
                fields[list(fields)[-1]].append((rest[1], _TYPES[rest[0]]))
        if list(counts)[:2] != ["vertex", "face"]:
            raise KeyError("vertex and face first")
        vertex = np.frombuffer(body, np.dtype(fields["vertex"]), counts["vertex"])
        face = np.frombuffer(body[vertex.nbytes :], np.dtype(fields["face"]), counts["face"])
        corner = np.stack([vertex[axis] for axis in "xyz"], -1).astype(np.float32)
        index, sides = face["corner"].astype(np.int32), face["count"]
    except (KeyError, IndexError, ValueError, OverflowError) as error:
        raise DataError(
            f"{path}: expected vertices x y z and triangles, got something else: {error}"
        ) from None
    if (sides != 3).any() or (len(index) and not 0 <= index.min() <= index.max() < len(corner)):
        raise DataError(f"{path}: expected triangles of the {len(corner)} vertices")
    if not np.isfinite(corner).all():
        raise DataError(f"{path}: expected vertices at finite places, got NaN or infinity")
    return Mesh(torch.from_numpy(corner), torch.from_numpy(index))
