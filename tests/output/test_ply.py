"""PLY files, read back by an independent reader."""

import pytest
import torch

from univoxel.color import linear_to_srgb
from univoxel.core.records import Mesh
from univoxel.output.mesh_files import write_ply

trimesh = pytest.importorskip("trimesh")

MESH = Mesh(
    torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]),
    torch.tensor([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], dtype=torch.int32),
    torch.nn.functional.normalize(torch.tensor([[-1.0, -1, -1], [1, 0, 0], [0, 1, 0], [0, 0, 1]])),
    torch.tensor([[0.0, 0.2, 1.0], [0.5, 0.5, 0.5], [1, 0, 0], [0, 0, 1]]),
    torch.tensor([0.1, 0.4, 0.6, 1.0]),
)


def test_round_trip(tmp_path):
    write_ply(tmp_path / "a.ply", MESH)
    back = trimesh.load(tmp_path / "a.ply", process=False)
    assert torch.equal(torch.tensor(back.vertices).float(), MESH.vertices)
    assert torch.equal(torch.tensor(back.faces).int(), MESH.faces)
    torch.testing.assert_close(torch.tensor(back.vertex_normals).float(), MESH.normals)
    color = torch.tensor(back.visual.vertex_colors[:, :3])
    assert torch.equal(color, (linear_to_srgb(MESH.albedo) * 255).round().byte())
    stored = back.metadata["_ply_raw"]["vertex"]["data"]["roughness"]
    torch.testing.assert_close(torch.tensor(stored.ravel().tolist()), MESH.roughness)
    assert back.is_watertight
    assert [p.name for p in tmp_path.iterdir()] == ["a.ply"]


def test_bare_and_empty_meshes(tmp_path):
    write_ply(tmp_path / "bare.ply", Mesh(MESH.vertices, MESH.faces))
    assert trimesh.load(tmp_path / "bare.ply", process=False).vertices.shape == (4, 3)
    write_ply(tmp_path / "empty.ply", Mesh(torch.empty(0, 3), torch.empty(0, 3).int()))
    assert b"element face 0\n" in (tmp_path / "empty.ply").read_bytes()


def test_a_file_that_cannot_be_written(tmp_path):
    with pytest.raises(OSError, match=r"a\.ply"):
        write_ply(tmp_path / "missing" / "a.ply", MESH)
