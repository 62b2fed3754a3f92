"""Runs of earlier versions are read: tests/runs/VERSION holds what each wrote.

0.2 is a training of a few steps. 0.1 is what the last commit before 0.2 was begun saved of a sphere
on a dense grid under lobes alone, with exposures and refined cameras, and nothing trained: version,
configuration, model and trust.txt were written by its own `save_config`, `save_scene` and
`confidence.words`, the log by hand in its keys.
"""

import json
import math
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import trimesh
from analytic import write_scene

import univoxel
from univoxel.cli.info import info, tables
from univoxel.config import check_same, load_config
from univoxel.scene import load_checkpoint

RUNS = Path(__file__).parent / "runs"
CITY = Path(univoxel.__file__).parent / "example_data/tiny/envmaps/city.hdr"


@pytest.fixture(params=["0.1", "0.2"])
def version(request):
    return request.param


@pytest.fixture
def run(version, tmp_path):
    return Path(shutil.copytree(RUNS / version, tmp_path / "run"))


def test_the_model_draws(run):
    opened = univoxel.open_run(run)
    assert len(opened.mesh().vertices) > 100
    assert opened.verdict is None  # there was none
    assert opened.trust.startswith("Doubt of albedo")
    view = {"samples": 4, "cameras": "orbit 1", "resolution": 16}
    picture = univoxel.relight(run, CITY, **view)[0]
    assert picture.shape == (16, 16, 4)
    assert float(picture[..., 3].max()) > 0.5


def test_it_is_measured_and_exported(run, tmp_path):
    data = write_scene(tmp_path / "data", views=3, size=48)
    measures = univoxel.evaluate(run, data, samples=4, json=tmp_path / "measures.json")
    assert math.isfinite(measures["nvs_psnr"])
    assert json.loads((tmp_path / "measures.json").read_text())["verdict"] is None
    (file,) = univoxel.export(run, tmp_path / "mesh.glb", texture_size=32)
    assert len(trimesh.load(file).geometry) == 1


def test_what_it_is_told_of(run):
    found = info(run)
    assert found["result"] is None
    assert next(iter(tables(found))).startswith("Result: unknown")
    (run / "trust.txt").unlink()  # training wrote it at its end
    assert next(iter(tables(info(run)))).startswith("Result: unfinished")


def test_a_training_goes_on_with_its_configuration(run, version):
    """Fields that are gone are no difference; those that came since say what was done then."""
    cfg = replace(load_config(run / "config.json"), out=run)
    check_same(cfg)
    later = (cfg.light_frame, cfg.stages[0].patches_from)
    assert later == (("world", 1.0) if version == "0.1" else ("auto", 0.2))
    _, state = load_checkpoint(run)
    assert state["stage"] == len(cfg.stages)
