"""What pages promise: options that exist, metrics that are defined."""

from __future__ import annotations

import inspect
import json
import re
from functools import cache
from pathlib import Path

import doc_blocks
import doc_prose
import doc_reference

DEFINITIONS = "docs/results/index.md"  # of all metrics
FLAG = re.compile(r"(?<![\w-])--[a-z][a-z-]*\b")
SPAN = re.compile(r"(`+)(.+?)\1", re.DOTALL)
CALL = re.compile(r"\bunivoxel ((?:lab )?[a-z]+)\b([^`\n]*)")
# Flags of every command, and those that no command lists
COMMON = {"--help", "--quiet", "--verbose", "--threads", "--version", "--traceback"}
OTHERS = {"--nthreads"}  # of workers of Dask, which pages tell of too


def faults(root: Path) -> list[str]:
    """One line for each promise that a page or an example does not keep."""
    found = []
    for page in doc_blocks.pages(root):
        name, text = page.relative_to(root).as_posix(), page.read_text(encoding="utf-8")
        if name != "CHANGELOG.md":  # which tells of options that are gone
            found += [f"{name}: no such option: {flag}" for flag in unknown_flags(text)]
        if tables(text) and not defined(page, text, root):
            found.append(f"{name}: has a table of figures and no link to {DEFINITIONS}")
    for example in sorted((root / "examples").rglob("*")):
        if example.suffix in (".py", ".ipynb"):
            name, text = example.relative_to(root).as_posix(), example.read_text(encoding="utf-8")
            found += [f"{name}: no such option: {flag}" for flag in unknown_flags(_cells(text))]
    return found


@cache
def options() -> dict[str, set[str]]:
    """Flags of each command, those of the laboratory as `lab NAME`."""
    from univoxel.cli import COMMANDS, laboratory
    from univoxel.cli.parsing import hints_of

    named = COMMANDS | {f"lab {name}": function for name, function in laboratory().items()}
    found = {}
    for name, function in named.items():
        hints = hints_of(function)
        parameters = inspect.signature(function).parameters.values()
        written = [doc_reference._option(p, hints[p.name])[0].strip("`") for p in parameters]
        found[name] = {flag for flag in written if flag.startswith("--")} | COMMON
    return found


def unknown_flags(text: str) -> list[str]:
    """Flags that no command has; after the name of a command, those that it does not have.

    Only flags of univoxel are looked at: in calls of it, and in code spans that begin with a flag
    or with the name of a command.
    """
    known = options()
    everywhere = OTHERS.union(*known.values())
    found = []
    joined = re.sub(r" *\\\n *", " ", text)
    for command, arguments in CALL.findall(joined):
        name = command if command in known else f"lab {command}"
        own = known.get(name, everywhere)
        found += [f for f in FLAG.findall(arguments.partition("#")[0]) if f not in own]
    for _, span in SPAN.findall(doc_prose.without_code(text)):
        words = span.split()
        if words and words[0].startswith("--"):
            found += [flag for flag in FLAG.findall(span) if flag not in everywhere]
        elif words and words[0] in known:
            found += [flag for flag in FLAG.findall(span) if flag not in known[words[0]]]
    return list(dict.fromkeys(found))


def tables(text: str) -> bool:
    """Whether a page shows figures from a result file."""
    return any(".json" in name for name in doc_blocks.MARKER.findall(text))


def defined(page: Path, text: str, root: Path) -> bool:
    """Whether a page is that of the definitions, or links to it."""
    wanted = (root / DEFINITIONS).resolve()
    links = [(page.parent / target).resolve() for target in doc_prose.links(text)]
    return wanted in (page.resolve(), *links)


def _cells(text: str) -> str:
    """The text of a notebook's cells; of another file its own."""
    if not text.startswith("{"):
        return text
    return "\n".join("".join(cell["source"]) for cell in json.loads(text)["cells"])
