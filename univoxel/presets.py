"""Presets: amounts of work, and the amount that fits a time limit."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

from univoxel import lights
from univoxel.config import PREPARATION, JointConfig, LossConfig, StageConfig, TrainConfig
from univoxel.core.choices import LIGHTS, Differing, FieldName, LightName, Metal
from univoxel.errors import UserError, demand
from univoxel.scene import SceneConfig


@dataclass(frozen=True)
class Work:
    """An amount of work."""

    minutes: float  # that its training takes on two quiet cores, on 80 photographs of 400 pixels
    voxels: float  # millions, of the finest grid
    steps: float  # of the fine stage; the others follow
    rays: float  # per step
    # Rates at the beginning of a stage: few steps want larger ones
    lr_networks: float
    lr_sdf: float
    # Of the joint optimisation under the hybrid light: normals want steps more than observations
    joint_steps: float
    observations: float  # per step
    directions: float  # of the light at a point, per step; the hybrid light's turn at random


# fmt: off
PRESETS = {
    #     minutes, voxels, steps, rays, lr_networks, lr_sdf, joint_steps, observations, directions
    "draft": Work(1.0, 1.25,  530, 1280, 6e-3,   0.07,   395, 2048,  64),
    "fast":  Work(2.0, 2.0,   900, 2048, 6e-3,   0.07,   675, 2048,  64),
    "full":  Work(5.0, 3.3,  2900, 2048, 3.7e-3, 0.056, 2500, 3400, 105),
    "best":  Work(8.0, 4.0,  4200, 2048, 3e-3,   0.05,  4200, 4096, 128),
}
# fmt: on


SHORTEST = 1.0  # minutes; in fewer, patches and taught colours cost more than they bring
CARVING = 0.1  # share of the minutes: where carving takes more it costs more than it brings


def preset(
    name: str, data: Path, out: Path, light: LightName = "hybrid", varying: Differing = "auto"
) -> TrainConfig:
    """The configuration of a preset: draft, fast, full or best.

    A preset is an amount of work, designed for about 1, 2, 5 or 8 minutes on two cores. Every
    machine makes all of its steps, however long they take. Its sizes are upper limits: capacity is
    adaptive with the hybrid light, and fixed with the others, which serve for comparison.

    Args:
        light, varying: see `budget`.

    Raises:
        UserError: an unknown name, or varying light with a map from the beginning.
    """
    demand(name in PRESETS, "preset", f"one of {', '.join(PRESETS)}", repr(name))
    return _configuration(PRESETS[name], data, out, light, varying)


def budget(
    minutes: float, data: Path, out: Path, light: LightName = "hybrid", varying: Differing = "auto"
) -> TrainConfig:
    """The configuration for a time limit in minutes on two cores: a preset or one in between.

    Args:
        minutes: above 0, from reading the first photograph to the end. A quarter of it is for
            reading and preparation.
        light: "sg", local lobes as published; "hybrid", local lobes while the shape forms, then one
            environment map with traced visibility for the materials, then lobes fitted to them;
            "sh" and "mlp", other local lighting models; "envmap-sg" and "envmap", one map with
            traced visibility from the beginning; "baked", no light: the colours of the photographs
            are used as albedo. docs/guide/lights.md compares them.
        varying: what changes between photographs: "none"; "exposure", a gain per channel; "light",
            the light as well; "auto", what is seen to change.

    Raises:
        UserError: minutes is out of range, there is no such light, or the light varies and is one
            map from the beginning.
    """
    demand(0 < minutes < math.inf, "minutes", "above 0", f"{minutes:g}")
    work = work_in((1 - PREPARATION) * minutes)
    return replace(_configuration(work, data, out, light, varying), minutes=minutes)


def chosen(
    name: str,
    minutes: float | None,
    data: Path,
    out: Path,
    light: LightName = "hybrid",
    varying: Differing = "auto",
) -> TrainConfig:
    """A preset within a limit of minutes; or for the name auto, the work that fits into them.

    Without minutes: the preset as it is, fast for auto.
    """
    if name == "auto" and minutes is not None:
        return budget(minutes, data, out, light, varying)
    config = preset("fast" if name == "auto" else name, data, out, light, varying)
    return config if minutes is None else replace(config, minutes=minutes)


def with_field(cfg: TrainConfig, kind: FieldName) -> TrainConfig:
    """The same configuration with another field. With sparse fields, the first, coarse stage is
    dense and capacity is fixed."""
    stages = [replace(s, field=kind) if isinstance(s, StageConfig) else s for s in cfg.stages]
    if kind == "sparse" and isinstance(stages[0], StageConfig):
        stages[0] = replace(stages[0], field="dense")
    capacity = "fixed" if kind == "sparse" else cfg.capacity
    return replace(cfg, stages=tuple(stages), capacity=capacity)


def with_metal(cfg: TrainConfig, metal: Metal) -> TrainConfig:
    """The same configuration, given whether the object is all metal; a UserError if it is, but no
    stage solves for an environment map."""
    if metal == "auto":
        return cfg
    if not any(isinstance(s, JointConfig) for s in cfg.stages):
        raise UserError(
            f"metal={metal} needs light=hybrid, the only model that classifies metals, got "
            f"light={cfg.scene.light.kind}",
            *("metal", "light"),
        )
    only = metal == "all"
    stages = [replace(s, only_metal=only) if isinstance(s, JointConfig) else s for s in cfg.stages]
    return replace(cfg, stages=tuple(stages))


def work_in(minutes: float) -> Work:
    """Work on the geometric line between the presets on either side of a time.

    Before draft the nearest two lead on. Beyond best only steps do: a finer grid or a larger batch
    would want more memory.
    """
    known = list(PRESETS.values())
    k = max(i for i, w in enumerate(known[:-1]) if i == 0 or w.minutes <= minutes)
    low, high = known[k], known[k + 1]
    x = math.log(minutes / low.minutes) / math.log(high.minutes / low.minutes)

    def between(name: str) -> float:
        a, b = getattr(low, name), getattr(high, name)
        return a * (b / a) ** (x if name in ("steps", "joint_steps") else min(x, 1.0))

    return replace(Work(**{f.name: between(f.name) for f in fields(Work)}), minutes=minutes)


def _configuration(
    work: Work, data: Path, out: Path, light: LightName, varying: Differing
) -> TrainConfig:
    voxels = round(work.voxels, 3)
    exposures, known = varying == "auto", "none" if varying == "auto" else varying
    steps, rays = max(6, round(work.steps)), max(8, round(work.rays))
    lr_networks = (work.lr_networks, 3e-4)
    compared = work.minutes >= SHORTEST
    coarse = StageConfig(
        0.9,
        steps // 2,
        share=0.15,
        rays=rays // 2,
        sharpness=(0.7, 0.35),
        lr_sdf=(0.2, 0.02),
        lr_networks=lr_networks,
        physical_from=1.0,
        patches_from=0.2 if compared else 1.0,  # before, there is no surface yet
    )
    fine = StageConfig(
        voxels=voxels,
        iterations=steps,
        share=0.85,
        rays=rays,
        lr_sdf=(work.lr_sdf, 0.005),
        lr_networks=lr_networks,
        patches_from=0.0 if compared else 1.0,
    )
    local = lights.SGConfig(directions=128), lights.SHConfig(), lights.MLPLightConfig()
    kinds: tuple[lights.LightConfig, ...] = *local, lights.EnvmapSGConfig(), lights.EnvmapConfig()
    alone = {config.kind: config for config in kinds}
    bare: dict[str, Any] = {"sky_nodes": 0, "mirrored": False, "varying": known}
    match light:
        case "hybrid":
            coarse, fine, joint, refit = _hybrid_stages(work, coarse, fine)
            lobes = lights.SGConfig(directions=round(work.directions))
            scene, loss = SceneConfig(light=lobes, varying=known), LossConfig()
            stages, capacity = (coarse, fine, joint, refit), "adaptive"
        case "baked":
            scene = SceneConfig(**bare, light=lights.BakedConfig(), roughness=0.5)
            stages, capacity, loss = (coarse, fine), "fixed", LossConfig()
        case _ if light in alone:
            scene = SceneConfig(**bare, light=alone[light])
            # Lobes that light the materials to the end: what leaves least shading in the albedo
            loss = LossConfig(light_smoothness=1.0) if light == "sg" else LossConfig()
            stages, capacity = (coarse, fine), "fixed"
        case _:
            raise UserError(f"light must be one of {', '.join(LIGHTS)}, got {light!r}", "light")
    turns = isinstance(scene.light, lights.LocalLightConfig) and known != "light"
    detailed = work.minutes > PRESETS["draft"].minutes and light != "baked"
    return TrainConfig(
        data,
        out,
        stages,
        exposures=exposures,
        light_frame="auto" if turns else "world",
        carving_seconds=CARVING * 60 * work.minutes,
        capacity=capacity,
        detail="texture" if detailed else "none",  # of a look nobody waits for it
        scene=scene,
        loss=loss,
    )


def _hybrid_stages(
    work: Work, coarse: StageConfig, fine: StageConfig
) -> tuple[StageConfig, StageConfig, JointConfig, StageConfig]:
    """The stages of the hybrid light, from the two that geometry forms in."""
    steps = fine.iterations
    # Shares are what the stages of fast cost where none is cut
    coarse, fine = replace(coarse, share=0.11), replace(fine, share=0.41)
    # What Newton and tracing cost follows the steps, or little work would be nothing else
    joint = JointConfig(
        iterations=max(1, round(work.joint_steps)),
        share=0.27,
        rays=round(work.observations),
        points=min(25 * steps, 15000 + 6 * steps),
        newton_points=min(4000, 3 * steps, 1000 + steps),
        colors=work.minutes >= SHORTEST,
    )
    refit = replace(
        fine,
        iterations=steps // 3,
        share=0.21,
        sharpness=(0.3, 0.3),
        lr_sdf=(0.015, 0.0015),
        lr_features=(0.01, 0.001),
        plate=0.0,
        diffusion=0.0,
        physical_from=0.0,
        patches_from=1.0,
        refit=True,
    )
    return coarse, fine, joint, refit
