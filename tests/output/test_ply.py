"""PLY files: read back by an independent reader and by ours, and what is none."""

import pytest
import torch

from univoxel.color import linear_to_srgb
from univoxel.core.records import Mesh
from univoxel.data.truth import read_ply
from univoxel.errors import DataError
from univoxel.output.mesh_files import write_ply

trimesh = pytest.importorskip("trimesh")

MESH = Mesh(
    torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]),
    torch.tensor([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], dtype=torch.int32),
    torch.nn.functional.normalize(torch.tensor([[-1.0, -1, -1], [1, 0, 0], [0, 1, 0], [0, 0, 1]])),
    torch.tensor([[0.0, 0.2, 1.0], [0.5, 0.5, 0.5], [1, 0, 0], [0, 0, 1]]),
    torch.tensor([0.1, 0.4, 0.6, 1.0]),
)


def test_what_is_written_is_read(tmp_path):
    path = tmp_path / "a.ply"
    for mesh in (Mesh(MESH.vertices, MESH.faces), Mesh(MESH.vertices[:0], MESH.faces[:0]), MESH):
        write_ply(path, mesh)
        read = read_ply(path)
        assert torch.equal(read.vertices, mesh.vertices)
        assert torch.equal(read.faces, mesh.faces)
    back = trimesh.load(path, process=False)
    assert torch.equal(torch.tensor(back.vertices).float(), MESH.vertices)
    assert torch.equal(torch.tensor(back.faces).int(), MESH.faces)
    torch.testing.assert_close(torch.tensor(back.vertex_normals).float(), MESH.normals)
    color = torch.tensor(back.visual.vertex_colors[:, :3])
    assert torch.equal(color, (linear_to_srgb(MESH.albedo) * 255).round().byte())
    stored = back.metadata["_ply_raw"]["vertex"]["data"]["roughness"]
    torch.testing.assert_close(torch.tensor(stored.ravel().tolist()), MESH.roughness)
    assert back.is_watertight
    assert [p.name for p in tmp_path.iterdir()] == ["a.ply"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda data: b"solid" + data, "expected a binary little-endian PLY file"),
        (lambda data: data.replace(b"binary_little_endian", b"ascii"), "little-endian PLY file"),
        (lambda data: data.replace(b"end_header", b"end"), "little-endian PLY file"),
        (lambda data: data[:-5], "expected vertices x y z and triangles"),
        (lambda data: data.replace(b"float z", b"float w"), "expected vertices x y z"),
        (lambda data: data.replace(b"float z", b"half z"), "expected vertices x y z"),
        (lambda data: data.replace(b"element face", b"element edge"), "expected vertices x y z"),
        (lambda data: data.replace(b"vertex 4", b"vertex -1"), "could not read them: -1 of vertex"),
        (lambda data: data.replace(b"face 2", b"face 9" + 30 * b"9"), "expected vertices x y z"),
        (lambda data: data[:-12] + b"\x63" + data[-11:], "triangles with vertex indices below 4"),
        (lambda data: data[:-13] + b"\4" + data[-12:], "triangles with vertex indices below 4"),
    ],
)
def test_other_files_are_refused(tmp_path, change, message):
    path = tmp_path / "a.ply"
    write_ply(path, Mesh(MESH.vertices, MESH.faces[:2]))
    path.write_bytes(change(path.read_bytes()))
    with pytest.raises(DataError, match=f"a.ply: .*{message}"):
        read_ply(path)


def test_what_cannot_be_read_or_written(tmp_path):
    path = tmp_path / "a.ply"
    with pytest.raises(DataError, match=r"a\.ply: cannot be read: No such file"):
        read_ply(path)
    write_ply(path, Mesh(MESH.vertices / torch.tensor([1.0, 0, 1]), MESH.faces))
    with pytest.raises(DataError, match=r"a\.ply: expected finite vertices"):
        read_ply(path)
    with pytest.raises(OSError, match=r"a\.ply"):
        write_ply(tmp_path / "missing" / "a.ply", MESH)
