"""What is known of the extension, and the one warning where it does not serve."""

import logging

import pytest
import torch
from torch._subclasses.fake_tensor import FakeTensor, FakeTensorMode

from univoxel.ops import adam_rows_, composite, native, native_status, use_backend


@pytest.fixture(autouse=True)
def untold(monkeypatch):
    monkeypatch.setattr(native, "_told", set())


def warned(caplog) -> list[str]:
    return [r.getMessage() for r in caplog.records if r.levelno == logging.WARNING]


def call(dtype=torch.float32):
    return composite(torch.rand(4, dtype=dtype), torch.rand(4, 3, dtype=dtype), OFFSETS)[0]


OFFSETS = torch.tensor([0, 4])


def test_status_of_the_build_that_serves():
    status = native_status()
    assert status.loaded == (native.core is not None)
    if status.loaded:
        assert status.variant in status.built
        assert status.variant in status.usable
        assert status.reason is None
    else:
        assert status.reason
        assert status.variant is None


def test_a_missing_extension_is_told_once(monkeypatch, caplog):
    monkeypatch.setattr(native, "core", None)
    monkeypatch.setattr(native, "variant", "no extension built")
    call()
    call()
    assert warned(caplog) == [
        "univoxel.ops uses eager PyTorch, which is many times slower: the compiled extension is "
        "not loaded: no extension built"
    ]


def test_a_type_without_kernels_is_told_once(caplog):
    for _ in range(2):
        call(torch.bfloat16)
    assert warned(caplog) == [
        "univoxel.ops runs in eager torch, many times slower: kernels take float32 and float64 on "
        "the cpu, got torch.bfloat16 on cpu"
    ]


def test_who_asks_for_the_reference_is_not_warned(caplog):
    with use_backend("reference"):
        call(torch.bfloat16)
    call()
    assert warned(caplog) == []


def test_fakes_and_transforms_go_by_the_registered_op():
    """Neither can be given to the kernel itself, which reads memory."""
    alpha, value = torch.rand(5, requires_grad=True), torch.rand(5, 3)
    offsets = torch.tensor([0, 2, 5])
    with FakeTensorMode() as mode:
        fakes = [mode.from_tensor(t) for t in (alpha, value, offsets)]
        out, weight = composite(*fakes)
    assert isinstance(out, FakeTensor)
    assert (out.shape, weight.shape) == ((2, 3), (5,))
    # torch takes no op of its library through transforms, and says so
    with pytest.raises(RuntimeError, match="functorch transforms"):
        torch.func.grad(lambda a: composite(a, value, offsets)[0].sum())(alpha.detach())


def test_what_a_kernel_writes_is_counted():
    """By torch's count of changes a scene tells that its surface has moved."""
    param, m, v = torch.rand(3, 4, 2).unbind()
    before = param._version
    rates = {"lr": 0.1, "beta1": 0.9, "beta2": 0.99, "eps": 1e-8, "step": 1}
    adam_rows_(param, m, v, torch.tensor([1]), torch.rand(1, 2), **rates)
    assert param._version > before
