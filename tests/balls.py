"""Points on a ball, for tests of lights: positions are normals."""

import torch
from torch.nn.functional import normalize

from univoxel import sphere
from univoxel.core.records import Surface


def surface_at(position, normal, albedo=0.5, roughness=0.5, **others):
    """One material all over, and a feature of zeros; opaque, and seen from a distance of 1."""
    n = len(position)
    values = {"albedo": albedo * torch.ones(n, 3), "roughness": roughness * torch.ones(n)}
    values |= {"features": torch.zeros(n, 1), "opacity": torch.ones(n), "depth": torch.ones(n)}
    return Surface(position, normal, **(values | others))


def ball(n=200, features=4, albedo=0.5, roughness=0.5, seed=0):
    g = torch.Generator().manual_seed(seed)
    normal = sphere.fibonacci_sphere(n)
    features = torch.randn(n, features, generator=g)
    return surface_at(normal, normal, albedo, roughness, features=features)


def views(surface, seed=1):
    g = torch.Generator().manual_seed(seed)
    offset = normalize(torch.randn(surface.normal.shape, generator=g), dim=-1)
    return normalize(surface.normal + 0.7 * offset, dim=-1)


def shaken(light, seed=0):
    """A local light with random weights in the last layer of its head, so that points differ."""
    g = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        light.head[-1].weight.normal_(0, 0.1, generator=g)
    return light
