"""The layers of the package and of the laboratory as data, and imports that break them.

test_layers.py and scripts/house.py hold every import to them; docs/figures/diagrams.py draws those
of the package.
"""

import ast
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

# From the bottom up. A folder or file imports only from layers below its own; inside a folder
# anything goes that is no circle.
LAYERS = [
    {"core", "brdf", "camera", "color", "errors", "sphere"},
    {"ops", "optim"},
    {"data", "envmap", "fields", "lights"},
    {"run", "scene"},
    {"config", "presets", "render"},
    {"preparation"},
    {"capture", "evaluation", "training"},
    {"output"},
    {"batch", "detail", "viewer"},
    {"api", "cli"},
]

# Of lab/, which imports from the package what it likes, and which the package does not import
LAB_LAYERS = [
    {"plots", "record"},
    {"worker"},
    {"runner"},
    {"chart", "compare", "stress", "submit"},
    {"bank", "published"},
    {"commands"},
]


def layer(module: str, layers: list[set[str]]) -> int:
    """Index of the layer of a module named without the package, such as `ops.composite`."""
    for name in (module, module.partition(".")[0]):
        for i, names in enumerate(layers):
            if name in names:
                return i
    raise AssertionError(f"{module} stands in no layer: add it to tests/layers.py")


def modules(package: Path) -> dict[str, Path]:
    """Modules by dotted name without the package; a folder goes by its own name."""
    found = {}
    for path in package.rglob("*.py"):
        parts = path.relative_to(package).with_suffix("").parts
        found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


def imports(path: Path, package: str, known: set[str]) -> set[str]:
    """What a file of a package imports, anywhere in it, as absolute names.

    Args:
        known: modules of the package, without its name.
    """
    names = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert not node.level, f"{path}: imports are absolute"
            parent = node.module or ""
            for alias in node.names:
                inner = f"{parent}.{alias.name}".removeprefix(f"{package}.")
                is_module = parent.partition(".")[0] == package and inner in {*known, "_core"}
                names.add(f"{package}.{inner}" if is_module else parent)
    return names


def violations(
    folder: Path, package: str = "univoxel", layers: list[set[str]] = LAYERS
) -> list[str]:
    """A line for each import of a package that its layers do not have, and for a circle."""
    found, known = [], modules(folder)
    wanted: dict[str, set[str]] = {}
    for module, path in known.items():
        if not module or module.startswith("tests"):
            continue
        unit, wanted[module] = module.partition(".")[0], set()
        for name in sorted(imports(path, package, set(known))):
            if name.endswith("._core"):
                found.append(f"{module} imports {name}: only ops/native.py loads it")
                continue
            if package == "univoxel" and name.partition(".")[0] == "lab":
                found.append(f"{module} imports {name}: a wheel has none")
            if not name.startswith(f"{package}."):
                continue
            target = name.removeprefix(f"{package}.")
            wanted[module].add(target)
            if target.partition(".")[0] == unit:
                continue
            own, theirs = layer(module, layers), layer(target, layers)
            if theirs > own:
                found.append(f"{module} imports {target}: up")
            elif (
                theirs == own
                and (folder / unit).is_dir()
                and (folder / target.split(".")[0]).is_dir()
            ):
                found.append(f"{module} imports {target}: sideways")
    try:
        TopologicalSorter(wanted).prepare()
    except CycleError as circle:
        found.append(f"a circle: {' -> '.join(circle.args[1])}")
    return found
