"""Draws docs/images/metal_fits.png: what a metal and a painted point leave of either material.

    python docs/figures/metal_fits.py docs/images

One point is seen by some cameras under the map of the bundled scene. For each roughness the base
colour that serves best is searched for as a dielectric and as a metal, in sRGB.
"""

from __future__ import annotations

import math
import sys
from pathlib import Path

import matplotlib

matplotlib.use("agg")
import matplotlib.pyplot as plt
import torch
from torch import Tensor

from univoxel import brdf
from univoxel.color import linear_to_srgb
from univoxel.data.images import read_image
from univoxel.envmap import EnvMap, lookup
from univoxel.sphere import fibonacci_sphere

MAP = Path(__file__).parents[2] / "univoxel/example_data/tiny/envmaps/train.hdr"
DIRECTIONS, VIEWS = 4096, 16
NORMAL = torch.nn.functional.normalize(torch.tensor([0.3, -0.5, 0.8]), dim=0)
TRIED = torch.linspace(0.08, 0.95, 25)  # roughnesses
BASES = torch.linspace(0.005, 1.0, 400)
MIN_REFLECTANCE = 0.25  # of a metal's brightest channel, as in training/metals.py
NOISE = 0.01  # sRGB
CASES = {
    "gold ball": (torch.tensor([1.0, 0.77, 0.34]), 0.3, 1.0),
    "painted ball": (torch.tensor([0.55, 0.35, 0.12]), 0.45, 0.0),
}


def eyes() -> Tensor:
    """Directions [V, 3] to the cameras, in the half-sphere above the point."""
    every = fibonacci_sphere(400)
    return every[every @ NORMAL > 0.35][:: 120 // VIEWS][:VIEWS]


def shaded(diffuse: float, f0: float, roughness: float) -> Tensor:
    """Radiance [V, 3] of the point for the same diffuse albedo and F0 in all channels."""
    wi = fibonacci_sphere(DIRECTIONS)
    wi = wi[wi @ NORMAL > 0]
    wo = eyes()[:, None]
    light = lookup(EnvMap(read_image(MAP)[..., :3]), wi)
    material = torch.full((1, 1, 3), diffuse), torch.full((1, 1), roughness)
    value = brdf.evaluate(NORMAL, wo, wi, *material, torch.full((1, 1, 3), f0))
    cosine = (wi @ NORMAL)[:, None]
    return 4 * math.pi / DIRECTIONS * (value * light * cosine).sum(1)


def residual(constant: Tensor, slope: Tensor, target: Tensor, least: float) -> float:
    """Root mean square in sRGB of the best constant + base * slope [V, 3]."""
    tried = linear_to_srgb((constant + BASES[:, None, None] * slope).clamp_min(0))
    base = BASES[(tried - target).square().mean(1).argmin(0)]
    base = base * max(1.0, least / float(base.max()))
    shown = linear_to_srgb((constant + base * slope).clamp_min(0))
    return float((shown - target).square().mean().sqrt())


def fits(target: Tensor) -> tuple[list[float], list[float]]:
    """Residuals as dielectric and as metal for all roughnesses that are tried."""
    dielectric, metal = [], []
    for roughness in TRIED.tolist():
        black, white = shaded(0.0, 0.0, roughness), shaded(0.0, 1.0, roughness)
        layer = shaded(0.0, brdf.F0, roughness)
        dielectric.append(residual(layer, shaded(1.0, brdf.F0, roughness) - layer, target, 0.0))
        metal.append(residual(black, white - black, target, MIN_REFLECTANCE))
    return dielectric, metal


def main() -> None:
    generator = torch.Generator().manual_seed(0)
    figure, panels = plt.subplots(1, 2, figsize=(8.0, 2.7), facecolor="white", sharey=True)
    for axes, (name, (base, roughness, metallic)) in zip(panels, CASES.items(), strict=True):
        black, white = shaded(0.0, 0.0, roughness), shaded(0.0, 1.0, roughness)
        layer = shaded(0.0, brdf.F0, roughness)
        diffuse = shaded(1.0, brdf.F0, roughness) - layer
        rgb = black + base * (white - black) if metallic else layer + base * diffuse
        target = linear_to_srgb(rgb) + NOISE * torch.randn(rgb.shape, generator=generator)
        dielectric, metal = fits(target)
        assert (min(metal) < min(dielectric)) == bool(metallic)
        axes.plot(TRIED, dielectric, color="#3a6ea5", label="as dielectric")
        axes.plot(TRIED, metal, color="#c9822b", label="as metal")
        axes.axvline(roughness, color="#5b6f7a", lw=0.8, ls=":")
        axes.set_title(name, size=10)
        axes.set_xlabel("roughness that is tried (dotted: the true one)", size=8)
        axes.set_yscale("log")
        axes.tick_params(which="both", left=False, labelleft=False, labelsize=7)
    panels[0].set_ylabel("residual", size=8)
    panels[0].legend(fontsize=8, frameon=False)
    figure.tight_layout()
    figure.savefig(Path(sys.argv[1]) / "metal_fits.png", dpi=100, metadata={"Software": None})


if __name__ == "__main__":
    main()
