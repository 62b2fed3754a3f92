"""One environment map, albedo and roughness from the photographs, with traced visibility.

Local lobes explain every photograph and leave shadows in the albedo. Once geometry stands, the
light is known to be one distant map that reaches a point where nothing is in the way, and what is
in the way shines as bright as the photographs show it. That leaves few unknowns: Gauss-Newton steps
on the map alternate with rounds of Adam on map, materials and the surface's normals, which shading
and highlights tell better than silhouettes and colours did.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor
from torch.nn.functional import binary_cross_entropy, normalize

from univoxel import brdf, losses
from univoxel.color import CLIPPED
from univoxel.data import Photos
from univoxel.joint.albedo_entropy import balance, matte_albedo, sunlit
from univoxel.joint.config import JointConfig
from univoxel.joint.initialise import STEPS, TRIALS, TRIED, supposed
from univoxel.joint.metals import find_metal
from univoxel.joint.newton import newton_round
from univoxel.joint.observations import Problem, draw, draw_sightings, pose, turned, widened
from univoxel.lights import priors
from univoxel.optim import RowAdam
from univoxel.scene import Scene
from univoxel.training.divergence import Guard
from univoxel.training.progress import Progress
from univoxel.training.surface_update import (
    EPS_FEATURES,
    EPS_SDF,
    MOMENTS,
    refresh_surface_,
    smooth_sdf_gradient_,
)

# Of a sighting in a Newton step over one in a step of Adam, with trials and the search for metals;
# measured
NEWTON_COST = 6.5
LEAST_POINTS = 2000  # on a machine however slow
SPREAD = 2  # passes that smooth the sdf's gradient: fewer than where geometry forms
FOLLOWING = 60  # steps in which materials follow a map that was changed
FOLLOWED = 0.1  # weight of their loss, against Adam's eps; no other was tried
HOLD = 3e-3  # on the squared distance, in voxels, between the surface and its points


def solve(scene: Scene, photos: Photos, cfg: JointConfig, seed: int, progress: Progress) -> None:
    """Fit scene.sky, the materials and the normals to the photographs; other heads stay.

    What a point sees, and is seen by, is traced once: the surface turns, and hardly moves.
    """
    assert scene.sky is not None
    if progress.clock.over:
        progress.clock.skip()
        return
    # What does not fit is cut alike: points here, steps of Adam by `steps`, points of Newton below
    points = min(cfg.points, max(LEAST_POINTS, round(progress.clock.pace * cfg.points)))
    try:
        scene.occluder()
        problem = pose(scene, photos, replace(cfg, points=points), seed)
    except ValueError as error:  # no surface, or none that is seen
        progress.trouble(f"stage {progress.clock.stage + 1}: {error}: light and materials stay")
        progress.clock.skip()
        return
    scene.field.sdf.requires_grad_(cfg.lr_sdf > 0)
    first, turn, more = 0.0, -1.0, cfg.rounds  # begin and end of a round, rounds to come
    guard = Guard(progress)
    for done in progress.clock.steps(newton_share(cfg)):
        if done >= turn:
            seconds = progress.clock.reserved / more
            problem = turned(scene, problem)
            if more == cfg.rounds:
                with progress.clock.off_pace():
                    problem = supposed(scene, problem, cfg, seconds, progress.trouble)
                    if cfg.colors:
                        problem = sunlit(scene, problem, progress.say)
                        if balance(scene, problem) or problem.sun is not None:
                            problem = replace(problem, albedo=matte_albedo(scene, problem))
            with progress.clock.off_pace():
                costs = newton_round(scene, problem, cfg, seconds, progress.trouble)
                if cfg.colors:
                    balance(scene, problem)
                sure = 1 - (more - 1) / max(cfg.rounds - 1, 1)
                problem = replace(problem, metal=find_metal(scene, problem, cfg, sure))
                if problem.albedo is not None:
                    follow(scene, problem, cfg)
                    problem = replace(problem, albedo=None)
            more = 1 + progress.clock.blocks_that_fit(
                more - 1
            )  # on a slow machine fewer and longer rounds
            groups = [
                {"params": [scene.field.features], "eps": EPS_FEATURES},
                {"params": list(scene.material.parameters())},
                {"params": [scene.sky.log_radiance]},
                {"params": [scene.field.sdf], "eps": EPS_SDF},
            ]
            if scene.views:
                groups.append({"params": [scene.views.gain_steps]})
                if scene.views.sky_weights is not None:
                    groups[2]["params"] += [scene.views.sky_weights, scene.views.sky_basis]
            optimizer = RowAdam(groups, betas=MOMENTS)
            guard.follow(optimizer)
            first, turn, more = done, done + (1 - done) / more, more - 1
        fade = 0.1 ** ((done - first) / (turn - first))
        # After a Newton round light is better than what Adam would make of it while the albedo
        # follows: the map moves slowly, gains do not
        of_map, of_gains = (0.1, 0.0) if costs else (1.0, 1.0)
        rates = (
            cfg.lr_features,
            cfg.lr_networks,
            cfg.lr_map * of_map,
            cfg.lr_sdf * scene.field.voxel_size,
            cfg.lr_networks * of_gains,
        )
        for group, rate in zip(optimizer.param_groups, rates, strict=False):
            group["lr"] = rate * fade * guard.scale
        terms = objective(scene, problem, cfg)
        loss = torch.stack(list(terms.values())).sum()
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        if not guard.sound(loss):
            continue
        if cfg.lr_sdf:
            smooth_sdf_gradient_(scene.field, SPREAD)
        optimizer.step()
        if progress.due():
            progress.report({k: v.item() for k, v in terms.items()}, None)
            guard.keep()
    refresh_surface_(scene)


def follow(scene: Scene, problem: Problem, cfg: JointConfig) -> None:
    """Teach the materials the albedos that the photographs have under a map that was changed.

    Adam on the photographs does so too, in many more and dearer steps: paint that holds the shades
    of another light, times this one, is far from them, and short trainings would end before. Metal,
    roughness and metallic stay.
    """
    wanted = matte_albedo(scene, problem)
    matte = wanted.isfinite().all(1) & ~problem.metal
    if not matte.any():
        return
    position = problem.seen.position
    with torch.no_grad():
        albedo, rough, metallic = scene.material(scene.field.features_at(position))
    wanted = torch.where(matte[:, None], wanted, albedo.clamp_min(1e-3)).log()
    materials = {"params": list(scene.material.parameters())}
    optimizer = RowAdam([{"params": [scene.field.features], "eps": EPS_FEATURES}, materials])
    for step in range(FOLLOWING):
        rates = cfg.lr_features, cfg.lr_networks
        for group, rate in zip(optimizer.param_groups, rates, strict=True):
            group["lr"] = rate * 0.1 ** (step / FOLLOWING)
        some = torch.randint(len(position), (cfg.rays,))
        found = scene.material(scene.field.features_at(position[some]))
        albedo = found[0].clamp_min(1e-3).log()
        loss = (albedo - wanted[some]).abs().mean()
        for now, before in zip(found[1:], (rough, metallic), strict=True):
            loss = loss + (now - before[some]).abs().mean()
        optimizer.zero_grad(set_to_none=True)
        (FOLLOWED * loss).backward()
        optimizer.step()


def newton_share(cfg: JointConfig) -> float:
    """Share of the stage's time that Newton rounds take if nothing is cut."""
    if not cfg.newton_steps:
        return 0.0
    points = cfg.rounds * cfg.newton_steps * cfg.newton_points + TRIALS * STEPS * TRIED
    sightings = points * cfg.newton_views
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
    sample = scene.field.sample(torch.cat([position, beside]))
    parts = (x.chunk(2) for x in scene.material(sample.features))
    (albedo, albedo_near), (roughness, roughness_near), (metallic, _) = parts
    metal = problem.metal[points].float()
    diffuse, f0 = brdf.split(albedo, metallic * metal)
    assert isinstance(f0, Tensor)
    repeat = torch.arange(len(points)).repeat_interleave(cfg.views)
    roughness_shown = widened(roughness, len(transport.direction))
    normal = normalize(sample.gradient[: len(points)], dim=1, eps=1e-6)
    shown = normal[repeat], diffuse[repeat], roughness_shown[repeat], f0[repeat]
    rgb = draw_sightings(scene, problem, index, sighting, *shown)
    encoded, target = losses.encode(rgb), problem.target[sighting]
    return {
        "joint": losses.photometric(encoded, target, clipped=CLIPPED),
        "surface": HOLD * (sample.sdf[: len(points)] / problem.voxel_size).square().mean(),
        "albedo": cfg.albedo_smoothness * priors.smoothness(albedo, albedo_near),
        "roughness": cfg.roughness_smoothness * priors.smoothness(roughness, roughness_near),
        "metallic": cfg.metallic * binary_cross_entropy(metallic, metal),
    }
