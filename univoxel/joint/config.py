"""The constants of the joint solve."""

from __future__ import annotations

import math
from dataclasses import dataclass

from univoxel.validation import check_fields


@dataclass(frozen=True)
class JointConfig:
    """The stage that solves for one map, the materials and normals, see tasks/joint.py."""

    iterations: int = 700  # Adam steps in all rounds, >= 1; fewer when time runs out
    share: float = 0.4  # of the time budget, (0, 1]
    rays: int = 4096  # sightings per step, >= views
    views: int = 4  # sightings of a point per step, >= 1
    rounds: int = 4  # of Newton steps on the map and then of Adam, >= 1
    points: int = 20000  # on the surface, >= 1
    tracing: int = 2  # visibility rays per point and direction, >= 1
    colors: bool = True  # whether the few colours of paint tell of the light, see solve/palette.py
    lr_features: float = 0.03  # at the begin of a round; all rates > 0
    lr_networks: float = 3e-3
    lr_map: float = 0.05  # of the log map
    lr_sdf: float = 0.04  # of the surface, voxels per step, >= 0; 0: it stays
    albedo_smoothness: float = 0.005  # weights >= 0
    roughness_smoothness: float = 0.02
    metallic: float = 0.01
    newton_steps: int = 3  # at the begin of a round, >= 0
    newton_points: int = 4000  # of the points, >= 1
    newton_views: int = 8  # sightings of each, >= 2
    newton_roughness: float = 0.1  # standard deviation that roughness follows the map with; 0: none
    newton_smooth: float = 1e-7  # Laplacian on the log map against the mean squared residual, > 0

    def __post_init__(self):
        counts = ("iterations", "views", "rounds", "points", "tracing", "newton_points")
        check_fields(self, "at least 1", lambda x: x >= 1, *counts)
        check_fields(self, "in (0, 1]", lambda x: 0 < x <= 1, "share")
        check_fields(self, "at least views", lambda x: x >= self.views, "rays")
        rates = ("lr_features", "lr_networks", "lr_map", "newton_smooth")
        check_fields(self, "above 0", lambda x: 0 < x < math.inf, *rates)
        weights = ("albedo_smoothness", "roughness_smoothness", "metallic")
        not_below = (*weights, "lr_sdf", "newton_steps", "newton_roughness")
        check_fields(self, "at least 0", lambda x: 0 <= x < math.inf, *not_below)
        check_fields(self, "at least 2", lambda x: x >= 2, "newton_views")
