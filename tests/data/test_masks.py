"""Masks in files of their own: which is whose, what their numbers mean, how they lie on pixels."""

import layouts
import numpy as np
import pytest
import torch
from analytic import write_scene
from layouts import save_turned, scene, write_colmap, write_llff, write_nerfstudio
from PIL import Image, ImageOps

from univoxel.data import load_photos
from univoxel.data.images import (
    orientation,
    stored_from_upright,
    upright_from_stored,
    write_exr,
    write_png,
)
from univoxel.data.load_images import read_photo
from univoxel.data.masks import coverage_in, find_masks, masks_beside, masks_in, read_mask
from univoxel.errors import DataError, WithoutMasks


def save(path, mask):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.asarray(mask, np.uint8)).save(path)
    return path


@pytest.fixture
def folder(tmp_path):
    return tmp_path / "masks"


@pytest.mark.parametrize(
    "name",
    [
        *("IMG_1.png", "img_1.PNG", "IMG_1.JPG.png", "IMG_1_mask.png", "IMG_1.jpg_mask.jpg"),
        *("IMG_1_alpha.png", "IMG_1.mask.png", "IMG_1.JPG.mask.tif", "mask_IMG_1.png"),
        *("IMG_1-Mask.JPG", "IMG_1_matte.png", "IMG_1-removebg-preview.png", "IMG_1.HEIC.png"),
        "inner/IMG_1 mask.webp",
    ],
)
def test_whose_a_mask_is(tmp_path, folder, name):
    path = save(folder / name, np.zeros((2, 2)))
    save(folder / "IMG_10.png", np.zeros((2, 2)))
    assert masks_in(folder, [("IMG_1", tmp_path / "IMG_1.JPG")]) == [path]


def test_folders_tell_apart_what_names_do_not(tmp_path, folder):
    paths = [save(folder / side / "1.png", np.zeros((2, 2))) for side in ("left", "right")]
    asked = [(f"{side}/1", tmp_path / side / "1.jpg") for side in ("left", "right")]
    assert masks_in(folder, asked) == paths
    with pytest.raises(DataError, match=r"1\.jpg: expected one mask, got .*1\.png and .*1\.png"):
        masks_in(folder, [("1", tmp_path / "1.jpg")])


def test_folders_of_masks_that_do_not_fit(tmp_path, folder):
    """A mask of two photographs; those of a split, where that of the photograph is missing."""
    asked = [("a", tmp_path / "a.jpg")]
    with pytest.raises(DataError, match="masks: expected a folder of masks, got nothing there"):
        masks_in(folder, asked)
    folder.mkdir()
    with pytest.raises(DataError, match=r"expected masks .*, found no image"):
        masks_in(folder, asked)
    save(folder / "1.png", np.zeros((2, 2)))
    asked = [(f"{side}/1", tmp_path / side / "1.jpg") for side in ("left", "right")]
    with pytest.raises(DataError, match=r"masks/1\.png: expected a mask of one photograph, but"):
        masks_in(folder, asked)
    for name in ("train/1", "train/2", "test/3"):
        save(tmp_path / "splits" / f"{name}.png", np.zeros((2, 2)))
    asked = [(name, tmp_path / "train" / f"{name}.jpg") for name in "123"]
    with pytest.raises(DataError, match=r"none for 1: 3\.jpg"):
        masks_in(tmp_path / "splits", asked)


def test_a_mask_is_of_the_photograph_that_it_names_most_exactly(tmp_path, folder):
    names = {"a.jpg": "a.jpg.png", "a.png": "a.png.png", "mask_1.jpg": "mask_1.png"}
    names |= {"1.jpg": "1_mask.png", "e\u0301.jpg": "\u00e9.png"}  # letters as Macs write them
    paths = {image: save(folder / mask, np.zeros((2, 2))) for image, mask in names.items()}
    asked = [(image.rpartition(".")[0], tmp_path / image) for image in names]
    assert masks_in(folder, asked) == list(paths.values())
    save(folder / "a.png", np.zeros((2, 2)))  # a copy: COLMAP's name is the exact one
    assert masks_in(folder, asked) == list(paths.values())


def test_where_folders_of_masks_are(tmp_path):
    """The nearest first; nothing that is another program's, and nothing of other photographs."""
    image = save(tmp_path / "a" / "images" / "1.jpg", np.zeros((2, 2)))
    places = ["masks", "a/pmasks", "a/Mask", "a/masks", "a/images_mask", "a/images/masks"]
    save(tmp_path / "a" / "test_mask" / "1.png", np.zeros((2, 2)))
    for place in places:
        save(tmp_path / place / "._1.png", np.zeros((2, 2)))
        mask = save(tmp_path / place / "1.png", np.zeros((2, 2)))
        assert find_masks(tmp_path, [("1", image)]) == [mask]
    assert find_masks(tmp_path / "a" / "images", [("2", image)]) == [mask]
    assert find_masks(tmp_path, [("2", image.with_name("2.jpg"))]) == [None]


def test_beside_a_photograph_names_must_say_that_they_are_masks(tmp_path):
    image = save(tmp_path / "1.jpg", np.zeros((2, 2)))
    save(tmp_path / "1.png", np.zeros((2, 2)))
    assert masks_beside([("1", image)]) == [None]
    alpha = save(tmp_path / "1_alpha.png", np.zeros((2, 2)))
    assert masks_beside([("1", image)]) == [alpha]
    mask = save(tmp_path / "1.Mask.PNG", np.zeros((2, 2)))
    assert masks_beside([("1", image)]) == [mask]
    save(tmp_path / "1_mask.png", np.zeros((2, 2)))
    with pytest.raises(DataError, match=r"1\.jpg: expected one mask, got .*1\.Mask\.PNG and "):
        masks_beside([("1", image)])


@pytest.mark.parametrize(
    "layout", ["colmap", "idr", "llff", "metashape", "neilf", "polycam", "realitycapture"]
)
@pytest.mark.parametrize("name", ["{}_mask.PNG", "MASK-{}.png", "{}.mask.png"])
def test_names_of_masks_in_every_layout(tmp_path, layout, name):
    written = scene()
    data = getattr(layouts, f"write_{layout}")(tmp_path, written)
    place = next(p for p in data.rglob("mask*") if p.is_dir())
    images = sorted(p for p in data.rglob("*.png") if place not in p.parents)
    for image, mask in zip(images, sorted(place.iterdir()), strict=True):
        mask.rename(place / name.format(image.stem))
    place.rename(place.with_name("Masks"))
    for split in ("train", "test"):
        found = load_photos(data, split).alpha
        assert np.array_equal(found, written.pictures[written.split(split), ..., 3])
    next((place.with_name("Masks")).glob("*003*")).unlink()
    message = r"expected a mask for each of 8 photographs, got none for 1: \S*003\.png"
    with pytest.raises(DataError, match=message) as caught:
        load_photos(data)
    assert not isinstance(caught.value, WithoutMasks)
    data = write_llff(tmp_path / "beside", written)  # where they are no photographs
    for mask in (data / "masks").iterdir():
        save(data / "images" / f"._{mask.name}", np.zeros((2, 2)))
        mask.rename(data / "images" / f"{mask.stem}_mask.png")
    found = load_photos(data).alpha
    assert np.array_equal(found, written.pictures[written.split("train"), ..., 3])


def test_masks_of_another_size(folder):
    mask = np.zeros((4, 6))
    mask[:, :3] = 255
    path = save(folder / "a.png", mask)
    assert torch.equal(read_mask(path, 6, 4), torch.from_numpy(mask).byte())
    larger = read_mask(path, 60, 40)
    assert larger.shape == (40, 60)
    assert (larger[:, :24] == 255).all()
    assert not larger[:, 36:].any()
    smaller = read_mask(path, 3, 2)
    assert smaller.tolist() == [[255, 128, 0]] * 2  # means
    with pytest.raises(DataError, match=r"a\.png: expected 40x60 pixels, got 6x4"):
        read_mask(path, 40, 60)


def test_what_masks_hold_is_as_it_is(tmp_path):
    """Alpha where there is one, numbers in floating point, and soft masks: also where nothing of
    them is certain, and those of one value; a cut-out that fills its picture is the object."""
    rgba = np.zeros((2, 2, 4))
    rgba[0, :, 3], rgba[1, :, :3] = 255, 255
    path = save(tmp_path / "a.png", rgba)
    assert read_mask(path, 2, 2).tolist() == [[255, 255], [0, 0]]
    for values in ([0, 100, 255], [0, 17, 180], [90, 90, 90], [0, 0, 0]):
        assert coverage_in(save(path, [values]))[0].tolist() == values
    noise = np.random.default_rng(0).integers(0, 255, (9, 9, 4), np.uint8)
    noise[..., 3] = 255
    assert (coverage_in(save(path, noise)) == 255).all()
    for high in (255, 1):
        write_exr(tmp_path / "a.exr", {"Y": high * np.array([[-0.1, 0.4, 1]])}, half=False)
        assert coverage_in(tmp_path / "a.exr")[0].tolist() == pytest.approx([0, 0.4, 1])


HALF = np.array([[0, 0], [1, 1]])


def palette(numbers, *colors):
    picture = Image.fromarray(np.asarray(numbers, np.uint8), "P")
    picture.putpalette([value for color in colors for value in color])
    return picture


def rgb(*scale):
    return Image.fromarray((HALF[..., None] * np.array(scale)).astype(np.uint8))


OBJECTS = {
    "black and white": Image.fromarray((255 * HALF).astype(np.uint8)),
    "one bit": Image.fromarray(HALF > 0),
    "0 and 1": Image.fromarray(HALF.astype(np.uint8)),
    "0 and 1, three channels": rgb(1, 1, 1),
    "0 and 128": Image.fromarray((128 * HALF).astype(np.uint8)),
    "green": rgb(0, 255, 0),
    "dark red": rgb(128, 0, 0),
    "opaque alpha": rgb(255, 255, 255).convert("RGBA"),
    "grey with opaque alpha": rgb(255, 255, 255).convert("LA"),
    "palette of colours": palette(HALF, (0, 0, 0), (128, 0, 0)),
    "palette of grey": palette(1 - HALF, (255, 255, 255), (0, 0, 0)),
    "palette of 0 and 1": palette(HALF, (0, 0, 0), (1, 1, 1)),
    "16 bits": Image.fromarray((65535 * HALF).astype(np.uint16)),
    "8 bits in 16": Image.fromarray((255 * HALF).astype(np.uint16)),
    "0 and 1 in 16": Image.fromarray(HALF.astype(np.uint16)),
}


@pytest.mark.parametrize("top", [1, 2, 255, 65535])
@pytest.mark.parametrize("kind", [np.int32, np.float32])
def test_masks_of_32_bits(tmp_path, kind, top):
    Image.fromarray((top * HALF).astype(kind)).save(tmp_path / "a.tif")
    assert coverage_in(tmp_path / "a.tif").tolist() == HALF.tolist()
    Image.fromarray((1e9 * HALF).astype(kind)).save(tmp_path / "a.tif")
    with pytest.raises(DataError, match=r"a\.tif: expected mask values up to 65535, got"):
        coverage_in(tmp_path / "a.tif")


@pytest.mark.parametrize("alpha", [0, 128, 254, 255])
def test_an_alpha_that_is_the_same_all_over_says_nothing(tmp_path, alpha):
    """Of a mask its brightness counts then; of a photograph, the mask beside it."""
    mask = rgb(255, 255, 255)
    mask.putalpha(alpha)
    mask.save(tmp_path / "a_mask.png")
    assert coverage_in(tmp_path / "a_mask.png").tolist() == (255 * HALF).tolist()
    Image.new("RGBA", (2, 2), (9, 8, 7, alpha)).save(tmp_path / "a.png")
    flat = {
        name: np.full((2, 2), x) for name, x in {"R": 4, "G": 3, "B": 2, "A": alpha / 255}.items()
    }
    write_exr(tmp_path / "a.exr", flat)
    for photograph, colors in (("a.png", [9, 8, 7]), ("a.exr", [4, 3, 2])):
        color, found = read_photo(tmp_path / photograph, beside=tmp_path / "a_mask.png")
        assert found.tolist() == (255 * HALF).tolist()
        assert color[0, 0].tolist() == colors


def test_photographs_of_nothing_or_nothing_else_are_named(tmp_path, caplog):
    written = scene()
    written.pictures[1:8, ..., 3], written.pictures[9, ..., 3] = 0, 255
    written.pictures[1, 0, 0, 3] = 200
    load_photos(write_nerfstudio(tmp_path, written))
    names = ", ".join(written.names[v] for v in range(2, 7))
    assert f"6 of 8 photographs show nothing of the object: {names}, ...\n" in caplog.text
    assert f"1 of 8 photographs show nothing but the object: {written.names[9]}\n" in caplog.text


@pytest.mark.parametrize("what", OBJECTS)
def test_what_is_the_object(tmp_path, what):
    """As programs write masks, whose lower half is the object."""
    OBJECTS[what].save(tmp_path / "a.png")
    found = coverage_in(tmp_path / "a.png").float()
    assert (found / found.max()).tolist() == HALF.tolist()
    assert float(found.max()) == (1 if "16" in what else 255)


COLORFUL = np.random.default_rng(0).integers(0, 255, (9, 9, 3), np.uint8)
TWO_COLORS = np.array([[[255] * 3, [255, 0, 0]]], np.uint8)


@pytest.mark.parametrize(
    ("picture", "message"),
    [
        (Image.fromarray(np.array([[0, 1, 2]], np.uint8)), "values of at most 2 of 255"),
        (palette([[0, 1, 2]], (0, 0, 0), (128, 0, 0), (0, 128, 0)), "3 palette colours"),
        (palette([[0, 1, 1]], (9, 9, 200), (128, 0, 0)), "2 palette colours"),
        (Image.fromarray(COLORFUL), "got an image with several colours"),
        (Image.fromarray(TWO_COLORS), "got an image with several colours"),
    ],
)
def test_pictures_that_say_nothing_of_one_object(tmp_path, picture, message):
    picture.save(tmp_path / "a.png")
    with pytest.raises(DataError, match=rf"a\.png: expected a mask.*{message}.*: use masks that"):
        coverage_in(tmp_path / "a.png")


def test_inverted_masks_are_refused(tmp_path):
    written = scene(10, 30, 20)
    data = write_colmap(tmp_path, written)
    for n, path in enumerate(sorted((data / "masks").iterdir())):
        mask = np.zeros((20, 30))
        mask[4:12, 3 + n : 15 + n] = 255
        save(path, mask)
    assert load_photos(data).alpha.any()
    for path in (data / "masks").iterdir():
        save(path, 255 - np.asarray(Image.open(path)))
    with pytest.raises(DataError, match=r"8 of 8 sampled masks are white along .* to be inverted"):
        load_photos(data)


@pytest.fixture
def lit(tmp_path):
    """A bright triangle before a dark, noisy room, and masks of it."""
    written = scene(10, 40, 40)
    data, noise = write_colmap(tmp_path, written), np.random.default_rng(0)
    row, column = np.mgrid[:40, :40]
    for n, name in enumerate(written.names):
        mask = 255 * ((row > 4 + n) & (column > 6) & (row + 2 * column < 70)).astype(np.uint8)
        picture = np.where(mask[..., None] > 0, (200, 120, 90), (20, 40, 30))
        picture = picture + noise.integers(-9, 9, picture.shape)
        save(data / "images" / f"{name}.png", picture)
        save(data / "masks" / f"{name}.png.png", mask)
    return data


@pytest.mark.parametrize(
    ("way", "word"),
    [
        (np.fliplr, "mirrored left to right"),
        (np.flipud, "mirrored top to bottom"),
        (lambda mask: np.rot90(mask, 2), "rotated by 180 degrees"),
        (lambda mask: np.rot90(mask, -1), "rotated by 90 degrees to the left"),
        (np.rot90, "rotated by 90 degrees to the right"),
        (np.transpose, "mirrored about a diagonal"),
    ],
)
def test_masks_of_pictures_that_were_mirrored_or_turned(lit, way, word):
    assert load_photos(lit).alpha.any()
    for path in (lit / "masks").iterdir():
        save(path, way(np.asarray(Image.open(path))))
    with pytest.raises(DataError, match=f"8 of 8 sampled masks fit .* only when {word}"):
        load_photos(lit)


def test_some_masks_may_be_mirrored_but_not_all_faint(lit):
    """A vote would mend them: one that fits by chance is no reason to end."""
    paths = sorted((lit / "masks").iterdir())
    for path in paths[:5]:
        save(path, np.fliplr(np.asarray(Image.open(path))))
    assert load_photos(lit).alpha.any()
    for path in paths:
        save(path, np.asarray(Image.open(path)) // 4 + np.arange(40) % 20)
    with pytest.raises(DataError, match=r"expected masks .*, got values of at most 82 of 255 in 8"):
        load_photos(lit)


@pytest.mark.parametrize("straight", [True, False])
def test_colours_that_are_multiplied_by_alpha_are_told(lit, caplog, straight):
    for path in (lit / "images").iterdir():
        mask = lit / "masks" / f"{path.name}.png"
        alpha = np.array(
            Image.open(mask).resize((20, 20)).resize((40, 40), Image.Resampling.BILINEAR)
        )
        share = 1 if straight else alpha[..., None] / 255
        color = (np.array((200, 120, 90)) * share * np.ones((40, 40, 1))).astype(np.uint8)
        write_png(path, np.concatenate([color, alpha[..., None]], -1))
        mask.unlink()
    load_photos(lit)
    assert ("colours seem to be premultiplied by alpha" in caplog.text) != straight


# Photographs that EXIF says to turn


def turned_photograph(path, upright, tag):
    stored = stored_from_upright(torch.from_numpy(upright), tag).contiguous().numpy()
    path.parent.mkdir(exist_ok=True)
    save_turned(path, stored, tag)


@pytest.mark.parametrize("tag", range(1, 9))
def test_masks_follow_their_photographs(tmp_path, tag):
    """Upright ones are turned to the stored pixels, by their size, or where they say so."""
    upright = np.zeros((16, 24), np.uint8)
    upright[2:7, 3:9] = 255
    turned_photograph(tmp_path / "a.jpg", np.repeat(upright[..., None], 3, 2), tag)
    with Image.open(tmp_path / "a.jpg") as image:  # turning is that of viewers
        as_stored, looked_at = np.array(image), np.array(ImageOps.exif_transpose(image))
    assert orientation(tmp_path / "a.jpg") == tag
    assert np.array_equal(upright_from_stored(torch.from_numpy(as_stored), tag), looked_at)
    stored = stored_from_upright(torch.from_numpy(upright), tag).contiguous()
    height, width = stored.shape
    plain, tagged, other = (tmp_path / name for name in ("a.png", "b.jpg", "c.jpg"))
    save(plain, stored)
    turned_photograph(tagged, upright, tag)
    turned_photograph(other, upright, 3)
    for mask in (plain, tagged, other):
        found = read_mask(mask, width, height, tmp_path / "a.jpg")
        assert torch.equal(found > 127, stored > 127)
    save(plain, upright)
    if tag >= 5:
        assert torch.equal(read_mask(plain, width, height, tmp_path / "a.jpg"), stored)
    assert torch.equal(read_mask(plain, width, height, tmp_path / "a.jpg", upright=True), stored)


@pytest.mark.parametrize("square", [False, True])
@pytest.mark.parametrize("upright", [False, True])
def test_colours_tell_what_masks_were_made_of(tmp_path, caplog, square, upright):
    """Where sizes do not: photographs that were held upside down, and square ones."""
    size = 30 if square else 40
    written = scene(10, size, 30)
    data, tag = write_nerfstudio(tmp_path, written), 6 if square else 3
    caplog.set_level("INFO", "univoxel")
    for n, name in enumerate(written.names):
        mask = np.zeros((30, size), np.uint8)
        mask[3:14, 5 + n : 17 + n] = 255
        picture = np.where(mask[..., None] > 0, (200, 120, 40), (20, 40, 90)).astype(np.uint8)
        (data / "images" / f"{name}.png").unlink()
        turned_photograph(data / "images" / f"{name}.jpg", picture, tag)
        stored = stored_from_upright(torch.from_numpy(mask), tag)
        save(data / "masks" / f"{name}.png", mask if upright else stored)
    photos = load_photos(data)
    red = photos.color[..., 0] > 120
    assert torch.equal(photos.alpha > 127, red)
    assert photos.alpha.any()
    what = "the upright image" if upright else "the stored pixels"
    assert f"8 photographs have an EXIF orientation, and their masks seem to match {what}" in (
        caplog.text
    )


def test_photographs_with_masks_of_a_folder(tmp_path, folder):
    """They take the place of alpha in the pictures."""
    data = write_scene(tmp_path / "data", 3, 8)
    for view in range(3):
        mask = np.zeros((16, 16))
        mask[2 * view] = mask[2 * view + 1] = 255
        save(folder / f"r_{view}.png", mask)
    photos = load_photos(data, masks=folder)
    for view in range(3):
        rows = photos.alpha[view].float().mean(1)
        assert rows.nonzero()[:, 0].tolist() == [view]
