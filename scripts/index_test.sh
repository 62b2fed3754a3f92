#!/bin/bash
# Make an index of packages of dist/ and install univoxel from it as from the public one, with the
# extras that most people want, in an environment of its own. Everything else comes from the index
# that pip knows. Usage: scripts/index_test.sh PYTHON [EXTRAS]
set -euo pipefail
cd "$(dirname "$0")/.."
python=$1 extras=${2-capture,masks,view}
work=$PWD/build/index
rm -rf "$work" && mkdir -p "$work/simple/univoxel"
for file in dist/univoxel-*.whl; do
    ln -s "$PWD/$file" "$work/simple/univoxel/"
    name=$(basename "$file")
    echo "<a href=\"$name#sha256=$(sha256sum "$file" | cut -d' ' -f1)\">$name</a>"
done >"$work/simple/univoxel/index.html"
"$python" -m venv "$work/venv"
# The pinned torch first, as everywhere here: a newer one might come with CUDA
"$work/venv/bin/pip" install -q -c constraints.txt torch
time "$work/venv/bin/pip" install -q -c constraints.txt --extra-index-url "file://$work/simple" \
    --only-binary univoxel "univoxel${extras:+[$extras]}"
cd "$work" # not beside the sources
venv/bin/python -c 'import univoxel; print(univoxel.__file__)'
venv/bin/univoxel doctor
du -sh venv
