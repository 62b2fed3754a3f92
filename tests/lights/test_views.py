"""What differs from view to view: anchored, shown or averaged; light reads it, materials do not."""

from dataclasses import replace

import pytest
import torch
from analytic import sphere_scene
from balls import ball, views

from univoxel.lights import MLPLightConfig, SGConfig, SHConfig
from univoxel.lights.views import ViewLights
from univoxel.scene import Scene, load_scene, save_scene
from univoxel.sphere import fibonacci_sphere

NAMES = ("left", "right", "above")
SMALL = [
    SGConfig(lobes=3, hidden=8, directions=16),
    SHConfig(order=2, hidden=8, directions=32),
    MLPLightConfig(rank=4, hidden=8, directions=32),
]


def shaken(seed: int = 0) -> ViewLights:
    """Three views with everything their own."""
    torch.manual_seed(seed)
    lights = ViewLights(NAMES, 5, fibonacci_sphere(40))
    with torch.no_grad():
        lights.gain_steps.normal_(0, 0.1)
        lights.sky_weights.normal_()
    return lights


def varying_scene(light=SMALL[0], mirrored: bool = True) -> Scene:
    cfg = sphere_scene(40).cfg
    cfg = replace(cfg, varying="light", codes=5, views=NAMES, light=light, mirrored=mirrored)
    torch.manual_seed(0)
    return Scene(cfg, sphere_scene(40).field)


def test_the_mean_over_the_views_is_no_change():
    lights = shaken()
    torch.testing.assert_close(lights.gain(torch.arange(3)).prod(0), torch.ones(3))
    torch.testing.assert_close(lights.code(torch.arange(3)).mean(0), torch.zeros(5))
    torch.testing.assert_close(lights.sky_change().mean(0), torch.zeros(40, 3))
    assert torch.equal(lights.gain(), torch.ones(3))
    assert torch.equal(lights.code(), torch.zeros(5))


@pytest.mark.parametrize(("view", "index"), [("above", 2), ("1", 1)])
def test_the_light_of_a_view_is_shown(view, index):
    lights = shaken()
    lights.choose(view)
    assert torch.equal(lights.gain(), lights.gain(index))
    assert torch.equal(lights.code(), lights.code(torch.tensor([index]))[0])
    lights.choose(None)
    assert torch.equal(lights.gain(), torch.ones(3))


@pytest.mark.parametrize("view", ["3", "below", "-1"])
def test_no_such_view(view):
    wanted = rf"number of a view \(below 3\) or its name \(from left to above\), got '{view}'"
    with pytest.raises(ValueError, match=wanted):
        shaken().choose(view)


def test_a_change_of_the_map_is_smooth_at_first_and_no_exposure():
    lights = shaken()
    change = lights.sky_change().detach()
    assert change.std() > 0.1
    # Harmonics of degree 1 to 3 have no mean over the sphere, but for the 40 directions' unevenness
    assert change.mean(1).abs().max() < 0.1 * change.std()


@pytest.mark.parametrize("light", SMALL, ids=lambda light: light.kind)
def test_light_reads_the_code_and_materials_do_not(light):
    scene, surface = varying_scene(light), ball(30)
    wo = views(surface)
    zero = [scene.light.reflected(coded(scene, surface, v), wo) for v in (0, 1)]
    torch.testing.assert_close(*zero, rtol=0, atol=0)  # at first the code changes nothing
    with torch.no_grad():
        for net in (scene.light.head, scene.radiance.net, scene.mirrored.net):
            for layer in net.linear:
                layer.weight.normal_(0, 0.3)
    for draw in (
        lambda s: scene.light.reflected(s, wo),
        lambda s: scene.radiance(s.features, s.normal, wo),
        lambda s: scene.mirrored(s, wo, scene.radiance.directions),
    ):
        drawn = draw(coded(scene, surface, torch.arange(30) % 3))
        alone = draw(coded(scene, surface, 1))
        torch.testing.assert_close(drawn[1::3], alone[1::3])
        assert (drawn[::3] - alone[::3]).abs().max() > 1e-3
        (slope,) = torch.autograd.grad(drawn.sum(), scene.views.raw_codes)
        assert slope.abs().min() > 0
    materials = torch.cat([m.flatten() for m in scene.material(surface.features)])
    assert materials.requires_grad
    mine = torch.autograd.grad(materials.sum(), list(scene.views.parameters()), allow_unused=True)
    assert all(slope is None for slope in mine)
    # Even were the code handed to them, they stop before it
    both = scene.material(scene.coded(surface.features, 1)), scene.material(surface.features)
    assert all(torch.equal(a, b) for a, b in zip(*both, strict=True))


def coded(scene, surface, view):
    return replace(surface, features=scene.coded(surface.features, view))


def test_the_map_shown_is_that_of_the_view():
    scene = varying_scene()
    with torch.no_grad():
        scene.views.sky_weights.normal_()
    assert scene.environment() is scene.sky
    scene.show_light_of("right")
    wanted = scene.sky.log_radiance + scene.views.sky_change()[1]
    torch.testing.assert_close(scene.environment().log_radiance, wanted)


def test_a_checkpoint_keeps_the_views(tmp_path):
    scene = varying_scene()
    with torch.no_grad():
        scene.views.gain_steps.normal_()
    save_scene(scene, tmp_path, {})
    again = load_scene(tmp_path)
    assert again.cfg == scene.cfg
    assert again.views.names == NAMES
    assert torch.equal(again.views.log_gain, scene.views.log_gain)


def test_one_light_for_all_has_no_views():
    scene = sphere_scene(40)
    assert scene.views is None
    features = torch.zeros(2, 4)
    assert scene.coded(features) is features
    with pytest.raises(ValueError, match="all views of this run share one light"):
        scene.show_light_of("left")
