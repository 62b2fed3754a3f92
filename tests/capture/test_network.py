"""Masks of a network: of a made one, of rembg's interface, and of the real one where it lies."""

import os
import sys
import types
from pathlib import Path

import numpy as np
import pytest
import torch

from univoxel.capture import masks as module
from univoxel.errors import DataError, MissingExtra


@pytest.fixture
def home(tmp_path, monkeypatch):
    monkeypatch.setenv("U2NET_HOME", str(tmp_path))
    monkeypatch.setitem(sys.modules, "rembg", None)  # as if it were not installed
    return tmp_path


class FakeSession:
    """Red is the object."""

    def __init__(self, weights, *_):
        if Path(weights).read_bytes() != b"weights":
            raise RuntimeError("no protobuf")

    def get_inputs(self):
        return [types.SimpleNamespace(name="picture")]

    def run(self, _, values):
        picture = values["picture"]
        assert picture.shape == (1, 3, module.SIDE, module.SIDE)
        assert picture.dtype == np.float32
        return [3 * picture[:, :1] - 7]


@pytest.fixture
def onnxruntime(monkeypatch):
    made = types.ModuleType("onnxruntime")
    made.SessionOptions = types.SimpleNamespace
    made.InferenceSession = FakeSession
    monkeypatch.setitem(sys.modules, "onnxruntime", made)


def photograph():
    picture = torch.zeros(30, 40, 3, dtype=torch.uint8)
    picture[10:20, 5:15, 0] = 255
    return picture


def test_weights_that_are_there(home, onnxruntime):
    (home / "u2netp.onnx").write_bytes(b"weights")
    mask = module.network()(photograph())
    assert mask.shape == (30, 40)
    assert 0 <= float(mask.min()) <= float(mask.max()) <= 1
    assert ((mask > 0.5) == (photograph()[..., 0] > 0)).all()


def test_weights_that_are_none(home, onnxruntime):
    (home / "u2netp.onnx").write_bytes(b"web page")
    with pytest.raises(DataError, match=r"u2netp\.onnx: expected a network, .*no protobuf"):
        module.network()


def test_without_a_network_one_line_says_how_to_get_one(home, onnxruntime, monkeypatch):
    with pytest.raises(MissingExtra, match=r"pip install 'univoxel\[masks\]'.*u2netp\.onnx"):
        module.network()
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    (home / "u2netp.onnx").write_bytes(b"weights")
    with pytest.raises(MissingExtra, match=r"pip install 'univoxel\[masks\]'"):
        module.network()


def test_rembg_goes_first(home, monkeypatch):
    made = types.ModuleType("rembg")
    made.new_session = lambda name: types.SimpleNamespace(
        predict=lambda picture: [picture.getchannel("R")] if name == "u2netp" else []
    )
    monkeypatch.setitem(sys.modules, "rembg", made)
    mask = module.network()(photograph())
    torch.testing.assert_close(mask, photograph()[..., 0].float() / 255)

    def offline(_):
        raise ConnectionError("no network")

    made.new_session = offline
    with pytest.raises(DataError, match=r"expected weights of u2netp; fetching: no network"):
        module.network()


WEIGHTS = Path(os.environ.get("U2NET_HOME") or Path.home() / ".u2net") / "u2netp.onnx"


@pytest.mark.skipif(not WEIGHTS.is_file(), reason="weights of u2netp: make network-test")
def test_the_real_network_finds_what_stands_out(monkeypatch):
    site = os.environ.get("NETWORK_SITE")
    monkeypatch.setattr(sys, "path", [*sys.path, site] if site else sys.path)
    pytest.importorskip("onnxruntime")
    row, column = torch.meshgrid(torch.arange(240), torch.arange(320), indexing="ij")
    true = (row - 110.0).square() + (column - 170.0).square() < 60**2
    picture = torch.full((240, 320, 3), 225, dtype=torch.uint8)
    picture[true] = torch.tensor([170, 40, 30], dtype=torch.uint8)
    found = module.network()(picture) > 0.5
    assert float((found & true).sum() / (found | true).sum()) > 0.9
