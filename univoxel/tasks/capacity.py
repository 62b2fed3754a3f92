"""How much model a scene needs, told by rays that training does not see.

A change is paid for in dB: how much less well the held-out pixels are drawn with it, by the
physically based render and by the radiance head, and how far materials move, as if that were an
error of the same render. The smallest of the candidates that costs less than TOLERANCE is taken.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from typing import TypeVar

import torch
from torch import Tensor, nn

from univoxel.color import linear_to_srgb
from univoxel.config import StageConfig, TrainConfig
from univoxel.fields.hull import fit_grid
from univoxel.lights import LocalSG
from univoxel.records import Rays, Surface
from univoxel.render.pipeline import shade, surface_at
from univoxel.scene import SHELL, Scene
from univoxel.tasks import shrink

Number = TypeVar("Number", int, float)

TOLERANCE = 0.02  # dB that the held-out rays may lose by one kind of saving
SHARES = (1, 7 / 8, 3 / 4, 5 / 8, 1 / 2, 3 / 8, 1 / 4, 1 / 8)  # that are tried, of what there is
WORTH = 0.1  # share of the parameters from which on it is worth the time to make heads smaller
SETTLE_STEPS, SETTLE_RATE = 20, 1e-3  # of Adam, for heads of which something was taken
LESSON = 1024  # rays of the training photographs that they settle on
MET = 0.5  # opacity from which on a ray counts as one that meets the surface
REGAINED = 0.1  # dB likewise, where training goes on with what is left
GRID_TOLERANCE = 0.1  # dB that a rehearsal on a coarser grid may fall short of the best so far
COARSER = 1 / 3  # voxels of a grid over those of the next finer that is tried
MISSES = 2  # grids in a row that fall short, before no coarser one is tried: rehearsals are noisy
FEWEST_VOXELS = 16**3
HEADER = 8192  # bytes of a model's file that hold no numbers
REHEARSAL = 0.1  # share of a stage's steps that a grid is tried for
REACHES = (3.5, 3.0, 2.75, 2.5, 2.25, 2.0, 1.75, 1.5)  # voxels
PROBES = 8  # random mixtures of the outputs whose gradients tell what they depend on


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


class Rehearsal:
    """A few steps through the whole schedule of a stage, off the record; in place of Progress."""

    def __init__(self, steps: int):
        self.step, self._steps = 0, steps

    def steps(self) -> Iterator[float]:
        """Progress through the stage in [0, 1), once a step."""
        for i in range(self._steps):
            yield i / self._steps
            self.step += 1

    def due(self) -> bool:
        return False

    checkpoint_due = due

    def state(self) -> dict:
        return {}

    def report(self, losses: dict[str, float], psnr: float | None) -> None: ...

    def shorten(self) -> None: ...


@dataclass(frozen=True)
class Look:
    """The held-out rays, and what the photographs show there."""

    rays: Rays
    view: Tensor  # [N] int64
    target: Tensor  # [N, 3] sRGB, on black
    radiance: Callable[[Scene, Surface], Tensor]  # [N, 3] sRGB-encoded, of the radiance head

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
        head = self.radiance(scene, surface)
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


@contextmanager
def trial(scene: Scene) -> Iterator[None]:
    """A block whose changes by `shrink` are undone after it."""
    parts = shrink.parts_of(scene)
    try:
        yield
    finally:
        shrink.put_back(parts)


def coarser_grid(
    scene: Scene,
    most: int,
    box: tuple[Tensor, Tensor],
    rehearse: Callable[[Scene], float],
) -> Choice:
    """Bring the field to the coarsest grid that a rehearsal of the next stage draws as well with.

    Takes COARSER of the voxels until MISSES rehearsals in a row, each of which begins from the
    scene as it is, end more than GRID_TOLERANCE below the best. The scene goes on from the
    rehearsal on its grid.

    Args:
        most: voxels of the finest grid.
        box: corners [3], [3].
        rehearse: trains a scene and returns the PSNR of its held-out rays.
    """
    scene.surface_moved()
    chosen, found, voxels, misses = scene, [], most, 0
    while (misses < MISSES and voxels >= FEWEST_VOXELS) or not found:
        tried = copy.deepcopy(scene)
        tried.field = tried.field.resized(fit_grid(*box, voxels))
        quality = rehearse(tried)
        best = max([q for _, q in found], default=quality)
        if quality < best - GRID_TOLERANCE:
            misses += 1
        else:
            chosen, misses = tried, 0
            after, cost = voxels, best - quality
        found.append((voxels, quality))
        voxels = round(COARSER * voxels)
    copy_over(chosen, scene)
    why = "held-out rays after rehearsals: " + ", ".join(f"{v:,} {q:.2f} dB" for v, q in found)
    return Choice("voxels", most, after, cost, why)


def copy_over(source: Scene, target: Scene) -> None:
    """Let target be what source is."""
    target.field, target.inv_s = source.field, source.inv_s
    target.load_state_dict(source.state_dict())
    target.surface_moved()


@torch.no_grad()
def shorter_reach(scene: Scene, look: Look, limit: float = TOLERANCE) -> Choice:
    """How far from the surface a finished scene is stored, in voxels."""
    field = scene.field
    surface = look.meet(scene)
    before = look.decode(scene, surface, surface.features)
    nodes = (field.sdf.detach().abs() / field.voxel_size).flatten()

    def cost(reach: float) -> float:
        near = (nodes < reach).view(field.grid.size)
        sdf, features = field.sdf, field.features
        try:
            field.sdf = nn.Parameter(torch.where(near, sdf, SHELL * field.voxel_size * sdf.sign()))
            field.features = nn.Parameter(features * near[..., None])
            surface = look.meet(scene)
            return look.cost(before, look.decode(scene, surface, surface.features))
        finally:
            field.sdf, field.features = sdf, features

    reach = smallest([SHELL, *REACHES], cost, limit)
    paid = cost(reach)
    kept, all_kept = int((nodes < reach).sum()), int((nodes < SHELL).sum())
    why = f"{kept:,} of {len(nodes):,} nodes are kept instead of {all_kept:,}; costs {paid:.3f} dB"
    return Choice("reach", SHELL, reach, paid, why)


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
                shrink.drop_lobes(scene, torch.tensor([k for k in range(count) if k != gone]))
                costs.append(look.cost(before, look.decode(scene, surface, surface.features)))
    order = torch.tensor(costs).argsort(descending=True)

    def reduce(kept: int) -> None:
        shrink.drop_lobes(scene, order[:kept].sort().values)

    return _spare("lobes", scene, look, lesson, count, reduce, limit)


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
    seen = surface.features[surface.opacity > MET].double()
    centred = seen - seen.mean(0)
    cov = centred.T @ centred / max(len(seen), 1)
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


def fewer_channels(scene: Scene, look: Look, lesson: Look, limit: float) -> Choice:
    """Turn the features to their principal channels and drop those that matter least."""
    basis, worth = channel_basis(scene, look)
    shrink.rotate(scene, basis.float())
    surface = look.meet(scene)
    mean = surface.features[surface.opacity > MET].mean(0)
    worth[0] = torch.inf  # materials keep at least one
    order = worth.argsort(descending=True)

    def reduce(kept: int) -> Tensor:
        keep = order[:kept].sort().values
        shrink.drop_channels(scene, keep, mean)
        return keep

    return _spare("channels", scene, look, lesson, scene.cfg.channels, reduce, limit)


def fewer_units(scene: Scene, look: Look, lesson: Look, limit: float = TOLERANCE) -> Choice:
    """Narrow the hidden layers of all heads."""
    surface = lesson.meet(scene)
    with torch.no_grad(), shrink.reads(scene) as read:
        lesson.decode(scene, surface, surface.features)

    def reduce(units: int) -> None:
        shrink.drop_units(scene, units, read)

    return _spare("hidden units", scene, look, lesson, scene.cfg.hidden, reduce, limit)


def _spare(
    what: str,
    scene: Scene,
    look: Look,
    lesson: Look,
    count: int,
    reduce: Callable[[int], Tensor | None],
    limit: float,
) -> Choice:
    """Reduce something of a scene to the smallest SHARES of `count` that costs at most `limit` dB
    after the heads have settled, where those are worth the time.

    Args:
        lesson: rays of the training photographs, to settle on.
        reduce: does it, by `shrink`; returns the channels it kept where it dropped any.
    """
    surface, taught = look.meet(scene), lesson.meet(scene)
    with torch.no_grad():
        before = look.decode(scene, surface, surface.features)
        wanted = lesson.decode(scene, taught, taught.features)
    settles = share_of_heads(scene) > WORTH
    parts = {count: shrink.parts_of(scene)}
    paid = {count: 0.0}

    def cost(kept: int) -> float:
        with trial(scene):
            keep = reduce(kept)
            here, there = surface.features, taught.features
            if keep is not None:
                here, there = here[:, keep], there[:, keep]
            if settles:
                settle(scene, parts[count], lesson, taught, there, wanted)
            with torch.no_grad():
                paid[kept] = look.cost(before, look.decode(scene, surface, here))
            parts[kept] = shrink.parts_of(scene)
        return paid[kept]

    candidates = sorted({max(1, round(s * count)) for s in SHARES}, reverse=True)
    kept = smallest(candidates, cost, limit)
    shrink.put_back(parts[kept])
    why = f"costs {paid[kept]:.3f} dB"
    if more := [k for k in paid if k < kept]:
        why += f", {max(more)} would cost {paid[max(more)]:.3f} dB"
    return Choice(what, count, kept, paid[kept], why)


def share_of_heads(scene: Scene) -> float:
    """Share of the parameters near the surface and of the heads that the heads have."""
    near = int((scene.field.sdf.detach().abs() < SHELL * scene.field.voxel_size).sum())
    rest = sum(x.numel() for name, x in scene.named_parameters() if not name.startswith("field."))
    return rest / (rest + near * (1 + scene.cfg.channels))


def settle(
    scene: Scene,
    before: shrink.Parts,
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


def adapt(
    scene: Scene,
    cfg: TrainConfig,
    index: int,
    box: tuple[Tensor, Tensor],
    look: Look,
    lesson: Look,
    rehearse: Callable[[Scene, StageConfig, int], float],
    pace: float = 1.0,
) -> list[Choice]:
    """Fit what comes after stage `index` to the scene, in place; what was chosen, in order.

    Args:
        box: corners [3], [3] of the grid.
        look, lesson: held-out rays, and some of those that are trained on.
        rehearse: trains a scene in a stage's manner in so many steps and returns the PSNR of its
            held-out rays.
        pace: share of its steps that time let the last stage make.
    """
    found: list[Choice] = []
    stage, after = cfg.stages[index], cfg.stages[index + 1 :]
    follows = after[0] if after else None
    if isinstance(follows, StageConfig) and not follows.refit:
        most = round(1e6 * follows.voxels)
        steps = max(1, round(REHEARSAL * pace * follows.iterations))
        if cfg.budget_mb:
            most = min(most, affordable(scene, 1e6 * cfg.budget_mb))
        found.append(
            coarser_grid(
                scene,
                most,
                box,
                lambda tried: rehearse(tried, on_grid(follows, box, tried.field.voxel_size), steps),
            )
        )
    if isinstance(stage, StageConfig) and not stage.refit and stage.physical_from < 1:
        found.append(fewer_channels(scene, look, lesson, REGAINED if after else TOLERANCE))
        if share_of_heads(scene) > WORTH:
            if isinstance(scene.light, LocalSG):
                found.append(fewer_lobes(scene, look, lesson))
            found.append(fewer_units(scene, look, lesson))
    if not after:
        found.append(shorter_reach(scene, look))
    return found


def least_bytes(scene: Scene) -> int:
    """What the file of a scene like this cannot go below: its networks and light as they are, and
    a grid of FEWEST_VOXELS, a quarter of it near the surface."""
    return _apart_from_grid(scene) + FEWEST_VOXELS // 4 * _node_bytes(scene)


def bytes_at_most(scene: Scene, reach: float = SHELL) -> int:
    """What the slim file of a scene can grow to, with features at every node within reach."""
    near = int((scene.field.sdf.detach().abs() < reach * scene.field.voxel_size).sum())
    return _apart_from_grid(scene) + near * _node_bytes(scene)


def affordable(scene: Scene, budget: float) -> int:
    """Voxels of the finest grid on which the scene's surface fits into a file of `budget` bytes.

    The nodes near a surface are as many as its area has squares of a voxel's side.
    """
    near = bytes_at_most(scene) - _apart_from_grid(scene)
    room = max(budget - _apart_from_grid(scene), 0.0)
    return max(FEWEST_VOXELS, int(scene.field.grid.nodes_count * (room / near) ** 1.5))


def _node_bytes(scene: Scene) -> int:
    """Of a node near the surface: numbers of its row twice, distance and features in halves."""
    return 4 + 4 + 2 + 2 * scene.cfg.channels


def _apart_from_grid(scene: Scene) -> int:
    rest = (x for name, x in scene.state_dict().items() if not name.startswith("field."))
    return HEADER + sum(x.numel() * x.element_size() for x in rest)


def on_grid(stage: StageConfig, box: tuple[Tensor, Tensor], voxel_size: float) -> StageConfig:
    """A stage with its sharpness, which counts in voxels of its own grid, for those of another.

    Edges stay as sharp in the world as on the finest grid: what a coarse grid cannot say is bends
    of the surface, not the place of an edge.
    """
    own = fit_grid(*box, round(1e6 * stage.voxels)).voxel_size
    begin, end = (s * min(own / voxel_size, 1.0) for s in stage.sharpness)
    return replace(stage, sharpness=(begin, end))


def voxels(stage: StageConfig, chosen: list[dict]) -> int:
    """Of a stage's grid: its own, or fewer where that was chosen."""
    fewer = [round(c["after"]) for c in chosen if c["what"] == "voxels"]
    return min([round(1e6 * stage.voxels), *fewer])


def reach(chosen: list[dict]) -> float | None:
    """What `shorter_reach` chose, if it did."""
    found = [c["after"] for c in chosen if c["what"] == "reach"]
    return found[-1] if found else None
