"""A clear error in one line for each way to break a data set, in every layout."""

import math
import struct
from functools import partial

import layouts
import numpy as np
import pytest
from layouts import HEIGHT, WIDTH, refused, renamed, repainted, rewritten, scene, without
from PIL import Image

from univoxel.data.images import write_exr, write_png
from univoxel.data.transforms import RIGID_TOLERANCE

GIANT = 10**400  # float() raises OverflowError
# Text that no JSON is, and what is said of it
NO_JSON = [
    (b"{", "invalid JSON in line 1, column 2"),
    (b"\xff\xfe{}", "expected text in UTF-8"),
    (b"[" * 100_000, "nested too deeply"),
    (b'{"a":' * 100_000, "nested too deeply"),
    (b'{"a": ' + b"1" * 5000 + b"}", "an integer has too many digits"),
]


def all_pictures(place, change):
    """Another alpha for all photographs of a folder."""

    def apply(folder):
        for path in (folder / place).iterdir():
            picture = np.array(Image.open(path))
            write_png(path, change(picture))

    return apply


def alpha(value):
    return all_pictures("train", lambda p: np.dstack([p[..., :3], np.full_like(p[..., 3], value)]))


def white(channels):
    """A photograph without alpha."""
    return repainted("train/p_002.png", np.ones((HEIGHT, WIDTH, channels), np.uint8).squeeze())


# transforms_<split>.json and transforms.json, which are read alike

NERF = "transforms_train.json"
edit = partial(layouts.edited, NERF)


def root(**values):
    return edit(lambda r: r.update(values))


def frame(**values):
    return edit(lambda r: r["frames"][1].update(values))


def matrix(change):
    """An edit of the first frame's matrix."""

    def apply(first):
        found = change(np.array(first["transform_matrix"]))
        first["transform_matrix"] = found.tolist() if isinstance(found, np.ndarray) else found

    return edit(lambda r: apply(r["frames"][0]))


def moved(place):
    return edit(lambda r: r["frames"][0]["transform_matrix"][0].__setitem__(3, place))


def without_angle(**values):
    return edit(lambda r: [r.pop("camera_angle_x"), r.update(values)])


def mixed(folder):
    (folder / "train/p_002.png").unlink()
    plane = np.ones((HEIGHT, WIDTH), np.float32)
    write_exr(folder / "train/p_002.exr", dict.fromkeys("RGBA", plane))


def small_mask(folder):
    write_png(folder / "train/p_002.png", np.ones((HEIGHT, WIDTH, 3), np.uint8))
    write_png(folder / "train/p_002_mask.png", np.zeros((2, 2), np.uint8))


SHEAR = np.eye(4) + 0.1 * np.eye(4, k=1) * [1, 1, 0, 0]
OF_NERF = [
    (
        without(NERF),
        r"expected photographs .*, got .*test\.json\. If .* \(looked for transforms_train\.json, ",
    ),
    (rewritten(NERF, b"[1, 2]"), r"expected a JSON object, got \[1, 2\]"),
    *((rewritten(NERF, text), message) for text, message in NO_JSON),
    (root(frames=[]), r"expected a list of frames, got \[\]"),
    (root(frames={"a": 1}), "expected a list of frames, got {'a': 1}"),
    (root(frames=["r_0"]), "frame 0: expected a JSON object, got 'r_0'"),
    (frame(file_path=None), "frame 1: expected text in file_path"),
    (frame(file_path="a\0b"), "frame 1: expected text in file_path"),
    (
        without(*(f"train/p_00{v}.png" for v in range(1, 6))),
        r"train\.json: missing images: .*train/p_001, .* \(5 of 8\).*for the endings none, \.png",
    ),
    (frame(file_path="./train/p_001.png"), "frame 1: the name p_001 .* occurs twice"),
    (frame(k4=0.1), "frame 1: expected only distortion terms k1 k2 k3 p1 p2, got k4"),
    (frame(k2="no"), "frame 1: expected k2 between -inf and inf, got 'no'"),
    (root(k1=GIANT), "frame 0: expected k1 between -inf and inf, got 1000"),
    (root(p1=1e30), "frame 0: expected distortion coefficients of magn"),
    (root(k1=20.0), "frame 0: removing lens distortion would leave"),
    (root(k1=-10.0, k2=30.0), "frame 0: the lens distortion folds the"),
    (root(is_fisheye=True), "frame 0: expected one of the camera models .* a fisheye"),
    (frame(camera_model="EQUIRECTANGULAR"), "models .* got 'EQUIRECTANGULAR'"),
    (root(w=60, h=30), r"images of 60x30 pixels \(w and h\), got 12x8"),
    (alpha(0), "all 8 images are fully transparent"),
    (alpha(255), "all 8 images are fully opaque: cut out the object"),
    (white(3), r"p_002\.png: expected an alpha channel or a mask p_002_mask\.png"),
    (white(1), r"p_002\.png: expected an image with 3 or 4 channels, got 1"),
    (small_mask, r"p_002_mask\.png: expected 12x8 pixels, got 2x2"),
    (mixed, "the same format as p_001"),
    (matrix(lambda m: None), "frame 0: expected a finite 4x4 transform_matrix, got None"),
    (matrix(lambda m: m[:2]), "frame 0: expected a finite 4x4"),
    (matrix(lambda m: [[1.0], [1.0, 2.0]]), "frame 0: expected a finite 4x4"),
    (matrix(lambda m: m * np.nan), "frame 0: expected a finite 4x4"),
    (moved(GIANT), "frame 0: expected a finite 4x4"),
    (moved(1e308), r"frame 0: expected matrix values up to 1e\+09, got 1e\+308"),
    (matrix(lambda m: m * [0, 1, 1, 1]), "frame 0: expected rotation .* scale of 1, 1, -?0"),
    (matrix(lambda m: m * [2, 2, 2, 1]), "rotation .* scale of 2, 2, 2"),
    (matrix(lambda m: m @ SHEAR), "frame 0: expected rotation"),
    (matrix(lambda m: m * [1 + 2 * RIGID_TOLERANCE, 1, 1, 1]), "frame 0: expected rotation"),
    (matrix(lambda m: m * [-1, 1, 1, 1]), "frame 0: expected a rotation .* reflection"),
    (matrix(lambda m: m.T), "frame 0: transform_matrix must end with 0 0 0 1"),
    (without_angle(), "frame 0: expected camera_angle_x between 0 and 3.142, got nothing"),
    (root(camera_angle_x=40.0), "camera_angle_x between 0 and 3.142, got 40.0"),
    (root(camera_angle_x=math.nan), "camera_angle_x .* got nan"),
    (root(camera_angle_x=True), "camera_angle_x .* got True"),
    (root(camera_angle_x=1e-320), "frame 0: expected focal lengths"),
    (root(camera_angle_x=3.14159265), "frame 0: expected focal lengths"),
    (root(fl_x=-5.0), "expected fl_x between 0 and inf, got -5.0"),
    (root(fl_x=GIANT), "frame 0: expected fl_x between 0 and inf, got 1000"),
    (root(fl_x=1e-320), "frame 0: expected focal lengths from 0.006 to 1.2e"),
    (root(fl_x=1e39), "frame 0: expected focal lengths from 0.006 to 1.2e"),
    (root(fl_x=5.0, fl_y=0.0), "expected fl_y between 0 and inf, got 0.0"),
    (root(cx=1000.0), "expected cx between -12 and 24, got 1000.0"),
    (root(cy=-1000.0), "expected cy between -8 and 16, got -1000.0"),
]


# What transforms.json may have beyond them

JSON = "transforms.json"
edit_test = partial(layouts.edited, JSON)


def of_file(**values):
    return edit_test(lambda r: r.update(values))


def of_mask(path):
    return edit_test(lambda r: r["frames"][1].update(mask_path=path))


def other_size(folder):
    edit_test(lambda r: [r.pop("w"), r.pop("h")])(folder)
    write_png(folder / "images" / "p_008.png", np.ones((HEIGHT, 9, 3), np.uint8))


def two_fit(folder):
    for path in list((folder / "images").iterdir()):
        path.rename(path.with_name(path.name.replace("p_", "P_")))
        (path.with_name(path.name.replace(".png", ".pNg"))).write_bytes(b"")


OF_NERFSTUDIO = [
    (of_mask("masks/none.png"), r"frame 1: the mask .*masks/none\.png .*\(mask_path\)"),
    (of_mask(7), "frame 1: the mask .*/7"),
    (of_mask("a\0b"), "frame 1: the mask"),
    (of_file(test_filenames="p_000"), "expected a list of file_paths as test_filenames"),
    (of_file(test_filenames=[]), "to list only frames of this file, got an empty list"),
    (of_file(test_filenames=["x/y.png"]), "expected test_filenames to list only .*, got y"),
    (of_file(k5=0.1), "expected only distortion terms k1 k2 k3 p1 p2, got k5"),
    (other_size, r"masks/p_008\.png: expected 9x8 pixels, got 12x8"),
    (two_fit, r"images/p_009\.png, got .*P_009\.png and .*p_009\.pNg: rename"),
    (layouts.replaced(JSON, ("images/p", "/a/../images/p")), "10 of 10"),
    (renamed("images", "images_2"), "images_2 exists: rename it to images, so that cameras are"),
]


# COLMAP's models

cameras, images = (
    partial(layouts.replaced, f"sparse/0/{name}.txt") for name in ("cameras", "images")
)
NO_MODEL = "this file of a COLMAP model"


def painted(width, height):
    return repainted("images/p_004.png", np.ones((height, width, 3), np.uint8))


def text_of_images(text):
    return rewritten("sparse/0/images.txt", text)


FULL = ("SIMPLE_PINHOLE 12 8 11.0 6.0 4.0", f"FULL_OPENCV 12 8 9 9 9 9{' 0.1' * 8}")
OF_COLMAP = [
    (cameras(("SIMPLE_PINHOLE", "OPENCV_FISHEYE")), "got OPENCV_FISHEYE for camera 3: run"),
    (cameras(FULL), "got FULL_OPENCV with k4, k5 or k6 for camera 3: run"),
    (cameras(("SIMPLE_PINHOLE", "PINHOLE")), "camera 3: 3 parameters do not fit model PINHOLE"),
    (cameras(("11.0", "wide")), rf"cameras\.txt: {NO_MODEL}.* 'wide'"),
    (cameras(("11.0", "-11.0")), r"expected focal lengths from 0\.006 to .* pixels .*, got -11"),
    *(
        (cameras(("11.0", number)), r"cameras\.txt: .*(focal lengths|parameters \[inf)")
        for number in ("9" * 400, "1e-320", "1e39")
    ),
    (cameras((" 12 ", f" {GIANT} ")), rf"cameras\.txt: {NO_MODEL}"),
    (images((" 3 p_004", " 9 p_004")), r"images\.txt: p_004\.png refers to missing camera 9"),
    (images((" 3 p_004.png", "")), rf"images\.txt: {NO_MODEL}"),
    (text_of_images(b"# none\n"), r"images\.txt: expected photographs w"),
    (text_of_images(b"1 0 0 0 0 1 2 3 3 p_000.png\n"), r"txt: .* the pose of p_000\.png is"),
    (
        without(*(f"images/p_00{v}.png" for v in range(1, 9))),
        r"images\.txt: missing images: p_008\.png, .* \(8 of 10\)",
    ),
    (renamed("images", "photos"), r"missing images: p_009.* \(10 of 10\).*looked in .*images and "),
    (painted(13, 8), r"p_004\.png: expected 12x8 pixels, the size of .*, got 13x8"),
    (painted(12, 9), r"p_004\.png: expected 12x8 pixels, the size of .*, got 12x9"),
]


def cut(name, keep):
    def apply(folder):
        path = folder / "sparse/0" / name
        path.write_bytes(path.read_bytes()[:keep])

    return apply


def far(folder):
    path = folder / "sparse/0/images.bin"
    data = bytearray(path.read_bytes())
    struct.pack_into("<d", data, 8 + 4 + 32, 1e300)
    path.write_bytes(data)


def numbered(model):
    data = struct.pack("<Q", 1) + struct.pack("<iiQQ", 3, model, WIDTH, HEIGHT) + bytes(80)
    return rewritten("sparse/0/cameras.bin", data)


OF_COLMAP_BINARY = [
    (cut("cameras.bin", 30), rf"cameras\.bin: {NO_MODEL}"),
    (cut("cameras.bin", 0), rf"cameras\.bin: {NO_MODEL}"),
    (cut("images.bin", 76), rf"images\.bin: {NO_MODEL}"),  # in a name
    (cut("images.bin", -3), rf"images\.bin: {NO_MODEL}"),  # in points
    (far, r"images\.bin: .* the pose of p_009\.png is"),
    (numbered(7), "got FOV for camera 3: run colmap"),
    (numbered(99), "got model 99 for camera 3: run colmap"),
]


# Layouts of research


def rows(change):
    """What makes other rows of those of LLFF, written again."""

    def apply(folder):
        path = folder / "poses_bounds.npy"
        np.save(path, change(np.load(path)), allow_pickle=True)

    return apply


def one(row, column, new):
    def apply(found):
        found[row, column] = new(found[row, column])
        return found

    return rows(apply)


POSES = "poses_bounds.npy"
OF_LLFF = [
    (rewritten(POSES, b"no array"), f"{POSES}: this NumPy array could not be read"),
    (rows(lambda _: np.array({"a": 1})), "npy: this NumPy array could not be read"),
    (rows(lambda r: r[:, :15]), r"npy: expected rows of 17 numbers, got shape \(10, 15\)"),
    (rows(lambda r: r.astype(str)), r"npy: expected rows of numbers, got 10 rows of <U"),
    (rows(lambda r: r[1:]), "expected a row for each of 10 photographs in .*images, got 9"),
    (one(2, 14, lambda _: 0), "row 2: expected height, width and focal length above 0, got"),
    (one(3, 4, lambda x: 2 * x), r"p_003.png: expected the aspect ratio 12x16 of its"),
    (one(1, 0, lambda x: x + 0.5), "row 1: expected rotation and translation"),
    (
        without(*(f"images/p_00{v}.png" for v in range(10))),
        f"{POSES}: expected images in .*images, images_2, images_4 or similar",
    ),
]


def arrays(change):
    """A change of the matrices of IDR by their names."""

    def apply(folder):
        with np.load(folder / SPHERE) as file:
            found = dict(file)
        change(found)
        np.savez(folder / SPHERE, **found)

    return apply


def world_mat_2(change):
    return arrays(lambda a: a.update(world_mat_2=change(a["world_mat_2"])))


def leaning(found):
    """Pixels sheared by 2 in 8 rows."""
    shear = np.eye(4)
    shear[0, 1] = 0.25
    found["world_mat_3"] = shear @ found["world_mat_3"]


SPHERE = "cameras_sphere.npz"
OF_IDR = [
    (rewritten(SPHERE, b"no archive"), f"{SPHERE}: this npz file could not be read"),
    (arrays(dict.clear), f"{SPHERE}: expected arrays world_mat_0, .* got none"),
    (world_mat_2(lambda m: m[:3, :3]), "npz: expected a 4x4 matrix"),
    (world_mat_2(lambda m: m.astype("<U1")), "arrays of numbers, but world_mat_2 is of type <U1"),
    (world_mat_2(lambda m: m * np.nan), "npz: world_mat_2 contains NaN or infinity"),
    (world_mat_2(np.ones_like), "world_mat_2: expected an invertible projection matrix, got a"),
    (arrays(leaning), "world_mat_3: .* rows shifted by up to 1 pixels"),
    (
        world_mat_2(lambda m: np.diag([50.0, 1, 1, 1]) @ m),
        "_2: expected cx between -12 and 24",
    ),
    (arrays(lambda a: a.pop("world_mat_9")), "expected a matrix world_mat for each of 10"),
    (renamed("image", "photos"), "npz: expected images in .*image, f"),
    (
        repainted("mask/p_003.png", np.ones((4, 4), np.uint8)),
        "3.png: expected 12x8 pixels, got",
    ),
]

SFM = "inputs/sfm_scene.json"
sfm = partial(layouts.edited, SFM)


def image(change):
    return sfm(lambda r: change(r["camera_track_map"]["images"]["3"]))


def unplaced(root):
    for found in root["camera_track_map"]["images"].values():
        found.update(flg=0)


def camera(**values):
    return image(lambda i: i["camera"].update(values))


OF_NEILF = [
    (rewritten(SFM, b"{"), "sfm_scene.json: invalid JSON in line 1"),
    (rewritten(SFM, b"[1]"), "sfm_scene.json: expected JSON with image_path.file_paths and"),
    (rewritten(SFM, b"{}"), r"sfm_scene.json: expected JSON with .* KeyError\('image_list'\)"),
    (sfm(lambda r: r["camera_track_map"].update(images=[])), "json: expected .*no images"),
    (sfm(unplaced), "sfm_scene.json: expected images with cameras"),
    (image(lambda i: i.pop("camera")), r"image 3: expected size \[w, h\] and a camera with"),
    (image(lambda i: i.update(size=[12])), r"image 3: expected size \[w, h\] and a camera"),
    (image(lambda i: i.update(size=[-12, 8])), "image 3: expected w between 0 and inf, got -1"),
    (image(lambda i: i.update(size=[12, 12])), r"p_003.png: expected the aspect ratio"),
    (camera(extrinsic=[1.0] * 15), "image 3: .* 16 numbers"),
    (camera(extrinsic=(2 * np.eye(4)).ravel().tolist()), "image 3: transform_matrix must end"),
    (camera(intrinsic={"focal": [-1.0, 2.0], "ppt": [6, 4]}), "3: expected fl_x .* got -1.0"),
    (renamed("inputs/images", "photos"), "json: missing images: p_000"),
]

META = "train_001/metadata.json"


def meta(**values):
    return layouts.edited(META, lambda r: r.update(values))


def two_lights(folder):
    renamed("train_000/rgba_sunset.png", "train_000/rgba_a.png")(folder)
    (folder / "train_000/rgba_b.png").touch()


OF_TENSOIR = [
    *((rewritten(META, text), message) for text, message in NO_JSON),
    (meta(cam_transform_mat="1,2,3"), "expected 16 numbers in cam_transform_mat, got '1,2,3'"),
    (meta(cam_transform_mat="a,b"), "expected JSON with cam_transform_mat, numbers"),
    (meta(cam_transform_mat=[1.0]), "expected JSON with cam_transform_mat, numbers"),
    (meta(cam_angle_x=40), "expected cam_angle_x between 0 and 3.142, got 40"),
    (meta(imw=13), r"metadata\.json: expected images of 13x8 pixels .*, got 12x8"),
    (
        without(*(f"train_00{v}/rgba_sunset.png" for v in range(5))),
        r"missing images: .*train_000/rgba_sunset\.png, .* \(5 of 8\)",
    ),
    (two_lights, r"train_000: expected rgba\.png, .* got rgba_a\.png, rgba_b\.png"),
]


# What programs of photogrammetry and phones export

xml = partial(layouts.replaced, "cameras.xml")
ENTITY, FIRST = '<!DOCTYPE d [<!ENTITY a "b">]>', 'label="p_000"><transform>'
SENSOR = '<sensor id="3" label="unknown" type="frame">'
OF_METASHAPE = [
    (xml(("</chunk>", "")), "cameras.xml: this XML could not be read: mismatched tag"),
    (xml(("<document", f"{ENTITY}<document")), "expected Metashape XML, got XML with a DOCTYPE"),
    (xml(("<chunk", "<x><chunk"), ("</chunk>", "</chunk></x>")), "expected one chunk, got 0"),
    (xml(("transform>", "other>")), "xml: none of the 11 cameras is both"),
    (xml((SENSOR, '<sensor id="4">')), "camera p_000: this sensor is not listed"),
    (xml((SENSOR, '<sensor id="3" type="fisheye">')), "expected a sensor of type frame"),
    (xml(("calibration", "other")), "camera p_000: expected a calibration, found none"),
    (xml(("<f>11.0</f>", "")), "camera p_000: expected a number for f, got nothing"),
    (xml(("<f>11.0", "<f>wide")), "camera p_000: expected a number for f, got 'wide'"),
    (xml(("<f>11.0", "<f>-11.0")), "camera p_000: expected fl_x between 0 and inf"),
    (xml(("<f>11.0", "<p3>.1</p3><f>11.0")), "expected distortion terms k1 to k4"),
    (xml(("<f>11.0", "<b2>2</b2><f>11.0")), "p_000: expected perpendicular rows"),
    (xml(('width="12"', 'width="0"')), "camera p_000: expected a resolution above 0,"),
    (xml(('width="12"', "")), "camera p_000: expected a number for width, got nothing"),
    (xml(('width="12"', 'width="9"')), r"p_000.png: expected the aspect ratio 9x8"),
    (xml(("<scale>2.5", "<scale>-2.5")), "transform of component 0: expected a scale"),
    (xml(("<scale>2.5", "<scale>2.5 1")), "transform of component 0: expected 1 numbers"),
    (xml(("<rotation>", "<rotation>1 ")), "transform of component 0: expected 9 numbers"),
    (xml((FIRST, f"{FIRST}1 ")), "camera p_000: expected 16 numbers as transform"),
    (renamed("images", "photos"), "cameras.xml: missing images: p_000"),
]


def value(index, new):
    """A change of one value of p_003, in the fifth line."""

    def apply(folder):
        lines = (folder / "cameras.csv").read_text().splitlines()
        values = lines[4].split(",")
        values[index] = new
        lines[4] = ",".join(values)
        (folder / "cameras.csv").write_text("\n".join(lines))

    return apply


HEAD = b"#name,x,y,alt,heading,pitch,roll,f\n"
OF_REALITYCAPTURE = [
    (value(4, "north"), "line 5: expected a number for heading, got 'north'"),
    (value(1, ""), "line 5: expected a number for x, got ''"),
    (value(3, "nan"), "line 5: expected a number for alt, got 'nan'"),
    (value(7, "0"), "line 5: expected fl_x between 0 and inf, got 0.0"),
    (value(8, "3"), "line 5: expected cx between -12 and 24, got 42.0"),
    (value(12, "far"), "line 5: expected a number for k3, got 'far'"),
    (value(10, "0,0"), "line 5: expected 16 values, got 17"),
    (rewritten("cameras.csv", HEAD), "cameras.csv: expected a line for each camera, got none"),
    (rewritten("cameras.csv", HEAD + b"\xff"), "cameras.csv: expected text in UTF-8"),
    (renamed("images", "photos"), "cameras.csv: missing images: p_000.png,"),
]

CAMERA = "keyframes/corrected_cameras/p_003.json"


def polycam(**values):
    return layouts.edited(CAMERA, lambda camera: camera.update(values))


OF_POLYCAM = [
    (polycam(fx=0), "p_003.json: expected fl_x between 0 and inf, got 0"),
    (polycam(cy=None), "p_003.json: expected cy between -inf and inf, got nothing"),
    (polycam(width="12"), "p_003.json: expected width between 0 and inf, got '12'"),
    (polycam(t_12=None), "p_003.json: expected t_12 between -inf and inf, got nothing"),
    (polycam(t_00=9.0), "p_003.json: expected rotation and translation"),
    (polycam(width=10), "p_003.png: expected the aspect ratio 10x8 of .*, got 12x8"),
    (rewritten(CAMERA, b"[]"), r"p_003.json: expected a JSON object, got \[\]"),
    (rewritten(CAMERA, b"{"), "p_003.json: invalid JSON in line 1"),
    (
        renamed("keyframes/corrected_images", "keyframes/images"),
        "corrected_cameras: missing images: p_000, p_001, .*looked in .*corrected_images; the "
        "images in .*keyframes/images belong to .* in .*/cameras",
    ),
]

BROKEN = {
    "nerf": OF_NERF,
    "nerfstudio": OF_NERFSTUDIO,
    "colmap": OF_COLMAP,
    "colmap binary": OF_COLMAP_BINARY,
    "llff": OF_LLFF,
    "idr": OF_IDR,
    "neilf": OF_NEILF,
    "tensoir": OF_TENSOIR,
    "metashape": OF_METASHAPE,
    "realitycapture": OF_REALITYCAPTURE,
    "polycam": OF_POLYCAM,
}


@pytest.mark.parametrize(
    ("layout", "damage", "message"),
    [(layout, *case) for layout, cases in BROKEN.items() for case in cases],
)
def test_one_line_for_what_is_broken(tmp_path, layout, damage, message):
    options = {"text": True} if layout == "colmap" else {}
    folder = getattr(layouts, f"write_{layout.split()[0]}")(tmp_path, scene(), **options)
    refused(folder, damage, message, "test" if layout == "nerfstudio" else "train")
