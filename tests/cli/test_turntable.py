"""Photographs of a turntable: that the light turned is found, and the materials under it."""

from dataclasses import replace

import pytest
import torch
from analytic import cameras_around, hull_of, scene_of, sphere_scene
from balls import surface_at
from observed_points import (
    BLUE,
    RED,
    Steps,
    lamps,
    no_metal,
    photographed,
    photographs_under,
    problem_on_a_sphere,
)

from univoxel.color import linear_to_srgb, srgb_to_linear
from univoxel.config import JointConfig
from univoxel.errors import ConfigError, DataError
from univoxel.lights import EnvmapConfig
from univoxel.lights.views import Table, Turntable, resampling, rotated
from univoxel.preparation import light_frame
from univoxel.preparation.hull import observe_hull
from univoxel.preparation.light_frame import (
    VARIED,
    LightFrame,
    explained,
    light_frame_of,
    varied_light,
)
from univoxel.render.observations import TurnedMaps, shade_observations, turned_maps
from univoxel.render.pipeline import extract_mesh, radiance_of, shade
from univoxel.scene import Scene, load_scene, save_scene
from univoxel.sphere import random_rotation
from univoxel.training import joint_solve
from univoxel.training.equations import channel_radiance
from univoxel.training.newton import linear_transport, newton_round_

NODES, VIEWS = 128, 16
TURNTABLE = Turntable.of(cameras_around(VIEWS))


def turning(scene: Scene) -> Scene:
    other = Scene(replace(scene.cfg, turntable=TURNTABLE), scene.field, scene.inv_s)
    other.load_state_dict(scene.state_dict())
    return other


def turned_lamps() -> torch.Tensor:
    """What the lamps are in the world of each photograph: [V, D, 3]."""
    map = lamps(NODES)
    turn = TURNTABLE.turn(cameras_around(VIEWS).camera_to_world[:, :, 3])
    return (
        resampling(torch.nn.functional.normalize(sphere_scene(NODES).sky.direction, dim=1), turn)
        @ map
    )


@pytest.fixture(scope="module")
def photographs():
    """The same sphere under lamps that stand still, and under lamps that turn with the camera."""
    return {
        "still": photographs_under(lamps(NODES), 0.3, VIEWS),
        "turning": photographs_under(turned_lamps(), 0.3, VIEWS),
    }


@pytest.mark.parametrize("light", ["still", "turning"])
def test_which_light_it_was(photographs, light, caplog):
    caplog.set_level("INFO", "univoxel")
    photos = photographs[light]
    found = explained(observe_hull(photos, *hull_of(photos), 1500), TURNTABLE)
    told = light_frame_of(photos, *hull_of(photos), "auto")
    if light == "still":
        assert found.by_still_light > 2 * found.by_turning_light
        assert found.ahead < -3
        assert told == LightFrame()
        assert not caplog.text
    else:
        assert found.by_turning_light > 2 * found.by_still_light
        assert found.ahead > 3
        assert told == LightFrame(TURNTABLE)
        assert "light: it rotates with the camera, as on a turntable" in caplog.text


def test_light_of_its_own_for_each_photograph_is_found(monkeypatch):
    """Lamps that are turned at random from photograph to photograph; exposures are no light."""
    generator = torch.Generator().manual_seed(1)
    turn = torch.stack([random_rotation(generator) for _ in range(VIEWS)])
    maps = resampling(
        torch.nn.functional.normalize(sphere_scene(NODES).sky.direction, dim=1), turn
    ) @ lamps(NODES)
    differ, still = photographs_under(maps, 0.3, VIEWS), photographs_under(lamps(NODES), 0.3, VIEWS)
    gains = torch.linspace(-0.5, 0.5, VIEWS)[torch.randperm(VIEWS, generator=generator)]
    linear = srgb_to_linear(still.color.float() / 255) * (gains - 0.5).exp()[:, None, None, None]
    exposed = replace(still, color=(255 * linear_to_srgb(linear)).round().to(torch.uint8))
    assert varied_light(differ, *hull_of(differ), None) > 2 * VARIED
    assert varied_light(still, *hull_of(still), None) < VARIED / 2
    assert varied_light(exposed, *hull_of(exposed), gains) < VARIED / 2
    monkeypatch.setattr(light_frame, "VARIED_SHARE", 0.999)  # what is mirrored is no light
    assert varied_light(differ, *hull_of(differ), None) == 0
    black = replace(still, color=torch.zeros_like(still.color))
    assert varied_light(black, *hull_of(black), None) == 0


def test_exposures_are_no_light(photographs):
    """Each photograph is as bright as another: what is left is how the light turned."""
    photos, gains = photographs["turning"], torch.linspace(-1.0, 0.0, VIEWS)[torch.randperm(VIEWS)]
    linear = srgb_to_linear(photos.color.float() / 255) * gains.exp()[:, None, None, None]
    color = (255 * linear_to_srgb(linear)).round().to(torch.uint8)
    observations = observe_hull(replace(photos, color=color), *hull_of(photos), 1500)
    told, untold = (explained(observations, TURNTABLE, known) for known in (gains, None))
    assert told.saved > 2 * untold.saved
    assert told.ahead > 3


@pytest.mark.parametrize(
    ("still_around", "ahead", "saved", "turns"),
    [
        (None, 3, 0.1, True),
        (None, 1, 0.1, False),  # might be chance
        (None, 9, 0.01, False),  # sure, but next to nothing
        (False, 3, 0.1, True),  # a scale on the turntable moves, too
        (True, -1, 0.0, True),
        (True, -3, 0.0, False),
    ],
)
def test_what_decides(photographs, monkeypatch, caplog, still_around, ahead, saved, turns):
    caplog.set_level("INFO", "univoxel")
    found = light_frame.Explained(-0.02, 0.3, ahead, saved)
    monkeypatch.setattr(light_frame, "explained", lambda *_: found)
    monkeypatch.setattr(light_frame, "surroundings_stand_still", lambda _: still_around)
    photos = photographs["still"]
    found = light_frame_of(photos, *hull_of(photos), "auto")
    assert (found.turntable is not None) == turns
    assert found.flash is None
    if turns:
        assert "(fixed light: 0 %)" in caplog.text


def test_a_turntable_without_an_axis(photographs):
    photos = photographs["still"]
    pose = photos.cameras.camera_to_world.clone()
    # Every other on its side
    pose[::2, :, :2] = torch.stack([pose[::2, :, 1], -pose[::2, :, 0]], 2)
    tumbled = replace(photos, cameras=replace(photos.cameras, camera_to_world=pose))
    with pytest.raises(DataError, match="light_frame=turntable needs cameras around one"):
        light_frame_of(tumbled, *hull_of(photos), "turntable")
    assert light_frame_of(tumbled, *hull_of(photos), "auto") == LightFrame()
    # What is known is not looked for
    assert light_frame_of(photos, *hull_of(photos), "turntable").turntable == TURNTABLE
    assert light_frame_of(photographs["turning"], *hull_of(photos), "world") == LightFrame()


def test_the_equations_see_the_map_as_the_renders_do():
    """Newton's linear transport against the shading of observations, map by map."""
    scene = turning(scene_of((0.5, 0.4, 0.3), 0.4, NODES, lamps(NODES)))
    problem = problem_on_a_sphere(20, 4, NODES, scene)
    eye = cameras_around(VIEWS).camera_to_world[:4, :, 3]
    problem = replace(problem, observations=replace(problem.observations, eye=eye))
    problem = replace(problem, turned=turned_maps(scene, problem.observations))
    point, observation = torch.arange(20), torch.arange(80).view(20, 4)
    rough = torch.full((20,), 0.5)
    with torch.no_grad():
        transport = linear_transport(problem, point, observation, rough, False)
        albedo = torch.full((20, 3), 0.5)
        index = point.repeat_interleave(4)
        shaded = shade_observations(
            *(scene, problem, index, observation.flatten(), problem.observations.normal[index]),
            *(albedo[index], rough[index], torch.full((80, 3), 0.04)),
        )
        for c in range(3):
            _, radiance = channel_radiance(transport, scene.sky.radiance, albedo.log(), c, None)
            # The split sum of the diffuse layer's share is an approximation of its quadrature
            torch.testing.assert_close(radiance.flatten(), shaded[:, c], rtol=0.03, atol=1e-3)
    still = replace(problem, turned=None)
    flat = linear_transport(still, point, observation, rough, False)
    _, other = channel_radiance(flat, scene.sky.radiance, albedo.log(), 0, None)
    assert (other.flatten() - shaded[:, 0]).abs().max() > 0.1  # the frame matters


def test_light_is_white_where_photographs_do_not_tell():
    """Matte paint is as brown under white light as it is white under brown light."""

    def tint_found(turned: bool) -> float:
        torch.manual_seed(0)
        scene = scene_of((0.5, 0.5, 0.5), 0.9, NODES)
        problem = problem_on_a_sphere(300, 8, NODES, scene)
        white = torch.full((NODES, 3), 0.7) * lamps(NODES).mean(1, keepdim=True)
        paint, rough = torch.tensor([0.4, 0.25, 0.1]).expand(300, 3), torch.full((300,), 0.9)
        problem = photographed(problem, white, paint, rough)
        noisy = problem.target + 0.02 * torch.randn_like(problem.target)
        still = TurnedMaps(torch.eye(NODES)[None], torch.zeros(8, dtype=torch.long))
        problem = replace(problem, target=noisy, turned=still if turned else None)
        with torch.no_grad():
            scene.sky.log_radiance.copy_((white * torch.tensor([1.6, 1.0, 0.6])).log())
        cfg = JointConfig(newton_points=300, newton_views=8, newton_steps=6)
        assert newton_round_(scene, problem, no_metal(problem), cfg).costs
        log_map = scene.sky.log_radiance.detach().mean(0)
        return float(log_map.max() - log_map.min())

    assert tint_found(True) < 0.1
    assert tint_found(False) > 0.3


def test_solve_finds_map_and_albedo_under_light_that_turns(photographs):
    scene = turning(sphere_scene(NODES))
    cfg = JointConfig(points=800, newton_points=800, rays=512, tracing=1, rounds=3)
    # The trials leave a map 1.5 times too bright for grey materials: 300 steps are too few
    joint_solve.solve(scene, photographs["turning"], cfg, 0, Steps(cfg.iterations))
    mesh = extract_mesh(scene)
    x = mesh.vertices[:, 0]
    ratio = torch.stack([mesh.albedo[x > 0.1].mean(0) / RED, mesh.albedo[x < -0.1].mean(0) / BLUE])
    assert (ratio[0] / ratio[1] - 1).abs().max() < 0.2
    wanted = lamps(NODES).mean(1)
    found = scene.sky.radiance.detach().mean(1)
    correlation = torch.corrcoef(torch.stack([wanted.log(), found.log()]))[0, 1]
    assert correlation > 0.8  # half of the sphere is seen by highlights alone


def test_both_renders_follow_the_camera():
    """What is shown of a point depends on where the camera stands, not on the world."""
    scene = turning(sphere_scene(NODES)).eval()
    eye = cameras_around(VIEWS).camera_to_world[:, :, 3]
    turn = TURNTABLE.turn(eye)
    here = torch.nn.functional.normalize(torch.tensor([[0.5, 0.2, 0.6]]), dim=1).expand(VIEWS, 3)
    wo = rotated(turn.transpose(1, 2), here)  # as the first camera sees it
    at = {"features": torch.zeros(VIEWS, 4), "depth": torch.full((VIEWS,), 2.0)}
    surface = surface_at(eye - 2.0 * wo, wo, roughness=0.3, **at)
    still = sphere_scene(NODES).eval()
    with torch.no_grad():
        for render in (radiance_of, shade):
            seen, other = render(scene, surface, wo), render(still, surface, wo)
            # All lie in one frame of the light, but for the rounding of their turns
            torch.testing.assert_close(seen, seen[:1].expand_as(seen), atol=1e-4, rtol=0)
            assert (other - other[:1]).abs().max() > 1e-2


@pytest.mark.parametrize("laid", [1, 2])
def test_a_checkpoint_keeps_the_axes(laid, tmp_path):
    """Those of before an object could be laid anew have neither eyes nor others."""
    kept = TURNTABLE
    if laid == 2:
        one = TURNTABLE.point, TURNTABLE.axis, TURNTABLE.start
        kept = Turntable(*one, ((1.0, 2.0, 3.0),), (Table(*one, ((0.0, 1.0, 0.5),)),))
    scene = sphere_scene(NODES)
    save_scene(Scene(replace(scene.cfg, turntable=kept), scene.field, scene.inv_s), tmp_path, {})
    assert load_scene(tmp_path).cfg.turntable == kept
    for changes, message in (
        ({"light": EnvmapConfig()}, "needs light=hybrid, sg, sh or mlp, got envmap"),
        ({"varying": "light"}, "cannot also differ"),
    ):
        with pytest.raises(ConfigError, match=message):
            replace(scene.cfg, turntable=TURNTABLE, **changes)
