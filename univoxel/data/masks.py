"""Mask files: the photograph, values and orientation of each."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from torch import Tensor
from torch.nn.functional import interpolate

from univoxel.core.system import folded
from univoxel.data.images import (
    FOREIGN,
    SUFFIXES,
    as_array,
    image_size,
    opened,
    orientation,
    read_image,
    stored_from_upright,
    turn_note,
    upright_from_stored,
)
from univoxel.data.path_sandbox import entries
from univoxel.errors import DataError, some

PLACES = ("masks", "mask", "pmasks")  # folders of masks; the first that has one counts
# What stands before or behind a photograph's name in that of its mask. Beside a photograph the
# first counts
WORDS = ("mask", "masks", "alpha", "matte", "silhouette", "removebg-preview")
_WORD = "|".join(map(re.escape, WORDS))
_BEHIND = re.compile(rf"(.+?)[_\-. ]+({_WORD})")
_BEFORE = re.compile(rf"({_WORD})[_\-. ]+(.+)")
SKEW = 0.01  # by which width over height of a mask and its photograph may differ
COLORED = 64  # of 255: difference of channels from which a pixel of a mask has a colour
FEW = 0.001  # share of a mask's pixels that may have a colour, as JPEG makes some
HUE = 0.2  # by which pixels of one colour may differ from it, channel over largest channel
MOST = 0.95  # share of pixels that is taken for all: the others are on borders
LABELS = 15  # of 255: largest value up to which several ones are numbers of things
LOOKED_AT = 4  # photographs that say whether masks are upright
# Masks that are inverted keep a border of this share of the sides, and have as much black within
BORDER, HOLE = 0.02, 0.005
USUAL = 0.75  # share of masks that must be wrong in one way, and
FEWEST = 4  # of how many at least, before it is said
# Along the edge of a right mask colours change more than elsewhere: 4 to 32 times as much in six
# data sets, and 0.2 to 3 times along that of a mirrored one (6 of an object that is its mirror)
FITS = 3.0
WAYS = {2: "mirrored left to right", 3: "rotated by 180 degrees", 4: "mirrored top to bottom"}
WAYS |= {5: "mirrored about a diagonal", 6: "rotated by 90 degrees to the left"}
WAYS |= {7: "mirrored about a diagonal", 8: "rotated by 90 degrees to the right"}
BRIGHT, SOFT = 100, 100  # of 255, of an object; pixels: for colours to tell of alpha
WHITE = "use masks that are white on the object and black elsewhere"

Named = Sequence[tuple[str, Path]]  # photographs: the name within the data set, and the file
Claim = tuple[tuple[int, ...], Path]  # of a mask: how well it fits, lowest best, and the mask


# Whose a mask is


def find_masks(folder: Path, photographs: Named) -> list[Path | None]:
    """The mask of each photograph of a data set where it has a folder of masks, or None; a
    DataError where two masks are of one photograph, or one is of two.

    Such a folder is called masks, mask or pmasks, or like that of the photographs with _masks or
    _mask behind, upper or lower case. It lies in the folder of the photographs, beside it, or
    beside one around it. Of images_4 it may be masks_4.
    """
    found: dict[int, Path] = {}
    known = {p: _places(folder, p) for p in {image.parent for _, image in photographs}}
    for near in range(max(map(len, known.values()), default=0)):
        asked: dict[Path, list[int]] = {}
        for i, (_, image) in enumerate(photographs):
            if i not in found and near < len(places := known[image.parent]):
                asked.setdefault(places[near], []).append(i)
        for place, those in asked.items():
            found |= _paired(_pictures(place), place, photographs, those)
    return [found.get(i) for i in range(len(photographs))]


def masks_in(folder: Path, photographs: Named) -> list[Path]:
    """The mask of each photograph in a folder that the user names; a DataError where there is no
    such folder, a photograph has none in it or two, or one is of two."""
    if not folder.is_dir():
        what = "a file" if folder.exists() else "nothing there"
        raise DataError(f"{folder}: expected a folder of masks, got {what}")
    files = _pictures(folder)
    if not files:
        raise DataError(f"{folder}: expected masks ({' '.join(SUFFIXES)}), found no image")
    everyone = range(len(photographs))
    found = _paired(files, folder, photographs, everyone)
    require_all(folder, photographs, [i in found for i in everyone])
    return [found[i] for i in everyone]


def require_all(where: Path, photographs: Named, masked: Sequence[bool]) -> None:
    """Raise a DataError that names the photographs without a mask, if there are any."""
    without = [image for (_, image), there in zip(photographs, masked, strict=True) if not there]
    if without:
        first = without[0]
        raise DataError(
            f"{where}: expected a mask for each of {len(photographs)} photographs, got none for "
            f"{len(without)}: {some([p.name for p in without])} (looked for "
            f"{first.stem}.png, {first.name}.png, {first.stem}_mask.png and similar names)"
        )


def masks_beside(photographs: Named) -> list[Path | None]:
    """The mask of each photograph that is beside it, such as IMG_1_mask.png; a DataError where two
    are of one photograph."""
    found: dict[int, Path] = {}
    for parent in dict.fromkeys(image.parent for _, image in photographs):
        here = [i for i, (_, image) in enumerate(photographs) if image.parent == parent]
        found |= _paired(_beside(parent), None, photographs, here)
    return [found.get(i) for i in range(len(photographs))]


def without_masks(pictures: Sequence[Path]) -> list[Path]:
    """Pictures of one folder, without those that are masks of others by their names."""
    photographs = [(path.stem, path) for path in pictures]
    claimed = {mask for claims in _claims(pictures, None, photographs) for _, mask in claims}
    return [path for path in pictures if path not in claimed]


def photographs_in(folder: Path) -> list[Path]:
    """The photographs of a folder in order of their names; hidden files are of other programs."""
    return without_masks(_beside(folder))


def _places(folder: Path, start: Path) -> list[Path]:
    """Folders of masks of the photographs in a folder of a data set, the nearest first."""
    found: list[Path] = []
    inner = ""  # name of the folder that leads to the photographs
    for steps, around in enumerate([start, *start.parents]):
        # Of what lies in another data set, only what is beside its folder
        if steps > 1 and not around.is_relative_to(folder):
            break
        found += _named_masks(around, inner)
        if around == folder:
            break
        inner = around.name
    return found


def _named_masks(around: Path, inner: str) -> list[Path]:
    """Folders within another that are called as masks of what lies in its folder `inner`."""
    names = [f"{inner}_masks", f"{inner}_mask"] if inner else []
    if shrunk := re.fullmatch(r"images(_\d+)", inner):
        names += [f"{name}{shrunk[1]}" for name in PLACES]
    order = {folded(name): place for place, name in enumerate([*names, *PLACES])}
    folders = [p for p in entries(around) if folded(p.name) in order and p.is_dir()]
    return sorted(folders, key=lambda p: (order[folded(p.name)], p.name))


def _beside(folder: Path) -> list[Path]:
    return [path for path in entries(folder) if _is_picture(path)]


def _pictures(folder: Path) -> list[Path]:
    """Pictures of a folder, and of folders in it."""
    return sorted(p for p in folder.rglob("*") if _is_picture(p))


def _is_picture(path: Path) -> bool:
    """Whether a name is that of a picture. Macs leave ._IMG_1.png beside each on foreign disks."""
    return path.suffix.lower() in SUFFIXES and not path.name.startswith(".")


def _paired(
    masks: Sequence[Path], root: Path | None, photographs: Named, those: Sequence[int]
) -> dict[int, Path]:
    """The masks of some photographs among files, by the photographs' numbers.

    Args:
        root: folder of the masks; None: that of the photographs, beside which names must say that
            they are masks.
    """
    found: dict[int, Path] = {}
    whose: dict[Path, Path] = {}
    every = _claims(masks, root, [photographs[i] for i in those])
    for i, claims in zip(those, every, strict=True):
        image = photographs[i][1]
        best = [mask for rank, mask in claims if rank == min(claims)[0]]
        if len(best) > 1:
            raise DataError(
                f"{image}: expected one mask, got {' and '.join(map(str, best[:2]))}: remove one"
            )
        if not best:
            continue
        mask = found[i] = best[0]
        if root is not None and whose.setdefault(mask, image) != image:
            raise DataError(
                f"{mask}: expected a mask of one photograph, but its name matches {whose[mask]} "
                f"and {image}: put each mask into a subfolder of the same name as its photograph, "
                f"or name it after the whole file name, such as {image.name}.png"
            )
    return found


def _claims(masks: Sequence[Path], root: Path | None, photographs: Named) -> list[list[Claim]]:
    """Of each photograph, the masks that name it.

    A mask is of the photograph that it names most exactly: IMG_1.jpg.png is of IMG_1.jpg, and what
    no photograph is called by its whole name is of one with that stem. Folders tell apart what
    names do not.
    """
    whole: dict[str, list[int]] = {}
    stems: dict[str, list[int]] = {}
    numbers: dict[int, list[int]] = {}
    for i, (name, image) in enumerate(photographs):
        whole.setdefault(folded(image.name), []).append(i)
        plain = re.sub("_rgba?$", "", image.stem)
        for stem in {folded(s) for s in (image.stem, plain, name, Path(name).name)}:
            stems.setdefault(stem, []).append(i)
        if image.stem.isdecimal():
            numbers.setdefault(int(image.stem), []).append(i)

    def named(mask: Path) -> tuple[list[int], tuple[int, int]]:
        """The photographs that a mask names, and how: with the word beside the name or none."""
        for form, word in _forms(mask.name):
            for exact, known in enumerate((whole, stems)):
                those = [i for i in known.get(form, []) if photographs[i][1] != mask]
                if those and (root or word is not None):
                    return those, (exact, 0) if root else (WORDS.index(word or ""), exact)
        return [], (0, 0)

    found = {mask: named(mask) for mask in masks}
    if root and not any(those for those, _ in found.values()):  # of 000000.png it is 000.png
        found = {m: (numbers.get(int(m.stem), []), (0, 0)) for m in masks if m.stem.isdecimal()}
    claims: list[list[Claim]] = [[] for _ in photographs]
    strangers: list[tuple[int, Claim]] = []  # in folders that no photograph of theirs is in
    for mask, (those, rank) in found.items():
        inner = mask.relative_to(root).parts[:-1] if root else ()
        common = {i: _common(inner, photographs[i][1].parts[:-1]) for i in those}
        for i, count in common.items():
            if count == max(common.values()):
                claim = (-count, *rank), mask
                if inner and not count:
                    strangers.append((i, claim))
                else:
                    claims[i].append(claim)
    if any(rank[0] for those in claims for rank, _ in those):
        return claims
    return [those or [claim for j, claim in strangers if j == i] for i, those in enumerate(claims)]


def _common(inner: Sequence[str], parts: Sequence[str]) -> int:
    """How many of the last names of two paths are the same."""
    same = [folded(a) == folded(b) for a, b in zip(reversed(inner), reversed(parts), strict=False)]
    return same.index(False) if False in same else len(same)


def _forms(name: str) -> Iterator[tuple[str, str | None]]:
    """What a mask's name may say, from most to least: each with a word of WORDS that is left out.

    First without its own ending: IMG_1.jpg_mask.png yields img_1.jpg_mask, img_1.jpg, img_1.
    """
    text, word = folded(name), None
    text = text[: -len(Path(text).suffix)]
    while True:
        yield text, word
        if Path(text).suffix in (*SUFFIXES, *FOREIGN):
            text = text[: -len(Path(text).suffix)]
        elif found := _BEHIND.fullmatch(text):
            text, word = found.groups()
        elif found := _BEFORE.fullmatch(text):
            word, text = found.groups()
        else:
            return


# What its numbers mean


def read_mask(
    path: Path, width: int, height: int, photograph: Path | None = None, upright: bool = False
) -> Tensor:
    """A mask [height, width] of the stored pixels of a photograph, uint8 or float32 in [0, 1].

    One of another size but the same shape is resized; rows and columns that an original of N times
    the size has left over are cut off. Arguments and errors as in `laid_over`.
    """
    mask = laid_over(path, width, height, photograph, upright)
    if mask.shape == (height, width):
        return mask
    mode = "area" if mask.shape[1] > width else "bilinear"
    resized = interpolate(mask[None, None].float(), (height, width), mode=mode)[0, 0]
    return resized if mask.is_floating_point() else resized.round().to(torch.uint8)


def laid_over(
    path: Path, width: int, height: int, photograph: Path | None = None, upright: bool = False
) -> Tensor:
    """A mask as it lies over the stored pixels of a photograph of width and height, in its own
    size; a DataError where it cannot be read, is none, or has another shape.

    An orientation in the mask's EXIF counts. A mask without one may have been made of the stored
    pixels or of the photograph as it is looked at: its size tells, where it is not square, and
    elsewhere `upright`.
    """
    mask, own = coverage_in(path), orientation(path)
    turned = 1 if photograph is None else orientation(photograph)
    if own not in (1, turned):
        mask = upright_from_stored(mask, own)
    if own != turned and (own != 1 or _seen_upright(mask.shape, width, height, turned, upright)):
        mask = stored_from_upright(mask, turned)
    factor = max(mask.shape[0] // height, 1)
    if (mask.shape[0] // factor, mask.shape[1] // factor) == (height, width):
        mask = mask[: factor * height, : factor * width]  # what an original has left over
    if not _alike(mask.shape, width, height):
        note = turn_note(photograph) if photograph else ""
        came = f"{mask.shape[1]}x{mask.shape[0]}"
        raise DataError(f"{path}: expected {width}x{height} pixels, got {came}{note}")
    return mask.contiguous()


def _seen_upright(
    shape: Sequence[int], width: int, height: int, turned: int, default: bool
) -> bool:
    """Whether a mask is of a photograph as it is looked at, and not of its stored pixels."""
    stored = _alike(shape, width, height)
    looked_at = _alike(shape, *((height, width) if turned >= 5 else (width, height)))
    return default if stored and looked_at else looked_at


def _alike(shape: Sequence[int], width: int, height: int) -> bool:
    """Whether a mask [h, w] has the shape of a picture, but for the rounding of its sides."""
    return abs(shape[1] * height / (shape[0] * width) - 1) <= SKEW + 0.5 / min(shape)


def coverage_in(path: Path) -> Tensor:
    """A mask as it is stored [H, W]: uint8, or float32 in [0, 1]; largest on the object. A
    DataError where it cannot be read, or says nothing of one object.

    That is its alpha, unless that is the same all over; or its brightness. Where there are but two
    values, or two colours of which one is black, the larger one is the object, whatever its number.
    """
    if path.suffix.lower() in (".exr", ".hdr"):
        return _levels(read_image(path), path)
    with opened(path) as image:
        if image.mode == "P" and not image.has_transparency_data:
            return _of_palette(image, path)
        if image.mode in ("I", "F"):
            return _of_wide_numbers(np.asarray(image, np.float32), path)
        return _levels(torch.from_numpy(as_array(image, path)), path)


def _of_wide_numbers(values: np.ndarray, path: Path) -> Tensor:
    """Of a picture of 32 bits: of 0 and 1, or as much as 8 or 16 bits hold."""
    top = float(values.max())
    if not np.isfinite(values).all() or top > 65535:
        raise DataError(f"{path}: expected mask values up to 65535, got values up to {top:g}")
    return _scaled(torch.from_numpy(values / (65535 if top > 255 else 1)), path)


def _of_palette(image: Image.Image, path: Path) -> Tensor:
    """Of a picture with a palette: brightness where that is grey; else what is not number 0."""
    numbers = np.asarray(image)
    palette = np.array(image.getpalette("RGB"), np.uint8).reshape(-1, 3)
    used = np.unique(numbers).tolist()
    colors = palette[[min(n, len(palette) - 1) for n in used]].astype(int)
    if (np.ptp(colors, axis=1) == 0).all():
        return _scaled(torch.from_numpy(np.array(image.convert("L"))), path)
    things = [n for n in used if n]
    if len(things) > 1 or palette[0].any():
        named = [f"{n}: {palette[min(n, len(palette) - 1)].tolist()}" for n in used]
        raise DataError(
            f"{path}: expected a mask of one object, got {len(used)} palette colours "
            f"({some(named)}): {WHITE}"
        )
    return torch.from_numpy(255 * (numbers > 0).astype(np.uint8))


def _levels(image: Tensor, path: Path) -> Tensor:
    """Coverage [H, W] in a picture [H, W, C]."""
    if image.shape[-1] == 4:
        alpha = image[..., 3]
        if bool((alpha < alpha.max()).any()):
            return _scaled(alpha, path)
        try:
            return _scaled(_brightness(image[..., :3], path), path)
        except DataError:  # a cut-out photograph whose object fills it
            return image[..., 3].contiguous()
    return _scaled(_brightness(image, path), path)


def _brightness(image: Tensor, path: Path) -> Tensor:
    """The first channel [H, W], or of one colour on black its strongest."""
    if image.shape[-1] == 1:
        return image[..., 0]
    unit = 1 / 255 if image.is_floating_point() else 1
    largest = image.amax(-1)
    colored = largest - image.amin(-1) > COLORED * unit
    count = int(colored.sum())
    if count <= FEW * colored.numel():
        return image[..., 0]
    tones = image[colored].float() / largest[colored][:, None].float()
    usual = tones.median(0).values
    one = ((tones - usual).abs().amax(-1) < HUE).float().mean() >= MOST
    if not one or count < MOST * int((largest > COLORED * unit).sum()):
        raise DataError(f"{path}: expected a mask, got an image with several colours: {WHITE}")
    strongest = image[..., int(usual.argmax())]
    if image.is_floating_point():
        return strongest / strongest.max()
    return (strongest.float() * (255 / int(strongest.max()))).round().to(torch.uint8)


def _scaled(levels: Tensor, path: Path) -> Tensor:
    """Coverage from brightness [H, W]: of two values the larger is the object."""
    floating = levels.is_floating_point()
    top = float(levels.max())
    if top == (1 if floating else 255) or top <= 0:
        return levels.clamp_min(0).contiguous() if floating else levels.contiguous()
    if bool(((levels == 0) | (levels == top)).all()):
        if bool(levels.all()) and top not in (1, 1 / 65535):
            return levels.contiguous()  # of one value: nothing says how bright the object is
        return (levels > 0).float() if floating else 255 * (levels > 0).to(torch.uint8)
    if floating and 2 < top <= 255:
        levels, top = levels / 255, top / 255
    elif floating and top <= 255.5 / 65535:  # 8 bits in 16
        levels, top = levels * (65535 / 255), top * 65535 / 255
    code = round(255 * top) if floating else int(top)
    if code <= LABELS:
        raise DataError(
            f"{path}: expected a mask that is white on the object, got values of at most {code} "
            f"of 255, as in images of labels: {WHITE}"
        )
    return levels.clamp(0, 1) if floating else levels.contiguous()


# How masks lie on photographs


def made_upright(pairs: Sequence[tuple[Path, Path]]) -> bool | None:
    """Whether masks are of photographs as they are looked at, where EXIF says to turn these; None
    if no photograph is turned without its mask.

    One whose size tells speaks for all. Without any, colours tell: along a mask's edge they change.
    """
    asked = [(image, mask) for image, mask in pairs if orientation(image) != 1 == orientation(mask)]
    if not asked:
        return None
    for image, mask in asked:
        told = {
            _seen_upright(image_size(mask)[::-1], *image_size(image), orientation(image), default)
            for default in (False, True)
        }
        if len(told) == 1:
            return told.pop()
    changes = np.zeros(2)
    for image, mask in asked[:: -(-len(asked) // LOOKED_AT)]:
        picture, mask = read_image(image)[..., :3].float().mean(-1), coverage_in(mask).float()
        mask = mask / mask.max().clamp_min(1e-9)
        for way, laid in enumerate((mask, stored_from_upright(mask, orientation(image)))):
            changes[way] += _change(_small(picture), _small(laid))
    return bool(changes[1] > changes[0])


def require_fit(where: Path, views: Sequence[tuple[Tensor, Tensor]]) -> None:
    """Raise a DataError where masks are faint, or most are inverted, mirrored or turned.

    Args:
        views: colours [H, W, 3] and coverage [H, W] of some photographs.
    """
    largest = max(float(mask.max()) for _, mask in views)
    if largest < 0.5 and len(views) >= FEWEST:
        raise DataError(
            f"{where}: expected masks that are white on the object, got values of at most "
            f"{255 * largest:.0f} of 255 in {len(views)} sampled masks: {WHITE}"
        )
    inverted, ways = 0, []
    for color, mask in views:
        picture, mask = _small(color.float().mean(-1)), _small(mask)
        inverted += _is_inverted(mask)
        ways.append(_fitting_way(picture, mask))
    if inverted >= USUAL * len(views):
        raise DataError(
            f"{where}: {inverted} of {len(views)} sampled masks are white along the whole image "
            "border and black inside, so they seem to be inverted. Use masks that are white on "
            "the object and black elsewhere; `magick mogrify -negate masks/*.png` inverts them"
        )
    way = max(set(ways), key=ways.count)
    if way != 1 and len(ways) >= FEWEST and ways.count(way) >= USUAL * len(ways):
        raise DataError(
            f"{where}: {ways.count(way)} of {len(ways)} sampled masks fit their photographs only "
            f"when {WAYS[way]}: save the masks in the orientation of the stored pixels"
        )


def _is_inverted(mask: Tensor) -> bool:
    """Whether a mask keeps the border of the picture, and not all that is within."""
    rim = max(1, round(BORDER * min(mask.shape)))
    inner = mask[rim:-rim, rim:-rim]
    border = (mask.sum() - inner.sum()) / max(mask.numel() - inner.numel(), 1)
    return bool(inner.numel() and border >= MOST and 1 - inner.mean() >= HOLE)


def _fitting_way(picture: Tensor, mask: Tensor) -> int:
    """The orientation of EXIF by which a mask has to be turned to fit; 1 where none does better."""
    ways = range(1, 9 if mask.shape[0] == mask.shape[1] else 5)
    changes = {way: _change(picture, stored_from_upright(mask, way)) for way in ways}
    best = max(ways, key=changes.__getitem__)
    return best if changes[best] >= max(FITS, 2 * changes[1]) else 1


def premultiplied(views: Sequence[Sequence[Tensor]]) -> bool:
    """Whether stored colours of bright objects are never above alpha, where alpha is soft.

    Args:
        views: colours [H, W, 3] and alpha [H, W] of some photographs, of which only those of 8 bits
            are looked at.
    """
    above = count = 0
    for color, alpha in views:
        if color.dtype != torch.uint8 or alpha.dtype != torch.uint8 or not (alpha == 255).any():
            continue
        largest = color.amax(-1)
        usual = int(largest[alpha == 255].median())
        soft = (alpha >= 16) & (alpha <= 0.6 * usual)
        if usual >= BRIGHT:
            above += int((largest[soft] > alpha[soft]).sum())
            count += int(soft.sum())
    return count >= SOFT and above < 0.01 * count


def _small(values: Tensor) -> Tensor:
    """A picture [H, W] with at most 256 pixels along each side."""
    size = [min(n, 256) for n in values.shape]
    return interpolate(values[None, None], size, mode="area")[0, 0]


def _change(picture: Tensor, mask: Tensor) -> float:
    """How much a picture changes along the edge of a mask, over how much it does on average; of one
    size, or of one shape and resized."""
    if mask.shape != picture.shape:
        mask = interpolate(mask[None, None], picture.shape, mode="area")[0, 0]
    edge, change = (_steps(p) for p in (mask, picture))
    return float((edge * change).sum() / (edge.sum() * change.mean()).clamp_min(1e-9))


def _steps(values: Tensor) -> Tensor:
    """Sums of the differences to the next pixels, to the right and below: [H - 1, W - 1]."""
    here = values[:-1, :-1]
    return (values[1:, :-1] - here).abs() + (values[:-1, 1:] - here).abs()
