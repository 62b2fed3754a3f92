"""Generated blocks of pages: found by their markers, made anew, compared or written.

    <!-- begin NAME -->

    what the generator says

    <!-- end NAME -->

A NAME that ends in .json is the path of a result file below benchmarks/results: see doc_tables.
"""

from __future__ import annotations

import json
import re
import subprocess
from collections.abc import Callable
from pathlib import Path

import doc_python
import doc_reference
import doc_tables

BLOCK = re.compile(
    r"^<!-- begin (?P<name>\S+) -->\n(?P<text>.*?)^<!-- end (?P=name) -->", re.DOTALL | re.MULTILINE
)
MARKER = re.compile(r"^<!-- (?:begin|end) (\S+) -->", re.MULTILINE)


def pages(root: Path) -> list[Path]:
    """All Markdown files of the repository, tracked or new."""
    command = ["git", "-C", str(root), "ls-files", "-co", "--exclude-standard", "*.md"]
    listed = subprocess.run(command, capture_output=True, text=True, check=False)
    if listed.returncode:  # no repository, such as a copy that a test made
        return sorted(root.rglob("*.md"))
    return sorted(
        path for name in set(listed.stdout.splitlines()) if (path := root / name).exists()
    )


def generated(name: str, results: Path) -> str:
    """The text of one block.

    Raises:
        ValueError: no generator has this name; a result file cannot be made a table of.
        OSError: the result file cannot be read.
    """
    generators: dict[str, Callable[[], str]] = doc_reference.GENERATORS | doc_python.GENERATORS
    if name in generators:
        return generators[name]()
    return doc_tables.block(name, results)


def update(root: Path, write: bool) -> list[str]:
    """Compare every block of every page with what its generator says, or write it.

    Returns:
        One line for each fault.
    """
    faults = []
    for page in pages(root):
        text = page.read_text(encoding="utf-8")
        name = page.relative_to(root)
        blocks = list(BLOCK.finditer(text))
        if len(MARKER.findall(text)) != 2 * len(blocks):
            faults.append(f"{name}: a block begins or ends alone, or holds another")
            continue
        for block in reversed(blocks):
            try:
                made = generated(block["name"], root / "benchmarks" / "results")
            except (ValueError, OSError, KeyError) as error:
                faults.append(f"{name}: block {block['name']}: {error}")
                continue
            wanted = f"\n{made.strip()}\n\n"
            if block["text"] == wanted:
                continue
            if write:
                text = text[: block.start("text")] + wanted + text[block.end("text") :]
            else:
                line = (
                    text.count("\n", 0, block.start())
                    + 1
                    + _first_difference(block["text"], wanted)
                )
                faults.append(
                    f"{name}:{line}: block {block['name']} differs from its source: "
                    "run `make docs-write`"
                )
        if write:
            page.write_text(text, encoding="utf-8")
    return faults


def unused(root: Path) -> list[str]:
    """One line for each result file that no page shows."""
    names = [n for page in pages(root) for n in MARKER.findall(page.read_text(encoding="utf-8"))]
    shown = {name.partition(":")[0] for name in names}
    results = root / "benchmarks" / "results"
    files = sorted(path.relative_to(results).as_posix() for path in results.rglob("*.json"))
    return [f"benchmarks/results/{file}: no page shows it" for file in files if file not in shown]


def several_versions(root: Path) -> list[str]:
    """One line if the figures are not all of one version: what lies directly in results/."""
    found: dict[str, list[str]] = {}
    for path in sorted((root / "benchmarks" / "results").glob("*.json")):
        record = json.loads(path.read_text(encoding="utf-8"))
        found.setdefault(record.get("commit", "none"), []).append(path.stem)
    if len(found) < 2:
        return []
    told = "; ".join(f"{commit}: {', '.join(names)}" for commit, names in sorted(found.items()))
    return [f"benchmarks/results: figures are of several versions: {told}"]


def _first_difference(text: str, wanted: str) -> int:
    """Lines from the block's marker to the first that differs."""
    pairs = zip(text.splitlines(), wanted.splitlines(), strict=False)
    return 1 + next((i for i, (a, b) in enumerate(pairs) if a != b), 0)
