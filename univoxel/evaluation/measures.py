"""The measures of a trained scene, and what decides on them.

- albedo_psnr_raw, _1ch, _3ch: albedo as it is; with one scale; with a scale per channel.
- albedo_psnr_fg: as _3ch, over the pixels of the mask only.
- relit_psnr: rendered with the albedo times the scale per channel, clipped to 1, on the surface
  and on what it sees of itself; relit_psnr_raw: with the albedo as it is.
- chamfer: samples of the mesh against points of the true surface.
- trust_spearman: of doubt (see `univoxel.confidence.survey`) and error over the pixels of the mask
  in all views: of the albedo, with a scale per channel, mean absolute difference in sRGB; of the
  roughness, absolute difference.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TypeAlias

import torch
from torch import Tensor

from univoxel import metrics
from univoxel.color import linear_to_srgb
from univoxel.data import Photos
from univoxel.evaluation.truth import Expected, view_truth
from univoxel.pictures.layers import Layers
from univoxel.records import Mesh
from univoxel.render.pipeline import surface_of_view
from univoxel.scene import Scene

# By key: what the table says of it
MEASURES = {
    "nvs_psnr": "novel views, PSNR, dB",
    "nvs_ssim": "novel views, SSIM",
    "albedo_psnr_raw": "albedo PSNR, dB, as it is",
    "albedo_psnr_1ch": "albedo PSNR, dB, one scale",
    "albedo_psnr_3ch": "albedo PSNR, dB, a scale per channel",
    "albedo_psnr_fg": "albedo PSNR, dB, a scale per channel, mask only",
    "roughness_mse": "roughness MSE in the mask",
    "relit_psnr": "relit PSNR, dB, albedo with a scale per channel",
    "relit_psnr_raw": "relit PSNR, dB, albedo as it is",
    "normal_mae_deg": "normals, mean error in the mask, degrees",
    "chamfer": "Chamfer distance, world units",
    "trust_spearman": "rank correlation of the albedo's doubt with its error",
    "trust_spearman_roughness": "rank correlation of the roughness's doubt with its error",
    "train_seconds": "training, seconds",
    "threads": "threads in training",
    "peak_rss_mb": "peak memory in training, MB",
    "parameters": "parameters",
    "model_bytes": "size of the model file, bytes",
}


def in_words(measures: Mapping[str, float | int | None]) -> dict[str, str]:
    """What people read of measures by key: their texts, by what they are. None is a dash."""
    return {meaning: _text(measures[key]) for key, meaning in MEASURES.items() if key in measures}


def _text(value: float | int | None) -> str:
    if value is None:
        return "-"
    return f"{value:.4g}" if isinstance(value, float) else f"{value:,}"


SURFACE_POINTS = 100_000  # samples of the mesh for the Chamfer distance, at most

Pairs: TypeAlias = tuple[Tensor, Tensor] | None  # doubts and errors, [N] each


@dataclass(frozen=True)
class Scales:
    """What the albedo is multiplied by before it is compared; [3] each."""

    one: Tensor
    three: Tensor


def score(layers: Layers, expected: Expected, scales: Scales) -> list[tuple[str, float]]:
    """The measures of one view, by key; relit pictures give one pair of numbers for each map."""
    truth = expected.truth
    picture = linear_to_srgb(layers.rgb + expected.behind * (1 - layers.alpha[..., None]))
    found = [
        ("nvs_psnr", metrics.psnr(picture, expected.photo)),
        ("nvs_ssim", metrics.ssim(picture, expected.photo)),
    ]
    for name, photo in expected.relit.items():
        scaled, raw = layers.relit_scaled[name], layers.relit[name]
        found.append(("relit_psnr", metrics.psnr(linear_to_srgb(scaled), photo)))
        found.append(("relit_psnr_raw", metrics.psnr(linear_to_srgb(raw), photo)))
    mask = truth.mask if truth.mask is not None and truth.mask.any() else None
    if expected.albedo is not None:
        aligned = linear_to_srgb(layers.albedo * scales.three)
        one = linear_to_srgb(layers.albedo * scales.one)
        raw = linear_to_srgb(layers.albedo)
        found.append(("albedo_psnr_raw", metrics.psnr(raw, expected.albedo)))
        found.append(("albedo_psnr_1ch", metrics.psnr(one, expected.albedo)))
        found.append(("albedo_psnr_3ch", metrics.psnr(aligned, expected.albedo)))
        if mask is not None:
            found.append(("albedo_psnr_fg", metrics.psnr(aligned, expected.albedo, mask)))
    if truth.roughness is not None and mask is not None:
        error = metrics.roughness_mse(layers.roughness, truth.roughness, mask)
        found.append(("roughness_mse", error))
    if truth.normal is not None and mask is not None:
        found.append(("normal_mae_deg", metrics.normal_mae(layers.normal, truth.normal, mask)))
    return found


def doubts_and_errors(layers: Layers, expected: Expected, scales: Scales) -> tuple[Pairs, Pairs]:
    """Doubts and errors in the mask of a view, of albedo and of roughness, where there is truth."""
    truth, doubt = expected.truth, layers.doubt
    if doubt is None or truth.mask is None:
        return None, None
    there = truth.mask & (layers.alpha > 0)
    albedo, roughness = None, None
    if expected.albedo is not None:
        error = (linear_to_srgb(layers.albedo * scales.three) - expected.albedo).abs().mean(-1)
        albedo = doubt[there][:, 0], error[there]
    if truth.roughness is not None:
        error = (layers.roughness - truth.roughness).abs()
        roughness = doubt[there][:, 1], error[there]
    return albedo, roughness


def doubt_correlation(pairs: list[Pairs]) -> float | None:
    """Rank correlation of doubts and errors over all views; None where there is no truth."""
    known = [pair for pair in pairs if pair is not None]
    if not known:
        return None
    doubt, error = (torch.cat(part) for part in zip(*known, strict=True))
    return metrics.spearman(doubt, error)


def albedo_scales(scene: Scene, photos: Photos) -> Scales:
    """The scales over all test views, or 1 where there is no true albedo.

    This is a pass of its own, so that the pass that renders keeps one view in memory.
    """
    pairs = []
    for view in range(len(photos)):
        truth = view_truth(photos, view)
        if truth.albedo is not None and truth.mask is not None:
            surface, _ = surface_of_view(scene, photos.cameras, view)
            pairs.append((truth.albedo[truth.mask], surface.albedo[truth.mask.flatten()]))
    if not pairs:
        return Scales(torch.ones(3), torch.ones(3))
    truth, albedo = (torch.cat(part) for part in zip(*pairs, strict=True))
    everywhere = torch.ones(len(truth), dtype=torch.bool)
    one, three = (metrics.albedo_scale(truth, albedo, everywhere, c) for c in (1, 3))
    return Scales(one, three)


def mesh_chamfer(mesh: Mesh | None, points: Tensor | None) -> float | None:
    """Chamfer distance of samples of a mesh and points; None where there are none of either."""
    if mesh is None or points is None or not len(mesh.faces):
        return None
    count = min(len(points), SURFACE_POINTS)
    samples = metrics.sample_mesh(mesh, count, torch.Generator().manual_seed(0))
    return metrics.chamfer(samples, points)
