"""What wheels on public hosts are built with, as far as no network is needed."""

import io
import tarfile
import zipfile

import pytest
import wheel_parts


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
