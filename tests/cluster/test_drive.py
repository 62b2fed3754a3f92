"""Pieces of work with processes of a moment: killed, doubled, broken, on workers that come and go.

Workers and schedulers of a cluster are processes of their own, as people start them.
"""

import contextlib
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

from univoxel import child
from univoxel.cluster.drive import drive
from univoxel.cluster.machines import machines
from univoxel.cluster.piece import FirstOf, Piece, Record, Step, Told, load_record
from univoxel.cluster.work import Unwanted, last_line, work
from univoxel.errors import DataError, MissingExtra, ProcessFailed, UserError

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


def counting(out: Path, name: str, last: int = 2, pause: float = 0.05) -> Piece:
    folder = out / name
    arguments = ("-c", COUNTER, str(folder), str(last), str(pause))
    step = Step("count", arguments, folder / "made", log=folder / "log")
    return Piece(
        name, (step,), out / f"{name}.lock", out / f"{name}.txt", out / f"{name}.json", threads=1
    )


def saying(out: Path, name: str, program: str) -> Piece:
    step = Step("say", ("-c", program), out / f"{name}.made")
    return Piece(name, (step,), out / f"{name}.lock", out / f"{name}.txt", out / f"{name}.json")


def begun(out: Path, name: str) -> list[int]:
    """Processes that were at work on a piece."""
    path = out / name / "begun"
    return [int(line) for line in path.read_text().split()] if path.exists() else []


def alone(piece: Piece):
    return work(piece, lambda told: None, lambda: True)


def test_all_are_done_once_and_recorded(tmp_path):
    pieces = [counting(tmp_path, f"p{i}") for i in range(5)]
    with machines(2) as client:
        found = {ended.name: ended for ended in drive(client, pieces, len(pieces))}
    assert {name: ended.state for name, ended in found.items()} == dict.fromkeys(
        ("p0", "p1", "p2", "p3", "p4"), "done"
    )
    for piece in pieces:
        assert len(begun(tmp_path, piece.name)) == 1
        assert load_record(piece.record).seconds["count"] > 0
    assert alone(pieces[0]).state == "done"
    assert len(begun(tmp_path, "p0")) == 1  # it was done before


def test_nothing_listens_for_others_here(tmp_path):
    """The cluster of this machine opens no port but on the loopback, and nothing answers there."""
    mine = f"pid={os.getpid()},"
    with machines(1):
        told = subprocess.run(["ss", "-ltnpH"], capture_output=True, text=True)
    if told.returncode or mine not in told.stdout:
        pytest.skip("ss does not tell")
    ours = [line.split()[3] for line in told.stdout.splitlines() if mine in line]
    assert {address.rpartition(":")[0] for address in ours} == {"127.0.0.1"}


def test_a_killed_process_is_gone_on_with(tmp_path):
    piece = counting(tmp_path, "mug", last=30, pause=0.1)
    at = tmp_path / "mug" / "at"

    def kill() -> None:
        wait_for(lambda: at.exists() and int(at.read_text()) >= 3)
        os.kill(begun(tmp_path, "mug")[0], signal.SIGKILL)

    killer = threading.Thread(target=kill)
    killer.start()
    with machines(1) as client:
        [ended] = drive(client, [piece], 1)
    killer.join()
    assert ended.state == "done"
    assert len(begun(tmp_path, "mug")) == 2
    assert len((tmp_path / "mug" / "log").read_text().splitlines()) <= 31  # what was done stays


def test_a_process_that_dies_each_time_is_given_up_and_others_go_on(tmp_path):
    dies = saying(
        tmp_path,
        "dies",
        f"import os; open({str(tmp_path / 'n')!r}, 'a').write('x'); os.kill(os.getpid(), 9)",
    )
    with machines(1) as client:
        found = {e.name: e for e in drive(client, [dies, counting(tmp_path, "mug")], 2, tries=3)}
    assert found["mug"].state == "done"
    assert found["dies"].state == "failed"
    assert re.match("ended by SIGKILL, 3 times; .*memory is short", found["dies"].errors["say"])
    assert (tmp_path / "n").read_text() == "xxx"


def test_a_mistake_is_not_tried_again_and_is_named(tmp_path):
    program = "import sys; print('a: expected b'); open('n', 'a').write('x'); sys.exit(2)"
    piece = saying(tmp_path, "wrong", program.replace("'n'", repr(str(tmp_path / "n"))))
    with machines(1) as client:
        [ended] = drive(client, [piece], 1)
    assert (ended.state, ended.errors) == ("failed", {"say": "a: expected b"})
    assert (tmp_path / "n").read_text() == "x"
    assert load_record(piece.record).errors == ended.errors
    left = saying(tmp_path, "nothing", "pass")
    assert "ended well and left no" in alone(left).errors["say"]
    quiet = saying(tmp_path, "quiet", "import os; os._exit(3)")
    assert alone(quiet).errors["say"] == "ended with exit code 3"


def test_steps_after_one_that_failed(tmp_path):
    fails = Step("a", ("-c", "raise SystemExit(1)"), tmp_path / "none", needed=False)
    makes = Step("b", ("-c", f"open({str(tmp_path / 'b')!r}, 'w')"), tmp_path / "b")
    piece = Piece("x", (fails, makes), tmp_path / "lock", tmp_path / "said")
    assert list(alone(piece).errors) == ["a"]
    assert (tmp_path / "b").exists()
    (tmp_path / "b").unlink()
    stops = Step("a", fails.arguments, fails.makes, needed=True)
    assert list(alone(Piece("x", (stops, makes), piece.lock, piece.output)).errors) == ["a"]
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


def test_an_argument_is_the_first_that_is_there(tmp_path):
    paths = tmp_path / "cut", tmp_path / "scene"
    assert str(FirstOf(paths)) == str(paths[1])
    paths[0].mkdir()
    assert str(FirstOf(paths)) == str(paths[0])


def test_two_at_one_folder_share_the_pieces(tmp_path):
    """Each is done by one of them; both end with all."""
    pieces = [counting(tmp_path, f"p{i}", last=5, pause=0.1) for i in range(4)]
    states = []

    def other() -> None:
        with machines(2) as client:
            states.extend(ended.state for ended in drive(client, pieces, 4))

    second = threading.Thread(target=other)
    second.start()
    with machines(2) as client:
        states.extend(ended.state for ended in drive(client, pieces, 4))
    second.join()
    assert states == ["done"] * 8
    assert [len(begun(tmp_path, piece.name)) for piece in pieces] == [1] * 4


def test_a_process_that_outlives_its_worker_keeps_others_away(tmp_path):
    """As where the system does not end it: the lock is its own."""
    piece = counting(tmp_path, "mug")
    program = "import sys, time; from univoxel import child; child.hold(sys.argv[1]); print(1, "
    program += "flush=True); time.sleep(60)"
    options = {"stdout": subprocess.PIPE}
    with process("-c", program, f"{piece.lock}.child", **options) as orphan:
        assert orphan.stdout is not None
        with orphan.stdout as said:
            said.readline()
        assert alone(piece).state == "taken"
    assert not begun(tmp_path, "mug")
    assert alone(piece).state == "done"


def test_the_child_ends_with_its_worker(tmp_path):
    piece = counting(tmp_path, "mug", last=1000, pause=0.1)
    program = (
        "import pickle, sys; from univoxel.cluster.work import work;"
        "work(pickle.load(open(sys.argv[1], 'rb')), print, lambda: True)"
    )
    (tmp_path / "piece").write_bytes(pickle.dumps(piece))
    with process("-c", program, str(tmp_path / "piece"), stdout=-3) as running:
        wait_for(lambda: begun(tmp_path, "mug"))
        running.kill()
        running.wait()
    wait_for(lambda: not alive(begun(tmp_path, "mug")[0]))


def test_what_nobody_waits_for_is_ended(tmp_path):
    piece = counting(tmp_path, "mug", last=1000, pause=0.1)
    with pytest.raises(Unwanted):
        work(piece, lambda told: None, lambda: not begun(tmp_path, "mug"))
    assert not alive(begun(tmp_path, "mug")[0])


@pytest.fixture
def interruptible():
    """SIGINT interrupts, also where these tests run in the background, which ignores it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("interruptible")
def test_an_interrupt_ends_the_processes(tmp_path):
    piece = counting(tmp_path, "mug", last=1000, pause=0.1)

    def stop() -> None:
        wait_for(lambda: begun(tmp_path, "mug"))
        os.kill(os.getpid(), signal.SIGINT)

    with machines(1) as client:
        threading.Thread(target=stop).start()
        with pytest.raises(KeyboardInterrupt):
            list(drive(client, [piece], 1))
    wait_for(lambda: not alive(begun(tmp_path, "mug")[0]))


@pytest.mark.parametrize("what", [signal.SIGKILL, signal.SIGTERM])
def test_a_worker_that_is_ended_and_one_that_joins(tmp_path, what):
    """The piece of the one that ended goes on with what it had, at the one that joined."""
    pieces = [counting(tmp_path, f"p{i}", last=25, pause=0.1) for i in range(2)]
    with scheduler(tmp_path) as (_, address), worker(address) as first, contextlib.ExitStack() as s:

        def change() -> None:
            wait_for(lambda: begun(tmp_path, "p0") or begun(tmp_path, "p1"))
            time.sleep(0.5)
            first.send_signal(what)
            s.enter_context(worker(address))

        with machines(1, address) as client:
            changing = threading.Thread(target=change)
            changing.start()
            found = list(drive(client, pieces, 2))
            changing.join()
    assert [ended.state for ended in found] == ["done", "done"]
    assert sorted(len(begun(tmp_path, piece.name)) for piece in pieces) == [1, 2]


def test_a_scheduler_that_is_gone_is_said_and_its_work_ends(tmp_path):
    piece = counting(tmp_path, "mug", last=1000, pause=0.1)
    with scheduler(tmp_path) as (running, address), worker(address), machines(1, address) as client:

        def kill() -> None:
            wait_for((tmp_path / "mug" / "at").exists)  # it has been at work
            running.kill()

        threading.Thread(target=kill).start()
        with pytest.raises(ProcessFailed, match="scheduler is gone: the same command goes on"):
            list(drive(client, [piece], 1))
        wait_for(lambda: not alive(begun(tmp_path, "mug")[0]))
    last = counting(tmp_path, "mug", last=int((tmp_path / "mug" / "at").read_text()) + 2)
    with scheduler(tmp_path) as (_, address), worker(address), machines(1, address) as client:
        assert [ended.state for ended in drive(client, [last], 1)] == ["done"]
    assert len(begun(tmp_path, "mug")) == 2


def test_a_worker_without_the_package_is_named(tmp_path):
    def on_worker(piece, topic):
        raise ModuleNotFoundError("No module named 'univoxel'")

    with machines(1) as client, pytest.MonkeyPatch.context() as patch:
        patch.setattr("univoxel.cluster.drive.on_worker", on_worker)
        with pytest.raises(ProcessFailed, match="a worker has another univoxel than this, or none"):
            list(drive(client, [counting(tmp_path, "mug")], 1))


def test_a_client_that_ends_takes_its_work_from_the_workers(tmp_path):
    piece = counting(tmp_path, "mug", last=1000, pause=0.1)
    with scheduler(tmp_path) as (_, address), worker(address):
        with machines(1, address) as client:
            handed_out = drive(client, [piece], 1)
            thread = threading.Thread(target=lambda: [*handed_out], daemon=True)
            with pytest.MonkeyPatch.context() as patch:
                patch.setattr(threading, "excepthook", lambda _: None)
                thread.start()
                wait_for(lambda: begun(tmp_path, "mug"))
                client.close()
                thread.join()
        wait_for(lambda: not alive(begun(tmp_path, "mug")[0]))
        # The worker lets go of the piece a moment after its process is gone
        wait_for(lambda: alone(counting(tmp_path, "mug", last=3)).state == "done")


def test_files_that_cannot_be_written_fail_the_piece_alone(tmp_path):
    piece = counting(tmp_path, "mug")
    piece.output.symlink_to("/dev/full")
    assert "No space left" in alone(piece).errors["files"]
    assert alone(counting(tmp_path, "cup")).state == "done"


def test_a_broken_record_is_named(tmp_path):
    (tmp_path / "mug.json").write_text('{"colour": 1}')
    with pytest.raises(DataError, match=r"mug\.json: expected the record of a piece of work"):
        load_record(tmp_path / "mug.json")
    assert load_record(tmp_path / "none") == Record()
    assert "record of a piece" in alone(counting(tmp_path, "mug")).errors["files"]


def test_how_far_it_is_is_told(tmp_path):
    told: list[Told] = []
    piece = counting(tmp_path, "mug", last=60, pause=0.05)
    assert work(piece, told.append, lambda: True).state == "done"
    assert told[0].share is None or told[0].share < 0.2
    assert told[-1].rays_per_second == 1e4
    (tmp_path / "log").write_text('{"share": 0.5}\n{"sha')
    assert last_line(tmp_path / "log") == {}
    (tmp_path / "log").write_text("")
    assert last_line(tmp_path / "log") == {}
    (tmp_path / "log").write_text("3\n")
    assert last_line(tmp_path / "log") == {}


def test_mistakes_are_named(tmp_path, monkeypatch):
    with pytest.raises(UserError, match="jobs must be at least 1, got 0"), machines(0):
        pass
    monkeypatch.setattr("univoxel.cluster.machines.CONNECT_SECONDS", 0.5)
    with (
        pytest.raises(ProcessFailed, match=r"scheduler=tcp://127\.0\.0\.1:9: no scheduler of Dask"),
        machines(1, "tcp://127.0.0.1:9"),
    ):
        pass
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(MissingExtra, match=r"univoxel\[cluster\]"), machines(1):
        pass


def test_workers_of_another_version_are_refused(tmp_path):
    with (
        scheduler(tmp_path) as (_, address),
        worker(address),
        machines(1, address) as client,
        pytest.MonkeyPatch.context() as patch,
    ):
        client.wait_for_workers(1)
        patch.setattr("univoxel.__version__", "9.9")
        with pytest.raises(ProcessFailed, match=r"workers with univoxel 9\.9, got \d"):
            with machines(1, address):
                pass


def test_the_exit_code_of_a_held_lock(tmp_path):
    with process("-m", "univoxel.child", str(os.getpid()), "-", "true") as running:
        assert running.wait() == 0
    lock = str(tmp_path / "lock")
    sleeping = ("-m", "univoxel.child", str(os.getpid()), lock, "sleep", "60")
    with process(*sleeping) as first:
        # Only when it has become its command
        wait_for(lambda: "sleep" in Path(f"/proc/{first.pid}/comm").read_text())
        with process(*sleeping[:4], "true") as second:
            assert second.wait() == child.LOCKED
