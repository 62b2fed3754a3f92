"""Fewer channels, lobes and units: what nothing depended on goes without a trace."""

from itertools import pairwise

import pytest
import torch
from analytic import photos_of, sphere_scene

from univoxel.checkpoint import load_scene, save_scene
from univoxel.compression import prune
from univoxel.compression.config import CompressionConfig
from univoxel.compression.quality import reference_rays
from univoxel.lights import MLPLightConfig, SGConfig, SHConfig
from univoxel.networks import DirectionTable

RIDGE = CompressionConfig().ridge
LIGHTS = [
    SGConfig(lobes=3, hidden=8, directions=8, directions_eval=8),
    SHConfig(order=1, hidden=8, directions=8, directions_eval=8),
    MLPLightConfig(rank=2, hidden=8, directions=8, directions_eval=8),
]


def lit_scene(light=LIGHTS[0]):
    """A scene of random features and weights, so that everything depends on everything."""
    scene = sphere_scene(16, voxel_size=0.1, light=light).eval()
    scene.inv_s = 60.0
    g = torch.Generator().manual_seed(1)
    with torch.no_grad():
        scene.field.features.normal_(generator=g)
        scene.radiance.directions.table[: DirectionTable.rows].normal_(generator=g)
        for owner, name in prune.heads(scene):
            for layer in getattr(owner, name).linear:
                layer.weight.normal_(0, 0.3, generator=g)
                layer.bias.normal_(0, 0.3, generator=g)
    return scene


@pytest.fixture(scope="module")
def rays():
    photos = photos_of(2, 24)
    pixels = torch.cartesian_prod(torch.arange(2), torch.arange(24), torch.arange(24))
    return reference_rays(photos, pixels)


def assert_same(scene, rays, before):
    # Twice the same sums in another order: float32, heads of three layers, sRGB steep in the dark
    for name, value in rays.decoded(scene)._asdict().items():
        torch.testing.assert_close(value, getattr(before, name), atol=2e-4, rtol=1e-3, msg=name)


@pytest.mark.parametrize("light", LIGHTS, ids=lambda light: light.kind)
def test_a_change_of_basis_changes_nothing(rays, light):
    scene = lit_scene(light)
    before, features = rays.decoded(scene), scene.field.features.clone()
    basis = torch.block_diag(*(torch.randn(2, 2) + 2 * torch.eye(2) for _ in range(2)))
    prune.rotate_(scene, basis)
    assert not torch.allclose(scene.field.features, features)
    assert_same(scene, rays, before)


@pytest.mark.parametrize("light", LIGHTS, ids=lambda light: light.kind)
@pytest.mark.parametrize("keep", [[0, 2], [0, 1, 3], [1, 2]])
def test_a_channel_that_is_the_same_everywhere_goes_without_a_trace(rays, light, keep):
    scene = lit_scene(light)
    gone = [c for c in range(4) if c not in keep]
    mean = torch.zeros(4)
    mean[gone] = 0.7
    with torch.no_grad():
        scene.field.features[..., gone] = 0.7
    before = rays.decoded(scene)
    prune.drop_channels_(scene, torch.tensor(keep), mean)
    assert scene.cfg.channels == scene.field.channels == scene.field.features.shape[-1]
    assert scene.cfg.material_channels == sum(c < 2 for c in keep)
    # Where a ray meets little, its features are divided by no less than 1e-4: only those that hit
    hit = rays.surface(scene).opacity > 0.5
    after = rays.decoded(scene)
    for name, value, now in zip(before._fields, before, after, strict=True):
        torch.testing.assert_close(now[hit], value[hit], atol=1e-4, rtol=1e-3, msg=name)


def test_a_dark_lobe_goes_without_a_trace(rays):
    scene = lit_scene()
    with torch.no_grad():
        scene.light.base[1, 4:] = -60.0  # softplus: 1e-26
        scene.light.head.linear[-1].weight[7 + 4 : 14] = 0
    before = rays.decoded(scene)
    prune.drop_lobes_(scene, torch.tensor([0, 2]))
    assert scene.cfg.light.lobes == scene.light.config.lobes == 2
    assert_same(scene, rays, before)


@pytest.mark.parametrize("kept", [0, 2])
def test_mirror_levels_that_say_nothing_go_without_a_trace(rays, kept):
    scene = lit_scene()
    table = scene.radiance.directions
    with torch.no_grad():
        table.table.zero_()[: kept * table.rows].normal_()
    before, coarse = rays.decoded(scene), table.table.detach().clone()
    prune.drop_mirror_levels_(scene, kept)
    assert scene.cfg.mirror_levels == table.levels == kept
    assert torch.equal(table.table, coarse[: kept * table.rows])
    assert_same(scene, rays, before)


def test_units_that_nothing_reads_go_without_a_trace(rays):
    scene = lit_scene()
    with torch.no_grad():
        for owner, name in prune.heads(scene):
            net = getattr(owner, name).linear
            for layer, after in pairwise(net):
                layer.weight[5:], layer.bias[5:] = 0, -1.0
                after.weight[:, 5:] = 0
    with prune.recorded_inputs(scene) as inputs:
        before = rays.decoded(scene)
    prune.drop_units_(scene, 5, inputs, RIDGE)
    assert scene.cfg.hidden == scene.cfg.light.hidden == 5
    assert_same(scene, rays, before)


def test_what_is_dropped_is_taken_over_where_it_can_be(rays):
    """Of two units that always say the same one is enough."""
    scene = lit_scene()
    first, second, _ = scene.radiance.net.linear
    with torch.no_grad():
        first.weight[7], first.bias[7] = 2 * first.weight[3], 2 * first.bias[3]
        second.weight[7], second.bias[7] = second.weight[0], second.bias[0]
    with prune.recorded_inputs(scene) as inputs:
        before = rays.decoded(scene).radiance
        net = scene.radiance.net
        scene.radiance.net = prune.narrowed(net, inputs["RadianceHead"], 7, RIDGE)
        after = rays.decoded(scene).radiance
    torch.testing.assert_close(after, before, atol=1e-3, rtol=0)  # the fit is damped by 1e-4


@pytest.mark.parametrize("light", LIGHTS, ids=lambda light: light.kind)
def test_a_trial_leaves_no_trace(rays, light):
    scene = lit_scene(light)
    before, cfg = rays.decoded(scene), scene.cfg
    snapshot = prune.snapshot(scene)
    prune.drop_channels_(scene, torch.tensor([0, 3]), torch.zeros(4))
    prune.drop_mirror_levels_(scene, 1)
    prune.restore_(snapshot)
    assert scene.cfg == cfg
    assert_same(scene, rays, before)


@pytest.mark.parametrize("light", LIGHTS, ids=lambda light: light.kind)
def test_a_smaller_scene_is_saved_and_loaded(rays, light, tmp_path):
    scene = lit_scene(light)
    with prune.recorded_inputs(scene) as inputs:
        rays.decoded(scene)
    prune.drop_units_(scene, 6, inputs, RIDGE)
    prune.drop_channels_(scene, torch.tensor([1, 2, 3]), torch.zeros(4))
    prune.drop_mirror_levels_(scene, 1)
    if isinstance(light, SGConfig):
        prune.drop_lobes_(scene, torch.tensor([0, 2]))
    before = rays.decoded(scene)
    save_scene(scene, tmp_path, {})
    again = load_scene(tmp_path)
    assert again.cfg == scene.cfg
    assert_same(again, rays, before)
