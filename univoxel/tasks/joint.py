"""One environment map, albedo and roughness from the photographs, with traced visibility.

Local lobes explain every photograph and leave shadows in the albedo. Once geometry stands, the
light is known to be one distant map that reaches a point where nothing is in the way, and what is
in the way shines as bright as the photographs show it. That leaves few unknowns: rounds of Adam on
map and materials alternate with Gauss-Newton steps on the map.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from univoxel import brdf, losses
from univoxel.config import JointConfig
from univoxel.data import Photos
from univoxel.lights import priors
from univoxel.ops import shade_map
from univoxel.optim import RowAdam
from univoxel.render.pipeline import extract_mesh
from univoxel.render.transport import (
    Observations,
    Transport,
    mean_colors,
    observe,
    surface_points,
    trace,
)
from univoxel.scene import Scene
from univoxel.tasks.equations import (
    CLIPPED,
    Rows,
    graph_laplacian,
    normal_equations,
    solve_damped,
    view_differences,
    view_equations,
)
from univoxel.tasks.guard import Guard
from univoxel.tasks.progress import Progress

NEWTON_CHUNK = 256  # points whose equations are built at once
WEIGHTS_PRIOR = 10.0  # on changes of a view's map, in units of the Laplacian's weight
METAL = 0.2  # metallic from which on a point is taken for metal
NEWTON_COST = 2.7  # of a sighting in a Newton step, over one in a step of Adam; measured
UNSOLVABLE = "the equations for the map have no solution: it stays as it is in this round"
LEAST_CHUNKS, LEAST_POINTS = 2, 2000  # on a machine however slow
LEAST_VIEWS = 2  # of a point in a Newton round


@dataclass(frozen=True)
class Problem:
    """Everything about the photographs and the geometry that stays fixed."""

    seen: Observations
    transport: Transport
    target: Tensor  # [S, 3] sRGB-encoded sightings
    metal: Tensor  # [P] bool, what the stages before took for metal; no other point can become it
    voxel_size: float

    @property
    def solid_angle(self) -> float:
        return 4 * math.pi / len(self.transport.direction)


@torch.no_grad()
def pose(scene: Scene, photos: Photos, cfg: JointConfig, seed: int) -> Problem:
    """Sample the surface, gather its sightings and trace what light can reach it.

    Raises:
        ValueError: there is no surface, or no photograph sees it.
    """
    generator = torch.Generator().manual_seed(seed)
    mesh = extract_mesh(scene)
    assert mesh.normals is not None
    assert scene.sky is not None
    tracer = scene.occluder()
    offset = scene.field.voxel_size
    bright = mean_colors(
        unexposed(scene, observe(mesh.vertices, mesh.normals, photos, tracer, offset))
    )
    position, normal = surface_points(mesh, cfg.points, generator)
    seen = observe(position, normal, photos, tracer, offset)
    if not len(seen.view):
        raise ValueError("no photograph sees a point of the surface")
    direction = scene.sky.direction
    transport = trace(seen, tracer, mesh, bright, direction, cfg.tracing, offset, generator)
    metal = scene.material(scene.field.features_at(position))[2] > METAL
    return Problem(seen, transport, losses.encode(seen.color), metal, offset)


def unexposed(scene: Scene, seen: Observations) -> Observations:
    """The same as one exposure would have it, as far as the scene knows the photographs'."""
    return replace(seen, color=seen.color / scene.exposed(torch.ones_like(seen.color), seen.view))


def draw(problem: Problem, points: int, views: int) -> tuple[Tensor, Tensor]:
    """Random points that are seen, and random sightings of each: indices [points * views]."""
    counts = problem.seen.offsets.diff()
    usable = (counts > 0).nonzero()[:, 0]
    point = usable[torch.randint(len(usable), (points,))]
    which = (torch.rand(points, views) * counts[point][:, None]).long()
    sighting = problem.seen.offsets[point][:, None] + which
    return point.repeat_interleave(views), sighting.reshape(-1)


def solve(scene: Scene, photos: Photos, cfg: JointConfig, seed: int, progress: Progress) -> None:
    """Fit scene.sky and the materials to the photographs; geometry and other heads stay."""
    assert scene.sky is not None
    if progress.over:
        progress.skip()
        return
    # What does not fit is cut alike: points here, steps of Adam by `steps`, points of Newton below
    points = min(cfg.points, max(LEAST_POINTS, round(progress.pace * cfg.points)))
    try:
        scene.occluder()
        problem = pose(scene, photos, replace(cfg, points=points), seed)
    except ValueError as error:  # no surface, or none that is seen
        progress.trouble(f"stage {progress.stage + 1}: {error}: light and materials stay")
        progress.skip()
        return
    first, turn, more = 0.0, -1.0, cfg.rounds  # begin and end of a round, rounds to come
    guard = Guard(progress)
    for done in progress.steps(newton_share(cfg)):
        if done >= turn:
            if more < cfg.rounds:
                with progress.apart():
                    seconds = progress.reserved / more
                    newton_round(scene, problem, cfg, seconds, progress.trouble)
                more = 1 + progress.room_for(more - 1)  # on a slow machine fewer and longer rounds
            groups = [
                {"params": [scene.field.features], "eps": 1e-8},
                {"params": list(scene.material.parameters())},
                {"params": [scene.sky.log_radiance]},
            ]
            if scene.views:
                groups.append({"params": [scene.views.gain_steps]})
                if scene.views.sky_weights is not None:
                    groups[2]["params"] += [scene.views.sky_weights, scene.views.sky_basis]
            optimizer = RowAdam(groups, betas=(0.9, 0.99))
            guard.follow(optimizer)
            first, turn, more = done, done + (1 - done) / more, more - 1
        fade = 0.1 ** ((done - first) / (turn - first))
        # After a Newton round light is better than what Adam would make of it while the albedo
        # follows: the map moves slowly, gains do not
        of_map, of_gains = (1.0, 1.0) if more == cfg.rounds - 1 else (0.1, 0.0)
        rates = (cfg.lr_features, cfg.lr_networks, cfg.lr_map * of_map, cfg.lr_networks * of_gains)
        for group, rate in zip(optimizer.param_groups, rates, strict=False):
            group["lr"] = rate * fade * guard.scale
        terms = objective(scene, problem, cfg)
        loss = torch.stack(list(terms.values())).sum()
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        if not guard.sound(loss):
            continue
        optimizer.step()
        if progress.due():
            progress.report({k: v.item() for k, v in terms.items()}, None)
            guard.keep()


def newton_share(cfg: JointConfig) -> float:
    """Share of the stage's time that Newton rounds take if nothing is cut."""
    sightings = cfg.newton_points * cfg.newton_views * cfg.newton_steps * (cfg.rounds - 1)
    newton = NEWTON_COST * sightings
    return newton / (newton + cfg.iterations * cfg.rays)


def objective(scene: Scene, problem: Problem, cfg: JointConfig) -> dict[str, Tensor]:
    """The weighted losses of a random batch of sightings."""
    seen, transport = problem.seen, problem.transport
    index, sighting = draw(problem, cfg.rays // cfg.views, cfg.views)
    points = index[:: cfg.views]
    position = seen.position[points]
    beside = position + 2 * problem.voxel_size * torch.randn_like(position)
    # One sampling, one gradient: adding up sparse ones costs more than either
    features = scene.field.features_at(torch.cat([position, beside]))
    parts = (x.chunk(2) for x in scene.material(features))
    (albedo, albedo_near), (roughness, roughness_near), (metallic, _) = parts
    diffuse, f0 = brdf.split(albedo, metallic * problem.metal[points])
    assert isinstance(f0, Tensor)
    repeat = torch.arange(len(points)).repeat_interleave(cfg.views)
    roughness_shown = widened(roughness, len(transport.direction))
    shown = diffuse[repeat], roughness_shown[repeat], f0[repeat]
    rgb = draw_sightings(scene, problem, index, sighting, *shown)
    encoded, target = losses.encode(rgb), problem.target[sighting]
    return {
        "joint": losses.photometric(encoded, target, clipped=CLIPPED),
        "albedo": cfg.albedo_smoothness * priors.smoothness(albedo, albedo_near),
        "roughness": cfg.roughness_smoothness * priors.smoothness(roughness, roughness_near),
        "metallic": cfg.metallic * metallic.mean(),
    }


def draw_sightings(
    scene: Scene,
    problem: Problem,
    point: Tensor,
    sighting: Tensor,
    diffuse: Tensor,
    roughness: Tensor,
    f0: Tensor,
) -> Tensor:
    """What the map makes of sightings [N] of points [N], each in its photograph's light: [N, 3].

    Args:
        diffuse, roughness, f0: of the points, [N, 3], [N] and [N, 3].
    """
    seen, transport, sky = problem.seen, problem.transport, scene.sky
    assert sky is not None
    view = seen.view[sighting]
    change = scene.views.sky_change() if scene.views else None
    if change is None:
        order, parts, maps = None, (slice(None),), [sky.radiance]
    else:  # a map for each view
        order = torch.argsort(view)
        parts = order.split(torch.bincount(view, minlength=len(change)).tolist())
        maps = (sky.log_radiance + change).exp().unbind()
    rgb = torch.cat(
        [
            shade_map(
                map,
                transport.open,
                transport.indirect,
                point[part],
                seen.normal[point[part]],
                seen.wo[sighting[part]],
                diffuse[part],
                roughness[part],
                transport.direction,
                problem.solid_angle,
                f0[part],
            )
            for part, map in zip(parts, maps, strict=True)
        ]
    )
    if order is not None:
        rgb = rgb[torch.argsort(order)]
    return scene.exposed(rgb, view)


@torch.no_grad()
def newton_round(
    scene: Scene,
    problem: Problem,
    cfg: JointConfig,
    seconds: float = math.inf,
    tell: Callable[[str], None] = print,
) -> list[float]:
    """Gauss-Newton steps on the log map, with the albedo of every point eliminated.

    The normal equations for log map and log albedo of the points are block diagonal in the albedo;
    its Schur complement is D x D. What then speaks for the map is only what no albedo can explain:
    how a point's brightness changes from view to view, and with it the absolute scale, from
    highlights of known reflectance. Residuals are in sRGB-encoded colour with Cauchy weights; a
    graph Laplacian keeps the log map smooth. Where light varies, the views' log gains are solved
    for together with the map, and before that, with the map as it is, what each view's map has of
    its own. Returns the mean weighted squared residual before each step.

    Args:
        seconds: wall time that it may take, about: fewer points serve where all would take more.
        tell: called with a sentence where the equations have no solution; then the round is over.
    """
    begin = time.monotonic()
    seen, sky = problem.seen, scene.sky
    assert sky is not None
    counts = seen.offsets.diff()
    # Points that are seen as often as usual: of few photographs that is less than is wanted. In one
    # view the albedo explains everything; a metal has no albedo to eliminate
    usual = float(counts[counts > 0].float().median())
    least = max(LEAST_VIEWS, min(cfg.newton_views // 2, usual))
    rich = ((counts >= least) & ~problem.metal).nonzero()[:, 0]
    chosen = rich[torch.randperm(len(rich))[: cfg.newton_points]]
    if not len(chosen):
        return []
    albedo, roughness, _ = scene.material(scene.field.features_at(seen.position[chosen]))
    log_albedo = albedo.clamp_min(1e-3).log()
    which = (torch.rand(len(chosen), cfg.newton_views) * counts[chosen][:, None]).long()
    sighting = seen.offsets[chosen][:, None] + which
    parts = torch.arange(len(chosen)).split(NEWTON_CHUNK)
    roughness = widened(roughness, len(sky.direction))
    rows, spent = [], 0.0  # on the equations of one part
    for k in parts:
        rows.append(light_rows(problem, chosen[k], sighting[k], roughness[k]))
        if len(rows) == 1 and seconds < math.inf:
            before = time.monotonic()
            normal_equations(rows[0], sky.radiance, log_albedo[k])
            spent = time.monotonic() - before
        so_far = time.monotonic() - begin
        if len(rows) >= LEAST_CHUNKS and so_far + cfg.newton_steps * len(rows) * spent > seconds:
            break
    parts = parts[: len(rows)]
    count = sum(map(len, parts))
    sighting, log_albedo = sighting[:count], log_albedo[:count]
    smooth = cfg.newton_smooth * graph_laplacian(sky.direction)
    unknowns = len(smooth) + (len(scene.views) if scene.views else 0)
    smooth = torch.nn.functional.pad(smooth, 2 * (0, unknowns - len(smooth)))
    costs = []
    for _ in range(cfg.newton_steps):
        differs = view_differences(scene)
        if differs is not None and differs.basis is not None:
            hessian = slope = torch.zeros(())
            for r, k in zip(rows, parts, strict=True):
                h, g = view_equations(r, sky.radiance, log_albedo[k], differs)
                hessian, slope = hessian + h / sighting.numel(), slope + g / sighting.numel()
            if not views_step(scene, hessian, slope, cfg.newton_smooth):
                tell(UNSOLVABLE)
                break
            differs = view_differences(scene)
        x = sky.log_radiance.T  # [3, D]
        x = torch.nn.functional.pad(x, (0, unknowns - x.shape[1]))  # no gain is likelier than 1
        system, right, ties = smooth, -x @ smooth, []
        for r, k in zip(rows, parts, strict=True):  # added up at once: all would take much memory
            h, g, tie = normal_equations(r, sky.radiance, log_albedo[k], differs)
            system, right = system + h / sighting.numel(), right + g / sighting.numel()
            ties.append(tie)
        system.diagonal(dim1=1, dim2=2).add_(cfg.newton_smooth)
        step = solve_damped(system, right)
        if step is None:
            tell(UNSOLVABLE)
            break
        step = step.clamp(-1, 1)
        to_map, to_gain = step.split([len(sky.direction), unknowns - len(sky.direction)], 1)
        sky.log_radiance.add_(to_map.T)
        if scene.views is not None:
            sky.log_radiance.add_(scene.views.add(to_gain.T))
        change = [(t.own - torch.einsum("cpd,cd->cp", t.cross, step)) / t.norm for t in ties]
        log_albedo = (log_albedo + torch.cat(change, 1).T.clamp(-0.5, 0.5)).clamp(-7.0, 0.0)
        costs.append(sum(t.cost for t in ties) / sighting.numel())
    return costs


def views_step(scene: Scene, hessian: Tensor, gradient: Tensor, smooth: float) -> bool:
    """Gauss-Newton step of each view's gain and change of the map; False: there is none.

    Args:
        hessian, gradient: [3, B, R + 1, R + 1] and [3, B, R + 1] from `view_equations`, over the
            number of sightings.
    """
    views, sky = scene.views, scene.sky
    assert views is not None
    assert sky is not None
    assert views.sky_weights is not None
    now = views.sky_weights - views.sky_weights.mean(0)  # [B, R, 3]
    now = torch.nn.functional.pad(now.permute(2, 0, 1), (0, 1))
    prior = WEIGHTS_PRIOR * smooth
    hessian.diagonal(dim1=2, dim2=3).add_(prior)
    step = solve_damped(hessian, gradient - prior * now)
    if step is None:
        return False
    step = step.clamp(-1, 1).permute(1, 2, 0)
    sky.log_radiance.add_(views.add(step[:, -1], step[:, :-1]))
    return True


def light_rows(problem: Problem, point: Tensor, sighting: Tensor, roughness: Tensor) -> Rows:
    """Rows for points [P], sightings [P, V] and roughness [P]."""
    transport, seen = problem.transport, problem.seen
    normal, wo = seen.normal[point][:, None], seen.wo[sighting]
    cosine = (normal @ transport.direction.T).clamp_min(0) * problem.solid_angle  # [P, 1, D]
    through = 1 - brdf.specular_albedo((normal * wo).sum(2), roughness[:, None])
    shine = cosine * brdf.specular(
        normal[:, :, None], wo[:, :, None], transport.direction, roughness[:, None, None]
    )
    share = transport.open[point].float()[:, None] / 255
    blocked = transport.indirect[point].float()  # [P, D, 3]
    through = through / math.pi
    return Rows(
        (cosine * share)[:, 0],
        through,
        shine * share,
        through[..., None] * (cosine @ blocked),
        shine @ blocked,
        problem.target[sighting],
        seen.view[sighting],
    )


def widened(roughness: Tensor, nodes: int) -> Tensor:
    """Roughness whose lobe covers the gap between the map's nodes.

    A node stands for 4 pi / D steradians of sky; between point lights a narrow highlight would be
    missed. Its share of sky, as seen in the half vector, has a variance of about 1 / D in GGX's
    alpha^2, and variances add (Kaplanyan and Hill 2016 filter normals so).
    """
    return (roughness**4 + 1 / nodes) ** 0.25
