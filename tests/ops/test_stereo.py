"""Plane sweep and semi-global matching, against their references and where the answer is known."""

import math

import pytest
import torch
from analytic import look_at

from univoxel.camera import Cameras, image_rays, project, projection_matrices
from univoxel.ops import match_cost, semi_global, use_backend

SIZE, VIEWS, STEP, STEPS = 24, 5, 0.1, 7
TRUE = 3  # the step that the surface lies at


def bytes_of(pictures):
    return (255 * pictures).round().byte()


def texture(point):
    """Colours [..., 3] that change over space as slowly as pixels can show."""
    return 0.5 + 0.3 * torch.sin(6 * point + torch.tensor([0.0, 1.0, 2.0]))


def close_by():
    """Cameras within half a radian that look at the origin from above."""
    phi = torch.arange(VIEWS) * 2 * math.pi / VIEWS
    at = torch.stack([0.4 * phi.cos(), 0.4 * phi.sin(), torch.full((VIEWS,), 2.0)], 1)
    whole = torch.full((VIEWS, 2), float(SIZE))
    return Cameras(torch.stack([look_at(p) for p in at]), whole, whole / 2, SIZE, SIZE)


def case(holes=True, seed=0):
    """Views of a textured table at z = 0, whose rays start before it."""
    g = torch.Generator().manual_seed(seed)
    cameras, pictures, starts = close_by(), [], []
    for view in range(VIEWS):
        rays = image_rays(cameras, view)
        t = -rays.origin[:, 2] / rays.direction[:, 2]
        color = texture(rays.origin + t[:, None] * rays.direction)
        pictures.append(torch.cat([color, torch.ones(len(t), 1)], 1))
        starts.append(t - TRUE * STEP)
    pictures = bytes_of(torch.stack(pictures)).view(VIEWS, SIZE, SIZE, 4)
    inside = torch.rand(SIZE * SIZE, generator=g) < (0.8 if holes else 2)
    rows = torch.where(inside, inside.long().cumsum(0) - 1, -1).view(SIZE, SIZE)
    rays = image_rays(cameras, 0)
    color = pictures[0].flatten(0, 1)[inside, :3] / 255
    lines = rays.origin[inside], rays.direction[inside], starts[0][inside], color
    return pictures, projection_matrices(cameras), *lines, rows, torch.arange(1, VIEWS)


def test_projections_are_those_of_the_cameras():
    cameras, points = close_by(), torch.randn(20, 3) * 0.3
    for view, matrix in enumerate(projection_matrices(cameras)):
        found = points @ matrix[:, :3].T + matrix[:, 3]
        pixel, depth = project(cameras, view, points)
        torch.testing.assert_close(found[:, 2], depth)
        torch.testing.assert_close(found[:, :2] / found[:, 2:], pixel, rtol=1e-5, atol=1e-4)


@pytest.mark.parametrize(("radius", "best"), [(0, 1), (1, 2), (2, 4)])
def test_match_cost_equals_its_reference(radius, best):
    arguments = list(case())
    g = torch.Generator().manual_seed(1)
    # Coverage of all kinds too
    arguments[0] = bytes_of(torch.rand(arguments[0].shape, generator=g))
    start = arguments[4]
    arguments[4] = start + torch.randn(len(start), generator=g)  # behind views as well
    options = dict(step=STEP, steps=STEPS, most=0.3, radius=radius, best=best)
    found = match_cost(*arguments, **options)
    with use_backend("reference"):
        wanted = match_cost(*arguments, **options)
    # Colours are divided by coverages down to a half; pixels of some 10 are rounded to 1e-6
    torch.testing.assert_close(found, wanted, rtol=0, atol=1e-4)
    assert 0.2 < (wanted < 0.3).float().mean() < 1  # some are seen, some are not


def test_photographs_agree_where_the_surface_is():
    cost = match_cost(*case(holes=False), STEP, STEPS, best=2)
    inner = cost.view(SIZE, SIZE, STEPS)[5:-5, 5:-5].flatten(0, 1)  # others see it too
    assert (inner.argmin(1) == TRUE).float().mean() > 0.95
    assert inner[:, TRUE].median() < 0.3 * inner[:, TRUE + 2].median()


def test_a_view_that_sees_nothing_there_disagrees_most():
    pictures, *others = case(holes=False)
    pictures[1:, ..., 3] = 0
    cost = match_cost(pictures, *others, STEP, 2)
    torch.testing.assert_close(cost, torch.full_like(cost, 0.2))


def test_views_of_one_line_of_pixels_see_nothing():
    pictures, *others, rows, views = case(holes=False)
    cost = match_cost(
        pictures[:, :1], *others[:1], *(x[:SIZE] for x in others[1:]), rows[:1], views, STEP, 2
    )
    torch.testing.assert_close(cost, torch.full_like(cost, 0.2))


def test_pictures_may_begin_at_any_byte():
    pictures, *others = case()
    moved = torch.cat([torch.zeros(1, dtype=torch.uint8), pictures.flatten()])[1:]
    found = match_cost(moved.view(pictures.shape), *others, STEP, 2)
    assert torch.equal(found, match_cost(pictures, *others, STEP, 2))


def volume(seed=0, holes=True):
    g = torch.Generator().manual_seed(seed)
    inside = torch.rand(9, 11, generator=g) < (0.8 if holes else 2)
    rows = torch.where(inside, inside.flatten().long().cumsum(0).view(9, 11) - 1, -1)
    return torch.rand(int(inside.sum()), STEPS, generator=g), rows


@pytest.mark.parametrize(("small", "large"), [(0.0, 0.0), (0.05, 0.2), (0.3, 5.0)])
def test_semi_global_equals_its_reference(small, large):
    cost, rows = volume()
    found = semi_global(cost, rows, small, large)
    with use_backend("reference"):
        wanted = semi_global(cost, rows, small, large)
    torch.testing.assert_close(found, wanted, rtol=1e-5, atol=1e-6)  # sums of 20 numbers of order 1


def test_where_depths_may_not_change_a_line_shares_the_one_that_suits_it_best():
    cost, rows = volume(holes=False)
    total = semi_global(cost[:11], rows[:1], 1e3, 1e3)  # downwards and upwards a line is alone
    along = total - 2 * cost[:11]
    assert (along.argmin(1) == cost[:11].sum(0).argmin()).all()


def test_where_depths_may_change_freely_each_pixel_takes_its_own():
    cost, rows = volume()
    assert torch.equal(semi_global(cost, rows, 0.0, 0.0).argmin(1), cost.argmin(1))


@pytest.mark.parametrize("backend", ["native", "reference"])
def test_pictures_of_differing_sizes_end_where_their_coverage_does(backend):
    """What a smaller picture has lost counts as not seen, and what it still shows as before."""
    pictures, matrix, origin, direction, start, color, rows, _ = case(holes=False)
    smaller = pictures.clone()
    smaller[1, :, 12:] = 0  # stored in the same tensor, nothing beyond
    rest = matrix, origin, direction, start, color, rows, torch.tensor([1])
    options = dict(step=STEP, steps=STEPS, radius=0, best=1)
    with use_backend(backend):
        found, wanted = (match_cost(p, *rest, **options) for p in (smaller, pictures))
    t = start[:, None] + STEP * torch.arange(STEPS)
    points = origin[:, None] + t[..., None] * direction[:, None]
    column = project(close_by(), 1, points.reshape(-1, 3))[0][:, 0].view(found.shape)
    within = column < 11.5  # between pixels that both have
    beyond = column > 12  # less than half covered
    torch.testing.assert_close(found[within], wanted[within])
    torch.testing.assert_close(found[beyond], torch.full_like(found[beyond], 0.2))
    assert (wanted[within] < 0.19).float().mean() > 0.3
    assert (wanted[beyond] < 0.19).float().mean() > 0.3
