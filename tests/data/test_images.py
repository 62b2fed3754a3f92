"""Reading and writing pictures: exact values, broken files, writes that are whole or not at all."""

import errno
import os
import struct
import zlib
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import OpenEXR
import pytest
import torch
from PIL import ExifTags, Image, ImageCms

from univoxel.core.files import replacing
from univoxel.data import images
from univoxel.data.load_images import read_photo
from univoxel.envmap import read_map
from univoxel.errors import DataError


def noise(*shape, dtype=np.float32):
    return np.random.default_rng(0).random(shape).astype(dtype)


# PNG and JPEG


def test_numbers_of_png(tmp_path):
    """Floats are rounded and clipped, 16 bits are not cut, palettes become colours and alpha."""
    images.write_png(tmp_path / "a.png", np.array([[-1.0, 0.2, 0.5, 2.0]]))
    assert images.read_image(tmp_path / "a.png").flatten().tolist() == [0, 51, 128, 255]
    Image.fromarray(np.array([[0, 257, 32768, 65535]], np.uint16)).save(tmp_path / "a.png")
    back = images.read_image(tmp_path / "a.png")
    torch.testing.assert_close(back[0, :, 0], torch.tensor([0, 257, 32768, 65535]) / 65535)
    image = Image.new("P", (2, 1))
    image.putpalette([255, 0, 0, 0, 0, 255])
    image.putdata([0, 1])
    image.save(tmp_path / "a.png", transparency=1)
    assert images.read_image(tmp_path / "a.png").tolist() == [[[255, 0, 0, 255], [0, 0, 255, 0]]]


@pytest.mark.parametrize("shape", [(5, 7), (5, 7, 3), (5, 7, 4)])
def test_png_bytes_survive_a_round_trip(tmp_path, shape):
    image = (255 * noise(*shape)).astype(np.uint8)
    images.write_png(tmp_path / "a.png", torch.from_numpy(image))
    back = images.read_image(tmp_path / "a.png")
    assert back.dtype == torch.uint8
    assert np.array_equal(back.numpy().reshape(shape), image)
    assert back.shape == (5, 7, shape[2] if len(shape) == 3 else 1)


def swapped_profile() -> bytes:
    """That of sRGB, under another name and with red and green exchanged."""
    data = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    data = data.replace("sRGB".encode("utf-16-be"), "else".encode("utf-16-be"))
    return data.replace(b"rXYZ", b"----").replace(b"gXYZ", b"rXYZ").replace(b"----", b"gXYZ")


@pytest.mark.parametrize("name", ["a.png", "a.jpg", "a.tif", "a.webp"])
def test_colours_of_a_profile(tmp_path, name):
    """They become sRGB where that is asked: masks and measures are no colours."""
    picture = Image.new("RGBA" if name in ("a.png", "a.webp") else "RGB", (2, 2), (250, 10, 20))
    options = {"quality": 100} | ({"lossless": True} if name == "a.webp" else {})
    picture.save(tmp_path / name, icc_profile=swapped_profile(), **options)
    stored, seen = (images.read_image(tmp_path / name, s)[0, 0, :3].tolist() for s in (False, True))
    assert stored == pytest.approx([250, 10, 20], abs=3)
    assert seen == pytest.approx([10, 250, 20], abs=6)
    assert read_photo(tmp_path / name, masks=False)[0][0, 0].tolist() == seen
    for profile in (b"none", ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()):
        picture.save(tmp_path / name, icc_profile=profile, **options)
        assert images.read_image(tmp_path / name, in_srgb=True)[0, 0, 0] == pytest.approx(
            250, abs=3
        )


def linear_profile() -> bytes:
    """Primaries of sRGB, and no curve: called sRGB all the same."""
    data = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    start = data.index(b"para", 128)  # of all three channels: gamma 1 in place of the curve
    return data[:start] + b"curv" + bytes(4 + 4) + data[start + 12 :]


def chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


P3_CHROMATICITIES = (31270, 32900, 68000, 32000, 26500, 69000, 15000, 6000)
# Of (250, 10, 20) stated in each way
STATED = {
    "linear": ([chunk(b"gAMA", struct.pack(">I", 100000))], (253, 55, 79)),
    "gamma": ([chunk(b"gAMA", struct.pack(">I", 45455))], (250, 10, 20)),
    "sRGB": ([chunk(b"sRGB", b"\0"), chunk(b"gAMA", struct.pack(">I", 100000))], (250, 10, 20)),
    "P3": ([chunk(b"cHRM", struct.pack(">8I", *P3_CHROMATICITIES))], (255, 0, 0)),
    "coded P3": ([chunk(b"cICP", bytes([12, 13, 0, 1]))], (255, 0, 0)),
    "coded sRGB": ([chunk(b"cICP", bytes([1, 13, 0, 1]))], (250, 10, 20)),
}


def stating(path, *chunks):
    """A picture that says so of its colours."""
    Image.new("RGBA", (2, 2), (250, 10, 20, 77)).save(path)
    data = path.read_bytes()
    path.write_bytes(data[:33] + b"".join(chunks) + data[33:])


def test_what_a_png_states_is_refused_or_not_believed(tmp_path):
    """HDR; the name of a profile."""
    stating(tmp_path / "a.png", chunk(b"cICP", bytes([9, 18, 0, 1])))
    with pytest.raises(DataError, match=r"a\.png: expected sRGB colours, got HLG \(HDR\)"):
        images.read_image(tmp_path / "a.png", in_srgb=True)
    Image.new("RGB", (2, 2), (250, 10, 20)).save(tmp_path / "a.png", icc_profile=linear_profile())
    seen = images.read_image(tmp_path / "a.png", in_srgb=True)[0, 0].tolist()
    assert seen == pytest.approx([253, 55, 79], abs=2)


@pytest.mark.parametrize("how", STATED)
def test_colours_that_a_png_states(tmp_path, how):
    said, expected = STATED[how]
    stating(tmp_path / "a.png", *said)
    assert images.read_image(tmp_path / "a.png")[0, 0].tolist() == [250, 10, 20, 77]
    seen = images.read_image(tmp_path / "a.png", in_srgb=True)[0, 0].tolist()
    assert seen == pytest.approx([*expected, 77], abs=2)


def test_adobe_rgb_that_a_camera_states(tmp_path):
    """In EXIF alone, as cameras do: DCF's index R03."""
    light = np.array([0.5, 0.2, 0.1])  # linear Adobe RGB (1998), and the same in Rec. 709
    turned = light @ np.array([[1.3982, -0.3982, 0], [0, 1, 0], [0, -0.0429, 1.0429]]).T
    code = np.round(255 * light ** (256 / 563)).astype(np.uint8)
    expected = 255 * (1.055 * turned ** (1 / 2.4) - 0.055)
    for index, wanted in (("R03", expected), ("R98", code)):
        exif = Image.Exif()
        exif[ExifTags.IFD.Exif] = {0xA001: 65535, ExifTags.IFD.Interop: {1: index}}
        picture = Image.new("RGB", (16, 16), tuple(code.tolist()))
        picture.save(tmp_path / "a.jpg", quality=100, subsampling=0, exif=exif)
        seen = images.read_image(tmp_path / "a.jpg", in_srgb=True)[0, 0]
        assert seen.tolist() == pytest.approx(wanted.tolist(), abs=2)


def test_primaries_that_are_none_change_nothing():
    rgb = np.array([[0.5, 0.4, 0.3]], np.float32)
    for wrong in ((0.3, 0.3) * 4, (0.0,) * 8, (np.nan,) * 8, (0.3, 0.4, 0.5)):
        assert images.in_rec709(rgb, wrong) is rgb


def test_other_kinds_under_the_name_of_jpeg(tmp_path):
    path = tmp_path / "a.jpg"
    for kind in ("WEBP", "TIFF", "PNG"):
        Image.new("RGB", (5, 3), (9, 8, 7)).save(path, format=kind, lossless=True)
        assert images.read_image(path)[0, 0].tolist() == [9, 8, 7]
        assert images.image_size(path) == (5, 3)
    path.write_bytes(b"\0\0\0\x18ftypheic" + bytes(40))
    for read in (images.read_image, images.image_size):
        with pytest.raises(DataError, match=r"a\.jpg: .*but the file is HEIC or AVIF: convert"):
            read(path)
    Image.fromarray(np.zeros((3, 5), np.float32)).save(tmp_path / "a.tif")
    with pytest.raises(DataError, match="expected 8 or 16 bits per channel, got 32"):
        images.read_image(tmp_path / "a.tif")
    (tmp_path / "a.tif").write_bytes(b"II*\0" + bytes(40))
    with pytest.raises(DataError, match=r"this TIFF could not be read: .*: convert it to"):
        images.read_image(tmp_path / "a.tif")


# OpenEXR


def test_half_exr_survives_a_round_trip(tmp_path):
    channels = {name: noise(6, 9, dtype=np.float16) for name in ("R", "rgb.G", "depth")}
    images.write_exr(tmp_path / "a.exr", channels)
    back = images.read_exr(tmp_path / "a.exr")
    assert back.keys() == channels.keys()
    for name, value in channels.items():
        assert back[name].dtype == np.float32
        assert np.array_equal(back[name], value.astype(np.float32))


def test_numbers_of_exr(tmp_path):
    """Floats are exact, halves hold no infinity, and channels come in the order of their names."""
    path, value = tmp_path / "a.exr", torch.from_numpy(1e6 * noise(6, 9))
    images.write_exr(path, {"Y": value}, half=False)
    assert torch.equal(images.read_image(path)[..., 0], value)
    images.write_exr(path, {"Y": np.array([[1e6, -1e6, 1.0]])})
    assert images.read_exr(path)["Y"].tolist() == [[65504.0, -65504.0, 1.0]]
    channels = {name: np.full((2, 3), k) for k, name in enumerate("ABGR")}
    images.write_exr(path, channels | {"Z": np.zeros((2, 3))})
    assert images.read_image(path)[0, 0].tolist() == [3, 2, 1, 0]
    for bad in (np.nan, np.inf):
        value[2, 3] = bad
        images.write_exr(path, dict.fromkeys("RGB", value), half=False)
        with pytest.raises(DataError, match=r"a\.exr: NaN or infinity at row 2, column 3"):
            images.read_image(path)


def test_exr_without_colours_is_no_picture(tmp_path):
    images.write_exr(tmp_path / "a.exr", {"depth": np.zeros((2, 2))})
    with pytest.raises(DataError, match="expected channels R, G, B, or Y, got depth"):
        images.read_image(tmp_path / "a.exr")
    images.write_exr(tmp_path / "a.exr", {"R": np.zeros((2, 2)), "G": np.zeros((2, 2))})
    with pytest.raises(DataError, match="expected channels R, G, B, or Y, got G, R"):
        images.read_image(tmp_path / "a.exr")


@pytest.mark.parametrize("corner", [(0, 0), (2, 3), (-1, -2), (8, 6), (20, 0), (-9, 0)])
def test_cropped_exr(tmp_path, corner):
    """The picture is the display window: 0 beyond the data, and none of what is around it."""
    x, y = corner
    data = noise(4, 5)
    window = (np.array([1, 1], np.int32), np.array([10, 8], np.int32))
    within = (np.array([x, y], np.int32), np.array([x + 4, y + 3], np.int32))
    header = {"type": OpenEXR.scanlineimage, "displayWindow": window, "dataWindow": within}
    OpenEXR.File(header, {"Y": data}).write(str(tmp_path / "a.exr"))
    whole = np.zeros((40, 40), np.float32)  # of which pixel 0, 0 is at 10, 10
    whole[10 + y : 14 + y, 10 + x : 15 + x] = data
    assert np.array_equal(images.read_exr(tmp_path / "a.exr")["Y"], whole[11:19, 11:21])
    assert images.image_size(tmp_path / "a.exr") == (10, 8)


def test_an_exr_of_several_parts(tmp_path):
    """The one with colours is meant, and of two nobody knows which."""
    header = {"type": OpenEXR.scanlineimage}
    parts = [
        OpenEXR.Part({**header, "name": name}, {c: noise(4, 5) for c in channels})
        for name, channels in (("depth", "Z"), ("beauty", "RGB"), ("diffuse", "RGB"))
    ]
    OpenEXR.File(parts[:2]).write(str(tmp_path / "a.exr"))
    assert sorted(images.read_exr(tmp_path / "a.exr")) == ["B", "G", "R"]
    OpenEXR.File(parts).write(str(tmp_path / "a.exr"))
    with pytest.raises(DataError, match="got several parts with colours"):
        images.read_image(tmp_path / "a.exr")


DISPLAY_P3 = (0.68, 0.32, 0.265, 0.69, 0.15, 0.06, 0.3127, 0.329)
ACES_2065 = (0.7347, 0.2653, 0.0, 1.0, 0.0001, -0.077, 0.32168, 0.33767)
ACES_CG = (0.713, 0.293, 0.165, 0.83, 0.128, 0.044, 0.32168, 0.33767)


@pytest.mark.parametrize(
    ("stated", "red"),
    [
        # Colours as published with the spaces, white adapted as of Bradford
        (DISPLAY_P3, [1.22494, -0.04206, -0.01964]),
        (ACES_CG, [1.70505, -0.13026, -0.02400]),
        (ACES_2065, [2.52169, -0.27648, -0.01538]),  # whose blue has y below 0
        (images.REC_709, [1, 0, 0]),
        (images.OF_RADIANCE, [1, 0, 0]),
        ((0,) * 8, [1, 0, 0]),
    ],
)
def test_colours_of_stated_primaries(tmp_path, stated, red):
    """White stays white, and what only the wider space has is cut off."""
    rgb = np.array([[[0.5, 0.5, 0.5], [0.5, 0, 0]]], np.float32)
    channels = {c: np.ascontiguousarray(rgb[..., i]) for i, c in enumerate("RGB")}
    header = {"type": OpenEXR.scanlineimage, "chromaticities": stated}
    if any(stated):
        OpenEXR.File(header, channels).write(str(tmp_path / "a.exr"))
    body = bytes([128, 128, 128, 128, 128, 0, 0, 128])
    head = radiance(body, "-Y  1   +X 2 ")
    lines = f"PRIMARIES= {' '.join(map(str, stated))}\n".encode()
    (tmp_path / "a.hdr").write_bytes(head.replace(b"FORMAT", lines + b"FORMAT"))
    for path in tmp_path.iterdir():
        white, found = images.read_image(path)[0].tolist()
        assert white == pytest.approx([0.5] * 3, abs=1e-3)
        assert found == pytest.approx([max(x / 2, 0) for x in red], abs=1e-3)


def test_old_run_lengths(tmp_path):
    """1 1 1 N is the last pixel N times more; the next such counts N 256 times."""
    pixels = [(9, 8, 7, 130), (1, 1, 1, 44), (1, 1, 1, 1), (5, 4, 3, 129), (1, 1, 1, 2)]
    head = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 8 +X 38\n"
    (tmp_path / "a.hdr").write_bytes(head + bytes(np.ravel(pixels).tolist()))
    found = images.read_image(tmp_path / "a.hdr").reshape(-1, 3)
    assert (found[:301] == torch.tensor([9, 8, 7]) * 2.0**-6).all()
    assert (found[301:] == torch.tensor([5, 4, 3]) * 2.0**-7).all()
    for body in (pixels[:-1], pixels[1:], [*pixels, pixels[0]]):
        (tmp_path / "a.hdr").write_bytes(head + bytes(np.ravel(body).tolist()))
        with pytest.raises(DataError, match=r"a\.hdr: expected 38x8 .* 1216 uncompressed bytes"):
            images.read_image(tmp_path / "a.hdr")


def test_kinds_by_their_first_bytes(tmp_path):
    value = np.full((4, 8), 2.0)
    images.write_exr(tmp_path / "a.exr", dict.fromkeys("RGB", value))
    (tmp_path / "a.exr").rename(tmp_path / "a.hdr")
    images.write_radiance(tmp_path / "b.exr", np.full((4, 8, 3), 3.0))
    assert (read_map(tmp_path / "a.hdr").radiance == 2).all()
    assert (read_map(tmp_path / "b.exr").radiance == 3).all()
    assert images.image_size(tmp_path / "a.hdr") == (8, 4)


def test_a_sun_that_half_floats_do_not_hold(tmp_path, caplog):
    value = np.full((4, 8), 2.0, np.float32)
    value[1, 2], value[2, 2] = np.inf, 900
    channels = {c: value.astype(np.float16) for c in "RGB"}
    OpenEXR.File({"type": OpenEXR.scanlineimage}, channels).write(str(tmp_path / "a.exr"))
    assert read_map(tmp_path / "a.exr").radiance[1, 2].tolist() == [900] * 3
    assert "infinite radiance is replaced by 900" in caplog.text
    with pytest.raises(DataError, match="NaN or infinity at row 1, column 2"):
        images.read_image(tmp_path / "a.exr")
    for bad, said in (
        (np.nan, "NaN or infinity at row 1, column 2"),
        (-800.0, "expected finite radiance of at least 0"),
    ):
        value[1, 2] = bad
        images.write_exr(tmp_path / "a.exr", dict.fromkeys("RGB", value), half=False)
        with pytest.raises(DataError, match=said):
            read_map(tmp_path / "a.exr")
    value[1, 2] = -0.01  # filters leave texels slightly below 0
    images.write_exr(tmp_path / "a.exr", dict.fromkeys("RGB", value))
    assert float(read_map(tmp_path / "a.exr").radiance.min()) == 0
    Image.new("RGB", (8, 4)).save(tmp_path / "a.jpg")  # which says nothing of the sun
    said = r"a\.jpg: expected an environment map \(\.hdr or \.exr\), got an im"
    with pytest.raises(DataError, match=said):
        read_map(tmp_path / "a.jpg")


def test_the_largest_photographs(tmp_path, monkeypatch):
    """Pillow's own limit is below what telephones make; a bomb is refused all the same."""
    monkeypatch.setattr(images, "LARGEST", 40)
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 10)
    Image.new("RGB", (8, 5)).save(tmp_path / "a.png")
    assert images.read_image(tmp_path / "a.png").shape == (5, 8, 3)
    assert images.image_size(tmp_path / "a.png") == (8, 5)
    assert Image.MAX_IMAGE_PIXELS == 10
    Image.new("RGB", (9, 5)).save(tmp_path / "a.png")
    with pytest.raises(DataError, match="exceeds limit of 40 pixels"):
        images.read_image(tmp_path / "a.png")


# Radiance


def radiance(body, size="-Y 2 +X 8", form="32-bit_rle_rgbe"):
    return f"#?RADIANCE\n# a comment\nFORMAT={form}\n\n{size}\n".encode() + bytes(body)


def rgbe_value(r, g, b, e):
    return [m * 2.0 ** (e - 136) for m in (r, g, b)]


def test_flat_radiance_is_exact(tmp_path):
    g = np.random.default_rng(0)
    pixels = g.integers(0, 256, (2, 8, 4), dtype=np.uint8)
    pixels[..., 3] = g.integers(100, 160, (2, 8))
    pixels[1, 2] = (9, 9, 9, 0)  # exponent 0 is black
    (tmp_path / "a.hdr").write_bytes(radiance(pixels.tobytes()))
    image = images.read_image(tmp_path / "a.hdr")
    for row in range(2):
        for column in range(8):
            expected = rgbe_value(*map(int, pixels[row, column]))
            if (row, column) == (1, 2):
                expected = [0.0] * 3
            assert image[row, column].tolist() == expected


def test_written_radiance_decodes_by_hand(tmp_path):
    """Numbers of the format come back exactly; others within half a step; none overflows."""
    picture = np.zeros((2, 8, 3))
    picture[0, 0] = rgbe_value(255, 128, 1, 140)
    picture[0, 1] = rgbe_value(128, 0, 7, 1)
    picture[0, 2] = (1.0, 0.999, 0.998)  # 255.7 of 256 steps: rounds into the next exponent
    picture[0, 3] = (0.999, 0.5, 0.1)
    picture[0, 4] = (1e39, 1.0, 0.0)  # above the largest number
    picture[0, 5] = 1e-40  # below the smallest
    picture[1] = np.exp(np.random.default_rng(0).normal(0, 8, (8, 3)))
    images.write_radiance(tmp_path / "a.hdr", picture)
    body = (tmp_path / "a.hdr").read_bytes()[-64:]
    back = np.array([rgbe_value(*body[i : i + 4]) for i in range(0, 64, 4)]).reshape(2, 8, 3)
    assert np.array_equal(back[0, :2], picture[0, :2])
    assert back[0, 4].tolist() == [255 * 2.0**119, 0, 0]
    assert back[0, 5].tolist() == [0, 0, 0]
    fair = np.delete(np.arange(16), [4, 5])
    error = np.abs(back - picture).reshape(16, 3)[fair]
    assert (error <= picture.reshape(16, 3)[fair].max(1, keepdims=True) / 256).all()
    assert np.array_equal(images.read_image(tmp_path / "a.hdr").numpy(), back.astype(np.float32))


def test_run_lengths_are_decoded(tmp_path):
    head = [2, 2, 0, 8]
    red = [128 + 8, 200]  # one run
    green = [3, 10, 20, 30, 128 + 5, 40]  # literals, then a run
    blue = [8, 1, 2, 3, 4, 5, 6, 7, 8]
    exponent = [128 + 7, 136, 1, 137]
    row = head + red + green + blue + exponent
    (tmp_path / "a.hdr").write_bytes(radiance(row + row))
    image = images.read_image(tmp_path / "a.hdr")
    expected = [[200, g, b] for g, b in zip([10, 20, 30] + [40] * 5, range(1, 9), strict=True)]
    expected[-1] = [2 * v for v in expected[-1]]
    assert image.tolist() == [expected, expected]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"P6 8 2 255", r"expected a Radiance image .* got b'P6 8 2 2'"),
        (b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n", "expected a header and pixels"),
        (radiance(bytes(64), form="32-bit_rle_xyze"), "expected FORMAT=32-bit_rle_rgbe, got"),
        (radiance(bytes(64), size="+Y 2 +X 8"), r"expected the size .* got b'\+Y 2"),
        (radiance(b"", size="-Y 0 +X 8"), "expected the size"),
        (radiance(bytes(63)), "expected 8x2 pixels, as 64 uncompressed bytes .* got 63"),
        (radiance([2, 2, 0, 8, 128 + 8]), "row 0 of 2 is truncated"),
        (radiance([2, 2, 0, 8, 128 + 9, 1]), "row 0 of 2 is truncated or damaged"),
        (radiance([2, 2, 0, 8, 0, 1]), "row 0 of 2 is truncated or damaged"),
        (radiance([2, 2, 0, 8] + [128 + 8, 1] * 4), "row 1 of 2 is missing"),
    ],
)
def test_broken_radiance(tmp_path, content, message):
    (tmp_path / "a.hdr").write_bytes(content)
    with pytest.raises(DataError, match=rf"a\.hdr: {message}"):
        images.read_image(tmp_path / "a.hdr")


# Broken files of all kinds


def written(path):
    match path.suffix:
        case ".png":
            images.write_png(path, (255 * noise(40, 40, 3)).astype(np.uint8))
        case ".jpg":
            Image.fromarray((255 * noise(40, 40, 3)).astype(np.uint8)).save(path)
        case ".exr":
            images.write_exr(path, dict.fromkeys("RGB", noise(40, 40)))
        case ".hdr":
            path.write_bytes(radiance(bytes(64)))
    return path.read_bytes()


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".exr", ".hdr"])
@pytest.mark.parametrize("keep", [0.02, 0.5, 0.95])
def test_truncated_files(tmp_path, suffix, keep):
    path = tmp_path / f"a{suffix}"
    content = written(path)
    path.write_bytes(content[: int(keep * len(content))])
    with pytest.raises(DataError, match=rf"a\{suffix}: "):
        images.read_image(path)


@pytest.mark.parametrize("read", [images.read_image, images.image_size])
@pytest.mark.parametrize("suffix", [".png", ".jpg", ".exr", ".hdr"])
def test_empty_missing_and_foreign_files(tmp_path, suffix, read):
    path = tmp_path / f"a{suffix}"
    with pytest.raises(DataError, match="expected a file, got nothing there"):
        read(path)
    written(path)
    if suffix != ".hdr":
        assert images.image_size(path) == (40, 40)
    for content, said in (
        (path.read_bytes()[:20], rf"a\{suffix}: "),
        (b"", "the file is empty"),
        (b"this is no picture, whatever its name says" * 20, rf"a\{suffix}: "),
    ):
        path.write_bytes(content)
        with pytest.raises(DataError, match=said):
            read(path)
    path.unlink()
    path.mkdir()
    if read is images.read_image:
        with pytest.raises(DataError, match="expected a file, got a folder"):
            read(path)


@pytest.mark.parametrize("read", [images.read_image, images.image_size])
@pytest.mark.parametrize("name", ["IMG_1.HEIC", "a.heif", "a.avif"])
def test_pictures_of_telephones(tmp_path, read, name):
    with pytest.raises(DataError, match=r"expected an image \(\.png .* got '\.bmp'"):
        images.read_image(tmp_path / "a.bmp")
    (tmp_path / name).write_bytes(b"ftypheic")
    with pytest.raises(DataError, match=rf"{name}: .* got '\.\w+': convert .* `univoxel poses`"):
        read(tmp_path / name)


# Writing


@pytest.mark.parametrize(
    ("image", "message"),
    [
        (np.zeros((2, 3, 2)), r"must be \[H, W\(, 3 or 4\)\], got \[2, 3, 2\]"),
        (np.zeros(3), r"got \[3\]"),
        (np.full((2, 2), np.nan), "contains NaN"),
        (np.zeros((2, 2), np.int64), "must be uint8 or floating, got int64"),
    ],
)
def test_what_is_no_picture(tmp_path, image, message):
    with pytest.raises(ValueError, match=message):
        images.write_png(tmp_path / "a.png", image)
    for channels in ({}, {"Y": np.zeros((2, 2)), "Z": np.zeros((2, 3))}, {"Y": np.zeros((0, 2))}):
        with pytest.raises(ValueError, match=r"channels must all be \[H, W\]"):
            images.write_exr(tmp_path / "a.exr", channels)
    assert not list(tmp_path.iterdir())


def write(path, value):
    if path.suffix == ".png":
        images.write_png(path, np.full((2, 2), value, np.uint8))
    else:
        images.write_exr(path, {"Y": np.full((2, 2), value)})


@pytest.mark.parametrize("name", ["a.png", "a.exr"])
def test_a_full_disk_leaves_the_old_file(tmp_path, name):
    """/dev/full fails every write with ENOSPC; the temporary file is made a link to it."""
    with pytest.raises(OSError, match=rf"cannot write: No such file or directory: .*none/{name}"):
        write(tmp_path / "none" / name, 1)
    if not os.path.exists("/dev/full"):
        pytest.skip("no /dev/full on this system")
    path = tmp_path / name
    write(path, 1)
    with replacing(path) as temporary:  # learn its name
        temporary.write_bytes(path.read_bytes())
    temporary.symlink_to("/dev/full")
    message = rf"cannot write: .*No space left on device.*{name}"
    with pytest.raises(OSError, match=message) as caught:
        write(path, 2)
    assert caught.value.errno == errno.ENOSPC
    assert float(images.read_image(path)[0, 0, 0]) == 1
    assert [path.name for path in tmp_path.iterdir()] == [name]


def test_what_openexr_says_of_damage_stays_away(tmp_path, capfd):
    """One line is promised: the library's own lines go to no one, from any thread."""
    path = tmp_path / "a.exr"
    images.write_exr(path, dict.fromkeys("RGB", noise(64, 64)), half=False)
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    capfd.readouterr()
    with ThreadPoolExecutor(4) as pool:
        failures = [pool.submit(images.read_image, path).exception() for _ in range(16)]
    assert all("this OpenEXR file could not be read" in str(f) for f in failures)
    os.write(2, b"heard")
    assert capfd.readouterr().err == "heard"
