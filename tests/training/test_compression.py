"""Capacity that follows the scene: what is lost, the search for sizes, budgets, and whole runs."""

import dataclasses
import json

import pytest
import torch
from analytic import photos_of, sphere_scene, write_scene
from plain import plain_stage, plain_training

from univoxel.cli import trainer as task
from univoxel.cli.info import info
from univoxel.cli.trainer import train
from univoxel.config import JointConfig
from univoxel.fields.field import FEWEST_ROWS, ROWS, Levels, hash_field
from univoxel.fields.grid import fit_grid
from univoxel.lights import EnvmapConfig, SGConfig
from univoxel.scene import FILE, Scene, SceneConfig, load_checkpoint, load_scene, save_scene
from univoxel.training import compression, loop
from univoxel.training.compression import (
    FEWEST_VOXELS,
    last_within_limit,
    reference_rays,
    stage_voxels,
)
from univoxel.training.progress import CapacityChoice, chosen_reach, chosen_voxels

LIGHT = SGConfig(lobes=4, hidden=16, directions=16, directions_eval=16)


def reference_of_two_views():
    """Held-out rays."""
    photos = photos_of(2, 24)
    pixels = torch.cartesian_prod(torch.arange(2), torch.arange(24), torch.arange(24))
    return reference_rays(photos, pixels)


def heads(scene):
    """Every network that reads features, by its first layer."""
    networks = [scene.material.net, scene.radiance.net, scene.light.head]
    return [net.linear[0] for net in networks]


def feature_scene():
    """Random features on a grid; 4 lobes."""
    scene = sphere_scene(0, voxel_size=0.1, light=LIGHT).eval()
    scene.inv_s = 60.0
    g = torch.Generator().manual_seed(1)
    with torch.no_grad():
        scene.field.features.normal_(generator=g)
        scene.light.head.linear[-1].weight.normal_(0, 0.1, generator=g)
    return scene


# As runs have it in their checkpoints and logs
ENTRY = {
    "what": "voxels",
    "before": 1_000_000,
    "after": 37_037,
    "cost": 0.0625,
    "why": "held-out rays after rehearsals",
    "said": "voxels 1,000,000 -> 37,037: held-out rays after rehearsals",
}


def test_an_entry_is_read_and_written_as_it_was():
    choice = CapacityChoice.from_json(json.loads(json.dumps(ENTRY)))
    assert choice.kind == "voxels"
    assert choice.sentence == ENTRY["said"]
    assert json.dumps(choice.as_json()) == json.dumps(ENTRY)


def test_choices_are_found_by_their_kind():
    def choice(kind, after):
        return CapacityChoice(kind, 10**6, after, 0.0, "")

    choices = [choice("voxels", 5e4), choice("reach", 2.5), choice("rows", 9), choice("reach", 1.5)]
    assert chosen_voxels(choices) == 50_000
    assert chosen_reach(choices) == 1.5
    assert chosen_voxels(choices[1:]) is None
    assert chosen_reach(choices[2:3]) is None
    stage = plain_stage(voxels=0.06, iterations=1, share=1.0)
    assert stage_voxels(stage, choices) == 50_000
    assert stage_voxels(stage, [choice("voxels", 70_000)]) == 60_000
    assert stage_voxels(stage, []) == 60_000


def test_edges_stay_as_sharp_on_a_coarser_grid():
    stage = plain_stage(voxels=0.064, iterations=1, share=1.0, sharpness=(0.6, 0.3))
    box = torch.zeros(3), torch.ones(3)
    same = compression.on_grid(stage, box, compression.fit_grid(*box, 64_000).voxel_size)
    assert same.sharpness == pytest.approx(stage.sharpness)
    coarse = compression.on_grid(stage, box, compression.fit_grid(*box, 8_000).voxel_size)
    assert coarse.sharpness == pytest.approx((0.3, 0.15))  # voxels twice as wide


def test_no_grid_is_finer_than_the_photographs(tmp_path):
    photos = photos_of(3, 48)
    pixel = 1.8 / 48  # a picture is 1.8 wide at the origin
    grids = [plain_stage(voxels=v, iterations=1, share=0.5) for v in (5e-4, 1.0)]
    cfg = plain_training(tmp_path, tmp_path, (grids[0], JointConfig(), grids[1]), minutes=1.0)
    box = torch.tensor([-0.5, -0.5, -1.0]), torch.tensor([0.5, 0.5, 1.0])
    for wide in (1.0, 2.0):
        cut = compression.limited_to_pixels(
            dataclasses.replace(cfg, voxel_pixels=wide), photos.cameras, box
        )
        assert cut.stages[:2] == cfg.stages[:2]
        grid = compression.fit_grid(*box, compression.stage_voxels(cut.stages[2], []))
        assert grid.voxel_size == pytest.approx(wide * pixel, rel=1e-3)
    cut = compression.limited_to_pixels(
        dataclasses.replace(cfg, voxel_pixels=99.0), photos.cameras, box
    )
    assert compression.stage_voxels(cut.stages[2], []) == FEWEST_VOXELS
    free = dataclasses.replace(cfg, voxel_pixels=0.0)
    assert compression.limited_to_pixels(free, photos.cameras, box) == free


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return write_scene(tmp_path_factory.mktemp("sphere") / "data")


def config(data, out, light=LIGHT, **changes):
    stages = (
        plain_stage(voxels=0.02, iterations=40, share=0.5, rays=256),
        plain_stage(voxels=0.05, iterations=50, share=0.5, rays=256, physical_from=0.3),
    )
    scene = SceneConfig(channels=4, material_channels=2, hidden=16, light=light, sky_nodes=0)
    cfg = plain_training(data, out, stages, minutes=2.0, scene=scene, capacity="adaptive")
    return dataclasses.replace(cfg, voxel_pixels=0.0, **changes)  # pictures are 32 pixels wide


@pytest.fixture(scope="module")
def run(data, tmp_path_factory):
    return train(config(data, tmp_path_factory.mktemp("adaptive") / "run", budget_mb=0.3))


def test_an_adapted_run_says_what_was_chosen_and_is_read_again(run, tmp_path):
    found = info(run, json=tmp_path / "info.json", picture=tmp_path / "picture.png")
    assert json.loads((tmp_path / "info.json").read_text()) == found
    assert (tmp_path / "picture.png").stat().st_size > 0
    kinds = [c["what"] for c in found["chosen"]]
    assert kinds == ["voxels", "mirror levels", "reach"]
    assert found["bytes"] == (run / FILE).stat().st_size <= 0.3e6
    assert found["grid"]["nodes"] <= 6e4
    assert found["grid"]["share_with_distance"] < 1
    assert any("reach 4 -> " in choice["said"] for choice in found["chosen"])
    assert found["chosen"][0]["said"].startswith("voxels 50,000 -> ")
    with pytest.raises(ValueError, match=r"picture: expected a .png file, got .*a.jpg"):
        info(run, picture=tmp_path / "a.jpg")


def test_a_scene_drawn_from_an_adapted_file_is_the_one_that_was_trained(run, data):
    photos = photos_of(12, 32)
    pixels = torch.cartesian_prod(torch.arange(12), torch.arange(32), torch.arange(32))
    # black gives 9 dB, the right sphere in one mean colour 16
    assert loop.held_out_psnr(load_scene(run), photos, pixels, physical=True) > 17


def test_resume_goes_on_with_what_was_chosen(data, tmp_path, monkeypatch):
    cfg = config(data, tmp_path / "run", budget_mb=0.3)
    original, counts = task.run_stage, []

    def killed(scene, cfg, stage, pixels, progress):
        counts.append(scene.field.grid.nodes_count)
        if progress.clock.stage == 1:
            raise KeyboardInterrupt
        original(scene, cfg, stage, pixels, progress)

    monkeypatch.setattr(task, "run_stage", killed)
    with pytest.raises(KeyboardInterrupt):
        train(cfg)
    fits = compression.fit_grid(*load_scene(cfg.out).field.bounds(), 50_000).nodes_count
    assert counts[1] < fits
    with pytest.raises(ValueError, match="the run was started with another budget_mb"):
        train(dataclasses.replace(cfg, budget_mb=1.0), resume=True)
    seen = []
    monkeypatch.setattr(task, "run_stage", lambda scene, *_: seen.append(scene.field.grid))
    train(cfg, resume=True)
    assert [grid.nodes_count for grid in seen] == counts[1:]


@pytest.fixture(scope="module")
def hashed(data, tmp_path_factory):
    cfg = config(data, tmp_path_factory.mktemp("hashed") / "run", budget_mb=0.3)
    stages = tuple(dataclasses.replace(s, field="hash") for s in cfg.stages)
    return train(dataclasses.replace(cfg, stages=stages))


def test_a_hash_table_is_adapted_by_rows(hashed, data):
    found = info(hashed)
    assert [c["what"] for c in found["chosen"]].count("rows") == 1
    assert found["bytes"] == (hashed / FILE).stat().st_size <= 0.3e6
    scene = load_scene(hashed)
    assert scene.field.kind == "hash"
    # Unless the budget took some more, the file has those rows that were kept, and no others
    rows = next(c for c in found["chosen"] if c["what"] == "rows")
    assert 0 < int(scene.field.features.any(1).sum()) <= rows["after"] <= rows["before"]
    pixels = torch.cartesian_prod(torch.arange(12), torch.arange(32), torch.arange(32))
    # as above
    assert loop.held_out_psnr(scene, photos_of(12, 32), pixels, physical=True) > 17


def test_a_light_without_networks_is_adapted_too(data, tmp_path):
    light = EnvmapConfig(rows=8, directions=8, directions_eval=8)
    cfg = config(data, tmp_path / "run", light)
    stages = tuple(dataclasses.replace(s, iterations=8, rays=64) for s in cfg.stages)
    out = train(dataclasses.replace(cfg, stages=stages))
    assert [c["what"] for c in load_checkpoint(out)[1]["chosen"]] == ["mirror levels", "reach"]


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


def test_rows_that_no_probe_meets_or_whose_going_would_be_seen_stay(reference):
    scene = hash_scene()
    before = scene.field.features.detach().clone()
    choice = drop_rows_(scene, reference, [])
    assert choice.before == choice.after > 0
    assert torch.equal(scene.field.features, before)
    for first in heads(scene):  # all levels are read
        first.weight.data.normal_()
    choice = drop_rows_(scene, reference, [reference], limit_db=-1.0)
    assert (choice.cost, choice.before) == (0.0, choice.after)
    assert torch.equal(scene.field.features, before)


def test_what_a_file_leaves_out_is_no_reason_to_trace_anew():
    held_out = reference_of_two_views()
    scene = feature_scene()
    tracer, sdf = scene.occluder(), scene.field.sdf.detach().clone()
    compression.storage_loss_db(scene, held_out, held_out.decoded(scene), 1.0)
    assert scene.occluder() is tracer
    assert torch.equal(scene.field.sdf, sdf)


def test_a_budget_is_kept_at_any_cost(tmp_path):
    held_out = reference_of_two_views()
    scene = feature_scene()
    scene.field = scene.field.resized(fit_grid(*scene.field.bounds(), 60_000))
    whole = save_scene(scene, tmp_path, {}, slim=True, reach=4.0).stat().st_size
    assert compression.fit_budget_(scene, held_out, 4.0, 2 * whole) == []
    budget = 0.15 * whole
    choices = compression.fit_budget_(scene, held_out, 4.0, budget)
    assert [c.kind for c in choices] == ["reach", "voxels"]
    assert choices[0].cost > 0
    file = save_scene(scene, tmp_path, {}, slim=True, reach=choices[0].after)
    assert file.stat().st_size <= budget


def test_what_a_budget_has_room_for():
    with pytest.raises(ValueError, match=r"budget_mb must be at least 0.* got 0.001"):
        compression.check_budget(sphere_scene(16), 0.001)
    compression.check_budget(sphere_scene(16), 1.0)
    scene = SceneConfig()  # 16 channels: 8 levels
    assert compression.table_rows(scene, None) == ROWS
    assert compression.table_rows(scene, 100.0) == ROWS
    assert compression.table_rows(scene, 1.0) == 2**12  # 8 levels of 8 bytes a row: half of 0.5 MB
    assert compression.table_rows(scene, 1e-3) == FEWEST_ROWS


@pytest.mark.parametrize(
    ("megabytes", "levels"), [(None, 5), (40.0, 5), (1.0, 3), (0.3, 2), (0.02, 1)]
)
def test_a_budget_leaves_room_for_some_mirror_levels(megabytes, levels):
    assert compression.mirror_levels(SceneConfig(), megabytes) == levels
    assert compression.mirror_levels(SceneConfig(mirror_levels=1), megabytes) == 1
