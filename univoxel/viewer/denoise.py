"""Noise taken out of a path traced picture by Intel's Open Image Denoise, where it is installed."""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor
from importlib.util import find_spec

import numpy as np
import torch
from torch import Tensor

# It takes about a second of all cores, without holding Python's lock: a view that moves meanwhile
# is answered as ever.
_BESIDE = ThreadPoolExecutor(1, "univoxel denoiser")


def available() -> bool:
    """Whether the extra `denoise` is installed."""
    return find_spec("pyoidn") is not None


def denoised_beside(
    rgb: Tensor, albedo: Tensor, normal: Tensor, shadow: Tensor | None
) -> Future[tuple[Tensor, Tensor | None]]:
    """`denoised` in a thread of its own, of the values as they are now."""
    copies = (rgb.clone(), albedo.clone(), normal.clone())
    return _BESIDE.submit(denoised, *copies, None if shadow is None else shadow.clone())


def denoised(
    rgb: Tensor, albedo: Tensor, normal: Tensor, shadow: Tensor | None
) -> tuple[Tensor, Tensor | None]:
    """Radiance without its noise, and a floor's shadow likewise.

    Args:
        rgb: [H, W, 3] linear.
        albedo, normal: [H, W, 3], free of noise, 0 where there is no surface.
        shadow: [H, W] in [0, 1].
    """
    import pyoidn  # pyright: ignore[reportMissingImports]  the extra `denoise`

    def array(values: Tensor) -> np.ndarray:
        return np.ascontiguousarray(values.numpy(), np.float32)

    aside = {"albedo": array(albedo), "normal": array(normal)}
    light = torch.from_numpy(pyoidn.denoise(array(rgb), **aside, hdr=True)).clamp_min(0)
    if shadow is None:
        return light, None
    grey = pyoidn.denoise(array(shadow[..., None].expand(-1, -1, 3)))
    return light, torch.from_numpy(grey)[..., 0].clamp(0, 1)
