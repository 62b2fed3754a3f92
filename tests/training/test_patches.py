"""Patches of the surface, compared between photographs: a textured plane seen from five sides."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from balls import surface_at
from torch.nn.functional import normalize

from univoxel.camera import Cameras, image_rays, projection_matrices
from univoxel.core.records import Rays
from univoxel.data import Photos
from univoxel.training import patches

EYES = torch.tensor(
    [[0.0, 0.0, 3.0], [0.9, 0.0, 3.0], [-0.9, 0.2, 2.9], [0.1, 0.8, 3.0], [0.0, -0.8, 3.1]]
)
SIZE = 64


def nothing_hides(but_all=False):
    tracer = SimpleNamespace(occluded=lambda start, *_: torch.full((len(start),), but_all))
    return SimpleNamespace(occluder=lambda: tracer, field=SimpleNamespace(voxel_size=0.02))


def cameras():
    back = normalize(EYES, dim=1)
    right = normalize(torch.linalg.cross(torch.tensor([[0.0, 1.0, 0.0]]).expand(5, 3), back), dim=1)
    up = torch.linalg.cross(back, right)
    pose = torch.stack([right, up, back, EYES], 2)
    half = torch.full((5, 2), SIZE / 2)
    return Cameras(pose, torch.full((5, 2), 100.0), half, SIZE, SIZE)


def plane_at(rays, height):
    """Distance along rays to the plane z = height."""
    return (height - rays.origin[:, 2]) / rays.direction[:, 2]


def pattern(point):
    """Linear grey between 0.1 and 0.9 at points of a plane."""
    x, y = point[:, 0], point[:, 1]
    waves = (
        torch.sin(22 * x + 6 * y) + torch.sin(14 * y - 8 * x + 1) + torch.sin(18 * y + 9 * x * y)
    )
    return 0.5 + 0.13 * waves


def photos(alpha=1.0):
    """Of the plane z = 0."""
    cams, pictures = cameras(), []
    for view in range(5):
        rays = image_rays(cams, view)
        point = rays.origin + plane_at(rays, 0.0)[:, None] * rays.direction
        pictures.append(pattern(point).view(SIZE, SIZE, 1).expand(-1, -1, 3))
    color = torch.stack(pictures)
    coverage = torch.full((5, SIZE, SIZE), alpha)
    return Photos(Path(), list("abcde"), color, coverage, cams)


def rays_of(count=200):
    draw = torch.Generator().manual_seed(0)
    view = torch.randint(5, (count,), generator=draw)
    row, column = torch.randint(8, SIZE - 8, (2, count), generator=draw)
    at = row * SIZE + column
    every = [image_rays(cameras(), v) for v in range(5)]
    origin = torch.stack([every[v].origin[k] for v, k in zip(view, at, strict=True)])
    direction = torch.stack([every[v].direction[k] for v, k in zip(view, at, strict=True)])
    return Rays(origin, direction), torch.stack([view, row, column], 1).int()


def surface_of(rays, height, normal=(0.0, 0.0, 1.0)):
    depth = plane_at(rays, height)
    normal = normalize(torch.as_tensor(normal), dim=0).expand(len(depth), 3)
    return surface_at(rays.origin + depth[:, None] * rays.direction, normal, depth=depth)


def disagreement(height, normal=(0.0, 0.0, 1.0), scene=None, shots=None):
    shots = photos() if shots is None else shots
    rays, pixels = rays_of()
    surface = surface_of(rays, height, normal)
    scene = nothing_hides() if scene is None else scene
    bright = patches.comparable(shots)
    return patches.disagreement(scene, bright, cameras(), surface, -rays.direction, pixels)


def test_patches_agree_on_the_true_plane_alone():
    right = disagreement(torch.tensor(0.0))
    assert right < 0.005
    for wrong in (-0.1, -0.05, 0.05, 0.1):
        assert disagreement(torch.tensor(wrong)) > 5 * right
    assert disagreement(torch.tensor(0.0), torch.tensor([0.6, 0.0, 1.0])) > 2 * right


@pytest.mark.parametrize("start", [-0.06, 0.06])
def test_a_plane_at_the_wrong_depth_is_pulled_to_the_right_one(start):
    height = torch.tensor(start, requires_grad=True)
    optimizer = torch.optim.Adam([height], lr=0.005)
    for _ in range(60):
        optimizer.zero_grad()
        disagreement(height).backward()
        optimizer.step()
    assert abs(height.item()) < 0.005


@pytest.mark.parametrize("gain", [0.5, 1.3])
def test_exposure_changes_little(gain):
    shots = photos()
    shots.color[1::2] *= gain
    assert disagreement(torch.tensor(0.0), shots=shots) < 0.02


def test_what_cannot_be_compared_pulls_nothing():
    plain = replace(photos(), color=torch.full((5, SIZE, SIZE, 3), 0.5))
    assert disagreement(torch.tensor(0.1), shots=plain) == 0
    assert disagreement(torch.tensor(0.1), shots=photos(alpha=0.5)) == 0
    assert disagreement(torch.tensor(0.1), scene=nothing_hides(but_all=True)) == 0
    assert disagreement(torch.tensor(0.1), torch.tensor([1.0, 0.0, -0.5])) == 0


def test_a_photograph_of_something_else_has_no_say():
    shots = photos()
    draw = torch.Generator().manual_seed(1)
    shots.color[4] = torch.rand(SIZE, SIZE, 1, generator=draw).expand(-1, -1, 3)
    rays, pixels = rays_of()
    kept = pixels[:, 0] != 4
    rays, pixels = Rays(rays.origin[kept], rays.direction[kept]), pixels[kept]
    surface, bright = surface_of(rays, torch.tensor(0.0)), patches.comparable(shots)
    found = patches.disagreement(
        nothing_hides(), bright, cameras(), surface, -rays.direction, pixels
    )
    assert found < 0.01


def test_views_from_almost_the_same_place_are_left_out():
    eyes = torch.cat([EYES[:1] + torch.tensor([[0.01, 0.0, 0.0]]), EYES[1:3]])
    pose = torch.cat([cameras().camera_to_world[:1], cameras().camera_to_world[:3]])
    pose[1:, :, 3] = eyes
    three = replace(cameras().of(torch.tensor([0, 0, 1, 2])), camera_to_world=pose)
    position, normal = torch.zeros(1, 3), torch.tensor([[0.0, 0.0, 1.0]])
    view, matrices = torch.zeros(1, dtype=torch.int64), projection_matrices(three)
    others, seen = patches.views_beside(nothing_hides(), three, matrices, position, normal, view)
    assert set(others[seen].tolist()) == {2, 3}


def test_bytes_are_as_bright_as_what_they_stand_for():
    grey = torch.tensor([0.0, 0.2140, 1.0]).view(1, 1, 3, 1).expand(5, SIZE, 3, 3)
    stored = torch.tensor([0, 127, 255], dtype=torch.uint8).view(1, 1, 3, 1).expand(5, SIZE, 3, 3)
    alpha = torch.ones(5, SIZE, 3)
    linear, encoded = (
        patches.comparable(replace(photos(), color=color.contiguous(), alpha=alpha))
        for color in (grey, stored)
    )
    assert torch.allclose(linear.float(), encoded.float(), atol=5e-3)
