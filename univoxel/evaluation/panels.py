"""The panels of a test view on the contact sheet: render, truth and error."""

from __future__ import annotations

import torch
from torch import Tensor

from univoxel.color import linear_to_srgb
from univoxel.evaluation.measures import Scales
from univoxel.evaluation.truth import Expected
from univoxel.pictures.contact_sheet import Panel, heat, shrink
from univoxel.pictures.layers import Layers

COLOR_LIMIT, ROUGHNESS_LIMIT, NORMAL_LIMIT = 0.2, 0.5, 45.0  # brightest errors on the sheet


def panels_of_view(layers: Layers, expected: Expected, scales: Scales) -> list[Panel]:
    """What the contact sheet shows of a view. Errors of materials and normals: in the mask."""
    truth, mask = expected.truth, expected.truth.mask

    def colors(title: str, linear: Tensor, photo: Tensor | None) -> Panel:
        picture = linear_to_srgb(linear)
        error = None if photo is None else (picture - photo).abs().mean(-1)
        return Panel(title, picture, photo, error, COLOR_LIMIT)

    def gray(roughness: Tensor) -> Tensor:
        return roughness[..., None].expand(-1, -1, 3)

    def mapped(normal: Tensor) -> Tensor:
        return 0.5 * normal + 0.5 * (normal != 0).any(-1, keepdim=True)

    rough, bent = None, None
    if truth.roughness is not None and mask is not None:
        rough = (layers.roughness - truth.roughness).abs() * mask
    if truth.normal is not None and mask is not None:
        cosine = (layers.normal * truth.normal).sum(-1).clamp(-1, 1)
        bent = cosine.acos().rad2deg() * mask
    panels = [
        colors(
            "novel view",
            layers.rgb + expected.behind * (1 - layers.alpha[..., None]),
            expected.photo,
        ),
        colors("albedo, scaled", layers.albedo * scales.three, expected.albedo),
        Panel(
            "roughness",
            gray(layers.roughness),
            None if truth.roughness is None else gray(truth.roughness),
            rough,
            ROUGHNESS_LIMIT,
        ),
        Panel(
            "normal",
            mapped(layers.normal),
            None if truth.normal is None else mapped(truth.normal),
            bent,
            NORMAL_LIMIT,
            " degrees",
        ),
    ]
    if layers.doubt is not None:  # beside what it should foretell
        albedo, rough = (torch.from_numpy(heat(x, 1.0)) for x in layers.doubt.unbind(-1))
        heads = ("roughness doubt", "albedo error")
        error = panels[1].error
        panels.append(Panel("albedo doubt", albedo, rough, error, COLOR_LIMIT, heads=heads))
    panels += [
        colors(f"under {name}", layers.relit_scaled[name], photo)
        for name, photo in expected.relit.items()
    ]
    return [shrink(panel) for panel in panels]
