"""What differs from view to view: light of its own, a flash at the lens, an object that turns."""

import math
from dataclasses import replace

import pytest
import torch
from analytic import cameras_around, cameras_at, hull_of, on_circle, sphere_scene
from balls import ball, views
from observed_points import lamps, no_metal, photographs_under, problem_on_a_sphere, random_problem
from scipy.spatial.transform import Rotation
from torch.nn.functional import normalize

from univoxel import brdf
from univoxel.camera import Cameras, circle_of
from univoxel.color import linear_to_srgb_unclipped
from univoxel.config import JointConfig
from univoxel.core.records import Surface
from univoxel.errors import ConfigError
from univoxel.evaluation import confidence
from univoxel.lights import MLPLightConfig, SGConfig, SHConfig
from univoxel.lights.views import Flash, Table, Turntable, ViewLights, resampling, rotated
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
from univoxel.sphere import fibonacci_sphere
from univoxel.training import joint_solve, metals
from univoxel.training.equations import channel_radiance
from univoxel.training.loop import build_optimizer
from univoxel.training.newton import NewtonRound, linear_transport, newton_round_

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
    change = lights.sky_change().detach()
    assert change.std() > 0.1
    # Harmonics of degree 1 to 3 have no mean over the sphere, but for the 40 directions' unevenness
    assert change.mean(1).abs().max() < 0.1 * change.std()


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
    """The same sphere in a room, and there with a flash too: photographs, hull and its grid."""
    both = {
        name: photographs_under(0.5 * lamps(128), 0.3, VIEWS, flash=lamp)
        for name, lamp in (("room", None), ("flash", Flash(2.0)))
    }
    return {name: (photos, *hull_of(photos)) for name, photos in both.items()}


def test_photographs_tell_of_a_flash(photographs, caplog):
    caplog.set_level("INFO", "univoxel")
    found = {
        name: explained_by_flash(observe_hull(*seen, 1500)) for name, seen in photographs.items()
    }
    assert found["room"].shade < 0.05
    assert found["flash"].shade > 0.3
    assert found["flash"].ahead > 5
    told = light_frame_of(*photographs["flash"], "auto")
    assert told.turntable is None
    assert told.flash == pytest.approx(2.0, abs=0.3)
    assert "light: there is a flash on the camera" in caplog.text
    assert light_frame_of(*photographs["room"], "camera").flash is not None
    assert light_frame_of(*photographs["flash"], "world") == LightFrame()


@pytest.mark.parametrize(
    ("shade", "glint", "ahead", "saved", "turned", "lit"),
    [
        (0.3, 0.0, 5.0, 0.1, 0.0, True),
        (-0.1, 0.8, 5.0, 0.1, 0.0, True),  # metal
        (0.3, 0.0, 1.0, 0.1, 0.0, False),  # might be chance
        (0.02, 0.2, 9.0, 0.1, 0.0, False),  # as gloss in a room
        # It has to explain more than a turntable does: both are ahead of a still light
        (0.3, 0.0, 5.0, 0.1, 9.0, False),
        (0.3, 0.0, 5.0, 0.2, 9.0, True),
    ],
)
def test_what_decides_on_a_flash(photographs, monkeypatch, shade, glint, ahead, saved, turned, lit):
    found = light_frame.Flashed(shade, glint, ahead, saved)
    monkeypatch.setattr(light_frame, "explained_by_flash", lambda *_: found)
    if turned:
        around = light_frame.Explained(0.1, 0.4, turned, 0.3)
        monkeypatch.setattr(light_frame, "explained", lambda *_: around)
    told = light_frame_of(*photographs["room"], "auto")
    assert (told.flash is not None) == lit
    assert (told.turntable is not None) == (bool(turned) and not lit)


def test_nothing_seen_tells_nothing(photographs):
    seen = observe_hull(*photographs["room"], 100)
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


TILTED = Rotation.from_rotvec([0.4, -0.3, 0.2])


def ring(count: int = 12, height: float = 0.5, tilt: Rotation | None = None) -> Cameras:
    """Level cameras around the origin, from azimuth 0 on; in a world that may be tilted."""
    level = cameras_at(on_circle(count, 3.0, 3 * height), 32, 30.0)
    return level if tilt is None else tilted(level, tilt)


def tilted(cameras: Cameras, tilt: Rotation) -> Cameras:
    turn = torch.from_numpy(tilt.as_matrix()).float()
    return replace(cameras, camera_to_world=turn @ cameras.camera_to_world)


@pytest.mark.parametrize("tilt", [None, TILTED])
def test_the_axis_is_what_level_cameras_stand_around(tilt):
    turntable = Turntable.of(ring(tilt=tilt))
    up = [0.0, 0.0, 1.0] if tilt is None else tilt.apply([0.0, 0.0, 1.0]).tolist()
    assert turntable.axis == pytest.approx(up, abs=1e-5)
    assert turntable.point == pytest.approx([0, 0, 0], abs=1e-3)
    assert turntable.start == pytest.approx(
        [1, 0, 0] if tilt is None else tilt.apply([1.0, 0, 0]).tolist(), abs=1e-3
    )


def test_light_turns_as_the_camera_does():
    """What the camera sees straight ahead lies in the same direction of the light's frame."""
    cameras = ring(tilt=TILTED)
    turntable = Turntable.of(cameras)
    eye, back = cameras.camera_to_world[:, :, 3], cameras.camera_to_world[:, :, 2]
    turn = turntable.turn(eye)
    lit = rotated(turn, back)
    torch.testing.assert_close(lit, back[:1].expand_as(lit), atol=2e-3, rtol=0)
    torch.testing.assert_close(rotated(turn[:1], back[:1]), back[:1])
    torch.testing.assert_close(turn @ turn.transpose(1, 2), torch.eye(3).expand_as(turn))
    rounded = turntable.turn(eye[:1], 64) @ turn[:1].transpose(1, 2)
    torch.testing.assert_close(rounded, torch.eye(3)[None], atol=1e-5, rtol=0)


def laid_anew(roll: float) -> tuple[Cameras, Rotation]:
    """A ring of cameras, and one around the object after it was rolled over, in its own world."""
    over = Rotation.from_rotvec([roll, 0.2, 0.0])
    first, second = ring(16), ring(12, height=0.8, tilt=over)
    poses = torch.cat([first.camera_to_world, second.camera_to_world])
    return replace(ring(28), camera_to_world=poses), over


@pytest.mark.parametrize("roll", [math.pi, 2.3, math.pi / 2])
def test_an_object_laid_anew_has_another_axis(roll):
    """What hangs above the turntable stays above it, and the camera at its side of the room."""
    cameras, over = laid_anew(roll)
    turntable = Turntable.of(cameras)
    assert [len(table.eyes) for table in turntable.tables] == [16, 12]
    assert turntable.others[0].axis == pytest.approx(over.apply([0, 0, 1]).tolist(), abs=1e-4)
    eye, back = cameras.camera_to_world[:, :, 3], cameras.camera_to_world[:, :, 2]
    turn = turntable.turn(eye)
    above = torch.tensor([[0.0, 0.0, 1.0]])
    lamp = torch.cat([above.expand(16, 3), torch.tensor(over.apply(above)).expand(12, 3).float()])
    torch.testing.assert_close(rotated(turn, lamp), above.expand(28, 3), atol=1e-3, rtol=0)
    assert rotated(turn, back)[:, 1].abs().max() < 2e-3  # all in the plane of the first camera
    assert (rotated(turn, back)[:, 0] > 0.7).all()  # at the first camera's side
    assert turntable.laid(eye + 0.05).tolist() == 16 * [0] + 12 * [1]
    # From a camera on, the light turns on about the axis of its own table
    between = torch.nn.functional.normalize(eye[16] + eye[17], dim=0) * eye[16].norm()
    step = turntable.turn(between) @ turn[16].T
    assert Rotation.from_matrix(step.numpy()).magnitude() == pytest.approx(math.pi / 12, abs=0.02)


def test_a_few_cameras_on_their_heads_are_no_table():
    cameras, _ = laid_anew(math.pi)
    assert not Turntable.of(cameras.of(torch.arange(20))).others


def test_a_map_is_resampled_to_what_it_is_in_the_world():
    """Against the formula of a smooth light that is turned."""
    cameras, direction = ring(), fibonacci_sphere(512)
    turntable = Turntable.of(cameras)
    turn = turntable.turn(cameras.camera_to_world[:, :, 3])

    def light(w):  # in its own frame
        return 2 + w @ torch.tensor([0.8, -0.5, 0.6])

    weights = resampling(direction, turn)
    found = weights @ light(direction)
    wanted = light(rotated(turn[:, None], direction))
    torch.testing.assert_close(weights.sum(2), torch.ones(12, 512))
    assert (found - wanted).abs().max() < 0.05  # the nodes' Gaussians blur it a little
    # None that rounding swallows: times what a point sees of them they would be denormals, on which
    # processors crawl
    assert (weights == 0).double().mean() > 0.8
    assert weights[weights > 0].min() >= torch.finfo(torch.float32).eps


def test_cameras_that_are_not_level_say_nothing():
    tumbled = ring()
    turns = torch.from_numpy(Rotation.random(12, random_state=0).as_matrix()).float()
    poses = tumbled.camera_to_world.clone()
    poses[:, :, :3] = poses[:, :, :3] @ turns
    assert Turntable.of(replace(tumbled, camera_to_world=poses)) is None
    assert Turntable.of(ring().of(torch.arange(2))) is None
    assert Turntable.of(cameras_around(12)) is not None


def test_a_camera_that_was_aimed_anew_stood_still_all_the_same():
    """On a ball head below its pan the view turns and rolls: the circle of centres tells more."""
    cameras = ring(24, tilt=TILTED)
    pose = cameras.camera_to_world.clone()
    angle = 2 * math.pi * torch.arange(24) / 24
    aim = Rotation.from_rotvec(torch.stack([0 * angle, 0.06 * angle.sin(), 0 * angle], 1).numpy())
    pose[:, :, :3] = pose[:, :, :3] @ torch.from_numpy(aim.as_matrix()).float()
    turntable = Turntable.of(replace(cameras, camera_to_world=pose))
    exact = Turntable.of(cameras)
    assert turntable.axis == pytest.approx(exact.axis, abs=1e-4)
    away = torch.tensor(turntable.point) - torch.tensor(exact.point)
    axis = torch.tensor(exact.axis)
    assert (away - (away @ axis) * axis).norm() < 1e-3


def test_level_cameras_on_an_inclined_circle_were_carried_around_it():
    """What is up is then said by how they were held: nobody inclines a turntable so far."""
    inclined = Rotation.from_rotvec([0.6, 0, 0])
    place = torch.from_numpy(inclined.apply(on_circle(24, 3.0, 0.9).numpy())).float()
    cameras = cameras_at(place, 32, 30.0)
    assert circle_of(cameras) is not None
    assert Turntable.of(cameras).axis[2] > 0.99


def test_axis_and_start_are_across():
    with pytest.raises(ConfigError, match="axis and start must be perpendicular unit vectors"):
        Turntable((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, 0.6, 0.8))
    with pytest.raises(ConfigError, match="axis and start must be perpendicular"):
        Turntable((0.0, 0.0, 0.0), (0.0, 0.0, 2.0), (1.0, 0.0, 0.0))
    one = (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), (1.0, 0.0, 0.0)
    with pytest.raises(ConfigError, match="each needs camera positions"):
        Turntable(*one, others=(Table(*one, eyes=((1.0, 0.0, 0.0),)),))
