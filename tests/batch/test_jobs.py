"""Jobs with processes of a moment: killed, doubled, broken, on workers that come and go.

Workers and schedulers of a cluster are processes of their own, as people start them.
"""

import contextlib
import dataclasses
import io
import json
import logging
import os
import pickle
import re
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from clusters import alive, process, scheduler, wait_for, worker
from filelock import FileLock
from rich.console import Console

from univoxel.batch import jobs
from univoxel.batch.jobs import (
    Job,
    ProgressTable,
    Result,
    Step,
    connect,
    last_line,
    run_job,
    run_jobs,
)
from univoxel.core import progress_bar
from univoxel.errors import DataError, ExistingFile, MissingExtra, ProcessFailed, UserError

# A "training": counts to its end through kills, as it keeps where it is, and tells of it
COUNTER = """
import json, os, sys, time
from pathlib import Path
folder, last, pause = Path(sys.argv[1]), int(sys.argv[2]), float(sys.argv[3])
folder.mkdir(parents=True, exist_ok=True)
at = folder / "at"
with (folder / "begun").open("a") as file:
    file.write(f"{os.getpid()}\\n")
for i in range(int(at.read_text()) if at.exists() else 0, last):
    time.sleep(pause)
    with (folder / "log").open("a") as file:
        file.write(json.dumps({"share": (i + 1) / last, "rays_per_second": 1e4}) + "\\n")
    (folder / "at.tmp").write_text(str(i + 1))
    os.replace(folder / "at.tmp", at)
(folder / "made").write_text("whole")
"""


def counting(out: Path, name: str, last: int = 2, pause: float = 0.05) -> Job:
    folder = out / name
    arguments = ("-c", COUNTER, str(folder), str(last), str(pause))
    step = Step("count", arguments, folder / "made", log=folder / "log")
    return Job(name, (step,), folder, threads=1)


def saying(out: Path, name: str, program: str) -> Job:
    return Job(name, (Step("say", ("-c", program), out / f"{name}.made"),), out / name)


def begun(out: Path, name: str) -> list[int]:
    """Processes that were at work on a job."""
    path = out / name / "begun"
    return [int(line) for line in path.read_text().split()] if path.exists() else []


def test_all_are_done_once_and_recorded(tmp_path):
    jobs = [counting(tmp_path, f"p{i}") for i in range(5)]
    with connect(2) as client:
        found = {ended.name: ended for ended in run_jobs(client, jobs, len(jobs))}
    assert {name: ended.state for name, ended in found.items()} == dict.fromkeys(
        ("p0", "p1", "p2", "p3", "p4"), "done"
    )
    for job in jobs:
        assert len(begun(tmp_path, job.name)) == 1
        assert job.record()["seconds"]["count"] > 0
    assert run_job(jobs[0]).state == "done"
    assert len(begun(tmp_path, "p0")) == 1  # it was done before


def test_nothing_listens_for_others_here(tmp_path):
    """The cluster of this machine opens no port but on the loopback, and nothing answers there."""
    mine = f"pid={os.getpid()},"
    with connect(1):
        told = subprocess.run(["ss", "-ltnpH"], capture_output=True, text=True)
    if told.returncode or mine not in told.stdout:
        pytest.skip("ss does not tell")
    ours = [line.split()[3] for line in told.stdout.splitlines() if mine in line]
    assert {address.rpartition(":")[0] for address in ours} == {"127.0.0.1"}


def test_a_process_that_dies_each_time_is_given_up_and_others_go_on(tmp_path):
    program = "import os; open({!r}, 'a').write('x'); os.kill(os.getpid(), 9)"
    dies = saying(tmp_path, "dies", program.format(str(tmp_path / "n")))
    with connect(1) as client:
        found = {e.name: e for e in run_jobs(client, [dies, counting(tmp_path, "mug")], 2, tries=3)}
    assert found["mug"].state == "done"
    assert found["dies"].state == "failed"
    assert re.match("ended by SIGKILL.*memory runs out; attempts: 3", found["dies"].errors["say"])
    assert (tmp_path / "n").read_text() == "xxx"


def test_a_mistake_is_not_tried_again_and_is_named(tmp_path):
    program = "import sys; print('a: expected b'); open('n', 'a').write('x'); sys.exit(2)"
    job = saying(tmp_path, "wrong", program.replace("'n'", repr(str(tmp_path / "n"))))
    with connect(1) as client:
        [ended] = run_jobs(client, [job], 1)
    assert (ended.state, ended.errors) == ("failed", {"say": "a: expected b"})
    assert (tmp_path / "n").read_text() == "x"
    assert job.record()["errors"] == ended.errors
    left = saying(tmp_path, "nothing", "pass")
    assert "ended without an error, but " in run_job(left).errors["say"]
    quiet = saying(tmp_path, "quiet", "import os; os._exit(3)")
    assert run_job(quiet).errors["say"] == "ended with exit code 3"


def test_steps_after_one_that_failed(tmp_path):
    fails = Step("a", ("-c", "raise SystemExit(1)"), tmp_path / "none", needed=False)
    makes = Step("b", ("-c", f"open({str(tmp_path / 'b')!r}, 'w')"), tmp_path / "b")
    job = Job("x", (fails, makes), tmp_path / "x")
    assert list(run_job(job).errors) == ["a"]
    assert (tmp_path / "b").exists()
    (tmp_path / "b").unlink()
    stops = Step("a", fails.arguments, fails.makes, needed=True)
    assert list(run_job(Job("x", (stops, makes), tmp_path / "y")).errors) == ["a"]
    assert not (tmp_path / "b").exists()


def test_what_is_older_than_what_it_is_made_of_is_made_again(tmp_path):
    made, source = tmp_path / "made", tmp_path / "source"
    step = Step("a", (), made, after=source)
    assert not step.done()
    made.touch()
    assert step.done()
    source.touch()
    os.utime(made, (1, 1))
    assert not step.done()
    assert not Step("a", ()).done()
    paths = tmp_path / "cut", tmp_path / "scene"  # an argument is the first that is there
    step = Step("train", ("train", paths))
    assert step.words() == ["train", str(paths[1])]
    paths[0].mkdir()
    assert step.words() == ["train", str(paths[0])]


def test_jobs_that_are_not_begun(tmp_path):
    """One that another is at work on, whose files cannot be written, or of other options."""
    job = dataclasses.replace(counting(tmp_path, "mug"), identity={"seed": 1, "steps": 2})
    with FileLock(job.file(".lock")):
        assert run_job(job).state == "locked"
    assert not begun(tmp_path, "mug")
    job.check_same()
    assert run_job(job).state == "done"
    job.check_same()
    other = dataclasses.replace(job, identity={"seed": 2, "steps": 2})
    with pytest.raises(ExistingFile, match=r"mug\.json has other values of seed than this"):
        other.check_same()
    full = counting(tmp_path, "full")
    full.file(".txt").symlink_to("/dev/full")
    assert "No space left" in run_job(full).errors["files"]


def test_two_at_one_folder_share_the_jobs(tmp_path):
    """Each is done by one of them; both end with all."""
    jobs = [counting(tmp_path, f"p{i}", last=5, pause=0.1) for i in range(4)]
    states = []

    def other() -> None:
        with connect(2) as client:
            states.extend(ended.state for ended in run_jobs(client, jobs, 4))

    second = threading.Thread(target=other)
    second.start()
    with connect(2) as client:
        states.extend(ended.state for ended in run_jobs(client, jobs, 4))
    second.join()
    assert states == ["done"] * 8
    assert [len(begun(tmp_path, job.name)) for job in jobs] == [1] * 4


def test_the_child_ends_with_its_worker(tmp_path):
    job = counting(tmp_path, "mug", last=1000, pause=0.1)
    program = (
        "import pickle, sys; from univoxel.batch.jobs import run_job;"
        "run_job(pickle.load(open(sys.argv[1], 'rb')))"
    )
    (tmp_path / "job").write_bytes(pickle.dumps(job))
    with process("-c", program, str(tmp_path / "job"), stdout=-3) as running:
        wait_for(lambda: begun(tmp_path, "mug"))
        running.kill()
        running.wait()
    wait_for(lambda: not alive(begun(tmp_path, "mug")[0]))


def test_what_nobody_waits_for_is_ended(tmp_path):
    job = counting(tmp_path, "mug", last=1000, pause=0.1)

    def watch(step: Step) -> None:
        if begun(tmp_path, "mug"):
            raise InterruptedError(step.name)

    assert run_job(job, watch).errors == {"files": "count"}
    assert not alive(begun(tmp_path, "mug")[0])


@pytest.fixture
def interruptible():
    """SIGINT interrupts, also where these tests run in the background, which ignores it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("interruptible")
def test_an_interrupt_ends_the_processes(tmp_path):
    job = counting(tmp_path, "mug", last=1000, pause=0.1)

    def stop() -> None:
        wait_for(lambda: begun(tmp_path, "mug"))
        os.kill(os.getpid(), signal.SIGINT)

    with connect(1) as client:
        threading.Thread(target=stop).start()
        with pytest.raises(KeyboardInterrupt):
            list(run_jobs(client, [job], 1))
    wait_for(lambda: not alive(begun(tmp_path, "mug")[0]))


@pytest.mark.parametrize("what", [signal.SIGKILL, signal.SIGTERM])
def test_a_worker_that_is_ended_and_one_that_joins(tmp_path, what):
    """The job of the one that ended goes on with what it had, at the one that joined."""
    jobs = [counting(tmp_path, f"p{i}", last=25, pause=0.1) for i in range(2)]
    with scheduler(tmp_path) as (_, address), worker(address) as first, contextlib.ExitStack() as s:

        def change() -> None:
            wait_for(lambda: begun(tmp_path, "p0") or begun(tmp_path, "p1"))
            time.sleep(0.5)
            first.send_signal(what)
            s.enter_context(worker(address))

        with connect(1, address) as client:
            changing = threading.Thread(target=change)
            changing.start()
            found = list(run_jobs(client, jobs, 2))
            changing.join()
    assert [ended.state for ended in found] == ["done", "done"]
    assert sorted(len(begun(tmp_path, job.name)) for job in jobs) == [1, 2]


def test_a_scheduler_that_is_gone_is_said_and_its_work_ends(tmp_path):
    job = counting(tmp_path, "mug", last=1000, pause=0.1)
    with scheduler(tmp_path) as (running, address), worker(address), connect(1, address) as client:

        def kill() -> None:
            wait_for((tmp_path / "mug" / "at").exists)  # it has been at work
            running.kill()

        threading.Thread(target=kill).start()
        with pytest.raises(ProcessFailed, match="lost the connection to the scheduler: run"):
            list(run_jobs(client, [job], 1))
        wait_for(lambda: not alive(begun(tmp_path, "mug")[0]))
    last = counting(tmp_path, "mug", last=int((tmp_path / "mug" / "at").read_text()) + 2)
    with scheduler(tmp_path) as (_, address), worker(address), connect(1, address) as client:
        assert [ended.state for ended in run_jobs(client, [last], 1)] == ["done"]
    assert len(begun(tmp_path, "mug")) == 2


def test_a_worker_without_the_package_is_named(tmp_path, monkeypatch):
    def run_on_worker(job, topic):
        raise ModuleNotFoundError("No module named 'univoxel'")

    with connect(1) as client:
        monkeypatch.setattr("univoxel.batch.jobs.run_on_worker", run_on_worker)
        with pytest.raises(ProcessFailed, match="a worker has another version of univoxel"):
            list(run_jobs(client, [counting(tmp_path, "mug")], 1))


def test_a_client_that_ends_takes_its_work_from_the_workers(tmp_path, monkeypatch):
    job = counting(tmp_path, "mug", last=1000, pause=0.1)
    with scheduler(tmp_path) as (_, address), worker(address):
        with connect(1, address) as client:
            handed_out = run_jobs(client, [job], 1)
            thread = threading.Thread(target=lambda: [*handed_out], daemon=True)
            monkeypatch.setattr(threading, "excepthook", lambda _: None)
            thread.start()
            wait_for(lambda: begun(tmp_path, "mug"))
            client.close()
            thread.join()
        wait_for(lambda: not alive(begun(tmp_path, "mug")[0]))
        # The worker lets go of the job a moment after its process is gone
        wait_for(lambda: run_job(counting(tmp_path, "mug", last=3)).state == "done")


def test_records_that_are_broken_or_of_a_former_version(tmp_path):
    job = counting(tmp_path, "mug")
    assert job.record() == {"identity": {}, "seconds": {}, "errors": {}}
    for text in ("[]", '{"seconds": 3}'):
        job.file(".json").write_text(text)
        with pytest.raises(DataError, match=r"mug\.json: expected the record of a batch job"):
            job.record()
        assert "record of a batch job" in run_job(job).errors["files"]
    fields = {"identity": {"seed": 1}, "seconds": {"count": 3.0}, "errors": {"count": "x"}}
    job.file(".json").write_text(json.dumps(fields | {"where": "a machine"}))
    assert job.record() == fields
    assert run_job(job).state == "done"
    assert job.record()["seconds"]["count"] > 3.0
    assert job.record()["errors"] == {}


def test_how_far_a_job_is_comes_from_its_log(tmp_path):
    shares = []
    job = counting(tmp_path, "mug", last=60, pause=0.05)
    assert run_job(job, lambda step: shares.append(last_line(step.log)["share"])).state == "done"
    assert shares == sorted(shares)
    assert shares[0] < 0.6
    assert shares[-1] == 1
    for text in ('{"share": 0.5}\n{"sha', "", "3\n"):
        (tmp_path / "log").write_text(text)
        assert last_line(tmp_path / "log") == {}
    assert last_line(None) == last_line(tmp_path / "none") == {}


def test_mistakes_are_named(tmp_path, monkeypatch):
    with pytest.raises(UserError, match="jobs must be at least 1, got 0"), connect(0):
        pass
    monkeypatch.setattr("univoxel.batch.jobs.CONNECT_SECONDS", 0.5)
    with (
        pytest.raises(ProcessFailed, match=r"scheduler=tcp://127\.0\.0\.1:9: no Dask scheduler"),
        connect(1, "tcp://127.0.0.1:9"),
    ):
        pass
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(MissingExtra, match=r"univoxel\[cluster\]"), connect(1):
        pass


def test_workers_of_another_version_are_refused(tmp_path, monkeypatch):
    with scheduler(tmp_path) as (_, address), worker(address), connect(1, address) as client:
        client.wait_for_workers(1)
        monkeypatch.setattr("univoxel.batch.jobs.__version__", "9.9")
        said = pytest.raises(ProcessFailed, match=r"workers with univoxel 9\.9, got \d")
        with said, connect(1, address):
            pass


# What is shown of jobs at work: rows on a terminal, lines elsewhere, time that is left


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
