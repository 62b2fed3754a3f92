"""What a smaller model costs, told by rays that training does not see.

In dB: how much less well held-out pixels are drawn with it, by the physically based render and by
the radiance head; or how far materials move, as if that were an error of the same render.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import TypeVar

import torch
from torch import Tensor

from univoxel.color import linear_to_srgb
from univoxel.records import Rays, Surface
from univoxel.render.pipeline import radiance_of, shade, surface_at
from univoxel.scene import Scene

Number = TypeVar("Number", int, float)

TOLERANCE = 0.02  # dB that the held-out rays may lose by one kind of saving


@dataclass(frozen=True)
class Choice:
    """What was chosen of one kind of capacity."""

    what: str  # such as lobes
    before: float
    after: float
    cost: float  # dB on held-out rays; below 0 they gained
    why: str

    def noted(self) -> dict:
        """For the run's state; JSON."""
        said = f"{self.what} {self.before:,.9g} -> {self.after:,.9g}: {self.why}"
        return asdict(self) | {"said": said}


@dataclass(frozen=True)
class Look:
    """The held-out rays, and what the photographs show there."""

    rays: Rays
    view: Tensor  # [N] int64
    target: Tensor  # [N, 3] sRGB, on black

    @property
    def wo(self) -> Tensor:
        return -self.rays.direction

    def meet(self, scene: Scene) -> Surface:
        with torch.no_grad():
            return surface_at(scene, self.rays)

    def decode(self, scene: Scene, surface: Surface, features: Tensor) -> dict[str, Tensor]:
        """Everything that the heads make of features [N, C] there; colours on black, sRGB."""
        opacity = surface.opacity[:, None]
        albedo, roughness, metallic = scene.material(features)
        surface = replace(
            surface, features=features, albedo=albedo, roughness=roughness, metallic=metallic
        )
        head = radiance_of(scene, surface, self.wo, self.view)
        rgb = shade(scene, surface, self.wo, view=self.view)
        material = torch.cat([albedo, roughness[:, None], metallic[:, None]], 1)
        return {
            "radiance": head * opacity,
            "physical": linear_to_srgb((rgb * opacity).clamp_min(0)),
            "material": material * opacity,
        }

    def cost(self, before: dict[str, Tensor], after: dict[str, Tensor]) -> float:
        """dB that were lost: the largest of radiance, physical render and materials."""

        def error(picture: Tensor) -> Tensor:
            return (picture - self.target).square().mean()

        moved = (after["material"] - before["material"]).square().mean()
        ratio = [error(after[k]) / error(before[k]) for k in ("radiance", "physical")]
        ratio.append(1 + moved / error(before["physical"]))
        return 10 * torch.stack(ratio).max().log10().item()


def smallest(candidates: Sequence[Number], cost: Callable[[Number], float], limit: float) -> Number:
    """The last of candidates, from the dearest to the most sparing, that costs at most `limit` dB.

    Found by halving, for costs that rise. The first costs nothing and is not looked at.
    """
    low, high = 0, len(candidates)
    while high - low > 1:
        middle = (low + high) // 2
        if cost(candidates[middle]) <= limit:
            low = middle
        else:
            high = middle
    return candidates[low]
