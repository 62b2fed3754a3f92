"""Photographs compared: patches on a plane that is known, plane sweep and semi-global matching."""

import math

import pytest
import torch
from analytic import cameras_at, on_circle
from op_cases import PICTURE, doubled, eyes, patch_rays, patches, results

from univoxel.camera import image_rays, project, projection_matrices
from univoxel.ops import (
    match_cost,
    patch_correlation,
    patch_correlation_reference,
    semi_global,
    use_backend,
)


def test_halves_are_what_they_hold():
    given = patches(5)
    given["brightness"] = given["brightness"].half()
    whole = patch_correlation(**given | {"brightness": given["brightness"].float()})
    for got, wanted in zip(patch_correlation(**given), whole, strict=True):
        torch.testing.assert_close(got, wanted, rtol=1e-6, atol=1e-6)


def textured(depth=0.0):
    """Photographs of a plane x = 0 with a pattern on it, and patches of the first view on a plane
    x = depth."""
    cameras, pictures = eyes(), []
    row, column = torch.meshgrid(torch.arange(PICTURE), torch.arange(PICTURE), indexing="ij")
    for view in range(len(cameras)):
        where = torch.full((PICTURE**2,), view)
        rays = patch_rays(cameras, where, row.flatten(), column.flatten())
        ray, origin = rays["direction"][:, 0], rays["origin"]
        point = origin - (origin[:, :1] / ray[:, :1]) * ray
        pattern = 0.5 + 0.2 * (12 * point[:, 1]).sin() + 0.2 * (15 * point[:, 2]).cos()
        pictures.append(pattern.view(PICTURE, PICTURE))
    brightness = torch.stack(pictures)
    row, column = (
        t.flatten() for t in torch.meshgrid(*2 * [torch.arange(14, 34, 5)], indexing="ij")
    )
    rays = patch_rays(cameras, torch.zeros(len(row), dtype=torch.int64), row, column)
    step = torch.arange(-2, 3)
    down, right = (t.flatten() for t in torch.meshgrid(step, step, indexing="ij"))
    ray, origin = rays["direction"][:, 0], rays["origin"]
    return rays | {
        "brightness": brightness,
        "projection": projection_matrices(cameras),
        "own": brightness[0, row[:, None] + down, column[:, None] + right],
        "views": torch.tensor([1, 2]).expand(len(row), 2),
        "position": origin + (depth - origin[:, :1]) / ray[:, :1] * ray,
        "normal": torch.tensor([1.0, 0.0, 0.0]).expand(len(row), 3),
    }


def test_the_right_plane_correlates_best():
    found = {
        depth: patch_correlation(**textured(depth))[0].mean().item()
        for depth in (-0.2, -0.05, 0.0, 0.05, 0.2)
    }
    assert max(found, key=found.get) == 0.0
    assert found[0.0] > 0.99
    assert found[0.2] < 0.9


def test_exposure_and_even_shading_change_nothing():
    given = textured(0.03) | {"noise": 1e-6}
    other = given | {"brightness": 0.1 + 0.5 * given["brightness"]}
    torch.testing.assert_close(
        patch_correlation(**other)[0], patch_correlation(**given)[0], rtol=1e-4, atol=1e-4
    )


def test_what_shows_the_background_is_not_seen():
    given = textured()
    assert patch_correlation(**given)[1].all()
    given["brightness"][2] = -1
    seen = patch_correlation(**given)[1]
    assert seen[:, 0].all()
    assert not seen[:, 1].any()


def test_one_pixel_of_background_beside_a_patch_is_enough():
    given = doubled(patches(60, 4, 5))  # rounding would choose other pixels
    spots = torch.rand(given["brightness"].shape, generator=torch.Generator().manual_seed(3)) < 0.03
    given["brightness"] = torch.where(spots, -1.0, given["brightness"])
    seen = patch_correlation(**given)[1]
    assert torch.equal(seen, patch_correlation_reference(**given)[1])
    assert 0.1 < seen.float().mean() < 0.9


def test_a_view_that_looks_away_and_a_plane_along_the_ray():
    """Finite numbers where no gradient is, and nothing read beyond the pictures."""
    given = patches(5)
    behind = -given["projection"]
    behind[:, 2] *= 0  # z is 0 everywhere
    correlation, _, *gradients = results("patch_correlation", given | {"projection": behind})
    assert correlation.isfinite().all()
    assert not torch.cat(gradients).any()
    position = given["position"]
    along = torch.linalg.cross(position - given["origin"], given["direction"][:, 1])
    patch_correlation(**given | {"normal": along})
    for away in (1e30, math.nan):
        patch_correlation(**given | {"position": away * position})


SIZE, VIEWS, STEP, STEPS = 24, 5, 0.1, 7
TRUE = 3  # the step that the surface lies at


def bytes_of(pictures):
    return (255 * pictures).round().byte()


def texture(point):
    """Colours [..., 3] that change over space as slowly as pixels can show."""
    return 0.5 + 0.3 * torch.sin(6 * point + torch.tensor([0.0, 1.0, 2.0]))


def close_by():
    """Cameras within half a radian that look at the origin from above."""
    return cameras_at(on_circle(VIEWS, 0.4, 2.0), SIZE, SIZE)


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


def test_views_that_see_nothing_disagree_most():
    """Where there is no coverage, and of one line of pixels."""
    pictures, *others = case(holes=False)
    pictures[1:, ..., 3] = 0
    cost = match_cost(pictures, *others, STEP, 2)
    torch.testing.assert_close(cost, torch.full_like(cost, 0.2))
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


def test_depths_that_may_not_change_along_a_line_or_may_freely():
    """A line shares the depth that suits it best, or each pixel takes its own."""
    cost, rows = volume(holes=False)
    total = semi_global(cost[:11], rows[:1], 1e3, 1e3)  # downwards and upwards a line is alone
    along = total - 2 * cost[:11]
    assert (along.argmin(1) == cost[:11].sum(0).argmin()).all()
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
