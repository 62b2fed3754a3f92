"""Triangle meshes from PLY files."""

import pytest
import torch

from univoxel.core.records import Mesh
from univoxel.data.truth import read_ply
from univoxel.errors import DataError
from univoxel.output.mesh_files import write_ply

VERTICES = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3]])
FACES = torch.tensor([[0, 1, 2], [0, 2, 3]], dtype=torch.int32)


def test_what_is_written_is_read(tmp_path):
    path = tmp_path / "mesh.ply"
    albedo, roughness = torch.rand(4, 3), torch.rand(4)
    for mesh in (
        Mesh(VERTICES, FACES),
        Mesh(VERTICES, FACES, VERTICES, albedo, roughness),
        Mesh(VERTICES[:0], FACES[:0]),
    ):
        write_ply(path, mesh)
        read = read_ply(path)
        assert torch.equal(read.vertices, mesh.vertices)
        assert torch.equal(read.faces, mesh.faces)


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
    path = tmp_path / "mesh.ply"
    write_ply(path, Mesh(VERTICES, FACES))
    path.write_bytes(change(path.read_bytes()))
    with pytest.raises(DataError, match=f"mesh.ply: .*{message}"):
        read_ply(path)


def test_places_that_are_not_finite_are_refused(tmp_path):
    path = tmp_path / "mesh.ply"
    write_ply(path, Mesh(VERTICES / torch.tensor([1.0, 0, 1]), FACES))
    with pytest.raises(DataError, match=r"mesh.ply: expected finite vertices"):
        read_ply(path)


def test_a_missing_file(tmp_path):
    with pytest.raises(DataError, match=r"mesh.ply: cannot be read: No such file"):
        read_ply(tmp_path / "mesh.ply")
