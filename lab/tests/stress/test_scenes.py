"""Scenes of the stress suite: shapes, cameras, light and truth agree with one another."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from lab.stress import render, scenes, shapes
from lab.stress.scenes import Spec
from univoxel.camera import image_rays, project
from univoxel.data import load_cameras, load_points, relight_maps
from univoxel.envmap import EnvMap, lookup
from univoxel.sphere import latlong_directions, texel_solid_angles

SPECS = {
    "figure": Spec(size=48, views=8, tests=2),
    "box": Spec("box", 0.7, size=48, views=8, tests=2),
    "rods": Spec("rods", 0.08, size=48, views=8, tests=2),
    "fur": Spec("fur", 0.1, size=48, views=8, tests=2),
}


@pytest.fixture(scope="module", params=SPECS)
def scene(request):
    spec = SPECS[request.param]
    return spec, scenes.parts_of(spec)


def volume(part):
    corners = part.vertices[part.faces].astype(float)
    a, b, c = corners.transpose(1, 0, 2)
    return (np.cross(a, b) * c).sum() / 6


def test_parts_are_closed_and_face_outwards(scene):
    _, parts = scene
    for part in parts:
        edges = np.concatenate([part.faces[:, [i, (i + 1) % 3]] for i in range(3)])
        keys = [np.unique(e @ [1, len(part.vertices)]) for e in (edges, edges[:, ::-1])]
        assert (keys[0] == keys[1]).all()  # every edge is there both ways
        assert len(keys[0]) == len(edges)
        assert volume(part) > 0
        corners = part.vertices[part.faces]
        face = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        area = np.linalg.norm(face, axis=1)
        cosine = (face * part.normals[part.faces[:, 0]]).sum(1) / np.maximum(area, 1e-12)
        # Slivers aside, a face looks the way its corners do: of a hair with six sides within 30
        # degrees, but for its foot
        hair = len(part.faces) == 12 * shapes.HAIRS
        assert np.average(cosine, weights=area) > (0.8 if hair else 0.98)
        np.testing.assert_allclose(np.linalg.norm(part.normals, axis=1), 1, atol=1e-5)
        assert ((part.base >= 0) & (part.base <= 1)).all()


def test_a_ball_and_a_ring_have_their_volumes():
    ring, ball, _ = shapes.build("figure", 0, 0.5, 1)
    # Chords of a grid of 1/30 of the radius: a fraction of a percent
    assert volume(ball) == pytest.approx(4 / 3 * math.pi * 0.38**3, rel=3e-3)
    assert volume(ring) == pytest.approx(2 * math.pi**2 * 0.34 * 0.08**2, rel=1e-2)
    assert [p.metallic for p in (ring, ball)] == [1.0, 0.0]
    np.testing.assert_allclose(
        np.linalg.norm(ball.vertices - [0, 0, 0.19], axis=1), 0.38, atol=1e-5
    )


def test_rods_are_as_thick_as_asked_for():
    for diameter in (0.16, 0.02):
        rod = shapes.build("rods", diameter, 0.5, 0)[-1]
        centre = rod.vertices.mean(0)
        _, _, (axis, *_) = np.linalg.svd(rod.vertices - centre, full_matrices=False)
        beside = (rod.vertices - centre) - ((rod.vertices - centre) @ axis)[:, None] * axis
        assert 2 * np.linalg.norm(beside, axis=1).max() == pytest.approx(diameter, rel=1e-3)


def test_hairs_stand_on_the_ball_as_long_as_asked_for():
    assert len(shapes.build("fur", 0.0, 0.5, 0)) == 1
    skin, hairs = shapes.build("fur", 0.1, 0.5, 0)
    each = hairs.vertices.reshape(shapes.HAIRS, -1, 3)
    tip, foot = each[:, -2], each[:, -1]
    np.testing.assert_allclose(np.linalg.norm(tip - foot, axis=1), 0.1 + 0.03, atol=1e-5)
    assert (np.linalg.norm(foot, axis=1) < shapes.FUR_RADIUS).all()  # rooted below the skin
    # As far around the ball as its own skin is near: none is bald
    root = foot / np.linalg.norm(foot, axis=1, keepdims=True)
    from_above = (skin.vertices[::50] / shapes.FUR_RADIUS) @ root.T
    assert np.degrees(np.arccos(from_above.max(1).clip(-1, 1))).max() < 4


def test_an_unknown_shape():
    with pytest.raises(ValueError, match="shape must be of figure, box, rods, fur, got 'cube'"):
        shapes.build("cube", 1, 0.5, 0)


def test_the_whole_object_is_in_every_picture_and_in_its_mask(scene):
    spec, parts = scene
    points = torch.from_numpy(scenes.surface_points(parts, 2000))
    assert len(points) == 2000
    for cameras in (scenes.train_cameras(spec), scenes.test_cameras(spec)):
        for view in range(len(cameras)):
            pixel, depth = project(cameras, view, points)
            assert (depth > 0).all()
            assert (pixel > 0).all()
            assert (pixel < spec.size).all()
    truth = scenes.truth_of_view(parts, cameras, 0)
    column, row = project(cameras, 0, points)[0].long().unbind(1)
    # A point on the rim may fall into a pixel that no ray of its grid meets
    assert (truth["alpha"][row, column] > 0).mean() > 0.99


def test_points_lie_on_what_can_be_seen():
    _, ball, box = parts = shapes.build("figure", 0, 0.5, 0)
    points = scenes.surface_points(parts, 4000)
    assert (np.linalg.norm(points - [0, 0, 0.19], axis=1) > 0.379).all()  # none inside the ball
    assert ball.vertices[:, 2].min() == pytest.approx(box.vertices[:, 2].max(), abs=1e-3)


def test_any_first_cameras_are_spread():
    cameras = scenes.train_cameras(Spec(views=80)).camera_to_world[:, :, 3]
    torch.testing.assert_close(cameras.norm(dim=1), torch.full((80,), scenes.DISTANCE))
    for count in (6, 12, 40):
        z = cameras[:count, 2] / scenes.DISTANCE
        gaps = torch.cat([z.new_tensor([-0.4]), z.sort().values, z.new_tensor([0.95])]).diff()
        # A low-discrepancy sequence leaves no gap above a few times the mean
        assert gaps.max() < 3 * 1.35 / count
    shifted = scenes.train_cameras(Spec(views=4, shift=0.5)).camera_to_world[:, :, 3]
    away = shifted - scenes.train_cameras(Spec(views=4)).camera_to_world[:, :, 3]
    torch.testing.assert_close(away.norm(dim=1), torch.full((4,), 0.5))


def test_truth_is_that_of_a_ball():
    _, ball, _ = shapes.build("figure", 0, 0.3, 0)
    cameras = scenes.test_cameras(Spec(size=32, tests=1))
    truth = scenes.truth_of_view([ball], cameras, 0)
    rays = image_rays(cameras, 0)
    out = rays.origin - torch.tensor([0.0, 0.0, 0.19])
    b = (out * rays.direction).sum(1)
    root = (b.square() - out.square().sum(1) + 0.38**2).clamp_min(0).sqrt()
    t = -b - root
    inside = torch.from_numpy(truth["alpha"] == 255).flatten()
    assert 30 < inside.sum() < 400
    normal = ((out + t[:, None] * rays.direction) / 0.38)[inside]
    found = torch.from_numpy(truth["normal"]).float().reshape(-1, 3)[inside]
    assert (found * normal).sum(1).min() > 0.98  # means over a pixel of 0.06, at the rim too
    depth = t * -(rays.direction @ cameras.camera_to_world[0, :, 2])
    found = torch.from_numpy(truth["depth"]).float().flatten()[inside]
    assert (found - depth[inside]).abs().median() < 2e-3  # half floats near 3: 1e-3
    assert set(np.unique(truth["roughness"][truth["alpha"] > 0])) == {np.float16(0.3)}


@pytest.mark.parametrize("name", ["room", "dusk", "studio"])
def test_light_is_as_bright_as_it_should_be(name):
    way, weight = latlong_directions(64), texel_solid_angles(64, 128)
    light = torch.from_numpy(scenes.radiance(name, way.double().numpy()))
    above = (light * (weight * way[..., 2].clamp_min(0))[..., None]).sum((0, 1)).mean()
    assert float(above) / math.pi == pytest.approx(scenes.BRIGHTNESS, rel=1e-3)
    assert light.min() > 0


def test_a_sun_takes_its_share_of_the_power():
    way, weight = latlong_directions(512), texel_solid_angles(512, 1024)[..., None]
    for share in (0.5, 0.95):
        soft, sunny = (
            (torch.from_numpy(scenes.radiance("room", way.double().numpy(), s)) * weight)
            for s in (0.0, share)
        )
        # Its colour has a mean near 1
        assert sunny.sum() / soft.sum() == pytest.approx(1, rel=0.03)
        kept = soft.sum() * (1 - share)
        assert (sunny.sum() - kept) / sunny.sum() == pytest.approx(share, rel=0.03)


def test_maps_hold_the_light():
    spec = Spec()
    way = torch.nn.functional.normalize(
        torch.randn(500, 3, generator=torch.Generator().manual_seed(0)), dim=1
    )
    found = lookup(EnvMap(torch.from_numpy(scenes.environment(spec, "dusk"))), way)
    wanted = torch.from_numpy(scenes.radiance("dusk", way.double().numpy())).float()
    torch.testing.assert_close(found, wanted, rtol=0.02, atol=0.01)  # smooth, 1.4 degrees a texel
    poles = scenes.environment(spec, "dusk", poles=True)
    assert np.ptp(poles[0], axis=0).max() < 1e-6  # one direction
    with pytest.raises(ValueError, match="light must be room, dusk or studio, got 'noon'"):
        scenes.radiance("noon", way.numpy())


def test_what_is_written_is_what_our_loaders_read(tmp_path):
    spec = Spec(size=16, views=3, tests=2)
    render.write_known(spec, tmp_path, scenes.parts_of(spec))
    names, cameras = load_cameras(tmp_path / "transforms_train.json", spec.size)
    assert names == ["r_000", "r_001", "r_002"]
    wanted = scenes.train_cameras(spec)
    torch.testing.assert_close(cameras.camera_to_world, wanted.camera_to_world)
    torch.testing.assert_close(cameras.focal, wanted.focal)
    assert len(load_points(tmp_path)) > 1000
    for name in scenes.RELIGHT:
        (tmp_path / "relight" / name).mkdir(parents=True)
    assert sorted(relight_maps(tmp_path)) == ["dusk", "studio"]


def test_a_hidden_part_casts_no_truth():
    """The foot of the ball is in the ring's hole: the nearest surface counts."""
    spec = SPECS["figure"]
    parts = scenes.parts_of(spec)
    cameras = scenes.test_cameras(spec)
    alone = scenes.truth_of_view(parts[1:2], cameras, 0)
    together = scenes.truth_of_view(parts, cameras, 0)
    both = (alone["alpha"] == 255) & (together["alpha"] == 255)
    assert (together["depth"][both] <= alone["depth"][both] + 5e-3).all()


@pytest.mark.parametrize("rings", [1, 2])
def test_rings_stand_level_around_the_axis(rings):
    spec = Spec(rings=rings, views=12, turning=True)
    cameras = scenes.train_cameras(spec)
    eye = cameras.camera_to_world[:, :, 3]
    assert len(eye[:, 2].round(decimals=4).unique()) == rings
    assert cameras.camera_to_world[:, 2, 0].abs().max() < 1e-6
    turned = scenes.light_azimuths(spec, cameras)
    assert turned[0] == 0
    x, y, _ = eye.numpy().T
    assert np.allclose(np.cos(turned), x / np.hypot(x, y))  # the first stands on +X
    assert scenes.light_azimuths(replace(spec, turning=False), cameras) is None
