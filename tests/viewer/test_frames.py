"""Frames of the viewer against the pictures of `univoxel relight` and the scene's own layers."""

import sys
import threading
import types
from dataclasses import replace
from itertools import islice

import pytest
import torch
from asymmetric_scene import lamp as a_lamp
from asymmetric_scene import layers_of, looking, subject_of, with_metal

from univoxel.cli.relight import RelightOptions, relight_images
from univoxel.color import linear_to_srgb
from univoxel.errors import UserError
from univoxel.ops import Sun
from univoxel.output import viewpoints
from univoxel.render.metrics import psnr
from univoxel.render.pipeline import surface_of_view
from univoxel.viewer import frames
from univoxel.viewer.frames import LAYERS, Look, quick_picture, refined_pictures
from univoxel.viewer.viewer_scene import mesh_of

SIZE = 40


@pytest.fixture(scope="module")
def scene():
    return with_metal()


@pytest.fixture(scope="module")
def subject(scene):
    return subject_of(scene)


@pytest.fixture(scope="module")
def lamp():
    return a_lamp()


@pytest.fixture
def camera():
    return looking(25, 30, SIZE, focal=2.0)


def straight(picture):
    """Linear premultiplied RGBA as sRGB with straight alpha."""
    alpha = picture[..., 3:]
    return torch.cat([linear_to_srgb(picture[..., :3] / alpha.clamp_min(1e-6)), alpha], -1)


def on_black(picture):
    return picture[..., :3] * picture[..., 3:]


def relit(monkeypatch, scene, lamp, camera, **options):
    monkeypatch.setattr(viewpoints, "load_scene", lambda run: scene)
    return straight(relight_images("run", lamp, camera, samples=1024, **options)[0])


def shown(pictures):
    return [picture for picture in pictures if picture is not None]


@pytest.mark.parametrize("backdrop", [False, True])
def test_at_rest_it_becomes_the_relit_picture(monkeypatch, scene, subject, lamp, camera, backdrop):
    """38 dB, which a picture of 64 samples reaches; the exposure and the turn are light's."""
    options = {"rotate": 70.0, "exposure": 0.5, "suns": [Sun((1, 1, 2), (1.0, 0.9, 0.8), 5.0)]}
    background = "map" if backdrop else "transparent"
    ground = None if backdrop else "lowest"
    expected = relit(
        monkeypatch, scene, lamp, camera, ground=ground, background=background, **options
    )
    lighting = RelightOptions(**options | {"exposure": 1.0}).lighting(lamp)
    look = Look(lighting, exposure=-1.0, ground=not backdrop, backdrop=backdrop)
    found = shown(refined_pictures(subject, camera, look, samples=64))
    quality = [float(psnr(on_black(p), on_black(expected))) for p in found]
    assert quality[-1] >= 38
    assert quality == sorted(quality)  # no pass makes it worse
    assert (found[-1][..., 3] - expected[..., 3]).abs().mean() < 0.01  # alpha holds the shadow


def test_a_quick_picture_is_about_the_same(monkeypatch, scene, subject, lamp, camera):
    """Of few samples: noise, and the silhouette of triangles."""
    expected = relit(monkeypatch, scene, lamp, camera)
    look = Look(viewpoints.lighting(lamp))
    assert psnr(on_black(quick_picture(subject, camera, look)), on_black(expected)) >= 20


def test_layers_are_the_materials(scene, subject, lamp, camera):
    surface, wo = surface_of_view(scene, camera, 0)
    depth = surface.depth * (wo @ camera.camera_to_world[0, :, 2])
    inside = surface.opacity > 0.999
    ends = (camera.camera_to_world[0, :, 3] - subject.traced.mesh.vertices) @ (
        camera.camera_to_world[0, :, 2]
    )
    near, far = ends.min(), ends.max()
    assert len(mesh_of(scene, 500).faces) <= 500
    expected = layers_of(surface) | {
        "depth": (1 - (depth - near) / (far - near))[:, None].expand(-1, 3),
    }
    assert set(expected) == set(LAYERS) - {"render", "expected error"}
    for layer, values in expected.items():
        look = Look(viewpoints.lighting(lamp), layer)
        quick, *_, last = shown(refined_pictures(subject, camera, look))
        exact = (last.reshape(-1, 4)[:, :3] - values.clamp(0, 1)).abs()[inside]
        assert exact.max() < 1e-4, layer
        difference = (quick.reshape(-1, 4)[:, :3] - values).abs()[inside]
        assert difference.mean() < 0.02, layer  # triangles in place of the field


def test_expected_errors_are_those_at_the_vertices(scene, subject, lamp, camera):
    """Black where no error is expected, near white where a large one is."""
    height = subject.traced.mesh.vertices[:, 2]
    known = replace(subject)
    vars(known)["albedo_error"] = 0.2 * (height > 0)
    look = Look(viewpoints.lighting(lamp), "expected error")
    (found,) = shown(refined_pictures(known, camera, look))
    surface, _ = surface_of_view(scene, camera, 0)
    up = surface.position[:, 2].reshape(SIZE, SIZE)
    solid = (surface.opacity > 0.999).reshape(SIZE, SIZE)
    assert found[solid & (up > 0.05)][:, :3].mean() > 0.8
    assert found[solid & (up < -0.05)][:, :3].mean() < 0.1
    with pytest.raises(UserError, match="photographs"):
        quick_picture(subject, camera, look)


def test_a_caller_can_leave_between_steps(subject, lamp, camera):
    """Steps are short: a picture of many samples comes in many of them."""
    look = Look(viewpoints.lighting(lamp))
    steps = list(islice(refined_pictures(subject, camera, look), 6))
    assert steps[0] is not None
    assert steps[1] is None


def test_denoised_pictures_are_better(monkeypatch, scene, subject, lamp, camera):
    """With the package itself: five times less error from the same few samples."""
    if not frames.available():
        pytest.skip("needs pyoidn")
    expected = relit(monkeypatch, scene, lamp, camera, ground="lowest")
    looks = [Look(viewpoints.lighting(lamp), ground=True, denoise=d) for d in (False, True)]
    noisy, clean = (shown(refined_pictures(subject, camera, look, samples=4)) for look in looks)
    for found in (noisy, clean):
        assert found[-1].shape == (SIZE, SIZE, 4)
    quality = [float(psnr(on_black(p[-1]), on_black(expected))) for p in (noisy, clean)]
    assert quality[1] > quality[0] + 3
    assert quality[1] >= 30
    shadow = [(p[-1][..., 3] - expected[..., 3]).abs().mean() for p in (noisy, clean)]
    assert shadow[1] < shadow[0]


def test_a_denoiser_goes_beside(monkeypatch, subject, lamp, camera):
    """It gets light, albedo and normals without background, and the last pass; None meanwhile."""
    calls, held = [], threading.Event()

    def slow(color, **others):
        held.wait(60)
        calls.append((color, others))
        return 0.5 * color

    package = types.SimpleNamespace(denoise=slow)
    monkeypatch.setitem(sys.modules, "pyoidn", package)
    noisy = shown(refined_pictures(subject, camera, Look(viewpoints.lighting(lamp)), samples=20))
    look = Look(viewpoints.lighting(lamp), denoise=True)
    pictures, steps = refined_pictures(subject, camera, look, samples=20), []
    for picture in pictures:
        steps.append(picture)
        if len(steps) > 40:
            held.set()  # the passes are over long since
    found = shown(steps)
    assert len(calls) == 2  # the first pass, then the last
    color, aside = calls[0]
    assert aside["hdr"] is True
    nothing = (noisy[-1][..., 3] == 0).numpy()
    for values in (color, aside["albedo"], aside["normal"]):
        assert values.shape == (SIZE, SIZE, 3)
        assert (values[nothing] == 0).all()
        assert (values[~nothing] != 0).any()
    half = Look(viewpoints.lighting(lamp), exposure=-1.0)
    last = shown(refined_pictures(subject, camera, half, samples=20))[-1]
    torch.testing.assert_close(found[-1], last, rtol=0, atol=1e-5)
    monkeypatch.setattr(frames, "find_spec", lambda name: None)
    assert not frames.available()
