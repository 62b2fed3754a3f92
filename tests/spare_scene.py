"""A scene of random features, and rays that judge what it loses."""

import torch
from analytic import photos_of, sphere_scene

from univoxel.lights import SGConfig
from univoxel.training.compression import reference_rays

LIGHT = SGConfig(lobes=4, hidden=16, directions=16, directions_eval=16)


def reference_of_two_views():
    """Held-out rays."""
    photos = photos_of(2, 24)
    pixels = torch.cartesian_prod(torch.arange(2), torch.arange(24), torch.arange(24))
    return reference_rays(photos, pixels)


def heads(scene):
    """Every network that reads features, by its first layer."""
    networks = [scene.material.net, scene.radiance.net, scene.light.head]
    return [net.linear[0] for net in networks]


def feature_scene():
    """Random features on a grid; 4 lobes."""
    scene = sphere_scene(0, voxel_size=0.1, light=LIGHT).eval()
    scene.inv_s = 60.0
    g = torch.Generator().manual_seed(1)
    with torch.no_grad():
        scene.field.features.normal_(generator=g)
        scene.light.head.linear[-1].weight.normal_(0, 0.1, generator=g)
    return scene
