#!/bin/bash
# Make the source distribution and, from it alone, one repaired wheel per Python, all into dist/.
# Kernels are compiled once: of a second Python only the bindings. pybind11 knows no stable ABI.
# Usage: scripts/wheel.sh [PYTHON ...]; without any: each CPython 3.10 to 3.14 that is here
set -euo pipefail
cd "$(dirname "$0")/.."
work=$PWD/build/wheel
tools=$PWD/.venv/bin

pythons=("$@")
usable() { "$1" -c 'import sysconfig as s; open(s.get_path("include") + "/Python.h")' 2>/dev/null; }
if [ ${#pythons[@]} = 0 ]; then
    for version in 3.10 3.11 3.12 3.13 3.14; do
        for python in "python$version" "${PYENV_ROOT:-$HOME/.pyenv}/versions/$version".*/bin/python; do
            if usable "$python"; then pythons+=("$python"); break; fi
        done
    done
fi
[ ${#pythons[@]} -gt 0 ] || { echo "wheel.sh: no CPython with its headers" >&2; exit 1; }

export PATH=$tools:$PATH # patchelf, for auditwheel
if [ -d .deps/usr ]; then
    deps=$PWD/.deps/usr lib=$PWD/.deps/usr/lib/$(c++ -print-multiarch)
    export CMAKE_PREFIX_PATH=$deps CPLUS_INCLUDE_PATH=$deps/include
    export LD_LIBRARY_PATH=$lib${LD_LIBRARY_PATH:+:$LD_LIBRARY_PATH}
fi

rm -rf "$work" && mkdir -p "$work/source" dist
rm -f dist/univoxel-*
"$tools/python" -m build --sdist -o dist . >"$work/sdist.log" 2>&1 || { cat "$work/sdist.log" >&2; exit 1; }
tar -xzf dist/univoxel-*.tar.gz -C "$work/source" --strip-components=1
# Embree and TBB go inside, and so do their licences.
for file in {,.deps}/usr/share/doc/lib{embree,tbb}[0-9]*/copyright; do
    [ ! -e "$file" ] || cp "$file" "$work/source/LICENSE.$(basename "$(dirname "$file")")"
done
[ ! -e /usr/share/common-licenses/Apache-2.0 ] ||
    cp /usr/share/common-licenses/Apache-2.0 "$work/source/LICENSE.Apache-2.0"
for python in "${pythons[@]}"; do
    "$python" -m pip wheel -q --no-deps -w "$work/raw" \
        --config-settings=build-dir="$work/cmake" "$work/source"
done
# torch brings an OpenMP runtime, loaded before the extension, which must share it.
for wheel in "$work"/raw/*.whl; do
    auditwheel repair --strip --exclude libgomp.so.1 -w dist "$wheel" >"$work/repair.log" 2>&1 ||
        { cat "$work/repair.log" >&2; exit 1; }
done
for wheel in dist/*.whl; do
    auditwheel show "$wheel" | tr '\n' ' ' | grep -o '"manylinux[a-z0-9_]*"' | head -1
    ls -sh "$wheel"
done
