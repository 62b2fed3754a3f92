"""Fewer channels, rows, lobes, levels and hidden units, while held-out rays do not suffer."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import torch
from torch import Tensor

from univoxel.compression import prune
from univoxel.compression.choices import CapacityChoice, Kind
from univoxel.compression.config import CompressionConfig
from univoxel.compression.quality import Decoded, ReferenceRays, last_within_limit
from univoxel.compression.sizes import head_share
from univoxel.lights import LocalSG
from univoxel.records import Surface
from univoxel.render.pipeline import surface_at
from univoxel.scene import Scene


@dataclass(frozen=True)
class Criterion:
    """What decides how small the networks of a scene may be."""

    held_out: ReferenceRays  # they judge
    calibration: ReferenceRays  # of the training photographs: smaller networks settle on them
    limit_db: float  # that one kind of saving may cost
    cfg: CompressionConfig


@dataclass(frozen=True)
class Baseline:
    """What a scene gave along rays before it was made smaller."""

    rays: ReferenceRays
    surface: Surface
    decoded: Decoded

    @staticmethod
    def of(scene: Scene, rays: ReferenceRays) -> Baseline:
        surface = rays.surface(scene)
        with torch.no_grad():
            return Baseline(rays, surface, rays.decode(scene, surface, surface.features))

    def decode(self, scene: Scene, channels: Tensor | None) -> Decoded:
        """What the smaller scene's networks make of the same features.

        Args:
            channels: those that it has left [K]; None: all.
        """
        features = self.surface.features
        if channels is not None:
            features = features[:, channels]
        return self.rays.decode(scene, self.surface, features)

    @torch.no_grad()
    def loss_db(self, scene: Scene, channels: Tensor | None = None) -> float:
        """Quality that the smaller scene has lost."""
        return self.rays.loss_db(self.decoded, self.decode(scene, channels))


@contextmanager
def trial(scene: Scene) -> Iterator[None]:
    """A block whose changes by `prune` are undone after it."""
    before = prune.snapshot(scene)
    try:
        yield
    finally:
        prune.restore_(before)


def fewer_lobes_(scene: Scene, criterion: Criterion) -> CapacityChoice:
    """Drop lobes of a spherical-Gaussian light, those whose going alone costs least first."""
    assert isinstance(scene.light, LocalSG)
    count = scene.light.config.lobes
    baseline = Baseline.of(scene, criterion.held_out)
    losses = []
    for lobe in range(count if count > 1 else 0):
        with trial(scene), torch.no_grad():
            prune.drop_lobes_(scene, torch.tensor([k for k in range(count) if k != lobe]))
            losses.append(baseline.loss_db(scene))
    order = torch.tensor(losses).argsort(descending=True)

    def reduce_(kept: int) -> None:
        prune.drop_lobes_(scene, order[:kept].sort().values)

    return _reduce_(scene, "lobes", sizes_to_try(count, criterion.cfg), reduce_, criterion)


def channel_basis(scene: Scene, rays: ReferenceRays, probes: int) -> tuple[Tensor, Tensor]:
    """A basis [C, C] of the features whose channels matter in turn, and how much each does [C].

    What matters is a channel's variance over the surface times the squared gradient of everything
    that is decoded: within the material channels, and within the others, the eigenvectors of one
    in the metric of the other. Every new channel has the group's mean scale, that the optimiser's
    rates fit.

    Args:
        probes: random mixtures of the outputs whose gradients are averaged.
    """
    surface = rays.surface(scene)
    gram = _mean_squared_gradient(scene, rays, surface, probes)
    weight = surface.opacity.double()[:, None] / surface.opacity.sum().clamp_min(1e-6)
    centred = surface.features.double() - mean_features(surface)
    covariance = centred.T @ (weight * centred)
    m, c = scene.material.channels, scene.cfg.channels
    basis, worth = torch.zeros(c, c, dtype=torch.float64), torch.zeros(c, dtype=torch.float64)
    for group in (slice(0, m), slice(m, c)):
        g, v = gram[group, group], covariance[group, group]
        if not len(g):
            continue
        floor = 1e-4 * g.diagonal().mean().clamp_min(1e-20)
        metric = torch.linalg.cholesky(g + floor * torch.eye(len(g), dtype=torch.float64))
        value, vector = torch.linalg.eigh(metric.T @ v @ metric)
        value, vector = value.flip(0).clamp_min(0), vector.flip(1)
        new = metric @ vector
        scale = v.diagonal().mean().sqrt() / (new * (v @ new)).sum(0).clamp_min(1e-30).sqrt()
        # A channel that is the same everywhere keeps the length of a unit vector
        scale = torch.where(value > 1e-12 * value[0], scale, 1 / new.norm(dim=0))
        basis[group, group], worth[group] = new * scale, value
    return basis, worth


def _mean_squared_gradient(
    scene: Scene, rays: ReferenceRays, surface: Surface, probes: int
) -> Tensor:
    """E[J^T J] [C, C], float64, of the gradient J of everything that is decoded from features."""
    features = surface.features.clone().requires_grad_()
    outputs = rays.decode(scene, surface, features)
    gram = torch.zeros(features.shape[1], features.shape[1], dtype=torch.float64)
    generator = torch.Generator().manual_seed(0)
    for _ in range(probes):
        mixed = [
            (x * (torch.randint(0, 2, x.shape, generator=generator) * 2 - 1)).sum() for x in outputs
        ]
        (slope,) = torch.autograd.grad(torch.stack(mixed).sum(), features, retain_graph=True)
        gram += slope.double().T @ slope.double() / (probes * len(slope))
    return gram


def mean_features(surface: Surface) -> Tensor:
    """Mean [C] of the features, weighted by opacity."""
    weight = surface.opacity / surface.opacity.sum().clamp_min(1e-6)
    return weight @ surface.features


def fewer_channels_(scene: Scene, criterion: Criterion) -> CapacityChoice:
    """Turn the features to their principal channels and drop those that matter least."""
    basis, worth = channel_basis(scene, criterion.held_out, criterion.cfg.channel_probes)
    prune.rotate_(scene, basis.float())
    mean = mean_features(criterion.held_out.surface(scene))
    worth[0] = torch.inf  # materials keep at least one
    order = worth.argsort(descending=True)

    def reduce_(kept: int) -> Tensor:
        keep = order[:kept].sort().values
        prune.drop_channels_(scene, keep, mean)
        return keep

    sizes = sizes_to_try(scene.cfg.channels, criterion.cfg)
    return _reduce_(scene, "channels", sizes, reduce_, criterion)


def fewer_mirror_levels_(scene: Scene, criterion: Criterion) -> CapacityChoice:
    """Drop the finest levels of the table of mirrored directions."""

    def reduce_(levels: int) -> None:
        prune.drop_mirror_levels_(scene, levels)

    sizes = range(scene.cfg.mirror_levels, -1, -1)
    return _reduce_(scene, "mirror levels", sizes, reduce_, criterion)


def fewer_units_(scene: Scene, criterion: Criterion) -> CapacityChoice:
    """Narrow the hidden layers of all heads."""
    with prune.recorded_inputs(scene) as inputs:
        criterion.calibration.decoded(scene)

    def reduce_(units: int) -> None:
        prune.drop_units_(scene, units, inputs, criterion.cfg.ridge)

    sizes = sizes_to_try(scene.cfg.hidden, criterion.cfg)
    return _reduce_(scene, "hidden units", sizes, reduce_, criterion)


def fewer_rows_(
    scene: Scene,
    held_out: ReferenceRays,
    probes: Iterable[ReferenceRays],
    far: float,
    limit_db: float,
    shares: Sequence[float],
) -> CapacityChoice:
    """Set the rows of a hash table to 0, which a file does not hold, that matter least.

    A row matters, to first order, by its features times the gradient of everything that is
    decoded. Rows that no probe meets are not judged, and stay.

    Args:
        probes: rays of the training photographs, a batch at a time.
        far: world units from the surface, beyond which rows are not looked at.
        shares: of the rows that are dropped on trial, from 0 rising.

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

    share = last_within_limit(shares, loss_db, limit_db)
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


def sizes_to_try(count: int, cfg: CompressionConfig) -> list[int]:
    """Shares of a number, from the number itself down to 1 at least."""
    return sorted({max(1, round(share * count)) for share in cfg.size_shares}, reverse=True)


def _reduce_(
    scene: Scene,
    kind: Kind,
    sizes: Sequence[int],
    reduce_: Callable[[int], Tensor | None],
    criterion: Criterion,
) -> CapacityChoice:
    """Reduce one kind of a scene's sizes to the smallest that costs at most the criterion's limit.

    Where networks are worth the time, they settle before a size is given up.

    Args:
        sizes: falling, from the present one.
        reduce_: brings the scene to a size, by `prune`; returns the channels that it kept where it
            dropped any.
    """
    baseline = Baseline.of(scene, criterion.held_out)
    calibration = Baseline.of(scene, criterion.calibration)
    settles = head_share(scene) > criterion.cfg.least_head_share
    limit = criterion.limit_db
    full_size = sizes[0]
    snapshots = {full_size: prune.snapshot(scene)}
    losses = {full_size: 0.0}

    def loss_db(size: int) -> float:
        with trial(scene):
            channels = reduce_(size)
            losses[size] = baseline.loss_db(scene, channels)
            if losses[size] > limit and settles:
                _settle_(scene, snapshots[full_size], calibration, channels, criterion.cfg)
                losses[size] = baseline.loss_db(scene, channels)
            snapshots[size] = prune.snapshot(scene)
        return losses[size]

    size = last_within_limit(sizes, loss_db, limit)
    prune.restore_(snapshots[size])
    why = f"costs {losses[size]:.3f} dB"
    if smaller := [k for k in losses if k < size]:
        why += f", {max(smaller)} would cost {losses[max(smaller)]:.3f} dB"
    return CapacityChoice(kind, full_size, size, losses[size], why)


def _settle_(
    scene: Scene,
    snapshot: prune.Snapshot,
    calibration: Baseline,
    channels: Tensor | None,
    cfg: CompressionConfig,
) -> None:
    """Train the networks that were replaced since a snapshot to give what was decoded before.

    Args:
        calibration: what the scene gave then along the calibration rays.
        channels: those that features have left [K]; None: all.
    """
    parameters = [p for network in prune.replaced_networks(snapshot) for p in network.parameters()]
    optimizer = torch.optim.Adam(parameters, lr=cfg.settle_rate)
    for k in range(cfg.settle_steps):
        optimizer.param_groups[0]["lr"] = cfg.settle_rate * (1 - k / cfg.settle_steps)
        decoded = calibration.decode(scene, channels)
        errors = [
            (x - target).square().mean()
            for x, target in zip(decoded, calibration.decoded, strict=True)
        ]
        loss = torch.stack(errors).sum()
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        optimizer.step()
