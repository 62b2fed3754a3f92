#!/bin/bash
# Make .venv with the package (editable) and all that development needs, and with another extra.
# Usage: scripts/venv.sh PYTHON [EXTRA]
set -euo pipefail
cd "$(dirname "$0")/.."
python=$1

if [ ! -x .venv/bin/python ] || ! .venv/bin/python -m pip --version >/dev/null 2>&1; then
    if "$python" -c 'import ensurepip' 2>/dev/null; then
        "$python" -m venv .venv
    else  # Debian without python3-venv: pip comes from the wheel in .deps
        "$python" -m venv --without-pip .venv
        wheels=(.deps/usr/share/python-wheels/pip-*.whl)
        PYTHONPATH=${wheels[0]} .venv/bin/python -m pip install -q pip
    fi
fi
# torch first and pinned: a newer one might come with gigabytes of CUDA packages.
.venv/bin/pip install -q -c constraints.txt torch
.venv/bin/pip install -q -c constraints.txt -e ".[dev${2:+,$2}]"
# Of the editable install only the path counts. Its import hook would stand before PYTHONPATH and the
# current folder, and so hide any other build of the package, such as the one with sanitizers.
sed -i '/^import /d' .venv/lib/python3*/site-packages/_editable_skbc_univoxel.pth
