"""What the file of a finished scene leaves out."""

import torch
from spare_scene import feature_scene, reference_of_two_views

from univoxel.checkpoint import save_scene
from univoxel.compression.config import CompressionConfig
from univoxel.compression.storage import fit_budget_, storage_loss_db
from univoxel.grid import fit_grid

CFG = CompressionConfig()


def test_what_a_file_leaves_out_is_no_reason_to_trace_anew():
    held_out, _ = reference_of_two_views()
    scene = feature_scene()
    tracer, sdf = scene.occluder(), scene.field.sdf.detach().clone()
    storage_loss_db(scene, held_out, held_out.decoded(scene), 1.0)
    assert scene.occluder() is tracer
    assert torch.equal(scene.field.sdf, sdf)


def test_a_budget_is_kept_at_any_cost(tmp_path):
    held_out, _ = reference_of_two_views()
    scene = feature_scene()
    scene.field = scene.field.resized(fit_grid(*scene.field.bounds(), 60_000))
    whole = save_scene(scene, tmp_path, {}, slim=True, reach=4.0).stat().st_size
    assert fit_budget_(scene, held_out, 4.0, 2 * whole, CFG) == []
    budget = 0.15 * whole
    choices = fit_budget_(scene, held_out, 4.0, budget, CFG)
    assert [c.kind for c in choices] == ["reach", "voxels"]
    assert choices[0].cost > 0
    file = save_scene(scene, tmp_path, {}, slim=True, reach=choices[0].after)
    assert file.stat().st_size <= budget
