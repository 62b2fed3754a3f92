"""How large the package is and how it hangs together: prints the figures and holds them to limits.

Limits only fall: a change that needs more says why, and raises one here where all can see it.

    python scripts/house.py
"""

from __future__ import annotations

import ast
import re
import sys
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "tests"))

from layers import LAYERS, violations  # noqa: E402

LIMITS = {
    "lines of the package": 36_940,
    "lines of the laboratory": 5_300,
    "lines of tests": 34_610,
    "modules of the package": 162,
    "loose modules at the top": 12,
    "configuration fields": 126,
    "fields that nothing sets": 0,
    "layers": 10,
    "imports that go up": 0,
    "circles": 0,
    "files that a ray batch crosses": 4,
    "files that read one option": 3,
}

# What a batch goes through from drawn pixels to its losses, as run_stage calls it
BATCH = ("batch_at", "surface_at", "losses_of", "patches.disagreement")
# Where a training's options are read: its command, presets, and what they are there for
READERS = ("cli/train.py", "cli/trainer.py", "presets.py", "training/*.py", "preparation/*.py")


def lines(*patterns: str) -> int:
    """Of the Python files that patterns find below the root."""
    files = {path for pattern in patterns for path in ROOT.glob(pattern)}
    return sum(len(path.read_text(encoding="utf-8").splitlines()) for path in files)


@cache
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


def crossed(start: Path, calls: tuple[str, ...]) -> set[Path]:
    """Files of training/ and render/ that hold what is named in a file, or what that names."""
    folders = {f"univoxel.{name}": ROOT / "univoxel" / name for name in ("training", "render")}
    found: set[Path] = set()
    waiting, seen = [(start, call) for call in calls], set()
    while waiting:
        path, call = waiting.pop()
        module, head, (name, *rest) = tree(path), {}, call.split(".")
        for node in module.body:
            if isinstance(node, ast.ImportFrom) and node.module:
                inner = f"{node.module}."
                head |= {alias.asname or alias.name: inner + alias.name for alias in node.names}
        if (path, call) in seen:
            continue
        seen.add((path, call))
        if name in head:  # of another file, or a file's own
            place, _, last = ".".join([head[name], *rest]).rpartition(".")
            folder, _, file = place.rpartition(".")
            if folder in folders:
                waiting.append((folders[folder] / f"{file}.py", last))
            continue
        body = [n for n in module.body if getattr(n, "name", None) == name]
        found |= {path} if body else set()
        for node in (inner for one in body for inner in ast.walk(one)):
            if isinstance(node, ast.Name):
                waiting.append((path, node.id))
            elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
                waiting.append((path, f"{node.value.id}.{node.attr}"))
    return found


def read_in(option: str) -> int:
    """Files that read a field of a training's configuration, its command among them."""
    names = {"cfg", "config", "self"}  # self: the options of the command
    return sum(
        any(
            isinstance(node, ast.Attribute)
            and node.attr == option
            and isinstance(node.value, ast.Name)
            and node.value.id in names - ({"self"} if path.name != "train.py" else set())
            for node in ast.walk(tree(path))
        )
        for pattern in READERS
        for path in (ROOT / "univoxel").glob(pattern)
    )


def options() -> list[str]:
    """Options of train that are fields of its configuration, too, but for its folders."""
    (command,) = (
        node
        for node in tree(ROOT / "univoxel/cli/train.py").body
        if isinstance(node, ast.ClassDef) and node.name == "TrainOptions"
    )
    given = {line.target.id for line in command.body if isinstance(line, ast.AnnAssign)}
    return [
        name for kind, name in fields() if kind == "TrainConfig" and name in given - {"data", "out"}
    ]


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
        "files that a ray batch crosses": len(crossed(ROOT / "univoxel/training/loop.py", BATCH)),
        "files that read one option": max(map(read_in, options())),
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
