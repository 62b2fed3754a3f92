"""What the writers of textured meshes share: the record, and its textures as pictures."""

from __future__ import annotations

import io
from dataclasses import dataclass

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from univoxel.color import linear_to_srgb

# glTF and USD look along -Z with +Y up, our world has +Z up: (x, y, z) -> (x, z, -y), a quarter
# turn.
Y_UP = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


@dataclass(frozen=True)
class TexturedMesh:
    """Triangles with textures, counter-clockwise seen from outside; a vertex stands in one chart.

    Row 0 of a texture is on top, at v = 1. The field's normal at a texel is the unit vector along

        n = x t + y b + z n,  b = t_w cross(n, t)

    where (x, y, z) is the texel of `relief`, and n, t are the vertices' normals and tangents,
    interpolated over the triangle and not normalised: the frame of MikkTSpace.
    """

    vertices: Tensor  # [P, 3] float32, world
    faces: Tensor  # [F, 3] int32
    normals: Tensor  # [P, 3] float32 unit, of the triangles, smooth across them
    tangents: Tensor  # [P, 4] float32: unit, along +u; w is 1, or -1 where the chart is mirrored
    uv: Tensor  # [P, 2] float32 in [0, 1], u to the right and v upwards
    relief: Tensor  # [T, T, 3] float32 unit, z > 0: the normal in the tangent frame
    albedo: Tensor  # [T, T, 3] float32 linear, in [0, 1]; of a metal: its F0
    roughness: Tensor  # [T, T] float32 perceptual, in [0, 1]
    metallic: Tensor | None = None  # [T, T] float32 in [0, 1]; None: no metal anywhere


def albedo_picture(mesh: TexturedMesh) -> np.ndarray:
    """[T, T, 3] uint8, sRGB."""
    return _bytes(linear_to_srgb(mesh.albedo))


def roughness_picture(mesh: TexturedMesh) -> np.ndarray:
    """[T, T] uint8, linear."""
    return _bytes(mesh.roughness)


def metallic_picture(mesh: TexturedMesh) -> np.ndarray:
    """[T, T] uint8, linear; black where the mesh has no metal."""
    return _bytes(torch.zeros_like(mesh.roughness) if mesh.metallic is None else mesh.metallic)


def relief_picture(mesh: TexturedMesh) -> np.ndarray:
    """[T, T, 3] uint8, linear, 127.5 (n + 1); green is +y, upwards in the picture."""
    return _bytes(0.5 * (mesh.relief + 1))


def encoded(picture: np.ndarray, jpeg: int | None) -> bytes:
    """A picture as the bytes of a PNG file, or of a JPEG file of some quality."""
    file = io.BytesIO()
    if jpeg is None:
        Image.fromarray(picture).save(file, format="PNG")
    else:  # 4:4:4: channels of these are no colours
        Image.fromarray(picture).save(file, format="JPEG", quality=jpeg, subsampling=0)
    return file.getvalue()


def _bytes(values: Tensor) -> np.ndarray:
    return (values.clamp(0, 1) * 255).round().byte().numpy()
