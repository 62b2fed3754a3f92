"""Imports go down the list of CONTRIBUTING.md, and never in a circle."""

import ast
import re
from pathlib import Path

import house
import pytest
from layers import LAB_LAYERS, LAYERS, violations

from univoxel.cli import COMMANDS

ROOT = Path(__file__).parent.parent

LAB = ("lab/*.py", "lab/stress/*.py", "lab/bank/*.py")
SOURCES = [path for pattern in ("univoxel/**/*.py", *LAB) for path in ROOT.glob(pattern)]

# Extras: imported inside the function that needs one
OPTIONAL = {"dask", "distributed", "drjit", "imageio_ffmpeg", "matplotlib", "mitsuba", "trimesh"}
OPTIONAL |= {"onnxruntime", "pillow_heif", "pycolmap", "rawpy", "rembg", "viser"}
# The one file or folder of csrc/ that includes it; no header of ours passes it on to others.
INCLUDES = {r"embree\d?/": "visibility.cpp", r"pybind11/": "bindings"}


def test_imports_only_go_down():
    assert violations(ROOT / "univoxel") == []
    assert violations(ROOT / "lab", "lab", LAB_LAYERS) == []


@pytest.mark.parametrize(
    ("file", "line", "fault"),
    [
        ("ops/march.py", "from univoxel.fields.dense import DenseField", "up"),
        ("ops/march.py", "def f():\n    import univoxel.scene", "up"),
        ("ops/march.py", "from univoxel.ops import composite", "a circle"),
        ("fields/dense.py", "from univoxel.lights import sg", "sideways"),
        ("fields/dense.py", "import univoxel._core", "only ops"),
        ("fields/dense.py", "from univoxel import _core", "only ops"),
        ("fields/dense.py", "from lab.record import Outcome", "a wheel has none"),
    ],
)
def test_a_wrong_import_is_found(tmp_path, file, line, fault):
    names = ["scene", "color", "camera", "ops.composite", "ops.march", "fields.dense", "lights.sg"]
    for name in names:
        path = tmp_path / (name.replace(".", "/") + ".py")
        path.parent.mkdir(exist_ok=True)
        (path.parent / "__init__.py").touch()
        path.touch()
    (tmp_path / "ops/composite.py").write_text("from univoxel.ops.march import march")
    assert violations(tmp_path) == []
    (tmp_path / file).write_text(line)
    assert any(fault in v for v in violations(tmp_path))


def test_an_unknown_module_is_found(tmp_path):
    (tmp_path / "stray.py").write_text("import univoxel.scene")
    with pytest.raises(AssertionError, match="stray stands in no layer"):
        violations(tmp_path)


def test_extras_are_not_imported_at_the_top():
    for path in SOURCES:
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            assert not OPTIONAL & {n.partition(".")[0] for n in names}, path


@pytest.mark.parametrize("library", INCLUDES)
def test_one_place_includes(library):
    pattern = re.compile(rf"^\s*#\s*include\s*[<\"]{library}", re.MULTILINE)
    sources = [p for p in (ROOT / "csrc").rglob("*") if p.is_file()]
    users = {p for p in sources if pattern.search(p.read_text("utf-8"))}
    assert {p.relative_to(ROOT / "csrc").parts[0] for p in users} == {INCLUDES[library]}


def test_the_diagram_shows_the_layers():
    picture = (ROOT / "docs/images/layers.svg").read_text("utf-8")
    rows = re.findall(r"<text [^>]*>([^<]*)</text>", picture)
    shown = [", ".join(sorted(names)) for names in LAYERS]
    assert [row for row in rows if row in shown] == shown


def test_a_command_is_one_file():
    names = {path.stem for path in (ROOT / "univoxel" / "cli").glob("*.py")}
    names -= {"__init__", "__main__", "parsing", "trainer"}
    commands = {"poses", "cutout", "train", "eval", "relight", "export", "envmap", "inspect"}
    commands |= {"batch", "capture", "info", "demo", "doctor", "view", "report"}
    assert names - {"evaluate"} | {"eval"} == commands == set(COMMANDS) - {"completion"}


def test_a_house_that_grows_is_told(monkeypatch, capsys):
    found = house.figures()
    monkeypatch.setattr(house, "figures", lambda: found)
    assert house.main() == 0
    assert "TOO MANY" not in capsys.readouterr().out
    monkeypatch.setitem(house.LIMITS, "layers", 1)
    assert house.main() == 1
    assert capsys.readouterr().out.count("TOO MANY") == 1
