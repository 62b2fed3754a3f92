"""What each layout may say: names, splits, sizes, lenses, places.

Axes are checked by test_layouts, what is broken by test_broken_layouts.
"""

import subprocess
import sys
import threading
from functools import partial

import layouts
import numpy as np
import pytest
import torch
from layouts import FOCAL, HEIGHT, WIDTH, angle, edited, renamed, replaced, scene, without

from univoxel.data import load_photos, photogrammetry
from univoxel.data.images import write_exr, write_png
from univoxel.data.research import decomposed
from univoxel.data.transforms import RIGID_TOLERANCE, find_image
from univoxel.errors import DataError

NERF, JSON = "transforms_train.json", "transforms.json"
NOISE = np.random.default_rng(0).integers(1, 256, (HEIGHT, WIDTH, 4), dtype=np.uint8)


@pytest.fixture
def nerf(tmp_path):
    return layouts.write_nerf(tmp_path / "data", scene())


@pytest.fixture
def nerfstudio(tmp_path):
    return layouts.write_nerfstudio(tmp_path / "data", scene())


# NeRF's layout, and Synthetic4Relight's


def frames(*changes):
    """A change of each of the first frames."""
    return edited(NERF, lambda r: [f.update(c) for f, c in zip(r["frames"], changes, strict=False)])


def test_names_with_extension_and_with_dots(nerf):
    renamed("train/p_002.png", "train/p_2.5.png")(nerf)
    frames({"file_path": "train/p_001.png"}, {"file_path": "train/p_2.5"})(nerf)
    assert load_photos(nerf).names[:2] == ["p_001", "p_2.5"]
    for name in ("a.png", "a.png.png"):
        write_png(nerf / name, NOISE)
    assert find_image(nerf, "a.png", "frame 0").name == "a.png"  # an exact name comes first


def test_intrinsics_in_pixels(nerf):
    def change(root):
        del root["camera_angle_x"]
        root.update(fl_x=7.0, cx=2.5, cy=1.5, w=WIDTH, h=HEIGHT, k1=0.0)
        root["frames"][1].update(fl_x=9.0, fl_y=8.0)

    edited(NERF, change)(nerf)
    cameras = load_photos(nerf).cameras
    assert cameras.focal[:2].tolist() == [[7.0, 7.0], [9.0, 8.0]]  # one serves both axes
    assert cameras.centre[:2].tolist() == [[2.5, 1.5]] * 2


def test_rounded_matrices_become_rotations(nerf):
    wanted = load_photos(nerf).cameras.camera_to_world[0]
    matrix = torch.cat([wanted, torch.tensor([[0.0, 0, 0, 1]])]).double().numpy()
    matrix[:3, :3] *= 1 + 0.5 * RIGID_TOLERANCE
    frames(*({"transform_matrix": m.tolist()} for m in (matrix, matrix[:3])))(nerf)
    for found in load_photos(nerf).cameras.camera_to_world[:2]:
        torch.testing.assert_close(found, wanted)


def test_synthetic4relight(nerf):
    """Training views are linear EXR with a mask, test views RGBA PNG."""
    linear = np.random.default_rng(0).random((HEIGHT, WIDTH, 3)).astype(np.float32) * 3
    linear[0, 0] = -0.01  # a filter's undershoot
    for path in list((nerf / "train").iterdir()):
        channels = {name: linear[..., k] for k, name in enumerate("RGB")}
        write_exr(path.with_name(f"{path.stem}_rgb.exr"), channels, half=False)
        write_png(path.with_name(f"{path.stem}_mask.png"), NOISE[..., 0])
        path.unlink()
    renamed("test/p_000.png", "test/p_000_rgba.png")(nerf)
    train, test = load_photos(nerf), load_photos(nerf, "test")
    assert train.names[0] == "p_001"
    assert train.color.dtype == torch.float32
    assert np.array_equal(train.color[0].numpy(), linear.clip(0))
    assert np.array_equal(train.alpha[0].numpy(), NOISE[..., 0])
    assert test.names[0] == "p_000"
    assert np.array_equal(test.color[0].numpy(), scene().pictures[0, ..., :3])


def test_alpha_of_exr(nerf):
    """Colours are divided by it; alpha of both kinds becomes one."""
    plane, alpha = np.full((HEIGHT, WIDTH), 0.25, np.float32), np.full((HEIGHT, WIDTH), 0.5)
    alpha[0, 0] = 0.0
    for path in list((nerf / "train").iterdir()):
        path.unlink()
        write_exr(path.with_suffix(".exr"), dict.fromkeys("RGB", plane) | {"A": alpha})
    write_exr(nerf / "train/p_002.exr", dict.fromkeys("RGB", plane))
    write_png(nerf / "train/p_002_mask.png", np.full((HEIGHT, WIDTH), 51, np.uint8))
    photos = load_photos(nerf)
    assert photos.color[0, 1, 1].tolist() == [0.5] * 3
    assert photos.color[0, 0, 0].tolist() == [0.0] * 3
    assert photos.alpha[:2, 1, 1].tolist() == pytest.approx([0.5, 0.2])


def test_no_reader_outlives_an_error(nerf):
    """One that did would be ended by the garbage collector, in whichever thread that runs: a thread
    that was just starting has hung in it."""
    without("train/p_002.png")(nerf)
    write_exr(nerf / "train/p_002.exr", dict.fromkeys("RGBA", np.ones((HEIGHT, WIDTH))))
    before = threading.active_count()
    with pytest.raises(DataError, match="the same format as p_001") as caught:
        load_photos(nerf)
    assert caught.value.__traceback__ is not None  # which holds all frames
    assert threading.active_count() == before


def test_folders_that_are_no_scene(tmp_path):
    with pytest.raises(DataError, match="none: expected a folder with a scene, got nothing there"):
        load_photos(tmp_path / "none")
    with pytest.raises(DataError, match=r"got an empty folder.*\(looked for transforms_test"):
        load_photos(tmp_path, "test")
    for k in range(9):
        (tmp_path / f"{k}.txt").write_text("")
    with pytest.raises(DataError, match=r"0\.txt: expected a folder with a scene, got a file"):
        load_photos(tmp_path / "0.txt")
    with pytest.raises(DataError, match=r"got 0\.txt, .*4\.txt, \.\.\.\. If .* \(looked for tr"):
        load_photos(tmp_path)
    (tmp_path / "1.csv").write_text("name,price\n")
    (tmp_path / "2.xml").write_text("<html></html>")
    with pytest.raises(DataError, match=r"expected photographs with their cameras, got 0\.txt"):
        load_photos(tmp_path)


# transforms.json of nerfstudio and instant-ngp


def test_instant_ngps_angle_and_paths(nerfstudio):
    def change(root):
        for key in ("fl_x", "fl_y", "cx", "cy", "w", "h", "camera_model"):
            del root[key]
        root.update(camera_angle_x=angle(), camera_angle_y=0.6, scale=0.33, offset=[0.5] * 3)
        for frame in root["frames"]:
            frame.update(file_path=f"./{frame['file_path']}", sharpness=30.0)

    edited(JSON, change)(nerfstudio)
    cameras = load_photos(nerfstudio).cameras
    assert cameras.focal.flatten().tolist() == pytest.approx([FOCAL] * 16)
    assert cameras.centre[0].tolist() == [WIDTH / 2, HEIGHT / 2]


def test_what_a_frame_says_goes_before_what_the_file_does(nerfstudio):
    edited(JSON, lambda r: r["frames"][0].update(fl_x=20.0, cx=5.0))(nerfstudio)  # p_009 is first
    cameras = load_photos(nerfstudio).cameras
    assert cameras.focal[:, 0].tolist() == [FOCAL] * 7 + [20.0]
    assert cameras.centre[7].tolist() == [5.0, HEIGHT / 2]


def test_splits_of_the_file_and_masks_without_mask_path(nerfstudio):
    names = {"train_filenames": ["images/p_003.png", "images/p_001.png"]}
    names["test_filenames"] = ["images/p_000.png"]
    edited(JSON, lambda r: r.update(names))(nerfstudio)
    edited(JSON, lambda r: [frame.pop("mask_path") for frame in r["frames"]])(nerfstudio)
    test = load_photos(nerfstudio, "test")
    assert load_photos(nerfstudio).names == ["p_003", "p_001"]
    assert test.names == ["p_000"]
    assert np.array_equal(test.alpha[0], scene().pictures[0, ..., 3])


# COLMAP's models


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("place", ["sparse/0", "sparse", "colmap/sparse/0", "."])
def test_places_of_colmap(tmp_path, place, text):
    photos = load_photos(layouts.write_colmap(tmp_path, scene(), place, text), "test")
    assert photos.names == ["p_000", "p_008"]


@pytest.mark.parametrize("form", ["binary", "text"])
def test_models_that_colmap_itself_writes(tmp_path, form):
    """With rigs and frames beside, as it has them since 3.12; of one and the same model."""
    pytest.importorskip("pycolmap")
    data = layouts.write_colmap(tmp_path, scene(), text=True)
    model, plain = data / "sparse/0", load_photos(data)
    (model / "points3D.txt").touch()
    program = (
        "import sys, zlib, pycolmap; from pathlib import Path; model = Path(sys.argv[1])\n"
        "read = pycolmap.Reconstruction(model)\n"
        "for file in model.iterdir(): file.unlink()\n"
        f"read.write_{form}(model)"
    )
    subprocess.run([sys.executable, "-c", program, model], check=True)  # never beside torch
    assert len(list(model.glob({"binary": "*.bin", "text": "*.txt"}[form]))) >= 3
    photos = load_photos(data)
    assert photos.names == plain.names
    torch.testing.assert_close(photos.cameras.camera_to_world, plain.cameras.camera_to_world)
    torch.testing.assert_close(photos.cameras.focal, plain.cameras.focal)


def test_binary_files_come_first(tmp_path):
    layouts.write_colmap(tmp_path, scene())
    layouts.write_colmap(tmp_path, scene(3), text=True)
    assert len(load_photos(tmp_path)) == 8


@pytest.mark.parametrize("text", [True, False])
def test_of_several_models_the_largest_is_read(tmp_path, text):
    """COLMAP's first try may have placed two photographs, and wrongly."""
    layouts.write_colmap(tmp_path, scene(2), place="sparse/0", text=text)
    layouts.write_colmap(tmp_path, scene(10), place="sparse/1", text=text)
    photos = load_photos(tmp_path)
    assert len(photos) == 8
    assert "sparse/1, the largest of 2 models" in photos.about


def test_photographs_in_folders_and_names_with_spaces(tmp_path):
    layouts.write_colmap(tmp_path, scene(2), text=True)
    for part, ending in (("images", ".png"), ("masks", ".png.png")):
        (tmp_path / part / "a b").mkdir()
        for v in range(2):
            renamed(f"{part}/p_00{v}{ending}", f"{part}/a b/p {v}{ending}")(tmp_path)
    replaced("sparse/0/images.txt", ("p_00", "a b/p "))(tmp_path)
    assert load_photos(tmp_path, "test").names == ["a b_p 0"]


# Layouts of research


def test_the_largest_photographs_of_llff_are_read(tmp_path):
    layouts.write_llff(tmp_path, scene(width=6, height=4), original=8, place="images_8")
    layouts.write_llff(tmp_path, scene(), original=4, place="images_4")
    assert load_photos(tmp_path).cameras.width == 12


@pytest.mark.parametrize("odd", [0, 1])
def test_masks_of_the_originals(tmp_path, odd):
    """images_4 beside masks of four times the size, rows and columns left over cut off."""
    layouts.write_llff(tmp_path, scene(), original=4, place="images_4")
    (tmp_path / "masks").mkdir()
    block = np.tile(np.uint8([0, 140, 180, 240]), (4, 1))  # mean 140
    for path in (tmp_path / "masks_4").iterdir():
        path.unlink()
        whole = np.pad(np.tile(block, (8, 12)), ((0, odd), (0, odd)))
        write_png(tmp_path / "masks" / path.name, whole)
    assert (load_photos(tmp_path).alpha == 140).all()


@pytest.mark.parametrize("factor", [-3.0, 1e-4, 250.0])
def test_projections_have_any_scale_and_sign(tmp_path, factor):
    wanted = load_photos(layouts.write_idr(tmp_path / "a", scene())).cameras
    found = load_photos(layouts.write_idr(tmp_path / "b", scene(), factor=factor)).cameras
    for key in ("camera_to_world", "focal", "centre"):
        np.testing.assert_allclose(getattr(found, key), getattr(wanted, key), atol=1e-5)


@pytest.mark.parametrize("file", ["cameras.npz", "cameras_large.npz"])
def test_other_files_of_idr(tmp_path, file):
    photos = load_photos(layouts.write_idr(tmp_path, scene(), file))
    assert photos.cameras.focal.flatten().tolist() == pytest.approx([FOCAL] * 16)
    assert f"IDR layout ({file})" in photos.about


def test_the_parts_of_a_projection():
    """Skew, too, and focal lengths that differ."""
    intrinsics = np.array([[900.0, 0.25, 310.0], [0, 880.0, 245.0], [0, 0, 1]])
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    turn *= np.linalg.det(turn)
    place = np.array([0.5, -2.0, 7.0])
    found, pose = decomposed(intrinsics @ np.column_stack([turn, -turn @ place]), "here")
    np.testing.assert_allclose(found, intrinsics, atol=1e-9)
    np.testing.assert_allclose(pose[:, 3], place, atol=1e-12)
    np.testing.assert_allclose(pose[:, :3].T, np.diag([1, -1, -1]) @ turn, atol=1e-12)


def named_anew(folder, place, name):
    for v, path in enumerate(sorted((folder / place).iterdir())):
        path.rename(folder / place / name.format(v))


@pytest.mark.parametrize(
    ("image", "mask"),
    [
        ("{:06d}.png", "{:03d}.png"),  # DTU in NeuS
        ("rect_{:03d}_3_r5000.png", "{:03d}.png"),  # by their place
        ("{:08d}.png", "{:08d}.png"),
    ],
)
def test_names_of_masks_of_idr(tmp_path, image, mask):
    written = scene()
    layouts.write_idr(tmp_path, written)
    named_anew(tmp_path, "image", image)
    named_anew(tmp_path, "mask", mask)
    alpha = load_photos(tmp_path).alpha.numpy()
    assert np.array_equal(alpha, written.pictures[written.split("train"), ..., 3])


def test_pictures_of_idr_that_are_not_there(tmp_path):
    """Those that are there are known by their numbers."""
    written = scene()
    layouts.write_idr(tmp_path, written)
    for place in ("image", "mask"):
        named_anew(tmp_path, place, "{:03d}.png")
        (tmp_path / place / "004.png").unlink()
    photos = load_photos(tmp_path)
    assert photos.names == ["001", "002", "003", "005", "006", "007", "008"]
    assert "1 of 10 listed images were left out" in photos.about
    wanted = written.poses[[1, 2, 3, 5, 6, 7, 8], :3, 3]
    np.testing.assert_allclose(photos.cameras.camera_to_world[:, :, 3], wanted, atol=1e-5)


def test_images_of_neilf_that_were_not_placed(tmp_path):
    """And names as the README has them: a list, in image_list."""

    def change(root):
        root["image_list"] = {"file_paths": list(root.pop("image_path")["file_paths"].values())}
        images = root["camera_track_map"]["images"]
        images["3"].update(flg=1)
        images.pop("5")

    layouts.write_neilf(tmp_path, scene())
    edited("inputs/sfm_scene.json", change)(tmp_path)
    without("inputs/images/p_002.png")(tmp_path)
    photos = load_photos(tmp_path)
    assert photos.names == ["p_001", "p_004", "p_006", "p_007", "p_008", "p_009"]
    assert "are missing, 2 photographs left out because they have no camera" in photos.about


def test_views_and_lights_of_tensoir(tmp_path):
    """Those of the training views are meant; NeRFactor's have no light in their names."""
    data = layouts.write_tensoir(tmp_path, scene())

    def named(name):
        for path in data.glob("*/rgba_[sn]*.png"):
            path.rename(path.with_name(name))

    assert load_photos(data).names == [f"train_{i:03d}" for i in range(8)]
    assert load_photos(data, "test").names == ["test_000", "test_001"]
    for view in range(2):  # relit test views
        path = data / f"test_{view:03d}" / "rgba_city.png"
        path.write_bytes((data / "train_000/rgba_sunset.png").read_bytes())
    assert "(rgba_sunset.png)" in load_photos(data, "test").about
    named("rgba_night.png")  # the only one of the training views
    assert "(rgba_night.png)" in load_photos(data, "test").about
    named("rgba.png")
    assert "(rgba.png)" in load_photos(data).about
    with pytest.raises(DataError, match=r"expected val_000/metadata\.json and so on, found none"):
        load_photos(data, "val")


# Programs of photogrammetry, and phones

xml = partial(replaced, "cameras.xml")
TERMS = {"k1": 0.03, "k2": -0.02, "k3": 0.01, "k4": 0.05, "p1": 0.004, "p2": -0.007}
OFFSETS = {"cx": 0.75, "cy": -0.5, "b1": 0.4}


def calibration(**terms):
    return "".join(f"<{key}>{value}</{key}>" for key, value in terms.items())


def check_lens(lens, centre, focal):
    """x' = x (1 + K1 r2 + ..) + P1 (r2 + 2 x2) + 2 P2 x y, as both manuals say."""
    u, v = lens.seen(x := np.array([0.3, -0.2]), y := np.array([0.1, 0.25]))
    rr = x * x + y * y
    radial = 1 + 0.03 * rr - 0.02 * rr**2 + 0.01 * rr**3 + 0.05 * rr**4
    bent_x = x * radial + 0.004 * (rr + 2 * x * x) - 2 * 0.007 * x * y
    bent_y = y * radial - 0.007 * (rr + 2 * y * y) + 2 * 0.004 * x * y
    np.testing.assert_allclose(u, centre[0] + bent_x * focal[0], rtol=1e-12)
    np.testing.assert_allclose(v, centre[1] + bent_y * focal[1], rtol=1e-12)


def test_lenses_of_metashape(tmp_path):
    """u = w / 2 + cx + x' f + x' B1."""
    text = calibration(**TERMS, **OFFSETS)
    path = layouts.write_metashape(tmp_path / "a", scene(), text) / "cameras.xml"
    sensor = photogrammetry._chunk(path).find("sensors/sensor")
    lens = photogrammetry._sensor_lens(sensor, "here")
    check_lens(lens, (WIDTH / 2 + 0.75, HEIGHT / 2 - 0.5), (FOCAL + 0.4, FOCAL))
    photos = load_photos(layouts.write_metashape(tmp_path / "b", scene(), calibration(k1=0.01)))
    assert "lens distortion removed" in photos.about


def test_lenses_of_realitycapture(tmp_path):
    """px and py in longer sides; t1 along x, as OpenCV's p2."""
    lens = "0.05,-0.025,0.03,-0.02,0.01,0.05,0.004,-0.007"
    path = layouts.write_realitycapture(tmp_path, scene(), lens=lens) / "cameras.csv"
    _, row = photogrammetry._rows(path)[0]
    found = photogrammetry._row_lens(row, tmp_path / "images" / "p_000.png", "here")
    check_lens(found, (6 + 12 * 0.05, 4 - 12 * 0.025), (FOCAL, FOCAL))


def test_the_largest_component_is_read_and_what_is_enabled(tmp_path):
    layouts.write_metashape(tmp_path, scene())
    other = ((f'component_id="{n}" label="p_00{v}"' for n in (0, 1)) for v in (1, 5))
    xml(*map(tuple, other), ('label="p_003"', 'label="p_003" enabled="0"'))(tmp_path)
    photos = load_photos(tmp_path)
    assert photos.names == ["p_002", "p_004", "p_006", "p_007", "p_008", "p_009"]
    assert "4 of 11 cameras left out: not placed, not enabled or in another" in photos.about
    xml(('label="not_placed"', 'label="right" master_id="0"'))(tmp_path)
    assert "; 1 belong to a rig" in load_photos(tmp_path).about


def test_a_chunk_without_components(tmp_path):
    """Its own transform leads to the world then."""
    written = scene()
    layouts.write_metashape(tmp_path, written)
    gone = ('<components><component id="0">', "</component></components>", ' component_id="0"')
    xml(*((piece, "") for piece in gone))(tmp_path)
    found = load_photos(tmp_path).cameras.camera_to_world[:, :, 3]
    wanted = written.poses[written.split("train"), :3, 3]
    np.testing.assert_allclose(found, wanted, atol=1e-5)


NEWER = "#name,x,y,alt,yaw,pitch,roll,f_35mm,px_norm,py_norm,k1,k2,k3,k4,t1,t2"
SHORT = "#name,x,y,alt,heading,pitch,roll,f"


@pytest.mark.parametrize(
    ("head", "lens"), [(NEWER, ",".join("0" * 8)), (SHORT, ""), (f"#cameras 10\n{SHORT}", "")]
)
def test_columns_of_realitycapture(tmp_path, head, lens):
    photos = load_photos(layouts.write_realitycapture(tmp_path, scene(), head, lens))
    assert len(photos) == 8
    assert photos.cameras.focal.unique().tolist() == pytest.approx([FOCAL])
    assert photos.cameras.centre[0].tolist() == [6, 4]


def test_pictures_that_are_not_there_and_names_with_folders(tmp_path):
    layouts.write_realitycapture(tmp_path, scene())
    without("images/p_001.png")(tmp_path)
    replaced("cameras.csv", ("p_002.png", r"D:\shots\p_002.tif"))(tmp_path)
    photos = load_photos(tmp_path)
    assert photos.names[0] == "p_002"
    assert "1 of 10 listed images were left out" in photos.about


@pytest.mark.parametrize("place", ["keyframes/corrected_", "keyframes/", "corrected_"])
def test_places_of_polycam(tmp_path, place):
    assert len(load_photos(layouts.write_polycam(tmp_path, scene(), place))) == 8


def test_cameras_of_polycam(tmp_path):
    """What loops were closed in comes before the cameras as they were tracked; one is of larger
    pictures."""
    layouts.write_polycam(tmp_path, scene())
    (tmp_path / "keyframes/cameras").mkdir()
    (tmp_path / "keyframes/cameras/p_001.json").write_text("{}")
    larger = {"width": 48, "height": 32, "fx": 4 * FOCAL, "fy": 4 * FOCAL, "cx": 24, "cy": 16}
    edited("keyframes/corrected_cameras/p_003.json", lambda c: c.update(larger))(tmp_path)
    cameras = load_photos(tmp_path).cameras
    assert len(cameras) == 8
    assert cameras.focal.unique().tolist() == [FOCAL]
    assert cameras.centre.unique(dim=0).tolist() == [[6, 4]]
