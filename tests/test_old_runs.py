"""Runs of earlier versions are read: tests/runs/VERSION holds what each wrote, a few steps long."""

import shutil
from dataclasses import replace
from pathlib import Path

import pytest

import univoxel
from univoxel.cli.info import info, tables
from univoxel.config import check_same, load_config
from univoxel.scene import load_checkpoint

RUNS = sorted((Path(__file__).parent / "runs").iterdir())


@pytest.fixture(params=RUNS, ids=lambda path: path.name)
def run(request, tmp_path):
    return Path(shutil.copytree(request.param, tmp_path / "run"))


def test_the_model_draws(run):
    opened = univoxel.open_run(run)
    assert len(opened.mesh().vertices) > 100
    assert opened.verdict is None  # there was none
    assert opened.trust.startswith("Doubt of albedo")
    picture = univoxel.relight(
        run, Path(univoxel.__file__).parent / "example_data/tiny/envmaps/city.hdr", samples=4,
        cameras="orbit 1", resolution=16,
    )[0]  # fmt: skip
    assert picture.shape == (16, 16, 4)
    assert float(picture[..., 3].max()) > 0.5


def test_what_it_is_told_of(run):
    found = info(run)
    assert found["result"] is None
    assert next(iter(tables(found))).startswith("Result: not judged")
    (run / "trust.txt").unlink()  # training wrote it at its end
    assert next(iter(tables(info(run)))).startswith("Result: unfinished")


def test_a_training_goes_on_with_its_configuration(run):
    """Fields that are gone are no difference."""
    cfg = replace(load_config(run / "config.json"), out=run)
    check_same(cfg)
    _, state = load_checkpoint(run)
    assert state["stage"] == len(cfg.stages)
