"""Rays against triangles: Embree against brute force, closed forms."""

import math
from types import SimpleNamespace

import pytest
import torch
from op_cases import soup, through_triangles

from univoxel import ops

TRIANGLE = torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
FACE = torch.tensor([[0, 1, 2]], dtype=torch.int32)


def rays(n=2000):
    return tuple(through_triangles(n).values())


@pytest.mark.parametrize("interval", [(0.0, math.inf), (0.1, 0.4)])
def test_native_equals_brute_force(interval):
    scene = ops.VisibilityScene(*soup(200))
    got, wanted = (
        scene.closest_hit(*rays(), *interval),
        ops.closest_hit_reference(*soup(200), *rays(), *interval),
    )
    assert 0.1 < (wanted.face >= 0).float().mean() < 0.95
    # Rays that graze an edge or the ends of the interval may fall on either side in float32.
    same = got.face == wanted.face
    assert same.float().mean() > 0.999
    torch.testing.assert_close(got.t[same], wanted.t[same], rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(got.barycentric[same], wanted.barycentric[same], rtol=0, atol=1e-3)
    occluded = scene.occluded(*rays(), *interval)
    assert occluded.dtype == torch.bool
    assert (occluded == (wanted.face >= 0)).float().mean() > 0.999


def test_one_triangle_in_closed_form():
    """The ray from above (x, y) meets the triangle at (u, v) = (x, y)."""
    origin = torch.tensor([[0.2, 0.3, 2.0], [0.7, 0.7, 2.0], [0.2, 0.3, -1.0]])
    down = torch.tensor([[0.0, 0.0, -1.0]]).expand(3, 3)
    hit = ops.VisibilityScene(TRIANGLE, FACE).closest_hit(origin, down)
    assert hit.face.tolist() == [0, -1, -1]
    assert hit.t.tolist() == pytest.approx([2.0, math.inf, math.inf])
    assert hit.barycentric[0].tolist() == pytest.approx([0.2, 0.3])
    assert hit.barycentric[1:].eq(0).all()
    # Distances count in the length of the direction
    scene = ops.VisibilityScene(TRIANGLE, FACE)
    origin, down = torch.tensor([[0.2, 0.3, 2.0]]), torch.tensor([[0.0, 0.0, -4.0]])
    assert scene.closest_hit(origin, down).t.item() == pytest.approx(0.5)
    assert scene.occluded(origin, down, t_min=0.51).item() is False
    assert scene.occluded(origin, down, t_max=0.49).item() is False
    assert scene.occluded(origin, down, 0.49, 0.51).item() is True


def test_closed_mesh_lets_no_ray_through():
    """Rays from inside, aimed at shared edges and corners, where neighbouring triangles meet."""
    x, y = torch.meshgrid(torch.arange(9.0), torch.arange(9.0), indexing="ij")
    vertices = torch.stack([x, y, 0.1 * torch.sin(3 * x + y)], -1).reshape(-1, 3)
    i = (9 * torch.arange(8)[:, None] + torch.arange(8)).reshape(-1)
    faces = torch.cat([torch.stack([i, i + 9, i + 10], 1), torch.stack([i, i + 10, i + 1], 1)])
    g = torch.Generator().manual_seed(0)
    edge = faces[torch.randint(len(faces), (20_000,), generator=g)][:, [0, 1]]
    inner = ((vertices[edge][..., :2] > 0.5) & (vertices[edge][..., :2] < 7.5)).all(-1).all(-1)
    a, b = vertices[edge[inner]].unbind(1)
    target = a + torch.rand(len(a), 1, generator=g) * (b - a)
    origin = torch.rand(len(a), 3, generator=g) + torch.tensor([3.5, 3.5, 2.0])
    assert ops.VisibilityScene(vertices, faces).occluded(origin, target - origin).all()


def test_what_a_mesh_is_given_as():
    vertices, faces = soup(200)
    scene = ops.VisibilityScene(vertices.repeat(1, 2)[:, :3], faces.long())
    assert torch.equal(scene.occluded(*rays()), ops.VisibilityScene(*soup(200)).occluded(*rays()))
    vertices, faces = TRIANGLE.clone(), FACE.clone()
    scene = ops.VisibilityScene(vertices, faces)
    vertices += 100
    faces.zero_()
    assert scene.occluded(torch.tensor([[0.2, 0.3, 2.0]]), torch.tensor([[0.0, 0.0, -1.0]])).item()


def test_no_rays_and_no_triangles():
    none = torch.empty(0, 3)
    scene = ops.VisibilityScene(*soup(200))
    assert scene.occluded(none, none).shape == (0,)
    assert scene.closest_hit(none, none).barycentric.shape == (0, 2)
    for empty in (
        ops.VisibilityScene(TRIANGLE, torch.empty(0, 3, dtype=torch.int32)),
        ops.VisibilityScene(none, torch.empty(0, 3, dtype=torch.int32)),
    ):
        assert not empty.occluded(*rays()).any()
        assert empty.closest_hit(*rays()).face.eq(-1).all()
        with ops.use_backend("reference"):
            assert not empty.occluded(*rays()).any()


def test_rays_that_are_not_finite_and_triangles_without_area_meet_nothing():
    down = torch.tensor([[0.0, 0.0, -1.0]])
    above = torch.tensor([[0.2, 0.3, 2.0]])
    scene = ops.VisibilityScene(TRIANGLE, FACE)
    assert scene.occluded(above, down).item()
    for bad in (math.nan, math.inf, 1e30):
        assert not scene.occluded(above.clone().fill_(bad), down).item()
        assert scene.closest_hit(above, down * bad).face.item() == -1
    assert not scene.occluded(above, torch.zeros(1, 3)).item()
    assert not ops.occluded_reference(TRIANGLE, FACE, above, down * math.nan).item()
    faces = torch.tensor([[0, 1, 2], [0, 0, 1], [2, 2, 2]], dtype=torch.int32)
    origin, down = torch.tensor([[0.2, 0.3, 2.0]]), torch.tensor([[0.0, 0.0, -1.0]])
    assert ops.VisibilityScene(TRIANGLE, faces).closest_hit(origin, down).face.item() == 0
    with ops.use_backend("reference"):
        assert ops.VisibilityScene(TRIANGLE, faces).closest_hit(origin, down).face.item() == 0


def test_without_embree_the_error_says_how_to_get_it(monkeypatch):
    monkeypatch.setattr(ops.native, "core", SimpleNamespace(embree_version=lambda: 0))
    with pytest.raises(RuntimeError, match=r"built without it.*libembree-dev.*rebuild"):
        ops.VisibilityScene(*soup(200))
    with ops.use_backend("reference"):
        scene = ops.VisibilityScene(*soup(200))
        assert scene.occluded(*rays(10)).any()
    with pytest.raises(RuntimeError, match="built without it"):
        scene.occluded(*rays(10))
