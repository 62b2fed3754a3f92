"""Where an exported mesh lies and how large it is."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TypeVar

import torch
from torch import Tensor

from univoxel.assets.base import TexturedMesh
from univoxel.names import Origin
from univoxel.records import Mesh

AnyMesh = TypeVar("AnyMesh", Mesh, TexturedMesh)


@dataclass(frozen=True)
class Placement:
    """x -> scale (x - origin), from the data set's world to an exported one."""

    origin: Tensor  # [3] float64, the point of the world that comes to lie at 0
    scale: float


def placement_of(vertices: Tensor, size: float | None, origin: Origin) -> Placement:
    """What brings the bounding box of vertices [P, 3] to a size and to an origin.

    Args:
        size: the longest side of the box afterwards; None: as it is.
        origin: what comes to lie at 0: "world", the data set's origin; "bottom", the middle of the
            box's floor; "centre", the middle of the box.
    """
    low, high = vertices.double().amin(0), vertices.double().amax(0)
    middle = (low + high) / 2
    match origin:
        case "bottom":
            at = torch.stack([middle[0], middle[1], low[2]])
        case "centre":
            at = middle
        case _:
            at = torch.zeros_like(middle)
    return Placement(at, 1.0 if size is None else size / float((high - low).max()))


def placed(mesh: AnyMesh, placement: Placement) -> AnyMesh:
    """A mesh brought where a placement says; normals and textures stay."""
    vertices = placement.scale * (mesh.vertices.double() - placement.origin)
    return replace(mesh, vertices=vertices.float())
