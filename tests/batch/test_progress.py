"""What is shown of jobs at work: rows on a terminal, lines elsewhere, time that is left."""

import io
import logging

import pytest
from rich.console import Console

from univoxel.batch import jobs
from univoxel.batch.jobs import ProgressTable, Result
from univoxel.core import progress_bar

TOLD = ("mug", "train", 0.25, 23.1)


@pytest.fixture
def clock(monkeypatch):
    """Seconds that have passed."""
    time = {"now": 0.0}
    monkeypatch.setattr(jobs.time, "monotonic", lambda: time["now"])
    return time


def test_lines_name_who_is_at_work(clock, monkeypatch, caplog):
    monkeypatch.setattr(progress_bar, "LINE_SECONDS", 0.0)

    def line(table: ProgressTable) -> str:
        table.refresh()
        return caplog.messages[-1]

    with caplog.at_level(logging.INFO, "univoxel"):
        table = ProgressTable(1, 3)
        table.tell(*TOLD)
        assert line(table).startswith("1/3  mug train 25% 23.1 dB")
        table.tell("cup", "eval", None, None)
        assert "25% 23.1 dB  cup eval" in line(table)
        clock["now"] = 60.0
        table.ended(Result("mug", "failed", {"train": "x"}))
        assert line(table).startswith("2/3  1 failed  about 0:01:00 left  cup eval")
        table.ended(Result("cup", "killed"))  # it is tried again
        assert "cup" not in line(table)


def test_rows_on_a_terminal(monkeypatch, caplog):
    drawn = io.StringIO()
    console = Console(file=drawn, force_terminal=True, width=120)
    monkeypatch.setattr(progress_bar, "Console", lambda stderr: console)
    with caplog.at_level(logging.INFO, "univoxel"):
        table = ProgressTable(0, 2)
        with table.progress:
            table.tell(*TOLD)
            table.tell("cup", "eval", None, None)
            table.refresh()
            table.progress.refresh()
        (task,) = table.progress.tasks
        assert (task.description, task.completed) == ("0/2", 0.25)
        assert task.fields["facts"] == "mug train 25% 23.1 dB\ncup eval"
        assert "cup eval" in drawn.getvalue()
