"""Imports go down the list of CONTRIBUTING.md, never up and never sideways."""

import ast
import re
from pathlib import Path

import pytest
from layers import HELPERS, LAYERS, drawn_layers

from univoxel.commands import COMMANDS

ROOT = Path(__file__).parent.parent

# Extras: imported inside the function that needs one
OPTIONAL = {"dask", "distributed", "drjit", "imageio_ffmpeg", "matplotlib", "mitsuba", "trimesh"}
OPTIONAL |= {"onnxruntime", "pillow_heif", "pycolmap", "rawpy", "rembg", "viser"}
# The one file or folder of csrc/ that includes it; no header of ours passes it on to others.
INCLUDES = {r"embree\d?/": "visibility.cpp", r"pybind11/": "bindings"}


def layer(module: str) -> int:
    """Index of the layer of a module named without the package, such as `ops.composite`."""
    for name in (module, module.partition(".")[0]):
        for i, names in enumerate(LAYERS):
            if name in names:
                return i
    raise AssertionError(f"univoxel.{module} stands in no layer: add it to tests/layers.py")


def modules(package: Path) -> dict[str, Path]:
    """Modules by dotted name without the package; a folder goes by its own name."""
    found = {}
    for path in package.rglob("*.py"):
        parts = path.relative_to(package).with_suffix("").parts
        found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


def imports(path: Path, known: set[str]) -> set[str]:
    """What a file imports, anywhere in it: absolute names, modules of ours without the package."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert not node.level, f"{path}: imports are absolute"
            parent = node.module or ""
            for alias in node.names:
                inner = f"{parent}.{alias.name}".removeprefix("univoxel.")
                is_module = inner in known or inner == "_core"
                names.add(f"univoxel.{inner}" if is_module else parent)
    return names


def violations(package: Path) -> list[str]:
    found = []
    known = modules(package)
    for module, path in known.items():
        if not module:
            continue
        folder = module.rpartition(".")[0]
        for name in sorted(imports(path, set(known))):
            if name.endswith("._core"):
                found.append(f"{module} imports {name}: only ops/native.py loads it")
                continue
            if not name.startswith("univoxel."):
                continue
            target = name.removeprefix("univoxel.")
            other, _, other_leaf = target.rpartition(".")
            if layer(target) < layer(module):
                continue
            own_folder = module == other and module in HELPERS  # a folder's __init__ gathers it
            helper = folder and folder == other and other_leaf in HELPERS.get(folder, ())
            if not own_folder and not helper:
                found.append(f"{module} imports {target}: {_direction(module, target)}")
    return found


def _direction(module: str, target: str) -> str:
    return "up" if layer(target) > layer(module) else "sideways"


def test_imports_only_go_down():
    assert violations(ROOT / "univoxel") == []


@pytest.mark.parametrize(
    ("file", "line", "fault"),
    [
        ("ops/march.py", "from univoxel.fields.dense import DenseField", "up"),
        ("ops/march.py", "def f():\n    import univoxel.scene", "up"),
        ("ops/march.py", "from univoxel.ops.smooth import smooth_rows_", "sideways"),
        ("ops/march.py", "from univoxel.ops import smooth", "sideways"),
        ("fields/dense.py", "from univoxel.lights import sg", "sideways"),
        ("color.py", "from univoxel.camera import Cameras", "sideways"),
        ("fields/dense.py", "import univoxel._core", "only ops"),
        ("fields/dense.py", "from univoxel import _core", "only ops"),
    ],
)
def test_a_wrong_import_is_found(tmp_path, file, line, fault):
    names = ["scene", "color", "camera", "ops.composite", "ops.march", "fields.dense", "lights.sg"]
    for name in names:
        path = tmp_path / (name.replace(".", "/") + ".py")
        path.parent.mkdir(exist_ok=True)
        (path.parent / "__init__.py").touch()
        path.touch()
    assert violations(tmp_path) == []
    (tmp_path / file).write_text(line)
    assert any(fault in v for v in violations(tmp_path))


def test_an_unknown_module_is_found(tmp_path):
    (tmp_path / "stray.py").write_text("import univoxel.records")
    with pytest.raises(AssertionError, match="stray stands in no layer"):
        violations(tmp_path)


def test_extras_are_not_imported_at_the_top():
    for path in (ROOT / "univoxel").rglob("*.py"):
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
    shown = [", ".join(sorted(names)) for names in drawn_layers()]
    assert [row for row in rows if row in shown] == shown


def test_tasks_are_commands():
    names = {path.stem for path in (ROOT / "univoxel" / "tasks").glob("*.py")} - {"__init__"}
    commands = {"poses", "cutout", "train", "eval", "relight", "export", "envmap", "inspect"}
    commands |= {"batch", "capture", "info", "submit", "demo", "doctor", "view", "report"}
    assert names - {"evaluate"} | {"eval"} == commands <= set(COMMANDS)
