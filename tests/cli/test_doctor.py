"""What `univoxel doctor` finds, with and without parts of the extension."""

import dataclasses
import json
import subprocess
import sys
from types import SimpleNamespace

import pytest
import torch

import univoxel
from univoxel.cli import doctor, main
from univoxel.core import machine
from univoxel.errors import MissingNative
from univoxel.ops import native, native_status, use_backend
from univoxel.presets import preset

GIB = 1 << 30
GOOD = native.NativeStatus(True, "avx2", None, ("avx2", "default"), ("default", "avx2"), 4)


@pytest.fixture
def without_embree(monkeypatch):
    monkeypatch.setattr(native, "core", SimpleNamespace(embree_version=lambda: 0))


def by_name(findings):
    return {f.what: f for f in findings}


def test_everything_is_there(tmp_path):
    """In a process of its own: other tests load libraries with an OpenMP runtime of theirs."""
    command = [sys.executable, "-m", "univoxel.cli", "doctor", "--json", tmp_path / "found.json"]
    said = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    found = {f["what"]: f for f in json.loads((tmp_path / "found.json").read_text())}
    assert found["torch"]["found"].startswith(torch.__version__)
    assert found["univoxel"]["found"].startswith(univoxel.__version__)
    assert {"processor", "kernels", "Embree", "OpenMP", "threads", "memory"} <= set(found)
    assert all(f["what"] in said for f in found.values())
    assert all(f["remedy"] for f in found.values() if f["state"] != "good")
    assert found["OpenMP"]["found"].count(".so") == 1 or "darwin" in found["Python"]["found"]


def test_a_build_without_embree(without_embree, capsys):
    assert native_status().embree is None
    found = by_name(doctor.look())
    assert found["Embree"].state == "bad"
    assert "pip install" in found["Embree"].remedy
    assert main(["doctor"]) == 2
    said = capsys.readouterr()
    assert "-> rebuild univoxel with a compiler" in " ".join(said.out.split())
    assert said.err.startswith("univoxel doctor: this installation cannot train: Embree: missing")


def test_no_build_at_all(monkeypatch):
    monkeypatch.setattr(native, "core", None)
    monkeypatch.setattr(native, "variant", "no compiled extension in /here")
    status = native_status()
    assert (status.loaded, status.variant, status.embree) == (False, None, None)
    assert status.reason == "no compiled extension in /here"
    finding = doctor.kernels(status)
    assert (finding.state, finding.found) == ("bad", "not loaded: no compiled extension in /here")
    with pytest.raises(MissingNative, match=r"kernels: not loaded: .* Embree: missing"):
        doctor.check([finding, doctor.embree(status)])


def test_extras_and_what_is_missing_of_them(monkeypatch):
    requirements = [
        "torch>=2.4",
        'pytest>=8; extra == "dev"',
        'numpy>=1; extra == "sums"',
        "no-such-package[all]>=3 ; python_version > '3' and extra == 'many'",
        "neither_this (>=1) ; extra == 'many'",
    ]
    assert doctor.extras("no-such-distribution") is None
    monkeypatch.setattr(doctor.metadata, "requires", lambda name: requirements)
    assert doctor.extras() == {"many": ["no-such-package", "neither_this"], "sums": []}


@pytest.mark.parametrize(
    ("cuda", "hip", "said"),
    [(None, None, "CPUs"), ("12.1", None, "CUDA 12.1"), (None, "6.0", "ROCm 6.0")],
)
def test_what_torch_was_built_for(monkeypatch, cuda, hip, said):
    monkeypatch.setattr(torch.version, "cuda", cuda)
    monkeypatch.setattr(torch.version, "hip", hip)
    assert doctor.torch_build() == f"{torch.__version__}, built for {said}"


def test_findings_that_ask_for_a_look(capsys):
    for arguments in (["--version", "--verbose"], ["--verbose", "--version"]):
        assert main(arguments) == 0
        assert "Embree" in capsys.readouterr().out
    assert doctor.kernels(GOOD).state == doctor.embree(GOOD).state == "good"
    slow = dataclasses.replace(GOOD, usable=("default", "avx2", "avx512"))
    assert doctor.kernels(slow).state == "look"
    assert "avx512" in doctor.kernels(slow).remedy
    assert doctor.openmp(["/a/libgomp.so.1"]).state == "good"
    assert doctor.openmp(["/a/libgomp.so.1", "/b/libiomp5.so"]).state == "look"
    assert doctor.memory(machine.Memory(8 * GIB, 7 * GIB)).state == "good"
    assert doctor.memory(machine.Memory(8 * GIB, GIB)).remedy
    assert doctor.memory(machine.Memory(8 * GIB, None)).found == "8.0 GiB"
    assert doctor.memory(None).found == "unknown"


def test_threads_against_cores(monkeypatch):
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    assert doctor.threads(2, 2.0) == doctor.Finding("threads", "2 on 2 cores")
    assert doctor.threads(1, 0.5).state == "good"  # fewer than one thread cannot be
    assert "OMP_NUM_THREADS=1" in doctor.threads(8, 1.5).remedy
    monkeypatch.setenv("OMP_NUM_THREADS", "8")
    assert doctor.threads(8, 8.0).found == "8 on 8 cores, OMP_NUM_THREADS=8"


def test_training_is_refused_before_a_photograph_is_read(without_embree, tmp_path):
    config = preset("draft", data=tmp_path / "nothing", out=tmp_path / "out")
    with pytest.raises(MissingNative, match=r"^train needs Embree for ray tracing"):
        univoxel.train(config)
    assert not config.out.exists()
    with (
        use_backend("reference"),
        pytest.raises(ValueError, match="nothing: expected a folder with a scene"),
    ):
        univoxel.train(config)
