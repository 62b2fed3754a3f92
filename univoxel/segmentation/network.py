"""Masks from a network that was trained to find what stands out in single photographs."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from univoxel.errors import DataError, MissingExtra

NETWORK = "u2netp"  # U^2-Net, small (Qin et al. 2020): a second a photograph on one core
SIDE = 320  # pixels of the pictures that it sees
# Of the pictures that it was trained on
MEAN = np.array([0.485, 0.456, 0.406], np.float32)
SPREAD = np.array([0.229, 0.224, 0.225], np.float32)


def network() -> Callable[[Tensor], Tensor]:
    """What makes a mask [H, W] in [0, 1] of a photograph [H, W, 3] uint8, sRGB.

    rembg runs the network, and fetches its weights once. Without rembg, onnxruntime runs weights
    that are there: u2netp.onnx in $U2NET_HOME, or in ~/.u2net.

    Raises:
        DataError: rembg could not fetch the weights.
        MissingExtra: neither is installed, or onnxruntime has no weights.
    """
    weights = Path(os.environ.get("U2NET_HOME") or Path.home() / ".u2net") / f"{NETWORK}.onnx"
    try:
        import rembg  # pyright: ignore[reportMissingImports]  the extra `masks`
    except (ImportError, SystemExit):  # it ends Python where onnxruntime is missing
        return _by_onnxruntime(weights)
    try:
        session = rembg.new_session(NETWORK)
    except OSError as error:  # requests' errors are some
        raise DataError(f"{weights}: expected weights of {NETWORK}; fetching: {error}") from None

    def masked(photograph: Tensor) -> Tensor:
        mask = session.predict(Image.fromarray(photograph.numpy()))[0]
        return torch.from_numpy(np.asarray(mask, np.float32) / 255)

    return masked


def _by_onnxruntime(weights: Path) -> Callable[[Tensor], Tensor]:
    try:
        import onnxruntime  # pyright: ignore[reportMissingImports]  the extra `masks`
    except ImportError:
        onnxruntime = None
    if onnxruntime is None or not weights.is_file():
        raise MissingExtra(
            "masks from a network need rembg: pip install 'univoxel[masks]'; or onnxruntime, and "
            f"the network's weights as {weights}; or masks of your own: cutout --from FOLDER, "
            "capture --masks FOLDER"
        )
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = torch.get_num_threads()
    try:
        session = onnxruntime.InferenceSession(str(weights), options, ["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime's own have no common root but this
        raise DataError(f"{weights}: expected a network, could not read it: {error}") from None
    return lambda photograph: _prediction(session, photograph)


def _prediction(session: Any, photograph: Tensor) -> Tensor:
    """A mask [H, W] in [0, 1] of a photograph [H, W, 3] uint8."""
    small = Image.fromarray(photograph.numpy()).resize((SIDE, SIDE), Image.Resampling.LANCZOS)
    values = np.asarray(small, np.float32)
    values = (values / max(values.max(), 1) - MEAN) / SPREAD
    name = session.get_inputs()[0].name
    found = session.run(None, {name: values.transpose(2, 0, 1)[None]})[0][0, 0]
    found = (found - found.min()) / max(found.max() - found.min(), 1e-6)
    height, width = photograph.shape[:2]
    mask = Image.fromarray(found).resize((width, height), Image.Resampling.BICUBIC)
    return torch.from_numpy(np.asarray(mask).clip(0, 1))
