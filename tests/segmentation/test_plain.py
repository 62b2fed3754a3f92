"""Objects on a plain desk before plain walls, found by their edges."""

import torch
from analytic import cameras_around, look_at
from sphere_in_room import behind
from spoilt_masks import TABLE, iou

from univoxel.camera import Cameras, image_rays
from univoxel.segmentation import plain

VIEWS, SIZE = 16, 96
RADIUS = 0.4  # of a ball that lies on the desk


def seen_from_above_and_from_the_side() -> Cameras:
    cameras = cameras_around(VIEWS, SIZE)
    poses = []
    for view in range(VIEWS):
        angle, up = torch.tensor(2.4 * view), 0.15 + 0.7 * view / VIEWS
        away = torch.stack([angle.cos(), angle.sin(), torch.tensor(up)])
        poses.append(look_at(2.2 * away / away.norm()))
    return Cameras(torch.stack(poses), cameras.focal, cameras.centre, SIZE, SIZE)


def pictures(cameras: Cameras, desk=(0.6, 0.5, 0.4)) -> tuple[list, list]:
    """sRGB photographs of a striped ball on a desk with a soft shadow, and their true masks."""
    found, masks = [], []
    for view in range(len(cameras)):
        rays = image_rays(cameras, view)
        o, d = rays.origin, rays.direction
        half = (o * d).sum(1)
        root = half.square() - o.square().sum(1) + RADIUS**2
        hit = root > 0
        point = o + (-half - root.clamp_min(0).sqrt())[:, None] * d
        ball = torch.where(
            (torch.sin(14 * point[:, 2]) > 0)[:, None],
            torch.tensor([0.2, 0.3, 0.7]),
            torch.tensor([0.7, 0.2, 0.2]),
        )
        t = (TABLE - o[:, 2]) / d[:, 2]
        place = o + t[:, None] * d
        shade = 1 - 0.4 * torch.exp(-(place[:, :2] / 0.5).square().sum(1))
        on_desk = (t > 0) & (place[:, :2].norm(dim=1) < 4)
        wall = torch.tensor([0.8, 0.8, 0.78]) * (0.95 + 0.05 * d[:, :1])
        back = torch.where(on_desk[:, None], torch.tensor(desk) * shade[:, None], wall)
        color = torch.where(hit[:, None], ball, back).reshape(SIZE, SIZE, 3)
        noise = torch.rand(color.shape, generator=torch.Generator().manual_seed(view))
        found.append((255 * (color + 0.01 * (noise - 0.5))).round().byte())
        masks.append(hit.reshape(SIZE, SIZE).float())
    return found, masks


def test_the_desk_is_left_out():
    cameras = seen_from_above_and_from_the_side()
    photographs, true = pictures(cameras)
    threshold = plain.plain_threshold(photographs, cameras)
    assert threshold is not None
    found = [plain.plain_mask(one, threshold) for one in photographs]
    overlap = torch.tensor([iou(f, t) for f, t in zip(found, true, strict=True)])
    assert overlap.mean() > 0.95
    assert overlap.min() > 0.9


def test_a_room_with_texture_is_not_plain():
    cameras = cameras_around(VIEWS, SIZE)
    photographs = []
    for view in range(VIEWS):
        color = behind(image_rays(cameras, view), 4.0).reshape(SIZE, SIZE, 3)
        stripes = 0.3 * (torch.arange(SIZE) % 8 < 4).float()[:, None, None]
        photographs.append((255 * (0.6 * color + stripes)).clamp(0, 255).byte())
    assert plain.plain_threshold(photographs, cameras) is None


def test_nothing_but_a_wall_is_no_object():
    cameras = cameras_around(VIEWS, 32)
    white = torch.full((32, 32, 3), 230, dtype=torch.uint8)
    assert plain.plain_threshold([white] * VIEWS, cameras) is None
    assert not plain.plain_mask(white, 0.02).any()


def test_lines_and_specks_are_no_object(monkeypatch):
    """The edge of a desk is thin; a mark on the wall is small."""
    monkeypatch.setattr(plain, "SMALLEST_PART", 0.1)
    picture = torch.full((80, 80, 3), 200, dtype=torch.uint8)
    picture[40:] = 120
    picture[20:60, 20:60] = torch.tensor([200, 30, 30], dtype=torch.uint8)
    picture[5:12, 5:12] = 40
    true = torch.zeros(80, 80)
    true[20:60, 20:60] = 1
    found = plain.plain_mask(picture, 0.02)
    assert iou(found, true) > 0.93
    assert not found[:, :15].any()
