"""Charts of a mesh: the place of each triangle in a texture."""

from __future__ import annotations

import torch
from torch import Tensor

from univoxel.core.records import Mesh
from univoxel.ops import native

PADDING = 4  # texels between charts: two mip levels stay apart


def unwrap(mesh: Mesh, size: int) -> tuple[Tensor, Tensor, Tensor]:
    """Cut a mesh into charts and pack them into a square of size x size texels.

    Returns:
        source [Q] int64, the vertex of `mesh` that each new one copies; faces [F, 3] int32, in the
        order of `mesh`; uv [Q, 2] float32 in [0, 1], v upwards. No chart is mirrored.

    Raises:
        ValueError: a face names a vertex that is not there.
        MissingNative: the compiled extension is missing.

    Source: Young 2018, xatlas, which is compiled into the extension: third_party/xatlas.
    """
    vertices, faces = mesh.vertices.float().contiguous(), mesh.faces.int().contiguous()
    charts = native.require().find_charts(*native.arrays(vertices, faces), size, PADDING)
    new, triangles = charts.count()
    source = torch.empty(new, dtype=torch.int64)
    corners = torch.empty(triangles, 3, dtype=torch.int32)
    uv = torch.empty(new, 2)
    charts.write(*native.arrays(source, corners, uv))
    return source, corners, uv.clamp_(0, 1)
