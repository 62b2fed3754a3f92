"""A scene as files that other programs read: same shape, same place, same look."""

import json
import shutil
import subprocess
from typing import Any

import numpy as np
import pytest
import torch
from asymmetric_scene import BALLS, albedo, lopsided, roughness, sdf
from glb import Glb
from PIL import Image
from scipy.spatial.transform import Rotation

from univoxel.cli import export as task
from univoxel.errors import UserError
from univoxel.ops import VisibilityScene
from univoxel.run import save_world

trimesh = pytest.importorskip("trimesh")
pytest.importorskip("pygltflib")

SIZE = 256
FACES = 2000
# Colours are stored in 8 bits of sRGB, whose slope in linear is 2.3 at most: 0.5 / 255 * 2.3, and
# as much again for what a texel's width changes and for the way to the surface.
COLOR = 0.01


def decoded(srgb):
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def looked_up(picture, x, y):
    """Bilinear value at texture coordinates, x to the right, y downwards, as renderers do."""
    picture = np.atleast_3d(np.asarray(picture, float))
    height, width = picture.shape[:2]
    x, y = x * width - 0.5, y * height - 0.5
    i, j = np.floor(x).astype(int), np.floor(y).astype(int)
    fx, fy = (x - i)[:, None], (y - j)[:, None]
    (i0, i1), (j0, j1) = (
        (k.clip(0, n - 1), (k + 1).clip(0, n - 1)) for k, n in ((i, width), (j, height))
    )
    top = (1 - fx) * picture[j0, i0] + fx * picture[j0, i1]
    bottom = (1 - fx) * picture[j1, i0] + fx * picture[j1, i1]
    return (1 - fy) * top + fy * bottom


def surface_of_balls(points):
    """The nearest point of the nearest ball, and its distance to the next ball."""
    offsets = points[:, None] - BALLS[:, :3]
    distances = offsets.norm(dim=2) - BALLS[:, 3]
    ball = distances.argmin(1)
    normal = torch.nn.functional.normalize(offsets[torch.arange(len(points)), ball], dim=1)
    near, next_one = distances.sort(1).values[:, :2].unbind(1)
    return BALLS[ball, :3] + BALLS[ball, 3:] * normal, normal, next_one - near


@pytest.fixture(scope="module")
def written(balls, tmp_path_factory):
    """The scene in each format."""
    folder = tmp_path_factory.mktemp("out")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("univoxel.scene.load_scene", lambda run: {"run": balls}[str(run)])
        for name in ("a.glb", "a.obj", "a.ply"):
            task.export("run", folder / "deep" / name, faces=FACES, texture_size=SIZE)
    return folder / "deep"


def check_materials(position, color, rough, tolerance=COLOR):
    on, _, gap = surface_of_balls(torch.tensor(position).float())
    clear = (gap > 0.06).numpy()  # the crease between two balls is rounded by the grid
    assert clear.mean() > 0.7
    np.testing.assert_allclose(color[clear], albedo(on).numpy()[clear], rtol=0, atol=tolerance)
    np.testing.assert_allclose(rough[clear], roughness(on).numpy()[clear], rtol=0, atol=tolerance)


def test_only_the_files_that_are_asked_for(written):
    pictures = [f"a_{kind}.png" for kind in ("albedo", "normal", "roughness")]
    assert sorted(p.name for p in written.iterdir()) == sorted(
        ["a.glb", "a.obj", "a.mtl", "a.ply", *pictures]
    )


def test_glb(written):
    file = Glb(written / "a.glb")
    names = ("POSITION", "NORMAL", "TANGENT", "TEXCOORD_0")
    corners = [file.values(name)[file.values("faces")] for name in names]
    assert ((corners[3] >= 0) & (corners[3] <= 1)).all()
    np.testing.assert_allclose(np.linalg.norm(corners[1], axis=2), 1, atol=1e-5)
    # The middle of each face as a renderer shades it
    position, normal, tangent, uv = (c.mean(1) for c in corners)
    pictures = [picture for _, _, picture in file.pictures()]
    assert {kind for kind, _, _ in file.pictures()} == {"image/png"}
    assert {picture.shape for picture in pictures} == {(SIZE, SIZE, 3)}
    material = file.file.materials[0]
    assert material.pbrMetallicRoughness.metallicFactor == 0
    texel = [
        looked_up(pictures[slot.index] / 255, *uv.T)
        for slot in (
            material.pbrMetallicRoughness.baseColorTexture,
            material.pbrMetallicRoughness.metallicRoughnessTexture,
            material.normalTexture,
        )
    ]
    assert (texel[1][:, 2] == 0).all()

    def to_world(v):  # glTF has +Y up: what is up is our +Z, what comes nearer our -Y
        return np.stack([v[:, 0], -v[:, 2], v[:, 1]], 1)

    check_materials(to_world(position), decoded(texel[0]), texel[1][:, 1])
    local = 2 * texel[2] - 1
    b = tangent[:, 3:] * np.cross(normal, tangent[:, :3])
    shaded = local[:, :1] * tangent[:, :3] + local[:, 1:2] * b + local[:, 2:] * normal
    shaded = torch.tensor(to_world(shaded)).float()
    _, true, gap = surface_of_balls(torch.tensor(to_world(position)).float())
    error = torch.rad2deg(torch.nn.functional.cosine_similarity(shaded, true).clamp(-1, 1).acos())
    error = error[gap > 0.06]
    # 8 bits are worth 0.4 degrees, the field's gradient as much again; slivers without a
    # texel of their own see their neighbours' frame.
    assert error.median() < 0.5
    assert error.quantile(0.99) < 1.6


def test_other_readers_see_the_object_where_it_is(written):
    inside = trimesh.load(written / "a.glb", force="mesh")
    upright = inside.vertices @ np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    for name, vertices in (("a.glb", upright), ("a.obj", None), ("a.ply", None)):
        mesh = trimesh.load(written / name, force="mesh")
        mesh.merge_vertices(merge_tex=True, merge_norm=True)
        assert mesh.is_watertight, name
        assert mesh.volume > 0, name
        assert len(mesh.faces) <= FACES
        assert mesh.area_faces.min() > 0
        vertices = mesh.vertices if vertices is None else vertices
        # On the surface of an object without symmetry; decimated triangles sag by less than a voxel
        distance = sdf(torch.tensor(vertices).float())
        assert distance.abs().max() < 0.024, name


def test_obj(written):
    mesh = trimesh.load(written / "a.obj", force="mesh", process=False)
    position = mesh.triangles_center
    x, y = mesh.visual.uv[mesh.faces].mean(1).T
    picture = {
        kind: np.asarray(Image.open(written / f"a_{kind}.png")) / 255
        for kind in ("albedo", "normal", "roughness")
    }
    color = decoded(looked_up(picture["albedo"], x, 1 - y))  # OBJ counts v upwards
    check_materials(position, color, looked_up(picture["roughness"], x, 1 - y)[:, 0])
    assert np.array_equal(
        np.asarray(mesh.visual.material.image), np.uint8(255 * picture["albedo"] + 0.5)
    )
    assert looked_up(picture["normal"], x, 1 - y)[:, 2].min() > 0.5
    text = (written / "a.mtl").read_text()
    for kind in picture:
        assert f"a_{kind}.png" in text


def test_ply(written):
    mesh = trimesh.load(written / "a.ply", process=False)
    rough = mesh.metadata["_ply_raw"]["vertex"]["data"]["roughness"].ravel()
    color = decoded(mesh.visual.vertex_colors[:, :3] / 255)
    check_materials(mesh.vertices, color, rough)


def test_the_validator_of_khronos_has_nothing_to_say(written):
    """Needs node and its module gltf-validator (npm install gltf-validator; NODE_PATH)."""
    program = """
        const read = require('fs').readFileSync;
        require('gltf-validator').validateBytes(new Uint8Array(read(process.argv[1])))
            .then(report => console.log(JSON.stringify(report.issues)));
    """
    node = shutil.which("node")
    if (
        not node
        or subprocess.run([node, "-e", "require('gltf-validator')"], capture_output=True).returncode
    ):
        pytest.skip("no gltf-validator")
    run = subprocess.run(
        [node, "-e", program, str(written / "a.glb")], capture_output=True, text=True, check=True
    )
    assert json.loads(run.stdout)["messages"] == []


def test_defaults(tmp_path, balls, monkeypatch):
    """All faces without textures, fewer with; the same shape."""
    monkeypatch.setattr("univoxel.scene.load_scene", lambda run: balls)
    monkeypatch.setattr(task, "TEXTURED_FACES", 500)
    task.export("run", tmp_path / "a.PLY")
    task.export("run", tmp_path / "a.glb", texture_size=64)
    full = trimesh.load(tmp_path / "a.PLY", process=False)
    assert len(full.faces) > 5000
    assert 400 < len(trimesh.load(tmp_path / "a.glb", force="mesh").faces) <= 500


def test_what_the_box_cuts_is_closed(tmp_path, monkeypatch):
    """Unasked, and with colours of the surface beside the cap."""
    middle = torch.tensor([-0.5, 0.0, 0.075])
    cut = lopsided(32**3, change=lambda nodes, sdf: (nodes - middle).norm(dim=-1) - 0.4)
    monkeypatch.setattr("univoxel.scene.load_scene", lambda run: cut)
    with torch.no_grad():  # as of a finished scene: nothing is stored away from the surface
        cut.field.features[cut.field.sdf.abs() > 2.5 * cut.field.voxel_size] = 0
    task.export("run", tmp_path / "a.ply")
    task.export("run", tmp_path / "b.ply", faces=400, watertight=True)
    mesh, small = (trimesh.load(tmp_path / name, process=False) for name in ("a.ply", "b.ply"))
    assert mesh.is_watertight
    assert small.is_watertight
    border = float(cut.field.bounds()[0][0])
    beyond = mesh.vertices[:, 0] < border - 1e-6
    assert beyond.sum() > 200
    assert mesh.vertices[:, 0].min() > border - cut.field.voxel_size
    black = mesh.visual.vertex_colors[:, :3].max(1) == 0
    assert not black[beyond].any()


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("a.stl", {}, r"ends in \.glb, \.obj, \.ply, \.usdz, got .*a\.stl"),
        ("a.ply", {"faces": 3}, "faces must be at least 4, got 3"),
        ("a.glb", {"texture_size": 1000}, "power of 2 from 16 to 4096, got 1000"),
        ("a.glb", {"texture_size": 8}, "power of 2 from 16 to 4096, got 8"),
        ("a.glb", {"texture_size": -64}, "got -64"),
        ("a.glb", {"texture_format": "webp"}, "texture_format must be png or jpeg, got webp"),
        ("a.glb", {"quality": 96}, "quality must be from 1 to 95, got 96"),
        ("a.glb", {"size": 0.0}, "size must be above 0, got 0"),
        ("a.glb", {"size": float("nan")}, "size must be above 0, got nan"),
        (
            "a.glb",
            {"origin": "top"},
            "origin must be upright or world or bottom or centre, got top",
        ),
        ("a.glb", {"lods": -1}, "lods must be from 0 to 8, got -1"),
        ("a.glb", {"lods": 9}, "lods must be from 0 to 8, got 9"),
        ("a.glb", {"lods": 3, "faces": 2000}, "lods=3 with 2000 faces leaves 31 faces in the c"),
    ],
)
def test_bad_arguments(tmp_path, name, options, message):
    with pytest.raises(ValueError, match=message):
        task.export(tmp_path, tmp_path / name, **options)


def test_errors_leave_nothing_behind(tmp_path, balls, monkeypatch):
    with pytest.raises(FileNotFoundError, match="not a trained run"):
        task.export(tmp_path, tmp_path / "mesh.ply")
    monkeypatch.setattr("univoxel.scene.load_scene", lambda run: balls)
    with pytest.raises(ValueError, match="without spaces"):
        task.export("run", tmp_path / "a b.obj", faces=100, texture_size=64)
    (tmp_path / "a.glb").mkdir()
    with pytest.raises(OSError, match=r"a\.glb"):
        task.export("run", tmp_path / "a.glb", faces=100, texture_size=64)
    assert [p.name for p in tmp_path.iterdir()] == ["a.glb"]


# Size, origin, levels of detail and JPEG textures

UPRIGHT = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # rows of glTF times this: our world


@pytest.fixture
def export(tmp_path, balls, monkeypatch):
    monkeypatch.setattr("univoxel.scene.load_scene", lambda run: balls)

    def write(name, run="run", **options):
        chosen: dict[str, Any] = {"texture_size": 64, "faces": 500} | options
        return task.export(run, tmp_path / name, **chosen)

    return write


def vertices(path):
    mesh = trimesh.load(path, force="mesh", process=False)
    return mesh.vertices @ UPRIGHT if path.suffix == ".glb" else np.asarray(mesh.vertices)


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
        for name in ("NORMAL", "TANGENT"):
            old, new = (Glb(path).values(name)[:, :3] @ UPRIGHT for path in (plain, world))
            np.testing.assert_allclose(new, turn.inv().apply(old), atol=2e-6)
    save_world(np.column_stack([np.eye(3), [0.0, -5.8e6, 0.0]]), tmp_path)
    with pytest.raises(UserError, match="from the origin, which is too far"):
        export(f"far.{suffix}", run=tmp_path, origin="world")


def test_nothing_moves_unasked(export, balls):
    (file,) = export("a.ply", faces=None)
    found, wanted = vertices(file), balls.field.isosurface()[0].numpy()
    bounds = [wanted.min(0), wanted.max(0)]
    np.testing.assert_allclose([found.min(0), found.max(0)], bounds, atol=1e-6)


def test_jpeg_textures(export, tmp_path):
    """What JPEG leaves is near what PNG holds, nearer at higher quality, and smaller."""
    exact = Glb(*export("exact.glb", texture_size=256)).pictures()
    errors, sizes = [], [sum(size for _, size, _ in exact)]
    for quality in (95, 90, 30):
        lossy = export("lossy.glb", texture_size=256, texture_format="jpeg", quality=quality)
        both = list(zip(exact, Glb(*lossy).pictures(), strict=True))
        assert {(a[0], b[0]) for a, b in both} == {("image/png", "image/jpeg")}
        errors.append([np.abs(a[2] - b[2]).mean() for a, b in both])
        sizes.append(sum(b[1] for _, b in both))
    assert sizes == sorted(sizes, reverse=True)
    # Steps of the tables at quality 90 are 3 to 24: a mean error of a step's quarter at most, 2 %
    assert max(errors[1]) < 4
    assert all((np.diff(errors, axis=0) >= 0).ravel())
    export("a.obj", texture_format="jpeg")
    names = [f"a_{kind}.jpg" for kind in ("albedo", "normal", "roughness")]
    assert sorted(p.name for p in tmp_path.glob("a_*")) == names
    assert all((tmp_path / name).read_bytes().startswith(b"\xff\xd8\xff") for name in names)
    text = (tmp_path / "a.mtl").read_text()
    assert all(name in text for name in names)
    assert ".png" not in text


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
    assert [len(Glb(f).pictures()[0][2]) for f in files] == [64, 32, 16, 16]
    full = silhouette(meshes[0])
    for level, mesh in enumerate(meshes[1:], 1):
        now = silhouette(mesh)
        # Edges of a ball of F triangles sag by about (their length)^2 / 8 r, 1/F of its radius
        assert (now & full).sum() / (now | full).sum() > 1 - 20 / counts[level]
    assert len(np.unique([silhouette(m).sum() for m in meshes])) > 1
    assert [f.name for f in export("b.ply", lods=1)] == ["b.ply", "b_lod1.ply"]
    export("c.obj", lods=1)
    assert "c_lod1" not in (tmp_path / "c.mtl").read_text()
    assert "c_lod1_albedo.png" in (tmp_path / "c_lod1.mtl").read_text()


def silhouette(mesh):
    """What rays along -z of a file's axes meet, over the object's box: [K, K] bool."""
    places, faces = (torch.tensor(np.asarray(x)) for x in (mesh.vertices, mesh.faces))
    scene = VisibilityScene(places.float(), faces.int())
    line = torch.linspace(-1.2, 1.2, 400)
    x, y = torch.meshgrid(line, line + 1, indexing="xy")
    origin = torch.stack([x, y, torch.full_like(x, 5.0)], -1).reshape(-1, 3)
    direction = torch.tensor([0.0, 0.0, -1.0]).expand_as(origin).contiguous()
    return (scene.closest_hit(origin, direction).face >= 0).reshape(400, 400).numpy()


def test_levels_need_triangles(export, tmp_path):
    """Of the surface itself, too, where it has fewer than were allowed."""
    said = r"lods=8 with \d+ faces leaves 0 faces in the coarsest"
    with pytest.raises(UserError, match=said) as caught:
        export("a.ply", faces=None, lods=8)
    assert caught.value.arguments == ("lods",)
    assert not list(tmp_path.iterdir())


def test_watertight_levels(tmp_path, monkeypatch):
    cut = lopsided(24**3, change=lambda nodes, sdf: nodes.norm(dim=-1) - 0.55)
    monkeypatch.setattr("univoxel.scene.load_scene", lambda run: cut)
    for file in task.export("run", tmp_path / "a.ply", faces=800, watertight=True, lods=2):
        assert trimesh.load(file).is_watertight, file
