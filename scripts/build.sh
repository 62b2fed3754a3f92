#!/bin/bash
# Compile the extension into BUILD and put it beside the Python sources (or into PREFIX).
# Usage: scripts/build.sh BUILD PREFIX [CMAKE OPTION ...]
set -euo pipefail
cd "$(dirname "$0")/.."
build=$1 prefix=$2
shift 2
export PATH=$PWD/.venv/bin:$PATH

options=("$@")
if [ -d .deps/usr ]; then
    # RPATH, unlike RUNPATH, also serves the libraries that Embree needs in turn.
    options+=("-DCMAKE_PREFIX_PATH=$PWD/.deps/usr"
              "-DCMAKE_INSTALL_RPATH=$PWD/.deps/usr/lib/$(c++ -print-multiarch)"
              -DCMAKE_MODULE_LINKER_FLAGS=-Wl,--disable-new-dtags)
    export CPLUS_INCLUDE_PATH=$PWD/.deps/usr/include
    [ ! -e .deps/usr/include/python/Python.h ] ||
        options+=("-DPython_INCLUDE_DIR=$PWD/.deps/usr/include/python")
fi
cmake -G Ninja -S . -B "$build" "-DPython_EXECUTABLE=$PWD/.venv/bin/python" \
    "-Dpybind11_DIR=$(python -m pybind11 --cmakedir)" "${options[@]}" >"$build.log" 2>&1 ||
    { cat "$build.log" >&2; exit 1; }
grep -h 'Embree' "$build.log" || true
rm -f "$build.log"
cmake --build "$build"
cmake --install "$build" --prefix "$prefix" >/dev/null
