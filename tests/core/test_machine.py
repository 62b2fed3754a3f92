"""What a machine says of itself, from files as Linux writes them."""

import os
from pathlib import Path

import pytest

from univoxel.core import machine

GIB = 1 << 30


def system(tmp_path: Path, groups: str, files: dict[str, str]) -> Path:
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
    root = system(tmp_path, groups, {f"sys/fs/cgroup/{name}": t for name, t in files.items()})
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
    root = system(tmp_path, groups, {f"sys/fs/cgroup/{name}": t for name, t in files.items()})
    everything = len(os.sched_getaffinity(0))
    assert machine.cores(root) == (everything if granted is None else granted)


def test_the_processor_has_a_name(tmp_path):
    root = system(tmp_path, "", {"proc/cpuinfo": "processor\t: 0\nmodel name\t: Abacus 3000\n"})
    assert machine.processor(root) == "Abacus 3000"
    assert machine.processor(tmp_path / "nothing")


def test_memory_of_a_system_without_such_files(tmp_path):
    """As psutil has it, on macOS and Windows."""
    found = machine.memory(tmp_path)
    assert found is not None
    assert found.free is not None
    assert GIB / 4 < found.free <= found.total
