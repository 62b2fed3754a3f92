"""Words and phrases that the style guide refuses, in pages and in the texts of the program.

CONTRIBUTING.md, section "Writing", says how to write instead. A marker is a regular expression that
hardly ever matches a good sentence; it is searched without regard to case. Code and generated
blocks are skipped, and so are words in italics, which are mentioned rather than used.
"""

from __future__ import annotations

import ast
import random
import re
from collections.abc import Iterator
from pathlib import Path

import doc_blocks
import doc_prose

# What not to write, what to write instead, and an example that is refused
MARKERS: list[tuple[str, str, str]] = [
    (r"\banew\b", "again, or from the start", "it is trained anew"),
    (r"\bat the begin\b", "at the beginning", "small at the begin"),
    (r"\bbelongs? into\b", "belongs in", "it belongs into a folder"),
    (r"\bbit by bit\b", "bit for bit, or gradually", "the same, bit by bit"),
    (r"\b(?:goes|go|went) on\b", "resumes, continues", "the same command goes on"),
    (r"\bforetells?\b", "predicts", "views that foretell others"),
    (r"\bmend(?:s|ed|ing)?\b", "fix", "mend it by hand"),
    (r"\bdear(?:er|est)?\b", "expensive", "steps that are dear"),
    (
        r"\b(?:puts?|putting) (?:\S+ ){0,5}right\b(?! (?:side|of|hand))",
        "corrects",
        "puts the cameras right",
    ),
    (r"\bas of (?!version|now|today|\d)", "as in, like", "the options are as of train"),
    (r"\bso many\b", "that number of, N", "so many have a camera"),
    (r"\bwhat looks like\b", "name the thing", "remove what looks like a table"),
    (
        r"(?<!leave )(?<!leaves )(?<!left )(?<!let )(?<!it )(?<!them )(?<!stand-)\balone\b",
        "only",
        "depth alone tells",
    ),
    (
        r"\b(?:stands|stood) (?!for\b|out\b|still\b|on\b|in front\b|before\b|around\b)",
        "is",
        "the number stands there",
    ),
    (r"\blies (?:beside|there|below RUN)\b", "is", "a file lies beside it"),
    (
        r"\bwhere (?:there (?:is|are|was|were) (?:no|none|one|any)|none|nothing|asked|needed)\b",
        "if",
        "the default where there is none",
    ),
    (
        r"\b(?:of|by|with|for) what (?!it|you|we|they|to\b|happen)",
        "name the thing",
        "half of what fits",
    ),
    (
        r"(?:^|[.;:] )What (?:is|are|was|has|does|comes|differs|fits|lies|looks) [^?.:]*\.",
        "name the thing",
        "What is there is kept.",
    ),
    (
        r"(?:\.(?:json|txt|html|md|csv|py)|\bCODE|\b(?:page|file|table|log|mask|view)s?|\bglossary|"
        r"\bphotographs?|\bphotos|\bpictures|\bsilhouettes) "
        r"(?:says?|foretells?|decides?|speaks?|tells?)\b",
        "a person says; a file contains, lists or shows",
        "the log says it",
    ),
    # Words of the field
    (r"\bdoubt(?:s|ed|ful)?\b", "uncertainty, uncertain", "doubt of the albedo"),
    (r"\bheld-out (?:rays|dB)\b", "validation pixels", "0.1 on held-out rays"),
    (r"\bpinned\b", "frozen", "nodes are pinned"),
    (r"\bjoint solve\b", "joint optimisation", "after the joint solve"),
    (r"\bhypothesis trials?\b", "multi-start initialisation", "hypothesis trials begin"),
    (r"\bmetal decision\b", "metal classification", "the metal decision"),
    (
        r"\bmirrored (?:light|directions?)\b",
        "specular reflection, reflected direction",
        "a table of mirrored directions",
    ),
    (r"\b(?:grey|mirror) balls?\b", "diffuse sphere, chrome sphere", "a grey ball"),
    (r"\btelephones?\b", "phones", "photographs of telephones"),
    (r"\bcontradicts? one another\b", "are inconsistent", "masks contradict one another"),
    (
        r"\bmasks? (?:are|is|were) taken in\b|\btakes? masks in\b",
        "masks are eroded",
        "the masks are taken in",
    ),
    (r"\bmatched points off\b", "epipolar error", "matched points off their lines"),
    (
        r"\ba house of\b|\brooms of the package\b",
        "packages, layers",
        "the code is a house of rooms",
    ),
]
# Keys of JSON files, which stay
KEYS = {"mirrored light"}
# Only in texts of the program: labels without their noun
LABELS = [(r"^of (?!the form\b)", "name the thing", "of all random choices")]

PAGES = ("README.md", "CONTRIBUTING.md", "docs/")
PROGRAM = ("univoxel/**/*.py", "lab/*.py")
# Functions whose docstrings the command line prints
HELP = ("command", "export", "inspect", "completion", "lab")
HELP += ("submit", "compare", "chart", "stress", "bank")


def faults(root: Path) -> list[str]:
    """One line for each place where a page or a text of the program uses such a phrase."""
    found = []
    for page in doc_blocks.pages(root):
        name = page.relative_to(root).as_posix()
        if name.startswith(PAGES):
            text = page.read_text(encoding="utf-8")
            found += [f"{name}:{line}: {what}" for line, what in of_page(text)]
    for path in sorted({path for pattern in PROGRAM for path in root.glob(pattern)}):
        name = path.relative_to(root).as_posix()
        for line, text in texts(path.read_text(encoding="utf-8")):
            found += [f"{name}:{line}: {what}" for what in slips(text) if text not in KEYS]
    return found


def of_page(text: str) -> list[tuple[int, str]]:
    """Line and fault of each slip on a page; a phrase may be broken over lines."""
    prose = doc_prose.without_blocks(doc_prose.without_code(text))
    prose = doc_prose.CODE_SPAN.sub(lambda m: "CODE" + "\n" * m.group().count("\n"), prose)
    prose = re.sub(r"\]\([^)]*\)", "]", prose)
    prose = re.sub(r"(?<!\*)\*[^*\n]+\*(?!\*)", "MENTION", prose)
    found, start = [], 1
    for paragraph in re.split(r"(\n\s*\n|\n(?=\s*(?:[-|#>]|\d+\. )))", prose):
        flat = paragraph.replace("\n", " ")
        for pattern, instead, _ in MARKERS:
            for match in re.finditer(pattern, flat, re.IGNORECASE):
                line = start + paragraph.count("\n", 0, match.start())
                found.append((line, _told(match, instead)))
        start += paragraph.count("\n")
    return sorted(found)


def slips(text: str) -> list[str]:
    """Phrases that are refused in a text of the program, each with what to write instead."""
    flat = " ".join(re.sub(r"`[^`]*`", "CODE", text).split())
    return [
        _told(match, instead)
        for pattern, instead, _ in MARKERS + LABELS
        for match in re.finditer(pattern, flat, re.IGNORECASE)
    ]


def texts(source: str) -> Iterator[tuple[int, str]]:
    """Line and text of the strings of a module that people read.

    Those are literals of several words, without the values of f-strings, and docstrings of
    commands. Other docstrings are for people who read the code.
    """
    tree = ast.parse(source)
    hidden: set[ast.AST] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.JoinedStr):
            hidden |= set(ast.walk(node)) - {node}
        elif isinstance(node, ast.FunctionDef | ast.ClassDef | ast.Module) and node.body:
            if isinstance(node.body[0], ast.Expr) and getattr(node, "name", "") not in HELP:
                hidden.add(node.body[0].value)
    for node in ast.walk(tree):
        if node in hidden:
            continue
        if isinstance(node, ast.JoinedStr):
            parts = [v.value if isinstance(v, ast.Constant) else "X" for v in node.values]
            if " " in (text := "".join(map(str, parts))).strip():
                yield node.lineno, text
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            if " " in node.value.strip():
                yield node.lineno, node.value


def _told(match: re.Match[str], instead: str) -> str:
    return f"{match.group().strip()!r}: write {instead}"


# Where a sample of sentences comes from, and its share
SAMPLED = {
    "README.md": 0.1,
    "docs/tutorials/*.md": 0.1,
    "docs/guide/*.md": 0.25,
    "docs/method/*.md": 0.1,
    "docs/results/*.md": 0.05,
    "docs/reference/*.md": 0.15,
    "univoxel/**/*.py": 0.25,
}


def sample(root: Path, count: int, seed: int) -> list[str]:
    """Random sentences of pages and program, `count` in all, for a reader who judges them."""
    draw, drawn = random.Random(seed), []
    for pattern, share in SAMPLED.items():
        found = []
        for path in sorted(root.glob(pattern)):
            text = path.read_text(encoding="utf-8")
            if path.suffix == ".py":
                told = [part for _, part in texts(text)]
            else:
                plain = doc_prose.without_blocks(doc_prose.without_code(text))
                told = re.split(r"\n\s*\n|\n(?=\s*(?:[-|#>]|\d+\. ))", plain)
            name = path.relative_to(root).as_posix()
            for part in told:
                for sentence in re.split(r"(?<=[.?!:]) +(?=[A-Z`*])", " ".join(part.split())):
                    if len(sentence.split()) > 4 and not sentence.startswith("|"):
                        found.append(f"{name}: {sentence}")
        drawn += draw.sample(found, min(len(found), round(share * count)))
    return drawn
