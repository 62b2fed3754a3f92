"""Meshes in files: glTF 2.0, OpenUSD, Wavefront OBJ with textures, PLY with materials at
vertices."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pygltflib as gltf
import torch
from torch import Tensor

from univoxel import __version__
from univoxel.color import linear_to_srgb
from univoxel.core.files import write_bytes, write_text
from univoxel.core.records import Mesh
from univoxel.errors import MissingExtra, UserError
from univoxel.output.mesh import Y_UP, TexturedMesh, encoded, texture_pictures


def glb(
    mesh: TexturedMesh, jpeg: int | None = None, extra: Mapping[str, Tensor] | None = None
) -> bytes:
    """A textured mesh as GLB, turned to +Y up.

    One mesh with one metallic-roughness material: base colour (sRGB), roughness in green and
    metallic in blue (linear), and a normal map for the tangents that are written beside it. Where
    it is known what photographs saw, vertices have `_SEEN`: float, 1 for seen, 0 for a guess.

    Args:
        jpeg: quality of textures as JPEG, 1 to 95; None: PNG, which loses nothing.
        extra: more attributes of vertices, [P, 4] float in [-1, 1], stored in 16 bits; names
            begin with an underscore.

    Source: Khronos Group, glTF 2.0 Specification, sections 3.7, 3.9 and 4.4.
    """
    pictures = texture_pictures(mesh)
    roughness = pictures["roughness"]
    metallic = pictures.get("metallic", np.zeros_like(roughness))
    # Red holds ambient occlusion in files that have it: 255 is none.
    packed = np.stack([np.full_like(roughness, 255), roughness, metallic], 2)
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
    known = {} if mesh.seen is None else {"_SEEN": mesh.seen}
    attributes = gltf.Attributes(
        POSITION=_accessor(file, blob, mesh.vertices @ Y_UP.T, gltf.VEC3, bounds=True),
        NORMAL=_accessor(file, blob, mesh.normals @ Y_UP.T, gltf.VEC3),
        TANGENT=_accessor(file, blob, tangents, gltf.VEC4),
        TEXCOORD_0=_accessor(file, blob, uv, gltf.VEC2),
        **{
            name: _accessor(file, blob, (32767 * values).round().short(), gltf.VEC4)
            for name, values in (extra or {}).items()
        },
        **{name: _accessor(file, blob, values, gltf.SCALAR) for name, values in known.items()},
    )
    indices = _accessor(file, blob, mesh.faces.reshape(-1), gltf.SCALAR)
    primitive = gltf.Primitive(attributes=attributes, indices=indices, material=0)
    file.meshes = [gltf.Mesh(name="object", primitives=[primitive])]
    for name, picture in (
        ("base colour", pictures["albedo"]),
        ("occlusion roughness metallic", packed),
        ("normal", pictures["normal"]),
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


# Textured meshes as USDZ: one file of OpenUSD's package format, as phones show it in a room.


ROOT, MESH, MATERIAL = "/object", "/object/mesh", "/object/material"


def require_usd() -> Any:
    """The modules of OpenUSD, as attributes, typed by nobody; a MissingExtra without them."""
    names = ("Sdf", "Usd", "UsdGeom", "UsdShade", "Vt")
    try:
        import_module("pxr")
        return SimpleNamespace(**{name: import_module(f"pxr.{name}") for name in names})
    except ImportError:
        raise MissingExtra("a .usdz file needs usd-core: pip install 'univoxel[usd]'") from None


def write_usdz(path: Path, mesh: TexturedMesh, jpeg: int | None = None) -> None:
    """Write a textured mesh as USDZ, turned to +Y up, whole or not at all; pictures as in `glb`.

    One mesh with one UsdPreviewSurface: diffuseColor (sRGB), roughness, metallic where the mesh has
    metal, and normal (raw), each a texture. One unit is one metre. USD holds no tangents: programs
    compute their own.

    Source: OpenUSD, UsdPreviewSurface and USDZ specifications; Apple's rules for ARKit.
    """
    usd = require_usd()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        pictures = _write_pictures(folder, mesh, jpeg)
        layer = folder / "object.usdc"
        stage = usd.Usd.Stage.CreateNew(str(layer))
        usd.UsdGeom.SetStageUpAxis(stage, usd.UsdGeom.Tokens.y)
        usd.UsdGeom.SetStageMetersPerUnit(stage, 1.0)
        stage.GetRootLayer().documentation = f"univoxel {__version__}"
        root = usd.UsdGeom.Xform.Define(stage, ROOT)
        stage.SetDefaultPrim(root.GetPrim())
        usd.Usd.ModelAPI(root.GetPrim()).SetKind("component")
        _define_material(usd, stage, pictures)
        _define_mesh(usd, stage, mesh)
        stage.GetRootLayer().Save()
        # The layer first, aligned and not compressed, as the format asks for
        package, module = folder / "object.usdz", usd.Sdf
        if not hasattr(module, "ZipFileWriter"):
            module = usd.Usd
        writer = module.ZipFileWriter.CreateNew(str(package))
        for file in (layer.name, *pictures.values()):
            writer.AddFile(str(folder / file), file)
        writer.Save()
        write_bytes(path, package.read_bytes())


def _write_pictures(folder: Path, mesh: TexturedMesh, jpeg: int | None) -> dict[str, str]:
    """Files of the textures, by the input of the surface that they are for."""
    (folder / "textures").mkdir()
    files = {}
    for name, picture in texture_pictures(mesh).items():
        kind = "diffuseColor" if name == "albedo" else name
        files[kind] = f"textures/{kind}.{'png' if jpeg is None else 'jpg'}"
        (folder / files[kind]).write_bytes(encoded(picture, jpeg))
    return files


def _define_mesh(usd: Any, stage: Any, mesh: TexturedMesh) -> None:
    def vectors(values: Any, kind: Any) -> Any:
        return kind.FromNumpy(np.ascontiguousarray(values.numpy(), np.float32))

    shape = usd.UsdGeom.Mesh.Define(stage, MESH)
    points = mesh.vertices @ Y_UP.T
    shape.CreatePointsAttr(vectors(points, usd.Vt.Vec3fArray))
    counts = np.full(len(mesh.faces), 3, np.int32)
    shape.CreateFaceVertexCountsAttr(usd.Vt.IntArray.FromNumpy(counts))
    indices = mesh.faces.reshape(-1).numpy().astype(np.int32)
    shape.CreateFaceVertexIndicesAttr(usd.Vt.IntArray.FromNumpy(indices))
    shape.CreateNormalsAttr(vectors(mesh.normals @ Y_UP.T, usd.Vt.Vec3fArray))
    shape.SetNormalsInterpolation(usd.UsdGeom.Tokens.vertex)
    shape.CreateSubdivisionSchemeAttr(usd.UsdGeom.Tokens.none)
    shape.CreateExtentAttr(usd.UsdGeom.Mesh.ComputeExtent(shape.GetPointsAttr().Get()))
    places = usd.UsdGeom.PrimvarsAPI(shape).CreatePrimvar(
        "st", usd.Sdf.ValueTypeNames.TexCoord2fArray, usd.UsdGeom.Tokens.vertex
    )
    places.Set(vectors(mesh.uv, usd.Vt.Vec2fArray))  # USD counts v upwards
    material = usd.UsdShade.Material.Get(stage, MATERIAL)
    usd.UsdShade.MaterialBindingAPI.Apply(shape.GetPrim()).Bind(material)


def _define_material(usd: Any, stage: Any, pictures: dict[str, str]) -> None:
    kinds = usd.Sdf.ValueTypeNames
    material = usd.UsdShade.Material.Define(stage, MATERIAL)
    surface = usd.UsdShade.Shader.Define(stage, f"{MATERIAL}/surface")
    surface.CreateIdAttr("UsdPreviewSurface")
    surface.CreateInput("useSpecularWorkflow", kinds.Int).Set(0)
    surface.CreateInput("ior", kinds.Float).Set(1.5)
    if "metallic" not in pictures:
        surface.CreateInput("metallic", kinds.Float).Set(0.0)
    out = surface.CreateOutput("surface", kinds.Token)
    material.CreateSurfaceOutput().ConnectToSource(out)

    reader = usd.UsdShade.Shader.Define(stage, f"{MATERIAL}/places")
    reader.CreateIdAttr("UsdPrimvarReader_float2")
    reader.CreateInput("varname", kinds.String).Set("st")
    st = reader.CreateOutput("result", kinds.Float2)
    for kind, file in pictures.items():
        texture = usd.UsdShade.Shader.Define(stage, f"{MATERIAL}/{kind}")
        texture.CreateIdAttr("UsdUVTexture")
        texture.CreateInput("file", kinds.Asset).Set(usd.Sdf.AssetPath(file))
        color = kind == "diffuseColor"
        texture.CreateInput("sourceColorSpace", kinds.Token).Set("sRGB" if color else "raw")
        for side in ("wrapS", "wrapT"):
            texture.CreateInput(side, kinds.Token).Set("clamp")
        texture.CreateInput("st", kinds.Float2).ConnectToSource(st)
        if kind == "normal":  # stored as (n + 1) / 2
            texture.CreateInput("scale", kinds.Float4).Set((2.0, 2.0, 2.0, 1.0))
            texture.CreateInput("bias", kinds.Float4).Set((-1.0, -1.0, -1.0, 0.0))
        vector = {"diffuseColor": kinds.Color3f, "normal": kinds.Normal3f}.get(kind)
        output = texture.CreateOutput(
            "rgb" if vector else "r", kinds.Float3 if vector else kinds.Float
        )
        surface.CreateInput(kind, vector or kinds.Float).ConnectToSource(output)


# Textured meshes as Wavefront OBJ with a material library and pictures beside it.


def write_obj(path: Path, mesh: TexturedMesh, jpeg: int | None = None) -> None:
    """Write NAME.obj, NAME.mtl and NAME_{albedo,roughness,normal}.png, or .jpg as in `glb`, each
    whole or not at all.

    A mesh with metal has a NAME_metallic.png besides. Positions stay in the world's axes, +Z up.
    The .obj comes last: where it is, the others are. Roughness, metallic and normal map are in the
    widespread extension for physically based materials (Pr, Pm, map_Pr, map_Pm, norm); OBJ has no
    tangents, programs compute their own.
    """
    name = path.stem
    if name.split() != [name]:
        raise UserError(f"{path}: OBJ files need a name without spaces")
    suffix = "png" if jpeg is None else "jpg"
    metal = "Pm 0" if mesh.metallic is None else f"Pm 1\nmap_Pm {name}_metallic.{suffix}"
    for kind, picture in texture_pictures(mesh).items():
        write_bytes(path.with_name(f"{name}_{kind}.{suffix}"), encoded(picture, jpeg))
    material = f"""newmtl object
Kd 1 1 1
Ks 0 0 0
Pr 1
{metal}
Ni 1.5
illum 2
map_Kd {name}_albedo.{suffix}
map_Pr {name}_roughness.{suffix}
norm {name}_normal.{suffix}
"""
    write_text(path.with_suffix(".mtl"), material)
    corners = (mesh.faces + 1).tolist()  # v/vt/vn of each corner are the same
    parts = [f"# univoxel: +Z up\nmtllib {name}.mtl\no object\n"]
    for line, values in (
        ("v %.7g %.7g %.7g\n", mesh.vertices),
        ("vt %.7g %.7g\n", mesh.uv),
        ("vn %.6f %.6f %.6f\n", mesh.normals),
    ):
        parts += [line % tuple(row) for row in values.tolist()]
    parts.append("usemtl object\ns 1\n")
    parts += [f"f {a}/{a}/{a} {b}/{b}/{b} {c}/{c}/{c}\n" for a, b, c in corners]
    write_text(path, "".join(parts))


# Meshes with materials at their vertices as PLY.


def write_ply(path: Path, mesh: Mesh) -> None:
    """Write a mesh as binary little-endian PLY, whole or not at all.

    Per vertex, as far as the mesh has them: x y z, nx ny nz, roughness, metallic and seen (float),
    albedo as red green blue (uchar, sRGB), which is where other programs look for colour.
    """
    columns: list[tuple[str, np.ndarray]] = []

    color = None if mesh.albedo is None else (linear_to_srgb(mesh.albedo) * 255).round()
    for names, values, dtype in (
        ("x y z", mesh.vertices, "<f4"),
        ("nx ny nz", mesh.normals, "<f4"),
        ("red green blue", color, "u1"),
        ("roughness", mesh.roughness, "<f4"),
        ("metallic", mesh.metallic, "<f4"),
        ("seen", mesh.seen, "<f4"),
    ):
        if values is not None:
            array = values.detach().numpy().astype(dtype)
            columns += zip(names.split(), np.atleast_2d(array.T), strict=True)
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
    text = "".join(line + "\n" for line in header).encode("ascii")
    write_bytes(path, text + vertex.tobytes() + face.tobytes())
