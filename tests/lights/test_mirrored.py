"""The network of what is mirrored sharply."""

import torch
from balls import surface_at
from torch.nn.functional import normalize

from univoxel import brdf
from univoxel.core.records import Surface
from univoxel.lights.base import MirroredLight
from univoxel.ops.networks import DirectionTable

NO_TABLE = DirectionTable(0)


def mirror_ball(n: int, metallic: float) -> tuple[Surface, torch.Tensor]:
    """Points of a ball of radius 1, and unit directions to the eye on their side."""
    normal = normalize(torch.randn(n, 3), dim=1)
    wo = normalize(normal + 0.7 * normalize(torch.randn(n, 3), dim=1), dim=1)
    material = {"albedo": 1.0, "roughness": 0.1, "metallic": metallic * torch.ones(n)}
    return surface_at(normal, normal, features=torch.zeros(n, 2), **material), wo


def test_adds_nothing_at_first():
    surface, wo = mirror_ball(50, 1.0)
    assert not MirroredLight(2, 8, 1.0)(surface, wo, NO_TABLE).any()


def test_learns_an_edge_that_no_lobe_has():
    torch.manual_seed(0)
    head = MirroredLight(2, 32, 1.0)
    optimizer = torch.optim.Adam(head.parameters(), lr=1e-2)

    def error() -> torch.Tensor:
        surface, wo = mirror_ball(512, 1.0)
        mirrored = 2 * (surface.normal * wo).sum(1, keepdim=True) * surface.normal - wo
        sky = (mirrored[:, 2:] > 0).float()  # white above the horizon, black below
        share = brdf.specular_albedo((surface.normal * wo).sum(1), surface.roughness, 1.0)
        return (head(surface, wo, NO_TABLE) - share[:, None] * sky).square().mean()

    before = error().item()
    for _ in range(150):
        optimizer.zero_grad()
        error().backward()
        optimizer.step()
    assert error() < 0.1 * before  # one radiance for all leaves half of it


def test_a_dielectric_mirrors_as_much_less_as_its_layer_reflects():
    torch.manual_seed(0)
    head = MirroredLight(2, 8, 1.0)
    torch.nn.init.normal_(head.net.linear[-1].weight)
    surface, wo = mirror_ball(50, 1.0)
    cosine = (surface.normal * wo).sum(1)
    whole = brdf.specular_albedo(cosine, surface.roughness, 1.0)[:, None]
    metal = head(surface, wo, NO_TABLE) / whole
    surface = Surface(**{**vars(surface), "metallic": None})
    share = brdf.specular_albedo(cosine, surface.roughness, brdf.F0)[:, None]
    torch.testing.assert_close(head(surface, wo, NO_TABLE), share * metal)


def test_reads_the_table_where_the_eye_is_mirrored():
    (surface, wo), asked = mirror_ball(50, 1.0), []

    class Watched(DirectionTable):
        def forward(self, direction):
            asked.append(direction)
            return super().forward(direction)

    MirroredLight(2, 8, 1.0, known=4)(surface, wo, Watched(2))
    # Halfway between both lies the normal
    torch.testing.assert_close(normalize(asked[0] + wo, dim=1), surface.normal)
    torch.testing.assert_close(asked[0].norm(dim=1), torch.ones(50))
