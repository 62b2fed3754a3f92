"""Hollows: a ball with a pit is opened, a mirror and a plain ball are left as they are; which
photographs say so, and whether there is time."""

import dataclasses
from functools import cache
from pathlib import Path

import pytest
import torch
from analytic import RADIUS, cameras_around, cameras_at, photos_of
from cropped import cropped

from univoxel.camera import image_rays, pixel_rays
from univoxel.color import linear_to_srgb
from univoxel.data import Photos
from univoxel.fields.grid import fit_grid
from univoxel.preparation import carving
from univoxel.preparation.carving import carve_concavities, carving_pictures, log_colors
from univoxel.preparation.hull import mask_distances, visual_hull

SIZE, VIEWS = 48, 30
PIT = torch.tensor([0.0, 0.0, 0.55]), 0.35


def with_pit(point):
    """A ball of radius 0.5 without another one: its rim is the circle at z = 0.39, r = 0.31."""
    return torch.maximum(point.norm(dim=-1) - 0.5, PIT[1] - (point - PIT[0]).norm(dim=-1))


def ball(point):
    return point.norm(dim=-1) - 0.5


def checks(point, normal, wo):
    """Colours [N, 3] painted on it."""
    return 0.5 + 0.4 * torch.sin(14 * point + torch.tensor([0.0, 1.0, 2.0]))


def plain(point, normal, wo):
    return torch.full_like(point, 0.4)


def dim(point, normal, wo):
    """Checks in the dark, two or three steps of 8 bits apart."""
    return 0.04 + 0.005 * torch.sin(14 * point + torch.tensor([0.0, 1.0, 2.0]))


def noisy(point, normal, wo):
    """Plain, as 8 bits of a grainy photograph show it."""
    return plain(point, normal, wo) + 0.006 * torch.randn(point.shape)


def mirrored(point, normal, wo):
    """Stripes all around, far away, in a mirror."""
    reflected = 2 * (normal * wo).sum(-1, keepdim=True) * normal - wo
    return 0.5 + 0.4 * torch.sin(7 * reflected + torch.tensor([0.0, 1.0, 2.0]))


def photographed(shape, look, cameras):
    """Pictures [V, H, W, 4] in bytes by sphere tracing."""
    pictures = []
    for view in range(len(cameras)):
        rays = image_rays(cameras, view)
        point = rays.origin.clone()
        for _ in range(50):
            point = point + 0.8 * shape(point)[:, None] * rays.direction
        normal = torch.func.vmap(torch.func.grad(shape))(point)
        hit = (shape(point).abs() < 2e-3)[:, None].float()
        color = look(point, torch.nn.functional.normalize(normal, dim=-1), -rays.direction)
        pictures.append(torch.cat([color * hit, hit], 1).nan_to_num(0.0))
    pictures = (255 * torch.stack(pictures)).round().byte()
    return pictures.view(len(cameras), cameras.height, cameras.width, 4)


@cache
def from_above(views=VIEWS):
    """Cameras on a spiral above z = 0.5: what a table hides none sees."""
    z = torch.linspace(0.25, 0.95, views)
    phi = 2.4 * torch.arange(views)
    r = (1 - z * z).sqrt()
    return cameras_at(2 * torch.stack([r * phi.cos(), r * phi.sin(), z], 1), SIZE, 1.5 * SIZE)


@cache
def hull_of(shape, look, cameras):
    """What `carve_concavities` takes."""
    pictures = photographed(shape, look, cameras)
    distance = mask_distances(pictures[..., 3] / 255)
    grid = fit_grid(torch.full((3,), -0.6), torch.full((3,), 0.6), 40_000)
    return visual_hull(distance, cameras, grid), grid, pictures, cameras


@cache
def opened(shape, look, cameras):
    """The hull's SDF, what became of it, and the shape's own, on the same nodes."""
    hull, grid, *photos = hull_of(shape, look, cameras)
    return hull, carve_concavities(hull, grid, *photos), shape(grid.nodes()), grid.voxel_size


def test_a_pit_is_opened_and_the_new_surface_lies_where_it_is():
    hull, found, truth, voxel = opened(with_pit, checks, from_above())
    pit = (hull < -voxel) & (truth > voxel)  # what silhouettes leave in
    assert pit.sum() > 100
    assert (found[pit] > 0).float().mean() > 0.8
    rest = truth < -1.5 * voxel
    assert (found[rest] < 0).float().mean() > 0.99
    assert (found >= hull).all()
    near = (truth.abs() < 2 * voxel) & (hull < -2 * voxel)
    assert near.sum() > 100
    assert (found - truth)[near].abs().median() < voxel
    assert (hull - truth)[near].abs().median() > 1.5 * voxel


def test_a_dark_pit_is_opened(monkeypatch):
    hull, found, truth, voxel = opened(with_pit, dim, from_above())
    pit = (hull < -voxel) & (truth > voxel)
    assert (found[pit] > 0).float().mean() > 0.8
    monkeypatch.setattr(carving, "LOG_SHARE", 0.0)
    as_it_is = carve_concavities(*hull_of(with_pit, dim, from_above()))
    assert (as_it_is[pit] > 0).float().mean() < (found[pit] > 0).float().mean() - 0.2


def test_dark_colours_are_taken_further_apart():
    color = torch.tensor([0, 10, 20, 120, 245, 255], dtype=torch.uint8)
    opaque = torch.stack([color] * 3 + [torch.full_like(color, 255)], 1)[None]
    found = log_colors(opaque)[0, :, 0].int()
    assert found[0] == 0
    assert found[-1] == 255
    assert found[2] - found[1] > 3 * (found[5] - found[4])
    half = torch.cat([opaque[..., :3] // 2, torch.full_like(opaque[..., 3:], 128)], 2)
    again = log_colors(half)[0]
    # Halves are rounded, and a step of them is several in the dark
    assert (2 * again[:, 0].int() - found).abs().max() < 8
    assert (again[:, 3] == 128).all()


@pytest.mark.parametrize("look", [plain, noisy, mirrored])
def test_what_photographs_cannot_tell_stays(look):
    """A plain ball says nothing, noise no more; a mirror shows all behind it but its outline."""
    hull, found, truth, voxel = opened(ball, look, cameras_around(VIEWS, SIZE))
    solid = truth < -2 * voxel
    assert (found[solid] < 0).float().mean() > 0.99
    if look is not mirrored:
        assert torch.equal(found, hull)


@pytest.mark.parametrize(
    ("rule", "strict"),
    [("AGREE", 1.0), ("LEAST", 1.0), ("ENOUGH", 1.0), ("BETTER", 1.0), ("PIECE", 0.2)],
)
def test_each_rule_can_keep_the_pit_closed(rule, strict, monkeypatch):
    monkeypatch.setattr(carving, rule, strict)
    case = hull_of(with_pit, checks, from_above())
    assert torch.equal(carve_concavities(*case), case[0])


@cache
def mostly_from_below():
    """A tenth of the cameras see into the pit."""
    at = from_above().camera_to_world[:, :, 3].clone()
    at[: VIEWS * 9 // 10, 2] *= -1
    return cameras_at(at, SIZE, 1.5 * SIZE)


def test_what_few_views_see_through_stays(monkeypatch):
    """They may all look at a lamp in something glossy; and two open nothing."""
    case = hull_of(with_pit, checks, mostly_from_below())
    assert torch.equal(carve_concavities(*case), case[0])
    monkeypatch.setattr(carving, "LEAST", 0.05)
    assert not torch.equal(carve_concavities(*case), case[0])
    hull, found, _, _ = opened(with_pit, checks, from_above(2))
    assert torch.equal(found, hull)


@pytest.mark.parametrize("factor", [1, 2])
def test_carving_is_that_of_whole_pictures(factor):
    cameras = from_above()
    pictures = photographed(with_pit, checks, cameras)
    alpha = pictures[..., 3].float() / 255
    color = (pictures[..., :3].float() / 255 / alpha[..., None].clamp_min(1e-3)).clamp_max(1)
    stored = (255 * color).round().byte()
    names = [f"{v}" for v in range(len(cameras))]
    whole = Photos(Path("pit"), names, stored, pictures[..., 3], cameras)
    cut = cropped(whole, factor, room=2)  # squares of pixels begin at the same ones
    grid = fit_grid(torch.full((3,), -0.6), torch.full((3,), 0.6), 40_000)
    hull = visual_hull(mask_distances(whole.coverage()), cameras, grid)
    made = [carving_pictures(p, factor * 0.03) for p in (cut, whole)]
    assert made[1][1].width == cameras.width // factor
    assert len(made[0][1].size_of_each().unique(dim=0)) >= 3
    found, wanted = (carve_concavities(hull, grid, *m) for m in made)
    carved = (wanted > 0) & (hull < 0)
    assert carved.sum() > 100
    # Equal costs that rounding tells apart
    assert ((found > 0) != (wanted > 0)).sum() <= 0.01 * carved.sum()


def test_of_points_beyond_a_picture_its_own_nearest_pixel_is_taken():
    cameras = cameras_around(2, size=SIZE)
    cameras = dataclasses.replace(cameras, sizes=torch.tensor([[30, 40], [SIZE, SIZE]]))
    pixel = torch.tensor([[29.5, 39.5], [35.5, 20.5], [-3.0, 60.0]])  # the first lies in it
    rays = pixel_rays(cameras, torch.tensor(0), pixel)
    _, found = carving._distance_and_pixel(rays.origin + 2 * rays.direction, cameras, 0)
    assert found.tolist() == [39 * SIZE + 29, 20 * SIZE + 29, 39 * SIZE]


@pytest.fixture
def small_hull():
    grid = fit_grid(torch.tensor([-1.0] * 3), torch.tensor([1.0] * 3), 40_000)
    return (grid.nodes().norm(dim=-1) - RADIUS).view(*grid.size), grid


@pytest.mark.parametrize(("share", "opens"), [(0.8, False), (1.25, True)])
@pytest.mark.parametrize("bits", [True, False])
def test_hollows_are_opened_where_little_time_is_expected(
    monkeypatch, small_hull, share, opens, bits
):
    """Seconds are a share of what the silhouettes' pixels take, shrunk to a voxel's width."""
    sdf, grid = small_hull
    monkeypatch.setattr(carving, "carve_concavities", lambda hull, *_: hull + 0.25)
    photos = photos_of(3, 64)
    if bits:
        photos = dataclasses.replace(photos, alpha=(255 * photos.alpha).round().byte())
    pictures, _ = carving.carving_pictures(photos, grid.voxel_size)
    assert pictures.shape[1] == 32  # so that shrinking counts
    pixels = pictures[..., 3].float().sum() / 255
    found = carving.carve_within_time(
        sdf, grid, photos, None, share * carving.PIXEL_SECONDS * float(pixels)
    )
    assert torch.equal(found, sdf + 0.25 if opens else sdf)


def test_time_is_not_expected_of_photographs_that_are_left_out(monkeypatch, small_hull):
    sdf, grid = small_hull
    monkeypatch.setattr(carving, "carve_concavities", lambda hull, *_: hull + 0.25)
    monkeypatch.setattr(carving, "VIEWS", 4)
    seconds = carving.PIXEL_SECONDS * 5 * 32**2  # of four whole pictures, and more
    assert torch.equal(
        carving.carve_within_time(sdf, grid, photos_of(40, 64), None, seconds), sdf + 0.25
    )


def test_pictures_are_shrunk_to_what_a_voxel_shows():
    """Pixels are 0.028 wide at the object."""
    photos = photos_of(3, 64)
    pictures, cameras = carving.carving_pictures(photos, 0.06)
    assert pictures.shape == (3, 32, 32, 4)
    assert (cameras.width, cameras.height) == (32, 32)
    torch.testing.assert_close(cameras.focal * 2, photos.cameras.focal)
    torch.testing.assert_close(cameras.centre * 2, photos.cameras.centre)
    color, alpha = photos.picture(1)
    whole = torch.cat([linear_to_srgb(color) * alpha[..., None], alpha[..., None]], -1)
    wanted = 255 * whole[20:22, 24:26].mean((0, 1))
    torch.testing.assert_close(pictures[1, 10, 12].float(), wanted, rtol=0, atol=0.51)  # rounded
    assert carving.carving_pictures(photos, 0.02)[0].shape == (3, 64, 64, 4)


def test_pictures_are_as_one_exposure_would_have_them():
    photos, gains = photos_of(3, 64), torch.tensor([0.4, 0.0, -0.4])
    photos = dataclasses.replace(photos, color=photos.color / 3)  # nothing is clipped
    exposed = photos.color * gains.exp()[:, None, None, None]
    exposed = dataclasses.replace(photos, color=exposed)
    wanted = carving.carving_pictures(photos, 0.06)[0].int()
    found = carving.carving_pictures(exposed, 0.06, gains)[0].int()
    assert (found - wanted).abs().max() <= 1  # rounded
    assert (carving.carving_pictures(exposed, 0.06)[0].int() - wanted).abs().max() > 10


def test_of_many_photographs_some_say_what_is_hollow(monkeypatch):
    monkeypatch.setattr(carving, "VIEWS", 4)
    photos = photos_of(10, 16)
    pictures, cameras = carving.carving_pictures(photos, 0.01)
    assert len(pictures) == len(cameras) == 4
    torch.testing.assert_close(cameras.camera_to_world, photos.cameras.camera_to_world[::3])
    assert torch.equal(pictures[2, ..., 3], (255 * photos.alpha[6]).round().byte())
