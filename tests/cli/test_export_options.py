"""Size, origin, levels of detail and JPEG textures of exported meshes, read back by others."""

import io
from typing import Any

import numpy as np
import pytest
import torch
from asymmetric_scene import lopsided
from PIL import Image
from scipy.spatial.transform import Rotation

from univoxel.cli import export as task
from univoxel.errors import UserError
from univoxel.ops import VisibilityScene
from univoxel.run import save_world

trimesh = pytest.importorskip("trimesh")
pygltflib = pytest.importorskip("pygltflib")

UPRIGHT = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # rows of glTF times this: our world


@pytest.fixture(scope="module")
def scene():
    return lopsided()


@pytest.fixture
def export(tmp_path, scene, monkeypatch):
    monkeypatch.setattr("univoxel.scene.load_scene", lambda run: scene)

    def write(name, run="run", **options):
        chosen: dict[str, Any] = {"texture_size": 64, "faces": 500} | options
        return task.export(run, tmp_path / name, **chosen)

    return write


def vertices(path):
    mesh = trimesh.load(path, force="mesh", process=False)
    return mesh.vertices @ UPRIGHT if path.suffix == ".glb" else np.asarray(mesh.vertices)


def pictures(path):
    """Textures of a GLB: (type, size in bytes, pixels)."""
    file = pygltflib.GLTF2().load(str(path))
    found = []
    for image in file.images:
        view = file.bufferViews[image.bufferView]
        data = file.binary_blob()[view.byteOffset :][: view.byteLength]
        opened = Image.open(io.BytesIO(data))
        found.append((image.mimeType, len(data), np.asarray(opened.convert("RGB"), float)))
        assert opened.format == {"image/png": "PNG", "image/jpeg": "JPEG"}[image.mimeType]
    return found


@pytest.mark.parametrize("suffix", ["glb", "obj", "ply"])
@pytest.mark.parametrize("origin", ["upright", "world", "bottom", "centre"])
def test_size_and_origin(export, suffix, origin):
    """True to 1e-6 of the size; PLY and GLB hold 24 bits, OBJ 7 digits."""
    (plain,) = export(f"plain.{suffix}")
    (moved,) = export(f"moved.{suffix}", size=0.3, origin=origin)
    before, after = vertices(plain), vertices(moved)
    low, high = after.min(0), after.max(0)
    assert (high - low).max() == pytest.approx(0.3, abs=0.3e-6)
    scale = 0.3 / (before.max(0) - before.min(0)).max()
    if origin in ("upright", "world"):
        expected = scale * before
    else:
        middle = (before.min(0) + before.max(0)) / 2
        bottom = np.array([*middle[:2], before[:, 2].min()])
        expected = scale * (before - (bottom if origin == "bottom" else middle))
        np.testing.assert_allclose((low + high)[:2] / 2, 0, atol=0.3e-6)
        at_zero = low[2] if origin == "bottom" else (low + high)[2] / 2
        assert at_zero == pytest.approx(0, abs=0.3e-6)
    np.testing.assert_allclose(after, expected, rtol=0, atol=1e-6)


@pytest.mark.parametrize("suffix", ["glb", "obj", "ply"])
def test_the_data_set_s_own_world(export, suffix, tmp_path):
    """Vertices, normals and the frame of the normal map are turned back, where it is asked for."""
    turn = Rotation.from_rotvec([2.0, -0.5, 0.7])
    save_world(np.column_stack([turn.as_matrix(), [0.5, -1.0, 2.0]]), tmp_path)
    (plain,) = export(f"plain.{suffix}", run=tmp_path)
    (world,) = export(f"world.{suffix}", run=tmp_path, origin="world")
    before, after = vertices(plain), vertices(world)
    expected = turn.inv().apply(before - [0.5, -1.0, 2.0])
    np.testing.assert_allclose(after, expected, rtol=0, atol=2e-6)
    if suffix == "glb":
        places = [arrays(path) for path in (plain, world)]
        for name in ("NORMAL", "TANGENT"):
            old, new = (found[name][:, :3] @ UPRIGHT for found in places)
            np.testing.assert_allclose(new, turn.inv().apply(old), atol=2e-6)
    save_world(np.column_stack([np.eye(3), [0.0, -5.8e6, 0.0]]), tmp_path)
    with pytest.raises(UserError, match="from the origin, which is too far"):
        export(f"far.{suffix}", run=tmp_path, origin="world")


def arrays(path):
    """Attributes of the vertices of a GLB."""
    file, found = pygltflib.GLTF2().load(str(path)), {}
    for name, number in vars(file.meshes[0].primitives[0].attributes).items():
        if number is not None and name in ("NORMAL", "TANGENT"):
            accessor = file.accessors[number]
            view = file.bufferViews[accessor.bufferView]
            data = file.binary_blob()[view.byteOffset :][: view.byteLength]
            found[name] = np.frombuffer(data, np.float32).reshape(accessor.count, -1)
    return found


def test_nothing_moves_unasked(export, scene):
    (file,) = export("a.ply", faces=None)
    bounds = [
        scene.field.isosurface()[0].numpy().min(0),
        scene.field.isosurface()[0].numpy().max(0),
    ]
    np.testing.assert_allclose([vertices(file).min(0), vertices(file).max(0)], bounds, atol=1e-6)


def test_jpeg_textures(export):
    """What JPEG leaves is near what PNG holds, nearer at higher quality, and smaller."""
    (exact,) = export("exact.glb", texture_size=256)
    errors, sizes = [], [sum(size for _, size, _ in pictures(exact))]
    for quality in (95, 90, 30):
        (lossy,) = export("lossy.glb", texture_size=256, texture_format="jpeg", quality=quality)
        both = list(zip(pictures(exact), pictures(lossy), strict=True))
        assert all(
            kinds == ("image/png", "image/jpeg") for kinds in [(a[0], b[0]) for a, b in both]
        )
        errors.append([np.abs(a[2] - b[2]).mean() for a, b in both])
        sizes.append(sum(b[1] for _, b in both))
    assert sizes == sorted(sizes, reverse=True)
    # Steps of the tables at quality 90 are 3 to 24: a mean error of a step's quarter at most, 2 %
    assert max(errors[1]) < 4
    assert all((np.diff(errors, axis=0) >= 0).ravel())


def test_jpeg_textures_of_obj(export, tmp_path):
    export("a.obj", texture_format="jpeg")
    names = [f"a_{kind}.jpg" for kind in ("albedo", "normal", "roughness")]
    assert sorted(p.name for p in tmp_path.glob("a_*")) == names
    assert all((tmp_path / name).read_bytes().startswith(b"\xff\xd8\xff") for name in names)
    text = (tmp_path / "a.mtl").read_text()
    assert all(name in text for name in names)
    assert ".png" not in text
    mesh = trimesh.load(tmp_path / "a.obj", force="mesh")
    assert mesh.visual.material.image.size == (64, 64)


def test_levels_of_detail(export, tmp_path):
    """A quarter of the triangles each, half the texels a side, the same shape in the same place."""
    files = export("a.glb", faces=4000, texture_size=64, lods=3, size=2.0, origin="bottom")
    assert [f.name for f in files] == ["a.glb", "a_lod1.glb", "a_lod2.glb", "a_lod3.glb"]
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted(f.name for f in files)
    meshes = [trimesh.load(f, force="mesh") for f in files]
    counts = [len(mesh.faces) for mesh in meshes]
    for level, count in enumerate(counts):
        most = 4000 // 4**level
        assert 0.85 * most <= count <= most, counts
    assert [pictures(f)[0][2].shape[0] for f in files] == [64, 32, 16, 16]
    full = silhouette(meshes[0])
    for level, mesh in enumerate(meshes[1:], 1):
        now = silhouette(mesh)
        # Edges of a ball of F triangles sag by about (their length)^2 / 8 r, 1/F of its radius
        assert (now & full).sum() / (now | full).sum() > 1 - 20 / counts[level]
    assert len(np.unique([silhouette(m).sum() for m in meshes])) > 1


def silhouette(mesh):
    """What rays along -z of a file's axes meet, over the object's box: [K, K] bool."""
    scene = VisibilityScene(
        torch.tensor(np.asarray(mesh.vertices)).float(), torch.tensor(np.asarray(mesh.faces)).int()
    )
    line = torch.linspace(-1.2, 1.2, 400)
    x, y = torch.meshgrid(line, line + 1, indexing="xy")
    origin = torch.stack([x, y, torch.full_like(x, 5.0)], -1).reshape(-1, 3)
    direction = torch.tensor([0.0, 0.0, -1.0]).expand_as(origin).contiguous()
    return (scene.closest_hit(origin, direction).face >= 0).reshape(400, 400).numpy()


def test_levels_of_other_files(export, tmp_path):
    assert [f.name for f in export("a.ply", lods=1)] == ["a.ply", "a_lod1.ply"]
    export("b.obj", lods=1)
    assert "a_lod1" not in (tmp_path / "b.mtl").read_text()
    assert "b_lod1_albedo.png" in (tmp_path / "b_lod1.mtl").read_text()


def test_levels_need_triangles(export, monkeypatch, tmp_path):
    """Of the surface itself, too, where it has fewer than were allowed."""
    with pytest.raises(
        UserError, match=r"lods=8 with \d+ faces leaves 0 faces in the coarsest"
    ) as caught:
        export("a.ply", faces=None, lods=8)
    assert caught.value.arguments == ("lods",)
    assert not list(tmp_path.iterdir())


def test_watertight_levels(tmp_path, monkeypatch):
    cut = lopsided(24**3, change=lambda nodes, sdf: nodes.norm(dim=-1) - 0.55)
    monkeypatch.setattr("univoxel.scene.load_scene", lambda run: cut)
    for file in task.export("run", tmp_path / "a.ply", faces=800, watertight=True, lods=2):
        assert trimesh.load(file).is_watertight, file
