"""Random scenes of the bank: what is drawn for each, and its photographs and truth.

`python -m lab.bank.scenes FOLDER VARIANT` is the process that renders one, as of
`lab.stress.render`.
"""

from __future__ import annotations

import json
import math
import shutil
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal, TypeAlias, TypeVar

import numpy as np
from scipy import ndimage

from lab.bank import lights, materials, objects
from lab.bank.lights import tabulated
from lab.bank.materials import Class, Material
from lab.stress import render, scenes
from lab.stress.damage import Damage, damaged
from lab.stress.render import SPEC, Shot
from lab.stress.shapes import Part
from univoxel.camera import Cameras
from univoxel.data.images import read_image
from univoxel.data.transforms import write_cameras

Half: TypeAlias = Literal["tuning", "judging"]
Capture: TypeAlias = Literal["still", "light", "turntable", "flash"]

HALVES: tuple[Half, ...] = ("tuning", "judging")
COUNT = 64  # scenes of a bank
VERSION = 1  # of what is drawn from a seed
SIZE = 176  # pixels of the photographs
SAMPLES, TEST_SAMPLES = 20, 40  # paths per pixel
TESTS = 5  # test views
VIEWS = (24, 80)  # photographs, at least and at most
RELIGHT = ("first", "second")  # other lights that test views are relit under
TRUTH = "truth.json"
SPECKLE = 1.5
MIRROR = 0.15  # roughness below which a surface mirrors what is around it

# What is rare and decided on is dealt from decks: the scenes of a pair, one of each half, are alike
# in it, so that both halves ask the same questions equally often
CAPTURES: dict[Capture, int] = {"still": 17, "light": 5, "turntable": 6, "flash": 4}
CLASSES: dict[Class, int] = {"none": 14, "some": 11, "all": 7}
EXPOSURES = {False: 24, True: 8}
MASKS = {"true": 21, "wide": 4, "rough": 7}
DECKS = {"capture": CAPTURES, "metal": CLASSES, "exposures": EXPOSURES, "masks": MASKS}

K = TypeVar("K")


@dataclass(frozen=True)
class Drawn:
    """What a scene is, as far as it has a name."""

    seed: int
    index: int
    half: Half
    family: str  # of objects
    metal: Class  # how much of the object is
    light: str
    relight: tuple[str, str]
    capture: Capture
    cameras: str  # sphere, rings or side
    views: int
    exposures: bool  # whether they differ
    masks: str  # true, wide or rough
    noise: float
    jpeg: int | None


def name_of(index: int) -> str:
    return f"scene-{index:03d}"


def half_of(seed: int, index: int) -> Half:
    """One scene of each pair is to tune with; which, a coin of the seed says."""
    coin = np.random.default_rng([VERSION, seed, index // 2, 1]).integers(2)
    return HALVES[(index + int(coin)) % 2]


def chosen(seed: int, count: int, half: Half | None) -> list[int]:
    """The scenes of a bank, or of one half of it."""
    return [i for i in range(count) if half in (None, half_of(seed, i))]


def drawn(seed: int, index: int) -> Drawn:
    """A scene of the bank of a seed."""
    random = _random(seed, index, "scene")
    capture: Capture = dealt(CAPTURES, seed, index, 2)
    exposures = dealt(EXPOSURES, seed, index, 3) and capture != "light"
    kinds = list(random.choice(lights.KINDS, 3, replace=False, p=lights.SHARES))
    low, high = np.log(VIEWS)
    families = list(objects.FAMILIES)
    order = np.random.default_rng([VERSION, seed, index // len(families), 4]).permutation(families)
    cameras = "rings" if capture == "turntable" else random.choice(["sphere", "rings", "side"])
    return Drawn(
        seed=seed,
        index=index,
        half=half_of(seed, index),
        family=str(order[index % len(families)]),
        metal=dealt(CLASSES, seed, index, 5),
        light=str(kinds[0]),
        relight=(str(kinds[1]), str(kinds[2])),
        capture=capture,
        cameras=str(cameras),
        views=round(float(np.exp(random.uniform(low, high)))),
        exposures=exposures,
        masks=dealt(MASKS, seed, index, 6),
        noise=round(float(random.uniform(0.0, 0.02)), 4),
        jpeg=int(random.integers(80, 96)) if random.uniform() < 0.7 else None,
    )


def dealt(deck: dict[K, int], seed: int, index: int, which: int) -> K:
    """What the pair of a scene gets from a shuffled deck, which holds each so many times."""
    cards = [key for key, count in deck.items() for _ in range(count)]
    pair = index // 2
    order = np.random.default_rng([VERSION, seed, pair // len(cards), which])
    return cards[order.permutation(len(cards))[pair % len(cards)]]


def render_scene(seed: int, index: int, folder: Path) -> Path:
    """Write the data set of a scene, unless it is there.

    Raises:
        UserError, MissingExtra, ProcessFailed, OSError: as in `lab.stress.render.render`.
    """
    return render.render_in(__name__, identity(seed, index), folder)


def identity(seed: int, index: int) -> str:
    """What scene.json says, by which a rendered scene is known."""
    sizes = {"size": SIZE, "samples": SAMPLES, "tests": TESTS}
    fields = {"bank": VERSION, **sizes, **asdict(drawn(seed, index))}
    return json.dumps(fields, indent=1) + "\n"


def parts_of(scene: Drawn) -> list[Part]:
    """The object with its materials."""
    shape = _random(scene.seed, scene.index, "shape")
    names = objects.roles(scene.family, _random(scene.seed, scene.index, "shape"))
    random = _random(scene.seed, scene.index, "materials")
    found = materials_of_roles(scene.metal, names, random)
    return objects.object_of(scene.family, shape, found.__getitem__)


def materials_of_roles(
    kind: Class, names: Sequence[str], random: np.random.Generator
) -> dict[str, Material]:
    """A material for each role; where some is metal, at least one has some and one has other."""
    return dict(zip(names, _materials(kind, len(names), random), strict=True))


def _materials(kind: Class, count: int, random: np.random.Generator) -> list[Material]:
    if kind == "none":
        return [materials.dielectric(random) for _ in range(count)]
    if kind == "all":
        return [materials.metal(random) for _ in range(count)]
    if count == 1:
        return [materials.partly_metal(random)]
    makers = [materials.dielectric, (materials.metal, materials.partly_metal)[random.integers(2)]]
    makers += [materials.metal, materials.dielectric, materials.dielectric]
    order = [makers[k] if k < 2 else makers[int(random.integers(5))] for k in range(count)]
    return [order[k](random) for k in random.permutation(count)]


def cameras_of(scene: Drawn) -> tuple[Cameras, Cameras]:
    """Cameras to train on and of the test views, which stand between those."""
    random = _random(scene.seed, scene.index, "cameras")
    start, count = random.uniform(0, 2 * math.pi), scene.views
    index, tests = np.arange(count), np.arange(TESTS)
    share, between = (index + 0.5) / count, (tests + 0.5) / TESTS
    match scene.cameras:
        case "sphere":
            low, high = random.uniform(-0.3, 0.1), random.uniform(0.75, 0.95)
            around, aside = index * math.pi * (3 - math.sqrt(5)), 0.7 + 2.4 * tests
        case "rings":
            rings = int(random.integers(1 if scene.capture == "turntable" else 2, 4))
            low, high = random.uniform(-0.1, 0.2), random.uniform(0.55, 0.8)
            share = (index % rings + 0.5) / rings
            around = 2 * math.pi * (index + (index % rings) / rings) / count
            aside = 0.7 + 2.4 * tests
        case _:  # one side
            low, high = random.uniform(-0.1, 0.1), random.uniform(0.5, 0.85)
            wide = random.uniform(0.9, 1.4)
            around = wide * (2 * (index * 0.618 % 1) - 1)
            aside = 0.8 * wide * (2 * (tests * 0.618 % 1) - 1)
    z = np.clip(low + (high - low) * share + random.normal(0, 0.02, count), -0.5, 0.96)
    near = scenes.DISTANCE * random.uniform(1.0, 1.12, count)
    phi = start + around + random.normal(0, 0.03, count)
    target = random.normal(0, 0.03, (count, 3))
    if scene.capture == "turntable":  # the camera stands still
        z, near, target = low + (high - low) * share, np.full(count, near[0]), 0 * target
        phi = start + around
    train = scenes.looking(*_places(z, phi, near, target), SIZE)
    height, distance = low + (high - low) * (0.1 + 0.8 * between), np.full(TESTS, 1.05)
    test = _places(height, start + aside, distance * scenes.DISTANCE, np.zeros((TESTS, 3)))
    return train, scenes.looking(*test, SIZE)


def _places(
    z: np.ndarray, phi: np.ndarray, distance: np.ndarray, target: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Directions backwards and places of cameras [V, 3]."""
    r = np.sqrt(1 - z**2)
    back = np.stack([r * np.cos(phi), r * np.sin(phi), z], -1)
    return back, target + distance[:, None] * back


def shots_of(
    scene: Drawn, train: Cameras, test: Cameras
) -> tuple[list[Shot], dict[str, np.ndarray]]:
    """What is rendered, and the maps of its lights by name."""
    random = _random(scene.seed, scene.index, "light")
    main = lights.light(scene.light, random)
    others = [lights.light(kind, random) for kind in scene.relight]
    flash, share = 0.0, 1.0
    if scene.capture == "flash":
        part = random.uniform(0.5, 0.9)
        flash, share = math.pi * part * (1.05 * scenes.DISTANCE) ** 2, 1 - part
    maps = {"train": share * tabulated(main)}
    maps |= {name: tabulated(light) for name, light in zip(RELIGHT, others, strict=True)}
    turning = [turned_light(scene, train, cameras) for cameras in (train, test)]
    poles = share * tabulated(main, True)
    shots = [
        Shot("train", train, poles, SAMPLES, turning[0], flash),
        Shot("test", test, poles, TEST_SAMPLES, turning[1], flash),
    ]
    if scene.capture == "light":
        poles = tabulated(lights.light(str(random.choice(["room", "lamps"])), random), True)
        shots.append(Shot("varied/train", train, poles, SAMPLES))
    for name, light in zip(RELIGHT, others, strict=True):
        shots.append(Shot(f"relight/{name}", test, tabulated(light, True), TEST_SAMPLES))
    return shots, maps


def turned_light(scene: Drawn, train: Cameras, cameras: Cameras) -> np.ndarray | None:
    """Radians [V] that the light has turned by, seen from the object; None: it stands still."""
    if scene.capture != "turntable":
        return None
    x, y, _ = cameras.camera_to_world[:, :, 3].double().numpy().T
    first, other, _ = train.camera_to_world[0, :, 3].double().numpy()
    return np.arctan2(y, x) - np.arctan2(other, first)


def damage_of(scene: Drawn, stops: float) -> Damage:
    """How photographs differ from what was rendered.

    Args:
        stops: of the exposure.
    """
    random = _random(scene.seed, scene.index, "damage")
    return Damage(
        views=scene.views,
        stops=float(random.uniform(0.5, 1.2)) if scene.exposures else 0.0,
        light=float(random.uniform(0.6, 1.0)) if scene.capture == "light" else 0.0,
        dilation=1.0 if scene.masks == "wide" else 0.0,
        rough=float(random.uniform(0.5, 1.2)) if scene.masks == "rough" else 0.0,
        noise=scene.noise,
        exposure=stops,
    )


def work(folder: Path, variant: str) -> None:
    """Write the data set of folder/scene.json."""
    asked = json.loads((folder / SPEC).read_text(encoding="utf-8"))
    scene = drawn(asked["seed"], asked["index"])
    parts = parts_of(scene)
    train, test = cameras_of(scene)
    shots, maps = shots_of(scene, train, test)
    raw = folder / "raw"
    raw.mkdir()
    render.write_truth(raw, parts, {"train": train, "test": test}, maps)
    render.expose(raw, variant, [one_part(parts)], shots)
    for shot in shots:
        for path in (raw / shot.place).glob("*.exr"):
            render.write_picture(path, despeckled(read_image(path).numpy()))
    for name in RELIGHT:  # each as a camera meters it
        _scale(sorted((raw / "relight" / name).glob("*.exr")), raw / "envmaps" / f"{name}.exr")
    random = _random(scene.seed, scene.index, "meter")
    gain = metered(_read(raw / "train")) * 2 ** random.uniform(-0.4, 0.3)
    damage = damage_of(scene, math.log2(gain))
    second = None
    if damage.light:
        second = raw / "varied"
        write_cameras(second, "train", train, [render.name_of(v) for v in range(scene.views)])
        both = metered(_read(raw / "train")) / metered(_read(second / "train"))
        _scale(sorted((second / "train").glob("*.exr")), gain=both)
    turning = shots[0].azimuths
    behind = np.zeros(scene.views) if turning is None else turning
    made = damaged(raw, folder / "made", damage, scene.index, second, scene.jpeg, behind)
    _scale([made / "envmaps" / "train.exr"], gain=gain)
    shutil.rmtree(made / "varied", ignore_errors=True)
    shutil.rmtree(raw)
    for path in made.iterdir():
        path.rename(folder / path.name)
    made.rmdir()
    told = json.dumps(truth_of(folder, scene, parts, damage), indent=1)
    (folder / TRUTH).write_text(told + "\n", encoding="utf-8")


def one_part(parts: Sequence[Part]) -> Part:
    """All parts as one, of one material that varies: it renders several times as fast."""
    mesh = {key: value.numpy() for key, value in scenes.joined(parts).items()}
    values = [np.ascontiguousarray(mesh[key][:, 0]) for key in ("roughness", "metallic")]
    return Part(mesh["vertices"], mesh["faces"], mesh["normals"], mesh["base"], *values)


def truth_of(folder: Path, scene: Drawn, parts: Sequence[Part], damage: Damage) -> dict:
    """What there is to decide about a scene, as truth.json has it."""
    whole = np.concatenate([np.broadcast_to(p.metallic, len(p.vertices)) for p in parts])
    return {
        "drawn": asdict(scene),
        "damage": asdict(damage),
        "metal_of_parts": [round(float(np.mean(p.metallic)), 3) for p in parts],
        "roughness_of_parts": [round(float(np.mean(p.roughness)), 3) for p in parts],
        "all_metal": bool((whole > 0.5).mean() > 0.98),
        "exposures_differ": bool(damage.stops),
        "light_varies": bool(damage.light),
        "turntable": scene.capture == "turntable",
        "flash": scene.capture == "flash",
    }


def metered(pictures: np.ndarray) -> float:
    """The factor that shows an object as a camera does: its middle grey, its lights not clipped.

    Args:
        pictures: [V, H, W, 4] linear, premultiplied by alpha.
    """
    inside = pictures[pictures[..., 3] > 0.9]
    brightness = inside[:, :3].max(-1)
    return float(min(0.3 / np.quantile(brightness, 0.5), 0.9 / np.quantile(brightness, 0.9)))


def despeckled(picture: np.ndarray) -> np.ndarray:
    """A picture [H, W, 4] without single pixels that a rare path made bright.

    None is brighter than SPECKLE times the second brightest of its eight neighbours.
    """
    around = np.ones((3, 3), bool)
    around[1, 1] = False
    brightness = picture[..., :3].max(-1)
    limit = SPECKLE * ndimage.rank_filter(brightness, -2, footprint=around, mode="nearest")
    factor = np.minimum(1, limit / np.maximum(brightness, 1e-6))
    inside = ndimage.minimum_filter(picture[..., 3], 3) > 0.9  # edges are thin as they are
    return np.concatenate(
        [picture[..., :3] * np.where(inside, factor, 1)[..., None], picture[..., 3:]], -1
    ).astype(np.float32)


def _read(folder: Path) -> np.ndarray:
    return np.stack([read_image(path).numpy() for path in sorted(folder.glob("*.exr"))])


def _scale(paths: Sequence[Path], map: Path | None = None, gain: float | None = None) -> None:
    """Multiply pictures, and their map, by a factor; by what a camera would meter, if none."""
    if gain is None:
        gain = metered(np.stack([read_image(path).numpy() for path in paths]))
    for path in [*paths, *([] if map is None else [map])]:
        picture = read_image(path).numpy()
        factor = np.array([gain, gain, gain, 1.0][: picture.shape[-1]], np.float32)
        render.write_picture(path, picture * factor)


def _random(seed: int, index: int, what: str) -> np.random.Generator:
    """Random numbers of one aspect of a scene, whatever the others need."""
    return np.random.default_rng([VERSION, seed, index, *what.encode()])


if __name__ == "__main__":
    work(Path(sys.argv[1]), sys.argv[2])
