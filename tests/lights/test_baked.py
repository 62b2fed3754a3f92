"""The light that is none: what photographs show is taken for albedo."""

from pathlib import Path

import torch
from balls import ball, views

from univoxel.fields.field import MaterialHead
from univoxel.lights import BakedLight, build
from univoxel.presets import preset


def test_albedo_is_what_is_sent_in_every_direction():
    surface, light = ball(50), BakedLight()
    rgb = light.reflected(surface, views(surface))
    assert torch.equal(rgb, surface.albedo)
    assert torch.equal(light.reflected(surface, -views(surface)), rgb)


def test_its_scene_has_one_roughness_and_no_metal():
    cfg = preset("fast", Path("data"), Path("run"), "baked")
    assert isinstance(build(4, cfg.scene.light), BakedLight)
    head = MaterialHead(cfg.scene.material_channels, cfg.scene.hidden, cfg.scene.roughness)
    _, roughness, metallic = head(torch.randn(20, 8))
    assert torch.equal(roughness, torch.full((20,), 0.5))
    assert not metallic.any()
