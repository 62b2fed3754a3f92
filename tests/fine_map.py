"""A map finer than the nodes of the joint solve lie apart."""

import torch

from univoxel import sphere


def fine_map(direction):
    """Radiance [..., 3] from directions [..., 3], and lamps."""
    x, y, z = direction.unbind(-1)
    pattern = 0.4 * (1.2 * (7 * x).sin() * (6 * y + 1).sin() + 1.2 * (7 * z + 2).sin()).exp()
    tint = torch.stack([0.5 + 0.2 * x, 0.5 + 0.2 * y, 0.5 - 0.2 * z], -1)
    return pattern[..., None] * tint


def of_nodes(map, direction):
    """Means [D, 3] of a map around nodes [D, 3]."""
    nodes = torch.zeros(len(direction), 3)
    texels = sphere.latlong_directions(64).flatten(0, 1)
    nearest = (texels @ direction.T).argmax(1)
    area = sphere.texel_solid_angles(64, 128).reshape(-1, 1)
    nodes.index_add_(0, nearest, map(texels) * area)
    return nodes / torch.zeros(len(direction), 1).index_add(0, nearest, area)
