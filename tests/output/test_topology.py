"""Which triangles stay: cleaned, closed, decimated; watched by trimesh."""

import pytest
import torch
from asymmetric_scene import lopsided

from univoxel.core.records import Mesh
from univoxel.output.topology import clean, close, open_edges, simplify

trimesh = pytest.importorskip("trimesh")

TETRAHEDRON = torch.tensor([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], dtype=torch.int32)
CORNERS = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])


def read(mesh):
    return trimesh.Trimesh(mesh.vertices.double().numpy(), mesh.faces.numpy(), process=False)


def test_floaters_and_voids_go_and_what_is_large_stays():
    def change(nodes, sdf):
        void = 0.2 - (nodes - torch.tensor([-0.05, 0.0, 0.0])).norm(dim=-1)
        speck = (nodes - torch.tensor([-0.4, -0.4, -0.4])).norm(dim=-1) - 0.04
        second = (nodes - torch.tensor([0.4, -0.3, 0.45])).norm(dim=-1) - 0.15
        return torch.maximum(sdf, void).minimum(speck).minimum(second)

    vertices, faces = lopsided(change=change).field.isosurface()
    assert len(read(Mesh(vertices, faces)).split(only_watertight=False)) == 4
    kept = read(clean(Mesh(vertices, faces))).split()
    assert len(kept) == 2
    assert all(part.volume > 0 for part in kept)
    assert min(part.bounds[0][0] for part in kept) > -0.42  # the speck is gone


def test_degenerate_and_double_faces_go_without_a_crack():
    ball = trimesh.creation.icosphere(2)
    vertices = torch.tensor(ball.vertices).float()
    faces = torch.tensor(ball.faces).int()
    # Corners of the first ten faces get vertices of their own, a hair away: cracks to be welded.
    own = vertices[faces[:10].long()].reshape(-1, 3) * (1 + 1e-7)
    split = torch.arange(30).reshape(10, 3).int() + len(vertices)
    fin = torch.tensor([[0, 5, 50], [5, 0, 50], [7, 7, 9]], dtype=torch.int32)
    messy = Mesh(torch.cat([vertices, own]), torch.cat([split, faces[10:], faces[20:22], fin]))
    assert open_edges(messy) > 0
    tidy = clean(messy)
    assert read(tidy).is_watertight
    assert len(tidy.faces) == len(ball.faces)
    assert len(tidy.vertices) == len(ball.vertices)
    assert read(tidy).volume == pytest.approx(ball.volume, rel=1e-5)


def test_simplify_keeps_shape_and_closure(balls):
    mesh = clean(Mesh(*balls.field.isosurface()))
    small = simplify(mesh, 800)
    assert 700 <= len(small.faces) <= 800
    assert read(small).is_watertight
    assert read(small).area_faces.min() > 0
    assert read(small).volume == pytest.approx(read(mesh).volume, rel=0.01)
    assert len(simplify(mesh, 10**9).faces) == len(mesh.faces)


def test_holes_are_closed():
    ball = trimesh.creation.icosphere(3)
    middles = torch.tensor(ball.triangles_center)
    # A large hole, a small one, and two that touch in a vertex.
    hole = (middles[:, 2] > 0.7) | (middles[:, 2] < -0.98)
    pair = torch.tensor(ball.vertex_faces[torch.tensor(ball.vertices)[:, 0].argmax()])
    pair = pair[pair >= 0]
    hole[pair[0]] = hole[pair[len(pair) // 2]] = True
    opened = Mesh(torch.tensor(ball.vertices).float(), torch.tensor(ball.faces).int()[~hole])
    assert open_edges(opened) > 0
    closed = close(opened)
    assert open_edges(closed) == 0
    assert read(closed).is_watertight
    assert read(closed).is_winding_consistent
    # The cap above z = 0.7 is cut flat: pi h^2 (3 - h) / 3 with h = 0.3 is 0.25
    assert read(closed).volume == pytest.approx(ball.volume - 0.25, abs=0.05)


def test_what_cannot_be_closed_is_reported():
    edge = torch.tensor([[0, 1, 4], [1, 0, 4], [0, 1, 4]], dtype=torch.int32)
    places = torch.cat([CORNERS, CORNERS[1:2] + 1])
    with pytest.raises(ValueError, match=r"cannot be closed: \d+ edges do not join"):
        close(Mesh(places, torch.cat([TETRAHEDRON, edge])))
    for mesh in (
        Mesh(CORNERS, TETRAHEDRON.flip(1)),  # inside out
        Mesh(torch.empty(0, 3), torch.empty(0, 3).int()),
        Mesh(CORNERS, torch.tensor([[0, 0, 1]]).int()),
    ):
        with pytest.raises(ValueError, match="no part that encloses a volume"):
            clean(mesh)
