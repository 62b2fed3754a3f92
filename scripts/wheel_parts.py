"""What wheels on public hosts are built with: Embree, and the OpenMP runtime of PyTorch to link to.

    python scripts/wheel_parts.py FOLDER

FOLDER gets `embree`, from Embree's own binaries, or on Linux on ARM, which they leave out, from
its source; and `torch`, whose runtime the extension shares: two in one process fight over the
cores, and on macOS and Windows end it. Untried: no public host has run this.
"""

from __future__ import annotations

import io
import platform
import subprocess
import sys
import tarfile
import urllib.request
import zipfile
from pathlib import Path

EMBREE = "4.4.0"
RELEASES = "https://github.com/RenderKit/embree"
BINARIES = {
    ("Linux", "x86_64"): f"embree-{EMBREE}.x86_64.linux.tar.gz",
    ("Darwin", "arm64"): f"embree-{EMBREE}.arm64.macosx.zip",
    ("Darwin", "x86_64"): f"embree-{EMBREE}.x86_64.macosx.zip",
    ("Windows", "AMD64"): f"embree-{EMBREE}.x64.windows.zip",
}
# What clang calls of OpenMP's runtime for the loops of csrc/parallel.h
RUNTIME = (
    "__kmpc_dispatch_deinit __kmpc_dispatch_init_4 __kmpc_dispatch_init_8 __kmpc_dispatch_next_4 "
    "__kmpc_dispatch_next_8 __kmpc_fork_call __kmpc_global_thread_num __kmpc_push_num_threads"
).split()


def address(system: str, machine: str) -> str:
    """Where Embree is for a machine, as `platform` names it: its binaries, or its source."""
    binary = BINARIES.get((system, machine))
    if binary is None:
        return f"{RELEASES}/archive/refs/tags/v{EMBREE}.tar.gz"
    return f"{RELEASES}/releases/download/v{EMBREE}/{binary}"


def unpack(archive: bytes, name: str, folder: Path) -> Path:
    """Unpack an archive; returns where its include/ or CMakeLists.txt lies."""
    folder.mkdir(parents=True)
    if name.endswith(".zip"):
        with zipfile.ZipFile(io.BytesIO(archive)) as file:
            file.extractall(folder)
    else:
        with tarfile.open(fileobj=io.BytesIO(archive)) as file:
            file.extractall(folder, filter="data")
    inner = [folder, *(path for path in folder.iterdir() if path.is_dir())]
    for path in inner:
        if (path / "include").is_dir() or (path / "CMakeLists.txt").exists():
            return path
    raise SystemExit(f"wheel_parts.py: {name} holds no include/ and no CMakeLists.txt")


def definitions() -> str:
    """What a linker of Windows makes an import library of PyTorch's runtime from."""
    return "\n".join(["LIBRARY libiomp5md.dll", "EXPORTS", *RUNTIME, ""])


def main(folder: Path) -> None:
    system, machine = platform.system(), platform.machine()
    url = address(system, machine)
    with urllib.request.urlopen(url) as answer:
        found = unpack(answer.read(), url, folder / "unpacked")
    if (found / "CMakeLists.txt").exists() and "archive" in url:
        options = [
            "-DEMBREE_ISPC_SUPPORT=OFF",
            "-DEMBREE_TUTORIALS=OFF",
            "-DCMAKE_BUILD_TYPE=Release",
        ]
        build, prefix = folder / "build", folder.resolve() / "embree"
        subprocess.check_call(
            ["cmake", "-S", found, "-B", build, f"-DCMAKE_INSTALL_PREFIX={prefix}", *options]
        )
        subprocess.check_call(["cmake", "--build", build, "--parallel", "--target", "install"])
    else:
        found.rename(folder / "embree")
    install = [sys.executable, "-m", "pip", "install", "--no-deps", "--target", folder / "site"]
    subprocess.check_call([*install, "torch"])
    (folder / "site" / "torch").rename(folder / "torch")
    if system == "Windows":
        exports = folder / "libiomp5md.def"
        exports.write_text(definitions())
        made = f"/out:{folder / 'libiomp5md.lib'}"
        subprocess.check_call(["llvm-lib", f"/def:{exports}", made, "/machine:x64"])


if __name__ == "__main__":
    main(Path(sys.argv[1]))
