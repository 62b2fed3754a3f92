"""Small networks that decode a ray's composited features."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from univoxel.networks import MLP, DirectionTable, waves


class MaterialHead(nn.Module):
    """The first `channels` features of [N, C] -> albedo [N, 3], roughness [N] and metallic [N].

    Albedo is the base colour of glTF: of a metal, what it reflects at normal incidence.
    """

    min_roughness: float = 0.05  # below, a highlight is narrower than the light's own detail

    def __init__(self, channels: int, hidden: int, roughness: float | None = None) -> None:
        """
        Args:
            roughness: of everything, if it is known: then nothing is metal. None: both are learned.
        """
        super().__init__()
        self.channels: int = channels
        self.roughness: float | None = roughness
        self.net: MLP = MLP([channels, hidden, hidden, 5])
        last = self.net.linear[-1]
        # Start mid-grey, glossy and no metal, whatever the features. Glossy: what is rough becomes
        # so, but for what starts rough the light makes itself sharp enough, and too bright.
        with torch.no_grad():
            last.weight.mul_(0.1)
            last.bias.copy_(torch.tensor([0.0, 0.0, 0.0, -1.3, -4.0]))

    def forward(self, features: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        out = torch.sigmoid(self.net(features[:, : self.channels]))
        if self.roughness is not None:
            known = torch.full_like(out[:, 3], self.roughness)
            return out[:, :3], known, torch.zeros_like(known)
        low = self.min_roughness
        return out[:, :3], low + (1 - low) * out[:, 3], out[:, 4]

    @torch.no_grad()
    def shift_roughness(self, features: Tensor, median: float) -> None:
        """Make everything rougher or smoother, to that median over features [N, C]."""
        low = self.min_roughness
        medians = torch.stack([torch.tensor(median), self(features)[1].median()])
        wanted, now = torch.logit((medians - low) / (1 - low), eps=1e-4)
        self.net.linear[-1].bias[3] += wanted - now

    @torch.no_grad()
    def shift_albedo(self, features: Tensor, median: Tensor) -> None:
        """Make every channel brighter or darker, to those medians [3] over features [N, C]."""
        medians = torch.stack([median, self(features)[0].median(0).values])
        wanted, now = torch.logit(medians, eps=1e-4)
        self.net.linear[-1].bias[:3] += wanted - now


class RadianceHead(nn.Module):
    """Outgoing radiance without any model of light: it lets geometry converge early.

    Reads features, normal, the mirrored view direction (Verbin et al. 2022, Ref-NeRF), what a table
    holds of it, and n.wo; returns sRGB-encoded colour, so that the network is as fine in the dark
    as the eye is.
    """

    def __init__(self, channels: int, hidden: int, levels: int = 0) -> None:
        """
        Args:
            levels: of the table of mirrored directions, >= 0.
        """
        super().__init__()
        self.directions: DirectionTable = DirectionTable(levels)
        self.net: MLP = MLP([channels + 3 + 9 + 1 + self.directions.channels, hidden, hidden, 3])

    def forward(self, features: Tensor, normal: Tensor, wo: Tensor) -> Tensor:
        cosine = (normal * wo).sum(1, keepdim=True)
        mirrored = 2 * cosine * normal - wo
        seen = [mirrored, *waves(2 * mirrored, 1), cosine, self.directions(mirrored)]
        return torch.sigmoid(self.net(torch.cat([features, normal, *seen], 1)))
