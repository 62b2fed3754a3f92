"""Charts, vertex frames and texels against constructions by hand."""

import hashlib
import math
import subprocess
import sys

import pytest
import torch

from univoxel.core.records import Mesh
from univoxel.ops.charts import corner_weights, rasterise, unwrap
from univoxel.output.mesh import dilated, vertex_normals, vertex_tangents
from univoxel.output.topology import clean, simplify

SQUARE = torch.tensor([[0, 1, 2], [0, 2, 3]], dtype=torch.int32)
CORNERS = torch.tensor([[0.0, 0], [1, 0], [1, 1], [0, 1]])


@pytest.fixture(scope="module")
def mesh(balls):
    return simplify(clean(Mesh(*balls.field.isosurface())), 1000)


def test_charts_keep_the_triangles_and_do_not_overlap(mesh, monkeypatch):
    size = 256
    source, faces, uv = unwrap(mesh, size)
    assert torch.equal(source[faces.long()], mesh.faces.long())
    assert ((uv >= 0) & (uv <= 1)).all()
    a, b, c = uv.double()[faces.long()].unbind(1)
    area = 0.5 * ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])
    assert (area > -1e-9).all()  # none mirrored
    texel, _, _ = rasterise(uv, faces, size)
    # The area in texels that triangles have is the number of texels they own, so none own the same;
    # one per cent for borders.
    assert len(texel) == pytest.approx(float(area.sum()) * size * size, rel=0.01)
    assert area.sum() > 0.4  # padding takes much of so small a texture
    with pytest.raises(ValueError, match="charts: Index out of range"):
        unwrap(Mesh(torch.eye(3), torch.tensor([[0, 1, 3]])), 64)
    monkeypatch.setattr("univoxel.ops.charts.REGION", 50)  # beyond which no chart goes
    assert len(unwrap(mesh, size)[0]) > 1.1 * len(source)  # more seams


def test_charts_are_those_that_the_package_xatlas_makes():
    """Of version 0.0.11, whose source is compiled in: on every processor the same."""
    n = 24
    i = torch.arange(n + 1).repeat_interleave(n + 1)
    x, y = 2 * i / n - 1, 2 * (torch.arange((n + 1) ** 2) - (n + 1) * i) / n - 1
    k = torch.arange(n).repeat_interleave(n) * (n + 1) + torch.arange(n).repeat(n)
    faces = [torch.stack([k, k + n + 1, k + n + 2], 1), torch.stack([k, k + n + 2, k + 1], 1)]
    saddle = Mesh(torch.stack([x, y, 2 * x**3 - y * y], 1), torch.cat(faces).int())
    source, faces, uv = unwrap(saddle, 256)
    digest = hashlib.sha256(source.numpy().tobytes() + faces.numpy().tobytes()).hexdigest()
    assert digest == "46ca99708000f739301391fda1c223a28c0dcc37085f715cc178760167dfc7e1"
    assert len(source) == 700
    corners = [[0.7366594, 0.3600158], [0.0017031, 0.6864952], [0.1306851, 0.6725426]]
    torch.testing.assert_close(uv[[0, 300, -1]], torch.tensor(corners), rtol=0, atol=1e-5)


# Many short searches; each begins threads and waits for them to end
SEARCHES = """
import torch
from univoxel.core.records import Mesh
from univoxel.ops.charts import corner_weights, rasterise, unwrap
faces = torch.tensor([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
mesh = Mesh(torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]), faces)
for _ in range(2000):
    unwrap(mesh, 64)
"""


def test_every_search_for_charts_ends_on_a_busy_machine():
    """Threads that missed that they should end kept 2 to 5 of 6 such processes forever."""
    searches = [subprocess.Popen([sys.executable, "-c", SEARCHES]) for _ in range(6)]
    try:
        assert [search.wait(300) for search in searches] == [0] * 6
    finally:
        for search in searches:
            search.kill()


def test_normals_of_a_cube_point_along_its_diagonals():
    trimesh = pytest.importorskip("trimesh")
    box = trimesh.creation.box()
    normals = vertex_normals(
        Mesh(torch.tensor(box.vertices).float(), torch.tensor(box.faces).int())
    )
    # Weighing by angle, not by face, makes it independent of the diagonals of the squares.
    expected = torch.tensor(box.vertices).float().sign() / math.sqrt(3)
    torch.testing.assert_close(normals, expected, rtol=0, atol=1e-6)


@pytest.mark.parametrize("mirrored", [False, True])
def test_tangents_of_a_turned_square(mirrored):
    turn, _ = torch.linalg.qr(torch.tensor([[1.0, 2, 0], [0, 1, 3], [2, 0, 1]]))
    turn = turn * turn.det().sign()
    u, v, n = turn.T
    flat = CORNERS * 2 - 1
    vertices = flat[:, :1] * u + flat[:, 1:] * v
    uv = torch.stack([1 - CORNERS[:, 0], CORNERS[:, 1]], 1) if mirrored else CORNERS
    tangents = vertex_tangents(vertices, SQUARE, n.expand(4, 3), uv)
    torch.testing.assert_close(tangents[:, :3], (-u if mirrored else u).expand(4, 3))
    assert (tangents[:, 3] == (-1 if mirrored else 1)).all()
    # +y of the frame is +v in either case
    b = tangents[:, 3:] * torch.linalg.cross(n.expand(4, 3), tangents[:, :3])
    torch.testing.assert_close(b, v.expand(4, 3))
    # A face without texture still has a frame
    normal = torch.tensor([0.0, 0, 1]).expand(4, 3)
    corners = torch.cat([CORNERS, torch.zeros(4, 1)], 1)
    tangents = vertex_tangents(corners, SQUARE, normal, torch.full((4, 2), 0.5))
    torch.testing.assert_close(tangents[:, :3].norm(dim=1), torch.ones(4))
    assert (tangents[:, 2] == 0).all()
    assert (tangents[:, 3] == 1).all()


def test_tangents_are_a_frame_on_a_curved_mesh(mesh):
    source, faces, uv = unwrap(mesh, 256)
    normals = vertex_normals(mesh)[source]
    tangents = vertex_tangents(mesh.vertices[source], faces, normals, uv)
    torch.testing.assert_close(tangents[:, :3].norm(dim=1), torch.ones(len(uv)))
    assert (tangents[:, :3] * normals).sum(1).abs().max() < 1e-5
    # Along a triangle's edges the texture's u grows as they go along its corners' tangents.
    corner, flat = mesh.vertices[source][faces.long()], uv[faces.long()]
    edge, du = corner[:, 1] - corner[:, 0], (flat[:, 1] - flat[:, 0])
    cosine = torch.nn.functional.cosine_similarity(edge, tangents[faces[:, 0].long(), :3])
    steep = (du[:, 0].abs() > 3 * du[:, 1].abs()) & (du[:, 0].abs() > 0.01)
    assert steep.sum() > 30
    assert (cosine.sign() == du[:, 0].sign())[steep].float().mean() > 0.99


def test_texels_of_a_square(monkeypatch):
    monkeypatch.setattr("univoxel.ops.charts.AT_ONCE", 100)  # several chunks
    size = 16
    uv = torch.cat([CORNERS * 0.5, CORNERS * 0.5 + 0.5])  # lower left and upper right quarter
    faces = torch.cat([SQUARE, SQUARE + 4])
    texel, face, barycentric = rasterise(uv, faces, size)
    weight = corner_weights(barycentric)
    row, column = texel // size, texel % size
    expected = torch.zeros(size, size, dtype=torch.bool)
    expected[8:, :8] = expected[:8, 8:] = True
    assert torch.equal(texel, expected.reshape(-1).nonzero()[:, 0])
    point = torch.einsum("kc,kcd->kd", weight, uv[faces[face].long()])
    torch.testing.assert_close(point[:, 0], (column + 0.5) / size)
    torch.testing.assert_close(point[:, 1], 1 - (row + 0.5) / size)
    assert (weight >= -1e-6).all()
    # Thin triangles and those between the middles of texels hold none
    thin = [[0.1, 0.1], [0.9, 0.1], [0.5, 0.1], [0.26, 0.26], [0.27, 0.26], [0.26, 0.27]]
    assert len(rasterise(torch.tensor(thin), torch.arange(6).int().view(2, 3), 4)[0]) == 0


def test_the_background_takes_the_nearest_texel():
    size = 5
    place = dilated(torch.tensor([0, 24]), size)  # two opposite corners
    row, column = torch.meshgrid(torch.arange(5), torch.arange(5), indexing="ij")
    assert (place[row + column < 4] == 0).all()
    assert (place[row + column > 4] == 1).all()
