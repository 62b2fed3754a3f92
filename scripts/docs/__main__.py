"""Check the documentation against results and code, or bring it up to date.

python scripts/docs [--write] [--release]

Without --write, nothing is changed: faults are printed, and the exit code is 1 if there are any.
With --write, generated blocks are refilled, and the other faults are printed. With --release,
figures of several versions are a fault too: `python benchmarks/figures.py` measures them again.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))  # the package of this tree, wherever the command is called

import doc_blocks  # noqa: E402
import doc_names  # noqa: E402
import doc_prose  # noqa: E402
import doc_truth  # noqa: E402
import doc_words  # noqa: E402


def main() -> int:
    parser = argparse.ArgumentParser(description="check the documentation, or bring it up to date")
    parser.add_argument("--write", action="store_true", help="refill the generated blocks")
    parser.add_argument("--release", action="store_true", help="figures must be of one version")
    parser.add_argument(
        "--sample", type=int, metavar="N", help="print N sentences to judge, and end"
    )
    parser.add_argument("--seed", type=int, default=0, help="of the sample")
    options = parser.parse_args()
    if options.sample:
        print(*doc_words.sample(ROOT, options.sample, options.seed), sep="\n")
        return 0
    faults = doc_blocks.update(ROOT, write=options.write)
    faults += doc_blocks.unused(ROOT) + doc_prose.faults(ROOT)
    faults += doc_names.faults(ROOT) + doc_truth.faults(ROOT)
    faults += doc_words.faults(ROOT)
    if options.release:
        faults += doc_blocks.several_versions(ROOT)
    for fault in faults:
        print(fault)
    print(f"{len(faults)} faults" if faults else "documentation: pages, results and code agree")
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
