"""What the kill test takes for broken, left over and lost; `make kill-test` ends real commands."""

import json
import time

import numpy as np
import pytest
from kill import SIGNALS, Toll, broken_files, ended, left_over, lost_seconds, report
from PIL import Image
from safetensors.numpy import save_file


@pytest.fixture
def run(tmp_path):
    """A run that had saved after 10 s, and had told of 14."""
    state = {"univoxel": json.dumps({"state": {"seconds": 10.0}})}
    save_file({"x": np.zeros(3000, np.float32)}, tmp_path / "scene.safetensors", state)
    (tmp_path / "log.jsonl").write_text('{"seconds": 9.0}\n{"seconds": 14.0}\n')
    (tmp_path / "config.json").write_text("{}")
    Image.fromarray(np.zeros((40, 40, 3), np.uint8)).save(tmp_path / "preview.png")
    (tmp_path / "index.html").write_text("<html></html>\n")
    (tmp_path / "mesh.glb").write_bytes(b"glTF" + bytes(4) + (12).to_bytes(4, "little"))
    return tmp_path


def test_files_that_are_cut_short_or_left_over_are_found(run):
    assert broken_files(run) == left_over(run) == []
    names = sorted(path.name for path in run.iterdir())
    for name in names:
        path = run / name
        path.write_bytes(path.read_bytes()[: -path.stat().st_size // 3])
    assert [line.partition(":")[0] for line in broken_files(run)] == names
    (run / "scene.safetensors.tmp123").write_bytes(b"")
    assert left_over(run) == ["scene.safetensors.tmp123"]


def test_what_was_not_saved_is_lost(run):
    told = (run / "log.jsonl").stat().st_mtime
    assert lost_seconds(run, told + 2.0) == pytest.approx(14 + 2 - 10, abs=0.1)
    (run / "scene.safetensors").unlink()
    assert lost_seconds(run, told + 2.0) == pytest.approx(16, abs=0.1)
    (run / "log.jsonl").unlink()
    assert lost_seconds(run, time.time()) == 0


def test_a_command_is_ended_or_has_ended():
    assert ended(("completion", "bash"), 0.05, SIGNALS[0])
    assert not ended(("completion", "bash"), 60.0, SIGNALS[0])


def test_each_fault_makes_the_exit_code():
    assert report({"train": Toll(5, lost=20.0)}) == 0
    faults = ({"broken": ["x"]}, {"refused": ["x"]}, {"differing": ["x"]}, {"lost": 31.0})
    assert [report({"train": Toll(5), "eval": Toll(1, **fault)}) for fault in faults] == [1] * 4
