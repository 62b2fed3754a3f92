"""The benchmarks' own machinery: a contender that dies must not take the run with it, nor one that
is not there be replaced."""

import os
from pathlib import Path

import pytest


def test_a_dying_contender_leaves_the_run_alone(monkeypatch):
    monkeypatch.syspath_prepend(Path(__file__).parent.parent / "benchmarks")
    workers = pytest.importorskip("workers")
    with pytest.raises(RuntimeError, match="ended with -6"):
        workers.Worker(os.abort)


def test_what_a_profile_times_is_there(monkeypatch):
    monkeypatch.syspath_prepend(Path(__file__).parent.parent / "benchmarks")
    profile_run = pytest.importorskip("profile_run")
    for part, places in profile_run.PARTS.items():
        for owner, name in places:
            assert callable(getattr(owner, name, None)), f"{part}: {owner} has no {name}"


def test_parts_that_run_once_include_what_they_call(monkeypatch):
    monkeypatch.syspath_prepend(Path(__file__).parent.parent / "benchmarks")
    profile_run = pytest.importorskip("profile_run")
    clock = profile_run.RunClock(None, lambda: 0.0)
    part = clock.timed("light", lambda: None)
    clock.timed("joint: Newton", part)()
    assert list(clock.forward) == ["joint: Newton"]
    clock.timed("march", part)()
    assert list(clock.forward) == ["joint: Newton", "light", "march"]


def test_rays_without_bare_embree_are_refused(monkeypatch, tmp_path, capsys):
    monkeypatch.syspath_prepend(Path(__file__).parent.parent / "benchmarks")
    monkeypatch.setattr("sys.argv", ["relight.py", str(tmp_path / "out.json"), "--only", "rays"])
    benchmark = pytest.importorskip("relight", exc_type=ImportError)
    monkeypatch.setattr(benchmark, "BARE_EMBREE", tmp_path / "none.so")
    with pytest.raises(SystemExit):
        benchmark.main()
    assert "none.so, which is not there: `make build/.bench`" in capsys.readouterr().err
