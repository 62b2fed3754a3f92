"""Many trainings: each on an analytic scene with settings that take a moment."""

import dataclasses
import json
import os
import re
import shutil
import threading

import pytest
from analytic import write_scene
from filelock import FileLock
from tiny import OF_LOBES as TINY

from lab import runner, worker
from lab.record import Setting, load_outcome
from univoxel.batch.jobs import Result
from univoxel.errors import DataError
from univoxel.evaluation.measures import MEASURES
from univoxel.scene import FILE

# Its steps take seconds; draft's minute would cut them on a busy machine
SMALL = Setting("small", "draft", "sg", minutes=30, changes=TINY)
DIES = dataclasses.replace(SMALL, name="dies", changes=(*TINY, f"seed={10**30}"))


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return write_scene(tmp_path_factory.mktemp("many") / "ball", views=6, size=16)


@pytest.fixture(scope="module")
def out(data, tmp_path_factory):
    """A folder in which one setting came through and one failed."""
    out = tmp_path_factory.mktemp("out")
    assert [bool(o.error) for o in runner.run([data], [DIES, SMALL], out, samples=1)] == [1, 0]
    return out


@pytest.fixture
def trained(monkeypatch):
    """The names of the settings whose process was started, in place of the process."""
    names = []

    def note(client, jobs, total, tries):
        for job in jobs:
            scene, _, setting = job.name.partition("/")
            names.append(setting)
            job.files.parent.mkdir(parents=True, exist_ok=True)
            runner.Outcome(scene, setting, {}).save(job.files.parent)
            yield Result(job.name, "done")

    monkeypatch.setattr(runner, "run_jobs", note)
    return names


def test_a_training_is_recorded_with_every_measure(out):
    outcome = load_outcome(out / "ball" / "small")
    assert (outcome.scene, outcome.setting, outcome.error) == ("ball", "small", None)
    assert set(MEASURES) | {"map_ball_psnr", "map_brightest_degrees"} <= set(outcome.measures)
    assert outcome.measures["nvs_psnr"] > 5
    assert outcome.measures["peak_rss_mb"] > 50
    assert outcome.measures["steps_made"] == 1
    assert outcome.measures["map_ball_psnr"] is None  # local light has no map
    assert outcome.load_average is not None
    assert (out / "ball" / "small" / "run" / FILE).is_file()


def test_a_failure_is_recorded_and_the_rest_goes_on(out):
    outcome = load_outcome(out / "ball" / "dies")
    assert re.match("[A-Za-z]+Error: Overflow", outcome.error)
    assert not outcome.measures
    failed = runner.failures([outcome, load_outcome(out / "ball" / "small")])
    assert failed.startswith("1 of 2 training runs failed; ")
    assert f"ball/dies: {outcome.error}" in failed


def test_what_is_done_is_not_done_again(data, out, trained):
    again = runner.run([data], [DIES, SMALL], out, samples=1)
    assert trained == ["dies"]
    assert again[1] == load_outcome(out / "ball" / "small")
    assert runner.run([data], [SMALL], out, samples=1) == again[1:]
    assert trained == ["dies"]


def test_results_of_other_settings_are_not_taken(data, out, trained):
    other = dataclasses.replace(SMALL, changes=(*TINY, "seed=5"))
    for settings, samples in (([other], 1), ([SMALL], 2)):
        with pytest.raises(ValueError, match=r"small/result\.json: comes from another config"):
            runner.run([data], settings, out, samples=samples)
    assert not trained


def test_a_killed_evaluation_goes_on_from_the_trained_scene(out, tmp_path, monkeypatch):
    folder = tmp_path / "ball" / "small"
    shutil.copytree(out / "ball" / "small", folder)
    (folder / "result.json").unlink()
    monkeypatch.setattr(worker, "train", lambda config: pytest.fail("it was trained already"))
    worker.work(folder)
    assert load_outcome(folder).measures["nvs_psnr"] > 5


def test_a_killed_training_starts_anew(out, tmp_path, monkeypatch):
    folder = tmp_path / "ball" / "small"
    shutil.copytree(out / "ball" / "small", folder)
    (folder / "result.json").unlink()
    (folder / "run" / FILE).write_bytes(b"truncated")
    begun = []

    def train(config):
        begun.append(config)
        assert not config.out.exists()
        shutil.copytree(out / "ball" / "small" / "run", config.out)

    monkeypatch.setattr(worker, "train", train)
    worker.work(folder)
    assert len(begun) == 1


def test_two_processes_do_not_share_a_folder(data, out, tmp_path):
    """Who comes second waits, and takes what the first has left."""
    folder = tmp_path / "ball" / "small"
    shutil.copytree(out / "ball" / "small", folder)
    result = folder / "result.json"
    result.rename(folder / "later")
    lock = FileLock(folder / f"{worker.JOB}.lock", thread_local=False)

    def leave() -> None:
        (folder / "later").rename(result)
        lock.release()

    lock.acquire()
    timer = threading.Timer(1.0, leave)
    timer.start()
    found = runner.run([data], [SMALL], tmp_path, samples=1)
    timer.join()
    assert found == [load_outcome(out / "ball" / "small")]  # with its load and its seconds


def test_a_killed_process_is_an_outcome(data, tmp_path, monkeypatch):
    """It is not tried again in one sitting: a crash is what experiments look for."""
    (tmp_path / "killed.py").write_text("import os; os.kill(os.getpid(), 9)")
    monkeypatch.setattr(runner.worker, "__name__", "killed")
    monkeypatch.setenv("PYTHONPATH", f"{tmp_path}:{os.environ.get('PYTHONPATH', '')}")
    (outcome,) = runner.run([data], [SMALL], tmp_path / "out", samples=1)
    assert outcome.error.startswith("ended by SIGKILL")
    assert load_outcome(tmp_path / "out" / "ball" / "small") == outcome
    (tmp_path / "killed.py").write_text("")
    (outcome,) = runner.run([data], [SMALL], tmp_path / "other", samples=1)
    assert outcome.error == "result.json is missing"


def test_mistakes_are_found_before_anything_is_trained(data, tmp_path, trained):
    other = tmp_path / "b" / "ball"
    shutil.copytree(data, other)
    (other / "transforms_test.json").unlink()
    out = tmp_path / "out"

    def refused(error, match, scenes=(data,), settings=(SMALL,), samples=1):
        with pytest.raises(error, match=match):
            runner.run(scenes, settings, out, samples)

    refused(ValueError, "expected scene folders with different names", [data, other])
    refused(ValueError, "expected at least one scene", [])
    refused(DataError, "transforms_test", [other])
    refused(
        ValueError, r"settings with different names, got \['small', 'small'\]", [data], [SMALL] * 2
    )
    escaping = dataclasses.replace(SMALL, name="../up")
    refused(ValueError, r"settings with different names, got \['../up'\]", settings=[escaping])
    refused(ValueError, "samples must be at least 1, got 0", samples=0)
    unknown = dataclasses.replace(SMALL, changes=("seed=x",))
    refused(ValueError, "changes=seed=x: expected a value such as 0 .int", settings=[unknown])
    assert not trained
    assert not out.exists()


def test_scenes_with_settings_of_their_own(data, tmp_path, trained):
    other = tmp_path / "other"
    other.mkdir()  # cannot be read: its process says so, the rest continues
    twice = dataclasses.replace(SMALL, name="twice")
    pairs = [(data, SMALL), (other, twice), (data, twice)]
    found = runner.run_pairs(pairs, tmp_path / "out", samples=1)
    assert [(o.scene, o.setting) for o in found] == [(d.name, s.name) for d, s in pairs]
    assert trained == ["small", "twice", "twice"]
    with pytest.raises(ValueError, match="settings with different names, got"):
        runner.run_pairs([(data, SMALL), (data, SMALL)], tmp_path / "out", samples=1)


def test_the_log_is_kept_for_charts(tmp_path):
    assert worker.read_log(tmp_path / "log.jsonl") == []
    line = {"seconds": 5.0, "stage": 1, "held_out_psnr": None, "losses": {}}
    (tmp_path / "log.jsonl").write_text(json.dumps(line) + "\n")
    assert worker.read_log(tmp_path / "log.jsonl") == [
        {"seconds": 5.0, "stage": 1, "held_out_psnr": None}
    ]
