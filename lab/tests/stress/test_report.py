"""Breaking points, tables and the picture of the stress suite, from made-up outcomes."""

import math
import pydoc

import pytest

from lab import plots
from lab.record import Outcome
from lab.stress import report
from lab.stress.axes import AXES, Axis, Level
from lab.stress.report import Break, Cell, breaking_point, kind
from univoxel import cli
from univoxel.errors import DataError

LEVELS = tuple(Level(v, f"{v:g}") for v in (0.0, 1.0, 2.0, 4.0))
AXIS = Axis("fog", "fog, metres", LEVELS)


def outcome(relit, scene="a", setting="sg-s0", error=None, **measures):
    measures = {} if error else {"relit_psnr": relit, "nvs_psnr": 30.0, "chamfer": None, **measures}
    return Outcome(scene, setting, {}, measures, error=error)


def broken(*values, reference=0, levels=LEVELS):
    return breaking_point(levels, values, reference)


def test_where_it_breaks_is_interpolated():
    found = broken(30.0, 29.0, 25.0, 10.0)
    assert found == Break(LEVELS[1], LEVELS[2], 0.5)
    assert found.value == pytest.approx(math.sqrt(2))  # between 1 and 2, geometric
    assert broken(30.0, 24.0, 26.0, 10.0).value == pytest.approx(0.5)  # from 0: linear
    assert broken(30.0, 27.0, 27.0, 27.0) == Break(LEVELS[0], LEVELS[1], 1.0)  # just
    assert broken(30.0, 27.1, 29.0, 31.0) is None
    # The fall counts from the reference, and only beyond it
    assert broken(10.0, 30.0, 29.0, 26.0, reference=1).value == pytest.approx(2 * 2 ** (2 / 3))
    assert str(found) == "1.4"


def test_severities_may_fall():
    views = tuple(Level(v, f"{v}") for v in (40, 20, 10))
    assert broken(30.0, 28.0, 26.0, levels=views).value == pytest.approx(20 * 0.5**0.5)


def test_a_failure_breaks():
    assert broken(30.0, 29.0, None, 29.0) == Break(LEVELS[1], LEVELS[2], 1.0)
    assert broken(None, 29.0, 20.0, 10.0) is None


@pytest.mark.parametrize(
    ("error", "wanted"),
    [
        (None, ""),
        ("univoxel.errors.UserError: expected masks", "refused"),
        ("ValueError: expected masks", "crashed"),
        ("univoxel.errors.DataError: p.png: broken", "refused"),
        ("FileNotFoundError: [Errno 2] no file", "refused"),
        ("FloatingPointError: the loss is nan at step 3", "not finite"),
        ("IndexError: index 3 is out of bounds", "crashed"),
        ("AssertionError", "crashed"),
        ("ended by SIGSEGV", "crashed"),
        ("ended with exit code 3", "crashed"),
    ],
)
def test_how_a_training_ended(error, wanted):
    assert kind(outcome(20.0, error=error)) == wanted


def test_a_number_that_is_none_counts():
    assert kind(outcome(math.nan)) == "not finite"
    assert kind(outcome(math.inf)) == "not finite"


def test_refusals_are_what_the_command_line_takes_for_mistakes():
    assert set(report.REFUSALS) == set(cli.MISTAKES)
    assert pydoc.locate("univoxel.errors.DataError") is DataError


def cells(light, *values, axis=AXIS):
    """A cell for each level, of outcomes for each seed's relit PSNR."""
    return [
        Cell(
            axis,
            level,
            light,
            tuple(
                v
                if isinstance(v, Outcome)
                else outcome(v, f"{axis.name}-{level.label}", f"{light}-s{s}")
                for s, v in enumerate(seeds)
            ),
        )
        for level, seeds in zip(axis.levels, values, strict=True)
    ]


FAILED = outcome(0.0, "fog-4", "sg-s1", error="IndexError: a | b")
CELLS = [
    *cells("hybrid", (30.0, 31.0), (30.0, 30.5), (29.0, 29.2), (28.0, 28.6)),
    *cells("sg", (28.0, 28.0), (26.0, 27.0), (24.5, 23.5), (20.0, FAILED)),
]


def test_means_and_spreads_are_over_the_seeds():
    first, *_, last = CELLS[4:]
    assert (first.mean("relit_psnr"), first.spread("relit_psnr")) == (28.0, 0.0)
    assert CELLS[0].mean("relit_psnr") == 30.5
    assert CELLS[0].spread("relit_psnr") == pytest.approx(math.sqrt(0.5))
    assert last.mean("relit_psnr") is None  # one seed of two is no answer
    assert last.fault() == "crashed"
    assert first.mean("chamfer") is None
    assert report.counts(CELLS) == {"trainings": 16, "refused": 0, "not finite": 0, "crashed": 1}
    # The base scene stands on many axes; its training is one
    assert report.counts(CELLS[:1] * 3)["trainings"] == 2


def test_the_table():
    text = report.markdown(CELLS)
    assert "16 trainings" in text
    assert "0 refused, 0 not finite, 1 crashed" in text
    assert "| axis | severities | hybrid | sg |" in text
    # 3 dB below 28 between 26.5 at 1 and 24 at 2: 1 * 2^0.6
    assert "| fog: fog, metres | **0**, 1, 2, 4 | holds (-2.2 dB) | 1.5 |" in text
    assert "| **0** | hybrid | 30.50 ± 0.71 | 30.00 ± 0.00 |" in text
    assert "| 4 | sg | crashed: IndexError: a / b |" in text
    widths = {line.count("|") for line in text.split("## fog")[1].splitlines() if "|" in line}
    assert len(widths) == 1


def test_a_reference_that_failed():
    text = report.markdown(cells("sg", (FAILED,), (20.0,), (20.0,), (20.0,)))
    assert "reference failed" in text


def test_the_picture(tmp_path):
    more = cells("sg", *[(30.0,)] * 5, axis=AXES["views"])
    for found in (CELLS, [*CELLS[4:], *more], cells("sg", *[(FAILED,)] * 4)):
        png, svg = plots.save_figure(report.plot(found), tmp_path / "stress")
        assert png.read_bytes().startswith(b"\x89PNG")
        assert "<svg" in svg.read_text()


def test_panels_lines_and_crosses():
    figure = report.plot(CELLS)
    (panel,) = figure.axes
    assert [t.get_text() for t in panel.get_xticklabels()] == ["0", "1", "2", "4"]
    assert len(panel.containers) == 2  # lines with error bars
    assert [t.get_text() for t in panel.texts] == ["crashed"]
