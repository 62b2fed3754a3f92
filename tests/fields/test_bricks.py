"""The sparse field: what the dense one is near its surface, and bricks that follow it."""

import copy

import pytest
import torch
from analytic import cameras_around
from asymmetric_scene import lopsided
from scipy.spatial import KDTree

from univoxel.fields import bricks as bricks_module
from univoxel.fields.bricks import BAND
from univoxel.fields.field import dense_field
from univoxel.fields.grid import GridShape, fit_grid
from univoxel.ops import brick_minimum
from univoxel.optim import RowAdam
from univoxel.render.pipeline import surface_of_view

RADIUS = 0.5


def sphere(n=40, channels=2, radius=RADIUS):
    grid = GridShape((-0.7,) * 3, 1.4 / (n - 1), (n, n, n))
    field = dense_field(grid, channels, grid.nodes().norm(dim=-1) - radius)
    with torch.no_grad():
        field.features.copy_(grid.nodes()[..., :channels])
    return field


def near_surface(count, distance, seed=0):
    g = torch.Generator().manual_seed(seed)
    direction = torch.nn.functional.normalize(torch.randn(count, 3, generator=g), dim=1)
    return direction * (RADIUS + distance * (2 * torch.rand(count, 1, generator=g) - 1))


@pytest.mark.parametrize("kind", ["dense", "sparse"])
def test_features_alone_send_nothing_to_the_sdf(kind):
    dense = sphere()
    field = dense if kind == "dense" else dense.in_bricks(dense.grid)
    points = near_surface(50, field.voxel_size)
    features = field.features_at(points)
    assert torch.equal(features, field.sample(points).features)
    features.sum().backward()
    assert field.sdf.grad is None
    assert field.features.grad is not None


@pytest.mark.parametrize("nodes", [40, 41, 80])
def test_near_the_surface_it_is_the_dense_field(nodes):
    dense, fine = sphere(), sphere(nodes).grid
    wanted, field = dense.resized(fine), dense.in_bricks(fine)
    points = near_surface(2000, 1.5 * fine.voxel_size)  # a node 2.45 voxels away is not cut off
    a, b = field.sample(points), wanted.sample(points)
    for name in ("sdf", "gradient", "features"):
        # `resample` places nodes in float32, `sample` in double
        torch.testing.assert_close(getattr(a, name), getattr(b, name), rtol=0, atol=3e-5)
    centre, corner = field.sample(torch.tensor([[0.0, 0.0, 0.0], [0.7, 0.7, 0.7]])).sdf
    assert corner.item() == pytest.approx(BAND * fine.voxel_size)
    assert centre.item() == pytest.approx(-BAND * fine.voxel_size)
    # each side of the surface a band, and what of a brick is beyond it
    thick = (2 * BAND + 7) * fine.voxel_size
    stored = 64 * (field.distances.count - 2) * fine.voxel_size**3
    assert stored < thick * 4 * torch.pi * RADIUS**2


def test_a_part_of_the_box_and_another_origin():
    """Every brick of the other grid that the band meets is found, off the source's lattice."""
    dense = sphere(33)
    fine = GridShape((-0.71, 0.013, -0.63), 0.0137, (101, 51, 90))
    field, wanted = dense.in_bricks(fine), dense.resized(fine)
    near = wanted.sdf.abs() < field.distances.far - 1e-4
    rows = field.distances.bricks.grid_rows()
    assert near.any()
    assert (rows[near] >= 128).all()
    torch.testing.assert_close(
        field.sdf[rows],
        wanted.sdf.clamp(-field.distances.far, field.distances.far),
        rtol=0,
        atol=3e-5,
    )


def images(scene, of_field):
    scene = copy.copy(scene)
    scene._modules = scene._modules | {"field": of_field}
    scene.inv_s = 2 / of_field.voxel_size
    surface, _ = surface_of_view(scene, cameras_around(2, size=96), 0)
    return surface.albedo * surface.opacity[:, None]


def psnr(a, b):
    return -10 * (a - b).square().mean().log10().item()


def test_conversion_keeps_the_picture():
    """Dense to sparse, to finer and to finer still: less than 0.05 dB of 34."""
    scene = lopsided(32**3)
    lower, upper = scene.field.bounds()
    finer, finest = (fit_grid(lower, upper, n**3) for n in (64, 128))
    dense = scene.field.resized(finer)
    before = images(scene, dense)
    truth = (before + 0.02 * torch.randn(before.shape)).clamp(0, 1)
    once = scene.field.in_bricks(finer)
    assert psnr(images(scene, once), truth) == pytest.approx(psnr(before, truth), abs=0.05)
    twice, whole = once.resized(finest), dense.resized(finest)
    before, after = images(scene, whole), images(scene, twice)
    truth = (before + 0.02 * torch.randn(before.shape)).clamp(0, 1)
    assert psnr(after, truth) == pytest.approx(psnr(before, truth), abs=0.05)
    assert twice.sdf.numel() < 0.3 * whole.sdf.numel()


def test_the_isosurface_is_the_dense_one():
    dense = sphere(41)
    field = dense.in_bricks(dense.grid)
    assert (field.distances.bricks.table == 1).any()
    for a, b in zip(field.isosurface(), dense.isosurface(), strict=True):
        torch.testing.assert_close(a, b)
    for a, b in zip(field.bounds(), dense.bounds(), strict=True):
        assert torch.equal(a, b)


@pytest.mark.parametrize("planes", [8, 12, 40])  # the last: one plane of cells is left over
def test_a_surface_found_in_slabs_is_sewn_together(monkeypatch, planes):
    monkeypatch.setattr(bricks_module, "SLAB", planes)
    dense = sphere(42)
    vertices, faces = dense.in_bricks(dense.grid).isosurface()
    wanted, whole = dense.isosurface()
    assert (len(vertices), len(faces)) == (len(wanted), len(whole))
    found = KDTree(vertices.numpy()).query(wanted.numpy())
    assert found[0].max() < 1e-5
    assert len(set(found[1])) == len(wanted)
    edges = faces.long()[:, [0, 1, 1, 2, 2, 0]].view(-1, 2)
    forth, back = (e[:, 0] * len(vertices) + e[:, 1] for e in (edges, edges.flip(1)))
    assert torch.equal(forth.sort().values, back.sort().values)  # closed, and turned alike


def test_occupied_nodes_are_the_dense_ones():
    dense = sphere(41)
    with torch.no_grad():
        dense.features.copy_((dense.sdf.abs() < dense.voxel_size)[..., None])
        field = dense.in_bricks(dense.grid)
        field.features.masked_fill_(field.features < 0.5, 0.0)  # nodes were placed by rounding
    assert 0.01 < dense.occupied().float().mean() < 0.2
    assert torch.equal(field.occupied(), dense.occupied())


def test_no_surface():
    dense = dense_field(sphere(12).grid, 1, torch.ones(12, 12, 12))
    field = dense.in_bricks(dense.grid)
    assert field.distances.count == 2
    with pytest.raises(ValueError, match="the field has no surface"):
        field.isosurface()
    field.refresh()
    assert field.distances.count == 2


def test_bricks_follow_the_surface():
    """A sphere that grows by 9 voxels, one between looks, always has its bricks."""
    dense = sphere(64, radius=0.4)
    field = dense.in_bricks(dense.grid)
    first, pool, distance = field.distances.count, len(field.sdf), dense.grid.nodes().norm(dim=-1)
    for step in range(1, 10):
        wanted = distance - 0.4 - step * field.voxel_size
        rows = field.distances.bricks.grid_rows()
        stored = rows >= 128
        with torch.no_grad():
            field.sdf[rows[stored]] = wanted[stored].clamp(
                -field.distances.far, field.distances.far
            )
        before, grown = field.distances.count, field.refresh()
        assert grown == (field.distances.count > before)
        rows = field.distances.bricks.grid_rows()
        assert (rows[wanted.abs() < field.voxel_size] >= 128).all()
        # What is carried on goes along the axes: the way round a corner is longer by a half
        near = (wanted > 0) & (wanted < 2 * field.voxel_size)
        error = field.sdf[rows] - wanted
        assert error[near].abs().max() < 1.5 * field.voxel_size
    assert field.distances.count > first
    assert not field.refresh()
    assert len(field.sdf) > pool  # it grew beyond the room there was
    assert len(field.features) == len(field.sdf) == 64 * len(field.distances.bricks.place)


def test_new_bricks_carry_distances_on():
    """Past a plane that comes near the last stored brick."""
    grid = GridShape((0.0, 0.0, 0.0), 1.0, (32, 8, 8))
    x = torch.arange(32.0)[:, None, None].expand(32, 8, 8)
    dense = dense_field(grid, 1, (x - 8.5).contiguous())
    field = dense.in_bricks(grid)
    with torch.no_grad():
        field.sdf[128 : 64 * field.distances.count] -= 3  # the plane stands at x = 11.5
    assert field.distances.bricks.table[:, 0, 0].tolist() == [1, 2, 6, 10, 0, 0, 0, 0]
    field.refresh()
    assert (field.distances.bricks.table[4] >= 2).all()
    line = field.sdf[field.distances.bricks.grid_rows()[:, 3, 3]]
    # nodes 13 .. 15 were cut off at 4 before the plane moved by 3
    wanted = torch.tensor([-1.5, -0.5, 0.5, 1.0, 1.0, 1.0, 2.0, 3.0, 4.0, 4.0])
    torch.testing.assert_close(line[10:20], wanted)


def test_the_optimiser_goes_on_when_bricks_come():
    field = sphere(48).in_bricks(sphere(48).grid)
    optimizer = RowAdam([field.sdf, field.features], lr=1e-3)
    points = near_surface(300, 0.02)
    for _ in range(3):
        optimizer.zero_grad()
        sample = field.sample(points)
        (sample.sdf.sum() + sample.features.square().sum()).backward()
        optimizer.step()
        moments = optimizer.state[field.sdf]["exp_avg"].clone()
        with torch.no_grad():
            field.sdf.view(-1, 64)[2 : field.distances.count] -= 3 * field.voxel_size
        before = field.sdf, field.features
        field.refresh()
        optimizer.follow(before[0], field.sdf)
        optimizer.follow(before[1], field.features)
    assert len(moments) < len(field.sdf)
    optimizer.zero_grad()
    field.sample(points).sdf.sum().backward()
    optimizer.step()
    state = optimizer.state[field.sdf]
    assert state["step"] == 4
    assert state["exp_avg"].shape == field.sdf.shape
    touched = field.sdf.grad.coalesce().indices()[0]
    still = torch.ones(len(moments), dtype=torch.bool)
    still[touched[touched < len(moments)]] = False
    assert torch.equal(state["exp_avg"][: len(moments)][still], moments[still])


@pytest.mark.parametrize("kind", ["dense", "sparse"])
def test_marching_follows_the_surface_but_in_training(kind):
    """There it moves in every step, and `refresh` says when to look again."""
    dense = sphere()
    field = dense if kind == "dense" else dense.in_bricks(dense.grid)
    distances = field.distances
    distances.eval()
    before = distances.brick_minimum()
    assert distances.brick_minimum() is before
    with torch.no_grad():
        field.sdf += field.voxel_size
    follows = distances.brick_minimum()
    assert torch.allclose(follows, before + field.voxel_size, atol=1e-6)
    distances.train()
    with torch.no_grad():
        field.sdf += field.voxel_size
    assert distances.brick_minimum() is follows
    field.refresh()
    bricks = () if kind == "dense" else (distances.bricks,)
    assert torch.equal(distances.brick_minimum(), brick_minimum(field.sdf.detach(), *bricks))
