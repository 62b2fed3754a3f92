"""How large the package is and how it hangs together: prints the figures and holds them to limits.

Limits only fall: a change that needs more says why, and raises one here where all can see it.

    python scripts/house.py
"""

from __future__ import annotations

import ast
import re
import sys
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "tests"))

from layers import LAYERS  # noqa: E402

LIMITS = {
    "lines of the package": 36_500,
    "lines of the laboratory": 3_100,
    "lines of tests": 36_700,
    "modules of the package": 261,
    "loose modules at the top": 36,
    "configuration fields": 131,
    "fields that nothing sets": 0,
    "layers": 16,
    "imports that go up": 0,
    "circles": 0,
}


def lines(*patterns: str) -> int:
    """Of the Python files that patterns find below the root."""
    files = {path for pattern in patterns for path in ROOT.glob(pattern)}
    return sum(len(path.read_text(encoding="utf-8").splitlines()) for path in files)


def tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


def fields() -> list[tuple[str, str]]:
    """Class and name of each field of a configuration."""
    return [
        (node.name, line.target.id)
        for path in ROOT.glob("univoxel/**/*.py")
        for node in ast.walk(tree(path))
        if isinstance(node, ast.ClassDef) and node.name.endswith("Config")
        for line in node.body
        if isinstance(line, ast.AnnAssign) and isinstance(line.target, ast.Name)
    ]


def names_set() -> set[str]:
    """Names that anything gives a value: keywords of calls, keys of dicts, FIELD=VALUE in text."""
    found: set[str] = set()
    for folder in ("univoxel", "tests", "lab", "benchmarks", "docs", "examples"):
        for path in (ROOT / folder).rglob("*.py"):
            for node in ast.walk(tree(path)):
                if isinstance(node, ast.keyword) and node.arg:
                    found.add(node.arg)
                elif isinstance(node, ast.Dict):
                    found |= {key.value for key in node.keys if isinstance(key, ast.Constant)}
                elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                    found |= set(re.findall(r"(\w+)(?==)", node.value))
    for path in [*ROOT.glob("docs/**/*.md"), ROOT / "README.md"]:
        found |= set(re.findall(r"(\w+)=\S", path.read_text(encoding="utf-8")))
    return {name for name in found if isinstance(name, str)}


def imports() -> dict[str, set[str]]:
    """Modules of the package that each module imports, by names without the package's."""
    known = {}
    for path in ROOT.glob("univoxel/**/*.py"):
        parts = path.relative_to(ROOT / "univoxel").with_suffix("").parts
        known[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    found: dict[str, set[str]] = {}
    for module, path in known.items():
        if not module:  # imports lazily what a user asks for
            continue
        found[module] = set()
        for node in ast.walk(tree(path)):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("univoxel"):
                parent = (node.module or "").removeprefix("univoxel").lstrip(".")
                for alias in node.names:
                    inner = f"{parent}.{alias.name}".lstrip(".")
                    target = inner if inner in known else parent
                    found[module] |= {target} if target else set()
    return found


def figures() -> dict[str, int]:
    """What is counted, in the order of LIMITS."""
    edges = imports()
    level = {name: k for k, names in enumerate(LAYERS) for name in names}
    up = sum(
        level[target.split(".")[0]] > level[module.split(".")[0]]
        for module, targets in edges.items()
        for target in targets
    )
    circles = 0
    try:
        TopologicalSorter(edges).prepare()
    except CycleError:
        circles = 1
    known, given = fields(), names_set()
    files = [*ROOT.glob("univoxel/**/*.py")]
    return {
        "lines of the package": lines("univoxel/**/*.py"),
        "lines of the laboratory": lines("lab/*.py", "lab/stress/*.py"),
        "lines of tests": lines("tests/**/*.py", "lab/tests/**/*.py"),
        "modules of the package": len(files),
        "loose modules at the top": sum(p.parent == ROOT / "univoxel" for p in files) - 1,
        "configuration fields": len(known),
        "fields that nothing sets": sum(name not in given for _, name in known),
        "layers": len(LAYERS),
        "imports that go up": up,
        "circles": circles,
    }


def main() -> int:
    over = 0
    for name, value in figures().items():
        limit = LIMITS[name]
        over += value > limit
        print(f"{name:28} {value:7,}  at most {limit:7,}{'  TOO MANY' * (value > limit)}")
    return int(over > 0)


if __name__ == "__main__":
    sys.exit(main())
