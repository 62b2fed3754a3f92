"""What is lost, and the search for sizes: mirror levels and rows that are dropped."""

import dataclasses

import pytest
import torch
from analytic import photos_of, sphere_scene
from spare_scene import LIGHT, feature_scene, heads, reference_of_two_views

from univoxel.fields.field import Levels, hash_field
from univoxel.fields.grid import fit_grid
from univoxel.scene import Scene, SceneConfig, load_scene, save_scene
from univoxel.training import compression
from univoxel.training.compression import last_within_limit, reference_rays


@pytest.fixture(scope="module")
def reference():
    return reference_of_two_views()


@pytest.mark.parametrize("wanted", range(6))
def test_the_last_that_costs_no_more_than_the_limit(wanted):
    candidates = [9, 7, 5, 4, 2, 1]
    seen = []

    def cost(x):
        seen.append(x)
        return 0.01 if x >= candidates[wanted] else 0.03

    assert last_within_limit(candidates, cost, 0.02) == candidates[wanted]
    assert 9 not in seen
    assert len(seen) <= 3


def test_moved_materials_are_a_cost():
    held_out = reference_of_two_views()
    before = held_out.decoded(feature_scene())
    moved = before._replace(material=before.material + 0.1)
    assert held_out.loss_db(before, before) == 0
    assert held_out.loss_db(before, moved) > 0.02


@pytest.mark.parametrize("kept", [0, 2])
def test_mirror_levels_that_say_nothing_go_without_a_trace(reference, kept, tmp_path):
    scene = sphere_scene(16, voxel_size=0.1, light=LIGHT).eval()
    scene.inv_s = 60.0
    table = scene.radiance.directions
    with torch.no_grad():
        scene.field.features.normal_()
        table.table.zero_()[: kept * table.rows].normal_()
    before, coarse = reference.decoded(scene), table.table.detach().clone()
    compression.drop_mirror_levels_(scene, kept)
    assert scene.cfg.mirror_levels == table.levels == kept
    assert torch.equal(table.table, coarse[: kept * table.rows])
    save_scene(scene, tmp_path, {})
    for one in (scene, load_scene(tmp_path)):
        assert one.cfg == scene.cfg
        # The same sums in another order: float32, heads of three layers, sRGB steep in the dark
        for name, value in reference.decoded(one)._asdict().items():
            torch.testing.assert_close(value, getattr(before, name), atol=2e-4, rtol=1e-3, msg=name)


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
    choice = compression.fewer_mirror_levels_(scene, rays)
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
        for number, first in enumerate(heads(scene)):  # materials read the first half alone
            first.weight[:, [2, 3] if number == 0 else [2, 3, 6, 7]] = 0
        scene.light.head.linear[-1].weight.normal_(0, 0.1, generator=g)
    return scene


def drop_rows_(scene, held_out, probes, limit_db=compression.TOLERANCE_DB):
    far = 4 * scene.field.voxel_size
    return compression.fewer_rows_(scene, held_out, probes, far, limit_db)


def test_rows_that_say_nothing_are_dropped(reference):
    scene = hash_scene()
    field, rays = scene.field, reference
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
    choice = drop_rows_(scene, reference, [])
    assert choice.before == choice.after > 0
    assert torch.equal(scene.field.features, before)


def test_rows_whose_going_would_be_seen_stay(reference):
    scene = hash_scene()
    for first in heads(scene):  # all levels are read
        first.weight.data.normal_()
    before = scene.field.features.detach().clone()
    choice = drop_rows_(scene, reference, [reference], limit_db=-1.0)
    assert (choice.cost, choice.before) == (0.0, choice.after)
    assert torch.equal(scene.field.features, before)
