#!/bin/bash
# Train the short scenes of tests/net.py at a commit and in the working tree, on this machine, and
# compare their bits: what a move or a rename is proven with. A minute or two.
# Usage: scripts/net.sh REV
set -euo pipefail
cd "$(dirname "$0")/.."
base=$(git rev-parse --verify "$1^{commit}")
work=$PWD/build/net
tree=$work/$base
here=$PWD
mkdir -p "$work"
git worktree prune
[ -d "$tree" ] || git worktree add -q --detach "$tree" "$base"
trap 'git worktree remove -f "$tree"' EXIT

if git diff --quiet "$base" -- csrc third_party cmake CMakeLists.txt; then
    cp -r univoxel/_core "$tree/univoxel/"
else
    for link in .venv .deps; do [ ! -e $link ] || ln -sfn "$here/$link" "$tree/$link"; done
    (cd "$tree" && scripts/build.sh build .)
fi
export OMP_NUM_THREADS=1
(cd "$tree" && PYTHONPATH=$tree "$here/.venv/bin/python" tests/net.py "$work/base.json") \
    >"$work/base.log" 2>&1 &
base_job=$!
PYTHONPATH=$here .venv/bin/python tests/net.py "$work/here.json" >"$work/here.log" 2>&1 ||
    { tail "$work/here.log" >&2; exit 1; }
wait $base_job || { tail "$work/base.log" >&2; exit 1; }
.venv/bin/python tests/net.py --compare "$work/base.json" "$work/here.json"
