"""Light that is finer than the lobes of a local light, as a surface mirrors it."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from univoxel import brdf
from univoxel.lights import local
from univoxel.networks import MLP, DirectionTable, waves
from univoxel.records import Surface

_OCTAVES = 4  # of the mirrored direction: sines of 1, 2, 4, 8 radians


class MirroredLight(nn.Module):
    """What the mirrored direction holds beyond a local light's lobes: E(n.wo, roughness) times a
    network of place, roughness and mirrored direction.

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
        inputs = features + 3 + 6 * local.FREQUENCIES + 6 * _OCTAVES + 2 + known
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
            table: of mirrored directions, with `known` channels; another network's too.
        """
        cosine = (surface.normal * wo).sum(1, keepdim=True)
        mirrored = 2 * cosine * surface.normal - wo
        roughness = surface.roughness[:, None]
        place = local.encode(surface, self.scale)
        way = [*waves(mirrored, _OCTAVES), roughness, cosine, table(mirrored)]
        light = self.net(torch.cat([place, *way], 1))
        _, f0 = brdf.split(surface.albedo, surface.metallic)
        share = brdf.specular_albedo(cosine[:, 0], surface.roughness, f0)
        return (share if share.dim() == 2 else share[:, None]) * light
