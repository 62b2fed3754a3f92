"""What a stage of training is made of, and what its losses weigh."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

from univoxel.names import FIELDS, FieldName
from univoxel.validation import check_fields

# Most of a limit of time that reading and preparation may take; stages share the rest
PREPARATION = 0.25


@dataclass(frozen=True)
class StageConfig:
    """One stage of training, on a grid of its own resolution."""

    voxels: float  # millions in the object's box at most, > 0; see TrainConfig.voxel_pixels
    iterations: int  # optimisation steps, >= 1; fewer when time runs out
    share: float  # of the time that is left for stages under a limit, (0, 1]
    rays: int = 2048  # per step, >= 1
    sharpness: tuple[float, float] = (0.5, 0.5)  # s of the NeuS density at begin and end, voxels
    lr_sdf: tuple[float, float] = (0.2, 0.02)  # at begin and end, voxels per step; all rates > 0
    # at begin and end: of features, and of the table of mirrored directions
    lr_features: tuple[float, float] = (0.1, 0.01)
    # at begin and end: of the networks, the light, and what differs from view to view
    lr_networks: tuple[float, float] = (3e-3, 3e-4)
    lr_poses: tuple[float, float] = (1e-3, 1e-4)  # radians, radii; of cameras that are refined
    plate: float = 0.003  # thin-plate smoothing of touched sdf nodes per step, [0, 0.125]
    spread: int = 4  # passes that smooth the sdf's gradient before the optimiser, >= 0
    diffusion: float = 0.01  # smoothing of touched feature nodes per step, [0, 0.25]
    physical_from: float = 1.0  # progress in [0, 1] at which the physically based render joins
    # progress in [0, 1] at which patches of the surface are compared between photographs; 1: never
    patches_from: float = 1.0
    refit: bool = False  # materials stay; light, radiance and silhouettes follow them
    # sparse: only bricks around the surface are stored; hash: features come from a hash table
    field: FieldName = "dense"

    def __post_init__(self) -> None:
        check_fields(self, "above 0", lambda x: 0 < x < math.inf, "voxels")
        check_fields(self, "at least 1", lambda x: x >= 1, "iterations", "rays")
        check_fields(self, "in (0, 1]", lambda x: 0 < x <= 1, "share")
        check_fields(
            self,
            "two numbers above 0",
            lambda x: len(x) == 2 and all(0 < v < math.inf for v in x),
            *("sharpness", "lr_sdf", "lr_features", "lr_networks", "lr_poses"),
        )
        check_fields(self, "at least 0", lambda x: x >= 0, "spread")
        check_fields(self, "in [0, 0.125]", lambda x: 0 <= x <= 0.125, "plate")
        check_fields(self, "in [0, 0.25]", lambda x: 0 <= x <= 0.25, "diffusion")
        check_fields(self, "in [0, 1]", lambda x: 0 <= x <= 1, "physical_from", "patches_from")
        check_fields(self, "dense, sparse or hash", lambda x: x in FIELDS, "field")


@dataclass(frozen=True)
class LossConfig:
    """Weights >= 0 of the losses; the photometric loss of the physically based render has 1."""

    radiance: float = 1.0  # photometric loss of what the radiance head shows
    silhouette: float = 0.1  # rays' opacity against the masks
    albedo_smoothness: float = 0.005  # change of the albedo over about a voxel, L1
    roughness_smoothness: float = 0.02  # change of the roughness over about a voxel, L1
    metallic: float = 0.01  # what the mean metallic costs: metal is for where nothing else serves
    light_smoothness: float = 0.1  # change of a local light over about a voxel, L1
    # distance of the light from grey on the whole, as a share of it: photographs fix albedo and
    # light up to a colour only
    white_light: float = 0.01
    map_smoothness: float = 1e-3  # total variation of the log map
    # what patches of the surface lack in correlation between photographs, in every second step
    patches: float = 0.4

    def __post_init__(self) -> None:
        names = [f.name for f in fields(self)]
        check_fields(self, "at least 0", lambda x: 0 <= x < math.inf, *names)
