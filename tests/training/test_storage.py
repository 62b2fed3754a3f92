"""What the file of a finished scene leaves out, and what a budget of bytes has room for."""

import pytest
import torch
from analytic import sphere_scene
from spare_scene import feature_scene, reference_of_two_views

from univoxel.fields.field import FEWEST_ROWS, ROWS
from univoxel.fields.grid import fit_grid
from univoxel.scene import SceneConfig, save_scene
from univoxel.training import compression


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


def test_a_budget_too_small_for_anything():
    with pytest.raises(ValueError, match=r"budget_mb must be at least 0.* got 0.001"):
        compression.check_budget(sphere_scene(16), 0.001)
    compression.check_budget(sphere_scene(16), 1.0)


@pytest.mark.parametrize(
    ("megabytes", "levels"), [(None, 5), (40.0, 5), (1.0, 3), (0.3, 2), (0.02, 1)]
)
def test_a_budget_leaves_room_for_some_mirror_levels(megabytes, levels):
    assert compression.mirror_levels(SceneConfig(), megabytes) == levels
    assert compression.mirror_levels(SceneConfig(mirror_levels=1), megabytes) == 1


def test_a_budget_decides_on_the_rows_of_a_hash_table():
    scene = SceneConfig()  # 16 channels: 8 levels
    assert compression.table_rows(scene, None) == ROWS
    assert compression.table_rows(scene, 100.0) == ROWS
    assert compression.table_rows(scene, 1.0) == 2**12  # 8 levels of 8 bytes a row: half of 0.5 MB
    assert compression.table_rows(scene, 1e-3) == FEWEST_ROWS
