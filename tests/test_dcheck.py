"""csrc/dcheck.h: a debug build stops at a broken invariant and says which; others do not look."""

import shutil
import subprocess
from pathlib import Path

import pytest

CSRC = Path(__file__).parent.parent / "csrc"
PROGRAM = r"""
#include <cstdio>
#include "nodes.h"

int main(int argc, char**) {
    const univoxel::DenseNodes nodes{4, 5};
    std::printf("%d\n", static_cast<int>(nodes.row(1, 2, argc == 1 ? 4 : 5)));
}
"""


@pytest.mark.skipif(not shutil.which("c++"), reason="no C++ compiler")
@pytest.mark.parametrize("debug", [False, True])
def test_a_debug_build_stops_at_a_node_outside_the_grid(tmp_path, debug):
    (tmp_path / "main.cpp").write_text(PROGRAM)
    options = ["-DUNIVOXEL_DEBUG=1"] if debug else []
    subprocess.run(
        ["c++", "-std=c++17", *options, "-I", CSRC, "main.cpp", "-o", "main"],
        cwd=tmp_path,
        check=True,
    )
    inside = subprocess.run([tmp_path / "main"], capture_output=True, text=True)
    assert (inside.returncode, inside.stdout) == (0, "34\n")
    outside = subprocess.run([tmp_path / "main", "outside"], capture_output=True, text=True)
    assert (outside.returncode == 0) != debug
    assert ("nodes.h" in outside.stderr and "DCHECK(" in outside.stderr) == debug
