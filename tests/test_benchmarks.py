"""The benchmarks' own machinery: a contender that dies must not take the run with it, nor one that
is not there be replaced."""

import os
import shlex
import subprocess
from pathlib import Path

import pytest


@pytest.fixture(autouse=True)
def importable(monkeypatch):
    monkeypatch.syspath_prepend(Path(__file__).parent.parent / "benchmarks")


def test_a_dying_contender_leaves_the_run_alone():
    workers = pytest.importorskip("workers")
    with pytest.raises(RuntimeError, match="ended with -6"):
        workers.Worker(os.abort)


def test_what_a_profile_times_is_there():
    profile_run = pytest.importorskip("profile_run")
    for part, places in profile_run.PARTS.items():
        for owner, name in places:
            assert callable(getattr(owner, name, None)), f"{part}: {owner} has no {name}"


def test_parts_that_run_once_include_what_they_call():
    profile_run = pytest.importorskip("profile_run")
    clock = profile_run.RunClock(None, lambda: 0.0)
    part = clock.timed("light", lambda: None)
    clock.timed("joint: Newton", part)()
    assert list(clock.forward) == ["joint: Newton"]
    clock.timed("march", part)()
    assert list(clock.forward) == ["joint: Newton", "light", "march"]


def test_rays_without_bare_embree_are_refused(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr("sys.argv", ["relight.py", str(tmp_path / "out.json"), "--only", "rays"])
    benchmark = pytest.importorskip("relight", exc_type=ImportError)
    monkeypatch.setattr(benchmark, "BARE_EMBREE", tmp_path / "none.so")
    with pytest.raises(SystemExit):
        benchmark.main()
    assert "none.so, which is not there: `make build/.bench`" in capsys.readouterr().err


@pytest.fixture
def figures():
    return pytest.importorskip("figures")


def test_every_figure_can_be_made_anew(figures):
    there = {path.stem for path in figures.RESULTS.glob("*.json")}
    assert {figure.name for figure in figures.FIGURES} == there
    for figure in figures.FIGURES:
        for command in figure.commands:
            program, name, *_ = shlex.split(command)
            assert program == "univoxel" or (figures.ROOT / name).is_file(), command


@pytest.fixture
def one_figure(figures, monkeypatch, tmp_path):
    """A single figure, whose command is Python's, its folder, and the program's arguments."""
    (tmp_path / "results").mkdir()
    write = "open('{work}/f.json', 'w').write('{{\\\"error\\\": 1}}')"
    figure = figures.Figure("f", 1, (f'python -c "{write}"',))
    monkeypatch.setattr(figures, "FIGURES", [figure])
    monkeypatch.setattr(figures, "RESULTS", tmp_path / "results")
    monkeypatch.setattr("sys.argv", ["figures.py", "data", "--work", str(tmp_path / "work")])
    return figure


def test_a_figure_is_made_once_of_each_version(figures, one_figure, monkeypatch, tmp_path, capfd):
    made = {"date": "2026-01-01", "commit": "a"}
    monkeypatch.setattr(figures, "made", lambda: made)
    assert figures.main() == 0
    result = tmp_path / "results/f.json"
    machine = {"machine": figures.plots.machine()}
    assert figures.json.loads(result.read_text()) == made | machine | {"error": 1}
    assert "f: of None, to be of a; 1 min" in capfd.readouterr().out
    assert figures.main() == 0
    assert capfd.readouterr().out == ""
    made["commit"] = "b"
    assert figures.main() == 0
    assert "f: of a, to be of b" in capfd.readouterr().out


def test_a_figure_that_fails_leaves_the_old_one(figures, one_figure, monkeypatch, tmp_path, capfd):
    result = tmp_path / "results/f.json"
    result.write_text('{"commit": "old"}')
    failing = figures.Figure("f", 1, ('python -c "raise SystemExit(3)"',))
    monkeypatch.setattr(figures, "FIGURES", [failing])
    assert figures.main() == 1
    assert "returned non-zero exit status 3" in capfd.readouterr().err
    assert figures.json.loads(result.read_text()) == {"commit": "old"}


def test_the_version_is_that_of_package_and_kernels(figures, monkeypatch, tmp_path):
    import made

    def git(*arguments):
        subprocess.run(["git", "-C", str(tmp_path), *arguments], check=True, capture_output=True)

    git("init")
    git("config", "user.email", "a@b")
    git("config", "user.name", "a")
    for folder in ("univoxel", "docs", "benchmarks"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "x").write_text("1")
    git("add", ".")
    git("commit", "-m", "one")
    monkeypatch.setattr(made, "__file__", str(tmp_path / "benchmarks/made.py"))
    first = made.made()["commit"]
    (tmp_path / "docs/x").write_text("2")
    git("commit", "-am", "two")
    assert made.made()["commit"] == first
    (tmp_path / "univoxel/x").write_text("2")
    assert made.made()["commit"] == f"{first}-dirty"
    git("commit", "-am", "three")
    third = made.made()["commit"]
    assert third not in (first, f"{first}-dirty")
    (tmp_path / "univoxel/x").write_text("3")
    git("commit", "-am", "four\n\nA message.\n\nFigures: unchanged")
    assert made.made()["commit"] == third
