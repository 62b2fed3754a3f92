"""The one distant light: what it says between its nodes, and where its map puts them."""

import math

import pytest
import torch
from torch.nn.functional import normalize

from univoxel.lights.latlong import NODES_AT_ONCE, DistantLight
from univoxel.sphere import direction_to_latlong, texel_solid_angles


def light_with(node: int, radiance: float, count: int = 512) -> DistantLight:
    light = DistantLight(count, 0.01)
    with torch.no_grad():
        light.log_radiance[node] = math.log(radiance)
    return light


def test_a_constant_map_is_constant_everywhere():
    light = DistantLight(100, 0.7)
    wi = normalize(torch.randn(NODES_AT_ONCE + 3, 3), dim=1)  # more than are done at once
    assert torch.allclose(light.incident(wi), torch.tensor(0.7), rtol=1e-5)
    assert torch.allclose(light.latlong(4), torch.full((4, 8, 3), 0.7), rtol=1e-5)


@torch.no_grad()
def test_incident_at_a_node_is_near_its_radiance():
    torch.manual_seed(0)
    light = DistantLight(512)
    # Smooth over the sphere: what is between two nodes is then between their radiances
    light.log_radiance.copy_(light.direction)
    error = light.incident(light.direction) / light.radiance - 1
    # The Gaussians reach the neighbours, 9 degrees away: what they add cancels to first order
    assert error.abs().max() < 0.03


@torch.no_grad()
@pytest.mark.parametrize("node", [3, 100, 256, 300, 509])
def test_a_bright_node_is_where_the_conventions_say(node):
    height = 64
    light = light_with(node, 100.0)
    picture = light.latlong(height)[..., 0]
    row, column = divmod(int(picture.argmax()), 2 * height)
    x, y, z = light.direction[node].tolist()
    # docs/reference/conventions.md, solved for column and row
    assert abs(row + 0.5 - height * (0.5 - math.asin(z) / math.pi)) < 1
    away = (column + 0.5 - 2 * height * (math.pi - math.atan2(y, x)) / (2 * math.pi)) % (2 * height)
    assert min(away, 2 * height - away) * math.sqrt(1 - z * z) < 1.5  # columns narrow to the poles
    u, v = direction_to_latlong(light.direction[node]).tolist()
    assert picture[int(v * height), int(u * 2 * height)] > 0.9 * picture.max()


@torch.no_grad()
def test_a_nodes_light_is_kept_by_the_map():
    light = light_with(200, 50.0)
    picture = light.latlong(64)
    total = (picture * texel_solid_angles(64, 128)[..., None]).sum((0, 1))
    nodes = light.radiance.sum(0) * 4 * math.pi / 512
    assert torch.allclose(total, nodes, rtol=0.05)  # the spiral is even to a few per cent


def test_the_map_takes_gradients():
    light = DistantLight(32)
    light.incident(torch.tensor([[0.0, 0.0, 1.0]])).sum().backward()
    gradient = light.log_radiance.grad
    # Softmax weights sum to 1, and the radiance is 1: so do the derivatives of each channel
    assert torch.allclose(gradient.sum(0), torch.ones(3), rtol=1e-5)
    assert gradient.sum(1).argmax() == light.direction[:, 2].argmax()


def test_texels_that_are_sharper_than_the_nodes_are_the_map():
    light = DistantLight(32, 0.7, rows=8)
    light.sharp += torch.arange(16.0)[:, None]
    assert torch.allclose(light.latlong(8), light.sharp, atol=1e-5)
    assert torch.allclose(light.latlong(4)[:, 0], torch.tensor(0.5))
    assert torch.allclose(light.incident(light.direction), torch.tensor(0.7))
    assert light.changed(torch.zeros(32, 3)).sharp is None
