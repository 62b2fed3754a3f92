"""Hollows: a ball with a pit is opened, a mirror and a plain ball are left as they are."""

import dataclasses
from functools import cache
from pathlib import Path

import pytest
import torch
from analytic import cameras_around, look_at
from cropped import cropped

from univoxel.camera import Cameras, image_rays, pixel_rays
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
    at = 2 * torch.stack([r * phi.cos(), r * phi.sin(), z], 1)
    half = torch.full((views, 2), SIZE / 2)
    return Cameras(torch.stack([look_at(p) for p in at]), half * 3, half, SIZE, SIZE)


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


def test_a_pit_is_opened():
    hull, found, truth, voxel = opened(with_pit, checks, from_above())
    pit = (hull < -voxel) & (truth > voxel)  # what silhouettes leave in
    assert pit.sum() > 100
    assert (found[pit] > 0).float().mean() > 0.8
    rest = truth < -1.5 * voxel
    assert (found[rest] < 0).float().mean() > 0.99
    assert (found >= hull).all()


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


def test_the_new_surface_lies_where_the_pit_is():
    hull, found, truth, voxel = opened(with_pit, checks, from_above())
    near = (truth.abs() < 2 * voxel) & (hull < -2 * voxel)
    assert near.sum() > 100
    assert (found - truth)[near].abs().median() < voxel
    assert (hull - truth)[near].abs().median() > 1.5 * voxel


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
    cameras = from_above()
    low = torch.arange(VIEWS) < VIEWS * 9 // 10
    at = cameras.camera_to_world[:, :, 3]
    at = torch.where(low[:, None], at * torch.tensor([1.0, 1.0, -1.0]), at)
    return Cameras(torch.stack([look_at(p) for p in at]), cameras.focal, cameras.centre, SIZE, SIZE)


def test_what_few_views_see_through_stays(monkeypatch):
    """They may all look at a lamp in something glossy."""
    case = hull_of(with_pit, checks, mostly_from_below())
    assert torch.equal(carve_concavities(*case), case[0])
    monkeypatch.setattr(carving, "LEAST", 0.05)
    assert not torch.equal(carve_concavities(*case), case[0])


def test_two_views_open_nothing():
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
