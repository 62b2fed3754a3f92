"""Fewer channels, rows, lobes, levels and hidden units, while held-out rays do not suffer."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager

import torch
from torch import Tensor, nn

from univoxel.checkpoint import SHELL
from univoxel.compression import prune
from univoxel.compression.quality import TOLERANCE, Choice, Look, smallest
from univoxel.fields.features import NodeFeatures
from univoxel.lights import LocalSG
from univoxel.records import Surface
from univoxel.render.pipeline import surface_at
from univoxel.scene import Scene

SHARES = (1, 7 / 8, 3 / 4, 5 / 8, 1 / 2, 3 / 8, 1 / 4, 1 / 8)  # that are tried, of what there is
WORTH = 0.1  # share of the parameters from which on it is worth the time to make heads smaller
SETTLE_STEPS, SETTLE_RATE = 20, 1e-3  # of Adam, for heads of which something was taken
TABLES = ("field.", "radiance.directions.")  # names of parameters that begin so are no head's
PROBES = 8  # random mixtures of the outputs whose gradients tell what they depend on
# Of the rows of a table, that may go
DROPPED = (0, 1 / 4, 3 / 8, 1 / 2, 5 / 8, 11 / 16, 3 / 4, 13 / 16, 7 / 8, 29 / 32, 15 / 16)


@contextmanager
def trial(scene: Scene) -> Iterator[None]:
    """A block whose changes by `shrink` are undone after it."""
    parts = prune.parts_of(scene)
    try:
        yield
    finally:
        prune.put_back(parts)


def fewer_lobes(scene: Scene, look: Look, lesson: Look, limit: float = TOLERANCE) -> Choice:
    """Drop lobes of a spherical-Gaussian light, those whose going alone costs least first."""
    assert isinstance(scene.light, LocalSG)
    count = scene.light.config.lobes
    surface = look.meet(scene)
    with torch.no_grad():
        before = look.decode(scene, surface, surface.features)
        costs = []
        for gone in range(count if count > 1 else 0):
            with trial(scene):
                prune.drop_lobes(scene, torch.tensor([k for k in range(count) if k != gone]))
                costs.append(look.cost(before, look.decode(scene, surface, surface.features)))
    order = torch.tensor(costs).argsort(descending=True)

    def reduce(kept: int) -> None:
        prune.drop_lobes(scene, order[:kept].sort().values)

    return _spare("lobes", scene, look, lesson, shares(count), reduce, limit)


def channel_basis(scene: Scene, look: Look) -> tuple[Tensor, Tensor]:
    """A basis [C, C] of the features whose channels matter in turn, and how much each does [C].

    What matters is a channel's variance over the surface times the squared gradient of everything
    that is decoded: within the material channels, and within the others, the eigenvectors of one
    in the metric of the other. Every new channel has the group's mean scale, that the optimiser's
    rates fit.
    """
    surface = look.meet(scene)
    features = surface.features.clone().requires_grad_()
    outputs = look.decode(scene, surface, features)
    gram = torch.zeros(features.shape[1], features.shape[1], dtype=torch.float64)
    generator = torch.Generator().manual_seed(0)
    for _ in range(PROBES):
        mixed = [
            (x * (torch.randint(0, 2, x.shape, generator=generator) * 2 - 1)).sum()
            for x in outputs.values()
        ]
        (slope,) = torch.autograd.grad(torch.stack(mixed).sum(), features, retain_graph=True)
        gram += slope.double().T @ slope.double() / (PROBES * len(slope))
    weight = surface.opacity.double()[:, None] / surface.opacity.sum().clamp_min(1e-6)
    centred = surface.features.double() - mean_features(surface)
    cov = centred.T @ (weight * centred)
    m, c = scene.material.channels, scene.cfg.channels
    basis, worth = torch.zeros(c, c, dtype=torch.float64), torch.zeros(c, dtype=torch.float64)
    for part in (slice(0, m), slice(m, c)):
        g, v = gram[part, part], cov[part, part]
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
        basis[part, part], worth[part] = new * scale, value
    return basis, worth


def mean_features(surface: Surface) -> Tensor:
    """Mean [C] of the features, weighted by opacity."""
    weight = surface.opacity / surface.opacity.sum().clamp_min(1e-6)
    return weight @ surface.features


def fewer_channels(scene: Scene, look: Look, lesson: Look, limit: float) -> Choice:
    """Turn the features to their principal channels and drop those that matter least."""
    basis, worth = channel_basis(scene, look)
    prune.rotate(scene, basis.float())
    surface = look.meet(scene)
    mean = mean_features(surface)
    worth[0] = torch.inf  # materials keep at least one
    order = worth.argsort(descending=True)

    def reduce(kept: int) -> Tensor:
        keep = order[:kept].sort().values
        prune.drop_channels(scene, keep, mean)
        return keep

    return _spare("channels", scene, look, lesson, shares(scene.cfg.channels), reduce, limit)


def fewer_rows(
    scene: Scene, look: Look, probes: Iterable[Look], far: float, limit: float = TOLERANCE
) -> Choice:
    """Let rows of a hash table be 0, which a file does not hold: those first that say least.

    What a row says is, to first order, its features times the gradient of everything that is
    decoded. Rows that no probe meets are not judged, and stay.

    Args:
        probes: rays of the training photographs, some at a time.
        far: world units from the surface, beyond which rows are not looked at.

    Source: as LeCun et al. 1990, "Optimal Brain Damage", with squared gradients for the Hessian.
    """
    features = scene.field.features
    before_them = features.detach().clone()
    there = before_them.any(1) & scene.field.rows_near(far)
    squared = torch.zeros_like(before_them)
    met = torch.zeros_like(there)
    for probe in probes:
        rows, slope = _slopes(scene, probe)
        squared[rows] += slope.square()
        met[rows] = True
    said = (squared * before_them.square()).sum(1)
    order = (there & met).nonzero()[:, 0]
    order = order[said[order].argsort()]
    with torch.no_grad():
        before = look.decode(scene, surface := look.meet(scene), surface.features)
    paid = {0.0: 0.0}

    @torch.no_grad()
    def drop(share: float) -> None:
        features.copy_(before_them)
        features[order[: round(share * len(order))]] = 0

    def cost(share: float) -> float:
        drop(share)
        with torch.no_grad():
            surface = look.meet(scene)
            paid[share] = look.cost(before, look.decode(scene, surface, surface.features))
        return paid[share]

    share = smallest(DROPPED, cost, limit)
    drop(share)
    count = int(there.sum())
    kept, why = count - round(share * len(order)), f"costs {paid[share]:.3f} dB"
    return Choice("rows", count, kept, paid[share], why)


def _slopes(scene: Scene, probe: Look) -> tuple[Tensor, Tensor]:
    """Rows [K] of the features that rays read, and the gradient [K, F] of a random mixture of
    everything that is decoded; its square is on average the sum of all outputs' squares."""
    surface = surface_at(scene, probe.rays)
    outputs = probe.decode(scene, surface, surface.features)
    mixed = [(x * (torch.randint_like(x, 2) * 2 - 1)).sum() for x in outputs.values()]
    (slope,) = torch.autograd.grad(torch.stack(mixed).sum(), scene.field.features)
    slope = slope.coalesce()
    return slope._indices()[0], slope._values()


def fewer_mirror_levels(scene: Scene, look: Look, lesson: Look, limit: float = TOLERANCE) -> Choice:
    """Drop the finest levels of the table of mirrored directions."""

    def reduce(levels: int) -> None:
        prune.drop_mirror_levels(scene, levels)

    candidates = range(scene.cfg.mirror_levels, -1, -1)
    return _spare("mirror levels", scene, look, lesson, candidates, reduce, limit)


def fewer_units(scene: Scene, look: Look, lesson: Look, limit: float = TOLERANCE) -> Choice:
    """Narrow the hidden layers of all heads."""
    surface = lesson.meet(scene)
    with torch.no_grad(), prune.reads(scene) as read:
        lesson.decode(scene, surface, surface.features)

    def reduce(units: int) -> None:
        prune.drop_units(scene, units, read)

    return _spare("hidden units", scene, look, lesson, shares(scene.cfg.hidden), reduce, limit)


def shares(count: int) -> list[int]:
    """SHARES of a number, from the number itself down to 1 at least."""
    return sorted({max(1, round(s * count)) for s in SHARES}, reverse=True)


def _spare(
    what: str,
    scene: Scene,
    look: Look,
    lesson: Look,
    candidates: Sequence[int],
    reduce: Callable[[int], Tensor | None],
    limit: float,
) -> Choice:
    """Reduce something of a scene to the smallest number that costs at most `limit` dB after the
    heads have settled, where those are worth the time.

    Args:
        candidates: numbers that fall from what there is.
        lesson: rays of the training photographs, to settle on.
        reduce: does it, by `shrink`; returns the channels it kept where it dropped any.
    """
    surface, taught = look.meet(scene), lesson.meet(scene)
    with torch.no_grad():
        before = look.decode(scene, surface, surface.features)
        wanted = lesson.decode(scene, taught, taught.features)
    settles = share_of_heads(scene) > WORTH
    count = candidates[0]
    parts = {count: prune.parts_of(scene)}
    paid = {count: 0.0}

    def cost(kept: int) -> float:
        with trial(scene):
            keep = reduce(kept)
            here, there = surface.features, taught.features
            if keep is not None:
                here, there = here[:, keep], there[:, keep]
            with torch.no_grad():
                paid[kept] = look.cost(before, look.decode(scene, surface, here))
            if paid[kept] > limit and settles:
                settle(scene, parts[count], lesson, taught, there, wanted)
                with torch.no_grad():
                    paid[kept] = look.cost(before, look.decode(scene, surface, here))
            parts[kept] = prune.parts_of(scene)
        return paid[kept]

    kept = smallest(candidates, cost, limit)
    prune.put_back(parts[kept])
    why = f"costs {paid[kept]:.3f} dB"
    if more := [k for k in paid if k < kept]:
        why += f", {max(more)} would cost {paid[max(more)]:.3f} dB"
    return Choice(what, count, kept, paid[kept], why)


def share_of_heads(scene: Scene) -> float:
    """Share of the parameters near the surface and of the heads that the heads have."""
    rest = sum(x.numel() for name, x in scene.named_parameters() if not name.startswith(TABLES))
    near = nodes_near(scene)
    features = near * scene.cfg.channels
    if not isinstance(scene.field.encoding, NodeFeatures):
        features = scene.field.features.shape[1] * int(scene.field.features.detach().any(1).sum())
    return rest / (rest + near + features)


def nodes_near(scene: Scene) -> int:
    """Nodes of the grid within SHELL voxels of the surface."""
    return int((scene.field.sdf.detach().abs() < SHELL * scene.field.voxel_size).sum())


def settle(
    scene: Scene,
    before: prune.Parts,
    lesson: Look,
    surface: Surface,
    features: Tensor,
    wanted: dict[str, Tensor],
) -> None:
    """Teach the networks that were replaced since `before` to say what was said before them.

    Args:
        surface, features: what the rays of the lesson meet, and its features as they are now.
        wanted: what was decoded there.
    """
    parameters: list[Tensor] = []
    for owner, name, value in before.held:
        now = getattr(owner, name)
        if now is not value and isinstance(now, nn.Module):
            parameters += now.parameters()
    optimizer = torch.optim.Adam(parameters, lr=SETTLE_RATE)
    for k in range(SETTLE_STEPS):
        optimizer.param_groups[0]["lr"] = SETTLE_RATE * (1 - k / SETTLE_STEPS)
        said = lesson.decode(scene, surface, features)
        loss = torch.stack([(said[n] - wanted[n]).square().mean() for n in wanted]).sum()
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        optimizer.step()
