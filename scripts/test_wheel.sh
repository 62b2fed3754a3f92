#!/bin/bash
# Install a wheel where there is Python and nothing else - no compiler, Embree, TBB or GLM, no
# network, no shell - and run the demo and the ops' tests there. Root, or a kernel that lets users
# have namespaces of their own.
# Usage: scripts/test_wheel.sh WHEEL PYTHON [REQUIREMENT ...]     such as torch==2.4.0
set -euo pipefail
cd "$(dirname "$0")/.."
wheel=$1 pip=("$2" -m pip) python=$("$2" -c 'import os, sys; print(os.path.realpath(sys.executable))')
shift 2
[ $# -gt 0 ] || set -- -c constraints.txt torch
name=$(basename "$wheel" .whl)-$(echo "$*" | tr -c 'a-zA-Z0-9.=\n' -)
house=$PWD/build/wheelhouse/$name root=$PWD/build/wheel-root
rm -rf "$root" && mkdir -p "$house" "$root"

# What it depends on, and the tests', as files
[ -e "$house/.complete" ] || "${pip[@]}" download -q -d "$house" "$wheel" pytest pytest-timeout hypothesis "$@"
touch "$house/.complete"
cp "$wheel" "$house" # this build of it

# The root: the interpreter, its standard library and the shared libraries of both
mkdir -p "$root"/{proc,sys,dev,tmp,house,tests}
debian=${python%/usr/bin/*} # one that scripts/pythons.sh unpacked has all that beside it
if [ -e "$debian/.complete" ]; then
    bound=$debian
    ln -s "$debian/usr" "$root/usr"
    for name in lib lib64; do [ ! -e "$debian/usr/$name" ] || ln -s "usr/$name" "$root/$name"; done
else
    bound=$("$python" -c 'import sysconfig; print(sysconfig.get_path("stdlib"))')
    mkdir -p "$root$(dirname "$python")"
    cp "$python" "$root$python"
    stdcxx=$(ldconfig -p | awk '/libstdc\+\+\.so\.6 .*x86-64|libstdc\+\+\.so\.6 .*AArch64/ {print $NF; exit}')
    # All parts of the C library, and C++'s: every Linux has them, and torch asks for them
    glibc=$(dirname "$(ldd "$python" | awk '/libc\.so\.6/ {print $3}')")
    parts=("$stdcxx" "$glibc"/lib{pthread,dl,m,rt,util}.so.[0-9])
    for file in "$python" "$bound"/lib-dynload/*.so "${parts[@]}"; do
        { ldd "$file" || true; } | grep -o '/[^ ]*' || true
    done | sort -u | grep -v '^/tmp' | cat - <(printf '%s\n' "${parts[@]}") | while read -r library; do
        mkdir -p "$root$(dirname "$library")" && cp -L "$library" "$root$library"
    done
fi
mkdir -p "$root$bound"
cp -r tests pyproject.toml "$root/tests"

rights=$([ "$(id -u)" = 0 ] || echo --map-root-user)
export root house bound python
# shellcheck disable=SC2086
unshare $rights --mount --net bash -euo pipefail <<'INNER'
for folder in proc sys dev; do mount --rbind "/$folder" "$root/$folder"; done
mount --bind "$bound" "$root$bound"
mount --bind "$house" "$root/house"
found=$(find "$root" -path "$root/proc" -prune -o -path "$root/sys" -prune -o -path "$root/dev" -prune -o \
    ! -path '*/share/*' \( -name 'libembree*' -o -name 'libtbb*' -o -name 'libgomp*' -o -name 'c++' -o -name 'g++' -o -name gcc -o -name cc -o -name glm \) -print)
[ -z "$found" ] || { echo "test_wheel.sh: the root is not clean: $found" >&2; exit 1; }
chroot=$(command -v chroot)
inside() { env -i HOME=/tmp USER=nobody PATH=/venv/bin LANG=C.UTF-8 "$chroot" "$root" "$@"; }
inside "$python" -m venv /venv
echo "== pip install univoxel"
time inside /venv/bin/python -m pip install -q --no-index --find-links /house univoxel
echo "== univoxel doctor"
inside /venv/bin/univoxel doctor
echo "== univoxel demo"
time inside /venv/bin/univoxel demo --out /tmp/demo
echo "== the ops' tests"
inside /venv/bin/python -m pip install -q --no-index --find-links /house pytest pytest-timeout hypothesis
# torch.compile calls a compiler
inside /venv/bin/python -m pytest -q -c /tests/pyproject.toml --rootdir /tests -p no:cacheprovider \
    -k "not compile and not version and not cheap" /tests/tests/ops /tests/tests/test_build.py
INNER
