"""Patches between photographs: native against reference, a plane that is known."""

import math

import torch
from analytic import look_at
from check_op import check_op
from torch.nn.functional import normalize

from univoxel.camera import Cameras, projection_matrices
from univoxel.ops import patch_correlation, patch_correlation_reference

SIZE, FOCAL = 48, 60.0


def cameras(views=4):
    """On a circle about the origin, 3 away, looking at it."""
    angle = 0.35 * torch.arange(views)
    away = torch.stack([angle.cos(), angle.sin(), torch.full_like(angle, 0.3)], 1)
    poses = torch.stack([look_at(p) for p in 3 * normalize(away, dim=1)])
    lens = torch.full((views, 2), FOCAL), torch.full((views, 2), SIZE / 2)
    return Cameras(poses, *lens, SIZE, SIZE)


def rays_of(known, view, row, column):
    """Origins, and directions through pixels with what columns and rows add to them."""
    pose = known.camera_to_world[view].double()
    local = torch.stack([(column + 0.5 - SIZE / 2) / FOCAL, -(row + 0.5 - SIZE / 2) / FOCAL], 1)
    right, up, back = pose[:, :, :3].unbind(2)
    middle = local[:, :1] * right + local[:, 1:] * up - back
    return pose[:, :, 3].contiguous(), torch.stack([middle, right / FOCAL, -up / FOCAL], 1)


def case(n=5, k=3, side=5, seed=0, noise=0.05):
    g = torch.Generator().manual_seed(seed)
    known = cameras()
    view = torch.randint(0, 4, (n,), generator=g)
    row, column = torch.randint(10, SIZE - 10, (2, n), generator=g)
    origin, direction = rays_of(known, view, row, column)
    depth = 2.9 + 0.2 * torch.rand(n, 1, generator=g, dtype=torch.float64)
    position = origin + depth * direction[:, 0]
    normal = -direction[:, 0] + 0.3 * torch.randn(n, 3, generator=g, dtype=torch.float64)
    # Smooth, or coordinates in float32 lie in other cells than in float64, with other slopes
    x = torch.arange(SIZE, dtype=torch.float64) / SIZE
    phase = torch.rand(4, 1, 1, generator=g, dtype=torch.float64)
    picture = 2 + torch.sin(9 * x + 6 * phase) * torch.cos(7 * x[:, None] - 3 * phase)
    return (
        picture,
        projection_matrices(known).double(),
        origin,
        direction,
        torch.rand(n, side * side, generator=g, dtype=torch.float64),
        torch.randint(0, 4, (n, k), generator=g),
        position.requires_grad_(),
        normal.requires_grad_(),
        noise,
    )


def counted(op):
    """The op with 0 and 1 in place of what numbers cannot be taken from."""

    def call(*arguments):
        correlation, seen = op(*arguments)
        return correlation, seen.long()

    return call


def test_native_equals_reference():
    cases = [case(), case(40, 4, 3, seed=1), case(3, 1, 1, seed=2), case(0), case(2, 0)]
    # Slopes of the picture change from cell to cell, where rounding may choose another
    rtol = {torch.float32: 2e-4, torch.float64: 1e-11}
    check_op(counted(patch_correlation), counted(patch_correlation_reference), cases, rtol)


def test_halves_are_what_they_hold():
    picture, *others = case()
    picture = picture.half()
    whole = patch_correlation(picture.double(), *others)
    for got, wanted in zip(patch_correlation(picture, *others), whole, strict=True):
        torch.testing.assert_close(got, wanted, rtol=1e-12, atol=0)


def textured(known, depth=0.0):
    """Photographs of a plane x = depth with a pattern on it, and their matrices."""
    matrix = projection_matrices(known).double()
    row, column = torch.meshgrid(torch.arange(SIZE), torch.arange(SIZE), indexing="ij")
    pictures = []
    for view in range(len(known)):
        where = torch.full((SIZE * SIZE,), view)
        origin, direction = rays_of(known, where, row.flatten(), column.flatten())
        ray = direction[:, 0]
        point = origin + ((depth - origin[:, :1]) / ray[:, :1]) * ray
        pattern = 0.5 + 0.2 * (12 * point[:, 1]).sin() + 0.2 * (15 * point[:, 2]).cos()
        pictures.append(pattern.view(SIZE, SIZE))
    return torch.stack(pictures), matrix


def on_plane(known, pictures, matrix, depth):
    """Arguments for patches of the first view, on a plane x = depth."""
    row, column = (
        t.flatten() for t in torch.meshgrid(*2 * [torch.arange(14, 34, 5)], indexing="ij")
    )
    view = torch.zeros(len(row), dtype=torch.int64)
    origin, direction = rays_of(known, view, row, column)
    step = torch.arange(-2, 3)
    down, right = (t.flatten() for t in torch.meshgrid(step, step, indexing="ij"))
    own = pictures[0, row[:, None] + down, column[:, None] + right]
    t = (depth - origin[:, :1]) / direction[:, 0, :1]
    normal = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64).expand(len(row), 3)
    views = torch.tensor([1, 2]).expand(len(row), 2)
    return pictures, matrix, origin, direction, own, views, origin + t * direction[:, 0], normal


def test_the_right_plane_correlates_best():
    known = cameras()
    pictures, matrix = textured(known)
    found = {
        depth: patch_correlation(*on_plane(known, pictures, matrix, depth))[0].mean().item()
        for depth in (-0.2, -0.05, 0.0, 0.05, 0.2)
    }
    assert max(found, key=found.get) == 0.0
    assert found[0.0] > 0.99
    assert found[0.2] < 0.9


def test_exposure_and_even_shading_change_nothing():
    known = cameras()
    pictures, matrix = textured(known)
    arguments = on_plane(known, pictures, matrix, 0.03)
    other = 0.1 + 0.5 * pictures
    torch.testing.assert_close(
        patch_correlation(other, *arguments[1:], 1e-9)[0], patch_correlation(*arguments, 1e-9)[0]
    )


def test_what_shows_the_background_is_not_seen():
    known = cameras()
    pictures, matrix = textured(known)
    arguments = on_plane(known, pictures, matrix, 0.0)
    assert patch_correlation(*arguments)[1].all()
    pictures = pictures.clone()
    pictures[2] = -1
    seen = patch_correlation(pictures, *arguments[1:])[1]
    assert seen[:, 0].all()
    assert not seen[:, 1].any()


def test_one_pixel_of_background_beside_a_patch_is_enough():
    picture, *others = case(60, 4)
    draw = torch.Generator().manual_seed(3)
    picture = torch.where(torch.rand(picture.shape, generator=draw) < 0.03, -1.0, picture)
    seen = patch_correlation(picture, *others)[1]
    assert torch.equal(seen, patch_correlation_reference(picture, *others)[1])
    assert 0.1 < seen.float().mean() < 0.9


def test_a_view_that_looks_away_and_a_plane_along_the_ray():
    """Finite numbers where no gradient is, and nothing read beyond the pictures."""
    picture, matrix, *others = case()
    behind = -matrix
    behind[:, 2] *= 0  # z is 0 everywhere
    correlation, _ = patch_correlation(picture, behind, *others)
    assert correlation.isfinite().all()
    for gradient in torch.autograd.grad(correlation.sum(), others[4:6]):
        assert torch.equal(gradient, torch.zeros_like(gradient))
    origin, direction, own, views, position, normal, noise = others
    along = torch.linalg.cross(position.detach() - origin, direction[:, 1])
    patch_correlation(picture, matrix, origin, direction, own, views, position, along, noise)
    far = position.detach() * 1e30
    for at in (far, far * math.nan):
        patch_correlation(picture, matrix, origin, direction, own, views, at, normal, noise)
