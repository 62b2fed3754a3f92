"""Channels, lobes, levels, units and rows that are dropped, and those that stay."""

import dataclasses

import pytest
import torch
from analytic import photos_of, sphere_scene
from spare_scene import LIGHT, feature_scene, reference_of_two_views

from univoxel.compression import prune, search
from univoxel.compression.config import CompressionConfig
from univoxel.compression.quality import reference_rays
from univoxel.fields.features import Levels
from univoxel.fields.field import hash_field
from univoxel.grid import fit_grid
from univoxel.scene import Scene, SceneConfig

CFG = CompressionConfig()


@pytest.fixture(scope="module")
def reference():
    return reference_of_two_views()


def test_channels_that_nothing_reads_are_dropped(reference):
    scene = feature_scene()
    held_out, calibration = reference
    # photographs of this scene, with noise: every change is for the worse
    drawn = held_out.decoded(scene).physical
    noise = 0.05 * torch.randn(drawn.shape, generator=torch.Generator().manual_seed(0))
    held_out = dataclasses.replace(held_out, target=drawn + noise)
    criterion = search.Criterion(held_out, calibration, 1e-4, CFG)
    choice = search.fewer_channels_(scene, criterion)
    assert (choice.before, choice.after) == (4, 2)
    assert scene.cfg.channels == 2
    assert scene.cfg.material_channels == 1
    assert choice.cost <= 1e-4


@pytest.mark.parametrize("saving", [search.fewer_lobes_, search.fewer_units_])
def test_what_is_saved_costs_no_more_than_the_limit(reference, saving):
    """What the choice says is what is seen afterwards; and what would cost more is left."""
    scene = feature_scene()
    held_out, _ = reference
    before = held_out.decoded(scene)
    choice = saving(scene, search.Criterion(*reference, 0.05, CFG))
    loss_db = held_out.loss_db(before, held_out.decoded(scene))
    assert loss_db == pytest.approx(choice.cost, abs=1e-4)
    assert choice.cost <= 0.05
    loose = saving(feature_scene(), search.Criterion(*reference, 100.0, CFG))  # at any cost
    assert loose.after < choice.before
    assert loose.after <= choice.after


def test_mirror_levels_that_draw_nothing_are_dropped():
    scene = sphere_scene(16).eval()
    scene.inv_s = 60.0
    table = scene.radiance.directions
    with torch.no_grad():
        table.table[: 2 * table.rows].normal_()
        scene.radiance.net.linear[0].weight[:, -table.channels :] *= 10
    photos = photos_of(4, 24)
    pixels = torch.cartesian_prod(torch.arange(4), torch.arange(24), torch.arange(24))
    rays = reference_rays(photos, pixels)
    drawn = rays.decoded(scene).radiance  # photographs that show what the coarse levels say
    rays = dataclasses.replace(rays, target=drawn + 0.01 * torch.randn_like(drawn))
    criterion = search.Criterion(rays, rays, CFG.tolerance_db, CFG)
    choice = search.fewer_mirror_levels_(scene, criterion)
    assert (choice.before, choice.after) == (5, 2)
    assert scene.cfg.mirror_levels == table.levels == 2


def hash_scene():
    """Random features on four levels, of which the coarser two are read."""
    grid = fit_grid(torch.full((3,), -0.7), torch.full((3,), 0.7), 15**3)
    levels = Levels.of(grid.bounds(), grid.voxel_size, 4)
    g = torch.Generator().manual_seed(1)
    torch.manual_seed(0)
    field = hash_field(grid, levels, grid.nodes().norm(dim=-1) - 0.5)
    scene = Scene(SceneConfig(8, 4, 16, sky_nodes=0, light=LIGHT), field).eval()
    scene.inv_s = 60.0
    with torch.no_grad():
        field.features.normal_(generator=g)
        for owner, name in prune.heads(scene):
            unread = [2, 3] if owner is scene.material else [2, 3, 6, 7]
            getattr(owner, name).linear[0].weight[:, unread] = 0
        scene.light.head.linear[-1].weight.normal_(0, 0.1, generator=g)
    return scene


def drop_rows_(scene, held_out, probes, limit_db=CFG.tolerance_db):
    far = 4 * scene.field.voxel_size
    return search.fewer_rows_(scene, held_out, probes, far, limit_db, CFG.dropped_row_shares)


def test_rows_that_say_nothing_are_dropped(reference):
    scene = hash_scene()
    field, rays = scene.field, reference[0]
    far = 4 * field.voxel_size
    before = field.features.detach().clone()
    drawn = rays.decoded(scene)
    # photographs that show just that, but for noise of 70 dB: what is read is missed
    noise = 3e-4 * torch.randn_like(drawn.radiance)
    rays = dataclasses.replace(rays, target=drawn.radiance + noise)
    choice = drop_rows_(scene, rays, [rays] * 4)
    there = (before.any(1) & field.rows_near(far)).view(4, -1)
    gone = there & ~field.features.detach().any(1).view(4, -1)
    assert (choice.kind, choice.before) == ("rows", there.sum())
    assert choice.before - choice.after == gone.sum()
    # Half of a level is behind the object, or beyond what rays sample, and of no use either
    assert gone[2:].sum() == 2 * gone[2].sum() > 0.4 * there[2:].sum()
    assert gone[:2].sum() < 0.6 * gone[2:].sum()
    assert choice.cost <= 0.02
    assert rays.loss_db(drawn, rays.decoded(scene)) == pytest.approx(choice.cost, abs=1e-6)


def test_rows_that_no_probe_meets_stay(reference):
    scene = hash_scene()
    before = scene.field.features.detach().clone()
    choice = drop_rows_(scene, reference[0], [])
    assert choice.before == choice.after > 0
    assert torch.equal(scene.field.features, before)


def test_rows_whose_going_would_be_seen_stay(reference):
    scene = hash_scene()
    for owner, name in prune.heads(scene):  # all levels are read
        getattr(owner, name).linear[0].weight.data.normal_()
    before = scene.field.features.detach().clone()
    choice = drop_rows_(scene, reference[0], [reference[0]], limit_db=-1.0)
    assert (choice.cost, choice.before) == (0.0, choice.after)
    assert torch.equal(scene.field.features, before)
