"""Meshes with materials at their vertices as PLY."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from univoxel.color import linear_to_srgb
from univoxel.files import replacing
from univoxel.records import Mesh


def write_ply(path: Path, mesh: Mesh) -> None:
    """Write a mesh as binary little-endian PLY, whole or not at all.

    Per vertex, as far as the mesh has them: x y z, nx ny nz, roughness and metallic (float), albedo
    as red green blue (uchar, sRGB), which is where other programs look for colour.

    Raises:
        OSError: the file cannot be written; nothing is left behind.
    """
    columns: list[tuple[str, np.ndarray]] = []

    def add(names: str, values: torch.Tensor, dtype: str) -> None:
        array = values.detach().numpy().astype(dtype)
        array = array[:, None] if array.ndim == 1 else array
        columns.extend(zip(names.split(), array.T, strict=True))

    add("x y z", mesh.vertices, "<f4")
    if mesh.normals is not None:
        add("nx ny nz", mesh.normals, "<f4")
    if mesh.albedo is not None:
        add("red green blue", (linear_to_srgb(mesh.albedo) * 255).round(), "u1")
    if mesh.roughness is not None:
        add("roughness", mesh.roughness, "<f4")
    if mesh.metallic is not None:
        add("metallic", mesh.metallic, "<f4")
    vertex = np.empty(len(mesh.vertices), [(name, column.dtype) for name, column in columns])
    for name, column in columns:
        vertex[name] = column
    face = np.empty(len(mesh.faces), [("corners", "u1"), ("index", "<i4", (3,))])
    face["corners"], face["index"] = 3, mesh.faces.numpy()

    kinds = {"<f4": "float", "|u1": "uchar"}
    properties = [f"property {kinds[column.dtype.str]} {name}" for name, column in columns]
    header = [
        "ply",
        "format binary_little_endian 1.0",
        "comment univoxel: red green blue are the albedo in sRGB",
        f"element vertex {len(vertex)}",
        *properties,
        f"element face {len(face)}",
        "property list uchar int vertex_indices",
        "end_header",
    ]
    with replacing(path) as temporary:
        text = "".join(line + "\n" for line in header).encode("ascii")
        temporary.write_bytes(text + vertex.tobytes() + face.tobytes())
