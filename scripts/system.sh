#!/bin/bash
# Bring in the Debian packages that the build needs and the machine lacks: by apt-get as root,
# unpacked into .deps without root. Does nothing where all is there. Usage: scripts/system.sh PYTHON
set -euo pipefail
cd "$(dirname "$0")/.."
python=$1
deps=$PWD/.deps

say() { echo "univoxel set-up: $*" >&2; }
header() { echo "#include <$1>" | c++ -E -x c++ -I "$deps/usr/include" - >/dev/null 2>&1; }
python_headers() { [ -e "$("$python" -c 'import sysconfig; print(sysconfig.get_path("include"))')/Python.h" ]; }

command -v "$python" >/dev/null || { say "no $python: install Python 3.10 or later"; exit 1; }
version=$("$python" -c 'import sys; print("%d.%d" % sys.version_info[:2])')

missing=()
command -v c++ >/dev/null || missing+=(g++)
command -v c++ >/dev/null && header glm/vec3.hpp || missing+=(libglm-dev)
command -v c++ >/dev/null && { header embree4/rtcore.h || header embree3/rtcore.h; } ||
    missing+=(libembree-dev)
python_headers || [ -e "$deps/usr/include/python/Python.h" ] ||
    missing+=("libpython$version-dev")
"$python" -c 'import ensurepip, venv' 2>/dev/null ||
    compgen -G "$deps/usr/share/python-wheels/pip-*.whl" >/dev/null ||
    missing+=("python$version-venv")
[ ${#missing[@]} -gt 0 ] || exit 0

if ! command -v apt-get >/dev/null; then
    say "please install what Debian calls: ${missing[*]}"
    exit 1
fi
if [ "$(id -u)" = 0 ]; then
    say "apt-get install ${missing[*]}"
    export DEBIAN_FRONTEND=noninteractive
    install() { apt-get install -y -q --no-install-recommends "${missing[@]}" </dev/null >&2; }
    install || { apt-get update -q >&2 && install; }
    exit 0
fi

# Without root: what the packages above unpack to. A compiler cannot be had this way.
packages=()
for package in "${missing[@]}"; do
    case $package in
        g++) say "no C++ compiler: ask for the package g++ (apt-get install g++)"; exit 1 ;;
        libembree-dev) packages+=(libembree3-3 libembree-dev libtbb12 libtbb-dev libtbbmalloc2
                                  libtbbbind-2-5 libhwloc15) ;;
        libpython*) packages+=("$package" "libpython$version") ;;
        python*-venv) packages+=(python3-pip-whl) ;;
        *) packages+=("$package") ;;
    esac
done
say "without root, into .deps: ${packages[*]}"
mkdir -p "$deps/apt/lists/partial" "$deps/apt/archives/partial"
cd "$deps/apt"
own=(-q -o "Dir::State::Lists=$deps/apt/lists" -o "Dir::Cache=$deps/apt")
apt-get -q download "${packages[@]}" >&2 2>/dev/null ||
    { apt-get "${own[@]}" update >&2 && apt-get "${own[@]}" download "${packages[@]}" >&2; }
for archive in ./*.deb; do dpkg -x "$archive" "$deps"; done
rm -rf "$deps/apt"
ln -sfn "python$version" "$deps/usr/include/python"
