"""Extras and runtimes, as the installed packages tell."""

import pytest
import torch

from univoxel.cli import doctor


def test_extras_and_what_is_missing_of_them(monkeypatch):
    requirements = [
        "torch>=2.4",
        'pytest>=8; extra == "dev"',
        'numpy>=1; extra == "sums"',
        "no-such-package[all]>=3 ; python_version > '3' and extra == 'many'",
        "neither_this (>=1) ; extra == 'many'",
    ]
    monkeypatch.setattr(doctor.metadata, "requires", lambda name: requirements)
    assert doctor.extras() == {"many": ["no-such-package", "neither_this"], "sums": []}


def test_extras_of_what_is_not_installed():
    assert doctor.extras("no-such-distribution") is None


@pytest.mark.parametrize(
    ("cuda", "hip", "said"),
    [(None, None, "CPUs"), ("12.1", None, "CUDA 12.1"), (None, "6.0", "ROCm 6.0")],
)
def test_what_torch_was_built_for(monkeypatch, cuda, hip, said):
    monkeypatch.setattr(torch.version, "cuda", cuda)
    monkeypatch.setattr(torch.version, "hip", hip)
    assert doctor.torch_build() == f"{torch.__version__}, built for {said}"
