"""What is shown of pieces at work: rows on a terminal, lines elsewhere, time that is left."""

import io
import logging
from pathlib import Path

import pytest
from rich.console import Console

from univoxel import bars
from univoxel.cluster import shown as module
from univoxel.cluster.piece import Ended, Piece, Told
from univoxel.cluster.shown import Shown, facts_of, minutes


@pytest.fixture
def clock(monkeypatch):
    """Seconds that have passed."""
    time = {"now": 0.0}
    monkeypatch.setattr(module.time, "monotonic", lambda: time["now"])
    return time


def pieces(*names: str, seconds: float = 100.0) -> list[Piece]:
    return [Piece(n, (), Path(), Path(), seconds=seconds) for n in names]


def test_lines_name_who_is_at_work(clock, monkeypatch, caplog):
    monkeypatch.setattr(bars, "LINE_SECONDS", 0.0)
    with caplog.at_level(logging.INFO, "univoxel"), Shown(pieces("mug", "cup"), 3) as shown:
        shown.now(Told("mug", "train", 20.0, 0.25, 2e4, 23.1))
        shown.refresh(2)
        assert caplog.messages[-1].startswith("1/3  mug train 25%  about 2 min left")
        clock["now"] = 60.0
        shown.ended(Ended("mug", "failed", {"train": "x"}))
        shown.refresh(1)
        assert caplog.messages[-1].startswith("2/3  1 failed  60 an hour  about 2 min left")
        shown.refresh(0)
        assert "waits for workers" in caplog.messages[-1]


def test_rows_on_a_terminal(clock, monkeypatch, caplog):
    drawn = io.StringIO()
    console = Console(file=drawn, force_terminal=True, width=120)
    monkeypatch.setattr(bars, "Console", lambda stderr: console)
    with caplog.at_level(logging.INFO, "univoxel"), Shown(pieces("mug", "cup"), 2) as shown:
        shown.now(Told("mug", "train", 20.0, 0.25, 2e4, 23.1))
        shown.refresh(2)
        shown._progress.refresh()
        assert "mug train" in drawn.getvalue()
        assert "25%  20k rays/s  held-out 23.1 dB  60 s left" in drawn.getvalue()
        shown.ended(Ended("mug", "done", seconds=50.0))
        shown.refresh(2)
        assert [task.description for task in shown._progress.tasks] == ["1/2"]
        shown.now(Told("mug", "train", 20.0))  # a late word of it
        shown.now(Told("cup", "eval", 1.0))
        shown.refresh(2)
        assert [task.description for task in shown._progress.tasks] == ["1/2", "cup eval"]
        clock["now"] = 31.0  # it has not told anything since
        shown.refresh(2)
        assert len(shown._progress.tasks) == 1


def test_time_that_is_left_follows_the_pace(clock):
    with Shown(pieces("a", "b", "c", "d"), 4) as shown:
        assert shown.left(2) == 200.0
        assert shown.left(8) == 100.0  # more workers than pieces
        shown.ended(Ended("a", "done", seconds=50.0))  # half of what was expected
        assert shown.left(1) == 150.0
        shown.ended(Ended("b", "failed", seconds=1.0))  # says nothing of the pace
        assert shown.left(1) == 100.0


def test_what_is_not_known_is_not_told():
    assert facts_of(Told("a", "eval", 3.0)) == []
    assert [minutes(x) for x in (89.0, 600.0, 7200.0)] == ["89 s", "10 min", "2.0 h"]
