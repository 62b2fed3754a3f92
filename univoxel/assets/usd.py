"""Textured meshes as USDZ: one file of OpenUSD's package format, as phones show it in a room."""

from __future__ import annotations

import tempfile
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

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
from univoxel.errors import MissingExtra
from univoxel.files import replacing

ROOT, MESH, MATERIAL = "/object", "/object/mesh", "/object/material"


def require_usd() -> Any:
    """The modules of OpenUSD, as attributes. They are typed by nobody.

    Raises:
        MissingExtra: they are not installed.
    """
    names = ("Sdf", "Usd", "UsdGeom", "UsdShade", "Vt")
    try:
        import_module("pxr")
        return SimpleNamespace(**{name: import_module(f"pxr.{name}") for name in names})
    except ImportError:
        raise MissingExtra("a .usdz file needs usd-core: pip install 'univoxel[usd]'") from None


def write_usdz(path: Path, mesh: TexturedMesh, jpeg: int | None = None) -> None:
    """Write a textured mesh as USDZ, turned to +Y up, whole or not at all.

    One mesh with one UsdPreviewSurface: diffuseColor (sRGB), roughness, metallic where the mesh has
    metal, and normal (raw), each a texture. One unit is one metre. USD holds no tangents: programs
    compute their own.

    Args:
        jpeg: quality of textures as JPEG, 1 to 95; None: PNG, which loses nothing.

    Raises:
        MissingExtra: usd-core is not installed.
        OSError: the file cannot be written; nothing is left behind.

    Source: OpenUSD, UsdPreviewSurface and USDZ specifications; Apple's rules for ARKit.
    """
    usd = require_usd()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        pictures = _write_pictures(folder, mesh, jpeg)
        layer = folder / "object.usdc"
        _write_stage(usd, layer, mesh, pictures)
        package = folder / "object.usdz"
        _write_package(usd, package, [layer, *(folder / file for file in pictures.values())])
        with replacing(path) as temporary:
            temporary.write_bytes(package.read_bytes())


def _write_package(usd: Any, package: Path, files: list[Path]) -> None:
    """An archive of files, the layer first, aligned and not compressed as the format asks for."""
    kind: Any = getattr(usd.Sdf, "ZipFileWriter", None) or getattr(usd.Usd, "ZipFileWriter", None)
    writer = kind.CreateNew(str(package))
    for file in files:
        writer.AddFile(str(file), file.relative_to(package.parent).as_posix())
    writer.Save()


def _write_pictures(folder: Path, mesh: TexturedMesh, jpeg: int | None) -> dict[str, str]:
    """Files of the textures, by the input of the surface that they are for."""
    pictures = {
        "diffuseColor": albedo_picture(mesh),
        "roughness": roughness_picture(mesh),
        "normal": relief_picture(mesh),
    }
    if mesh.metallic is not None:
        pictures["metallic"] = metallic_picture(mesh)
    files = {}
    for kind, picture in pictures.items():
        files[kind] = f"textures/{kind}.{'png' if jpeg is None else 'jpg'}"
        (folder / "textures").mkdir(exist_ok=True)
        (folder / files[kind]).write_bytes(encoded(picture, jpeg))
    return files


def _write_stage(usd: Any, layer: Path, mesh: TexturedMesh, pictures: dict[str, str]) -> None:
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
