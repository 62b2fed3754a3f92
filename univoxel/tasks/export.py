"""The surface of a trained scene as a mesh file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from univoxel.color import linear_to_srgb
from univoxel.data.images import replacing
from univoxel.records import Mesh
from univoxel.render.pipeline import extract_mesh
from univoxel.scene import load_scene


def export(run: Path, mesh: Path) -> None:
    """Write the zero level of a scene's sdf with its materials at the vertices.

    Args:
        run: folder of the trained scene.
        mesh: the file to write, .ply, whole or not at all.

    Raises:
        FileNotFoundError, ValueError: the run cannot be used, or `mesh` does not end in .ply.
        OSError: the file cannot be written.
    """
    mesh = Path(mesh)
    if mesh.suffix.lower() != ".ply":
        raise ValueError(f"export: expected a file that ends in .ply, got {mesh}")
    surface = extract_mesh(load_scene(run))
    mesh.parent.mkdir(parents=True, exist_ok=True)
    write_ply(mesh, surface)


def write_ply(path: Path, mesh: Mesh) -> None:
    """Write a mesh as binary little-endian PLY, whole or not at all.

    Per vertex, as far as the mesh has them: x y z, nx ny nz and roughness (float), albedo as
    red green blue (uchar, sRGB), which is where other programs look for colour.

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
