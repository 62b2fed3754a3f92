"""The package as a library: a run from beginning to end, quiet, and cancelled half way."""

import dataclasses

import pytest
import torch
from analytic import cameras_around

import univoxel
from univoxel import api
from univoxel.envmap import EnvMap
from univoxel.errors import DataError, ExistingFile
from univoxel.presets import preset
from univoxel.training import progress as progress_module

SMALL = (
    *(f"stages.{i}.{field}" for i in (0, 1, 3) for field in ("voxels=0.01", "rays=128")),
    *("stages.0.iterations=10", "stages.1.iterations=20", "stages.3.iterations=5"),
    *("stages.2.iterations=10", "stages.2.points=200", "stages.2.newton_points=50"),
    *("stages.2.rays=64", "scene.sky_nodes=64", "voxel_pixels=0", "carving_seconds=0"),
)


@pytest.fixture
def data(tiny):
    return tiny / "data"


@pytest.fixture
def run(tiny):
    return univoxel.open_run(tiny / "run")


def test_a_run_and_what_it_can_do(run, tmp_path, capfd):
    rendered = run.render()
    assert rendered.shape == (2, 16, 16, 4)
    assert rendered[..., 3].max() > 0.9
    relit = run.relight(EnvMap(torch.ones(4, 8, 3)), cameras="orbit 2", resolution=16, samples=4)
    assert relit.shape == (2, 16, 16, 4)
    assert run.render(cameras_around(3, 16)).shape == (3, 16, 16, 4)
    assert run.export(str(tmp_path / "ball.ply")).stat().st_size > 1000
    assert run.light(8).radiance.shape == (8, 16, 3)
    assert run.mesh().albedo.shape == run.mesh().vertices.shape
    assert run.trust.strip()
    measures = run.evaluate(samples=2)
    assert measures["nvs_psnr"] > 10
    assert capfd.readouterr().out == ""
    again = univoxel.open_run(str(run.path))
    assert repr(again) == f"Run({str(run.path)!r})"
    assert torch.equal(again.mesh().vertices, run.mesh().vertices)


def test_cancelled_and_resumed(data, tmp_path, monkeypatch):
    monkeypatch.setattr(progress_module, "REPORT_SECONDS", 0.0)
    out, seen = tmp_path / "run", []

    def cancel(now):
        seen.append(now)
        if [one.stage for one in seen].count(2) == 5:
            raise univoxel.Cancelled

    with pytest.raises(univoxel.Cancelled):
        univoxel.train(data, out, minutes=2, changes=SMALL, on_progress=cancel)
    assert [now.stage for now in seen][-1] == 2
    assert all(0 <= now.share <= 1 and now.stages == 4 and now.losses for now in seen)
    with pytest.raises(ExistingFile):
        univoxel.train(data, out, minutes=2, changes=SMALL)
    again = []
    run = univoxel.train(data, out, minutes=2, changes=SMALL, on_progress=again.append, resume=True)
    assert again[0].stage == 2  # what was done is not done again
    assert run.mesh().vertices.isfinite().all()
    assert {"losses", "held_out_psnr", "seconds"} <= run.log[-1].keys()
    assert len(run.log) == len(seen) + len(again)
    steps = [line["step"] for line in run.log]
    assert len(steps) == len(set(steps)) + 1  # only the step that was cancelled is made again


def test_the_configuration_alone_is_enough_as_before(data, tmp_path, monkeypatch):
    asked = {}
    monkeypatch.setattr(
        api, "train_config", lambda cfg, **options: asked.update(options) or cfg.out
    )
    cfg = preset("draft", data, tmp_path / "run")
    assert univoxel.train(cfg, resume=True) == tmp_path / "run"
    assert asked["resume"]
    assert univoxel.train(dataclasses.replace(cfg), True) == tmp_path / "run"


def test_options_of_the_command_are_arguments(monkeypatch):
    asked = []
    monkeypatch.setattr(api, "train_config", lambda cfg, **_: asked.append(cfg) or cfg.out)
    monkeypatch.setattr(api, "Run", lambda path: path)
    options = {"preset": "draft", "field": "sparse", "masks": "given", "seed": 3, "downscale": 2}
    assert str(univoxel.train("photos", "run", **options, changes=("loss.radiance=2",))) == "run"
    cfg = asked[0]
    assert (cfg.masks, cfg.seed, cfg.downscale, cfg.loss.radiance) == ("given", 3, 2, 2.0)
    assert cfg.stages[1].field == "sparse"
    with pytest.raises(TypeError, match="colour"):
        univoxel.train("photos", "run", colour="red")
    with pytest.raises(TypeError, match="pass either a configuration or preset, not both"):
        univoxel.train(cfg, preset="draft")


def test_what_is_wrong_is_one_line_and_every_public_name_is_there(data, tmp_path):
    with pytest.raises(TypeError, match="out is missing: pass the folder"):
        univoxel.train(data)
    with pytest.raises(DataError, match="expected a folder with a scene"):
        univoxel.train(tmp_path / "nothing", tmp_path / "run")
    with pytest.raises(AttributeError, match="has no attribute 'trian'"):
        univoxel.trian  # noqa: B018
    with pytest.raises(FileNotFoundError, match="not a trained run"):
        univoxel.open_run(tmp_path)
    assert all(getattr(univoxel, name) is not None for name in univoxel.__all__)
    assert set(univoxel.__all__) <= set(dir(univoxel))
