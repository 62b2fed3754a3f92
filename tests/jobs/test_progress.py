"""What is shown of jobs at work: rows on a terminal, lines elsewhere, time that is left."""

import io
import logging

import pytest
from rich.console import Console

from univoxel import bars
from univoxel.jobs import progress
from univoxel.jobs.job import Result
from univoxel.jobs.progress import ProgressTable

TOLD = {"job": "mug", "process": "train", "share": 0.25, "held_out_psnr": 23.1}


@pytest.fixture
def clock(monkeypatch):
    """Seconds that have passed."""
    time = {"now": 0.0}
    monkeypatch.setattr(progress.time, "monotonic", lambda: time["now"])
    return time


def test_lines_name_who_is_at_work(clock, monkeypatch, caplog):
    monkeypatch.setattr(bars, "LINE_SECONDS", 0.0)
    with caplog.at_level(logging.INFO, "univoxel"):
        table = ProgressTable(1, 3)
        table.tell(TOLD)
        assert caplog.messages[-1].startswith("1/3  mug train 25%")
        table.tell({"job": "cup", "process": "eval"})
        assert caplog.messages[-1].startswith("1/3  mug train 25%  cup eval")
        clock["now"] = 60.0
        table.ended(Result("mug", "failed", {"train": "x"}))
        assert caplog.messages[-1].startswith("2/3  1 failed  cup eval  about 0:01:00 left")
        table.ended(Result("cup", "killed"))  # it is tried again
        assert caplog.messages[-1].startswith("2/3  1 failed  about 0:01:00 left")


def test_rows_on_a_terminal(monkeypatch, caplog):
    drawn = io.StringIO()
    console = Console(file=drawn, force_terminal=True, width=120)
    monkeypatch.setattr(bars, "Console", lambda stderr: console)
    with caplog.at_level(logging.INFO, "univoxel"):
        table = ProgressTable(0, 2)
        with table.progress:
            table.tell(TOLD)
            table.progress.refresh()
            assert "mug train 25%" in drawn.getvalue()
            assert "held-out 23.1 dB" in drawn.getvalue()
            table.tell({"job": "cup", "process": "eval"})
            table.ended(Result("mug", "done", seconds=50.0))
            assert [task.description for task in table.progress.tasks] == ["1/2", "cup eval"]
