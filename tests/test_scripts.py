"""Scripts: known holes of packages, parts of wheels, notebooks; and csrc's debug checks."""

import io
import json
import runpy
import shutil
import subprocess
import tarfile
import warnings
import zipfile
from pathlib import Path

import doc_notebooks
import pytest
import wheel_parts

verdict = runpy.run_path(str(Path(__file__).parent.parent / "scripts" / "audit.py"))["verdict"]
HOLE = {"id": "PYSEC-1", "fix_versions": ["2.0"], "aliases": [], "description": ""}
SOUND = {"name": "a", "version": "1", "vulns": []}
HOLED = {"name": "b", "version": "1", "vulns": [HOLE]}
UNKNOWN = {"name": "c", "skip_reason": "not found"}


@pytest.mark.parametrize(
    ("dependencies", "code", "said"),
    [
        ([SOUND], 0, "1 packages asked for, 0 known holes"),
        ([SOUND, HOLED], 1, "b 1: PYSEC-1, fixed in 2.0"),
        ([SOUND, UNKNOWN], 3, "1 not asked for, nothing is known of them: c"),
        ([HOLED, UNKNOWN], 1, "nothing is known of them: c"),
        ([], 3, "0 packages asked for"),
    ],
)
def test_verdict(dependencies, code, said):
    found, text = verdict({"dependencies": dependencies})
    assert found == code
    assert said in text


@pytest.mark.parametrize(
    ("system", "machine", "end"),
    [
        ("Linux", "x86_64", "embree-4.4.0.x86_64.linux.tar.gz"),
        ("Darwin", "arm64", "embree-4.4.0.arm64.macosx.zip"),
        ("Windows", "AMD64", "embree-4.4.0.x64.windows.zip"),
        ("Linux", "aarch64", "archive/refs/tags/v4.4.0.tar.gz"),  # the source
    ],
)
def test_each_machine_gets_its_embree(system, machine, end):
    assert wheel_parts.address(system, machine).endswith(end)


@pytest.mark.parametrize("top", ["", "embree-4.4.0/"])
@pytest.mark.parametrize("kind", ["zip", "tar.gz"])
def test_archives_with_and_without_a_folder_on_top(top, kind, tmp_path):
    packed, name = io.BytesIO(), f"{top}include/rtcore.h"
    if kind == "zip":
        with zipfile.ZipFile(packed, "w") as file:
            file.writestr(name, "header")
    else:
        with tarfile.open(fileobj=packed, mode="w:gz") as file:
            about = tarfile.TarInfo(name)
            about.size = 6
            file.addfile(about, io.BytesIO(b"header"))
    found = wheel_parts.unpack(packed.getvalue(), f"embree.{kind}", tmp_path / "unpacked")
    assert (found / "include/rtcore.h").read_text() == "header"


def test_an_archive_of_something_else_is_refused(tmp_path):
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as file:
        file.writestr("readme.txt", "")
    with pytest.raises(SystemExit, match=r"embree\.zip holds no include/"):
        wheel_parts.unpack(packed.getvalue(), "embree.zip", tmp_path / "unpacked")


def test_an_import_library_names_what_it_stands_for():
    lines = wheel_parts.definitions().splitlines()
    assert lines[:2] == ["LIBRARY libiomp5md.dll", "EXPORTS"]
    assert "__kmpc_fork_call" in lines


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


@pytest.mark.parametrize("path", doc_notebooks.notebooks(), ids=lambda path: path.stem)
def test_notebook_runs(path):
    notebook = json.loads(path.read_text(encoding="utf-8"))
    kept = [cell["outputs"] for cell in doc_notebooks.code_cells(notebook)]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        doc_notebooks.run(notebook, path.name)
    said = "".join(
        "".join(output.get("text", []))
        for cell in doc_notebooks.code_cells(notebook)
        for output in cell["outputs"]
    )
    assert "gradients agree" in said
    assert any("data" in output for outputs in kept for output in outputs), "run doc_notebooks.py"


def test_a_cell_that_fails_is_named():
    cells = [{"cell_type": "code", "source": [line]} for line in ("x = 1", "assert x == 2")]
    with pytest.raises(AssertionError) as caught:
        doc_notebooks.run({"cells": cells}, "some.ipynb")
    assert "some.ipynb, cell 2" in str(caught.traceback[-1].path)
