"""What systems do in different ways, and what a machine says of itself, with stand-ins for both."""

import ctypes
import os
import re
import signal
import struct
import subprocess
import sys
import time
import types
from pathlib import Path
from unittest.mock import Mock

import psutil
import pytest

from univoxel.core import machine, system
from univoxel.data.load_images import check_name
from univoxel.data.transforms import view_names
from univoxel.errors import DataError


@pytest.fixture(params=["linux", "darwin", "win32"])
def each(request, monkeypatch):
    """Each system in turn, as far as its name goes."""
    monkeypatch.setattr(sys, "platform", request.param)
    if request.param == "darwin":
        monkeypatch.setitem(sys.modules, "fcntl", Fcntl())
    return request.param


class Fcntl(types.ModuleType):
    """The calls of macOS that Linux has not, noted down."""

    def __init__(self) -> None:
        super().__init__("fcntl")
        self.calls: list[tuple[int, bytes | int]] = []

    def fcntl(self, descriptor: int, command: int, argument: bytes | int = 0) -> None:
        os.fstat(descriptor)  # open
        self.calls.append((command, argument))


def test_room_is_taken_on_the_disk(each, tmp_path):
    with (tmp_path / "room").open("wb") as file:
        file.write(b"head")
        file.flush()
        system.reserve(file.fileno(), 1 << 20)
        assert os.fstat(file.fileno()).st_size == 1 << 20
    assert (tmp_path / "room").read_bytes().startswith(b"head\0")
    if each == "darwin":
        ((command, wanted),) = sys.modules["fcntl"].calls  # pyright: ignore
        # fstore_t: all of it, or none, behind the end of the file
        assert command == 42
        assert struct.unpack("Iiqqq", wanted) == (4, 3, 0, (1 << 20) - 4, 0)


def test_a_full_disk_is_an_error_on_macos(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "platform", "darwin")
    monkeypatch.setitem(
        sys.modules,
        "fcntl",
        types.SimpleNamespace(fcntl=Mock(side_effect=OSError(28, "No space left on device"))),
    )
    with (tmp_path / "room").open("wb") as file:
        with pytest.raises(OSError, match="No space"):
            system.reserve(file.fileno(), 1 << 20)
        assert os.fstat(file.fileno()).st_size == 0


def test_a_file_is_flushed(each, tmp_path, monkeypatch):
    flushed = []
    monkeypatch.setattr(os, "fsync", lambda descriptor: flushed.append(os.fstat(descriptor)))
    (tmp_path / "file").write_bytes(b"kept")
    system.flush(tmp_path / "file")
    if each == "darwin":
        assert sys.modules["fcntl"].calls == [(51, 0)]  # pyright: ignore
    else:
        assert [found.st_size for found in flushed] == [4]
    assert (tmp_path / "file").read_bytes() == b"kept"


def test_a_file_that_is_mapped_outlives_its_name(each, tmp_path):
    if each == "win32":
        assert not system.can_map()
        return
    with system.vanishing_file(tmp_path) as (descriptor, path):
        os.write(descriptor, b"seen")
        assert path.read_bytes() == b"seen"
        mapped = path.open("rb")
    assert not list(tmp_path.iterdir())
    with mapped:
        assert mapped.read() == b"seen"


def test_a_file_that_is_open_elsewhere_is_replaced_later(each, tmp_path, monkeypatch):
    """As a virus scanner on Windows holds one for a moment."""
    held, move = iter([PermissionError(13, "sharing violation")] * 3), os.replace

    def replace(source, target):
        if (error := next(held, None)) is not None:
            raise error
        move(source, target)

    monkeypatch.setattr(os, "replace", replace)
    (tmp_path / "new").write_text("new")
    if each == "win32":
        system.replace(tmp_path / "new", tmp_path / "old")
        assert (tmp_path / "old").read_text() == "new"
    else:  # there it means that the folder may not be written
        with pytest.raises(PermissionError):
            system.replace(tmp_path / "new", tmp_path / "old")


def test_a_file_that_stays_open_elsewhere_is_an_error(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "platform", "win32")
    monkeypatch.setattr(system, "REPLACED_WITHIN", 0.2)
    monkeypatch.setattr(os, "replace", Mock(side_effect=PermissionError(13, "sharing violation")))
    with pytest.raises(PermissionError, match="sharing"):
        system.replace(tmp_path / "new", tmp_path / "old")


def test_names_that_are_one_file(each):
    alike = system.file_key("Mu\u0308ller") == system.file_key("m\u00dcller")
    assert alike == (each != "linux")
    assert system.file_key("a") != system.file_key("b")


@pytest.mark.parametrize(
    ("names", "of_windows"),
    [
        (("a:b", "what?", "con", "NUL.png", "com1", "end.", "end ", "a\nb"), False),
        (("r_0.5", "console", "IMG 1", "nul_2", ".hidden", "\u00fc"), True),
    ],
)
def test_names_that_a_system_gives_a_file(names, of_windows, each):
    for name in names:
        assert system.can_be_a_name(name) == (of_windows or each != "win32"), name


def test_views_whose_pictures_would_be_one_file(monkeypatch):
    files = ["left/A.png", "right/a.png"]
    assert view_names(files) == ["A", "a"]
    monkeypatch.setattr(sys, "platform", "darwin")
    assert view_names(files) == ["left_A", "right_a"]
    check_name("aux", "here")
    monkeypatch.setattr(sys, "platform", "win32")
    with pytest.raises(DataError, match=r"here: .* that is valid as a file name, got 'aux'"):
        check_name("aux", "here")


def test_what_ended_a_process_and_what_control_c_does_not_reach(each):
    assert system.ended_by(0) is None
    assert system.ended_by(2) is None
    assert system.ended_by(-9) == "SIGKILL"
    assert system.ended_by(0xC0000017) == "a lack of memory"
    assert system.ended_by(0xC0000409) == "fault 0xc0000409"
    options = system.own_session()
    assert options == ({"creationflags": 512} if each == "win32" else {"start_new_session": True})


def test_peak_memory_is_in_the_unit_of_the_system(monkeypatch):
    here = system.peak_memory_mb()
    assert here is not None
    assert 10 < here < 1 << 20
    monkeypatch.setattr(sys, "platform", "darwin")
    there = system.peak_memory_mb()
    assert there is not None
    assert there == pytest.approx(here / 1024, rel=0.5)  # memory grows while tests run
    monkeypatch.setattr(sys, "platform", "win32")
    info = types.SimpleNamespace(peak_wset=3 << 20)
    process = types.SimpleNamespace(memory_info=lambda: info)
    monkeypatch.setattr(psutil, "Process", lambda: process)
    assert system.peak_memory_mb() == 3


def test_freed_memory_is_returned(monkeypatch):
    """Many pieces that glibc would keep, with one above them that holds the heap up."""
    process = psutil.Process()
    pieces = [bytearray(2000) for _ in range(50_000)]
    last = bytearray(2000)
    before = process.memory_info().rss
    del pieces
    system.release_memory()
    if sys.platform == system.LINUX and hasattr(ctypes.CDLL(None), "malloc_trim"):
        assert process.memory_info().rss < before - 50e6
    monkeypatch.setattr(system.ctypes, "CDLL", lambda _: object())
    system.release_memory()  # a library without the call
    assert len(last) == 2000


def test_what_a_system_lacks_is_none(monkeypatch):
    monkeypatch.delattr(os, "getloadavg")
    monkeypatch.setitem(sys.modules, "psutil", None)
    assert system.load() is None
    assert system.memory() is None
    monkeypatch.delattr(os, "sched_getaffinity")
    assert system.usable_cores() == os.cpu_count()


# The program of a process that ends with another, on a system that is called another one
LIVES = """\
import os, sys, time, psutil  # which asks for the system itself
sys.platform = {platform!r}
from univoxel.core import system
system.end_with(int(sys.argv[1]))
print(os.getpid(), flush=True)
time.sleep(600)
"""


@pytest.mark.parametrize("platform", ["linux", "darwin", "win32"])
def test_a_process_ends_with_the_one_that_began_it(platform):
    """Even where that is killed."""
    begins = (
        "import os, subprocess, sys\n"
        f"lives = {LIVES.format(platform=platform)!r}\n"
        "subprocess.run([sys.executable, '-c', lives, str(os.getpid())])\n"
    )
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    parent = subprocess.Popen([sys.executable, "-c", begins], stdout=-1, env=environment, text=True)
    assert parent.stdout is not None
    with parent.stdout:
        child = psutil.Process(int(parent.stdout.readline()))
        parent.send_signal(signal.SIGKILL)
        parent.wait()
    end = time.monotonic() + 20
    while running(child):
        assert time.monotonic() < end
        time.sleep(0.05)


def running(process: psutil.Process) -> bool:
    try:
        return process.is_running() and process.status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False


@pytest.mark.parametrize("platform", ["linux", "darwin", "win32"])
def test_a_process_that_begins_after_the_end_of_the_other_ends(platform):
    gone = subprocess.Popen([sys.executable, "-c", ""])
    gone.wait()
    done = subprocess.run(
        [sys.executable, "-c", LIVES.format(platform=platform), str(gone.pid)],
        capture_output=True,
        text=True,
    )
    assert (done.returncode, done.stdout, done.stderr) == (1, "", "")


def test_no_other_file_asks_which_system_it_is():
    package = Path(system.__file__).parents[1]
    asks = re.compile(
        r"sys\.platform|\bos\.(name\b|sched|posix|fork\(|replace|rename)|import (resource|fcntl)"
    )
    found = {
        str(path.relative_to(package)): asks.findall(path.read_text(encoding="utf-8"))
        for path in package.rglob("*.py")
    }
    assert [path for path, words in found.items() if words] == [str(Path("core/system.py"))]


GIB = 1 << 30


def machine_with(tmp_path: Path, groups: str, files: dict[str, str]) -> Path:
    """A root with 16 GiB of memory, 12 of them free, and these control groups."""
    memory = f"MemTotal: {16 << 20} kB\nMemFree: 1 kB\nMemAvailable: {12 << 20} kB\n"
    known = {"proc/meminfo": memory, "proc/self/cgroup": groups} | files
    for name, text in known.items():
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return tmp_path


def test_memory_of_this_machine():
    found = machine.memory()
    assert found is not None
    assert found.total > GIB
    assert found.free is None or 0 < found.free <= found.total


@pytest.mark.parametrize(
    ("groups", "files", "total", "free"),
    [
        ("", {}, 16, 12),
        ("0::/a/b\n", {"a/b/memory.max": "max\n", "a/b/memory.current": f"{GIB}\n"}, 16, 12),
        # The limit may be of a group around it; pages of files do not count as used
        (
            "0::/a/b\n",
            {
                "a/memory.max": f"{4 * GIB}\n",
                "a/memory.current": f"{3 * GIB}\n",
                "a/memory.stat": f"anon {GIB}\ninactive_file {2 * GIB}\n",
            },
            4,
            3,
        ),
        # Of two limits the tighter one counts, for what is left as well
        (
            "0::/a/b\n",
            {
                "a/memory.max": f"{8 * GIB}\n",
                "a/memory.current": f"{7 * GIB}\n",
                "a/b/memory.max": f"{4 * GIB}\n",
                "a/b/memory.current": f"{GIB}\n",
            },
            4,
            1,
        ),
        # In a container the path is one of the host: the mounted root is the group
        ("0::/../host\n", {"memory.max": f"{2 * GIB}\n", "memory.current": f"{GIB}\n"}, 2, 1),
        (
            "5:cpu,cpuacct:/x\n4:memory:/docker/1\n",
            {
                "memory/memory.limit_in_bytes": f"{2 * GIB}\n",
                "memory/memory.usage_in_bytes": f"{GIB}\n",
            },
            2,
            1,
        ),
        # What the first version writes where there is no limit
        (
            "4:memory:/\n",
            {
                "memory/memory.limit_in_bytes": "9223372036854771712\n",
                "memory/memory.usage_in_bytes": f"{GIB}\n",
            },
            16,
            12,
        ),
    ],
)
def test_memory_within_control_groups(tmp_path, groups, files, total, free):
    root = machine_with(tmp_path, groups, {f"sys/fs/cgroup/{name}": t for name, t in files.items()})
    assert machine.memory(root) == machine.Memory(total * GIB, free * GIB)


@pytest.mark.parametrize(
    ("groups", "files", "granted"),
    [
        ("0::/\n", {"cpu.max": "max 100000\n"}, None),
        ("0::/a\n", {"a/cpu.max": "50000 100000\n"}, 0.5),
        ("0::/a\n", {"cpu.max": "25000 100000\n"}, 0.25),
        ("3:cpu,cpuacct:/\n", {"cpu/cpu.cfs_quota_us": "-1", "cpu/cpu.cfs_period_us": "1"}, None),
        (
            "3:cpu,cpuacct:/\n",
            {"cpu/cpu.cfs_quota_us": "20000\n", "cpu/cpu.cfs_period_us": "100000\n"},
            0.2,
        ),
    ],
)
def test_cores_within_control_groups(tmp_path, groups, files, granted):
    root = machine_with(tmp_path, groups, {f"sys/fs/cgroup/{name}": t for name, t in files.items()})
    everything = len(os.sched_getaffinity(0))
    assert machine.cores(root) == (everything if granted is None else granted)


def test_the_processor_has_a_name_and_memory_is_known_without_such_files(tmp_path):
    root = machine_with(
        tmp_path, "", {"proc/cpuinfo": "processor\t: 0\nmodel name\t: Abacus 3000\n"}
    )
    assert machine.processor(root) == "Abacus 3000"
    assert machine.processor(tmp_path / "nothing")
    # As psutil has it, on macOS and Windows.
    found = machine.memory(tmp_path)
    assert found is not None
    assert found.free is not None
    assert GIB / 4 < found.free <= found.total
