"""The package as built: one OpenMP runtime, every variant loads, imports stay cheap."""

import ctypes
import json
import re
import subprocess
import sys
from pathlib import Path

import pytest
import torch

import univoxel
from univoxel.ops import native

VARIANTS = ["default", "avx2", "avx512"]  # each runs what the ones before it run


def run(code: str) -> str:
    """What Python prints for the code, in a process of its own."""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


def built() -> dict[str, Path]:
    folder = Path(univoxel.__file__).parent / "_core"
    return {p.parent.name: p for p in folder.glob("*/_core.*.so")}


def test_the_extension_is_built_and_the_best_variant_is_loaded():
    usable = torch.backends.cpu.get_cpu_capability().lower()
    best = VARIANTS[: VARIANTS.index(usable) + 1] if usable in VARIANTS else ["default"]
    assert native.core is not None, native.variant
    assert native.variant == next(v for v in reversed(best) if v in built())


def test_one_openmp_runtime():
    """Two would fight over the cores: alternating work then takes a multiple of the time."""
    code = (
        "import json, torch, univoxel.ops, threadpoolctl\n"
        "torch.ones(10**6).exp()\n"
        "print(json.dumps(threadpoolctl.threadpool_info()))"
    )
    runtimes = {p["filepath"] for p in json.loads(run(code)) if p["user_api"] == "openmp"}
    assert len(runtimes) == 1


@pytest.mark.parametrize("variant", VARIANTS)
def test_variant_loads_and_composites(variant):
    if variant not in built():
        pytest.skip(f"{variant} is not built here")
    usable = torch.backends.cpu.get_cpu_capability().lower()
    if VARIANTS.index(variant) > VARIANTS.index(usable):
        pytest.skip(f"this processor has no {variant}")
    code = (
        "import importlib.util, numpy, torch\n"
        f"path = {str(built()[variant])!r}\n"
        "spec = importlib.util.spec_from_file_location('univoxel._core', path)\n"
        "core = importlib.util.module_from_spec(spec)\n"
        "spec.loader.exec_module(core)\n"
        "alpha, value = numpy.array([0.5, 0.5]), numpy.array([[4.0], [8.0]])\n"
        "out, weight = numpy.empty((1, 1)), numpy.empty(2)\n"
        "core.composite_forward(alpha, value, numpy.array([0, 2]), out, weight, 0.0, 1)\n"
        "print(out[0, 0])"
    )
    assert float(run(code)) == 4.0


def test_no_variant_flushes_denormals():
    """-ffast-math at link time would, for the whole process; the kernels must not be built so."""
    for path in built().values():
        ctypes.CDLL(str(path), mode=ctypes.RTLD_LOCAL)
    assert (torch.tensor([1e-310], dtype=torch.float64) * 1.0).item() > 0.0


def test_versions_agree():
    """The recipe for conda has the dependencies and the version of pyproject.toml."""
    root = Path(__file__).parent.parent
    pyproject = (root / "pyproject.toml").read_text()
    assert f'\nversion = "{univoxel.__version__}"\n' in pyproject
    assert f"## [{univoxel.__version__}]" in (root / "CHANGELOG.md").read_text()
    needed = pyproject.partition("dependencies = [")[2].partition("\n]")[0]
    named = {
        f"{name} >={version}".lower()
        for name, version in re.findall(r'^    "([\w-]+)>=([\d.]+)', needed, re.MULTILINE)
    }
    other = {"torch": "pytorch", "openexr": "openexr-python"}
    named = {" ".join([other.get(one.split()[0], one.split()[0]), one.split()[1]]) for one in named}
    recipe = (root / "conda/meta.yaml").read_text()
    run = recipe.partition("  run:")[2].partition("\ntest:")[0]
    assert set(re.findall(r"- ([\w-]+ >=[\d.]+)", run)) == named
    assert f'set version = "{univoxel.__version__}"' in recipe


def test_imports_are_cheap():
    loaded = run("import sys, univoxel; print(*sys.modules)").split()
    assert not {"torch", "matplotlib", "scipy", "skimage", "tyro"} & set(loaded)
    loaded = run("import sys, univoxel.ops; print(*sys.modules)").split()
    assert not {"matplotlib", "trimesh", "viser", "skimage"} & set(loaded)


def test_the_bundled_scene_is_complete():
    """What `univoxel demo` reads lies inside the package, with its licences."""
    folder = Path(univoxel.__file__).parent / "example_data"
    assert "Redistribution and use" in (folder / "ATTRIBUTION.md").read_text()
    for split, views in (("train", 40), ("test", 5)):
        frames = json.loads((folder / "tiny" / f"transforms_{split}.json").read_text())["frames"]
        assert len(frames) == views
        assert all((folder / "tiny" / f"{f['file_path']}.png").exists() for f in frames)


def test_the_first_call_of_an_op_imports_no_compiler():
    """That takes a second and 70 MB, of every command."""
    code = (
        "import sys, torch\n"
        "from univoxel.ops import composite\n"
        "alpha = torch.rand(4, requires_grad=True)\n"
        "out, _ = composite(alpha, torch.rand(4, 3), torch.tensor([0, 4]))\n"
        "out.sum().backward()\n"
        "print('torch._dynamo' in sys.modules, alpha.grad.norm() > 0)"
    )
    assert run(code) == "False tensor(True)\n"
