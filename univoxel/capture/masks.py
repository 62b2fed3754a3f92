"""Masks of many photographs from a network, and which of them contradict the object."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from time import monotonic
from typing import Any

import numpy as np
import torch
from PIL import Image
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate, max_pool2d

from univoxel.camera import Cameras, project
from univoxel.core import log
from univoxel.core.choices import NETWORK, NetworkName
from univoxel.core.progress_bar import duration
from univoxel.errors import DataError, MissingExtra, UserError
from univoxel.fields.grid import GridShape
from univoxel.preparation.hull import mask_distances
from univoxel.preparation.object_shape import shrunk

Values = tuple[float, float, float]  # of red, green and blue
IMAGENET: tuple[Values, Values] = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
CENTRED: tuple[Values, Values] = (0.5, 0.5, 0.5), (1.0, 1.0, 1.0)


@dataclass(frozen=True)
class Network:
    """One of rembg's networks, and the pictures that it was trained on."""

    name: str
    megabytes: float  # of its weights
    side: int  # pixels of the pictures that it sees
    colors: tuple[Values, Values]  # mean and spread of these, of 1
    sigmoid: bool = False  # whether what it answers are logits


NETWORKS: dict[str, Network] = {
    network.name: network
    for network in (
        Network("u2netp", 4.7, 320, IMAGENET),  # U^2-Net, small (Qin et al. 2020)
        Network("silueta", 43, 320, IMAGENET),  # the same, pruned
        Network("u2net", 176, 320, IMAGENET),
        Network("isnet-general-use", 179, 1024, CENTRED),  # Qin et al. 2022
        Network("birefnet-general-lite", 224, 1024, IMAGENET, sigmoid=True),  # Zheng et al. 2024
        Network("birefnet-general", 973, 1024, IMAGENET, sigmoid=True),
    )
}


def check_network(name: str) -> Network:
    """The network of a name; a UserError if there is none."""
    if name not in NETWORKS:
        raise UserError(f"network: expected one of {', '.join(NETWORKS)}, got {name}", "network")
    return NETWORKS[name]


def mask_network(name: NetworkName = NETWORK) -> Callable[[Tensor], Tensor]:
    """What makes a mask [H, W] in [0, 1] of a photograph [H, W, 3] uint8, sRGB.

    rembg runs the network, and fetches its weights once. Without rembg, onnxruntime runs weights
    that are there: NAME.onnx in $U2NET_HOME, or in ~/.u2net.

    Raises:
        DataError: rembg could not fetch the weights.
        MissingExtra: neither is installed, or onnxruntime has no weights.
        UserError: there is no network of that name.
    """
    network = check_network(name)
    weights = Path(os.environ.get("U2NET_HOME") or Path.home() / ".u2net") / f"{name}.onnx"
    try:
        import rembg  # pyright: ignore[reportMissingImports]  the extra `masks`
    except (ImportError, SystemExit):  # it ends Python where onnxruntime is missing
        return _by_onnxruntime(network, weights)
    if not weights.is_file():
        log.info("%s: downloading the weights (%g MB, only once)", name, network.megabytes)
    try:
        session = rembg.new_session(name)
    except OSError as error:  # requests' errors are some
        raise DataError(f"{weights}: could not download the weights of {name}: {error}") from None

    def masked(photograph: Tensor) -> Tensor:
        mask = session.predict(Image.fromarray(photograph.numpy()))[0]
        return torch.from_numpy(np.asarray(mask, np.float32) / 255)

    return masked


def _by_onnxruntime(network: Network, weights: Path) -> Callable[[Tensor], Tensor]:
    try:
        import onnxruntime  # pyright: ignore[reportMissingImports]  the extra `masks`
    except ImportError:
        onnxruntime = None
    if onnxruntime is None or not weights.is_file():
        raise MissingExtra(
            "making masks with a network needs rembg: pip install 'univoxel[masks]'; or install "
            f"onnxruntime and put the network's weights at {weights}; or pass your own masks "
            "with cutout --from FOLDER or capture --masks FOLDER"
        )
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = torch.get_num_threads()
    try:
        session = onnxruntime.InferenceSession(str(weights), options, ["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime's own have no common root but this
        raise DataError(f"{weights}: this network could not be read: {error}") from None
    return lambda photograph: _prediction(network, session, photograph)


def _prediction(network: Network, session: Any, photograph: Tensor) -> Tensor:
    """A mask [H, W] in [0, 1] of a photograph [H, W, 3] uint8."""
    size = (network.side, network.side)
    small = Image.fromarray(photograph.numpy()).resize(size, Image.Resampling.LANCZOS)
    mean, spread = np.array(network.colors, np.float32)
    values = np.asarray(small, np.float32)
    values = (values / max(values.max(), 1) - mean) / spread
    name = session.get_inputs()[0].name
    found = session.run(None, {name: values.transpose(2, 0, 1)[None]})[0][0, 0]
    if network.sigmoid:
        found = torch.from_numpy(found).sigmoid().numpy()
    found = (found - found.min()) / max(found.max() - found.min(), 1e-6)
    height, width = photograph.shape[:2]
    mask = Image.fromarray(found).resize((width, height), Image.Resampling.BICUBIC)
    return torch.from_numpy(np.asarray(mask).clip(0, 1))


def timed(
    masked: Callable[[Tensor], Tensor], name: NetworkName, count: int
) -> Callable[[Tensor], Tensor]:
    """The same function, which tells after the first photograph how long so many take."""
    log.info("masks: using the network %s (%g MB)", name, NETWORKS[name].megabytes)
    first = True

    def measured(photograph: Tensor) -> Tensor:
        nonlocal first
        begun = monotonic()
        mask = masked(photograph)
        if first:
            first, seconds = False, monotonic() - begun
            whole = duration(count * seconds)
            log.info(
                "masks: %.1f s per photograph, about %s for all %d photographs",
                *(seconds, whole, count),
            )
        return mask

    return measured


# Which masks the object's silhouettes contradict, and how those are repaired.


# IoU below the usual one, from where on a mask is wrong. As much of it has to be more than a pixel
# off
BELOW = 0.08
# IoU with its silhouette below which a mask is wrong whatever the others have
LEAST = 0.75
# Voxels beside the silhouette within which a repaired mask keeps its own edge
BAND = 1.5

BESIDE, MISSING = "includes more than the object", "misses part of the object"


@dataclass(frozen=True)
class Verdict:
    """What the object's silhouette says about the mask of a photograph."""

    agreement: float | None  # IoU with the silhouette; None: there was none
    fault: str  # BESIDE, MISSING, or nothing
    mask: Tensor  # [H, W] in [0, 1]: repaired where there is a fault, else as it was


def judge(mask: Tensor, silhouette: Tensor, usual: float, voxel: float) -> Verdict:
    """Whether the object's silhouette contradicts a mask [H, W], and the mask repaired if so.

    Args:
        silhouette: [h, w] bool, smaller or as large.
        usual: median of the IoU of masks with their silhouettes.
        voxel: width of a voxel in pixels of the silhouette, of the grid that it comes from.
    """
    small = shrunk(mask, silhouette.shape[1], silhouette.shape[0])
    shown = small >= 0.5
    agreement = iou(shown, silhouette)
    # Edges that are a pixel off are no fault, though they are much of an object that is seen flat
    beside, missing = (shown & ~grown(silhouette)).sum(), (silhouette & ~grown(shown)).sum()
    differs = (beside + missing) / (silhouette | shown).sum().clamp_min(1)
    if agreement >= max(usual - BELOW, LEAST) or differs <= BELOW:
        return Verdict(agreement, "", mask)
    fault = BESIDE if beside > missing else MISSING
    return Verdict(agreement, fault, repaired(mask, silhouette, voxel))


def iou(a: Tensor, b: Tensor) -> float:
    """Intersection over union of two masks [H, W] bool; 1 where both are empty."""
    either = int((a | b).sum())
    return int((a & b).sum()) / either if either else 1.0


def voxel_pixels(grid: GridShape, cameras: Cameras, view: int) -> float:
    """How many pixels of a view a voxel in the middle of the grid is wide."""
    centre = (torch.stack(grid.bounds()).sum(0) / 2)[None]
    depth = project(cameras, view, centre)[1].abs()
    return float(grid.voxel_size * cameras.focal[view].mean() / depth)


def repaired(mask: Tensor, silhouette: Tensor, voxel: float) -> Tensor:
    """The mask within the grown silhouette, and all of the shrunk one; borders one voxel soft.

    In the band between both the mask is believed where it ends there, full on the inner side and
    empty on the outer one. Elsewhere, as where the table continues, the silhouette is.
    """
    small = shrunk(mask, silhouette.shape[1], silhouette.shape[0])
    away = mask_distances(silhouette.float()[None])[0] / voxel
    kernel = 2 * max(1, round(2 * BAND * voxel)) + 1
    sides = [(side >= BAND) & (side <= 3 * BAND) for side in (-away, away)]
    inner, outer = (_mean_near(small, side, kernel) for side in sides)
    believed = ((inner - outer - 0.5) / 0.25).clamp(0, 1)
    shape = (mask.shape[0], mask.shape[1])
    fine = interpolate(torch.stack([away, believed])[None], shape, mode="bilinear")[0]
    wide, middle, core = (0.5 - fine[0] + s for s in (BAND, 0.0, -BAND))
    within = torch.maximum(torch.minimum(mask, wide.clamp(0, 1)), core.clamp(0, 1))
    return torch.lerp(middle.clamp(0, 1), within, fine[1])


def grown(mask: Tensor) -> Tensor:
    """A mask [H, W] and the pixels that touch it."""
    return max_pool2d(mask.float()[None], 3, 1, 1)[0] > 0


def _mean_near(values: Tensor, where: Tensor, kernel: int) -> Tensor:
    """Means [H, W] of values over those pixels of a square around each that count; 0 if none do."""
    counted = torch.stack([values * where, where.float()])[None]
    total, count = avg_pool2d(counted, kernel, 1, kernel // 2)[0]
    return total / count.clamp_min(1e-6)
