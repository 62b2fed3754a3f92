"""Textured meshes as glTF 2.0 in one binary file (.glb)."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pygltflib as gltf
import torch
from torch import Tensor

from univoxel import __version__
from univoxel.assets.base import (
    Y_UP,
    TexturedMesh,
    albedo_picture,
    encoded,
    metallic_picture,
    relief_picture,
    roughness_picture,
)
from univoxel.files import replacing


def write_glb(path: Path, mesh: TexturedMesh, jpeg: int | None = None) -> None:
    """Write a textured mesh as GLB, turned to +Y up, whole or not at all.

    Args:
        jpeg: as of `glb`.

    Raises:
        OSError: the file cannot be written; nothing is left behind.
    """
    data = glb(mesh, jpeg)
    with replacing(path) as temporary:
        temporary.write_bytes(data)


def glb(
    mesh: TexturedMesh, jpeg: int | None = None, extra: Mapping[str, Tensor] | None = None
) -> bytes:
    """A textured mesh as GLB, turned to +Y up.

    One mesh with one metallic-roughness material: base colour (sRGB), roughness in green and
    metallic in blue (linear), and a normal map for the tangents that are written beside it.

    Args:
        jpeg: quality of textures as JPEG, 1 to 95; None: PNG, which loses nothing.
        extra: more attributes of vertices, [P, 4] float in [-1, 1], stored in 16 bits; names
            begin with an underscore.

    Source: Khronos Group, glTF 2.0 Specification, sections 3.7, 3.9 and 4.4.
    """
    roughness = roughness_picture(mesh)
    # Red holds ambient occlusion in files that have it: 255 is none.
    packed = np.stack([np.full_like(roughness, 255), roughness, metallic_picture(mesh)], 2)
    tangents = torch.cat([mesh.tangents[:, :3] @ Y_UP.T, mesh.tangents[:, 3:]], 1)
    uv = torch.stack([mesh.uv[:, 0], 1 - mesh.uv[:, 1]], 1)  # glTF counts v downwards
    file = gltf.GLTF2(
        asset=gltf.Asset(version="2.0", generator=f"univoxel {__version__}"),
        scene=0,
        scenes=[gltf.Scene(nodes=[0])],
        nodes=[gltf.Node(mesh=0, name="object")],
        materials=[
            gltf.Material(
                name="object",
                pbrMetallicRoughness=gltf.PbrMetallicRoughness(
                    baseColorTexture=gltf.TextureInfo(index=0),
                    metallicRoughnessTexture=gltf.TextureInfo(index=1),
                    metallicFactor=0.0 if mesh.metallic is None else 1.0,
                    roughnessFactor=1.0,
                ),
                normalTexture=gltf.NormalMaterialTexture(index=2),
                alphaMode=gltf.OPAQUE,
                alphaCutoff=None,
                doubleSided=False,
            )
        ],
        samplers=[
            gltf.Sampler(
                magFilter=gltf.LINEAR,
                minFilter=gltf.LINEAR_MIPMAP_LINEAR,
                wrapS=gltf.CLAMP_TO_EDGE,
                wrapT=gltf.CLAMP_TO_EDGE,
            )
        ],
        textures=[gltf.Texture(sampler=0, source=i) for i in range(3)],
    )
    blob = bytearray()
    attributes = gltf.Attributes(
        POSITION=_accessor(file, blob, mesh.vertices @ Y_UP.T, gltf.VEC3, bounds=True),
        NORMAL=_accessor(file, blob, mesh.normals @ Y_UP.T, gltf.VEC3),
        TANGENT=_accessor(file, blob, tangents, gltf.VEC4),
        TEXCOORD_0=_accessor(file, blob, uv, gltf.VEC2),
        **{
            name: _accessor(file, blob, (32767 * values).round().short(), gltf.VEC4)
            for name, values in (extra or {}).items()
        },
    )
    indices = _accessor(file, blob, mesh.faces.reshape(-1), gltf.SCALAR)
    primitive = gltf.Primitive(attributes=attributes, indices=indices, material=0)
    file.meshes = [gltf.Mesh(name="object", primitives=[primitive])]
    for name, picture in (
        ("base colour", albedo_picture(mesh)),
        ("occlusion roughness metallic", packed),
        ("normal", relief_picture(mesh)),
    ):
        view = _view(file, blob, encoded(picture, jpeg), None)
        kind = "image/png" if jpeg is None else "image/jpeg"
        file.images.append(gltf.Image(name=name, mimeType=kind, bufferView=view))
    file.buffers = [gltf.Buffer(byteLength=len(blob))]
    file.set_binary_blob(bytes(blob))
    return b"".join(file.save_to_bytes())


def _view(file: gltf.GLTF2, blob: bytearray, data: bytes, target: int | None) -> int:
    """Append bytes to the buffer, at a multiple of 4; the index of their view."""
    blob.extend(bytes(-len(blob) % 4))
    view = gltf.BufferView(buffer=0, byteOffset=len(blob), byteLength=len(data), target=target)
    file.bufferViews.append(view)
    blob.extend(data)
    return len(file.bufferViews) - 1


def _accessor(
    file: gltf.GLTF2, blob: bytearray, values: Tensor, kind: str, bounds: bool = False
) -> int:
    """Append values to the buffer; their index.

    Floats and 16-bit integers, which stand for [-1, 1], are of vertices, other integers indices.
    """
    array = values.numpy()
    short = values.dtype == torch.int16
    index = not short and not values.is_floating_point()
    target = gltf.ELEMENT_ARRAY_BUFFER if index else gltf.ARRAY_BUFFER
    array = array.astype("<i2" if short else "<u4" if index else "<f4")
    stored = gltf.SHORT if short else gltf.UNSIGNED_INT if index else gltf.FLOAT
    file.accessors.append(
        gltf.Accessor(
            bufferView=_view(file, blob, array.tobytes(), target),
            componentType=stored,
            normalized=short,
            count=len(array),
            type=kind,
            min=array.min(0).tolist() if bounds else None,
            max=array.max(0).tolist() if bounds else None,
        )
    )
    return len(file.accessors) - 1
