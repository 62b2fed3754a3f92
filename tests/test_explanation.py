"""Names that the pages of docs/explanation and docs/guide take from the code are there."""

import ast
import re
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PAGES = sorted([*(ROOT / "docs/guide").glob("*.md"), *(ROOT / "docs/explanation").glob("*.md")])
SOURCES = list((ROOT / "univoxel").rglob("*.py"))
CODE = re.compile(r"```[\s\S]*?```|`[^`\n]+`|^    .*$", re.MULTILINE)
FIELD = re.compile(r"\b([A-Z]\w*Config)\.(\w+)")
CONSTANT = re.compile(r"(?<![\w/.-])[A-Z][A-Z_]{3,}(?![\w/.-])")
FILE = re.compile(r"(?<![\w./])(?:univoxel/)?((?:\w+/)*\w+\.(?:py|cpp))\b")
# Placeholders of commands, and names that are not ours
WORDS = {
    "ADDRESS",
    "ANGLE",
    "AZIMUTH",
    "DATA",
    "ELEVATION",
    "FILE",
    "HEIGHT",
    "INTENSITY",
    "IRRADIANCE",
}
WORDS |= {
    "COLMAP",
    "NAME",
    "PIXELS",
    "SHARE",
    "DEGREES",
    "FACTOR",
    "TEXELS",
    "OPENCV",
    "EPYC",
    "OMP_NUM_THREADS",
    "QT_QPA_PLATFORM",
}


@cache
def classes() -> dict[str, set[str]]:
    """Fields by the names of configurations."""
    found = {}
    for path in SOURCES:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ClassDef) and node.name.endswith("Config"):
                body = [n for n in node.body if isinstance(n, ast.AnnAssign)]
                found[node.name] = {n.target.id for n in body if isinstance(n.target, ast.Name)}
    return found


@cache
def constants() -> set[str]:
    """Names that are assigned at the top of a module or a class."""
    found = set()
    for path in SOURCES:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
                found.add(node.id)
    return found


def unknown(text: str) -> list[str]:
    """Configurations' fields, constants and files in the code of a page that are not there."""
    code = "\n".join(m.group() for m in CODE.finditer(text))
    fields, known = classes(), constants() | WORDS
    faults = [f"{c}.{f}" for c, f in FIELD.findall(code) if f not in fields.get(c, ())]
    faults += [c for c in CONSTANT.findall(code) if c not in known]
    folders = (ROOT, ROOT / "univoxel", ROOT / "docs")
    return faults + [f for f in FILE.findall(code) if not any((d / f).exists() for d in folders)]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_names_of_the_code_are_there(page):
    assert unknown(page.read_text(encoding="utf-8")) == []


@pytest.mark.parametrize(
    "code", ["`StageConfig.nothing`", "`NothingConfig.rays`", "`NO_SUCH_ONE`", "`joint/none.py`"]
)
def test_a_wrong_name_is_found(code):
    assert unknown(f"A page with {code}.") == [code.strip("`")]


def test_right_names_are_none():
    text = "`StageConfig.rays`, `FRAMES_PER_SECOND` of `pictures/timelapse.py`, `--out RUN`"
    assert unknown(text) == []
