"""USDZ files, checked by OpenUSD's own rules and read back by it."""

import io
import sys
import zipfile

import numpy as np
import pytest
from asymmetric_scene import Metals, lopsided
from PIL import Image

from univoxel.cli import export as task
from univoxel.core.records import Mesh
from univoxel.errors import MissingExtra
from univoxel.output.mesh import bake
from univoxel.output.mesh_files import write_usdz
from univoxel.output.topology import clean, simplify

pytest.importorskip("pxr")
from pxr import Usd, UsdGeom, UsdShade

UPRIGHT = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # rows of USD times this: our world


@pytest.fixture(scope="module", params=["plain", "metal"])
def mesh(request):
    scene = lopsided()
    if request.param == "metal":
        scene.material = Metals()
    return bake(scene, simplify(clean(Mesh(*scene.field.isosurface())), 600), 128)


@pytest.fixture(scope="module", params=[None, 90], ids=["png", "jpeg"])
def file(request, mesh, tmp_path_factory):
    path = tmp_path_factory.mktemp("usd") / "a.usdz"
    write_usdz(path, mesh, request.param)
    assert [p.name for p in path.parent.iterdir()] == ["a.usdz"]
    return path


def complaints(path):
    """What OpenUSD's checker says by all its rules, those of USDZ among them."""
    validation = pytest.importorskip("pxr.UsdValidation", reason="an older usd-core")
    every = validation.ValidationRegistry().GetOrLoadAllValidators()
    found = validation.ValidationContext(every).Validate(Usd.Stage.Open(str(path)))
    return [error.GetErrorAsString() for error in found]


def test_what_apple_asks_for(file):
    """One layer of crate format comes first, pictures beside it, none compressed; +Y is up; the
    checker has nothing to say."""
    assert complaints(file) == []
    with zipfile.ZipFile(file) as package:
        first, *others = package.infolist()
        assert first.filename.endswith(".usdc")
        assert {name.filename.rpartition(".")[2] for name in others} <= {"png", "jpg"}
        assert all(part.compress_type == zipfile.ZIP_STORED for part in package.infolist())
    stage = Usd.Stage.Open(str(file))
    assert UsdGeom.GetStageUpAxis(stage) == "Y"
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    assert stage.GetDefaultPrim().IsA(UsdGeom.Xform)


def test_the_checker_can_complain(tmp_path, mesh):
    """Else it would check nothing: a file whose normal map has no scale and bias."""
    write_usdz(tmp_path / "a.usdz", mesh)
    with zipfile.ZipFile(tmp_path / "a.usdz") as package:
        package.extractall(tmp_path)
    stage = Usd.Stage.Open(str(tmp_path / "object.usdc"))
    stage.GetPrimAtPath("/object/material/normal").RemoveProperty("inputs:scale")
    stage.GetRootLayer().Save()
    assert any("scale" in str(line) for line in complaints(tmp_path / "object.usdc"))
    with pytest.raises(OSError, match=r"a\.usdz"):
        write_usdz(tmp_path / "missing" / "a.usdz", mesh)


def test_geometry_comes_back(file, mesh):
    stage = Usd.Stage.Open(str(file))
    shape = UsdGeom.Mesh(stage.GetPrimAtPath("/object/mesh"))
    points = np.array(shape.GetPointsAttr().Get())
    assert np.array_equal((points @ UPRIGHT).astype(np.float32), mesh.vertices.numpy())
    normals = np.array(shape.GetNormalsAttr().Get())
    assert np.array_equal((normals @ UPRIGHT).astype(np.float32), mesh.normals.numpy())
    faces = np.array(shape.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3)
    assert np.array_equal(faces, mesh.faces.numpy())
    assert set(shape.GetFaceVertexCountsAttr().Get()) == {3}
    places = UsdGeom.PrimvarsAPI(shape).GetPrimvar("st").Get()
    assert np.array_equal(np.array(places), mesh.uv.numpy())
    low, high = np.array(shape.GetExtentAttr().Get())
    np.testing.assert_array_equal((low, high), (points.min(0), points.max(0)))
    assert shape.GetSubdivisionSchemeAttr().Get() == "none"


def test_textures_come_back(file, mesh):
    """By the way a renderer goes: from the surface's inputs to the pictures in the package."""
    stage = Usd.Stage.Open(str(file))
    shape = stage.GetPrimAtPath("/object/mesh")
    material, _ = UsdShade.MaterialBindingAPI(shape).ComputeBoundMaterial()
    surface = material.ComputeSurfaceSource()[0]
    assert surface.GetIdAttr().Get() == "UsdPreviewSurface"
    stored = {
        "diffuseColor": ("sRGB", None),
        "roughness": ("raw", mesh.roughness),
        "normal": ("raw", 0.5 * mesh.relief + 0.5),
    }
    if mesh.metallic is None:
        assert surface.GetInput("metallic").Get() == 0
    else:
        stored["metallic"] = ("raw", mesh.metallic)
    for kind, (space, values) in stored.items():
        texture = UsdShade.Shader(surface.GetInput(kind).GetConnectedSource()[0])
        assert texture.GetInput("sourceColorSpace").Get() == space
        name = texture.GetInput("file").Get().path
        with zipfile.ZipFile(file) as package:
            picture = np.asarray(Image.open(io.BytesIO(package.read(name))), float) / 255
        if kind == "diffuseColor":
            picture = np.where(
                picture <= 0.04045, picture / 12.92, ((picture + 0.055) / 1.055) ** 2.4
            )
            values = mesh.albedo
        # Bits, of sRGB here; JPEG of quality 90 has steps of up to 24 of 255
        tolerance = 0.005 if name.endswith("png") else 0.02
        assert np.abs(picture - values.numpy()).mean() < tolerance, kind


def test_it_is_exported(tmp_path, monkeypatch):
    monkeypatch.setattr("univoxel.scene.load_scene", lambda run: lopsided())
    (path,) = task.export(
        "run", tmp_path / "a.usdz", faces=300, texture_size=64, size=0.3, origin="bottom"
    )
    assert complaints(path) == []
    stage = Usd.Stage.Open(str(path))
    points = np.array(UsdGeom.Mesh(stage.GetPrimAtPath("/object/mesh")).GetPointsAttr().Get())
    assert np.ptp(points, 0).max() == pytest.approx(0.3, abs=0.3e-6)
    assert points[:, 1].min() == pytest.approx(0, abs=0.3e-6)
    monkeypatch.setattr("univoxel.scene.load_scene", None)  # said before the run is read
    monkeypatch.setitem(sys.modules, "pxr", None)
    with pytest.raises(MissingExtra, match=r"needs usd-core: pip install 'univoxel\[usd\]'"):
        task.export("run", tmp_path / "b.usdz")
