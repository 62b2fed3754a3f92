#!/bin/bash
# Compile for 64-bit ARM and run what is asked for there, under qemu's emulation: the ops' tests, the
# net and the demo. Debian 12's packages and PyTorch's wheel for aarch64, in a root of its own below
# build/arm. Root; hours on a machine of two cores, so not part of `make test`.
# Usage: scripts/arm.sh setup | run COMMAND [ARGUMENT ...]     run: inside, in the repository
set -euo pipefail
cd "$(dirname "$0")/.."
work=$PWD/build/arm
root=$work/root
say() { echo "univoxel arm: $*" >&2; }

setup() {
    missing=()
    command -v qemu-aarch64-static >/dev/null || missing+=(qemu-user-static)
    command -v mmdebstrap >/dev/null || missing+=(mmdebstrap)
    command -v aarch64-linux-gnu-g++ >/dev/null || missing+=(g++-aarch64-linux-gnu)
    if [ ${#missing[@]} -gt 0 ]; then
        say "apt-get install ${missing[*]}"
        DEBIAN_FRONTEND=noninteractive apt-get install -y -q --no-install-recommends "${missing[@]}" </dev/null >&2
    fi
    mkdir -p "$work"
    if [ ! -e "$root/.complete" ]; then
        say "Debian's packages for arm64"
        rm -rf "$root"
        # Unpacked alone: nothing of theirs has to run
        mmdebstrap --quiet --variant=extract --architectures=arm64 \
            --include=python3,libpython3-dev,libembree-dev,libtbb-dev,libglm-dev,libgomp1,libstdc++-12-dev,libc6-dev,dash,coreutils,libopenblas0,gcc,g++ \
            bookworm "$root" >&2
        mkdir -p "$root"/{proc,sys,dev,tmp,univoxel}
        touch "$root/.complete"
    fi
    if [ ! -e "$work/site/.complete" ]; then
        say "Python's packages for aarch64"
        .venv/bin/python - >"$work/requirements.txt" <<'PY'
import tomllib
project = tomllib.load(open("pyproject.toml", "rb"))["project"]
print(*(r for r in project["dependencies"] if not r.startswith("torch>")), sep="\n")
# What PyTorch needs, and the tests
print("fsspec jinja2 networkx sympy typing-extensions pytest pytest-timeout hypothesis".replace(" ", "\n"))
PY
        into=(install -q --upgrade --target "$work/site" --only-binary=:all: --no-compile)
        into+=(--python-version 3.11 --implementation cp --platform manylinux2014_aarch64)
        for glibc in 36 35 34 31 28 27 17; do into+=(--platform "manylinux_2_${glibc}_aarch64"); done
        .venv/bin/pip "${into[@]}" -r "$work/requirements.txt"
        # The newest for CPUs alone that the package index has for aarch64. By itself: whether it needs
        # CUDA's packages pip asks of the machine that it runs on
        .venv/bin/pip "${into[@]}" --no-deps torch==2.9.1
        touch "$work/site/.complete"
    fi
    say "kernels"
    cat >"$work/toolchain.cmake" <<CMAKE
set(CMAKE_SYSTEM_NAME Linux)
set(CMAKE_SYSTEM_PROCESSOR aarch64)
set(CMAKE_CXX_COMPILER aarch64-linux-gnu-g++)
set(CMAKE_SYSROOT $root)
set(CMAKE_FIND_ROOT_PATH $root)
set(CMAKE_FIND_ROOT_PATH_MODE_PROGRAM NEVER)
set(CMAKE_FIND_ROOT_PATH_MODE_LIBRARY ONLY)
set(CMAKE_FIND_ROOT_PATH_MODE_INCLUDE ONLY)
set(CMAKE_FIND_ROOT_PATH_MODE_PACKAGE BOTH)
set(PYTHON_MODULE_EXTENSION .cpython-311-aarch64-linux-gnu.so)
CMAKE
    export PATH=$PWD/.venv/bin:$PATH
    cmake -G Ninja -S . -B "$work/build" "-DCMAKE_TOOLCHAIN_FILE=$work/toolchain.cmake" \
        "-DPython_EXECUTABLE=$PWD/.venv/bin/python" "-DPython_INCLUDE_DIR=$root/usr/include/python3.11" \
        "-Dpybind11_DIR=$(python -m pybind11 --cmakedir)" >"$work/configure.log" 2>&1 ||
        { cat "$work/configure.log" >&2; exit 1; }
    cmake --build "$work/build"
    cmake --install "$work/build" --prefix "$work/package" >/dev/null
}

# The emulator is known to the kernel inside the namespace alone, and the tree is read there but for
# what is compiled.
run() {
    export root work
    unshare --user --map-root-user --mount bash -euo pipefail -c '
        mount -t binfmt_misc binfmt_misc /proc/sys/fs/binfmt_misc
        magic="\\x7fELF\\x02\\x01\\x01\\x00\\x00\\x00\\x00\\x00\\x00\\x00\\x00\\x00\\x02\\x00\\xb7\\x00"
        mask="\\xff\\xff\\xff\\xff\\xff\\xff\\xff\\x00\\xff\\xff\\xff\\xff\\xff\\xff\\xff\\xff\\xfe\\xff\\xff\\xff"
        printf "%s" ":aarch64:M::$magic:$mask:$(command -v qemu-aarch64-static):F" >/proc/sys/fs/binfmt_misc/register
        for folder in proc sys dev; do mount --rbind "/$folder" "$root/$folder"; done
        mount --rbind "$PWD" "$root/univoxel"
        mount --bind "$work/package/univoxel/_core" "$root/univoxel/univoxel/_core"
        exec chroot "$root" /usr/bin/env -i HOME=/tmp PATH=/usr/bin:/bin LANG=C.UTF-8 OMP_NUM_THREADS=1 \
            OPENBLAS_NUM_THREADS=1 PYTHONDONTWRITEBYTECODE=1 PYTHONPATH=/univoxel:/univoxel/build/arm/site \
            /bin/sh -c "cd /univoxel && exec \"\$@\"" sh "$@"
    ' bash "$@"
}

case ${1:-} in
    setup) setup ;;
    run) shift; run "$@" ;;
    *) say "expected setup or run"; exit 2 ;;
esac
