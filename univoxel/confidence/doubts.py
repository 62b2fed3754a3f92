"""Doubt of albedo and roughness anywhere on the surface."""

from __future__ import annotations

import numpy as np
import torch
from scipy.spatial import KDTree
from torch import Tensor

from univoxel.confidence.survey import Survey

# Voxels, over 2, that opposite sides of a thin part count as farther apart: a pixel takes its doubt
# from its own side
NORMAL_SCALE = 3.0
# Nearest points that a pixel takes its doubt from
NEIGHBOURS = 4


class Doubts:
    """Doubts of a survey, to be looked up anywhere on the surface."""

    def __init__(self, surveyed: Survey) -> None:
        self._scale = NORMAL_SCALE * surveyed.voxel_size
        self._values = torch.stack([surveyed.albedo, surveyed.roughness], 1)
        self._tree = KDTree(self._key(surveyed.position, surveyed.normal))

    def at(self, position: Tensor, normal: Tensor) -> Tensor:
        """Doubt of albedo and of roughness [N, 2] at points [N, 3] with normals [N, 3]: the mean
        of the nearest points, weighted by the inverse squared distance."""
        count = min(NEIGHBOURS, len(self._values))
        nearest = self._tree.query(self._key(position, normal), k=count, workers=-1)
        distance, index = (torch.from_numpy(x.reshape(-1, count)) for x in map(np.asarray, nearest))
        weight = 1 / (distance.square() + 1e-12)
        weight = (weight / weight.sum(1, keepdim=True)).float()
        return (self._values[index] * weight[..., None]).sum(1)

    def _key(self, position: Tensor, normal: Tensor) -> np.ndarray:
        return torch.cat([position, self._scale * normal], 1).numpy()
