"""The light of a test photograph is found from it, and nothing else changes."""

import copy
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from analytic import cameras_around, sphere_scene

from univoxel.color import linear_to_srgb
from univoxel.data import Photos
from univoxel.evaluation.measures import every_nth, fit_light_, render_layers
from univoxel.lights import SGConfig
from univoxel.lights.views import ShownLight
from univoxel.render import metrics
from univoxel.scene import Scene


def lit_scene(varying: str) -> Scene:
    """A sphere whose light reads a view's code, where light varies."""
    plain = sphere_scene(40)
    light = SGConfig(lobes=4, hidden=8, directions=32, directions_eval=32)
    names = () if varying == "none" else ("a", "b")
    cfg = replace(plain.cfg, varying=varying, codes=3, views=names, light=light, mirrored=False)
    torch.manual_seed(1)
    scene = Scene(cfg, plain.field, inv_s=40.0).eval()
    if varying == "light":
        with torch.no_grad():  # as if it had learned from them
            codes = slice(cfg.channels, cfg.channels + 3)
            scene.light.head.linear[0].weight[:, codes].normal_(0, 1.0)
            scene.light.head.linear[-1].weight.normal_(0, 0.3)
    return scene


def photographed(scene: Scene, gain: torch.Tensor, code: torch.Tensor | None) -> Photos:
    """What the scene looks like under another light."""
    cameras = cameras_around(2, size=32)
    other = copy.deepcopy(scene)
    if other.views is None:
        color = render_layers(other, cameras, 0).rgb * gain
    else:
        other.views.shown = ShownLight(gain, code)
        color = render_layers(other, cameras, 0).rgb
    alpha = render_layers(other, cameras, 0).alpha
    straight = color / alpha.clamp_min(1e-3)[..., None]
    whole = torch.stack([straight, straight]), torch.stack([alpha, alpha])
    return Photos(Path("sphere"), ["r_0", "r_1"], *whole, cameras)


@torch.no_grad()
@pytest.mark.parametrize("varying", ["none", "exposure", "light"])
def test_the_light_of_a_photograph_is_found(varying):
    scene = lit_scene(varying)
    before = {name: value.clone() for name, value in scene.state_dict().items()}
    gain = torch.tensor([0.5, 1.6, 1.0])
    code = torch.tensor([0.8, -0.6, 0.4]) if varying == "light" else None
    photos = photographed(scene, gain, code)
    photo = metrics.on_black(*photos.picture(0))

    def quality():
        return metrics.psnr(linear_to_srgb(render_layers(scene, photos.cameras, 0).rgb), photo)

    mean = quality()
    fit_light_(scene, photos, 0)
    assert quality() > mean + 15
    if code is None:
        assert torch.allclose(scene.views.shown.gain, gain, atol=0.02)
    after = scene.state_dict()
    assert all(torch.equal(after[name], value) for name, value in before.items())


@torch.no_grad()
def test_a_view_that_shows_nothing_has_the_mean_light():
    scene = lit_scene("light")
    photos = photographed(scene, torch.ones(3), None)
    scene.views.shown = ShownLight(torch.zeros(3), None)
    fit_light_(scene, replace(photos, alpha=torch.zeros_like(photos.alpha)), 0)
    assert scene.views.shown is None


def named(*names: str) -> Photos:
    cameras = cameras_around(len(names), size=4)
    blank = torch.zeros(len(names), 4, 4, 3), torch.zeros(len(names), 4, 4)
    return Photos(Path("sphere"), list(names), *blank, cameras)


def test_every_nth_of_all_names():
    test, trained = named("c", "a"), ["b", "d"]
    chosen = every_nth(test, trained, 2)
    assert chosen.names == ["a", "c"]
    assert torch.equal(chosen.cameras.camera_to_world[1], test.cameras.camera_to_world[0])
    assert every_nth(test, trained, 4).names == ["a"]


@pytest.mark.parametrize(
    ("every", "message"),
    [
        (1, r"test_every 1 selects 2 photographs that were used for training, such as b"),
        (0, "test_every must be at least 1, got 0"),
    ],
)
def test_every_nth_is_none_that_was_trained_on(every, message):
    with pytest.raises(ValueError, match=message):
        every_nth(named("a", "c"), ["b", "d"], every)
