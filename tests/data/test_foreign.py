"""Lists of photographs as other programs write them, and pictures that are not there."""

import json
import logging
import re
import unicodedata

import layouts
import numpy as np
import pytest
import torch
from layouts import FOCAL, HEIGHT, WIDTH, scene, write_colmap, write_nerf, write_nerfstudio
from PIL import Image
from scipy.spatial.transform import Rotation

from univoxel.data import load_cameras, load_photos
from univoxel.data.transforms import view_names
from univoxel.errors import DataError


def text(file, *changes, encoding="utf-8"):
    """A change of a file: each pattern by what stands in its place."""

    def apply(folder):
        before = (folder / file).read_text()
        after = before
        for pattern, new in changes:
            after = re.sub(pattern, new, after)
        assert after != before or not changes
        (folder / file).write_bytes(after.encode(encoding))

    return apply


def smaller(folder):
    """Pictures shrunk after the cameras were found: of blocks of one colour."""
    for path in [*(folder / "images").iterdir(), *(folder / "masks").iterdir()]:
        picture = Image.open(path)
        picture.resize((2 * picture.width, 2 * picture.height), Image.Resampling.NEAREST).save(path)
    file = folder / "transforms.json"
    if file.exists():
        root = json.loads(file.read_text())
        root |= {key: 2 * root[key] for key in ("w", "h", "cx", "cy", "fl_x", "fl_y")}
        file.write_text(json.dumps(root))
    else:
        lens = f"{2 * WIDTH} {2 * HEIGHT} {2 * FOCAL} {WIDTH} {HEIGHT}"
        text("sparse/0/cameras.txt", ("12 8 .*", lens))(folder)
    for path in [*(folder / "images").iterdir(), *(folder / "masks").iterdir()]:
        picture = Image.open(path)
        picture.resize((picture.width // 2, picture.height // 2), Image.Resampling.BOX).save(path)


def in_capitals(folder):
    for path in (folder / "images").iterdir():
        path.rename(path.with_name(path.name.upper()))


def groups(folder):
    """Two groups of cameras with the same labels, pictures in folders of the groups' names."""
    for part in ("images", "masks"):
        for v in range(10):
            old = next((folder / part).glob(f"p_00{v}*"))
            new = old.parent / "ab"[v // 5] / old.name.replace(f"p_00{v}", f"p_00{v % 5}")
            new.parent.mkdir(exist_ok=True)
            old.rename(new)
    cameras = re.findall("<camera id.*?</camera>", (folder / "cameras.xml").read_text())
    named = [re.sub("p_00.", f"p_00{v % 5}", camera) for v, camera in enumerate(cameras)]
    inner = "".join(
        f'<group label="{name}">{"".join(named[i : i + 5])}</group>'
        for name, i in (("a", 0), ("b", 5))
    )
    text("cameras.xml", ("(?s)<cameras>.*</cameras>", f"<cameras>{inner}</cameras>"))(folder)


def unpadded(name):
    def apply(folder):
        for place in ("image", "mask"):
            for path in sorted((folder / place).iterdir(), reverse=True):
                path.rename(path.with_name(name.format(int(path.stem[-3:]) + 5)))

    return apply


def with_accents(folder):
    """Listed as most programs write them; in files, as Macs do."""
    for path in (folder / "images").iterdir():
        path.rename(path.with_name(unicodedata.normalize("NFD", f"\u00e9{path.name}")))
    listed = folder / "transforms.json"
    if not listed.exists():
        listed = folder / "sparse/0/images.txt"
    text(listed.relative_to(folder), ("(images/| )p_", "\\1\u00e9p_"))(folder)
    for path in (folder / "masks").iterdir():
        path.rename(path.with_name(f"\u00e9{path.name}"))
    if listed.suffix == ".json":
        text("transforms.json", ("masks/", "masks/\u00e9"))(folder)


def more_pictures(folder):
    rows = np.load(folder / "poses_bounds.npy")
    names = sorted(path.name for path in (folder / "images").iterdir())
    (folder / "view_imgs.txt").write_text("\n".join(names) + "\n")
    Image.new("RGB", (WIDTH, HEIGHT)).save(folder / "images" / "o_000.png")
    assert len(rows) == len(names)


OF_NERFSTUDIO = {
    "backslashes": text("transforms.json", ("images/", r"images\\\\\\\\")),
    "backslashes and a dot": text("transforms.json", ("(images|masks)/", r".\\\\\\\\\1\\\\\\\\")),
    "of another machine": text("transforms.json", ('"images/', '"/home/a/b/images/')),
    "of Windows": text("transforms.json", ('"images/', r'"C:\\\\\\\\a\\\\\\\\images\\\\\\\\')),
    "of Windows, with slashes": text("transforms.json", ('"images/', '"D:/a/images/')),
    "capitals": in_capitals,
    "null": text("transforms.json", ('"k1": 0.0', '"k1": null, "is_fisheye": null')),
    "numbers as text": text("transforms.json", (r'"(w|h|fl_x|cx|k1)": ([\d.]+)', r'"\1": "\2"')),
    "sizes with a point": text("transforms.json", (r'"(w|h)": (\d+)', r'"\1": \2.0')),
    "accents": with_accents,
    "smaller": smaller,
}
OF_COLMAP = {
    "backslashes": text("sparse/0/images.txt", (" p_", r" .\\p_")),
    "capitals": in_capitals,
    "accents": with_accents,
    "a mark and CR LF": text("sparse/0/cameras.txt", ("^", "\ufeff"), ("\n", "\r\n")),
    "FULL_OPENCV": text(
        "sparse/0/cameras.txt",
        ("SIMPLE_PINHOLE 12 8 11.0", "FULL_OPENCV 12 8 11 11"),
        (r"(FULL_OPENCV .*)\n", r"\1 0 0 0 0 0 0 0 0\n"),
    ),
    "smaller": smaller,
}
SPLITS = ("train", "test")


def views(photos):
    """Alpha and camera of each view, by its colours: a list may number them otherwise."""
    cameras = photos.cameras
    for view in range(len(photos)):
        color, alpha = photos.stored(view)
        camera = (getattr(cameras, k)[view] for k in ("camera_to_world", "focal", "centre"))
        yield color.numpy().tobytes(), [alpha, *camera]


SEMICOLONS = ((r"\.", "!"), (",", ";"), ("!", ","), (",png", ".png"))
CASES = [
    *(("nerfstudio", name, change) for name, change in OF_NERFSTUDIO.items()),
    *(("colmap", name, change) for name, change in OF_COLMAP.items()),
    ("realitycapture", "semicolons", text("cameras.csv", *SEMICOLONS)),
    ("realitycapture", "tabs in UTF-16", text("cameras.csv", (",", "\t"), encoding="utf-16")),
    ("metashape", "groups", groups),
    ("idr", "unpadded", unpadded("{}.png")),
    ("idr", "unpadded with a word", unpadded("view_{}_a.png")),
    ("llff", "more pictures than rows", more_pictures),
]


@pytest.mark.parametrize(("layout", "name", "change"), CASES, ids=[c[1] for c in CASES])
def test_lists_are_read_as_they_were_meant(tmp_path, layout, name, change):
    options = {"text": True} if layout == "colmap" else {}
    plain, data = (
        getattr(layouts, f"write_{layout}")(tmp_path / place, scene(10), **options)
        for place in ("plain", "data")
    )
    change(data)
    found, wanted = (
        {color: view for split in SPLITS for color, view in views(load_photos(folder, split))}
        for folder in (data, plain)
    )
    assert len(found) == len(wanted) == 10
    for color, (alpha, *camera) in found.items():
        assert torch.equal(alpha, wanted[color][0])
        torch.testing.assert_close(camera, wanted[color][1:], atol=1e-5, rtol=1e-5)
    about = load_photos(data).about
    assert ("10 cameras scaled to match smaller images" in about) == (name == "smaller")


def test_pictures_of_one_name_in_two_folders(tmp_path):
    data = write_nerfstudio(tmp_path, scene(10))
    for v in range(10):
        for part in ("images", "masks"):
            old = data / part / f"p_00{v}.png"
            new = data / part / f"cam{v % 2}" / f"{v // 2}.png"
            new.parent.mkdir(exist_ok=True)
            old.rename(new)
    moved = [(f"p_00{v}", f"cam{v % 2}/{v // 2}") for v in range(10)]
    chosen = [("^{", '{"test_filenames": ["images/cam1/2.png"],'), (', "mask_path": "[^"]*"', "")]
    text("transforms.json", *moved, *chosen)(data)
    photos = load_photos(data, "test")
    assert photos.names == ["cam1_2"]
    assert np.array_equal(photos.alpha[0], scene(10).pictures[5, ..., 3])
    assert load_cameras(data / "transforms.json", 8)[0] == [
        f"cam{v % 2}_{v // 2}" for v in reversed(range(10))
    ]
    assert view_names(["a/0.png", "b/1.png"]) == ["0", "1"]


@pytest.mark.parametrize("layout", ["nerfstudio", "llff", "colmap", "metashape", "realitycapture"])
def test_coordinates_of_the_earth(tmp_path, layout):
    """Distances between cameras stay as exact as float32 has them, in every layout."""
    written = scene()
    far = scene()
    far.poses[:, :3, :3] = Rotation.from_matrix(far.poses[:, :3, :3]).as_matrix()
    far.poses[:, :3, 3] += (391234.5, 5.82e6, 34.0)
    photos = load_photos(getattr(layouts, f"write_{layout}")(tmp_path, far))
    assert re.search(r"world moved by -39123\d -5820000 -3\d", photos.about)
    place = photos.cameras.camera_to_world[:, :, 3]
    wanted = torch.from_numpy(written.poses[written.split("train"), :3, 3]).float()
    torch.testing.assert_close(torch.cdist(place, place), torch.cdist(wanted, wanted))


def test_splits_of_a_far_world_are_moved_as_one(tmp_path):
    """In the layout of NeRF, too, whose splits are files of their own; one view tells nothing."""
    written = scene()
    written.poses[:, :3, :3] = Rotation.from_matrix(written.poses[:, :3, :3]).as_matrix()
    plain = {s: load_photos(write_nerf(tmp_path / f"a{s}", written), s) for s in SPLITS}
    written.poses[:, 0, 3] += 5.82e6
    data = write_nerf(tmp_path / "data", written)
    for split in SPLITS:
        photos = load_photos(data, split)
        assert "world moved by -5819999 0 -1" in photos.about
        shift = (photos.cameras.camera_to_world - plain[split].cameras.camera_to_world)[:, :, 3]
        torch.testing.assert_close(shift, shift.round(), atol=1e-5, rtol=0)
        assert photos.moved is not None


def test_what_is_odd_is_told(tmp_path, caplog):
    """One photograph; a lens of larger pictures, where no size says so: cx and cy would be those of
    a corner."""
    load_photos(write_nerfstudio(tmp_path / "one", scene(2), test_filenames=["images/p_000.png"]))
    assert "one photograph is not enough for a shape: at least 3" in caplog.text
    data = write_nerfstudio(tmp_path / "data", scene())
    load_photos(data)
    assert "beyond the border" not in caplog.text
    text("transforms.json", ('"w": 12, ', ""), ('"h": 8, ', ""))(data)
    text("transforms.json", (r'"cx": [\d.]+', '"cx": 12.0'), (r'"cy": [\d.]+', '"cy": 8.0'))(data)
    load_photos(data)
    assert "cx and cy are near or beyond the border of the 12x8 images" in caplog.text


# Pictures that are listed and not there are left out and counted, as long as enough remain


def places(writer, v):
    """The picture of view v in a layout."""
    split = "test" if v % 8 == 0 else "train"
    return f"{split if writer is write_nerf else 'images'}/p_00{v}.png"


@pytest.mark.parametrize("writer", [write_colmap, write_nerf, write_nerfstudio])
def test_pictures_that_are_not_there_are_left_out(tmp_path, writer, caplog):
    data = writer(tmp_path, scene())
    assert "left out" not in load_photos(data).about
    assert not caplog.messages
    lost = (2, 5, 6)
    for v in lost:
        (data / places(writer, v)).unlink()
    with caplog.at_level(logging.WARNING, "univoxel"):
        photos = load_photos(data)
    listed = 8 if writer is write_nerf else 10  # which has a file for each split
    assert f"3 of {listed} listed images were left out" in photos.about
    assert all(f"p_00{v}" in caplog.messages[0] for v in lost)
    assert caplog.messages[0].endswith(f"(3 of {listed} left out)")
    if writer is write_nerf:
        assert photos.names == ["p_001", "p_003", "p_004", "p_007", "p_009"]
        return
    # Every eighth of those that are there
    assert photos.names == ["p_001", "p_003", "p_004", "p_007", "p_008", "p_009"]
    assert load_photos(data, "test").names == ["p_000"]


@pytest.mark.parametrize(("views", "lost", "enough"), [(3, 1, 0), (4, 1, 1), (8, 4, 1), (8, 5, 0)])
def test_how_many_must_remain(tmp_path, views, lost, enough):
    data = write_colmap(tmp_path, scene(views))
    for v in range(lost):
        (data / "images" / f"p_00{v}.png").unlink()
    if enough:
        assert f"{lost} of {views} listed" in load_photos(data).about
        return
    with pytest.raises(DataError, match=rf"images.bin: missing .*\({lost} of {views}\)"):
        load_photos(data)


def test_splits_that_name_what_is_not_there(tmp_path):
    names = {"train_filenames": ["images/p_001.png", "images/p_002.png"]}
    data = write_nerfstudio(tmp_path, scene(), **names, test_filenames=["images/p_003.png"])
    (data / "images" / "p_002.png").unlink()
    assert load_photos(data).names == ["p_001"]
    (data / "images" / "p_003.png").unlink()
    with pytest.raises(DataError, match="frames in test_filenames, found 0 of 1"):
        load_photos(data, "test")


@pytest.mark.parametrize("named", ["p_00{}", "p_00{}.jpg", "p_00{}.HEIC", "p_00{}.PNG"])
@pytest.mark.parametrize("writer", [write_colmap, write_nerfstudio])
def test_names_without_their_ending_or_with_another(tmp_path, writer, named):
    """Photographs are converted after cameras were found; instant-ngp lists them without .png."""
    data = writer(tmp_path, scene(), **({"text": True} if writer is write_colmap else {}))
    file = data / ("sparse/0/images.txt" if writer is write_colmap else "transforms.json")
    text = file.read_text()
    for v in range(10):
        old = f"images/p_00{v}.png" if writer is write_nerfstudio else f"p_00{v}.png"
        text = text.replace(old, old[: -len(f"p_00{v}.png")] + named.format(v))
    file.write_text(text)
    assert load_photos(data).names == [f"p_00{v}" for v in (1, 2, 3, 4, 5, 6, 7, 9)]


def test_a_dot_in_a_name_is_no_ending(tmp_path):
    data = write_nerfstudio(tmp_path, scene())
    root = json.loads((data / "transforms.json").read_text())
    for k in (0, 1):  # p_009 and p_008
        root["frames"][k]["file_path"] = f"images/p_0.{k}"
    (data / "images" / "p_0.png").write_bytes((data / "images" / "p_001.png").read_bytes())
    (data / "transforms.json").write_text(json.dumps(root))
    assert "2 of 10 listed images were left out" in load_photos(data).about
