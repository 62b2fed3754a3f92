"""Metashape's XML: lenses, components and errors. Axes are checked by test_layouts."""

from functools import partial

import numpy as np
import pytest
from layouts import FOCAL, HEIGHT, WIDTH, refused, replaced, scene, write_metashape

from univoxel.data import load_photos, photogrammetry

TERMS = {"k1": 0.03, "k2": -0.02, "k3": 0.01, "k4": 0.05, "p1": 0.004, "p2": -0.007}
OFFSETS = {"cx": 0.75, "cy": -0.5, "b1": 0.4}

edited = partial(replaced, "cameras.xml")


def calibration(**terms):
    return "".join(f"<{key}>{value}</{key}>" for key, value in terms.items())


def test_lenses_bend_as_the_manual_says(tmp_path):
    """x' = x (1 + K1 r2 + ..) + P1 (r2 + 2 x2) + 2 P2 x y, u = w / 2 + cx + x' f + x' B1."""
    text = calibration(**TERMS, **OFFSETS)
    path = write_metashape(tmp_path, scene(), text) / "cameras.xml"
    sensor = photogrammetry._chunk(path).find("sensors/sensor")
    u, v = photogrammetry._sensor_lens(sensor, "here").seen(
        x := np.array([0.3, -0.2]), y := np.array([0.1, 0.25])
    )
    rr = x * x + y * y
    radial = 1 + 0.03 * rr - 0.02 * rr**2 + 0.01 * rr**3 + 0.05 * rr**4
    bent_x = x * radial + 0.004 * (rr + 2 * x * x) - 2 * 0.007 * x * y
    bent_y = y * radial - 0.007 * (rr + 2 * y * y) + 2 * 0.004 * x * y
    np.testing.assert_allclose(u, WIDTH / 2 + 0.75 + bent_x * (FOCAL + 0.4), rtol=1e-12)
    np.testing.assert_allclose(v, HEIGHT / 2 - 0.5 + bent_y * FOCAL, rtol=1e-12)


def test_distortion_is_taken_out(tmp_path):
    photos = load_photos(write_metashape(tmp_path, scene(), calibration(k1=0.01)))
    assert "lens distortion removed" in photos.about


def test_the_largest_component_is_read(tmp_path):
    write_metashape(tmp_path, scene())
    edited(
        *(
            (f'component_id="0" label="p_00{v}"', f'component_id="1" label="p_00{v}"')
            for v in (1, 5)
        )
    )(tmp_path)
    photos = load_photos(tmp_path)
    assert photos.names == ["p_002", "p_003", "p_004", "p_006", "p_007", "p_008", "p_009"]
    assert "3 of 11 cameras left out: not placed, not enabled or in another" in photos.about


def test_cameras_that_are_not_enabled(tmp_path):
    write_metashape(tmp_path, scene())
    edited(('label="p_003"', 'label="p_003" enabled="0"'))(tmp_path)
    assert "p_003" not in load_photos(tmp_path).names


def test_a_chunk_without_components(tmp_path):
    """Its own transform leads to the world then."""
    written = scene()
    write_metashape(tmp_path, written)
    edited(
        ('<components><component id="0">', ""),
        ("</component></components>", ""),
        (' component_id="0"', ""),
    )(tmp_path)
    found = load_photos(tmp_path).cameras.camera_to_world[:, :, 3]
    wanted = written.poses[written.split("train"), :3, 3]
    np.testing.assert_allclose(found, wanted, atol=1e-5)


SENSOR = '<sensor id="3" label="unknown" type="frame">'


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (edited(("</chunk>", "")), "cameras.xml: this XML could not be read: mismatched tag"),
        (
            edited(("<document", '<!DOCTYPE d [<!ENTITY a "b">]><document')),
            "cameras.xml: expected Metashape XML, got XML with a DOCTYPE",
        ),
        (
            edited(("<chunk", "<x><chunk"), ("</chunk>", "</chunk></x>")),
            "expected one chunk, got 0",
        ),
        (edited(("transform>", "other>")), "xml: none of the 11 cameras is both"),
        (edited((SENSOR, '<sensor id="4">')), "camera p_000: this sensor is not listed"),
        (edited((SENSOR, '<sensor id="3" type="fisheye">')), "expected a sensor of type frame"),
        (edited(("calibration", "other")), "camera p_000: expected a calibration, found none"),
        (edited(("<f>11.0</f>", "")), "camera p_000: expected a number for f, got nothing"),
        (edited(("<f>11.0", "<f>wide")), "camera p_000: expected a number for f, got 'wide'"),
        (edited(("<f>11.0", "<f>-11.0")), "camera p_000: expected fl_x between 0 and inf"),
        (edited(("<f>11.0", "<p3>.1</p3><f>11.0")), "expected distortion terms k1 to k4"),
        (edited(("<f>11.0", "<b2>2</b2><f>11.0")), "p_000: expected perpendicular rows"),
        (edited(('width="12"', 'width="0"')), "camera p_000: expected a resolution above 0,"),
        (edited(('width="12"', "")), "camera p_000: expected a number for width, got nothing"),
        (edited(('width="12"', 'width="9"')), r"p_000.png: expected the aspect ratio 9x8"),
        (edited(("<scale>2.5", "<scale>-2.5")), "transform of component 0: expected a scale"),
        (edited(("<scale>2.5", "<scale>2.5 1")), "transform of component 0: expected 1 numbers"),
        (edited(("<rotation>", "<rotation>1 ")), "transform of component 0: expected 9 numbers"),
        (
            edited(('label="p_000"><transform>', 'label="p_000"><transform>1 ')),
            "camera p_000: expected 16 numbers as transform",
        ),
        (lambda f: (f / "images").rename(f / "photos"), "cameras.xml: missing images: p_000"),
    ],
)
def test_one_line_for_what_is_broken(tmp_path, damage, message):
    refused(write_metashape(tmp_path, scene()), damage, message)
