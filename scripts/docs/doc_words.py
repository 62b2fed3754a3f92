"""Words and phrases that the style guide refuses, in pages and in the texts of the program.

CONTRIBUTING.md, section "Writing", says how to write instead. A marker is a regular expression that
hardly ever matches a good sentence; it is searched without regard to case. Code and generated
blocks are skipped, and so are words in italics, which are mentioned rather than used.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import doc_blocks
import doc_prose

# What not to write, and what to write instead
MARKERS = {
    r"\banew\b": "again, or from the start",
    r"\bat the begin\b": "at the beginning",
    r"\bbelongs? into\b": "belongs in",
    r"\bbit by bit\b": "bit for bit, or gradually",
    r"\b(?:goes|go|went) on\b": "resumes, continues",
    r"\bforetells?\b": "predicts",
    r"\bmend(?:s|ed|ing)?\b": "fix",
    r"\bdear(?:er|est)?\b": "expensive",
    r"\bputs? (?:\S+ ){0,5}right\b|\bputting (?:\S+ ){0,5}right\b": "corrects",
    r"\bas of (?!version|now|today|\d)": "as in, like",
    r"\bso many\b": "that number of, N",
    r"\bwhat looks like\b": "name the thing",
    r"\bas photographs? shows? it\b": "according to the photographs",
    r"(?<!leave )(?<!leaves )(?<!left )(?<!let )(?<!it )(?<!them )(?<!stand-)\balone\b": "only",
    r"\b(?:stands|stood) (?!for\b|out\b|still\b|on\b|in front\b|before\b)": "is",
    r"\blies (?:beside|there|below RUN)\b": "is",
    r"\bwhere (?:there (?:is|are|was|were)|none|nothing|asked|needed)\b": "if",
    r"\b(?:of|by|with|for) what (?!it|you|we|they|to\b|happen)": "name the thing",
    r"(?:^|[.;:] )What (?:is|are|was|has|does|comes|differs|fits|lies|looks) [^?.:]*\.": "name it",
    r"(?:\.(?:json|txt|html|md|csv|py)|\bCODE|\bpages?|\bfiles?|\btables?|\blogs?|\bglossary|"
    r"\bphotographs?|\bphotos|\bmasks?|\bpictures|\bsilhouettes|\bviews) "
    r"(?:says?|foretells?|decides?|speaks?|tells?)\b": "somebody says; a file lists or contains",
    # Words of the field
    r"\bdoubt(?:s|ed|ful)?\b": "uncertainty, uncertain",
    r"\bheld-out (?:rays|dB)\b": "validation pixels",
    r"\bpinned\b": "frozen",
    r"\bjoint solve\b": "joint optimisation",
    r"\bhypothesis trials?\b": "multi-start initialisation",
    r"\bmetal decision\b": "metal classification",
    r"\bmirrored (?:light|directions?)\b": "specular reflection, reflected direction",
    r"\b(?:grey|mirror) balls?\b": "diffuse sphere, chrome sphere",
    r"\btelephones?\b": "phones",
    r"\bcontradicts? one another\b": "are inconsistent",
    r"\bmasks? (?:are|is|were) taken in\b|\btakes? masks in\b": "masks are eroded",
    r"\bmatched points off\b": "epipolar error",
    r"\ba house of\b|\brooms of the package\b": "packages, layers",
}
# Only in texts of the program: labels without their noun, such as "of all random choices"
LABELS = {r"^of (?!the form\b)": "name the thing"}

PAGES = ("README.md", "CONTRIBUTING.md", "docs/")
PROGRAM = ("univoxel/**/*.py", "lab/*.py")


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
            found += [f"{name}:{line}: {what}" for what in slips(text, MARKERS | LABELS)]
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
        for pattern, instead in MARKERS.items():
            for match in re.finditer(pattern, flat, re.IGNORECASE):
                line = start + paragraph.count("\n", 0, match.start())
                found.append((line, _told(match, instead)))
        start += paragraph.count("\n")
    return sorted(found)


def slips(text: str, markers: dict[str, str] = MARKERS) -> list[str]:
    """Phrases of a text that are refused, each with what to write instead."""
    flat = " ".join(re.sub(r"`[^`]*`", "CODE", text).split())
    return [
        _told(match, instead)
        for pattern, instead in markers.items()
        for match in re.finditer(pattern, flat, re.IGNORECASE)
    ]


def texts(source: str) -> Iterator[tuple[int, str]]:
    """Line and text of the strings of a module that people read.

    Those are literals of several words, values of f-strings left out, and docstrings of what is
    public; docstrings of private functions are comments.
    """
    tree = ast.parse(source)
    hidden: set[ast.AST] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.JoinedStr):
            hidden |= set(ast.walk(node)) - {node}
        elif isinstance(node, ast.FunctionDef | ast.ClassDef | ast.Module) and node.body:
            first = node.body[0]
            private = getattr(node, "name", "").startswith("_")
            if isinstance(first, ast.Expr) and (private or not is_public(node)):
                hidden.add(first.value)
    for node in ast.walk(tree):
        if node in hidden:
            continue
        if isinstance(node, ast.JoinedStr):
            parts = [v.value if isinstance(v, ast.Constant) else "X" for v in node.values]
            yield node.lineno, "".join(map(str, parts))
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            if " " in node.value.strip():
                yield node.lineno, node.value


def is_public(node: ast.AST) -> bool:
    """Whether a docstring is shown to users: so far, of commands."""
    return isinstance(node, ast.FunctionDef) and node.name in ("command", "lab", "completion")


def _told(match: re.Match[str], instead: str) -> str:
    return f"{match.group().strip()!r}: write {instead}"
