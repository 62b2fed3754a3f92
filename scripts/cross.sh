#!/bin/bash
# Compile and link the extension for macOS on ARM and for Windows on x86-64, without Embree: what can
# be known of them on Linux. Nothing of it runs here. Root, for Debian's mingw-w64.
# Usage: scripts/cross.sh macos|windows
set -euo pipefail
cd "$(dirname "$0")/.."
target=$1
work=$PWD/build/cross
out=$work/$target
python=$PWD/.venv/bin/python
say() { echo "univoxel cross: $*" >&2; }

mkdir -p "$out" "$work/include"
ln -sfn /usr/include/glm "$work/include/glm"
# Python's headers differ by what the compiler's types are, and by threads
rm -rf "$out/python" && mkdir -p "$out/python"
cp -rL "$("$python" -c 'import sysconfig; print(sysconfig.get_path("include"))')/." "$out/python"
case $target in
    macos)  # zig is clang with the headers and libraries of each system; Python's package has it
        [ -d "$work/zig" ] || "$python" -m pip install -q --target "$work/zig" ziglang==0.17.1
        export PYTHONPATH=$work/zig ZIG_GLOBAL_CACHE_DIR=$work/cache ZIG_LOCAL_CACHE_DIR=$work/cache
        compile=("$python" -m ziglang c++ -target aarch64-macos)
        variants=("")
        ;;
    windows)
        command -v x86_64-w64-mingw32-g++-posix >/dev/null || {
            say "apt-get install g++-mingw-w64-x86-64-posix"
            DEBIAN_FRONTEND=noninteractive apt-get install -y -q --no-install-recommends \
                g++-mingw-w64-x86-64-posix </dev/null >&2
        }
        sed -i -E 's/(define SIZEOF_LONG) .*/\1 4/; s/(define SIZEOF_WCHAR_T) .*/\1 2/' "$out/python/pyconfig.h"
        printf '#define MS_WINDOWS 1\n#define MS_WIN64 1\n#define NT_THREADS 1\n' >>"$out/python/pyconfig.h"
        compile=(x86_64-w64-mingw32-g++-posix -Wa,-mbig-obj)
        variants=("" "-march=x86-64-v3")
        ;;
    *) say "expected macos or windows, got $target"; exit 2 ;;
esac
compile+=(-std=c++17 -fopenmp -DNDEBUG -Icsrc -isystem third_party/xatlas -isystem "$work/include")
bindings=(-O0 -isystem "$out/python" -isystem "$("$python" -c 'import pybind11; print(pybind11.get_include())')")
warnings=(-Wall -Wextra -Wno-unknown-pragmas -Wno-pass-failed)

objects=()
for source in csrc/*.cpp csrc/bindings/*.cpp third_party/xatlas/xatlas.cpp; do
    object=$out/$(echo "${source%.cpp}" | tr / _).o
    objects+=("$object")
    [ "$object" -ot "$source" ] || continue
    case $source in
        csrc/bindings/*) "${compile[@]}" "${warnings[@]}" "${bindings[@]}" -c "$source" -o "$object" ;;
        third_party/*) "${compile[@]}" -w -O3 -c "$source" -o "$object" ;;
        *) for variant in "${variants[@]}"; do # the last stays
            "${compile[@]}" "${warnings[@]}" -O3 -fno-math-errno -fno-trapping-math $variant -c "$source" -o "$object"
        done ;;
    esac
done
if [ "$target" = macos ]; then # the libraries of Python, OpenMP and C++ are found where it is loaded
    linked=$out/_core.cpython-311-darwin.so
    "$python" -m ziglang cc -target aarch64-macos -shared -undefined dynamic_lookup -o "$linked" "${objects[@]}"
else
    linked=$out/_core.cp311-win_amd64.pyd
    {
        printf 'LIBRARY python311.dll\nEXPORTS\n'
        x86_64-w64-mingw32-nm -u "${objects[@]}" | grep -oE '_?Py[A-Za-z_0-9]+' | sort -u
    } >"$out/python311.def"
    x86_64-w64-mingw32-dlltool -d "$out/python311.def" -l "$out/libpython311.a"
    "${compile[@]}" -shared -static-libgcc -static-libstdc++ -o "$linked" "${objects[@]}" "$out/libpython311.a"
fi
file -b "$linked"
