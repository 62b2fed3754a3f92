"""How small mirrored directions and hash tables may be: quality lost, and the search for sizes.

Quality is lost in dB: how much less well held-out pixels are drawn with a smaller model, by the
physically based render and by the radiance head; or how far materials move, as if that were an
error of the same render.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, TypeVar

import torch
from torch import Tensor, nn

from univoxel.color import linear_to_srgb
from univoxel.data import Photos
from univoxel.networks import MLP
from univoxel.records import Rays, Surface
from univoxel.render.pipeline import radiance_of, shade, surface_at
from univoxel.scene import Scene
from univoxel.training.choices import CapacityChoice
from univoxel.training.loop import batch_at

# dB that mirror levels, and rows, may cost. Below what is visible, even both together
TOLERANCE_DB = 0.02
# Shares of a hash table's rows that are dropped on trial, from 0 rising. Finer where more is gone,
# as costs rise faster there
DROPPED_ROW_SHARES = (
    *(0.0, 1 / 4, 3 / 8, 1 / 2, 5 / 8, 11 / 16, 3 / 4, 13 / 16, 7 / 8, 29 / 32, 15 / 16),
)

Number = TypeVar("Number", int, float)


class Decoded(NamedTuple):
    """Everything that a scene's networks give along N rays, times opacity."""

    radiance: Tensor  # [N, 3] of the radiance head, sRGB
    physical: Tensor  # [N, 3] physically based render, sRGB
    material: Tensor  # [N, 5] albedo, roughness, metallic


@dataclass(frozen=True)
class ReferenceRays:
    """N rays and the colours that the photographs show there.

    Held-out rays judge what is lost; rays of the training photographs probe.
    """

    rays: Rays
    view: Tensor  # [N] int64
    target: Tensor  # [N, 3] sRGB, on black

    @property
    def wo(self) -> Tensor:
        return -self.rays.direction

    def surface(self, scene: Scene) -> Surface:
        """The surface that the rays meet; no gradient."""
        with torch.no_grad():
            return surface_at(scene, self.rays)

    def decode(self, scene: Scene, surface: Surface, features: Tensor) -> Decoded:
        """What the networks make of features [N, C] on a surface."""
        opacity = surface.opacity[:, None]
        albedo, roughness, metallic = scene.material(features)
        surface = replace(
            surface, features=features, albedo=albedo, roughness=roughness, metallic=metallic
        )
        radiance = radiance_of(scene, surface, self.wo, self.view)
        physical = shade(scene, surface, self.wo, view=self.view)
        material = torch.cat([albedo, roughness[:, None], metallic[:, None]], 1)
        return Decoded(
            radiance * opacity,
            linear_to_srgb((physical * opacity).clamp_min(0)),
            material * opacity,
        )

    @torch.no_grad()
    def decoded(self, scene: Scene) -> Decoded:
        """What the scene as it is gives along the rays; no gradient."""
        surface = self.surface(scene)
        return self.decode(scene, surface, surface.features)

    def loss_db(self, before: Decoded, after: Decoded) -> float:
        """Quality that was lost: the largest loss of radiance, physical render and materials."""

        def error(picture: Tensor) -> Tensor:
            return (picture - self.target).square().mean()

        moved = (after.material - before.material).square().mean()
        ratio = [
            error(after.radiance) / error(before.radiance),
            error(after.physical) / error(before.physical),
            1 + moved / error(before.physical),
        ]
        return 10 * torch.stack(ratio).max().log10().item()


def reference_rays(photos: Photos, pixels: Tensor) -> ReferenceRays:
    """The rays of pixels [P, 3] (view, row, column) of the photographs."""
    batch = batch_at(photos, pixels)
    target = linear_to_srgb(batch.color * batch.alpha[:, None])
    return ReferenceRays(batch.rays, batch.view, target)


def random_reference_rays(photos: Photos, pixels: Tensor, count: int) -> ReferenceRays:
    """The rays of `count` of the pixels [P, 3] at most, drawn without replacement."""
    return reference_rays(photos, pixels[torch.randperm(len(pixels))[:count]])


def last_within_limit(
    candidates: Sequence[Number], loss_db: Callable[[Number], float], limit_db: float
) -> Number:
    """The last candidate that loses at most `limit_db`, found by bisection.

    Args:
        candidates: the first costs nothing and is not measured; losses rise from one to the next.
    """
    low, high = 0, len(candidates)
    while high - low > 1:
        middle = (low + high) // 2
        if loss_db(candidates[middle]) <= limit_db:
            low = middle
        else:
            high = middle
    return candidates[low]


def fewer_mirror_levels_(scene: Scene, held_out: ReferenceRays) -> CapacityChoice:
    """Drop the finest levels of the table of mirrored directions that held-out rays do not miss."""
    surface = held_out.surface(scene)
    full = scene.cfg.mirror_levels
    states = {full: _mirror_state(scene)}
    losses = {full: 0.0}

    @torch.no_grad()
    def decoded() -> Decoded:
        return held_out.decode(scene, surface, surface.features)

    before = decoded()

    def loss_db(levels: int) -> float:
        drop_mirror_levels_(scene, levels)
        losses[levels] = held_out.loss_db(before, decoded())
        states[levels] = _mirror_state(scene)
        _restore_(states[full])
        return losses[levels]

    levels = last_within_limit(range(full, -1, -1), loss_db, TOLERANCE_DB)
    _restore_(states[levels])
    why = f"costs {losses[levels]:.3f} dB"
    if fewer := [n for n in losses if n < levels]:
        why += f", {max(fewer)} would cost {losses[max(fewer)]:.3f} dB"
    return CapacityChoice("mirror levels", full, levels, losses[levels], why)


def drop_mirror_levels_(scene: Scene, levels: int) -> None:
    """Keep the coarsest levels of the table of mirrored directions; of the others the networks that
    read it see 0 from now on. Networks and table are new: the old stay as they were."""
    table = scene.radiance.directions
    dropped = table.channels - table.per_level * levels
    for owner in (scene.radiance, scene.mirrored):
        if owner is not None:
            owner.net = _without_last_inputs(owner.net, dropped)
    table.table = nn.Parameter(table.table.data[: levels * table.rows].clone())
    scene.cfg = replace(scene.cfg, mirror_levels=levels)


def _without_last_inputs(net: MLP, dropped: int) -> MLP:
    weights = [layer.weight.data for layer in net.linear]
    weights[0] = weights[0][:, : weights[0].shape[1] - dropped]
    fewer = MLP([weights[0].shape[1], *(len(w) for w in weights)])
    for layer, weight, before in zip(fewer.linear, weights, net.linear, strict=True):
        layer.weight = nn.Parameter(weight.clone())
        layer.bias = nn.Parameter(before.bias.data.clone())
    return fewer


def _mirror_state(scene: Scene) -> list[tuple[Any, str, Any]]:
    """Owner, name and value of all that `drop_mirror_levels_` replaces."""
    names = [(scene, "cfg"), (scene.radiance, "net"), (scene.radiance.directions, "table")]
    if scene.mirrored is not None:
        names.append((scene.mirrored, "net"))
    return [(owner, name, getattr(owner, name)) for owner, name in names]


def _restore_(state: list[tuple[Any, str, Any]]) -> None:
    for owner, name, value in state:
        setattr(owner, name, value)


def fewer_rows_(
    scene: Scene,
    held_out: ReferenceRays,
    probes: Iterable[ReferenceRays],
    far: float,
    limit_db: float,
) -> CapacityChoice:
    """Set the rows of a hash table to 0, which a file does not hold, that matter least.

    A row matters, to first order, by its features times the gradient of everything that is
    decoded. Rows that no probe meets are not judged, and stay.

    Args:
        probes: rays of the training photographs, a batch at a time.
        far: world units from the surface, beyond which rows are not looked at.

    Source: as LeCun et al. 1990, "Optimal Brain Damage", with squared gradients for the Hessian.
    """
    features = scene.field.features
    all_features = features.detach().clone()
    stored_rows = all_features.any(1) & scene.field.rows_near(far)
    squared = torch.zeros_like(all_features)
    judged = torch.zeros_like(stored_rows)
    for probe in probes:
        rows, slope = _row_gradients(scene, probe)
        squared[rows] += slope.square()
        judged[rows] = True
    worth = (squared * all_features.square()).sum(1)
    order = (stored_rows & judged).nonzero()[:, 0]
    order = order[worth[order].argsort()]
    decoded_before = held_out.decoded(scene)
    losses = {0.0: 0.0}

    @torch.no_grad()
    def drop_(share: float) -> None:
        features.copy_(all_features)
        features[order[: round(share * len(order))]] = 0

    def loss_db(share: float) -> float:
        drop_(share)
        losses[share] = held_out.loss_db(decoded_before, held_out.decoded(scene))
        return losses[share]

    share = last_within_limit(DROPPED_ROW_SHARES, loss_db, limit_db)
    drop_(share)
    count = int(stored_rows.sum())
    kept, why = count - round(share * len(order)), f"costs {losses[share]:.3f} dB"
    return CapacityChoice("rows", count, kept, losses[share], why)


def _row_gradients(scene: Scene, probe: ReferenceRays) -> tuple[Tensor, Tensor]:
    """Rows [K] of the features that rays read, and the gradient [K, F] of a random mixture of
    everything that is decoded; its square is on average the sum of all outputs' squares."""
    surface = surface_at(scene, probe.rays)
    outputs = probe.decode(scene, surface, surface.features)
    mixed = [(x * (torch.randint_like(x, 2) * 2 - 1)).sum() for x in outputs]
    (slope,) = torch.autograd.grad(torch.stack(mixed).sum(), scene.field.features)
    slope = slope.coalesce()
    return slope._indices()[0], slope._values()
