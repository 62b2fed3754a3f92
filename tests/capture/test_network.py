"""Masks of a network: of a made one, of rembg's interface, and of the real one where it lies."""

import os
import sys
import types
from pathlib import Path
from typing import get_args
from unittest.mock import Mock

import numpy as np
import pytest
import torch

from univoxel.capture import masks as module
from univoxel.core.choices import NetworkName
from univoxel.errors import DataError, MissingExtra, UserError


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
        assert picture.shape in {(1, 3, n.side, n.side) for n in module.NETWORKS.values()}
        assert picture.dtype == np.float32
        return [np.where(picture[:, :1] > 0.05, 5, -5).astype(np.float32)]


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


@pytest.mark.parametrize("name", get_args(NetworkName))
def test_weights_that_are_there(home, onnxruntime, name):
    (home / f"{name}.onnx").write_bytes(b"weights")
    mask = module.mask_network(name)(photograph())
    assert mask.shape == (30, 40)
    assert 0 <= float(mask.min()) <= float(mask.max()) <= 1
    assert ((mask > 0.5) == (photograph()[..., 0] > 0)).all()


def test_without_a_network_one_line_says_how_to_get_one(home, onnxruntime, monkeypatch):
    with pytest.raises(MissingExtra, match=r"pip install 'univoxel\[masks\]'.*u2netp\.onnx"):
        module.mask_network()
    (home / "u2netp.onnx").write_bytes(b"web page")
    said = r"u2netp\.onnx: this network could not be read.*no protobuf"
    with pytest.raises(DataError, match=said):
        module.mask_network()
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    (home / "u2netp.onnx").write_bytes(b"weights")
    with pytest.raises(MissingExtra, match=r"pip install 'univoxel\[masks\]'"):
        module.mask_network()
    with pytest.raises(UserError, match=r"expected one of u2netp, .*birefnet-general, got u2"):
        module.mask_network("u2")
    assert list(module.NETWORKS) == list(get_args(NetworkName))


def test_networks_see_what_they_were_trained_on():
    """As rembg has it: colours, and whether answers are logits."""
    seen = []

    class Session(FakeSession):
        def __init__(self):
            pass

        def run(self, _, values):
            seen.append(values["picture"][0, :, 0, 0])
            found = np.zeros((1, 1, *values["picture"].shape[2:]), np.float32)
            found[..., : found.shape[-1] // 2] = 2
            found[..., 0, 0], found[..., -1, -1] = 9, -9
            return [found]

    white = torch.full((20, 20, 3), 255, dtype=torch.uint8)
    for name, red, left in (
        ("u2net", (1 - 0.485) / 0.229, 11 / 18),
        ("isnet-general-use", 0.5, 11 / 18),
        ("birefnet-general", (1 - 0.485) / 0.229, 1 / (1 + np.exp(-2))),
    ):
        mask = module._prediction(module.NETWORKS[name], Session(), white)
        assert seen.pop()[0] == pytest.approx(red)
        assert float(mask[10, 5]) == pytest.approx(left, abs=1e-3)


def test_the_time_is_told_once_it_is_measured(monkeypatch, caplog):
    caplog.set_level("INFO", "univoxel")
    clock = iter([0.0, 5.1, 6.0, 7.0])
    monkeypatch.setattr(module, "monotonic", lambda: next(clock))
    masked = module.timed(lambda photo: photo[..., 0] / 255, "isnet-general-use", 60)
    assert caplog.messages == ["masks: using the network isnet-general-use (179 MB)"]
    for _ in range(2):
        assert torch.equal(masked(photograph()), photograph()[..., 0] / 255)
    told = "masks: 5.1 s per photograph, about 5 min for all 60 photographs"
    assert caplog.messages[1:] == [told]


def test_rembg_goes_first(home, monkeypatch, caplog):
    caplog.set_level("INFO", "univoxel")
    made = types.ModuleType("rembg")
    made.new_session = lambda name: types.SimpleNamespace(
        predict=lambda picture: [picture.getchannel("R" if name == "u2netp" else "G")]
    )
    monkeypatch.setitem(sys.modules, "rembg", made)
    mask = module.mask_network()(photograph())
    torch.testing.assert_close(mask, photograph()[..., 0].float() / 255)
    assert caplog.messages == ["u2netp: downloading the weights (4.7 MB, only once)"]
    (home / "u2net.onnx").touch()
    assert not module.mask_network("u2net")(photograph()).any()
    assert len(caplog.messages) == 1

    made.new_session = Mock(side_effect=ConnectionError("no network"))
    with pytest.raises(DataError, match=r"could not download the weights of u2netp: no network"):
        module.mask_network()


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
    found = module.mask_network()(picture) > 0.5
    assert float((found & true).sum() / (found | true).sum()) > 0.9
