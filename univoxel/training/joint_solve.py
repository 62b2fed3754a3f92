"""Joint optimisation of one environment map, albedo and roughness, with traced visibility.

Local lobes explain every photograph and leave shadows in the albedo. Once geometry stands, the
light is known to be one distant map that reaches a point where nothing is in the way, and what is
in the way shines as bright as the photographs show it. That leaves few unknowns. Gauss-Newton steps
on the map alternate with rounds of Adam on map, materials and the surface's normals, which shading
and highlights determine better than silhouettes and colours did.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, replace

import torch
from torch import Tensor
from torch.nn.functional import binary_cross_entropy, normalize

from univoxel import brdf
from univoxel.color import CLIPPED, linear_to_srgb_unclipped, luminance
from univoxel.config import JointConfig
from univoxel.data import Photos
from univoxel.errors import NoSurface
from univoxel.fields.field import MaterialHead
from univoxel.lights import base
from univoxel.optim import RowAdam
from univoxel.render import metrics
from univoxel.render.observations import (
    JointProblem,
    MaterialLabels,
    Mirrors,
    build_problem,
    first_labels,
    prefiltered_roughness,
    sample_observations,
    shade_observations,
    with_present_normals,
)
from univoxel.scene import Scene, Within, save_scene
from univoxel.training.albedo_entropy import diffuse_albedo, fit_sun_, minimise_entropy_
from univoxel.training.descent import EPS_FEATURES, EPS_SDF, MOMENTS, Guard, smooth_sdf_gradient_
from univoxel.training.metals import (
    TRIAL_POINTS,
    TRIAL_ROUNDS,
    TRIAL_STEPS,
    evidence,
    find_metal,
    initialise_,
    neutralise_,
)
from univoxel.training.mirrors import PAINT, find_mirrors
from univoxel.training.newton import NewtonRound, newton_round_
from univoxel.training.progress import Progress

# Points that are traced on a machine however slow; on a fast one JointConfig.points
MIN_POINTS = 2000
# Seconds of an observation in a Newton step over one in an Adam step; measured, with the trials
# and the search for metals. Only a first guess of the time to reserve
NEWTON_COST = 6.5
# Learning rates at the end of a round over those at its begin
DECAY = 0.1
# Learning rate of the map after a Newton step, times JointConfig.lr_map. Light is then better
# than what Adam would make of it while the albedo follows
MAP_AFTER_NEWTON = 0.1
# Learning rate of the views' gains after a Newton step, times lr_networks; 0: they stay
GAINS_AFTER_NEWTON = 0.0
# Passes that smooth the gradient of the sdf: fewer than where geometry forms
SDF_PASSES = 2
# Weight of the squared distance, in voxels, between the surface and its points
SURFACE_WEIGHT = 3e-3
# Voxels: standard deviation of where materials are compared, for their smoothness
BESIDE = 2.0
# Weight of what was found of sharp points, in Adam
MIRROR_WEIGHT = 1.0
# Weight of the loss by which materials learn albedos, against the epsilon of Adam; no other was
# tried
TEACHING_WEIGHT = 0.1
# Weight of the change of the albedo near each point, see BESIDE
ALBEDO_SMOOTHNESS = 0.005
# Weight of the change of the roughness there
ROUGHNESS_SMOOTHNESS = 0.02
# Weight of the cross entropy of metallic and the metal classification
METALLIC_WEIGHT = 0.01
# Median roughness that the solve starts with. What is rough becomes so, but for what starts rough
# the map makes itself sharp and bright enough, and both fit nearly as well
GLOSSY = 0.25
# Mean luminance of an ordinary albedo, and the brightest channel of an ordinary metal (steel). The
# former counts as much as photographs whose `NewtonRound.level` is LEVEL: on the bank's tuning
# half, the level is 2e-4 to 4e-4 for rough objects and 5e-3 for glossy ones
ORDINARY, ORDINARY_METAL, LEVEL = 0.35, 0.55, 1.7e-3
WHITE = 0.9  # albedo of white paint, in each channel
FEW_METALS = 0.05  # share of the points up to which their brightness means nothing


def solve(scene: Scene, photos: Photos, cfg: JointConfig, seed: int, progress: Progress) -> None:
    """Fit scene.sky, the materials and the normals to the photographs; other heads stay.

    What a point sees, and is seen by, is traced once: the surface turns, and hardly moves. Where
    time is over, or there is nothing to see, all stays. A run that was saved within the stage goes
    on there, on points of the surface as it is then.
    """
    problem = traced_problem(scene, photos, cfg, seed, progress)
    if problem is None:
        progress.within = None
        progress.clock.skip()
        return
    decisions = first_labels(scene, problem, cfg)
    scene.field.sdf.requires_grad_(cfg.lr_sdf > 0)
    guard = Guard(progress)
    current_round = Within(begin=0.0, end=0.0, rounds_after=cfg.rounds, solved=False)
    if progress.within is not None:
        current_round = Within(**progress.within)
        done = rounds_done(cfg, current_round.rounds_after)
        only_metal = decisions.only_metal or current_round.only_metal
        decisions = replace(decisions, only_metal=only_metal)
        decisions = with_metals(scene, problem, decisions, cfg, done)
        optimizer = adam(scene, problem)
        guard.follow(optimizer)
    for done in progress.clock.steps(newton_share(cfg)):
        if done >= current_round.end:
            problem = with_present_normals(scene, problem)
            rounds_left = current_round.rounds_after
            decisions, newton = newton_phase_(scene, problem, decisions, cfg, rounds_left, progress)
            # On a slow machine fewer and longer rounds
            rounds_after = progress.clock.blocks_that_fit(rounds_left - 1)
            end = done + (1 - done) / (1 + rounds_after)
            solved, level = bool(newton.costs), newton.level
            current_round = Within(done, end, rounds_after, solved, decisions.only_metal, level)
            progress.within = asdict(current_round)
            optimizer = adam(scene, problem)
            guard.follow(optimizer)
        set_rates_(optimizer, cfg, current_round, done, scene.field.voxel_size, guard.scale)
        terms = objective(scene, problem, decisions, cfg)
        loss = torch.stack(list(terms.values())).sum()
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        if not guard.sound(loss):
            continue
        if cfg.lr_sdf:
            smooth_sdf_gradient_(scene.field, SDF_PASSES)
        optimizer.step()
        if progress.due():
            progress.report({k: v.item() for k, v in terms.items()}, None)
            guard.keep()
        if progress.checkpoint_due():
            save_scene(scene, progress.cfg.out, progress.state())
    progress.within = None
    scene.field.refresh()
    set_level_(scene, problem, decisions.metal, current_round.level)


def traced_problem(
    scene: Scene, photos: Photos, cfg: JointConfig, seed: int, progress: Progress
) -> JointProblem | None:
    """The problem on as many points as there is time for; None: no time, or no surface that is
    seen, which the progress is told of."""
    if progress.clock.finished and progress.clock.over:
        return None
    # What does not fit is cut alike: points here, steps of Adam by `steps`, points of Newton there
    points = min(cfg.points, max(MIN_POINTS, round(progress.clock.pace * cfg.points)))
    try:
        scene.occluder()
        return build_problem(scene, photos, replace(cfg, points=points), seed)
    except NoSurface as error:  # there is none, or none that is seen
        progress.trouble(f"stage {progress.clock.stage + 1}: {error}: light and materials are kept")
        return None


def newton_share(cfg: JointConfig) -> float:
    """Share of the stage's time that Newton rounds take if nothing is cut."""
    if not cfg.newton_steps:
        return 0.0
    points = cfg.rounds * cfg.newton_steps * cfg.newton_points
    points += TRIAL_ROUNDS * TRIAL_STEPS * TRIAL_POINTS
    newton = NEWTON_COST * (points * cfg.newton_views)
    return newton / (newton + cfg.iterations * cfg.rays)


def newton_phase_(
    scene: Scene,
    problem: JointProblem,
    decisions: MaterialLabels,
    cfg: JointConfig,
    rounds_left: int,
    progress: Progress,
) -> tuple[MaterialLabels, NewtonRound]:
    """Change the map by Newton and by the colours of paint; return the decisions under it, and
    what Newton's steps came to.

    Args:
        rounds_left: this one among them; before the first the map is initialised.
    """
    seconds = progress.clock.reserved / rounds_left
    if rounds_left == cfg.rounds:
        with progress.clock.off_pace():
            decisions = start_(scene, problem, decisions, cfg, seconds, progress)
    if decisions.only_metal:
        neutralise_(scene, problem)
    with progress.clock.off_pace():
        newton = newton_round_(scene, problem, decisions, cfg, seconds)
        for trouble in newton.troubles:
            progress.trouble(trouble)
        follow_(scene, problem, newton)
        if cfg.colors:
            minimise_entropy_(scene, problem, decisions)
        done = rounds_done(cfg, rounds_left - 1)
        decisions = with_metals(scene, problem, decisions, cfg, done)
        if decisions.albedo is not None:
            teach_albedo_(scene, problem, decisions, cfg)
            decisions = replace(decisions, albedo=None)
        if decisions.mirrors is not None:
            teach_mirrors_(scene, problem, decisions.mirrors, cfg)
    return decisions, newton


@torch.no_grad()
def follow_(scene: Scene, problem: JointProblem, newton: NewtonRound) -> None:
    """Shift all roughnesses as the median of Newton's points changed with the map.

    Newton leaves the materials. Under a map that belongs to glossier ones Adam would roughen
    everything before albedos have followed, and roughness does not come back from 1.
    """
    features = scene.field.features_at(problem.observations.position)
    median = float(scene.material(features)[1].median())
    scene.material.shift_roughness(features, median + newton.to_roughness)


@torch.no_grad()
def set_level_(scene: Scene, problem: JointProblem, metal: Tensor, evidence: float) -> None:
    """Make the map darker and whiter, and the albedo brighter, towards an ordinary albedo.

    What photographs show of diffuse surfaces and of metal is the product of the two. Only the
    reflection of dielectrics, which no albedo changes, tells how bright and of what colour the
    light is: little, if they are rough, and every other reason why brightness changes with the view
    counts as such a reflection. So the maps of rough objects come out several times too bright. But
    cameras balance the colours of photographs so that the light looks white. A flash is white: with
    one, the map keeps its colour.

    Args:
        metal: [N] bool, of the points.
        evidence: `NewtonRound.level`.
    """
    all_metal = bool(metal.all())
    share = 1.0 if all_metal else LEVEL / (LEVEL + evidence)
    features = scene.field.features_at(problem.observations.position)
    albedo = scene.material(features)[0]
    median = albedo.median(0).values
    light = problem.sky.radiance.mean(0)
    factor = (light / light.mean()) ** share if scene.flash is None else torch.ones(3)
    albedo = factor * albedo
    if all_metal:
        level = ORDINARY_METAL / albedo.mean(0).max()
    else:
        level = (ORDINARY / luminance(albedo[~metal]).mean()).clamp_min(1.0) ** share
        if metal.float().mean() > FEW_METALS:  # their reflectance rises with the albedo of the rest
            most = ORDINARY_METAL / albedo[metal].amax(1).mean()
            level = torch.minimum(level, most.clamp_min(1.0))
    # An albedo that would be brighter than white paint would lose its contrast
    brightest = median.amax().clamp_min(WHITE)
    level = level / ((level * factor * median).amax() / brightest).clamp_min(1.0)
    factor = level * factor
    scene.material.shift_albedo(features, factor * median)
    problem.sky.log_radiance.sub_(factor.log())
    if scene.flash is not None:
        scene.flash.log_radiance.sub_(level.log())


def with_metals(
    scene: Scene, problem: JointProblem, decisions: MaterialLabels, cfg: JointConfig, done: float
) -> MaterialLabels:
    """The decisions with the metals that are found under the present map; done as in
    `find_metal`."""
    metal = torch.ones_like(decisions.metal)
    if not decisions.only_metal:
        metal = find_metal(scene, problem, cfg, done, decisions.likely)
    mirrors = find_mirrors(scene, problem)
    if mirrors is not None and not decisions.only_metal:
        mirrors = mirrors.where(evidence(scene, problem, cfg) < PAINT)
    if mirrors is not None:
        metal = metal | mirrors.metal
    return replace(decisions, metal=metal, mirrors=mirrors)


def rounds_done(cfg: JointConfig, rounds_after: int) -> float:
    """How far a round is among all, in [0, 1], by those that come after it."""
    return 1 - rounds_after / max(cfg.rounds - 1, 1)


def start_(
    scene: Scene,
    problem: JointProblem,
    decisions: MaterialLabels,
    cfg: JointConfig,
    seconds: float,
    progress: Progress,
) -> MaterialLabels:
    """Change map and roughness to where the solve starts from; return the decisions there.

    Args:
        seconds: that the trials may take.
    """
    features = scene.field.features_at(problem.observations.position)
    scene.material.shift_roughness(features, GLOSSY)
    decisions, troubles = initialise_(scene, problem, decisions, cfg, seconds)
    for trouble in troubles:
        progress.trouble(trouble)
    if decisions.only_metal and cfg.only_metal is None:
        progress.say(
            "the whole object is classified as metal, because that explains the photographs "
            "about as well as a mix of materials; if parts are not metal, use --metal some"
        )
    if not cfg.colors:
        return decisions
    sun = fit_sun_(scene, problem, decisions)
    if sun is not None:
        progress.say(str(sun))
        decisions = replace(decisions, sun=sun.log_excess)
    if minimise_entropy_(scene, problem, decisions) or sun is not None:
        albedo = diffuse_albedo(scene, problem)
        decisions = replace(decisions, albedo=albedo)
    return decisions


def teach_albedo_(
    scene: Scene, problem: JointProblem, decisions: MaterialLabels, cfg: JointConfig
) -> None:
    """Teach the materials the albedos that the photographs have under a map that was changed.

    Adam on the photographs does so too, in many more and dearer steps: paint that holds the shades
    of another light, times this one, is far from them, and short trainings would end before. Metal,
    roughness and metallic stay.
    """
    target = diffuse_albedo(scene, problem)
    diffuse = target.isfinite().all(1) & ~decisions.metal
    if not diffuse.any():
        return
    with torch.no_grad():
        albedo, *others = scene.material(scene.field.features_at(problem.observations.position))
    teach_(scene, problem, (torch.where(diffuse[:, None], target, albedo), *others), cfg)


def teach_mirrors_(scene: Scene, problem: JointProblem, mirrors: Mirrors, cfg: JointConfig) -> None:
    """Teach the materials what was found of points that mirror sharply; the others stay.

    Adam on the photographs would pull everything along, as all begin alike, and roughness would not
    come back from where it ends.
    """
    with torch.no_grad():
        materials = scene.material(scene.field.features_at(problem.observations.position))
    low = torch.full_like(materials[1], MaterialHead.min_roughness)
    found = mirrors.base, low, torch.ones_like(low)
    sharp = mirrors.sharp
    target = [
        torch.where(sharp.view(-1, *[1] * (before.dim() - 1)), after, before)
        for before, after in zip(materials, found, strict=True)
    ]
    teach_(scene, problem, target, cfg)


def teach_(scene: Scene, problem: JointProblem, target: Sequence[Tensor], cfg: JointConfig) -> None:
    """Teach the materials albedo [N, 3], roughness [N] and metallic [N] of the problem's points."""
    position, steps = problem.observations.position, cfg.entropy.teaching_steps
    log_albedo, *others = target[0].clamp_min(1e-3).log(), *target[1:]
    materials = {"params": list(scene.material.parameters())}
    optimizer = RowAdam([{"params": [scene.field.features], "eps": EPS_FEATURES}, materials])
    for step in range(steps):
        rates = cfg.lr_features, cfg.lr_networks
        for group, rate in zip(optimizer.param_groups, rates, strict=True):
            group["lr"] = rate * DECAY ** (step / steps)
        point = torch.randint(len(position), (cfg.rays,))
        material = scene.material(scene.field.features_at(position[point]))
        loss = (material[0].clamp_min(1e-3).log() - log_albedo[point]).abs().mean()
        for value, wanted in zip(material[1:], others, strict=True):
            loss = loss + (value - wanted[point]).abs().mean()
        optimizer.zero_grad(set_to_none=True)
        (TEACHING_WEIGHT * loss).backward()
        optimizer.step()


def adam(scene: Scene, problem: JointProblem) -> RowAdam:
    """An optimiser with a group each for features, materials, map, sdf and, where views differ,
    their gains."""
    views, light = scene.views, [problem.sky.log_radiance]
    if views is not None and views.sky_weights is not None:
        light += [views.sky_weights, views.sky_basis]
    if scene.flash is not None:
        light.append(scene.flash.log_radiance)
    groups = [
        {"params": [scene.field.features], "eps": EPS_FEATURES},
        {"params": list(scene.material.parameters())},
        {"params": light},
        {"params": [scene.field.sdf], "eps": EPS_SDF},
    ]
    if views is not None:
        groups.append({"params": [views.gain_steps]})
    return RowAdam(groups, betas=MOMENTS)


def set_rates_(
    optimizer: RowAdam,
    cfg: JointConfig,
    current_round: Within,
    done: float,
    voxel_size: float,
    scale: float,
) -> None:
    """Set the learning rates of `adam`'s groups: they fall from the begin of a round to its end.

    Args:
        scale: factor on all of them.
    """
    length = current_round.end - current_round.begin
    fade = DECAY ** ((done - current_round.begin) / length)
    map_factor = MAP_AFTER_NEWTON if current_round.solved else 1.0
    gains_factor = GAINS_AFTER_NEWTON if current_round.solved else 1.0
    rates = (
        cfg.lr_features,
        cfg.lr_networks,
        cfg.lr_map * map_factor,
        cfg.lr_sdf * voxel_size,
        cfg.lr_networks * gains_factor,
    )
    for group, rate in zip(optimizer.param_groups, rates, strict=False):
        group["lr"] = rate * fade * scale


def objective(
    scene: Scene, problem: JointProblem, decisions: MaterialLabels, cfg: JointConfig
) -> dict[str, Tensor]:
    """The weighted losses of a random batch of observations."""
    index, observation = sample_observations(problem, cfg.rays // cfg.views, cfg.views)
    point = index[:: cfg.views]
    position = problem.observations.position[point]
    distance = BESIDE * problem.voxel_size
    nearby = position + distance * torch.randn_like(position)
    # One sampling, one gradient: adding up sparse ones costs more than either
    sample = scene.field.sample(torch.cat([position, nearby]))
    parts = (x.chunk(2) for x in scene.material(sample.features))
    (albedo, albedo_nearby), (roughness, roughness_nearby), (metallic, _) = parts
    metal = decisions.metal[point].float()
    diffuse, f0 = brdf.split(albedo, metallic * metal)
    assert isinstance(f0, Tensor)
    repeated = torch.arange(len(point)).repeat_interleave(cfg.views)
    filtered_roughness = prefiltered_roughness(roughness, problem.nodes)
    normal = normalize(sample.gradient[: len(point)], dim=1, eps=1e-6)
    surface = normal[repeated], diffuse[repeated], filtered_roughness[repeated], f0[repeated]
    rgb = shade_observations(scene, problem, index, observation, *surface)
    encoded, target = linear_to_srgb_unclipped(rgb), problem.target[observation]
    if decisions.mirrors is not None:  # the map is too coarse for them
        encoded = torch.where(decisions.mirrors.sharp[index][:, None], target, encoded)
    squared_distance = (sample.sdf[: len(point)] / problem.voxel_size).square().mean()
    terms = {
        "joint": metrics.photometric(encoded, target, clipped=CLIPPED),
        "surface": SURFACE_WEIGHT * squared_distance,
        "albedo": ALBEDO_SMOOTHNESS * base.smoothness(albedo, albedo_nearby),
        "roughness": ROUGHNESS_SMOOTHNESS * base.smoothness(roughness, roughness_nearby),
        "metallic": METALLIC_WEIGHT * binary_cross_entropy(metallic, metal),
    }
    if decisions.mirrors is not None:
        terms["mirrors"] = MIRROR_WEIGHT * mirror_loss(
            decisions.mirrors, point, normal, albedo, roughness
        )
    return terms


def mirror_loss(
    mirrors: Mirrors, point: Tensor, normal: Tensor, albedo: Tensor, roughness: Tensor
) -> Tensor:
    """How far points [N] that mirror sharply are from what was found of them: a mean over all.

    Args:
        normal, albedo, roughness: of the points, [N, 3], [N, 3] and [N].
    """
    from_normal = (normal - mirrors.normal[point]).norm(dim=1)
    log_base = mirrors.base[point].clamp_min(1e-3).log()
    from_base = (albedo.clamp_min(1e-3).log() - log_base).abs().mean(1)
    from_roughness = (roughness - MaterialHead.min_roughness).abs()
    return (mirrors.sharp[point] * (from_normal + from_base + from_roughness)).mean()
