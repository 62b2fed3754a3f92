"""Cameras that are learned beside the scene."""

from dataclasses import replace

import pytest
import torch
from analytic import cameras_around

from univoxel.camera import PoseSteps, pixel_rays, project

VIEWS = 12


def poses(pivot=(0.1, -0.2, 0.05), radius=0.5):
    """The cameras, and steps of theirs that are all 0."""
    cameras = cameras_around(VIEWS)
    found = PoseSteps(VIEWS)
    found.about(cameras, torch.tensor(pivot), radius)
    return cameras, found


def shaken(found, scale=0.02, seed=0):
    random = torch.Generator().manual_seed(seed)
    found.steps.data = scale * torch.randn(VIEWS, 6, generator=random)
    return found


def landmarks():
    return torch.rand(40, 3, generator=torch.Generator().manual_seed(3)) - 0.5


def seen(cameras):
    return torch.cat([project(cameras, v, landmarks())[0] for v in range(VIEWS)])


def test_no_steps_leave_cameras_as_they_are():  # to a rounding at coordinates of 2
    cameras, found = poses()
    torch.testing.assert_close(
        found.corrected(cameras).camera_to_world, cameras.camera_to_world, atol=3e-7, rtol=0
    )
    assert found.moved(cameras).max() < 1e-4


def test_corrected_cameras_are_rigid():
    cameras, found = poses()
    rotation = shaken(found, 0.2).corrected(cameras).camera_to_world[:, :, :3]
    torch.testing.assert_close(
        rotation @ rotation.mT, torch.eye(3).expand(VIEWS, 3, 3), atol=1e-6, rtol=0
    )
    torch.testing.assert_close(torch.linalg.det(rotation), torch.ones(VIEWS))


def common(found, kind):
    """Steps that all cameras have in common."""
    random = torch.Generator().manual_seed(5)
    if kind == "scale":
        return torch.cat([torch.zeros(VIEWS, 3), 0.3 * found.away], 1)
    vector = 0.1 * torch.randn(3, generator=random)
    three = vector.expand(VIEWS, 3)
    none = torch.zeros(VIEWS, 3)
    return torch.cat([three, none] if kind == "rotation" else [none, three], 1)


@pytest.mark.parametrize("kind", ["rotation", "translation", "scale"])
def test_what_all_cameras_share_is_left_out(kind):
    """Else the object would drift away from test views, and no photograph would say so."""
    cameras, found = poses()
    found.steps.data = common(found, kind)
    assert found.moved(cameras).max() < 1e-3  # fp32 at 16 pixels


def test_a_scale_of_the_world_is_what_away_says():
    """Cameras twice as far from the pivot differ from these by the mode that is left out."""
    cameras, found = poses()
    place = cameras.camera_to_world[:, :, 3] - found.pivot
    grown = 0.1 * (place - place.mean(0))
    share = (grown * found.away).sum() / grown.norm()
    assert share.item() == pytest.approx(1.0, abs=1e-6)


def test_wrong_cameras_are_found_from_landmarks():
    """Pixels of known points bring shaken cameras back, up to what all of them share."""
    truth, found = poses()
    wrong = shaken(poses()[1], 0.03, seed=1).eval().corrected(truth)
    target, before = seen(truth), (seen(truth) - seen(wrong)).square().sum(1).mean().sqrt()
    optimizer = torch.optim.Adam(found.parameters(), lr=3e-3)
    found.train()
    for _ in range(300):
        error = (seen(found.corrected(wrong)) - target).square().sum(1).mean()
        optimizer.zero_grad()
        error.backward()
        optimizer.step()
    assert before > 0.4  # pixels of 32
    assert error.sqrt() < 0.02 * before


def test_gradients_of_rays_are_those_of_differences():
    cameras, found = poses()
    double = replace(
        cameras,
        camera_to_world=cameras.camera_to_world.double(),
        focal=cameras.focal.double(),
        centre=cameras.centre.double(),
    )
    found = shaken(found).double().train()
    view = torch.arange(VIEWS)
    pixel = torch.rand(VIEWS, 2, generator=torch.Generator().manual_seed(2)).double() * 32

    weight = torch.randn(2, VIEWS, 3, dtype=torch.double)

    def loss():
        rays = pixel_rays(found.corrected(double), view, pixel)
        return (weight[0] * rays.origin + weight[1] * rays.direction).sum()

    loss().backward()
    along = torch.randn(VIEWS, 6, dtype=torch.double)
    ends = []
    for step in (1e-6, -1e-6):
        found.steps.data += step * along
        ends.append(loss().item())
        found.steps.data -= step * along
    slope = (ends[0] - ends[1]) / 2e-6
    assert (found.steps.grad * along).sum().item() == pytest.approx(slope, rel=1e-6)


def test_a_shift_moves_the_picture_by_its_pixels():
    """At distance 2 and focal length f a shift by d across moves the picture by f d / 2."""
    cameras, found = poses(pivot=(0.0, 0.0, 0.0), radius=1e-3)
    across = cameras.camera_to_world[:, :, 0]
    shift = torch.zeros(VIEWS, 3)
    shift[4] = 10 * across[4]  # in radii
    found.steps.data[:, 3:] = shift
    moved = found.moved(cameras)
    whole = cameras.focal[4, 0] * 10e-3 / 2
    assert moved[4].item() == pytest.approx(whole.item() * (1 - 1 / VIEWS), rel=0.02)
    assert moved.argmax() == 4


def test_only_training_follows_the_cameras():
    cameras, found = poses()
    assert found.train().corrected(cameras).camera_to_world.requires_grad
    assert not found.eval().corrected(cameras).camera_to_world.requires_grad


def test_other_photographs_are_refused():
    _, found = poses()
    with pytest.raises(ValueError, match=r"the 12 photographs whose .* got 5"):
        found.corrected(cameras_around(5))
