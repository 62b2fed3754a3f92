"""The light that is none: what photographs show is taken for albedo."""

from dataclasses import replace
from pathlib import Path

import torch
from balls import ball, views

from univoxel.fields.field import MaterialHead
from univoxel.lights import BakedLight, build
from univoxel.presets import preset
from univoxel.render import metrics


def test_albedo_is_what_is_sent_in_every_direction():
    surface, light = ball(50), BakedLight()
    rgb = light.reflected(surface, views(surface))
    assert torch.equal(rgb, surface.albedo)
    assert torch.equal(light.reflected(surface, -views(surface)), rgb)


def test_albedo_becomes_the_median_of_the_photographs():
    """A highlight in two of nine photographs of a point leaves no trace."""
    shown = torch.full((9, 3), 0.3)
    shown[:2] = 0.95  # below what counts as clipped
    surface = replace(ball(1), albedo=torch.full((1, 3), 0.6, requires_grad=True))
    optimizer = torch.optim.Adam([surface.albedo], lr=0.01)
    for _ in range(200):
        optimizer.zero_grad()
        rgb = BakedLight().reflected(surface, views(surface)).expand(9, 3)
        metrics.photometric(rgb, shown).backward()
        optimizer.step()
    torch.testing.assert_close(surface.albedo[0], torch.full((3,), 0.3), atol=0.02, rtol=0)


def test_its_scene_has_one_roughness_and_no_metal():
    cfg = preset("fast", Path("data"), Path("run"), "baked")
    assert isinstance(build(4, cfg.scene.light), BakedLight)
    head = MaterialHead(cfg.scene.material_channels, cfg.scene.hidden, cfg.scene.roughness)
    _, roughness, metallic = head(torch.randn(20, 8))
    assert torch.equal(roughness, torch.full((20,), 0.5))
    assert not metallic.any()
