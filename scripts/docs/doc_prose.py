"""Rules for the prose of all pages: length of lines, numbers, links.

Measured numbers stand in generated blocks alone. A measured number is one with a unit, such as
`30 dB`: what a reader may not be able to reproduce, and what changes with the program. Sizes in
commands, names of settings and formulas belong into code spans or code blocks, which are free.
"""

from __future__ import annotations

import re
from pathlib import Path

import doc_blocks

COLUMNS = 100
README_LINES = 120

# Where numbers with units may stand anywhere: a history, and mathematics
FREE = (
    "CHANGELOG.md",
    "docs/derivations/",
    "univoxel/example_data/",
)

UNITS = (
    r"dB|%|percent|per cent|ms|s|seconds?|stops?|nats?|degrees?|"
    r"[kMG]B|[KMG]iB|GFLOP/s|x(?! ?\d)|times"
)
MEASURED = re.compile(rf"(?<![\w.^-])\d[\d,.]*(?: to \d[\d,.]*)? ?(?:{UNITS})(?![\w^])")
CODE_SPAN = re.compile(r"(`+).+?\1", re.DOTALL)
LINK = re.compile(r"!?\[[^\]]*\]\(([^)\s]+)[^)]*\)")


def faults(root: Path) -> list[str]:
    """One line for each place where a page breaks a rule."""
    found = []
    for page in doc_blocks.pages(root):
        name = page.relative_to(root).as_posix()
        text = page.read_text(encoding="utf-8")
        found += [f"{name}:{n}: {length} columns" for n, length in long_lines(text)]
        if name == "README.md" and (lines := text.count("\n")) > README_LINES:
            found.append(f"{name}: {lines} lines, at most {README_LINES}")
        if not name.startswith(FREE):
            found += [
                f"{name}:{n}: measured number outside of a generated block: {number}"
                for n, number in measured(text)
            ]
        found += [
            f"{name}: no such file: {target}"
            for target in links(text)
            if not (page.parent / target).exists()
        ]
        found += [
            f"{name}: {target} is no page of the site: name it in a code span, without a link"
            for target in links(text)
            if name.startswith("docs/") and leaves_docs(page, target, root)
        ]
    return found


def long_lines(text: str) -> list[tuple[int, int]]:
    """Number and length of the lines of prose that are too long; targets of links do not count."""
    blank = _without_blocks(_without_code(text))
    lengths = [
        (n, len(re.sub(r"\]\([^)]*\)", "]", line)))
        for n, line in enumerate(blank.splitlines(), 1)
        if not line.lstrip().startswith("|")
    ]
    return [(n, length) for n, length in lengths if length > COLUMNS]


def measured(text: str) -> list[tuple[int, str]]:
    """Line and text of the numbers with a unit that stand outside of code and generated blocks."""
    prose = _without_blocks(_without_code(text))
    prose = CODE_SPAN.sub(_blank, prose)
    prose = re.sub(r"\]\([^)]*\)", _blank, prose)
    return [(prose.count("\n", 0, m.start()) + 1, m.group()) for m in MEASURED.finditer(prose)]


def links(text: str) -> list[str]:
    """Files of the repository that a page links to, relative to it."""
    prose = CODE_SPAN.sub(_blank, _without_code(text))
    targets = [target.partition("#")[0] for target in LINK.findall(prose)]
    return [t for t in targets if t and not re.match(r"[a-z]+:", t)]


def leaves_docs(page: Path, target: str, root: Path) -> bool:
    """Whether a link of a page leads to Markdown outside of docs/, which Sphinx does not know."""
    path = (page.parent / target).resolve()
    return path.suffix == ".md" and not path.is_relative_to((root / "docs").resolve())


def _without_code(text: str) -> str:
    """Code blocks, fenced or indented, made blank; lines stay where they are."""
    lines, fence, before = [], "", ""
    for line in text.splitlines():
        marker = re.match(r"\s*(```+|~~~+|:::+)", line)
        if fence:
            if line.strip() == fence:
                fence = ""
            lines.append("")
        elif marker:
            fence = marker.group(1)
            lines.append("")
        elif line.startswith("    ") and (not before.strip() or lines[-1] == ""):
            lines.append("")
        else:
            lines.append(line)
        before = line
    return "\n".join(lines)


def _without_blocks(text: str) -> str:
    return doc_blocks.BLOCK.sub(_blank, text)


def _blank(match: re.Match[str]) -> str:
    """As many lines, all empty."""
    return "\n" * match.group().count("\n")
