"""RealityCapture's CSV: lenses, columns and errors. Angles are checked by test_layouts."""

from functools import partial

import numpy as np
import pytest
from layouts import FOCAL, refused, replaced, scene, write_realitycapture

from univoxel.data import load_photos, photogrammetry
from univoxel.errors import DataError

NEWER = "#name,x,y,alt,yaw,pitch,roll,f_35mm,px_norm,py_norm,k1,k2,k3,k4,t1,t2"
SHORT = "#name,x,y,alt,heading,pitch,roll,f"


@pytest.mark.parametrize(
    ("head", "lens"), [(NEWER, ",".join("0" * 8)), (SHORT, ""), (f"#cameras 10\n{SHORT}", "")]
)
def test_columns(tmp_path, head, lens):
    photos = load_photos(write_realitycapture(tmp_path, scene(), head, lens))
    assert len(photos) == 8
    assert photos.cameras.focal.unique().tolist() == pytest.approx([FOCAL])
    assert photos.cameras.centre[0].tolist() == [6, 4]


edited = partial(replaced, "cameras.csv")


def test_lenses_bend_as_the_vendor_says(tmp_path):
    """px and py in longer sides; t1 along x, as OpenCV's p2."""
    lens = "0.05,-0.025,0.03,-0.02,0.01,0.05,0.004,-0.007"
    path = write_realitycapture(tmp_path, scene(), lens=lens) / "cameras.csv"
    _, row = photogrammetry._rows(path)[0]
    found = photogrammetry._row_lens(row, tmp_path / "images" / "p_000.png", "here")
    u, v = found.seen(x := np.array([0.3, -0.2]), y := np.array([0.1, 0.25]))
    rr = x * x + y * y
    radial = 1 + 0.03 * rr - 0.02 * rr**2 + 0.01 * rr**3 + 0.05 * rr**4
    bent_x = x * radial + 0.004 * (rr + 2 * x * x) - 2 * 0.007 * x * y
    bent_y = y * radial - 0.007 * (rr + 2 * y * y) + 2 * 0.004 * x * y
    np.testing.assert_allclose(u, 6 + 12 * 0.05 + bent_x * FOCAL, rtol=1e-12)
    np.testing.assert_allclose(v, 4 - 12 * 0.025 + bent_y * FOCAL, rtol=1e-12)


def test_pictures_that_are_not_there_and_names_with_folders(tmp_path):
    write_realitycapture(tmp_path, scene())
    (tmp_path / "images" / "p_001.png").unlink()
    edited(("p_002.png", r"D:\shots\p_002.tif"))(tmp_path)
    photos = load_photos(tmp_path)
    assert photos.names[0] == "p_002"
    assert "1 of 10 listed images were left out" in photos.about


def value(index, new):
    """A change of one value of p_003, in the fifth line."""

    def apply(folder):
        lines = (folder / "cameras.csv").read_text().splitlines()
        values = lines[4].split(",")
        values[index] = new
        lines[4] = ",".join(values)
        (folder / "cameras.csv").write_text("\n".join(lines))

    return apply


def only_a_head(folder):
    (folder / "cameras.csv").write_text(SHORT + "\n")


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (value(4, "north"), "line 5: expected a number for heading, got 'north'"),
        (value(1, ""), "line 5: expected a number for x, got ''"),
        (value(3, "nan"), "line 5: expected a number for alt, got 'nan'"),
        (value(7, "0"), "line 5: expected fl_x between 0 and inf, got 0.0"),
        (value(8, "3"), "line 5: expected cx between -12 and 24, got 42.0"),
        (value(12, "far"), "line 5: expected a number for k3, got 'far'"),
        (value(10, "0,0"), "line 5: expected 16 values, got 17"),
        (only_a_head, "cameras.csv: expected a line for each camera, got none"),
        (
            lambda f: (f / "cameras.csv").write_bytes(SHORT.encode() + b"\n\xff"),
            "cameras.csv: expected text in UTF-8",
        ),
        (lambda f: (f / "images").rename(f / "photos"), "cameras.csv: missing images: p_000.png,"),
    ],
)
def test_one_line_for_what_is_broken(tmp_path, damage, message):
    refused(write_realitycapture(tmp_path, scene()), damage, message)


def test_another_csv_is_none_of_these(tmp_path):
    (tmp_path / "list.csv").write_text("name,price\n")
    (tmp_path / "list.xml").write_text("<html></html>")
    with pytest.raises(DataError, match=r"expected photographs with their cameras, got list\.csv"):
        load_photos(tmp_path)
