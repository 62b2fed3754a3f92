"""Progress: bars on terminals, lines of the log elsewhere; and independent pieces side by side."""

import io
import logging
import threading

import pytest
import torch
from rich.console import Console
from rich.progress import BarColumn, TextColumn

from univoxel.core import progress_bar
from univoxel.core.memmap import parallel_map


@pytest.fixture
def clock(monkeypatch):
    """Seconds that pass from one look at the clock to the next."""
    steps = {"by": 4.0, "now": 0.0}

    def now():
        steps["now"] += steps["by"]
        return steps["now"]

    monkeypatch.setattr(progress_bar, "monotonic", now)
    return steps


def test_lines_where_there_is_no_terminal(caplog, capfd, clock):
    with caplog.at_level(logging.INFO, "univoxel"):
        assert list(progress_bar.track(range(30), "rendering")) == list(range(30))
    lines = [r.getMessage() for r in caplog.records]
    assert 1 < len(lines) < 30  # not one for each
    assert all(line.startswith("rendering") and "%" in line for line in lines)
    assert all(r.progress for r in caplog.records)
    assert capfd.readouterr() == ("", "")
    caplog.clear()  # short work says nothing
    clock["by"] = 0.01
    with caplog.at_level(logging.INFO, "univoxel"):
        list(progress_bar.track(range(30), "rendering"))
    assert caplog.messages == []


def test_a_line_holds_what_the_columns_say(caplog, clock):
    clock["by"] = 11.0
    columns = TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[facts]}")
    with caplog.at_level(logging.INFO, "univoxel"), progress_bar.bar(*columns) as shown:
        task = shown.add_task("", total=1.0, facts="")
        shown.update(task, completed=0.25, description="stage 1/4", facts="loss 0.5 ")
    assert caplog.messages == ["stage 1/4  loss 0.5"]


@pytest.mark.parametrize(("level", "shown"), [(logging.INFO, True), (logging.WARNING, False)])
def test_a_bar_on_a_terminal_for_who_asked(monkeypatch, caplog, level, shown):
    drawn = io.StringIO()
    monkeypatch.setattr(
        progress_bar, "Console", lambda stderr: Console(file=drawn, force_terminal=True, width=80)
    )
    with caplog.at_level(level, "univoxel"):
        list(progress_bar.track(range(3), "rendering"))
    assert ("rendering" in drawn.getvalue()) == shown
    assert caplog.messages == []


@pytest.fixture(params=[1, 2])
def threads(request):
    before = torch.get_num_threads()
    torch.set_num_threads(request.param)
    yield request.param
    torch.set_num_threads(before)


def test_pieces_side_by_side(threads):
    """In order, as many at once as torch has threads, with the error of one."""
    assert parallel_map(lambda x: x * x, range(50)) == [x * x for x in range(50)]
    meet = threading.Barrier(threads, timeout=20)
    parallel_map(lambda _: meet.wait(), range(2 * threads))  # one alone would wait in vain
    with pytest.raises(ZeroDivisionError):
        parallel_map(lambda x: 1 / x, [1, 0, 2])
