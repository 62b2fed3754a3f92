"""Capacity that follows the scene: the criterion, the budget, and a run from end to end."""

import dataclasses
import json

import pytest
import torch
from analytic import photos_of, sphere_scene, write_scene

from univoxel.checkpoint import FILE, load_checkpoint, load_scene, save_scene
from univoxel.compression import plan, prune, search, sizes
from univoxel.compression.config import CompressionConfig
from univoxel.compression.quality import last_within_limit, reference_rays
from univoxel.compression.storage import fit_budget_
from univoxel.config import TrainConfig
from univoxel.fields.features import FEWEST_ROWS, ROWS, Levels
from univoxel.fields.field import hash_field
from univoxel.joint.config import JointConfig
from univoxel.lights import EnvmapConfig, SGConfig
from univoxel.scene import Scene, SceneConfig
from univoxel.tasks import train as task
from univoxel.tasks.info import info
from univoxel.tasks.train import train
from univoxel.training import loop
from univoxel.training.config import StageConfig
from univoxel.training.pixels import TrainingPixels
from univoxel.training.progress import Rehearsal

CFG = CompressionConfig()
LIGHT = SGConfig(lobes=4, hidden=16, directions=16, directions_eval=16)


@pytest.fixture(scope="module")
def reference():
    photos = photos_of(2, 24)
    pixels = torch.cartesian_prod(torch.arange(2), torch.arange(24), torch.arange(24))
    return reference_rays(photos, pixels), reference_rays(photos, pixels[::2])


def feature_scene():
    """Random features, two of whose four channels nothing reads; 4 lobes."""
    scene = sphere_scene(0, voxel_size=0.1, light=LIGHT).eval()
    scene.inv_s = 60.0
    g = torch.Generator().manual_seed(1)
    with torch.no_grad():
        scene.field.features.normal_(generator=g)
        for owner, name in prune.heads(scene):
            getattr(owner, name).linear[0].weight[
                :, [1, 3] if owner is not scene.material else 1
            ] = 0
        scene.light.head.linear[-1].weight.normal_(0, 0.1, generator=g)
    return scene


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


def test_moved_materials_are_a_cost(reference):
    held_out, _ = reference
    before = held_out.decoded(feature_scene())
    moved = before._replace(material=before.material + 0.1)
    assert held_out.loss_db(before, before) == 0
    assert held_out.loss_db(before, moved) > 0.02


@pytest.mark.parametrize(
    ("quality", "chosen"),
    [
        # voxels: PSNR; a ninth at a time from 364,500, then a third of the chosen
        ({364_500: 30.0, 40_500: 30.0, 4_500: 30.0}, 4_500),  # a plain scene: the coarsest
        ({364_500: 30.0, 40_500: 29.8, 4_500: 29.0, 121_500: 29.8}, 364_500),  # finer pays
        ({364_500: 30.0, 40_500: 29.8, 4_500: 29.0, 121_500: 29.95}, 121_500),  # a little less
        ({364_500: 30.0, 40_500: 29.8, 4_500: 29.95}, 4_500),  # between, chance had it
        ({364_500: 30.0, 40_500: 30.5, 4_500: 30.3, 13_500: 30.39}, 40_500),  # against the best
    ],
)
def test_a_grid_is_as_coarse_as_its_rehearsal_allows(quality, chosen, tmp_path, monkeypatch):
    scene = sphere_scene(0, voxel_size=0.1)
    box = scene.field.bounds()
    counts = {plan.fit_grid(*box, n): n for n in quality}

    stage = StageConfig(voxels=0.3645, iterations=40, share=1.0)
    cfg = TrainConfig(tmp_path, tmp_path, (stage, stage), minutes=1.0)
    pixels = TrainingPixels(photos_of(2, 8), torch.zeros(1, 3), torch.zeros(1, 3))

    def rehearse(cfg_, pixels_, tried, on_grid, steps):
        assert (cfg_, pixels_, steps) == (cfg, pixels, 8)
        assert on_grid == plan.on_grid(stage, box, tried.field.voxel_size)
        with torch.no_grad():
            tried.material.net.linear[-1].bias[0] = counts[tried.field.grid]
        return quality[counts[tried.field.grid]]

    monkeypatch.setattr(plan, "rehearsal", rehearse)
    (choice,) = plan.choose_grid_(scene, cfg, stage, box, pixels, pace=1.0)
    assert (choice.kind, choice.before, choice.after) == ("voxels", 364_500, chosen)
    assert counts[scene.field.grid] == chosen
    assert scene.material.net.linear[-1].bias[0] == chosen  # it goes on from that rehearsal
    assert "364,500 30.00 dB" in choice.why


def test_a_rehearsal_is_off_the_record():
    rehearsal = Rehearsal(4)
    assert list(rehearsal.clock.steps()) == [0, 0.25, 0.5, 0.75]
    assert rehearsal.clock.step == 4
    assert not rehearsal.due()
    assert not rehearsal.checkpoint_due()


def test_edges_stay_as_sharp_on_a_coarser_grid():
    stage = StageConfig(voxels=0.064, iterations=1, share=1.0, sharpness=(0.6, 0.3))
    box = torch.zeros(3), torch.ones(3)
    same = plan.on_grid(stage, box, plan.fit_grid(*box, 64_000).voxel_size)
    assert same.sharpness == pytest.approx(stage.sharpness)
    coarse = plan.on_grid(stage, box, plan.fit_grid(*box, 8_000).voxel_size)
    assert coarse.sharpness == pytest.approx((0.3, 0.15))  # voxels twice as wide


def test_no_grid_is_finer_than_the_photographs(tmp_path):
    photos = photos_of(3, 48)
    pixel = 1.8 / 48  # a picture is 1.8 wide at the origin
    grids = [StageConfig(voxels=v, iterations=1, share=0.5) for v in (5e-4, 1.0)]
    cfg = TrainConfig(tmp_path, tmp_path, (grids[0], JointConfig(), grids[1]), minutes=1.0)
    box = torch.tensor([-0.5, -0.5, -1.0]), torch.tensor([0.5, 0.5, 1.0])
    for wide in (1.0, 2.0):
        cut = plan.limited_to_pixels(
            dataclasses.replace(cfg, voxel_pixels=wide), photos.cameras, box
        )
        assert cut.stages[:2] == cfg.stages[:2]
        grid = plan.fit_grid(*box, plan.stage_voxels(cut.stages[2], []))
        assert grid.voxel_size == pytest.approx(wide * pixel, rel=1e-3)
    cut = plan.limited_to_pixels(dataclasses.replace(cfg, voxel_pixels=99.0), photos.cameras, box)
    assert plan.stage_voxels(cut.stages[2], []) == CFG.fewest_voxels
    free = dataclasses.replace(cfg, voxel_pixels=0.0)
    assert plan.limited_to_pixels(free, photos.cameras, box) == free


def test_a_budget_is_kept_at_any_cost(reference, tmp_path):
    held_out, _ = reference
    scene = feature_scene()
    scene.field = scene.field.resized(plan.fit_grid(*scene.field.bounds(), 60_000))
    whole = save_scene(scene, tmp_path, {}, slim=True, reach=4.0).stat().st_size
    assert fit_budget_(scene, held_out, 4.0, 2 * whole, CFG) == []
    budget = 0.15 * whole
    choices = fit_budget_(scene, held_out, 4.0, budget, CFG)
    assert [c.kind for c in choices] == ["reach", "voxels"]
    assert choices[0].cost > 0
    file = save_scene(scene, tmp_path, {}, slim=True, reach=choices[0].after)
    assert file.stat().st_size <= budget


def test_a_budget_too_small_for_anything():
    with pytest.raises(ValueError, match=r"budget_mb: 0.001 is too small for anything: .* need 0"):
        sizes.check_budget(sphere_scene(16), 0.001, CFG)
    sizes.check_budget(sphere_scene(16), 1.0, CFG)


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return write_scene(tmp_path_factory.mktemp("sphere") / "data")


def config(data, out, light=LIGHT, **changes):
    stages = (
        StageConfig(voxels=0.02, iterations=40, share=0.5, rays=256),
        StageConfig(voxels=0.05, iterations=50, share=0.5, rays=256, physical_from=0.3),
    )
    scene = SceneConfig(channels=4, material_channels=2, hidden=16, light=light, sky_nodes=0)
    cfg = TrainConfig(data, out, stages, minutes=2.0, scene=scene, capacity="adaptive")
    return dataclasses.replace(cfg, voxel_pixels=0.0, **changes)  # pictures are 32 pixels wide


@pytest.fixture(scope="module")
def run(data, tmp_path_factory):
    return train(config(data, tmp_path_factory.mktemp("adaptive") / "run", budget_mb=0.3))


def test_an_adapted_run_says_what_was_chosen_and_is_read_again(run, tmp_path):
    found = info(run, json=tmp_path / "info.json", picture=tmp_path / "picture.png")
    assert json.loads((tmp_path / "info.json").read_text()) == found
    assert (tmp_path / "picture.png").stat().st_size > 0
    kinds = [c["what"] for c in found["chosen"]]
    assert kinds[:2] == ["voxels", "channels"]
    assert "reach" in kinds
    assert found["bytes"] == (run / FILE).stat().st_size <= 0.3e6
    scene = load_scene(run)
    assert scene.cfg.channels == found["channels"] == scene.field.features.shape[-1]
    assert found["grid"]["nodes"] <= 6e4
    assert found["grid"]["share_with_distance"] < 1
    assert any("reach 4 -> " in choice["said"] for choice in found["chosen"])


def test_a_scene_drawn_from_an_adapted_file_is_the_one_that_was_trained(run, data):
    photos = photos_of(12, 32)
    pixels = torch.cartesian_prod(torch.arange(12), torch.arange(32), torch.arange(32))
    # black gives 9 dB, the right sphere in one mean colour 16
    assert loop.held_out_psnr(load_scene(run), photos, pixels, physical=True) > 17


def test_the_log_tells_of_choices(run):
    state = load_checkpoint(run)[1]
    assert state["chosen"][0]["said"].startswith("voxels 50,000 -> ")


@pytest.mark.parametrize(
    ("megabytes", "levels"), [(None, 5), (40.0, 5), (1.0, 3), (0.3, 2), (0.02, 1)]
)
def test_a_budget_leaves_room_for_some_mirror_levels(megabytes, levels):
    assert sizes.mirror_levels(SceneConfig(), megabytes, CFG) == levels
    assert sizes.mirror_levels(SceneConfig(mirror_levels=1), megabytes, CFG) == 1


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


def test_resume_goes_on_with_what_was_chosen(data, tmp_path, monkeypatch):
    cfg = config(data, tmp_path / "run")
    original, counts = task.run_stage, []

    def killed(scene, cfg, stage, pixels, progress):
        if not isinstance(progress, Rehearsal):
            if progress.clock.stage == 1:
                raise KeyboardInterrupt
            original(scene, cfg, stage, pixels, progress)
        # A rehearsal: the third grid serves as well as the first
        counts.append(scene.field.grid.nodes_count)

    for module in (task, loop):  # stages, and their rehearsals
        monkeypatch.setattr(module, "run_stage", killed)
    monkeypatch.setattr(loop, "held_out_psnr", lambda *_, **__: 20.0)
    with pytest.raises(KeyboardInterrupt):
        train(cfg)
    coarsest = counts[-1]
    assert coarsest < counts[1]
    with pytest.raises(ValueError, match="the run began with other capacity"):
        train(dataclasses.replace(cfg, capacity="fixed"), resume=True)
    seen = []
    monkeypatch.setattr(task, "run_stage", lambda scene, *_: seen.append(scene.field.grid))
    train(cfg, resume=True)
    assert [grid.nodes_count for grid in seen] == [coarsest]


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


def hash_scene():
    """Random features on four levels, of which the coarser two are read."""
    grid = plan.fit_grid(torch.full((3,), -0.7), torch.full((3,), 0.7), 15**3)
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


def test_a_budget_decides_on_the_rows_of_a_hash_table():
    scene = SceneConfig()  # 16 channels: 8 levels
    assert sizes.table_rows(scene, None, CFG) == ROWS
    assert sizes.table_rows(scene, 100.0, CFG) == ROWS
    assert sizes.table_rows(scene, 1.0, CFG) == 2**12  # 8 levels of 8 bytes a row: half of 0.5 MB
    assert sizes.table_rows(scene, 1e-3, CFG) == FEWEST_ROWS


def test_a_light_without_networks_is_adapted_too(data, tmp_path):
    light = EnvmapConfig(rows=8, directions=8, directions_eval=8)
    cfg = config(data, tmp_path / "run", light)
    stages = tuple(dataclasses.replace(s, iterations=8, rays=64) for s in cfg.stages)
    out = train(dataclasses.replace(cfg, stages=stages))
    assert [c["what"] for c in load_checkpoint(out)[1]["chosen"]][:2] == ["voxels", "channels"]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"capacity": "elastic"}, "capacity must be fixed or adaptive, got 'elastic'"),
        ({"budget_mb": -1.0}, "budget_mb must be above 0 or None, got -1"),
        ({"budget_mb": 1.0, "capacity": "fixed"}, "budget_mb 1 needs adaptive capacity"),
    ],
)
def test_bad_configurations(data, tmp_path, changes, message):
    with pytest.raises(ValueError, match=message):
        config(data, tmp_path / "run", **changes)


def test_a_picture_of_another_kind_is_refused(run, tmp_path):
    with pytest.raises(ValueError, match=r"picture: expected a .png file, got .*a.jpg"):
        info(run, picture=tmp_path / "a.jpg")
