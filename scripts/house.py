"""How large the package is and how it hangs together: prints the figures and holds them to limits.

Limits only fall: a change that needs more says why, and raises one here where all can see it.

    python scripts/house.py
"""

from __future__ import annotations

import ast
import re
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "tests"))

from layers import LAYERS, violations  # noqa: E402

LIMITS = {
    "lines of the package": 37_020,
    "lines of the laboratory": 5_300,
    "lines of tests": 37_050,
    "modules of the package": 160,
    "loose modules at the top": 12,
    "configuration fields": 128,
    "fields that nothing sets": 0,
    "layers": 10,
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


def figures() -> dict[str, int]:
    """What is counted, in the order of LIMITS."""
    wrong = violations(ROOT / "univoxel")
    circles = sum(line.startswith("a circle") for line in wrong)
    known, given = fields(), names_set()
    files = [*ROOT.glob("univoxel/**/*.py")]
    return {
        "lines of the package": lines("univoxel/**/*.py"),
        "lines of the laboratory": lines("lab/*.py", "lab/stress/*.py", "lab/bank/*.py"),
        "lines of tests": lines("tests/**/*.py", "lab/tests/**/*.py"),
        "modules of the package": len(files),
        "loose modules at the top": sum(p.parent == ROOT / "univoxel" for p in files) - 1,
        "configuration fields": len(known),
        "fields that nothing sets": sum(name not in given for _, name in known),
        "layers": len(LAYERS),
        "imports that go up": len(wrong) - circles,
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
