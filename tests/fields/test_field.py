"""Fields: decoding networks, distances in files and in bricks, hash tables of many resolutions."""

import copy
import math
from dataclasses import replace

import pytest
import torch
from scipy.spatial import KDTree
from torch import nn

from univoxel.core.records import Rays
from univoxel.fields import bricks as bricks_module
from univoxel.fields import field as fields
from univoxel.fields.bricks import BAND, BrickDistances
from univoxel.fields.distances import pack, unpack
from univoxel.fields.field import (
    COARSEST,
    PER_LEVEL,
    ROWS,
    Field,
    HashField,
    Levels,
    MaterialHead,
    RadianceHead,
    dense_field,
    hash_field,
)
from univoxel.fields.grid import GridShape
from univoxel.ops import brick_minimum, encode_hash
from univoxel.optim import RowAdam


@pytest.fixture(autouse=True)
def seed():
    torch.manual_seed(0)


def directions(n):
    return nn.functional.normalize(torch.randn(n, 3), dim=1)


@pytest.mark.parametrize("size", [1.0, 1e4])  # of the features: sigmoids saturate, ranges hold
def test_materials_stay_in_their_ranges(size):
    albedo, roughness, metallic = MaterialHead(4, 8)(size * torch.randn(200, 6))
    assert albedo.shape == (200, 3)
    assert roughness.shape == (200,)
    assert ((albedo >= 0) & (albedo <= 1)).all()
    assert ((roughness >= MaterialHead.min_roughness) & (roughness <= 1)).all()
    assert metallic.shape == (200,)
    assert ((metallic >= 0) & (metallic <= 1)).all()


def test_materials_start_mid_grey_glossy_and_no_metal():
    albedo, roughness, metallic = MaterialHead(8, 64)(torch.zeros(1, 8))
    # The last layer's weights start at a tenth: what its hidden units give is small.
    torch.testing.assert_close(albedo, torch.full((1, 3), 0.5), atol=0.05, rtol=0)
    assert 0.2 < roughness < 0.35
    assert metallic < 0.1


def test_albedo_shifts_as_a_whole():
    head, features = MaterialHead(4, 8), torch.randn(101, 6)
    before, median = head(features), torch.tensor([0.1, 0.5, 0.9])
    head.shift_albedo(features, median)
    after = head(features)
    torch.testing.assert_close(after[0].median(0).values, median)
    order = before[0].argsort(0)
    assert (after[0].gather(0, order).diff(dim=0) > -1e-6).all()
    for a, b in zip(after[1:], before[1:], strict=True):
        assert torch.equal(a, b)


def test_roughness_shifts_as_a_whole():
    head, features = MaterialHead(4, 8), torch.randn(101, 6)
    before = head(features)
    head.shift_roughness(features, 0.7)
    after = head(features)
    torch.testing.assert_close(after[1].median(), torch.tensor(0.7))
    assert (after[1][before[1].argsort()].diff() > -1e-6).all()
    assert torch.equal(after[0], before[0])
    assert torch.equal(after[2], before[2])
    known = MaterialHead(4, 8, roughness=0.4)
    known.shift_roughness(features, 0.7)
    assert (known(features)[1] == 0.4).all()


def test_materials_see_their_channels_only():
    head, features = MaterialHead(4, 8), torch.randn(10, 6)
    others = torch.cat([features[:, :4], torch.randn(10, 2)], 1)
    for a, b in zip(head(features), head(others), strict=True):
        assert torch.equal(a, b)
    features.requires_grad_()
    head(features)[0].sum().backward()
    assert features.grad[:, :4].any()
    assert not features.grad[:, 4:].any()


def test_radiance_reads_its_table_in_the_mirrored_direction():
    head, n = RadianceHead(2, 8, levels=3), 40
    features, normal, wo = torch.randn(n, 2), directions(n), directions(n)
    before = head(features, normal, wo)
    mirrored = 2 * (normal * wo).sum(1, keepdim=True) * normal - wo
    with torch.no_grad():
        head.directions.table.normal_()
        said = head.directions(mirrored)
        changed = head(features, normal, wo)
        plain = [features, normal, mirrored, (2 * mirrored).sin(), (2 * mirrored).cos()]
        cosine = (normal * wo).sum(1, keepdim=True)
        wanted = torch.sigmoid(head.net(torch.cat([*plain, cosine, said], 1)))
    torch.testing.assert_close(changed, wanted)
    assert (changed - before).abs().max() > 1e-3


def two_balls():
    axis = torch.arange(24.0)
    node = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1)
    centres = torch.tensor([[7.0, 7.0, 7.0], [17.0, 16.0, 15.0]])
    return torch.stack([(node - c).norm(dim=-1) for c in centres]).amin(0) - 5.2


def test_near_the_surface_nothing_changes_and_beyond_it_the_side_stays():
    sdf = two_balls()
    packed = pack(sdf, 2.0)
    again = unpack(packed, (24, 24, 24), 4.0)
    near = sdf.abs() < 2
    assert torch.equal(again[near], sdf[near])
    assert len(packed["rows"]) == near.sum()
    assert torch.equal(again[~near], 4 * sdf[~near].sign())
    assert len(packed["side"]) == 3  # outside, and the middle of each ball
    with pytest.raises(ValueError, match="expected signs for"):
        unpack(packed | {"side": packed["side"][:1]}, (24, 24, 24), 4.0)
    with pytest.raises(IndexError):
        unpack(packed, (8, 8, 8), 4.0)


def test_a_jump_between_the_sides_is_kept():
    sdf = torch.full((6, 6, 6), 9.0)
    sdf[2:4, 2:4, 2:4] = -9.0
    again = unpack(pack(sdf, 1.0), (6, 6, 6), 4.0)
    assert torch.equal(again.sign(), sdf.sign())
    assert torch.equal(again[1:5, 2:4, 2:4], sdf[1:5, 2:4, 2:4])  # next to the jump: as it was


GRID = GridShape((-0.7,) * 3, 1.4 / 39, (40, 40, 40))
COUNT = 4  # levels


def ball() -> Field:
    levels = Levels.of(GRID.bounds(), GRID.voxel_size, COUNT)
    field = hash_field(GRID, levels, GRID.nodes().norm(dim=-1) - 0.5)
    torch.manual_seed(0)
    nn.init.normal_(field.features)
    return field


def test_levels_go_from_coarse_to_fine():
    levels = Levels.of(GRID.bounds(), GRID.voxel_size, COUNT)
    sizes = torch.tensor(levels.voxel_sizes)
    assert sizes[0].item() == pytest.approx(1.4 / COARSEST)
    assert sizes[-1].item() == pytest.approx(GRID.voxel_size)
    ratios = sizes[1:] / sizes[:-1]
    assert torch.allclose(ratios, ratios[:1].expand(3))
    assert ratios[0] < 1
    assert Levels.of(GRID.bounds(), 1.0, 2).voxel_sizes == (1.0, 1.0)  # coarser than the coarsest
    assert len(Levels.of(GRID.bounds(), 0.1, 1).voxel_sizes) == 1


def test_distances_are_the_dense_fields_and_features_the_tables():
    field = ball()
    dense = dense_field(GRID, 1, field.sdf.detach().clone())
    points = 1.2 * torch.rand(200, 3) - 0.6
    found, wanted = field.sample(points), dense.sample(points)
    assert torch.equal(found.sdf, wanted.sdf)
    assert torch.equal(found.gradient, wanted.gradient)
    levels = field.levels
    table = encode_hash(field.features, points, levels.lower, levels.upper, levels.voxel_sizes)
    for level in range(COUNT):
        for k in range(PER_LEVEL):
            assert torch.equal(found.features[:, k * COUNT + level], table[:, 2 * level + k])
    vertices, faces = field.isosurface()
    assert (vertices.norm(dim=1) - 0.5).abs().max() < 0.01
    assert len(faces) > 1000


def test_held_channels_get_no_gradient():
    field = ball()
    points = torch.rand(100, 3) - 0.5
    field.features_at(points).square().sum().backward()
    whole = field.features.grad.to_dense()
    field.hold_channels_(COUNT + 1)  # the first of each level, and the second of the coarsest
    held = field.features.grad.to_dense().view(COUNT, ROWS, PER_LEVEL)
    whole = whole.view(COUNT, ROWS, PER_LEVEL)
    assert (held[:, :, 0] == 0).all()
    assert (held[0] == 0).all()
    assert torch.equal(held[1:, :, 1], whole[1:, :, 1])
    assert whole[0, :, 1].any()


def test_tables_may_be_smaller():
    levels = Levels.of(GRID.bounds(), GRID.voxel_size, COUNT, rows=2**10)
    field = hash_field(GRID, levels, GRID.nodes().norm(dim=-1) - 0.5)
    assert field.features.shape == (COUNT * 2**10, PER_LEVEL)
    field.features_at(torch.rand(500, 3) - 0.5).sum().backward()
    touched = field.features.grad.coalesce().indices()[0]
    assert touched.max() < COUNT * 2**10
    field.hold_channels_(COUNT)
    held = field.features.grad.to_dense().view(COUNT, -1, PER_LEVEL)
    assert (held[:, :, 0] == 0).all()
    assert all(level.any() for level in held[:, :, 1])


@pytest.mark.parametrize("finest", [1.0, 0.6, 0.4])  # voxels
def test_rows_near_are_all_that_points_near_the_surface_read(finest):
    field = ball()
    levels = replace(Levels.of(field.bounds(), finest * field.voxel_size, 4), rows=2**14)
    field = HashField(field.distances, levels)
    near = field.rows_near(1.5 * field.voxel_size)
    g = torch.Generator().manual_seed(0)
    direction = torch.nn.functional.normalize(torch.randn(1_000_000, 3, generator=g))
    away = 7 * torch.rand(1_000_000, generator=g) - 3.5  # voxels
    points = direction * (0.5 + field.voxel_size * away[:, None])
    # The node next to a point is up to 0.87 voxels away; and a cube around a near node reaches as
    # far beyond it
    rows = [rows_read(field, points[away.abs() < far]) for far in (0.6, 3.5)]
    assert near[rows[0]].all()
    read = torch.zeros(len(near), dtype=torch.bool)
    read[rows[1]] = True
    assert not (near & ~read).any()
    assert 0 < near.sum() < 0.9 * read.sum()
    assert field.rows_near(math.inf).all()


def rows_read(field: Field, points: torch.Tensor) -> torch.Tensor:
    """Rows of its table that have a say at points."""
    features = field.features_at(points)
    (grad,) = torch.autograd.grad(features.sum(), field.features)
    grad = grad.coalesce()
    return grad.indices()[0][grad.values().abs().sum(1) > 0]


def test_another_grid_keeps_the_features():
    field = ball()
    fine = GridShape((-0.7,) * 3, 1.4 / 79, (80, 80, 80))
    finer = field.resized(fine)
    points = torch.rand(100, 3) - 0.5
    assert torch.equal(finer.features_at(points), field.features_at(points))
    assert finer.sdf.shape == (80, 80, 80)
    assert finer.features.data_ptr() != field.features.data_ptr()
    assert finer.occupied().float().mean() < field.occupied().float().mean()


def test_smoothing_leaves_the_table():
    field = ball()
    before = field.features.detach().clone()
    field.features_at(torch.rand(10, 3)).sum().backward()
    field.smooth_features_(torch.arange(10), 0.1)
    assert torch.equal(field.features, before)


FINE = GridShape((-0.7,) * 3, 1.4 / 199, (200, 200, 200))


@pytest.fixture(scope="module")
def bricks():
    """The ball on a grid so fine that only bricks around its surface are stored."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fields, "DENSE_MOST", 1_000_000)
        return ball().resized(FINE)


def test_distances_of_a_fine_grid_lie_in_bricks(bricks):
    dense = ball()
    assert isinstance(bricks.distances, BrickDistances)
    assert bricks.sdf is bricks.distances.sdf
    assert bricks.sdf.numel() < 0.2 * FINE.nodes_count
    direction = torch.nn.functional.normalize(torch.randn(200, 3), dim=1)
    points = (0.49 + 0.02 * torch.rand(200, 1)) * direction
    found, wanted = bricks.sample(points), dense.sample(points)
    assert torch.equal(found.features, wanted.features)
    torch.testing.assert_close(found.sdf, wanted.sdf, atol=1e-3, rtol=0)  # a voxel is 0.036 there
    assert 0.01 < bricks.occupied().float().mean() < 0.1
    vertices, _ = bricks.isosurface()
    assert (vertices.norm(dim=1) - 0.5).abs().max() < 0.01


def test_bricks_learn_and_grow(bricks):
    """Gradients reach distances and table; where the surface moves, bricks follow."""
    bricks = copy.deepcopy(bricks)
    rays = Rays(torch.tensor([[0.0, 0.1, 2.0]]), torch.tensor([[0.0, 0.0, -1.0]]))
    samples = bricks.march(rays, torch.zeros(1), 2 / FINE.voxel_size)
    assert len(samples.t) > 2
    found = bricks.sample(rays.origin + samples.t[:, None] * rays.direction)
    (found.sdf.sum() + found.features.sum()).backward()
    assert bricks.sdf.grad.coalesce().values().any()
    assert bricks.features.grad.coalesce().values().any()
    before = len(bricks.sdf)
    with torch.no_grad():
        bricks.sdf[128:] -= 3 * FINE.voxel_size  # the ball grows by three voxels
    assert bricks.refresh()
    assert len(bricks.sdf) > before
    assert bricks.sdf is bricks.distances.sdf


def test_a_copy_stands_on_its_own_and_stays_in_bricks(bricks):
    copied = copy.deepcopy(bricks)
    assert copied.sdf is copied.distances.sdf
    assert copied.sdf is not bricks.sdf
    assert torch.equal(copied.sdf, bricks.sdf)
    assert isinstance(bricks.resized(GRID).distances, BrickDistances)


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
    # Once more to a finer grid
    finest = sphere(2 * nodes).grid
    a, b = field.resized(finest).sample(points / 2), wanted.resized(finest).sample(points / 2)
    near = b.sdf.abs() < 1.5 * finest.voxel_size
    torch.testing.assert_close(a.features[near], b.features[near], rtol=0, atol=3e-5)
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


@pytest.mark.parametrize("planes", [8, 12, 40])  # the last: one plane of cells is left over
def test_a_surface_found_in_slabs_is_sewn_together(monkeypatch, planes):
    monkeypatch.setattr(bricks_module, "SLAB", planes)
    dense = sphere(42)
    field = dense.in_bricks(dense.grid)
    assert (field.distances.bricks.table == 1).any()
    assert all(torch.equal(a, b) for a, b in zip(field.bounds(), dense.bounds(), strict=True))
    (vertices, faces), (wanted, whole) = field.isosurface(), dense.isosurface()
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
