"""What the joint solve is made of: how long it takes, what it weighs, where it decides."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from univoxel.validation import check_fields

_WHOLE = ("at least 1", lambda x: x >= 1)
_ABOVE = ("above 0", lambda x: 0 < x < math.inf)
_NOT_BELOW = ("at least 0", lambda x: 0 <= x < math.inf)
_SHARE = ("in (0, 1]", lambda x: 0 < x <= 1)


@dataclass(frozen=True)
class MetalConfig:
    """Which points are metal, see joint/metals.py."""

    # brightest channel of a metal at least, [0, 1]: metals in use reflect 0.4 and more
    min_reflectance: float = 0.25

    def __post_init__(self) -> None:
        check_fields(self, "in [0, 1]", lambda x: 0 <= x <= 1, "min_reflectance")


@dataclass(frozen=True)
class MirrorConfig:
    """The map that mirrors show, see joint/sharp_sky.py."""

    # rows of the map as sharp points show it, a multiple of 32; 0: it is not kept
    rows: int = 128

    def __post_init__(self) -> None:
        rows = range(0, 1025, 32)
        check_fields(self, "a multiple of 32 in [0, 1024]", lambda x: x in rows, "rows")


@dataclass(frozen=True)
class EntropyConfig:
    """The prior that paint comes in few colours, see joint/albedo_entropy.py."""

    # steps, >= 1, in which the materials learn the albedos under a map that was changed
    teaching_steps: int = 60

    def __post_init__(self) -> None:
        check_fields(self, *_WHOLE, "teaching_steps")


@dataclass(frozen=True)
class JointConfig:
    """The stage that solves for one map, the materials and normals, see joint/stage.py."""

    iterations: int = 700  # Adam steps in all rounds, >= 1; fewer when time runs out
    share: float = 0.4  # of the time budget, (0, 1]
    rays: int = 4096  # observations per step, >= views
    views: int = 4  # observations of a point per step, >= 1
    rounds: int = 4  # of Newton steps on the map and then of Adam, >= 1
    points: int = 20000  # on the surface, >= 1
    tracing: int = 2  # visibility rays per point and direction, >= 1
    colors: bool = True  # whether the light minimises the entropy of albedo, see entropy
    # whether all is metal, as dark as it looks, and the map neutral; None: trials decide
    only_metal: bool | None = None
    lr_features: float = 0.03  # at the begin of a round; all rates > 0
    # at the begin of a round: of the materials' head and the views' gains
    lr_networks: float = 3e-3
    lr_map: float = 0.05  # of the log map
    lr_sdf: float = 0.04  # of the surface, voxels per step, >= 0; 0: it stays
    newton_steps: int = 3  # at the begin of a round, >= 0
    newton_points: int = 4000  # of the points, >= 1
    newton_views: int = 8  # observations of each, >= 2
    newton_roughness: float = 0.1  # standard deviation that roughness follows the map with; 0: none
    newton_smooth: float = 1e-7  # Laplacian on the log map against the mean squared residual, > 0
    # how points are decided to be metal
    metal: MetalConfig = field(default_factory=MetalConfig)
    # the map that mirrors show
    mirror: MirrorConfig = field(default_factory=MirrorConfig)
    # the prior on few colours, where colors is set
    entropy: EntropyConfig = field(default_factory=EntropyConfig)

    def __post_init__(self) -> None:
        counts = ("iterations", "views", "rounds", "points", "tracing", "newton_points")
        check_fields(self, *_WHOLE, *counts)
        check_fields(self, *_SHARE, "share")
        check_fields(self, "at least views", lambda x: x >= self.views, "rays")
        check_fields(self, *_ABOVE, "lr_features", "lr_networks", "lr_map", "newton_smooth")
        check_fields(self, *_NOT_BELOW, "lr_sdf", "newton_steps", "newton_roughness")
        check_fields(self, "at least 2", lambda x: x >= 2, "newton_views")
