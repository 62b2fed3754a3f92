"""Pixels to rays and back, cameras that are learned, and the circle that they stand on."""

import math
from dataclasses import replace

import pytest
import torch
from analytic import cameras_around, cameras_at
from scipy.spatial.transform import Rotation

from univoxel.camera import (
    Cameras,
    PoseSteps,
    circle_of,
    image_rays,
    pixel_rays,
    project,
    resize,
    sizes_of,
    stacked,
)


def cameras():
    """Two cameras: one at +Z looking down -Z, one turned at random with an odd principal point."""
    q, _ = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(1)))
    q = q * torch.linalg.det(q).sign()
    first = torch.cat([torch.eye(3), torch.tensor([[0.0], [0.0], [4.0]])], 1)
    second = torch.cat([q, torch.tensor([[1.0], [-2.0], [0.5]])], 1)
    return Cameras(
        torch.stack([first, second]),
        focal=torch.tensor([[10.0, 10.0], [12.0, 9.0]]),
        centre=torch.tensor([[4.0, 3.0], [3.5, 3.25]]),
        width=8,
        height=6,
    )


def test_the_first_camera_by_hand():
    """x to the right is +X, y down is -Y, the centre looks along -Z; pixel centres are at 0.5."""
    rays = pixel_rays(cameras(), torch.zeros(3, dtype=torch.int64), torch.tensor(
        [[4.0, 3.0], [7.5, 3.0], [4.0, 5.5]]
    ))  # fmt: skip
    assert rays.origin.tolist() == [[0.0, 0.0, 4.0]] * 3
    expected = torch.tensor([[0.0, 0.0, -1.0], [0.35, 0.0, -1.0], [0.0, -0.25, -1.0]])
    expected = torch.nn.functional.normalize(expected, dim=1)
    torch.testing.assert_close(rays.direction, expected)
    _, depth = project(cameras(), 0, torch.tensor([[0.0, 0.0, 5.0], [0.0, 0.0, 3.0]]))
    assert depth.tolist() == pytest.approx([-1.0, 1.0])


def test_image_rays_go_row_by_row_through_pixel_centres():
    rays = image_rays(cameras(), 1)
    column, row = 5, 2
    single = pixel_rays(cameras(), torch.tensor([1]), torch.tensor([[column + 0.5, row + 0.5]]))
    assert len(rays.direction) == 48
    torch.testing.assert_close(rays.direction[row * 8 + column], single.direction[0])


@pytest.mark.parametrize("view", [0, 1])
def test_points_along_a_ray_project_to_its_pixel(view):
    cams = cameras()
    pixel = torch.rand(50, 2, generator=torch.Generator().manual_seed(2)) * torch.tensor([8.0, 6.0])
    rays = pixel_rays(cams, torch.full((50,), view), pixel)
    t = torch.linspace(0.5, 6.0, 50)[:, None]
    xy, depth = project(cams, view, rays.origin + t * rays.direction)
    # fp32 with coordinates of about 10 pixels
    torch.testing.assert_close(xy, pixel, atol=2e-5, rtol=1e-5)
    forward = -cams.camera_to_world[view, :, 2]
    torch.testing.assert_close(depth, t[:, 0] * (rays.direction @ forward))


def upright_and_across():
    """The two cameras with a portrait and a landscape."""
    width, height, sizes = sizes_of([(6, 8), (8, 4)])
    assert (width, height) == (8, 8)
    return replace(cameras(), width=width, height=height, sizes=sizes)


def test_pictures_of_differing_sizes_are_stored_from_their_top_left_corner():
    pictures = [torch.rand(8, 6, 3), torch.rand(4, 8, 3)]
    stored = stacked(pictures, beyond=7.0)
    cams = upright_and_across()
    assert stored.shape == (2, cams.height, cams.width, 3)
    for view, picture in enumerate(pictures):
        assert torch.equal(cams.cut(view, stored[view]), picture)
    assert (stored[0, :, 6:] == 7).all()
    assert (stored[1, 4:] == 7).all()
    assert sizes_of([(3, 2), (3, 2)]) == (3, 2, None)
    alike = [torch.rand(2, 3), torch.rand(2, 3)]
    assert torch.equal(stacked(alike), torch.stack(alike))


def test_each_view_has_its_own_size():
    cams = upright_and_across()
    for view, (width, height) in enumerate([(6, 8), (8, 4)]):
        rays = image_rays(cams, view)
        assert cams.size(view) == (width, height)
        assert len(rays.direction) == width * height
        last = pixel_rays(cams, torch.tensor(view), torch.tensor([width - 0.5, height - 0.5]))
        torch.testing.assert_close(rays.direction[-1], last.direction)
    one = cams.of(torch.tensor([1]))
    assert (len(one), one.size(0), one.width, one.height) == (1, (8, 4), 8, 8)
    assert torch.equal(one.focal, cams.focal[1:])
    assert cams.size_of_each().tolist() == [[6, 8], [8, 4]]
    assert cameras().size_of_each().tolist() == [[8, 6], [8, 6]]


def test_resized_pictures_show_the_same():
    """The width is the widest one's; the lower right corner of each stays where it is."""
    for cams in (cameras(), upright_and_across()):
        small = resize(cams, 4)
        assert small.width == 4
        for view in range(2):
            before, after = (
                pixel_rays(c, torch.tensor(view), torch.tensor([float(n) for n in c.size(view)]))
                for c in (cams, small)
            )
            torch.testing.assert_close(before.direction, after.direction)
    assert small.size_of_each().tolist() == [[3, 4], [4, 2]]


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


def test_no_steps_leave_cameras_as_they_are():
    cameras, found = poses()
    same = found.corrected(cameras).camera_to_world  # to a rounding at coordinates of 2
    torch.testing.assert_close(same, cameras.camera_to_world, atol=3e-7, rtol=0)
    assert found.moved(cameras).max() < 1e-4
    # Only training follows them
    assert found.train().corrected(cameras).camera_to_world.requires_grad
    assert not found.eval().corrected(cameras).camera_to_world.requires_grad


def test_corrected_cameras_are_rigid():
    cameras, found = poses()
    rotation = shaken(found, 0.2).corrected(cameras).camera_to_world[:, :, :3]
    torch.testing.assert_close(
        rotation @ rotation.mT, torch.eye(3).expand(VIEWS, 3, 3), atol=1e-6, rtol=0
    )
    torch.testing.assert_close(torch.linalg.det(rotation), torch.ones(VIEWS))
    with pytest.raises(ValueError, match=r"the 12 photographs whose .* got 5"):
        found.corrected(cameras_around(5))


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


RING = 40
TILT = torch.from_numpy(Rotation.from_rotvec([0.4, -0.3, 0.2]).as_matrix()).float()


def on_a_ring(noise: float = 0.0, turn: float = 2 * math.pi, heights=(0.9,)) -> Cameras:
    """Cameras on a ring of radius 3 in a tilted world, a share of it off by normal numbers."""
    generator = torch.Generator().manual_seed(0)
    angle = turn * torch.arange(RING) / RING
    height = torch.tensor(heights).repeat_interleave(-(-RING // len(heights)))[:RING]
    place = torch.stack([3 * angle.cos(), 3 * angle.sin(), height], 1)
    place = place + 3 * noise * torch.randn(RING, 3, generator=generator)
    level = cameras_at(place, 32, 30.0)
    return replace(level, camera_to_world=TILT @ level.camera_to_world)


def moved(cameras: Cameras, views: slice, away: float) -> Cameras:
    """With some of the centres further out, by a share of the ring's radius."""
    pose = cameras.camera_to_world.clone()
    pose[views, :, 3] *= 1 + away
    return replace(cameras, camera_to_world=pose)


def test_a_ring_is_found():
    circle = circle_of(on_a_ring())
    assert circle.radius == pytest.approx(3, abs=1e-4)
    wanted = TILT.double() @ torch.tensor([0, 0, 1.0]).double()
    assert abs(circle.axis @ wanted) == pytest.approx(1, abs=1e-6)
    torch.testing.assert_close(circle.centre, 0.9 * wanted, atol=1e-4, rtol=0)
    assert not circle.strays().any()


def test_what_is_no_stray():
    """Normal errors, and what stands elsewhere, where it was put."""
    circle = circle_of(on_a_ring(noise=0.002))
    assert 0.001 < circle.off.median() < 0.003
    assert not circle.strays().any()
    circle = circle_of(moved(on_a_ring(), slice(30, 36), 0.5))
    assert circle is not None
    assert not circle.strays().any()


@pytest.mark.parametrize("away", [0.02, -0.03])
def test_cameras_beside_the_ring_are_strays_and_do_not_bend_it(away):
    circle = circle_of(moved(on_a_ring(noise=0.0005), slice(30, 38), away))
    assert circle.strays().nonzero()[:, 0].tolist() == list(range(30, 38))
    assert circle.radius == pytest.approx(3, rel=1e-3)
    wanted = TILT.double() @ torch.tensor([0, 0, 1.0]).double()
    assert abs(circle.axis @ wanted) > math.cos(math.radians(0.1))


def test_other_paths_are_no_circle():
    """Nor is a walk around an object, which stays within some per cent of one."""
    assert circle_of(cameras_around(RING)) is None
    assert circle_of(on_a_ring(heights=(0.5, 1.5))) is None  # two rings, of which none has most
    assert circle_of(on_a_ring(turn=0.6)) is None  # a short arc has any axis
    assert circle_of(on_a_ring().of(torch.arange(6))) is None  # too few
    still = on_a_ring().of(torch.zeros(RING, dtype=torch.int64))
    assert circle_of(still) is None
    assert circle_of(on_a_ring(noise=0.02)) is None
