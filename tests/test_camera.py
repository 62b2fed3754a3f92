"""Pixels to rays and back, and the axes of the camera."""

from dataclasses import replace

import pytest
import torch

from univoxel.camera import Cameras, image_rays, pixel_rays, project, resize, sizes_of, stacked


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


def test_points_behind_the_camera_have_no_positive_depth():
    _, depth = project(cameras(), 0, torch.tensor([[0.0, 0.0, 5.0], [0.0, 0.0, 3.0]]))
    assert depth.tolist() == pytest.approx([-1.0, 1.0])


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


def test_rays_of_a_view_are_those_of_its_own_picture():
    cams = upright_and_across()
    for view, (width, height) in enumerate([(6, 8), (8, 4)]):
        rays = image_rays(cams, view)
        assert cams.size(view) == (width, height)
        assert len(rays.direction) == width * height
        last = pixel_rays(cams, torch.tensor(view), torch.tensor([width - 0.5, height - 0.5]))
        torch.testing.assert_close(rays.direction[-1], last.direction)


def test_some_views_keep_their_sizes():
    cams = upright_and_across()
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
