"""Where the visual hull stays, on balls that mirror, are painted, or are seen through."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from analytic import RADIUS, cameras_around, sphere_normals

from univoxel.camera import image_rays
from univoxel.cli.trainer import build_scene
from univoxel.color import linear_to_srgb
from univoxel.data import Photos
from univoxel.fields.field import dense_field
from univoxel.fields.grid import GridShape, fit_grid
from univoxel.lights.views import Turntable
from univoxel.optim import rows_of
from univoxel.preparation import hull_constraint as task
from univoxel.preparation.hull import mask_distances, visual_hull
from univoxel.preparation.hull_constraint import grown, open_observations, pinned_hull
from univoxel.preparation.light_frame import LightFrame
from univoxel.preparation.prepare import Silhouettes, pinned_in, prepare
from univoxel.presets import preset
from univoxel.render.observations import Observations
from univoxel.training.descent import smooth_sdf_gradient_

VIEWS, SIZE = 24, 64
GRID = fit_grid(torch.full((3,), -0.7), torch.full((3,), 0.7), 24**3)


def sky(direction):
    """Lamps of several colours in the dark."""
    phase = torch.tensor([0.0, 2.0, 4.0])
    lamps = torch.sin(4 * direction + phase) + torch.sin(5 * direction.roll(1, -1))
    return lamps.clamp_min(0) / 2


def mirror(rays, normal):
    cosine = (rays.direction * normal).sum(-1, keepdim=True)
    return sky(rays.direction - 2 * cosine * normal)


def paint(rays, normal):
    return sky(3 * normal)


def half(rays, normal):
    """A mirror above, grey below."""
    return torch.where(normal[:, 2:] > 0, mirror(rays, normal), 0.3)


def half_glossy(rays, normal):
    """A mirror above, glossy paint below."""
    share = torch.where(normal[:, 2:] > 0, 1.0, 0.15)
    return 0.3 * (1 - share) + share * mirror(rays, normal)


def noisy(rays, normal):
    """A mirror whose every sighting is off by chance, by as much as the lamps change it."""
    generator = torch.Generator().manual_seed(int(1e4 * rays.origin[0].sum().abs()))
    return mirror(rays, normal) / 2 + 0.8 * torch.rand(normal.shape, generator=generator)


def far_side(rays, normal):
    """What is painted inside, as in a bowl."""
    cosine = (rays.direction * normal).sum(-1, keepdim=True)
    return sky(3 * (RADIUS * normal - 2 * RADIUS * cosine * rays.direction) / RADIUS)


def photographs(look) -> Photos:
    cameras = cameras_around(VIEWS, SIZE)
    colors, masks = [], []
    for view in range(VIEWS):
        normal, hit = sphere_normals(cameras, view)
        color = look(image_rays(cameras, view), normal.view(-1, 3)).view(SIZE, SIZE, 3)
        colors.append(linear_to_srgb(color * hit[..., None]))
        masks.append(hit)
    encoded = (255 * torch.stack(colors)).round().byte()
    names = [f"r_{v}" for v in range(VIEWS)]
    return Photos(Path("ball"), names, encoded, 255 * torch.stack(masks).byte(), cameras)


def pinned(look, **constants):
    photos = photographs(look)
    distance = mask_distances(photos.coverage())
    hull = visual_hull(distance, photos.cameras, GRID)
    with pytest.MonkeyPatch.context() as patch:
        for name, value in ({"POINTS": 4000, "CLASSES": 24} | constants).items():
            patch.setattr(task, name, value)
        return pinned_hull(photos, distance, hull, GRID), hull


@pytest.fixture(scope="module")
def ball():
    return pinned(mirror)


@pytest.mark.parametrize(
    ("look", "constants"),
    [
        *((look, {}) for look in (paint, far_side)),
        # Neighbours that agree: without points turned away from one another there is no table
        (mirror, {"TURN": 180.0}),
        (half, {"LEAST_SHARE": 0.9}),  # a few points that agree are chance
        (mirror, {"STRONG_CHANGE": 0.9}),  # regions begin with the strongest changes
        (mirror, {"MIN_VIEWS": VIEWS}),  # points that few photographs show
    ],
)
def test_what_proves_nothing_is_not_held(look, constants):
    assert pinned(look, **constants)[0] is None


def test_paint_that_mirrors_a_part_is_not_pinned():
    """However small the changes that are asked for."""
    weak = {"CHANGE": 0.02, "STRONG_CHANGE": 0.02, "WEAK_CHANGE": 9.0}
    found, _ = pinned(half_glossy, **weak)
    height = found.position[:, 2]
    assert found.pinned[height > 0.2].float().mean() > 0.8
    below = height < -0.3  # regions grow some way across the border
    assert found.pinned[below].float().mean() < 0.1
    all_agree, _ = pinned(half_glossy, **weak, GAIN=0.0)
    assert all_agree.pinned[below].float().mean() > 0.5


def test_changes_that_hardly_follow_the_table_prove_nothing():
    any_gain = {"GAIN": 0.0, "CHANGE": 0.05, "STRONG_CHANGE": 0.05, "WEAK_CHANGE": 0.05}
    assert pinned(noisy, **any_gain, CORRELATION=0.9)[0] is None
    assert pinned(noisy, **any_gain)[0] is not None


def test_what_mirrors_the_object_tells_nothing(monkeypatch):
    """Of two balls side by side: a place that faces the other one, seen so that it mirrors it."""
    nodes = GRID.nodes().view(*GRID.size, 3)
    balls = [(nodes - torch.tensor([x, 0.0, 0.0])).norm(dim=-1) - 0.2 for x in (-0.35, 0.35)]
    hull = torch.minimum(*balls)
    towards = torch.tensor(
        [[1.0, 0.0, 0.0], [0.6, 0.8, 0.0]]
    )  # mirrored at +X: the other ball, sky
    wo = towards * torch.tensor([1.0, -1.0, 1.0])
    count = task.NEIGHBOURS
    normal = torch.tensor([[1.0, 0.0, 0.0]]).expand(count, 3)
    position = torch.tensor([[-0.15, 0.0, 0.0]]) + 0.001 * torch.randn(
        count, 3, generator=torch.Generator().manual_seed(0)
    )
    seen = Observations(
        position,
        normal,
        2 * torch.arange(count + 1),
        wo.repeat(count, 1),
        torch.full((2 * count, 3), 0.5),
        torch.arange(2).repeat(count),
        torch.zeros(2, 3),
    )
    monkeypatch.setattr(task, "MIN_VIEWS", 1)
    found = open_observations(seen, hull, GRID)
    assert found.count.tolist() == [1.0] * count


def test_regions_take_in_holes_and_what_is_weak_beside_them():
    line = torch.arange(40)
    nearest = (line[:, None] + torch.arange(-4, 5)).clamp(0, 39)
    strong, weak = (line >= 8) & (line < 20), (line >= 20) & (line < 30)
    strong[13] = strong[35] = False
    alone = strong.clone()
    alone[35] = True  # and no region
    found = grown(alone, weak, nearest)
    assert found[8:26].all()
    assert not found[:5].any()
    assert not found[31:].any()
    assert not grown(strong & (line > 17), weak, nearest).any()


def test_nodes_near_the_held_points_of_a_mirror_stay(ball):
    found, hull = ball
    nodes = found.nodes(hull, GRID)
    near = hull.abs() < task.BAND * GRID.voxel_size
    assert not (nodes & ~near).any()
    assert nodes.sum() > 0.8 * near.sum()
    upper = replace(found, pinned=found.position[:, 2] > 0)
    assert (GRID.nodes()[upper.nodes(hull, GRID)][:, 2] > -0.1).all()
    assert found.pinned.float().mean() > 0.8


def test_the_hull_is_put_back_once_and_gets_no_gradient(ball):
    found, hull = ball
    upper = replace(found, pinned=found.position[:, 2] > 0)
    field = dense_field(GRID, 2, hull + 0.01)
    upper.pin_(field)
    stays = field.distances.pinned
    assert torch.equal(field.sdf[stays], hull[stays])
    assert torch.equal(field.sdf[~stays], (hull + 0.01)[~stays])
    with torch.no_grad():
        field.sdf += 0.01
    upper.pin_(field)  # the same grid: training has begun
    assert not torch.equal(field.sdf[stays], hull[stays])

    index = (hull.abs() < GRID.voxel_size).nonzero().T
    field.sdf.grad = torch.sparse_coo_tensor(
        index, torch.ones(index.shape[1]), hull.shape, is_coalesced=True, check_invariants=True
    )
    smooth_sdf_gradient_(field, 2)
    gradient, rows = field.sdf.grad._values(), rows_of(field.sdf.grad)
    assert (gradient[stays.flatten()[rows]] == 0).all()
    assert (gradient[~stays.flatten()[rows]] > 0).all()


def test_which_bricks_are_empty_is_looked_at_again_and_bricks_are_let_go(ball):
    """In training it is not by itself."""
    found, hull = ball
    field = dense_field(GRID, 2, hull + 0.2).train()
    before = field.distances.brick_minimum()
    found.pin_(field)
    after = field.distances.brick_minimum()
    assert torch.equal(after, field.eval().distances.brick_minimum())
    assert not torch.equal(after, before)
    field = dense_field(GRID, 2, hull).in_bricks(GridShape(GRID.origin, GRID.voxel_size, GRID.size))
    before = field.sdf.clone()
    found.pin_(field)
    assert field.distances.pinned is None
    assert torch.equal(field.sdf, before)


def silhouettes_of(look) -> Silhouettes:
    photos = photographs(look)
    box = torch.full((3,), -0.7), torch.full((3,), 0.7)
    return Silhouettes(photos, mask_distances(photos.coverage()), box, refined=False)


def draft(tmp_path, **changes):
    cfg = preset("draft", tmp_path, tmp_path)
    first = replace(cfg.stages[0], voxels=GRID.nodes_count / 1e6)
    stages = first, *cfg.stages[1:]
    return replace(cfg, stages=stages, light_frame="world", exposures=False, **changes)


def test_a_run_that_goes_on_holds_the_same(tmp_path):
    silhouettes, cfg = silhouettes_of(half), draft(tmp_path)
    prepared = prepare(silhouettes, cfg)
    again = pinned_in(silhouettes, build_scene(prepared, cfg), cfg)
    assert torch.equal(again.position, prepared.pinned.position)
    assert torch.equal(again.pinned, prepared.pinned.pinned)


def test_what_is_held_is_not_carved(tmp_path, monkeypatch):
    carved = []

    def carve(hull, *_):
        carved.append(hull)
        return hull + 1

    monkeypatch.setattr("univoxel.preparation.prepare.carve_within_time", carve)
    prepared = prepare(silhouettes_of(half), draft(tmp_path))
    stays = prepared.pinned.nodes(carved[0], prepared.grid)
    assert torch.equal(prepared.hull, torch.where(stays, carved[0], carved[0] + 1))
    assert stays.any()


TURNTABLE = Turntable((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), (1.0, 0.0, 0.0))


@pytest.mark.parametrize(
    ("masks", "varying", "frame"),
    [
        ({"votes": 2}, "none", None),  # rough ones
        # Photographs that differ, and light that moves with the camera
        ({}, "exposure", None),
        ({}, "light", None),
        ({}, "none", LightFrame(TURNTABLE)),
        ({}, "none", LightFrame(flash=2.0)),
    ],
)
def test_where_nothing_is_held(tmp_path, monkeypatch, masks, varying, frame):
    cfg, silhouettes = draft(tmp_path), replace(silhouettes_of(half), **masks)
    if frame is not None:
        monkeypatch.setattr("univoxel.preparation.prepare.light_frame_of", lambda *_: frame)
    prepared = prepare(silhouettes, replace(cfg, scene=replace(cfg.scene, varying=varying)))
    assert prepared.pinned is None
    if not masks:
        assert pinned_in(silhouettes, build_scene(prepared, cfg), cfg) is None
