"""The interface of all lighting models, their regularisation, and a base for local light."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from univoxel import brdf
from univoxel.core.records import Occlusion, Surface
from univoxel.core.validation import about
from univoxel.ops.networks import MLP, DirectionTable, waves


def smoothness(value: Tensor, near: Tensor) -> Tensor:
    """L1 between what holds at surface points and at places right beside them, [N, ...]."""
    return (value - near).abs().mean()


def chroma(light: Tensor) -> Tensor:
    """Mean distance of RGB sums of light [N, 3] from their own grey, relative to the mean grey.

    Images fix albedo and light only up to a colour; a white light on the whole is the likeliest
    guess.
    """
    grey = light.mean(1, keepdim=True)
    return ((light - grey).abs() / grey.detach().mean().clamp_min(1e-6)).mean()


def total_variation(log_map: Tensor) -> Tensor:
    """How much a lat-long map [H, 2 H, 3] goes up and down over the sphere.

        (1 / 4 pi) integral of (1 + |grad log L|^2)^(1/2) - 1 dw,   gradients per radian

    In logarithms, so that a wall counts as much as the sky. About the length of the gradient where
    it is steep, so that noise is dear and the edge of a lamp is not; its square, without a kink,
    where it is even. Source: Rudin, Osher and Fatemi 1992; Charbonnier et al. 1994.
    """
    height, width, _ = log_map.shape
    step = math.pi / height
    elevation = math.pi / 2 - step * (torch.arange(height, device=log_map.device) + 0.5)
    across = elevation.cos()[:, None, None]
    down = torch.nn.functional.pad(log_map.diff(dim=0), (0, 0, 0, 0, 0, 1)) / step
    right = (log_map.roll(-1, 1) - log_map) / (step * across)
    length = (down.square() + right.square() + 1).sqrt() - 1
    return (across * length).sum() / (across.sum() * 3 * width)


# The interface of all lights.


MOST_DIRECTIONS = 1 << 16  # that light is summed up over: memory of a batch grows with them
MOST_LAYERS = 32  # of a network: without shortcuts deeper ones do not learn
MOST_ROWS = 1 << 13  # of a map
KIND = about("name of the lighting model in config.json")


@dataclass(frozen=True)
class Regularisation:
    """What keeps a light likely: terms [] >= 0, None if the light has no such term.

    Each is weighted by the field of LossConfig of its name.
    """

    light_smoothness: Tensor | None = None  # how far light changes over the surface
    map_smoothness: Tensor | None = None  # how far a map changes over the sphere
    white_light: Tensor | None = None  # how far light is from grey on the whole


class AbstractLight(nn.Module, ABC):
    """Light that falls on surface points. Declares; a leaf implements each method once."""

    traced: ClassVar[bool]  # whether the light is distant, so that `reflected` wants an occlusion
    config: Any  # with `directions` in training, and `directions_eval`

    @property
    def directions(self) -> int:
        """D, along which `reflected` sums up light: fewer in training mode than in evaluation."""
        return self.config.directions if self.training else self.config.directions_eval

    @abstractmethod
    def incident(
        self,
        surface: Surface,
        wi: Tensor,  # [N, D, 3]
    ) -> Tensor:
        """Linear radiance [N, D, 3] >= 0 that arrives at N points from unit world directions wi.

        Nothing is in the way of a light that is traced.
        """

    @abstractmethod
    def reflected(
        self,
        surface: Surface,
        wo: Tensor,  # [N, 3]
        occlusion: Occlusion | None = None,
        generator: torch.Generator | None = None,
    ) -> Tensor:
        """Linear radiance [N, 3] that N points send along unit world directions wo.

        Args:
            occlusion: what is in the light's way. A local light holds that already: where it is
                given nevertheless, it takes its share.
            generator: turns the directions of a quadrature at random; without one the result is
                deterministic. An occlusion brings its own directions.
        """

    @abstractmethod
    def regularisation(self, surface: Surface, near: Surface) -> Regularisation:
        """What keeps the light likely.

        Args:
            surface, near: N points of the surface, and one right beside each.
        """


# What the local lights share: a global light, and a network that adds to it at each point.


FREQUENCIES = 3  # of the position: sines of 1, 2, 4 half-turns over the scale


class LocalLightConfig(ABC):
    """What the configurations of all local lights have."""

    hidden: int  # width of the head, >= 1
    layers: int  # hidden layers of the head, >= 0
    directions: int  # in training, >= 1
    directions_eval: int  # in evaluation, >= 1
    scale: float  # world units: half the extent of what is lit, > 0


class AbstractLocalLight(AbstractLight):
    """Light that differs from point to point and holds direct light, indirect light and visibility
    together: `base`, the same everywhere, plus what `head` makes of a point."""

    traced = False
    config: LocalLightConfig

    def __init__(
        self,
        features: int,
        config: LocalLightConfig,
        base: Tensor,
        generator: torch.Generator | None = None,
    ) -> None:
        """
        Args:
            features: C of Surface.features, >= 0.
            base: at first, and all of the light then.
            generator: draws the head's first weights.
        """
        super().__init__()
        self.config = config
        sizes = [features + 3 + 6 * FREQUENCIES, *[config.hidden] * config.layers, base.numel()]
        self.head: MLP = MLP(sizes, generator or torch.default_generator)  # from `encode`
        nn.init.zeros_(self.head.linear[-1].weight)
        self.base: nn.Parameter = nn.Parameter(base)

    def raw(self, surface: Surface) -> Tensor:
        """What the head adds to the global light at each point: [N, numbers of `base`]."""
        return self.head(encode(surface, self.config.scale))


def encode(surface: Surface, scale: float) -> Tensor:
    """Features, position and sines of it: [N, C + 3 + 18].

    Args:
        scale: world units: half the extent of what is lit.
    """
    fine = waves(surface.position * (math.pi / scale), FREQUENCIES)
    return torch.cat([surface.features, surface.position / scale, *fine], -1)


# Light that is finer than the lobes of a local light, as a surface mirrors it.


_OCTAVES = 4  # of the reflected direction: sines of 1, 2, 4, 8 radians


class MirroredLight(nn.Module):
    """What the reflected direction holds beyond a local light's lobes: E(n.wo, roughness) times a
    network of place, roughness and reflected direction.

    Lobes and quadratures blur what a smooth surface mirrors sharply. The split sum (Karis 2013,
    Real Shading in Unreal Engine 4) asks for one blurred radiance a point instead, which a network
    can hold (Liu et al. 2023, NeRO). Signed, for it corrects the lobes; at first it is 0.
    """

    def __init__(self, features: int, hidden: int, scale: float, known: int = 0) -> None:
        """
        Args:
            features: C of Surface.features.
            hidden: width of the network.
            scale: world units: half the extent of what is lit.
            known: channels of the table of directions.
        """
        super().__init__()
        self.scale = scale
        inputs = features + 3 + 6 * FREQUENCIES + 6 * _OCTAVES + 2 + known
        self.net: MLP = MLP([inputs, hidden, hidden, 3])
        last = self.net.linear[-1]
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)

    @property
    def silent(self) -> bool:
        """Whether training may pass it over: it is 0 everywhere, and is not learned."""
        last = self.net.linear[-1]
        return (
            self.training
            and not last.weight.requires_grad
            and not bool(last.weight.any() or last.bias.any())
        )

    def forward(self, surface: Surface, wo: Tensor, table: DirectionTable) -> Tensor:
        """Radiance [N, 3] towards unit directions wo [N, 3], to be added.

        Args:
            table: of reflected directions, with `known` channels; another network's too.
        """
        cosine = (surface.normal * wo).sum(1, keepdim=True)
        mirrored = 2 * cosine * surface.normal - wo
        roughness = surface.roughness[:, None]
        place = encode(surface, self.scale)
        way = [*waves(mirrored, _OCTAVES), roughness, cosine, table(mirrored)]
        light = self.net(torch.cat([place, *way], 1))
        _, f0 = brdf.split(surface.albedo, surface.metallic)
        share = brdf.specular_albedo(cosine[:, 0], surface.roughness, f0)
        return (share if share.dim() == 2 else share[:, None]) * light
