"""Names that pages take from the code: commands, options, imports, fields, constants, files.

A page that names what is not there is a fault, as a reader finds it too late.
"""

from __future__ import annotations

import ast
import inspect
import re
import shlex
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path

import doc_blocks

from univoxel.cli import COMMANDS, LABORATORY, help_screen, laboratory, understood
from univoxel.cli.parsing import LAB, Usage

COMMAND = re.compile(r"^    univoxel +(.+)$|^univoxel +([a-z]+ (?:\S*/|-).*)$", re.MULTILINE)
CODE = re.compile(r"```[\s\S]*?```|`[^`\n]+`|^    .*$", re.MULTILINE)
FIELD = re.compile(r"\b([A-Z]\w*Config)\.(\w+)")
CONSTANT = re.compile(r"(?<![\w/.-])[A-Z][A-Z_]{3,}(?![\w/.-])")
FILE = re.compile(r"(?<![\w./])(?:univoxel/)?((?:\w+/)*\w+\.(?:py|cpp))\b")
# Options of every command
COMMON = {"--help", "--quiet", "--verbose", "--threads", "--from"}
# Placeholders of commands, and names that are not ours
WORDS = {
    *("ADDRESS", "ANGLE", "AZIMUTH", "DATA", "DEGREES", "ELEVATION", "FACTOR", "FILE", "HEIGHT"),
    *("INTENSITY", "IRRADIANCE", "NAME", "PIXELS", "SHARE", "TEXELS"),
    *(
        "COLMAP",
        "EPYC",
        "PSNR",
        "OPENCV",
        "OMP_NUM_THREADS",
        "ATEN_CPU_CAPABILITY",
        "QT_QPA_PLATFORM",
    ),
}


def faults(root: Path) -> list[str]:
    """One line for each name of a page that is not there."""
    found = tree(root)
    checks: list[Callable[[str], list[str]]] = [commands, spans, imports]
    checks.append(lambda text: targets(root, text))
    for page in doc_blocks.pages(root):
        name, text = page.relative_to(root).as_posix(), page.read_text(encoding="utf-8")
        lines = [line for check in checks for line in check(text)]
        if name.startswith(("docs/guide/", "docs/explanation/")):
            lines += [f"no such name: {fault}" for fault in unknown(root, text)]
        found += [f"{name}: {line}" for line in lines]
    return found


def commands(text: str) -> list[str]:
    """Command lines that the command line refuses."""
    found = []
    for match in COMMAND.finditer(re.sub(r" *\\\n *", " ", text)):
        line = match[1] or match[2]
        if "[--" not in line and "COMMAND" not in line and not accepted(line):
            found.append(f"no such command: univoxel {line}")
    return found


def accepted(line: str) -> bool:
    """Whether the arguments make a command."""
    arguments = [a for a in shlex.split(line, comments=True) if a != "--traceback"]
    if sorted(arguments) in (["--version"], ["--verbose", "--version"]):
        return True
    try:
        if help_screen(arguments) is None:
            understood(arguments)
    except Usage:
        return False
    return True


def spans(text: str) -> list[str]:
    """Code spans in sentences that name commands or options that are not there."""
    found = []
    for span in re.findall(r"`univoxel ([^`]+)`", " ".join(text.split())):
        words = span.split()
        known = laboratory() if words[0] == LAB or words[0] in LABORATORY else COMMANDS
        name = words[1] if words[0] == LAB and len(words) > 1 else words[0]
        if name in (LAB, "COMMAND") or name.startswith("--") or span.startswith("was built"):
            continue  # the last is a message
        parameters = inspect.signature(known[name]).parameters if name in known else ()
        options = {"--" + p.replace("_", "-") for p in parameters} | COMMON
        if name not in known or set(re.findall(r"--[a-z-]+", span)) - options:
            found.append(f"no such command or option: univoxel {span}")
    return found


def imports(text: str) -> list[str]:
    """Python code that does not compile, or imports what is not there."""
    found = []
    for block in re.findall(r"^```python\n(.*?)^```", text, re.MULTILINE | re.DOTALL):
        try:
            if not re.match(r"\s*(?:@|def |class )", block):  # signatures of the reference
                compile(block, "page", "exec")
            for line in re.findall(r"^(?:from|import) .*", block, re.MULTILINE):
                exec(line, {})
        except (SyntaxError, ImportError) as error:
            found.append(f"Python code: {error}")
    return found


def targets(root: Path, text: str) -> list[str]:
    """Targets of make, and scripts, that are not there."""
    there = re.search(r"\.PHONY: (.*)", (root / "Makefile").read_text(encoding="utf-8"))
    known = there.group(1).split() if there else []
    wanted = re.findall(r"^    make ([a-z-]+)", text, re.MULTILINE)
    scripts = re.findall(r"python ((?:benchmarks|scripts|examples|tests)/\S+)", text)
    return [f"no such target: make {name}" for name in wanted if name not in known] + [
        f"no such script: {script}" for script in scripts if not (root / script).exists()
    ]


def tree(root: Path) -> list[str]:
    """Where the tree of CONTRIBUTING.md and the folders of the package differ."""
    text = (root / "CONTRIBUTING.md").read_text(encoding="utf-8")
    table = text.partition("## The tree")[2].partition("## Rules")[0]
    rows = " ".join(re.findall(r"^\| (`.*?) \|", table, re.MULTILINE))
    places = root, root / "univoxel"
    gone = [n for n in re.findall(r"`([^`]+)`", rows) if not any((p / n).exists() for p in places)]
    named = set(re.findall(r"`(?:univoxel/)?([a-z]+(?:\.py|/))`", table))
    package = {p.name + "/" * p.is_dir() for p in (root / "univoxel").iterdir()}
    unnamed = sorted(
        n for n in package - named if not n.startswith(("_", "example_data", "py.typed"))
    )
    return [f"CONTRIBUTING.md: no such file or folder: {name}" for name in gone] + [
        f"CONTRIBUTING.md: the tree lacks {name}" for name in unnamed
    ]


def unknown(root: Path, text: str) -> list[str]:
    """Configurations' fields, constants and files in the code of a page that are not there."""
    code = "\n".join(m.group() for m in CODE.finditer(text))
    fields, constants = names(root)
    found = [f"{c}.{f}" for c, f in FIELD.findall(code) if f not in fields.get(c, ())]
    found += [c for c in CONSTANT.findall(code) if c not in constants | WORDS]
    folders = (root, root / "univoxel", root / "docs")
    return found + [f for f in FILE.findall(code) if not any((d / f).exists() for d in folders)]


@cache
def names(root: Path) -> tuple[dict[str, set[str]], set[str]]:
    """Fields by the names of configurations, and all names that are assigned."""
    fields: dict[str, set[str]] = {}
    assigned: set[str] = set()
    for node in nodes(root / "univoxel"):
        if isinstance(node, ast.ClassDef) and node.name.endswith("Config"):
            lines = [n.target for n in node.body if isinstance(n, ast.AnnAssign)]
            fields[node.name] = {target.id for target in lines if isinstance(target, ast.Name)}
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            assigned.add(node.id)
    return fields, assigned


def nodes(folder: Path) -> Iterator[ast.AST]:
    for path in folder.rglob("*.py"):
        yield from ast.walk(ast.parse(path.read_text(encoding="utf-8")))
