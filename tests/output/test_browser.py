"""The page in a real browser: what it shows, what it asks for, what hands do to it.

Without a browser these tests are skipped; `make page-test` brings one in.
"""

import json
import math
from functools import partial

import asymmetric_scene
import numpy as np
import pytest
from asymmetric_scene import lamp, layers_of, with_metal
from browser import browser, installed, pixels

from univoxel.cli.relight import relight_images
from univoxel.color import linear_to_srgb
from univoxel.data.images import write_exr
from univoxel.output import viewpoints
from univoxel.output.page import PageOptions, page_text
from univoxel.render.pipeline import surface_of_view

pytestmark = pytest.mark.skipif(
    installed() is None, reason="needs a browser, such as Debian's package chromium"
)
SIZE = 160
Y_UP = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # of glTF, from +Z up


looking = partial(asymmetric_scene.looking, size=SIZE, focal=2.2)


def seen_by(camera):
    """A camera as the arguments of the page's `picture`: size, matrix, projection by columns."""
    matrix = np.eye(4)
    matrix[:3] = Y_UP @ camera.camera_to_world[0].numpy()
    (fx, fy), (cx, cy) = camera.focal[0].tolist(), camera.centre[0].tolist()
    near, far = 0.1, 100.0
    projection = np.zeros((4, 4))
    projection[0, [0, 2]] = 2 * fx / SIZE, 1 - 2 * cx / SIZE
    projection[1, [1, 2]] = 2 * fy / SIZE, 2 * cy / SIZE - 1
    projection[2, 2:] = -(far + near) / (far - near), -2 * far * near / (far - near)
    projection[3, 2] = -1
    arguments = [[SIZE, SIZE], matrix.T.ravel().tolist(), projection.T.ravel().tolist()]
    return ", ".join(map(json.dumps, arguments))


@pytest.fixture(scope="module")
def scene():
    scene = with_metal()
    scene.sky = None  # as with --light sg: a run without a map
    return scene


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A run's folder, with a map beside it: a wide warm light at +X, dim blue all round."""
    folder = tmp_path_factory.mktemp("page")
    radiance = lamp().radiance
    write_exr(folder / "lamp.exr", dict(zip("RGB", radiance.unbind(2), strict=True)), half=False)
    return folder


@pytest.fixture(scope="module")
def tab(scene, folder):
    """A tab that shows the page of the scene under the lamp."""
    options = PageOptions(
        title="Balls", envmaps=[folder / "lamp.exr"], faces=4000, texture_size=512
    )
    page = folder / "balls.html"
    page.write_text(page_text(folder, scene, options), encoding="utf-8")
    with browser() as tab:
        tab.open(page.as_uri(), 480, 360)
        tab.run("univoxel.ready")
        yield tab


@pytest.fixture
def fresh(tab):
    """The tab, its light and layer as at the begin."""
    tab.run('univoxel.set({layer: "render", light: 0, turn: 0, exposure: 0, background: false})')
    return tab


def taken(tab, camera):
    """A picture composited on black [H, W, 3], and its alpha [H, W]."""
    picture = pixels(tab.run(f"univoxel.picture({seen_by(camera)})"))
    return picture[..., :3] * picture[..., 3:], picture[..., 3]


def psnr(a, b):
    return -10 * math.log10(np.square(a - b).mean())


@pytest.mark.parametrize(
    ("azimuth", "elevation", "turn", "stops"), [(25.0, 20.0, 0.0, 0.0), (140.0, -15.0, 70.0, -1.0)]
)
def test_it_looks_as_relit(fresh, scene, folder, monkeypatch, azimuth, elevation, turn, stops):
    camera = looking(azimuth, elevation)
    monkeypatch.setattr(viewpoints, "load_scene", lambda run: scene)
    options = {"rotate": turn, "exposure": 2**stops, "samples": 64}
    expected = relight_images(folder, folder / "lamp.exr", camera, **options)[0]
    fresh.run(f"univoxel.set({{turn: {turn}, exposure: {stops}}})")
    shown, alpha = taken(fresh, camera)
    expected_rgb = linear_to_srgb(expected[..., :3]).numpy()
    # Of a rasteriser and a path tracer: split sums for the gloss, harmonics for the shadows
    assert psnr(shown, expected_rgb) >= 25
    inside = (alpha > 0.9) & (expected[..., 3].numpy() > 0.9)
    assert inside.sum() > 3000
    assert psnr(shown[inside], expected_rgb[inside]) >= 25


def test_layers_are_the_materials(fresh, scene):
    camera = looking(25.0, 20.0)
    surface, _ = surface_of_view(scene, camera, 0)
    for layer, values in layers_of(surface).items():
        fresh.run(f'univoxel.set({{layer: "{layer}"}})')
        shown, alpha = taken(fresh, camera)
        inside = (alpha > 0.999) & (surface.opacity.reshape(SIZE, SIZE).numpy() > 0.999)
        error = np.abs(shown - values.reshape(SIZE, SIZE, 3).numpy())[inside]
        # 8 bits, JPEG, and a pixel's place on a coarse mesh; a wrong axis or curve is off by 0.2
        assert np.median(error) < 0.01, layer
        assert error.mean() < 0.02, layer


def brightest_side(tab, camera):
    """Degrees, counter-clockwise in the picture, of where the light is on the object."""
    shown, alpha = taken(tab, camera)
    y, x = np.mgrid[SIZE:0:-1, 0:SIZE]
    middle = [(w * alpha).sum() / alpha.sum() for w in (x, y)]
    weight = shown.sum(2) ** 4
    side = [(w * weight).sum() / weight.sum() - m for w, m in zip((x, y), middle, strict=True)]
    return math.degrees(math.atan2(side[1], side[0]))


def test_turning_the_light_moves_the_brightest_side(fresh):
    """Counter-clockwise from above, as --rotate: seen from above +X is on the right."""
    camera = looking(-90.0, 89.9)
    for turn in (0, 90, 180, -90):
        fresh.run(f"univoxel.set({{turn: {turn}}})")
        off = (brightest_side(fresh, camera) - turn + 180) % 360 - 180
        assert abs(off) < 40, turn  # the balls are no ball


def test_exposure_doubles_light(fresh):
    camera = looking(25.0, 20.0)
    linear = lambda srgb: np.where(srgb < 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)  # noqa: E731
    pictures = []
    for stops in (-2, -1):
        fresh.run(f"univoxel.set({{exposure: {stops}}})")
        pictures.append(taken(fresh, camera)[0])
    where = (pictures[0] > 0.2) & (pictures[1] < 0.95)
    assert where.sum() > 1000
    assert np.median(linear(pictures[1][where]) / linear(pictures[0][where])) == pytest.approx(
        2, abs=0.03
    )


def test_the_backdrop_is_the_map(fresh):
    """From +X towards -X the lamp is behind the eye; turned by half a circle it is in sight."""
    camera = looking(0.0, -28.0)
    brightness = []
    for turn in (0, 180):
        fresh.run(f"univoxel.set({{background: true, turn: {turn}}})")
        shown, alpha = taken(fresh, camera)
        assert alpha.min() == 1
        brightness.append(shown[:20].mean())
    assert brightness[1] > brightness[0] + 0.2


def test_nothing_leaves_the_page(tab):
    """Nor could it: the page forbids itself all but what it holds."""
    assert tab.requests[0].startswith("file:")
    assert {url.partition(":")[0] for url in tab.requests[1:]} <= {"blob", "data"}
    tab.run('fetch("https://example.org/").then(() => "sent", () => "refused")')
    assert tab.run('fetch("http://127.0.0.1:9/").catch((e) => "refused")') == "refused"
    complaints = [text for text in tab.errors if "Content Security Policy" in text]
    assert complaints
    tab.errors[:] = [
        text
        for text in tab.errors
        # the refusals above, and what software WebGL lacks
        if "violates" not in text and "KHR_parallel_shader_compile" not in text
    ]
    assert tab.errors == []


def state(tab):
    return tab.run("univoxel.state")


def eye(tab):
    """Where the camera stands; the tab asks for no gliding."""
    return tab.run("univoxel.eye()")


def test_hands_turn_the_view_and_the_light(fresh):
    before = eye(fresh)
    fresh.drag((240, 120), (300, 130))
    assert eye(fresh) != before
    assert state(fresh)["turn"] == 0
    before = eye(fresh)
    fresh.drag((240, 120), (300, 120), modifiers=8)  # Shift
    assert state(fresh)["turn"] == pytest.approx(300 * 60 / 480)
    assert eye(fresh) == pytest.approx(before)
    fresh.run('document.getElementById("grab").click()')
    fresh.drag((240, 120), (180, 120))
    fresh.run('document.getElementById("grab").click()')
    assert state(fresh)["turn"] == pytest.approx(0, abs=1e-6)
    assert eye(fresh) == pytest.approx(before)


def test_buttons_and_sliders(fresh):
    fresh.run('document.querySelector("#layers [data-name=normal]").click()')
    assert state(fresh)["layer"] == "normal"
    last = fresh.run("univoxel.lights.length") - 1
    assert fresh.run("univoxel.lights") == ["lamp", "studio", "city", "sunset", "overcast"]
    fresh.run('document.querySelector("#lights [data-name=overcast]").click()')
    assert state(fresh)["light"] == last
    fresh.run(
        'const turn = document.getElementById("turn"); turn.value = -45;'
        'turn.dispatchEvent(new Event("input"))'
    )
    assert state(fresh)["turn"] == -45
    fresh.run('document.getElementById("background").click()')
    assert state(fresh)["background"] is True
    assert fresh.run('document.getElementById("panel").hidden') is True
    fresh.run('document.getElementById("about").click()')
    assert fresh.run('document.getElementById("panel").hidden') is False
    fresh.run('document.getElementById("close").click()')


def test_on_a_phone_everything_fits(fresh):
    tab = fresh
    tab.window(360, 640, phone=True)
    outside = """
        [...document.querySelectorAll("nav button, #layers button, #sliders :is(button, input)")]
            .map((part) => part.getBoundingClientRect())
            .filter((box) => box.left < 0 || box.right > innerWidth
                || box.top < 0 || box.bottom > innerHeight).length"""
    assert tab.run("innerWidth") == 360
    assert tab.run(outside) == 0
    assert tab.run("document.documentElement.scrollWidth") == 360
    before = eye(tab)
    tab.swipe((180, 200), (240, 210))
    assert eye(tab) != before
    tab.run('document.getElementById("grab").click()')
    before = eye(tab)
    tab.swipe((180, 200), (240, 200))
    assert state(tab)["turn"] == pytest.approx(300 * 60 / 360, rel=0.05)
    assert eye(tab) == pytest.approx(before)
