"""csrc/parallel.h by itself, in a program of its own: no kernel throws from inside a chunk."""

import shutil
import subprocess
from pathlib import Path

import pytest

CSRC = Path(__file__).parent.parent / "csrc"
PROGRAM = r"""
#include <cstdio>
#include <mutex>
#include <set>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>
#include "parallel.h"

using Chunks = std::set<std::pair<int64_t, int64_t>>;

Chunks chunks(int64_t n, int threads, std::vector<int>& times) {
    Chunks seen;
    std::mutex mutex;
    univoxel::parallel_for(n, 7, threads, [&](int64_t begin, int64_t end) {
        for (int64_t i = begin; i < end; ++i) ++times[i];
        std::lock_guard<std::mutex> lock(mutex);
        seen.insert({begin, end});
    });
    return seen;
}

int main() {
    for (int64_t n : {0, 1, 7, 8, 1000}) {
        std::vector<int> once(n), times(n);
        const Chunks alone = chunks(n, 1, once);
        if (once != std::vector<int>(n, 1)) return std::puts("not every index once"), 1;
        for (int threads : {2, 3, 8}) {
            times.assign(n, 0);
            if (chunks(n, threads, times) != alone) return std::puts("other chunks"), 1;
            if (times != once) return std::puts("not every index once, in parallel"), 1;
        }
    }
    for (int threads : {1, 2, 8}) {
        std::string caught;
        try {
            univoxel::parallel_for(1000, 7, threads, [](int64_t begin, int64_t) {
                if (begin >= 70) throw std::invalid_argument("thrown in a chunk");
            });
        } catch (const std::invalid_argument& error) {
            caught = error.what();
        }
        if (caught != "thrown in a chunk") return std::puts("exception lost"), 1;
    }
    std::puts("ok");
}
"""


RACE = r"""
#include <cstdio>
#include "parallel.h"

int main(int argc, char**) {
    int64_t sum = 0, sums[100] = {};
    univoxel::parallel_for(700, 7, 4, [&](int64_t begin, int64_t end) {
        for (int64_t i = begin; i < end; ++i) (argc > 1 ? sum : sums[begin / 7]) += i;
    });
    for (int64_t part : sums) sum += part;  // after the team, whose writes are seen here
    std::printf("%d\n", sum > 0);
}
"""
TEAMS = {"OpenMP": ["-fopenmp"], "std::thread": ["-DUNIVOXEL_STD_THREADS=1", "-pthread"]}


def compiled(folder: Path, program: str, options: list[str]) -> Path:
    (folder / "main.cpp").write_text(program)
    compile_ = ["c++", "-std=c++17", "-O1", *options, "-I", CSRC, "main.cpp", "-o", "main"]
    subprocess.run(compile_, cwd=folder, check=True)
    return folder / "main"


@pytest.mark.skipif(not shutil.which("c++"), reason="no C++ compiler")
@pytest.mark.parametrize("team", TEAMS)
def test_chunks_and_exceptions(tmp_path, team):
    main = compiled(tmp_path, PROGRAM, TEAMS[team])
    run = subprocess.run([main], capture_output=True, text=True, timeout=60)
    assert run.stdout == "ok\n", run.stderr
    assert run.returncode == 0


@pytest.mark.skipif(not shutil.which("setarch"), reason="without setarch")
def test_the_thread_sanitizer_sees_races_and_no_others(tmp_path):
    """What `make tsan` rests on."""
    try:
        main = compiled(tmp_path, RACE, [*TEAMS["std::thread"], "-fsanitize=thread"])
    except (subprocess.CalledProcessError, OSError):
        pytest.skip("no thread sanitizer")
    for options in ([], ["race"]):
        command = ["setarch", "-R", main, *options]
        run = subprocess.run(command, capture_output=True, text=True, timeout=60)
        assert run.stdout == "1\n", run.stderr
        assert ("data race" in run.stderr) == bool(options)
