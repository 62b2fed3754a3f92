"""Polycam's raw data: where it lies, and errors. Axes are checked by test_layouts."""

import layouts
import pytest
from layouts import FOCAL, refused, scene, write_polycam

from univoxel.data import load_photos


def edited(**values):
    name = "keyframes/corrected_cameras/p_003.json"
    return layouts.edited(name, lambda camera: camera.update(values))


@pytest.mark.parametrize("place", ["keyframes/corrected_", "keyframes/", "corrected_"])
def test_places(tmp_path, place):
    assert len(load_photos(write_polycam(tmp_path, scene(), place))) == 8


def test_what_loops_were_closed_in_comes_first(tmp_path):
    """Beside it lie the cameras as they were tracked."""
    write_polycam(tmp_path, scene())
    (tmp_path / "keyframes" / "cameras").mkdir()
    (tmp_path / "keyframes" / "cameras" / "p_001.json").write_text("{}")
    assert len(load_photos(tmp_path)) == 8


def test_cameras_of_larger_pictures(tmp_path):
    write_polycam(tmp_path, scene())
    edited(width=48, height=32, fx=4 * FOCAL, fy=4 * FOCAL, cx=24, cy=16)(tmp_path)
    cameras = load_photos(tmp_path).cameras
    assert cameras.focal.unique().tolist() == [FOCAL]
    assert cameras.centre.unique(dim=0).tolist() == [[6, 4]]


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (edited(fx=0), "p_003.json: expected fl_x between 0 and inf, got 0"),
        (edited(cy=None), "p_003.json: expected cy between -inf and inf, got nothing"),
        (edited(width="12"), "p_003.json: expected width between 0 and inf, got '12'"),
        (edited(t_12=None), "p_003.json: expected t_12 between -inf and inf, got nothing"),
        (edited(t_00=9.0), "p_003.json: expected rotation and translation"),
        (edited(width=10), "p_003.png: expected the aspect ratio 10x8 of .*, got 12x8"),
        (
            lambda f: (f / "keyframes" / "corrected_cameras" / "p_003.json").write_text("[]"),
            r"p_003.json: expected a JSON object, got \[\]",
        ),
        (
            lambda f: (f / "keyframes" / "corrected_cameras" / "p_003.json").write_text("{"),
            "p_003.json: invalid JSON in line 1",
        ),
        (
            lambda f: (f / "keyframes" / "corrected_images").rename(f / "keyframes" / "images"),
            "corrected_cameras: missing images: p_000, p_001, .*looked in .*corrected_images",
        ),
    ],
)
def test_one_line_for_what_is_broken(tmp_path, damage, message):
    refused(write_polycam(tmp_path, scene()), damage, message)
