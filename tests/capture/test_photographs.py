"""Photographs of every format, upright, and what their files say."""

import struct

import numpy as np
import pillow_heif
import pytest
from PIL import Image, ImageCms

from univoxel.capture import photographs as module
from univoxel.capture import prepare
from univoxel.capture.photographs import describe, find_photographs, read_upright, require_readers
from univoxel.capture.prepare import Folders, gather, read_mask, write_pictures
from univoxel.errors import DataError, MissingExtra

ORIENTATION, MODEL, FOCAL_35MM, EXIF_WIDTH, EXIF_HEIGHT = 0x112, 0x110, 0xA405, 0xA002, 0xA003


def quarters(width=64, height=48) -> Image.Image:
    """Red, green; blue, white: from the top left, by rows."""
    picture = np.zeros((height, width, 3), np.uint8)
    picture[: height // 2, : width // 2] = 255, 0, 0
    picture[: height // 2, width // 2 :] = 0, 255, 0
    picture[height // 2 :, : width // 2] = 0, 0, 255
    picture[height // 2 :, width // 2 :] = 255, 255, 255
    return Image.fromarray(picture)


def corners(picture: Image.Image) -> list[str]:
    names = {(1, 0, 0): "r", (0, 1, 0): "g", (0, 0, 1): "b", (1, 1, 1): "w"}
    array = np.asarray(picture.convert("RGB")) > 127
    h, w = array.shape[:2]
    points = [(r * h // 4, c * w // 4) for r in (1, 3) for c in (1, 3)]
    return [names.get(tuple(array[p].astype(int).tolist()), "?") for p in points]


def test_all_eight_turns_come_upright(tmp_path):
    """As they are stored for each orientation, by EXIF's table of where row 0 and column 0 are."""
    upright = quarters()
    T = Image.Transpose
    stored = {
        1: upright,
        2: upright.transpose(T.FLIP_LEFT_RIGHT),
        3: upright.transpose(T.ROTATE_180),
        4: upright.transpose(T.FLIP_TOP_BOTTOM),
        5: upright.transpose(T.TRANSPOSE),
        6: upright.transpose(T.ROTATE_90),  # row 0 is the right side
        7: upright.transpose(T.TRANSVERSE),
        8: upright.transpose(T.ROTATE_270),
    }
    for orientation, picture in stored.items():
        exif = Image.Exif()
        exif[ORIENTATION] = orientation
        for path in (tmp_path / f"{orientation}.jpg", tmp_path / f"{orientation}.png"):
            picture.save(path, exif=exif)
            found = describe(path)
            assert (found.width, found.height, found.turned) == (64, 48, orientation)
            for longest, size in ((0, (64, 48)), (32, (32, 24))):
                read = read_upright(path, longest)
                assert read.size == size
                assert corners(read) == ["r", "g", "b", "w"], orientation


def test_heic_is_not_turned_twice(tmp_path):
    exif = Image.Exif()
    exif[ORIENTATION], exif[MODEL] = 6, "Phone"
    path = tmp_path / "a.heic"
    turned = quarters().transpose(Image.Transpose.ROTATE_90)
    pillow_heif.from_pillow(turned).save(path, quality=95, exif=exif.tobytes())
    for name in ("a.heic", "a.jpg"):  # also under another name
        path = path.rename(tmp_path / name)
        found = describe(path)
        assert (found.width, found.height, found.camera) == (64, 48, "Phone")
        assert corners(read_upright(path)) == ["r", "g", "b", "w"]


MODES = {
    "a.tif": ("RGB", "L", "RGBA", "CMYK", "P"),
    "a.webp": ("RGB", "RGBA"),
    "a.png": ("RGB", "L", "RGBA", "P", "1"),
    "a.jpeg": ("RGB", "L", "CMYK"),
}


@pytest.mark.parametrize(
    ("name", "mode"), [(n, mode) for n, modes in MODES.items() for mode in modes]
)
def test_formats_and_modes(tmp_path, name, mode):
    path, picture = tmp_path / name, quarters().convert(mode)
    if mode == "RGBA":
        picture.putalpha(Image.linear_gradient("L").resize((64, 48)))
    picture.save(path)
    read = read_upright(path)
    assert read.size == (64, 48)
    assert read.mode == ("RGBA" if mode == "RGBA" else "RGB")
    if mode not in ("L", "1"):
        assert corners(read) == ["r", "g", "b", "w"]
    array = np.linspace(0, 65535, 64 * 48).reshape(48, 64).astype(np.uint16)
    Image.fromarray(array).save(tmp_path / "grey.png")  # of 16 bits
    found = np.asarray(read_upright(tmp_path / "grey.png"))[..., 0]
    np.testing.assert_allclose(found, array / 257, atol=1)


def test_colours_of_another_space_become_srgb(tmp_path):
    """A space whose red is sRGB's green, and the other way round."""
    srgb = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    swapped = srgb.replace(b"rXYZ", b"keep").replace(b"gXYZ", b"rXYZ").replace(b"keep", b"gXYZ")
    for name in ("sRGB", "sRGB".encode("utf-16-be").decode("latin-1")):
        swapped = swapped.replace(name.encode("latin-1"), name.replace("s", "x").encode("latin-1"))
    for profile, expected in (
        (srgb, ["r", "g", "b", "w"]),
        (swapped, ["g", "r", "b", "w"]),
        (b"no profile", ["r", "g", "b", "w"]),
    ):
        quarters().save(tmp_path / "a.png", icc_profile=profile)
        read = read_upright(tmp_path / "a.png")
        assert corners(read) == expected
        assert "icc_profile" not in read.info  # it would be written again


def test_a_focal_length_is_believed_only_of_whole_files(tmp_path):
    path, whole = tmp_path / "a.jpg", pytest.approx(28 / 36 * 360)  # 28 mm before 36 mm
    for size, stated, prior in (
        ((360, 240), (360, 240), whole),
        ((240, 240), (360, 240), None),
        ((360, 240), (240, 360), whole),
        ((360, 240), None, None),
    ):
        exif = Image.Exif()
        if stated:
            tags = {FOCAL_35MM: 28, EXIF_WIDTH: stated[0], EXIF_HEIGHT: stated[1]}
            exif.get_ifd(0x8769).update(tags)
        Image.new("RGB", size).save(path, exif=exif)
        assert describe(path).prior == prior


def test_raw_is_developed_upright(tmp_path):
    """A DNG by hand: a ramp of light, stored lying; RAW programs differ in the borders."""
    path = tmp_path / "a.dng"
    write_dng(path, 320, 200, orientation=6)
    found = describe(path)
    assert (found.width, found.height) == (200, 320)
    read = np.asarray(read_upright(path)).astype(float)
    assert read.shape[:2] == (320, 200)
    rows = read[20:-20, 20:-20].mean((1, 2))
    assert (np.diff(rows) > -1).all()  # stored from left to right, upright from top to bottom
    assert rows[-1] > rows[0] + 50
    half = read_upright(path, 100)
    assert half.size == (62, 100)


def write_dng(path, width, height, orientation):
    """The least of a DNG: one uncompressed plane of 16 bits behind red, green, green, blue."""
    plane = np.tile(np.linspace(1000, 40000, width), (height, 1)).astype("<u2")
    matrix = (3.2406, -1.5372, -0.4986, -0.9689, 1.8758, 0.0415, 0.0557, -0.2040, 1.0570)
    fractions = [x for value in matrix for x in (round(value * 10000), 10000)]
    shorts = [(258, 16), (259, 1), (262, 32803), (274, orientation), (277, 1), (284, 1)]
    longs = [(254, 0), (256, width), (257, height), (273, None), (278, height)]
    longs += [(279, plane.nbytes), (50717, 65535)]
    tags = [  # number, type (1 byte, 2 text, 3 short, 4 long, 5 ratio, 10 signed ratio), values
        *((number, 3, [value]) for number, value in [*shorts, (50778, 21)]),
        *((number, 4, [value]) for number, value in longs),
        *((271, 2, b"Made\0"), (272, 2, b"By hand\0"), (50708, 2, b"Made by hand\0")),
        *((33421, 3, [2, 2]), (33422, 1, [0, 1, 1, 2]), (50706, 1, [1, 4, 0, 0])),
        *((50721, 10, fractions), (50728, 5, [1, 1, 1, 1, 1, 1])),
    ]
    tags.sort(key=lambda tag: tag[0])
    forms = {1: "B", 3: "H", 4: "I", 5: "I", 10: "i"}
    begin = 8 + 2 + 12 * len(tags) + 4
    extra, entries = b"", b""
    packed = []
    for number, kind, values in tags:
        if kind == 2:
            packed.append((number, kind, len(values), values))
            continue
        data = struct.pack(f"<{len(values)}{forms[kind]}", *(v or 0 for v in values))
        packed.append((number, kind, len(values) // (2 if kind in (5, 10) else 1), data))
    size = sum(len(data) + len(data) % 2 for *_, data in packed if len(data) > 4)
    for number, kind, count, data in packed:
        if number == 273:
            data = struct.pack("<I", begin + size)
        if len(data) > 4:
            place = struct.pack("<I", begin + len(extra))
            extra += data + b"\0" * (len(data) % 2)
            data = place
        entries += struct.pack("<HHI", number, kind, count) + data.ljust(4, b"\0")
    header = b"II*\0" + struct.pack("<IH", 8, len(tags)) + entries + bytes(4)
    path.write_bytes(header + extra + plane.tobytes())


def test_the_photographs_of_a_folder(tmp_path, monkeypatch):
    for name in ("b.JPG", "a.png", "a.dng", "b.heic", "c.webp", "notes.txt", ".hidden.jpg"):
        (tmp_path / name).write_bytes(b"")
    (tmp_path / "folder.jpg").mkdir()
    found, others, doubles = find_photographs(tmp_path)
    assert [p.name for p in found] == ["a.png", "b.JPG", "c.webp"]
    assert others == ["notes.txt"]
    assert doubles == 2
    (tmp_path / "outer").mkdir()
    with pytest.raises(DataError, match="expected photographs"):
        find_photographs(tmp_path / "outer")
    (tmp_path / "outer/images").mkdir()
    (tmp_path / "outer/images/a.jpg").write_bytes(b"")
    assert len(find_photographs(tmp_path / "outer")[0]) == 1
    monkeypatch.setattr(module.importlib.util, "find_spec", lambda name: None)
    require_readers([tmp_path / "a.jpg"])
    for name, said in (
        ("a.HEIC", r"a.HEIC: reading HEIC needs pillow-heif: pip install"),
        ("a.nef", r"a.nef: reading RAW needs rawpy"),
    ):
        with pytest.raises(MissingExtra, match=said):
            require_readers([tmp_path / name])


def test_where_photographs_lie(tmp_path):
    """A preview beside a folder of them is none, nor are masks; of a card the folders are told."""
    for name in ("preview", "images/a", "images/b", "images/c", "images/a_mask"):
        (tmp_path / "x" / name).parent.mkdir(parents=True, exist_ok=True)
        quarters().save(tmp_path / "x" / f"{name}.jpg")
    files, others, _ = find_photographs(tmp_path / "x")
    assert [path.name for path in files] == ["a.jpg", "b.jpg", "c.jpg"]
    assert others == ["a_mask.jpg"]
    (tmp_path / "x/images").rename(tmp_path / "x/DCIM")
    assert len(find_photographs(tmp_path / "x")[0]) == 1
    (tmp_path / "x/preview.jpg").unlink()
    with pytest.raises(DataError, match="got none, but DCIM has some: pass that folder"):
        find_photographs(tmp_path / "x")


@pytest.mark.parametrize("suffix", [".jpg", ".heic", ".dng"])
def test_broken_files_are_one_line(tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    path.write_bytes(b"no picture at all" * 100)
    with pytest.raises(DataError, match=f"a{suffix}: this photograph could not be read"):
        describe(path)
    with pytest.raises(DataError, match=f"a{suffix}: this photograph could not be read"):
        read_upright(path)


def test_a_cut_off_photograph_is_told_when_it_is_read(tmp_path):
    noise = np.random.default_rng(0).integers(0, 256, (48, 64, 3), np.uint8)
    for name in "ab":
        Image.fromarray(noise).save(tmp_path / f"{name}.jpg")
    data = (tmp_path / "b.jpg").read_bytes()
    (tmp_path / "b.jpg").write_bytes(data[: len(data) // 2])
    capture, unread = gather(sorted(tmp_path.glob("*.jpg")), None)
    assert unread == []
    found = dict(write_pictures(capture, Folders(tmp_path / "work"), 32))
    assert found[0] is None
    assert "b.jpg: this photograph could not be read" in str(found[1])
    assert [p.name for p in (tmp_path / "work/pictures/0").iterdir()] == ["00000.jpg"]


def test_masks_are_grown_turned_and_of_the_pictures_size(tmp_path, monkeypatch):
    monkeypatch.setattr(prepare, "MASK_MARGIN", 0.03)
    (tmp_path / "masks").mkdir()
    exif = Image.Exif()
    exif[ORIENTATION] = 6
    quarters(100, 60).save(tmp_path / "a.jpg")
    quarters(100, 60).save(tmp_path / "b.jpg", exif=exif)  # portrait
    for name, size in (("a", (50, 30)), ("b.jpg", (100, 60))):
        mask = np.zeros(size[::-1], np.uint8)
        mask[: size[1] // 2] = 255  # the upper half of what is stored
        Image.fromarray(mask).save(tmp_path / "masks" / f"{name}.png")
    capture, _ = gather(sorted(tmp_path.glob("*.jpg")), tmp_path / "masks")
    assert capture.groups == [[0, 1]]
    folders = Folders(tmp_path / "work")
    assert not any(why for _, why in write_pictures(capture, folders, 100))
    with Image.open(folders.masks / "0/00000.jpg.png") as mask:
        a = np.asarray(mask) > 0
    assert a.shape == (60, 100)
    # Half of it, and 3 % of the longer side; the edge of an enlarged mask is soft by a pixel
    assert a[:, 50].sum() == pytest.approx(30 + 3, abs=1)
    upright = np.asarray(read_mask(capture, 1)) > 127
    assert upright.shape == (100, 60)
    assert upright[:, 30:].all()  # row 0 of what is stored is the right side
    assert not upright[:, :30].any()
    with Image.open(folders.masks / "0/00001.jpg.png") as mask:
        assert mask.size == (100, 60)


def test_masks_that_do_not_fit_are_refused(tmp_path):
    (tmp_path / "masks").mkdir()
    for name in "ab":
        quarters().save(tmp_path / f"{name}.jpg")
    files = sorted(tmp_path.glob("*.jpg"))
    Image.new("L", (64, 48)).save(tmp_path / "masks/a.png")
    with pytest.raises(DataError, match=r"each of 2 photographs, got none for 1: b.jpg"):
        gather(files, tmp_path / "masks")
    Image.new("L", (64, 40)).save(tmp_path / "masks/b_mask.png")
    capture, _ = gather(files, tmp_path / "masks")
    with pytest.raises(DataError, match=r"b_mask.png: expected 64x48 pixels, got 64x40"):
        read_mask(capture, 1)
    with pytest.raises(DataError, match="none: expected a folder of masks"):
        gather(files, tmp_path / "none")
    with pytest.raises(DataError, match="at least two readable photographs, got 1"):
        gather(files[:1], None)


def test_only_formats_of_photographs_are_opened(tmp_path, monkeypatch):
    """Pillow goes by what a file holds, and starts Ghostscript for PostScript."""
    path = tmp_path / "a.jpg"
    quarters().save(path, format="EPS")
    assert path.read_bytes().startswith(b"%!PS")

    def started(*_, **__):
        raise AssertionError("a program was started")

    monkeypatch.setattr("subprocess.Popen", started)
    for read in (describe, read_upright):
        with pytest.raises(DataError, match=r"a\.jpg: this photograph could not be read"):
            read(path)
