"""Lens distortion: the pinhole that replaces a lens, and pictures that come out straight."""

import numpy as np
import pytest
import torch
from layouts import Scene, scene, write_colmap, write_nerfstudio

from univoxel.camera import image_rays
from univoxel.data import load_photos
from univoxel.data.lens import Lens, shrink, shrunk, sources, straighten, straightened
from univoxel.errors import DataError

WIDTH, HEIGHT, FOCAL, CENTRE = 96, 64, 90.0, (50.0, 30.0)
BENT = {
    "barrel": ((-0.2, 0.05, 0.0), (0.0, 0.0)),
    "pincushion": ((0.15, 0.0, 0.02), (0.0, 0.0)),
    "tangential": ((0.05, -0.1, 0.0), (0.01, -0.02)),
}


def lens_of(kind):
    radial, tangential = BENT[kind]
    return Lens(WIDTH, HEIGHT, (FOCAL, FOCAL), CENTRE, radial, tangential)


def seen_by_opencv(kind, x, y):
    """Pixels of directions (x, y, 1), as OpenCV documents its model."""
    (k1, k2, k3), (p1, p2) = BENT[kind]
    r = np.hypot(x, y)
    factor = 1 + k1 * r**2 + k2 * r**4 + k3 * r**6
    u = x * factor + (2 * p1 * x * y + p2 * (r**2 + 2 * x**2))
    v = y * factor + (p1 * (r**2 + 2 * y**2) + 2 * p2 * x * y)
    return FOCAL * u + CENTRE[0], FOCAL * v + CENTRE[1]


def directions_of_pixels(kind):
    """The directions (x, y, 1) that the lens shows at its pixel centres, by fixed-point steps."""
    column, row = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    x, y = (column - CENTRE[0]) / FOCAL, (row - CENTRE[1]) / FOCAL
    for _ in range(100):
        u, v = seen_by_opencv(kind, x, y)
        x, y = x + (column - u) / FOCAL, y + (row - v) / FOCAL
    u, v = seen_by_opencv(kind, x, y)
    assert max(np.abs(u - column).max(), np.abs(v - row).max()) < 1e-9
    return x, y


def pattern(x, y):
    """Smooth linear colours and coverage of directions: [..., 4] in [0, 1]."""
    waves = [np.sin(5 * x + 1), np.cos(4 * y), np.sin(3 * (x + y)), np.cos(4 * (x - y) + 0.5)]
    return 0.5 + 0.4 * np.stack(waves, -1)


@pytest.mark.parametrize("kind", BENT)
def test_the_pinhole_sees_most_without_empty_pixels(kind):
    lens = lens_of(kind)
    x, y = np.meshgrid(np.linspace(-0.6, 0.5, 12), np.linspace(-0.3, 0.4, 9))
    np.testing.assert_allclose(lens.seen(x, y), seen_by_opencv(kind, x, y))
    pinhole = straightened(lens)
    assert straightened(pinhole) is pinhole
    assert not pinhole.bent
    assert (pinhole.width, pinhole.height, pinhole.centre) == (WIDTH, HEIGHT, CENTRE)
    edge = np.linspace(0, 1, 999)
    column = np.concatenate([WIDTH * edge, WIDTH * edge, 0 * edge, 0 * edge + WIDTH])
    row = np.concatenate([0 * edge, 0 * edge + HEIGHT, HEIGHT * edge, HEIGHT * edge])
    x, y = ((p - c) / f for p, c, f in zip((column, row), CENTRE, pinhole.focal, strict=True))
    u, v = seen_by_opencv(kind, x, y)
    inside = np.minimum.reduce([u, WIDTH - u, v, HEIGHT - v])
    assert abs(inside.min()) < 0.01  # pixels: it touches the border between the points looked at


@pytest.mark.parametrize("kind", BENT)
def test_pictures_come_out_straight(kind):
    lens = lens_of(kind)
    pinhole = straightened(lens)
    bent = torch.from_numpy(pattern(*directions_of_pixels(kind))).float()
    straight = straighten(bent, sources(lens, pinhole))
    column, row = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    x, y = (column - CENTRE[0]) / pinhole.focal[0], (row - CENTRE[1]) / pinhole.focal[1]
    # Bilinear: an eighth of the second derivative, 25 * 0.4 / 90^2, in each direction; at the
    # border half a pixel is missing, 5 * 0.4 / 90 / 2
    error = (straight.numpy() - pattern(x, y))[1:-1, 1:-1]
    assert np.abs(error).max() < 5e-4
    np.testing.assert_allclose(straight, pattern(x, y), atol=0.012)


def bent_scene(kind, views=2):
    """Photographs of the pattern through the lens; it is fixed to the camera, poses say nothing."""
    picture = pattern(*directions_of_pixels(kind))
    encoded = np.where(
        picture <= 0.0031308, 12.92 * picture, 1.055 * np.abs(picture) ** (1 / 2.4) - 0.055
    )
    encoded[..., 3] = picture[..., 3]
    stored = (255 * encoded).round().astype(np.uint8)
    return Scene(scene(views).poses, np.stack([stored] * views))


def write_opencv(folder, kind):
    (k1, k2, _), (p1, p2) = BENT[kind]
    parameters = (FOCAL, FOCAL, *CENTRE, k1, k2, p1, p2)
    write_colmap(folder, bent_scene(kind), model="OPENCV", parameters=parameters)


def write_transforms(folder, kind):
    (k1, k2, k3), (p1, p2) = BENT[kind]
    values = {"k1": k1, "k2": k2, "k3": k3, "p1": p1, "p2": p2, "fl_x": FOCAL, "fl_y": FOCAL}
    write_nerfstudio(folder, bent_scene(kind), cx=CENTRE[0], cy=CENTRE[1], **values)


@pytest.mark.parametrize(
    ("write", "kind"),
    [
        (write_opencv, "barrel"),
        (write_opencv, "tangential"),
        (write_transforms, "pincushion"),
        (write_transforms, "tangential"),
    ],
)
def test_loaded_photographs_are_those_of_pinholes(tmp_path, write, kind):
    write(tmp_path, kind)
    photos = load_photos(tmp_path, "test")
    assert photos.about.endswith("96x64 pixels in test, lens distortion removed")
    rays, pose = image_rays(photos.cameras, 0), photos.cameras.camera_to_world[0]
    local = rays.direction @ pose[:, :3]
    x, y = (local[:, 0] / -local[:, 2]).numpy(), (-local[:, 1] / -local[:, 2]).numpy()
    wanted = pattern(x, y).reshape(HEIGHT, WIDTH, 4)
    color, alpha = photos.picture(0)
    inner = slice(1, -1), slice(1, -1)
    # As above, and steps of 8 bits: of sRGB twice, worth up to 0.009 where bright
    np.testing.assert_allclose(color[inner], wanted[..., :3][inner], atol=0.012)
    np.testing.assert_allclose(alpha[inner], wanted[..., 3][inner], atol=0.005)


@pytest.mark.parametrize(
    ("model", "parameters", "radial"),
    [
        ("SIMPLE_RADIAL", (FOCAL, *CENTRE, -0.1), (-0.1, 0.0, 0.0)),
        ("RADIAL", (FOCAL, *CENTRE, -0.1, 0.02), (-0.1, 0.02, 0.0)),
        ("OPENCV", (FOCAL, 80.0, *CENTRE, -0.1, 0.02, 0.0, 0.0), (-0.1, 0.02, 0.0)),
        ("PINHOLE", (FOCAL, 80.0, *CENTRE), (0.0, 0.0, 0.0)),
    ],
)
def test_models_of_colmap(tmp_path, model, parameters, radial):
    flat = Scene(scene(2).poses, np.full((2, HEIGHT, WIDTH, 4), 100, np.uint8))
    write_colmap(tmp_path, flat, model=model, parameters=parameters)
    cameras = load_photos(tmp_path, "test").cameras
    focal = (FOCAL, 80.0 if 80.0 in parameters else FOCAL)
    wanted = straightened(Lens(WIDTH, HEIGHT, focal, CENTRE, radial))
    assert cameras.focal[0].tolist() == pytest.approx(wanted.focal)
    assert cameras.centre[0].tolist() == pytest.approx(CENTRE)
    write_colmap(tmp_path, flat, model="SIMPLE_RADIAL", parameters=(FOCAL, *CENTRE, 50.0))
    with pytest.raises(DataError, match=r"images\.bin: removing lens distortion would leave"):
        load_photos(tmp_path)


def test_shrinking_keeps_the_view():
    lens = Lens(10, 7, (8.0, 9.0), (5.0, 3.5))
    small = shrunk(lens, 3)
    assert (small.width, small.height) == (3, 2)
    x, y = np.array([0.1, -0.3]), np.array([0.2, 0.0])
    for large, little in zip(lens.seen(x, y), small.seen(x, y), strict=True):
        np.testing.assert_allclose(little, large / 3)
    picture = torch.arange(70.0).view(7, 10, 1)
    assert shrink(picture, 3)[1, 2, 0] == picture[3:6, 6:9].mean()
    assert shrink(picture, 3).shape == (2, 3, 1)
