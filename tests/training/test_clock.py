"""The budget of a run, on a clock of our own."""

import itertools
import json
from pathlib import Path

import pytest
from plain import plain_stage, plain_training

from univoxel.config import PREPARATION
from univoxel.training import clock as clock_module
from univoxel.training.clock import HURRY, LEAST, RESERVE_SECONDS, REST, expected_seconds
from univoxel.training.progress import Progress

START = {"stage": 0, "progress": 0.0, "step": 0}


@pytest.fixture
def clock(monkeypatch):
    """Seconds that pass when a test says so."""

    class Clock:
        now = 1000.0

        def monotonic(self):
            return self.now

    clock = Clock()
    monkeypatch.setattr(clock_module, "time", clock)
    return clock


@pytest.fixture
def start(tmp_path, clock):
    """Begins a training: of stages of these shares, of which some seconds are over."""

    def begun(*shares, iterations=10, minutes=1.0, state=START, ago=0.0, step=None):
        stages = tuple(plain_stage(voxels=1.0, iterations=iterations, share=s) for s in shares)
        cfg = plain_training(Path("photos"), tmp_path, stages, minutes)
        # Where it is said how long a step takes, than was expected
        slower = 1.0 if step is None else step * iterations / expected_seconds(stages[0])
        return Progress(cfg, clock.now - ago, state, slower=slower)

    return begun


def steps(progress, clock, seconds, each=None):
    """The schedule of a stage whose steps take so many seconds; `each` is called in them."""
    done = []
    for x in progress.clock.steps():
        done.append(x)
        clock.now += seconds
        if each is not None:
            each()
    return done


def test_a_fast_machine_makes_every_step(start, clock):
    progress = start(0.5, 0.5)
    assert steps(progress, clock, 0.01) == pytest.approx([i / 10 for i in range(10)])
    assert (progress.clock.stage, progress.clock.done, progress.clock.step) == (1, 0.0, 10)
    # What it leaves of its 28 seconds goes to the next
    assert len(steps(progress, clock, 5.0)) == 10


def test_a_slow_machine_runs_through_the_whole_schedule_in_time(start, clock):
    progress, budget = start(0.25, 0.75, iterations=1000), 60 - RESERVE_SECONDS
    for until in (0.25 * budget, budget):
        done = steps(progress, clock, 0.5)
        assert progress.clock.seconds == pytest.approx(until, abs=0.5)  # a step ends late at most
        assert done == sorted(done)
        assert done[0] == 0
        assert done[-1] > 0.9


def test_uneven_steps_run_through_the_whole_schedule(start, clock):
    """What is slow at first and fast then makes every step that fits, and ends at 1."""
    progress = start(1.0, iterations=1000)
    done = []
    for x in progress.clock.steps():
        done.append(x)
        clock.now += 0.5 if len(done) < 20 else 0.01
    assert len(done) == 1000  # 10 s and 10 s of 56
    assert done == sorted(done)
    assert done[-1] > 0.98
    assert progress.clock.cut() == ""


def test_time_apart_is_taken_from_the_steps_to_come(start, clock):
    progress, budget, blocks, done = start(1.0, iterations=1000), 60 - RESERVE_SECONDS, 0, []
    for x in progress.clock.steps(0.3):
        done.append(x)
        clock.now += 0.25
        if x >= (blocks + 1) / 4 and blocks < 3:
            with progress.clock.off_pace():
                clock.now += 8.0
            blocks += 1
            assert progress.clock.blocks_that_fit(3 - blocks) == 3 - blocks
    assert blocks == 3
    assert progress.clock.seconds == pytest.approx(budget, abs=0.5)
    assert len(done) == pytest.approx((budget - 3 * 8) / 0.25, abs=3)
    steps_by_quarter = [sum(q <= 4 * x < q + 1 for x in done) for q in range(4)]
    assert min(steps_by_quarter) > 0.6 * max(steps_by_quarter)  # the guess was 30 %, it was 43 %


def test_blocks_that_do_not_fit_are_dropped(start, clock):
    progress = start(1.0, iterations=1000)
    for count, _ in enumerate(progress.clock.steps()):
        clock.now += 0.1
        if count == 10:
            with progress.clock.off_pace():
                clock.now += 10.0
            # 45 s are left; half of it has room for two
            assert progress.clock.blocks_that_fit(5) == 2
            break
    assert progress.clock.blocks_that_fit(1) == 1


def test_a_pause_does_not_count(start, clock):
    progress = start(1.0, iterations=30)

    def paused():
        before = progress.clock.seconds, progress.due(), progress.checkpoint_due()
        with progress.clock.stopped():
            clock.now += 100
            assert progress.clock.seconds == before[0]
        assert (progress.clock.seconds, progress.due(), progress.checkpoint_due()) == before

    steps(progress, clock, 0.5, paused)
    assert progress.clock.made == [1.0]


def test_a_watcher_is_called_between_steps_off_the_clock(start, clock):
    seen, progress = [], start(1.0)

    def watch():
        seen.append(progress.clock.step)
        clock.now += 1000

    progress.clock.watch = watch
    steps(progress, clock, 0.01)
    assert seen == list(range(1, 11))
    assert progress.clock.seconds == pytest.approx(0.1)


def test_what_was_cut_is_told(start, clock):
    with start(0.5, 0.5, iterations=100) as progress:
        steps(progress, clock, 0.01)
        steps(progress, clock, 1.1)  # 50 of 100 in 55 s
    assert progress.clock.made == pytest.approx([1.0, 0.5], abs=0.01)
    assert progress.state()["made"] == progress.clock.made
    assert progress.clock.pace == progress.clock.made[1]
    assert progress.clock.short() == {"shape": progress.clock.made[1]}
    cut = "training ended at the time limit (completed steps: 50% of shape)"
    assert progress.clock.cut() == cut
    assert progress.clock.minutes_for_all() == pytest.approx((1 + 2 * 55) / 60, abs=0.05)


def test_how_long_stages_took_over_two_sittings(start, clock):
    """What is done between stages counts for the next; preparation, before the clock, for none."""
    progress = start(0.5, 0.5, ago=3.0)  # of preparation
    steps(progress, clock, 0.1)
    clock.now += 2.0
    for _ in progress.clock.steps():
        if progress.clock.step == 15:
            break
        clock.now += 0.1
    state = json.loads(json.dumps(progress.state()))
    assert state["took"] == pytest.approx([1.0])
    assert state["stage_took"] == pytest.approx(2.5)
    clock.now += 100.0
    later = start(0.5, 0.5, ago=state["seconds"], state=state)
    steps(later, clock, 0.2)
    assert later.clock.made == [1.0, 1.0]  # those of both sittings
    assert later.state()["took"] == pytest.approx([1.0, 3.5])
    assert later.state()["stage_took"] == 0.0


def test_a_training_that_is_stopped_hurries_through_what_is_left(start, clock):
    shape = {"iterations": 1000, "minutes": 10.0}
    with start(0.2, 0.4, 0.4, **shape, step=1.0) as progress:
        schedule = []
        for x in progress.clock.steps():
            schedule.append(x)
            clock.now += 1.0
            if progress.clock.step == 15:
                progress.clock.finish()
                progress.clock.finish()  # once more changes nothing
        assert schedule[14] < 0.2
        assert schedule[-1] > 0.9  # the whole of it
        assert progress.clock.stage == 1
        assert progress.clock.pace < 0.04  # the next stage knows how little was made
        left = HURRY * (600 - RESERVE_SECONDS - 16)
        assert progress.clock.seconds - 16 == pytest.approx(0.17 * left, abs=3)
        for k in (1, 2):
            assert steps(progress, clock, 1.0)[-1] > 0.9
            assert progress.clock.seconds - 16 == pytest.approx((0.17 + 0.415 * k) * left, abs=3)
    assert progress.clock.over
    told = "training was stopped early (completed steps: 3% of coarse shape"
    assert progress.clock.cut().startswith(told)
    assert progress.state()["finished"]
    assert start(0.2, 0.4, 0.4, **shape, state=progress.state()).clock.finished


def test_stopped_in_the_last_stage_it_ends_soon(start, clock):
    progress = start(0.5, 0.5, iterations=1000, minutes=10.0, step=1.0)
    steps(progress, clock, 1.0)
    begin = clock.now
    steps(progress, clock, 1.0, progress.clock.finish)
    assert progress.clock.stage == 2
    assert clock.now - begin == pytest.approx(HURRY * (600 - RESERVE_SECONDS - 298), abs=2)
    assert progress.clock.over


def test_stopped_in_a_stage_of_rounds_it_leaves_that(start, clock):
    progress = start(0.5, 0.5, iterations=100, minutes=10.0)
    for _ in progress.clock.steps(0.3):
        clock.now += 1.0
        progress.clock.finish()
    assert (progress.clock.stage, progress.clock.made) == (1, [0.01])


def test_texture_and_page_do_not_lengthen_a_stop(start):
    limits = []
    for afterwards in (0.0, 1000.0):
        progress = start(1.0, minutes=None)
        progress.clock.afterwards = afterwards
        progress.clock.finish()
        limits.append(progress.clock.limit)
    assert limits[0] == pytest.approx(limits[1])  # rounding of a sum


def test_little_time_is_not_made_longer_by_a_stop(start, clock):
    progress = start(0.5, 0.5, iterations=1000, minutes=0.2)
    limit = progress.clock.limit
    steps(progress, clock, 0.1, progress.clock.finish)
    assert progress.clock.limit <= limit
    steps(progress, clock, 0.1)
    assert progress.clock.seconds <= 12 - RESERVE_SECONDS + 0.2


def test_a_stage_that_is_shortened_runs_through_its_schedule(start, clock, caplog):
    caplog.set_level("INFO", "univoxel")
    with start(1.0, iterations=1000) as progress:
        done = []
        for x in progress.clock.steps():
            done.append(x)
            clock.now += 0.001
            if len(done) == 500:
                progress.clock.shorten()
    assert len(done) == pytest.approx(500 + REST * 500, abs=1)
    assert done[499] == pytest.approx(0.499)
    assert done[-1] > 0.99
    assert (progress.clock.early, progress.state()["early"]) == ([0], [0])
    assert progress.clock.pace == 1.0
    assert "ended at the time limit" not in caplog.text


def test_without_a_limit_every_step_is_made(start, clock):
    progress = start(0.5, 0.5, minutes=None)
    clock.now += 10_000  # a slow preparation
    progress.prepared()
    for _ in range(2):
        assert len(steps(progress, clock, 1000.0)) == 10
    assert progress.clock.made == [1.0, 1.0]
    assert not progress.clock.over
    assert not progress.clock.hurried
    assert progress.clock.cut() == ""


def test_a_long_preparation_leaves_every_stage_half_of_its_share(start, clock):
    progress = start(0.2, 0.8, iterations=1000, state={})
    assert progress.preparing("masks")
    clock.now += 70.0  # of a limit of 60 s
    assert not progress.preparing("concavities")
    assert progress.preparing("hull", needed=True)
    progress.prepared()
    assert progress.state()["skipped"] == ["concavities"]
    usual = (1 - PREPARATION) * 60
    for share in (0.2, 0.8):
        clock.now += 30.0  # what is chosen and saved between stages takes nothing of it
        before = clock.now
        assert steps(progress, clock, 0.1)[-1] > 0.9
        assert clock.now - before == pytest.approx(LEAST * share * usual, abs=0.5)


def test_a_later_sitting_skips_what_the_first_did(start):
    """Or it would train on other masks."""
    state = start(1.0).state() | {"skipped": ["rough masks"]}
    later = start(1.0, ago=50, state=state)
    assert later.clock.hurried
    assert later.preparing("concavities")
    assert not later.preparing("rough masks")


def test_time_left_is_right_from_the_measured_pace(start, clock):
    """Estimates are five times too short: what is said follows what is seen, without jumps."""
    progress, said = start(0.5, 0.5, iterations=200, minutes=None), []
    pace = 5 * expected_seconds(progress.clock.cfg.stages[0]) / 200
    progress.clock.afterwards = 7.0  # texture and page
    for _ in range(2):
        for _ in progress.clock.steps():
            said.append((clock.now, progress.clock.remaining - 7.0))
            clock.now += pace
    end = clock.now
    for now, left in said[100:]:
        assert left - RESERVE_SECONDS == pytest.approx(end - now, rel=0.3, abs=3 * pace)
    for (_, before), (_, after) in itertools.pairwise(said[20:]):
        assert after == pytest.approx(before, rel=0.2)


def test_a_later_sitting_goes_on_where_the_first_stopped(start, clock):
    """Also one that several processes began, of which version 0.2.0 noted what they exchanged."""
    exchanged = {"count": 2, "steps": 7, "sent": 10.0, "touched": 8.0}
    state = {"stage": 1, "progress": 0.6, "step": 160, "made": [1.0], "ranks": exchanged}
    progress = start(0.5, 0.5, ago=30, state=state)
    assert progress.clock.seconds == pytest.approx(30)
    assert (progress.clock.stage, progress.clock.step) == (1, 160)
    assert "ranks" not in progress.state()
    done = steps(progress, clock, 0.01)
    assert done == pytest.approx([0.6, 0.7, 0.8, 0.9], abs=0.01)
    assert progress.clock.step == 164


def test_reports_and_checkpoints_come_by_the_clock(start, tmp_path, clock):
    progress = start(1.0)
    assert not progress.due()
    assert not progress.checkpoint_due()
    clock.now += 61
    assert progress.due()
    assert progress.checkpoint_due()
    assert not progress.checkpoint_due()  # it counts from the last one
    progress.clock.step += 5
    progress.report({"radiance": 0.25}, 31.0)
    assert not progress.due()
    line = json.loads((tmp_path / "log.jsonl").read_text())
    assert line["step"] == 5
    assert line["seconds"] == pytest.approx(61)
    assert line["losses"] == {"radiance": 0.25}
    assert line["held_out_psnr"] == 31.0
    assert line["rays_per_second"] == pytest.approx(5 * 2048 / 61)
