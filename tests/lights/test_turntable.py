"""Light that turns with the camera: the axis, and directions in the light's frame."""

import math
from dataclasses import replace

import pytest
import torch
from analytic import cameras_around, look_at
from scipy.spatial.transform import Rotation

from univoxel.camera import Cameras, circle_of
from univoxel.errors import ConfigError
from univoxel.lights.views import Table, Turntable, resampling, rotated
from univoxel.sphere import fibonacci_sphere

TILTED = Rotation.from_rotvec([0.4, -0.3, 0.2])


def ring(count: int = 12, height: float = 0.5, tilt: Rotation | None = None) -> Cameras:
    """Level cameras around the origin, from azimuth 0 on; in a world that may be tilted."""
    angle = 2 * math.pi * torch.arange(count) / count
    place = torch.stack([angle.cos(), angle.sin(), torch.full((count,), height)], 1)
    poses = torch.stack([look_at(3 * p) for p in place])
    if tilt is not None:
        poses = torch.from_numpy(tilt.as_matrix()).float() @ poses
    focal = torch.full((count, 2), 30.0)
    return Cameras(poses, focal, torch.full((count, 2), 16.0), 32, 32)


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
    first, second = ring(16), ring(12, height=0.8)
    over = Rotation.from_rotvec([roll, 0.2, 0.0])
    turned = torch.from_numpy(over.as_matrix()).float() @ second.camera_to_world
    poses = torch.cat([first.camera_to_world, turned])
    sizes = torch.full((28, 2), 30.0), torch.full((28, 2), 16.0)
    return Cameras(poses, *sizes, 32, 32), over


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


def test_a_turned_map_has_no_weight_that_rounding_swallows():
    """Times what a point sees of them they would be denormals, on which processors crawl."""
    cameras = ring()
    turntable = Turntable.of(cameras)
    turn = turntable.turn(cameras.camera_to_world[:, :, 3])
    weights = resampling(fibonacci_sphere(512), turn)
    assert (weights == 0).double().mean() > 0.8
    assert weights[weights > 0].min() >= torch.finfo(torch.float32).eps


def test_cameras_that_are_not_level_say_nothing():
    tumbled = ring()
    turns = torch.from_numpy(Rotation.random(12, random_state=0).as_matrix()).float()
    poses = tumbled.camera_to_world.clone()
    poses[:, :, :3] = poses[:, :, :3] @ turns
    assert Turntable.of(Cameras(poses, tumbled.focal, tumbled.centre, 32, 32)) is None
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
    angle = 2 * math.pi * torch.arange(24) / 24
    place = torch.stack([angle.cos(), angle.sin(), 0 * angle + 0.3], 1)
    place = torch.from_numpy(inclined.apply(3 * place.numpy())).float()
    sizes = torch.full((24, 2), 30.0), torch.full((24, 2), 16.0)
    cameras = Cameras(torch.stack([look_at(p) for p in place]), *sizes, 32, 32)
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
