"""Checkpoints: what goes in comes out; what is damaged is refused in one line."""

import copy
import dataclasses
import json
import math
import os
import subprocess
import sys
from unittest.mock import Mock

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from univoxel import lights
from univoxel.errors import ConfigError
from univoxel.fields import field as fields
from univoxel.fields.bricks import BrickDistances
from univoxel.fields.field import Levels, dense_field, hash_field
from univoxel.fields.grid import fit_grid
from univoxel.scene import FILE, SHELL, Scene, SceneConfig, load_checkpoint, load_scene, save_scene
from univoxel.training.compression import drop_mirror_levels_
from univoxel.training.loop import restore_surface_

LIGHTS = [
    lights.SGConfig(lobes=3),
    lights.SHConfig(order=4),
    lights.MLPLightConfig(rank=5),
    lights.EnvmapSGConfig(lobes=7),
    lights.EnvmapConfig(rows=16),
    lights.BakedConfig(),
]


def small_scene(light=None):
    torch.manual_seed(0)
    grid = fit_grid(torch.full((3,), -0.7), torch.full((3,), 0.7), 12**3)
    field = dense_field(grid, 4, grid.nodes().norm(dim=-1) - 0.5)
    with torch.no_grad():
        field.features[3:6, 3:6, 3:6] = torch.randn(3, 3, 3, 4)
    light = light or lights.SGConfig()
    cfg = SceneConfig(channels=4, material_channels=2, hidden=8, mirror_levels=2, light=light)
    scene = Scene(cfg, field, inv_s=20.0)
    with torch.no_grad():
        scene.radiance.directions.table[7:99] = torch.randn(92, 2)
    return scene


@pytest.mark.parametrize("light", LIGHTS, ids=lambda light: light.kind)
def test_a_checkpoint_gives_the_same_scene(tmp_path, light):
    scene = small_scene(light)
    assert scene.training
    save_scene(scene, tmp_path, {"step": 7})
    assert load_file(tmp_path / FILE)["field.feature_rows"].numel() == 27  # that are not 0
    again, state = load_checkpoint(tmp_path)
    assert state == {"step": 7}
    assert again.inv_s == scene.inv_s
    assert again.cfg == scene.cfg
    assert not again.training
    assert again.field.grid == scene.field.grid
    stored = again.state_dict()
    assert stored.keys() == scene.state_dict().keys()
    assert all(torch.equal(stored[name], value) for name, value in scene.state_dict().items())
    # Others may read it, as they may any file of this user
    (tmp_path / "any").write_text("")
    assert (tmp_path / FILE).stat().st_mode == (tmp_path / "any").stat().st_mode
    local = isinstance(lights.build(4, light), lights.AbstractLocalLight)  # knows the object's size
    assert getattr(lights.scaled(light, 3.0), "scale", None) == (3.0 if local else None)
    shown = scene.environment()  # the map that there is, of the sky or the light
    if light.kind.startswith("envmap"):
        assert shown is scene.light
        assert shown.latlong(4).shape == (4, 8, 3)
    else:
        assert shown is scene.sky
        assert shown is not None


def test_a_checkpoint_keeps_a_map_that_is_sharper_than_its_nodes(tmp_path):
    """As runs of version 0.2 have one."""
    scene = small_scene()
    sky = torch.rand(32, 64, 3)
    sky[3, 5] = 1e6  # a lamp beyond half precision
    scene.sky.sharp = sky
    scene.cfg = dataclasses.replace(scene.cfg, sky_rows=32)
    save_scene(scene, tmp_path, {})
    again = load_scene(tmp_path)
    assert again.cfg.sky_rows == 32
    assert torch.equal(again.sky.sharp, sky)
    save_scene(scene, tmp_path, {}, slim=True)
    with safe_open(tmp_path / "scene.safetensors", "pt") as file:
        assert file.get_tensor("sky.sharp").dtype == torch.float16
    slim = load_scene(tmp_path).sky.sharp
    assert torch.allclose(slim, sky.clamp_max(65504), rtol=1e-3, atol=1e-6)
    assert small_scene().cfg.sky_rows == 0
    with pytest.raises(ConfigError, match="sky_rows must be in"):
        SceneConfig(sky_rows=-1)


def test_reading_does_not_import_the_compiler(tmp_path):
    """Operations on torch's meta device do: a second and a half of each command that reads one."""
    runs = []
    for light in LIGHTS:
        run = tmp_path / light.kind
        run.mkdir()
        save_scene(small_scene(light), run, {})
        runs.append(str(run))
    program = """
import sys
from univoxel.scene import load_checkpoint
for run in sys.argv[1:]:
    load_checkpoint(run)
    if "torch._dynamo" in sys.modules:
        sys.exit(run)
"""
    subprocess.run([sys.executable, "-c", program, *runs], check=True)


def test_a_file_without_a_table_of_directions_is_one_from_before_there_were_any(tmp_path):
    scene = small_scene()
    drop_mirror_levels_(scene, 0)
    path = save_scene(scene, tmp_path, {})
    with safe_open(path, "pt") as file:
        meta = json.loads(file.metadata()["univoxel"])
    del meta["scene"]["mirror_levels"]
    tensors = {k: v for k, v in load_file(path).items() if not k.startswith("radiance.direction_")}
    save_file(tensors, path, {"univoxel": json.dumps(meta)})
    again = load_scene(tmp_path)
    assert again.cfg == scene.cfg
    for name, value in scene.state_dict().items():
        assert torch.equal(again.state_dict()[name], value), name


def test_a_slim_file_holds_what_is_seen(tmp_path):
    """Half the precision, and nothing of features where no ray stops."""
    scene = small_scene()
    distance = scene.field.sdf.detach().abs() / scene.field.voxel_size
    with torch.no_grad():
        scene.field.features.copy_(torch.randn(*scene.field.grid.size, 4))
    stored = load_file(save_scene(scene, tmp_path, {}, slim=True))
    assert stored["field.sdf"].dtype == stored["field.feature_values"].dtype == torch.float16
    assert len(stored["field.feature_rows"]) < scene.field.grid.nodes_count
    assert stored["radiance.direction_values"].shape == (92, 2)
    again = load_scene(tmp_path)
    kept, wanted = again.field.features, scene.field.features.detach()
    assert kept.dtype == again.field.sdf.dtype == torch.float32
    torch.testing.assert_close(kept[distance < 3.9], wanted[distance < 3.9], rtol=2**-11, atol=0)
    assert distance.max() > 4.1
    assert not kept[distance > 4.1].any()
    # Half precision has 11 bits
    near = distance < 4
    error = (again.field.sdf - scene.field.sdf)[near].abs().max() / scene.field.voxel_size
    assert error < 4 * 2**-11


def sparse_scene(nodes=20):
    scene = small_scene()
    grid = fit_grid(*scene.field.bounds(), nodes**3)
    scene.field = scene.field.in_bricks(grid)
    return scene


def test_a_checkpoint_of_a_sparse_field(tmp_path):
    scene = sparse_scene()
    field, rows = scene.field, 64 * scene.field.distances.count
    assert len(field.sdf) > rows
    save_scene(scene, tmp_path, {})
    again = load_scene(tmp_path).field
    assert again.kind == "sparse"
    assert again.grid == field.grid
    assert torch.equal(again.distances.bricks.table, field.distances.bricks.table)
    assert torch.equal(again.sdf, field.sdf[:rows])
    assert torch.equal(again.features, field.features[:rows])
    again.refresh()  # it can go on
    slim = sparse_scene(48)
    size = save_scene(slim, tmp_path, {}, slim=True).stat().st_size
    kept, field = load_scene(tmp_path).field, slim.field
    used = field.sdf[: len(kept.sdf)]
    near = used.abs() < 3.9 * field.voxel_size
    half = {"rtol": 2**-11, "atol": 1e-7}
    torch.testing.assert_close(kept.sdf, used, rtol=2**-11, atol=0)
    torch.testing.assert_close(kept.features[near], field.features[: len(used)][near], **half)
    slim.field = small_scene().field.resized(field.grid)
    assert size < 0.75 * save_scene(slim, tmp_path, {}, slim=True).stat().st_size


@pytest.mark.parametrize("slim", [False, True])
@pytest.mark.parametrize("dense_most", [fields.DENSE_MOST, 1000])
def test_a_checkpoint_of_a_hash_field(tmp_path, monkeypatch, dense_most, slim):
    """Over distances on a dense grid, or in bricks."""
    monkeypatch.setattr(fields, "DENSE_MOST", dense_most)
    scene = small_scene()
    grid = scene.field.grid
    levels = Levels.of(grid.bounds(), grid.voxel_size, scene.cfg.channels // 2)
    scene.field = hash_field(grid, levels, scene.field.sdf.detach())
    scene.field = field = scene.field.resized(fit_grid(*grid.bounds(), 40**3))
    with torch.no_grad():
        field.features[::3] = torch.randn(len(field.features[::3]), 2)
    save_scene(scene, tmp_path, {}, slim=slim)
    again = load_scene(tmp_path).field
    assert again.kind == "hash"
    assert isinstance(again.distances, BrickDistances) == (dense_most == 1000)
    assert (again.grid, again.levels) == (field.grid, field.levels)
    half = {"rtol": 2**-11 if slim else 0.0, "atol": 1e-7 * slim}
    torch.testing.assert_close(again.sdf, field.sdf[: len(again.sdf)], **half)
    read = field.rows_near(SHELL * field.voxel_size if slim else math.inf)[:, None]
    assert read.float().mean() < (0.9 if slim else 1.1)
    torch.testing.assert_close(again.features, field.features * read, **half)
    again.refresh()  # it can go on


def radius(tracer) -> float:
    return float(tracer.vertices.norm(dim=1).mean())


def grow(field, way="in place"):
    """In place, as an optimiser does; through a view, as between steps; or by another tensor."""
    with torch.no_grad():
        if way == "another":
            field.sdf.data = field.sdf.data + 0.2
        else:
            (field.sdf if way == "in place" else field.sdf.detach()).add_(0.2)


@pytest.mark.parametrize("way", ["in place", "a view", "another"])
def test_the_occluder_follows_the_surface(way):
    scene = small_scene()  # a ball of 0.5
    before = scene.occluder()
    assert scene.occluder() is before
    assert copy.deepcopy(scene).occluder() is not before  # a copy traces for itself
    assert scene.occluder() is before
    grow(scene.field, way)
    assert radius(before) > 0.45
    now = scene.occluder()
    assert radius(now) < 0.35
    scene.field = scene.field.resized(fit_grid(*scene.field.bounds(), 2000))
    assert scene.occluder() is not now


def test_a_held_surface_stays_until_it_is_released():
    scene = small_scene()
    assert radius(scene.occluder()) > 0.45
    grow(scene.field)
    with scene.surface_held():
        before = scene.occluder()
        assert radius(before) < 0.35  # what was traced before is stale
        grow(scene.field)
        assert scene.occluder() is before
        with scene.surface_held():  # within another block nothing is let go
            assert scene.occluder() is before
        scene.release_surface()
        assert radius(scene.occluder()) < 0.2
        with torch.no_grad():  # back, as by the guard of a stage
            scene.field.sdf -= 0.4
        restore_surface_(scene)
        assert radius(scene.occluder()) > 0.45
    grow(scene.field)
    grow(scene.field)
    grow(scene.field)
    with pytest.raises(ValueError, match=r"zero level|surface"):
        scene.occluder()


def test_a_failed_write_keeps_the_checkpoint_before(tmp_path, monkeypatch):
    save_scene(small_scene(), tmp_path, {"step": 1})

    monkeypatch.setattr(os, "replace", Mock(side_effect=OSError(28, "No space left on device")))
    with pytest.raises(OSError, match=r"scene.safetensors: cannot write .* No space left"):
        save_scene(small_scene(), tmp_path, {"step": 2})
    monkeypatch.undo()
    assert load_checkpoint(tmp_path)[1] == {"step": 1}
    assert [p.name for p in tmp_path.iterdir()] == [FILE]


def test_fields_and_lights_of_other_kinds(tmp_path):
    assert lights.read_config({"lobes": 4}) == lights.SGConfig(lobes=4, directions=128)  # older
    scene = small_scene()
    grid = scene.field.grid
    levels = Levels.of(grid.bounds(), grid.voxel_size, 1 + scene.cfg.channels // 2)
    scene.field = hash_field(grid, levels, scene.field.sdf.detach())
    save_scene(scene, tmp_path, {})
    with pytest.raises(ValueError, match="the field has 6 channels, but the networks use 4"):
        load_scene(tmp_path)


@pytest.mark.parametrize(
    ("scene", "name", "tensor"),
    [
        (small_scene, "field.sdf", torch.zeros(2, 2, 2)),
        (sparse_scene, "field.sdf", torch.zeros(128)),
        (sparse_scene, "field.place", torch.zeros(9).int()),
        (sparse_scene, "field.inside", torch.zeros(1).to(torch.uint8)),
    ],
)
def test_tensors_that_do_not_fit(tmp_path, scene, name, tensor):
    path = save_scene(scene(), tmp_path, {})
    with safe_open(path, "pt") as file:
        meta = file.metadata()
    tensors = load_file(path)
    tensors[name] = tensor
    save_file(tensors, path, meta)
    with pytest.raises(ValueError, match="the tensors do not match the header"):
        load_scene(tmp_path)
