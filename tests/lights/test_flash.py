"""A flash at the lens: what it adds, that every stage knows it, and that photographs tell of it."""

import math
from dataclasses import replace

import pytest
import torch
from analytic import cameras_around, hull_of, sphere_scene
from observed_points import lamps, no_metal, photographs_under, problem_on_a_sphere, random_problem
from torch.nn.functional import normalize

from univoxel import brdf
from univoxel.color import linear_to_srgb_unclipped
from univoxel.config import JointConfig
from univoxel.core.records import Surface
from univoxel.evaluation import confidence
from univoxel.lights.views import Flash
from univoxel.optim import parameters_of
from univoxel.preparation import light_frame
from univoxel.preparation.hull import observe_hull
from univoxel.preparation.light_frame import LightFrame, explained_by_flash, light_frame_of
from univoxel.render.observations import (
    has_one_light,
    prefiltered_roughness,
    shade_observations,
    unfiltered_roughness,
)
from univoxel.render.pipeline import shade, surface_of_view
from univoxel.scene import Scene, load_scene, save_scene
from univoxel.training import joint_solve, metals
from univoxel.training.equations import channel_radiance
from univoxel.training.loop import build_optimizer
from univoxel.training.newton import NewtonRound, linear_transport, newton_round_

VIEWS = 16


def test_white_paint_that_faces_the_lens():
    flash = Flash(2.0)
    flash.log_radiance.data.fill_(math.log(0.8))
    normal = torch.tensor([[0.0, 0.0, 1.0]]).repeat(3, 1)
    wo = normalize(torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, 1.0], [0.0, 1.0, 1.0]]), dim=1)
    white, rough, none = torch.ones(3, 3), torch.ones(3), torch.zeros(3, 3)
    radiance = flash.reflected(normal, wo, torch.tensor([2.0, 4.0, 2.0]), white, rough, none)
    # The specular layer of F0 = 0 takes and adds little
    assert torch.allclose(radiance[0], torch.tensor(0.8), rtol=0.05)
    assert torch.allclose(radiance[1], radiance[0] / 4)
    assert torch.allclose(radiance[2], radiance[0] * math.sqrt(0.5), rtol=0.05)


def test_it_is_a_light_from_where_the_camera_is():
    torch.manual_seed(0)
    normal, wo = (normalize(torch.randn(50, 3), dim=1) for _ in range(2))
    wo = wo * (wo * normal).sum(1, keepdim=True).sign()
    albedo, f0, rough = torch.rand(50, 3), torch.rand(50, 3), 0.1 + 0.9 * torch.rand(50)
    flash = Flash(3.0)
    seen = flash.reflected(normal, wo, torch.full((50,), 3.0), albedo, rough, f0)
    irradiance = math.pi * 0.5 * (normal * wo).sum(1, keepdim=True)
    assert torch.allclose(seen, irradiance * brdf.evaluate(normal, wo, wo, albedo, rough, f0))


def with_flash(scene: Scene) -> Scene:
    lit = Scene(replace(scene.cfg, flash=2.0), scene.field, scene.inv_s)
    lit.load_state_dict(scene.state_dict(), strict=False)
    return lit.eval()


def test_the_render_has_it_and_a_file_keeps_it(tmp_path):
    plain = sphere_scene(32).eval()
    lit = with_flash(plain)
    surface, wo = surface_of_view(plain, cameras_around(4, 24), 1)
    difference = shade(lit, surface, wo) - shade(plain, surface, wo)
    albedo, f0 = brdf.split(surface.albedo, surface.metallic)
    of_surface = surface.depth, albedo, surface.roughness, f0
    assert torch.allclose(
        difference, lit.flash.reflected(surface.normal, wo, *of_surface), atol=1e-6
    )
    assert difference.max() > 0.05
    save_scene(lit, tmp_path, {})
    again = load_scene(tmp_path)
    assert again.flash.distance == 2.0
    assert torch.equal(again.flash.log_radiance, lit.flash.log_radiance)


@pytest.mark.parametrize("metal", [False, True])
def test_newton_knows_what_the_shading_makes_of_it(metal):
    scene = with_flash(sphere_scene(12))
    problem = replace(random_problem(scene=scene), flash=scene.flash)
    map, base, roughness = torch.rand(12, 3), torch.rand(5, 3), 0.3 + 0.6 * torch.rand(5)
    scene.sky.log_radiance.data = map.log()
    diffuse, f0 = brdf.split(base, torch.full((5,), float(metal)))
    filtered = prefiltered_roughness(roughness, problem.nodes)
    point, which = torch.tensor([0, 2, 4]), torch.tensor([[3, 1], [9, 8], [18, 18]])
    index = point.repeat_interleave(2)
    of_points = problem.observations.normal, diffuse, filtered, f0
    seen = index, which.flatten(), *(x[index] for x in of_points)
    lit = shade_observations(scene, problem, *seen)
    assert (lit > shade_observations(scene, replace(problem, flash=None), *seen)).any()
    transport = linear_transport(problem, point, which, filtered[point], metal)
    sky = transport.diffuse_factor[..., None] * (transport.diffuse @ map)
    radiance = base[point][:, None] * (sky + transport.diffuse_indirect + transport.flash[0])
    radiance = radiance + transport.specular @ map + transport.specular_indirect
    radiance = radiance + transport.flash[1]
    assert torch.allclose(radiance, lit.view(3, 2, 3), rtol=1e-3, atol=1e-5)
    log_base = base[point].log()
    for c in range(3):
        of_channel = channel_radiance(transport, map, log_base, c, None)[1]
        assert torch.allclose(of_channel, radiance[..., c], rtol=1e-5)


def test_newton_finds_the_flash():
    """From a flash that is too weak, on a sphere of paint in a room that is known."""
    torch.manual_seed(0)
    scene = with_flash(sphere_scene(128))
    problem = replace(problem_on_a_sphere(400, 8, 128, scene), flash=scene.flash)
    scene.sky.log_radiance.data = (0.5 * lamps(128)).log()
    scene.flash.log_radiance.data.fill_(math.log(0.7))
    point = torch.repeat_interleave(problem.observations.offsets.diff())
    albedo = 0.2 + 0.6 * torch.rand(400, 3)
    filtered = prefiltered_roughness(torch.full((400,), 0.5), 128)
    f0 = torch.full((400, 3), brdf.F0)
    seen = (x[point] for x in (problem.observations.normal, albedo, filtered, f0))
    color = shade_observations(scene, problem, point, torch.arange(3200), *seen).detach()
    problem = replace(problem, target=linear_to_srgb_unclipped(color))
    scene.flash.log_radiance.data -= 0.7
    cfg = JointConfig(newton_points=400, newton_views=8, newton_steps=6)
    newton_round_(scene, problem, no_metal(problem), cfg)
    # Light and albedo share a factor that next to nothing tells. The prior of a smooth map leaves
    # the lamps too dim by a sixth; it began at half
    of_room = scene.flash.log_radiance.exp() / scene.sky.radiance.mean()
    assert of_room.item() == pytest.approx(0.7 / float(0.5 * lamps(128).mean()), rel=0.25)


def test_roughness_survives_the_filter():
    roughness = torch.linspace(0.1, 1.0, 10)
    again = unfiltered_roughness(prefiltered_roughness(roughness, 512), 512)
    assert torch.allclose(again, roughness, rtol=1e-3)


@pytest.fixture(scope="module")
def photographs():
    """The same sphere in a room, and there with a flash too."""
    flash = Flash(2.0)
    return {
        name: photographs_under(0.5 * lamps(128), 0.3, VIEWS, flash=lamp)
        for name, lamp in (("room", None), ("flash", flash))
    }


def test_photographs_tell_of_a_flash(photographs, caplog):
    caplog.set_level("INFO", "univoxel")
    found = {
        name: explained_by_flash(observe_hull(photos, *hull_of(photos), 1500))
        for name, photos in photographs.items()
    }
    assert found["room"].shade < 0.05
    assert found["flash"].shade > 0.3
    assert found["flash"].ahead > 5
    photos = photographs["flash"]
    told = light_frame_of(photos, *hull_of(photos), "auto")
    assert told.turntable is None
    assert told.flash == pytest.approx(2.0, abs=0.3)
    assert "light: there is a flash on the camera" in caplog.text
    photos = photographs["room"]
    assert light_frame_of(photos, *hull_of(photos), "camera").flash is not None
    assert light_frame_of(photographs["flash"], *hull_of(photos), "world") == LightFrame()


@pytest.mark.parametrize(
    ("shade", "glint", "ahead", "lit"),
    [
        (0.3, 0.0, 5.0, True),
        (-0.1, 0.8, 5.0, True),  # metal
        (0.3, 0.0, 1.0, False),  # might be chance
        (0.02, 0.2, 9.0, False),  # as gloss in a room
    ],
)
def test_what_decides(photographs, monkeypatch, shade, glint, ahead, lit):
    found = light_frame.Flashed(shade, glint, ahead, 0.1)
    monkeypatch.setattr(light_frame, "explained_by_flash", lambda *_: found)
    photos = photographs["room"]
    assert (light_frame_of(photos, *hull_of(photos), "auto").flash is not None) == lit


@pytest.mark.parametrize(("saved", "lit"), [(0.1, False), (0.2, True)])
def test_a_flash_has_to_explain_more_than_a_turntable(photographs, monkeypatch, saved, lit):
    """Either is ahead of a still light: both move with the camera."""
    flashed = light_frame.Flashed(0.3, 0.0, 5.0, saved)
    turned = light_frame.Explained(0.1, 0.4, 9.0, 0.3)
    monkeypatch.setattr(light_frame, "explained_by_flash", lambda *_: flashed)
    monkeypatch.setattr(light_frame, "explained", lambda *_: turned)
    photos = photographs["room"]
    told = light_frame_of(photos, *hull_of(photos), "auto")
    assert (told.flash is not None, told.turntable is not None) == (lit, not lit)


def test_nothing_seen_tells_nothing(photographs):
    photos = photographs["room"]
    seen = observe_hull(photos, *hull_of(photos), 100)
    black = replace(seen, color=torch.zeros_like(seen.color))
    assert explained_by_flash(black).ahead < 0


def test_trials_leave_the_flash_as_it_was(monkeypatch):
    scene = with_flash(sphere_scene(32))
    problem = replace(problem_on_a_sphere(100, 4, 32, scene), flash=scene.flash)

    def brighten(scene, *_):
        scene.flash.log_radiance.data += 1.0
        return NewtonRound([math.inf])

    monkeypatch.setattr(metals, "newton_round_", brighten)
    before = scene.flash.log_radiance.clone()
    metals.initialise_(scene, problem, no_metal(problem), JointConfig(), math.inf)
    assert torch.equal(scene.flash.log_radiance, before)


def test_every_stage_trains_it_but_the_polish():
    scene = with_flash(sphere_scene(32))
    problem = replace(problem_on_a_sphere(10, 2, 32, scene), flash=scene.flash)
    intensity = scene.flash.log_radiance
    assert any(p is intensity for p in parameters_of(joint_solve.adam(scene, problem)))
    assert any(p is intensity for p in parameters_of(build_optimizer(scene, refit=False)))
    assert intensity.requires_grad
    build_optimizer(scene, refit=True)
    assert not intensity.requires_grad


def test_a_flash_is_a_light_beside_the_map():
    scene = sphere_scene(32)
    problem = problem_on_a_sphere(10, 2, 32, scene)
    assert has_one_light(scene, problem)
    assert not has_one_light(scene, replace(problem, flash=Flash(2.0)))


def test_doubt_knows_how_far_each_camera_is_from_a_point():
    """Of a scene without a map, which is shaded as rays are."""
    plain = sphere_scene(0).eval()
    lit = with_flash(plain)
    seen = replace(random_problem().observations, eye=torch.randn(4, 3) * 3)
    surface = Surface(
        *(seen.position, seen.normal, torch.zeros(5, plain.cfg.channels), torch.rand(5, 3)),
        *(torch.full((5,), 0.5), torch.ones(5), torch.ones(5)),
        metallic=torch.zeros(5),
    )
    point, which = torch.tensor([0, 2, 4]), torch.tensor([3, 9, 18])
    of = surface, seen, None, point, which
    added = confidence.render(lit, *of) - confidence.render(plain, *of)
    away = seen.away(point, which)
    f0 = torch.full((3, 3), brdf.F0)
    material = surface.albedo[point], surface.roughness[point], f0
    shown = lit.flash.reflected(seen.normal[point], seen.wo[which], away, *material)
    assert shown.max() > 1e-3
    assert torch.allclose(added, shown, atol=1e-5)
