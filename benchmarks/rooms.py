"""`univoxel capture` from bare photographs of objects in furnished rooms, against their truth.

    python benchmarks/rooms.py --render [--only table] [--work ~/.cache/univoxel/rooms]
    python benchmarks/rooms.py [--only table] [--out benchmarks/results/preparation/rooms.json]
    python benchmarks/rooms.py --only table --width 640 --out FILE.json

Six objects of lab/bank on six supports, rendered by Mitsuba: 40 photographs of 1600 x 1200 pixels
from all around, as JPEG files with the EXIF of a phone, with noise, and exposures up to half a stop
apart. The border cuts the object in a third of them. --render makes them only; a photograph that
is there is not made again. Mitsuba wants LLVM 16 or later: DRJIT_LIBLLVM_PATH says where it is.

`capture` makes a `draft` of each room, with masks from --masks. Beside it a `draft` is trained on
the same photographs with true masks and cameras. IoU is that of the masks with the true
silhouettes. Chamfer distances are shares of the object's largest extent, after a similarity of the
cameras. An object is whole where 95 % of the true surface is found within 3 % of that extent.
"""

from __future__ import annotations

import argparse
import math
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import torch
from made import made
from PIL import Image
from poses import FOCAL, FOCAL_35MM, FOCAL_OF_35MM, HEIGHT, LONG, MODEL, WIDTH, similarity
from scipy import ndimage
from scipy.spatial import KDTree
from torch import Tensor

import univoxel
from lab.bank import lights, materials, objects
from lab.bank.lights import tabulated
from lab.bank.materials import Class, Material
from lab.bank.scenes import RELIGHT, TEST_SAMPLES, despeckled, materials_of_roles, one_part
from lab.record import result_text
from lab.stress import render, scenes
from lab.stress.render import VARIANTS, Shot
from lab.stress.shapes import Part
from univoxel.camera import Cameras, image_rays
from univoxel.cli.capture import PicturesConfig, capture
from univoxel.color import linear_to_srgb
from univoxel.data import load_photos
from univoxel.data.images import read_image, write_png
from univoxel.data.transforms import write_cameras
from univoxel.envmap import EnvMap, lookup
from univoxel.errors import UserError
from univoxel.ops import VisibilityScene
from univoxel.render.pipeline import extract_mesh
from univoxel.run import photos_of
from univoxel.scene import load_checkpoint

HERE = Path(__file__).parent


@dataclass(frozen=True)
class Room:
    """An object, what it is made of, and what it stands on."""

    name: str  # of the support
    family: str
    metal: Class
    top: tuple[float, float]  # half extents of the support, world units
    height: float  # of the support above the floor
    seed: int


METRE = 5.0  # world units; an object is a third of a metre large
ROOMS = (
    Room("table", "mug", "none", (3.5, 2.5), 3.7, 11),
    Room("counter", "bottle", "some", (5.0, 1.6), 4.5, 2),
    Room("stool", "animal", "none", (0.9, 0.9), 2.4, 3),
    Room("rug", "car", "some", (4.0, 3.0), 0.05, 4),
    Room("cabinet", "pot", "all", (2.0, 1.2), 4.2, 5),
    Room("box", "trophy", "none", (1.4, 1.4), 2.0, 6),
)
VIEWS, FULL = 40, 1600  # photographs, and pixels of their longer side
FOCAL_LENGTH = 0.8  # in widths of a picture: 28 mm
SAMPLES = 4  # paths per pixel of full photographs: few, as what they leave is smoothed
SMOOTH = 6.0  # pixels of full photographs that light is smoothed by, a standard deviation
SOFT = 0.9  # pixels that a lens and a phone's software blur by, a standard deviation
BRIGHTEST = 1.5  # radiance of a pixel before the blur; 1 is white
DEPTH = 4  # most segments of a path
NOISE, QUALITY, STOPS = 0.012, 92, 0.5
DETAIL = 2.0  # of objects in full photographs, against those of the bank
TESTS, TEST_SIZE = 5, 320  # relit views
POINTS = 20_000
NEAR, WHOLE = 0.03, 0.95  # share of the extent, and of the true surface
COLUMNS = [
    {"name": "support"},
    {"name": "object"},
    {"name": "placed"},
    {"name": "mean IoU", "digits": 3},
    {"name": "worst IoU", "digits": 3},
    {"name": "Chamfer", "unit": "%", "digits": 2},
    {"name": "Chamfer, true masks and cameras", "unit": "%", "digits": 2},
    {"name": "relit", "unit": "dB", "digits": 1},
    {"name": "relit, true masks and cameras", "unit": "dB", "digits": 1},
    {"name": "difference", "unit": "dB", "digits": 1},
    {"name": "whole"},
]


def object_of(room: Room, width: int) -> list[Part]:
    """The parts of a room's object."""
    random = np.random.default_rng(room.seed)
    names = objects.roles(room.family, np.random.default_rng(room.seed))
    found = materials_of_roles(room.metal, names, np.random.default_rng([room.seed, 1]))
    return objects.object_of(room.family, random, found.__getitem__, DETAIL * width / FULL)


def cameras_of(room: Room, width: int) -> Cameras:
    """A walk around the object, up and down; the border cuts it in every third photograph."""
    random = np.random.default_rng([room.seed, 2])
    view = np.arange(VIEWS)
    phi = 2 * math.pi * view / VIEWS + random.normal(0, 0.04, VIEWS)
    up = np.radians(31 + 14 * np.sin(3 * phi) + random.normal(0, 2, VIEWS))
    distance = random.uniform(3.0, 3.6, VIEWS)
    back = np.stack([np.cos(up) * np.cos(phi), np.cos(up) * np.sin(phi), np.sin(up)], -1)
    right = np.stack([-np.sin(phi), np.cos(phi), np.zeros(VIEWS)], -1)
    cut = view % 3 == 2
    aside = np.where(cut, random.choice([-1, 1], VIEWS) * random.uniform(1.7, 2.0, VIEWS), 0.0)
    target = random.normal(0, 0.08, (VIEWS, 3)) + (aside * distance / 3.3)[:, None] * right
    return _wide(scenes.looking(back, target + distance[:, None] * back, width))


def _wide(cameras: Cameras) -> Cameras:
    """The same with a phone's picture."""
    width, height = cameras.width, cameras.width * 3 // 4
    return replace(
        cameras,
        focal=torch.full_like(cameras.focal, FOCAL_LENGTH * width),
        centre=torch.tensor([[width / 2, height / 2]]).expand(len(cameras), 2).clone(),
        height=height,
    )


def test_cameras(room: Room) -> Cameras:
    view = np.arange(TESTS)
    z, phi = 0.2 + 0.6 * (view + 0.5) / TESTS, 0.5 + 2.4 * view
    back = np.stack([np.sqrt(1 - z**2) * np.cos(phi), np.sqrt(1 - z**2) * np.sin(phi), z], -1)
    return scenes.looking(back, 1.05 * scenes.DISTANCE * back, TEST_SIZE)


# The room: every surface a grid of coloured vertices, all of them one mesh of one material.


Sheet: TypeAlias = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]


def sheet(corner, u, v, spacing: float, material: Material) -> Sheet:
    """A rectangle that faces along u x v: vertices, faces, normals, base colour and roughness."""
    corner, u, v = (np.asarray(x, float) for x in (corner, u, v))
    across, along = (max(2, round(float(np.linalg.norm(x)) / spacing) + 1) for x in (u, v))
    a, b = np.meshgrid(np.linspace(0, 1, across), np.linspace(0, 1, along), indexing="ij")
    points = corner + a[..., None] * u + b[..., None] * v
    points = points.reshape(-1, 3)
    index = np.arange(across * along).reshape(across, along)
    one, two, three, four = (
        x.ravel() for x in (index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:])
    )
    faces = np.concatenate([np.stack([one, two, three], 1), np.stack([one, three, four], 1)])
    normal = np.cross(u, v) / np.linalg.norm(np.cross(u, v))
    normals = np.broadcast_to(normal, points.shape)
    base, roughness, _ = material(points, normals)
    return points, faces, normals, base, roughness


def crate(low, high, spacing: float, material: Material) -> list[Sheet]:
    """A box without its underside."""
    low, (x, y, z) = np.array(low, float), np.array(high, float) - np.array(low, float)
    ex, ey, ez = np.diag([x, y, z])
    sides = [(low + ez, ex, ey), (low, ex, ez), (low + ex, ey, ez)]
    sides += [(low + ex + ey, -ex, ez), (low + ey, -ey, ez)]
    return [sheet(corner, u, v, spacing, material) for corner, u, v in sides]


def half_of(room: Room) -> np.ndarray:
    """Of the room's floor, [2]."""
    return np.random.default_rng([room.seed, 7]).uniform(1.8, 2.4, 2) * METRE


def furniture(room: Room, floor: float, width: int) -> Part:
    """Walls, floor, support and what else is in the room.

    Args:
        floor: its z; the support's top is `room.height` above it.
        width: of the photographs, pixels; vertices are as near as they need.
    """
    random, coarser = np.random.default_rng([room.seed, 3]), FULL / width
    half, tall = half_of(room), 2.6 * METRE
    low, high = np.array([*-half, floor]), np.array([*half, floor + tall])
    x, y, z = np.diag(high - low)

    def worn(scale: float, material: Material, amount: float = 0.25) -> Material:
        """A material of another scale, with the small marks that all things have."""
        marks = materials.noise(random, 6.0, 3)

        def found(p: np.ndarray, n: np.ndarray):
            base, roughness, metallic = material(p * scale, n)
            return np.clip(base * (1 + amount * marks(p))[:, None], 0.02, 0.9), roughness, metallic

        return found

    def planks(scale: float) -> Material:
        """Wood whose grain is along x."""
        grain = materials.wood(random)
        turn = np.array([[0, 0, 0.2], [1, 0, 0], [0, 1, 0]])
        return worn(scale, lambda p, n: grain(p @ turn + [3.0, 0, 0], n))

    def some(scale: float = 0.4) -> Material:
        return worn(scale, materials.dielectric(random))

    pale = random.uniform(0.55, 0.75) * np.array([1.0, 0.97, 0.92])
    wall = worn(1, materials.uniform(pale, 0.8, 0.0), 0.05)
    sheets = [sheet(low, x, y, 0.05 * coarser, planks(0.3))]
    sheets.append(sheet(low + z, y, x, 0.2 * coarser, wall))
    for corner, along in ((low, y), (low + x, -x), (low + x + y, -y), (low + y, x)):
        sheets.append(sheet(corner, along, z, 0.08 * coarser, wall))
        for _ in range(3):  # pictures on the walls
            size, place = random.uniform(0.3, 0.8, 2) * METRE, random.uniform(0.05, 0.75)
            inwards = np.cross(along, z)
            lower = corner + place * along + 0.45 * z + 0.05 * inwards / np.linalg.norm(inwards)
            wide = size[1] * along / np.linalg.norm(along)
            sheets.append(sheet(lower, wide, size[0] * z / tall, 0.06 * coarser, some()))
    for _ in range(9):  # along the walls
        size = random.uniform([0.3, 0.3, 0.4], [1.0, 0.6, 1.9]) * METRE
        corner = low + random.uniform(size=3) * (high - low - size)
        side = random.integers(2)
        corner[side] = (low, high - size)[random.integers(2)][side]
        corner[2] = floor
        sheets += crate(corner, corner + size, 0.08 * coarser, some())
        for _ in range(4):  # books and boxes on it
            small = random.uniform(0.05, 0.25, 3) * METRE
            spot = corner + random.uniform(size=3) * (size - small)
            spot[2] = corner[2] + size[2]
            sheets += crate(spot, spot + small, 0.05 * coarser, some(1.0))
    a, b = room.top
    top = floor + room.height
    thick = min(0.2, room.height)
    sheets += crate(
        (-a, -b, top - thick),
        (a, b, top),
        0.012 * coarser,
        planks(0.5) if room.seed % 2 else some(0.6),
    )
    if room.name in ("cabinet", "box", "counter"):
        sheets += crate((-a, -b, floor), (a, b, top - thick), 0.04 * coarser, some())
    elif room.height > 1:  # legs
        wide = np.array([0.1, 0.1, 0])
        for sx in (-1, 1):
            for sy in (-1, 1):
                leg = np.array([sx * (a - 0.2), sy * (b - 0.2), floor])
                sheets += crate(
                    leg - wide, leg + wide + [0, 0, room.height - thick], 0.05 * coarser, some()
                )
    starts = np.cumsum([0, *(len(s[0]) for s in sheets[:-1])])
    faces = np.concatenate([s[1] + start for s, start in zip(sheets, starts, strict=True)])
    points, normals, base, roughness = (
        np.concatenate([s[k] for s in sheets]).astype(np.float32) for k in (0, 2, 3, 4)
    )
    return Part(points, faces.astype(np.int32), normals, base, roughness)


def lamps(room: Room, floor: float) -> list[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]]:
    """Panes of windows and a lamp: corner, two sides, and radiance; they face along u x v."""
    random = np.random.default_rng([room.seed, 4])
    half, wide, tall = half_of(room) - 0.1, 0.6 * METRE, 0.6 * METRE
    low = floor + 0.9 * METRE
    tint = random.uniform([0.8, 0.9, 1.0], [1.0, 1.0, 1.15])
    found = []
    for k in range(int(random.integers(1, 3))):
        radiance = random.uniform(6, 10) * tint
        middle = random.uniform(-0.4, 0.4)
        for column in (-1.1, 0.1):
            for row in (0.0, 1.1):
                z, place = low + row * tall, middle * half[1 - k] + column * wide
                if k == 0:
                    corner, along = np.array([-half[0], place, z]), np.array([0, wide, 0])
                else:
                    corner, along = np.array([place + wide, -half[1], z]), np.array([-wide, 0, 0])
                found.append((corner, along, np.array([0, 0, tall]), radiance))
    size = 0.5 * METRE
    corner = np.array([random.uniform(-2, 2), random.uniform(-2, 2), floor + 2.5 * METRE])
    warm = np.array([1.0, 0.85, 0.65]) * random.uniform(6, 12)
    found.append((corner, np.array([0, size, 0]), np.array([size, 0, 0]), warm))
    return found


def render_room(room: Room, folder: Path, width: int, variant: str) -> None:
    """Write photographs and truth, as far as they are not there."""
    mi = render.started(variant)
    parts, cameras = object_of(room, width), cameras_of(room, width)
    whole = one_part(parts)
    floor = float(whole.vertices[:, 2].min()) - room.height
    write_truth(room, folder, parts, cameras, variant)
    missing = [v for v in range(VIEWS) if not photograph(folder, v).exists()]
    if not missing:
        return
    emitters = {}
    for k, (corner, u, v, radiance) in enumerate(lamps(room, floor)):
        normal = np.cross(u, v)
        matrix = np.eye(4)
        matrix[:3] = np.stack([u / 2, v / 2, normal, corner + (u + v) / 2], 1)
        emitters[f"lamp{k}"] = {
            "type": "rectangle",
            "to_world": mi.ScalarTransform4f(matrix.tolist()),
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": radiance.tolist()}},
        }
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {
                "type": "aov",
                "aovs": "colour:albedo",
                "image": {"type": "path", "max_depth": DEPTH},
            },
            "object": render.mesh_of(mi, "object", whole),
            "room": render.mesh_of(mi, "room", furniture(room, floor, width)),
            **emitters,
        }
    )
    gain = None
    for view in missing:
        one = cameras.of(torch.tensor([view]))
        if gain is None:  # of a first look, metered as a phone does: on the whole picture
            by = width / 100
            small = replace(one, focal=one.focal / by, centre=one.centre / by, width=100, height=75)
            look = pictured(mi, scene, small, 64)[..., :3]
            gain = 0.2 / float(np.median(look.max(-1)))
        inside = np.array(Image.open(folder / "silhouettes" / f"IMG_{view:03d}.png")) > 127
        picture = smoothed(pictured(mi, scene, one, round(SAMPLES * FULL / width)), inside)
        save_photograph(photograph(folder, view), gain * picture, room, view)
        print(room.name, view, flush=True)


def pictured(mi: Any, scene: Any, camera: Cameras, samples: int) -> np.ndarray:
    """[H, W, 7] of one camera: linear colour, alpha, and the colour of what is there."""
    film = {
        "type": "hdrfilm",
        "width": camera.width,
        "height": camera.height,
        "component_format": "float32",
        "pixel_format": "rgba",
        "rfilter": {"type": "box"},
    }
    sensor = mi.load_dict(render.sensor_of(mi, camera, 0) | {"film": film})
    return np.array(mi.render(scene, sensor=sensor, spp=samples))


def smoothed(picture: np.ndarray, inside: np.ndarray) -> np.ndarray:
    """Linear colour [H, W, 3] with less noise: light is smoothed, and what it shines on is not.

    Args:
        picture: as in `pictured`.
        inside: [H, W] the object's silhouette, across which nothing is smoothed.
    """
    shown, colour = despeckled(picture[..., :4])[..., :3], picture[..., 4:] + 0.02
    light, reach = shown / colour, SMOOTH * picture.shape[1] / FULL
    found = np.zeros_like(light)
    for region in (inside, ~inside):
        weight = region[..., None].astype(np.float32)
        total, share = (
            np.asarray(ndimage.gaussian_filter(x, (reach, reach, 0)))
            for x in (light * weight, weight)
        )
        found += weight * total / np.maximum(share, 1e-6)
    window = picture[..., 4:].max(-1, keepdims=True) < 0.01  # and lamps, which have no colour
    return np.where(window, shown, found * colour)


def photograph(folder: Path, view: int) -> Path:
    return folder / "photographs" / f"IMG_{view:03d}.jpg"


def save_photograph(path: Path, linear: np.ndarray, room: Room, view: int) -> None:
    """As a phone would: exposure, a soft lens, noise, JPEG, EXIF."""
    random = np.random.default_rng([room.seed, 5, view])
    bright = np.minimum(linear[..., :3] * 2 ** random.uniform(-STOPS, STOPS), BRIGHTEST)
    soft = np.asarray(ndimage.gaussian_filter(bright, (SOFT, SOFT, 0)))
    encoded = linear_to_srgb(torch.from_numpy(soft)).numpy()
    encoded = encoded + NOISE * random.standard_normal(encoded.shape)
    picture = Image.fromarray(np.round(255 * encoded.clip(0, 1)).astype(np.uint8))
    exif = Image.Exif()
    exif[MODEL] = "Phone"
    exif.get_ifd(0x8769).update(
        {
            FOCAL: 4.3,
            FOCAL_35MM: round(FOCAL_OF_35MM * FOCAL_LENGTH),
            WIDTH: picture.width,
            HEIGHT: picture.height,
        }
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_suffix(".partial")
    picture.save(partial, "JPEG", quality=QUALITY, exif=exif)
    partial.rename(path)


def write_truth(
    room: Room, folder: Path, parts: Sequence[Part], cameras: Cameras, variant: str
) -> None:
    """Silhouettes, the points of the surface, and relit views, unless they are there."""
    truth, tests = folder / "truth", test_cameras(room)
    if not (truth / "transforms_test.json").exists():
        random = np.random.default_rng([room.seed, 6])
        kinds = ("room", "sky")
        found = {n: lights.light(k, random) for n, k in zip(RELIGHT, kinds, strict=True)}
        (truth / "test").mkdir(parents=True, exist_ok=True)
        shots = [
            Shot(f"relight/{n}", tests, tabulated(f, True), TEST_SAMPLES) for n, f in found.items()
        ]
        shots.append(replace(shots[0], place="test"))
        render.expose(truth, variant, [one_part(parts)], shots)
        maps = {name: tabulated(light) for name, light in found.items()}
        render.write_truth(
            truth, parts, {"train": cameras.of(torch.arange(0)), "test": tests}, maps
        )
    masks = folder / "silhouettes"
    masks.mkdir(exist_ok=True)
    mesh = scenes.joined(parts)
    scene = VisibilityScene(mesh["vertices"], mesh["faces"])
    for view in range(VIEWS):
        path = masks / f"IMG_{view:03d}.png"
        if not path.exists():
            rays = image_rays(cameras, view)
            hit = scene.closest_hit(rays.origin, rays.direction).face >= 0
            write_png(path, (255 * hit.reshape(cameras.height, cameras.width)).byte())


# What a capture made of it.


def true_data(room: Room, folder: Path, width: int) -> Path:
    """The photographs with true masks and cameras, as a data set."""
    out, cameras = folder / "true", cameras_of(room, width)
    if not (out / "transforms_train.json").exists():
        (out / "train").mkdir(parents=True, exist_ok=True)
        names = [f"IMG_{v:03d}" for v in range(VIEWS)]
        for view, name in enumerate(names):
            picture = Image.open(photograph(folder, view)).convert("RGB")
            picture.putalpha(Image.open(folder / "silhouettes" / f"{name}.png").convert("L"))
            picture.save(out / "train" / f"{name}.png", compress_level=1)
        write_cameras(out, "train", cameras, names)
    return out


def overlaps(cut: Path, folder: Path) -> list[float]:
    """Intersection over union with the true silhouettes, of each photograph that has a mask."""
    found = []
    photos = load_photos(cut, "train")
    for view, name in enumerate(photos.names):
        width, height = photos.cameras.size(view)
        path = folder / "silhouettes" / f"{Path(name).stem}.png"
        true = np.array(Image.open(path).convert("L").resize((width, height), Image.Resampling.BOX))
        a, b = photos.picture(view)[1].numpy() >= 0.5, true >= 128
        found.append(float((a & b).sum() / max((a | b).sum(), 1)))
    return found


def aligned(room: Room, run: Path) -> tuple[float, np.ndarray, np.ndarray]:
    """The similarity from a run's world to the true one, by the cameras of its photographs."""
    scene, _ = load_checkpoint(run)
    photos = scene.registered(photos_of(run, split="train"))
    ours = photos.cameras.camera_to_world.double().numpy()
    views = [int(Path(name).stem[4:7]) for name in photos.names]
    wanted = cameras_of(room, FULL).camera_to_world.double().numpy()[views]
    return similarity(ours, wanted)


def surface_errors(
    run: Path, true: Tensor, into: tuple[float, np.ndarray, np.ndarray]
) -> tuple[float, float]:
    """Chamfer distance as a share of the extent, and the share of the true surface found."""
    scale, turn, shift = into
    mesh = extract_mesh(load_checkpoint(run)[0])
    corners = scale * mesh.vertices.double().numpy() @ turn.T + shift
    faces = corners[mesh.faces.long().numpy()]
    area = np.linalg.norm(np.cross(faces[:, 1] - faces[:, 0], faces[:, 2] - faces[:, 0]), axis=1)
    random = np.random.default_rng(0)
    chosen = faces[random.choice(len(faces), POINTS, p=area / area.sum())]
    weight = random.dirichlet(np.ones(3), POINTS)
    ours, points = (weight[..., None] * chosen).sum(1), true.double().numpy()
    extent = float(np.ptp(points, 0).max())
    there, back = KDTree(points).query(ours)[0], KDTree(ours).query(points)[0]
    return float(there.mean() + back.mean()) / 2 / extent, float((back < NEAR * extent).mean())


def relit(
    room: Room, run: Path, folder: Path, into: tuple[float, np.ndarray, np.ndarray], work: Path
) -> float:
    """PSNR of relit views, the true cameras and maps brought into the run's world."""
    scale, turn, shift = into
    truth, cameras = folder / "truth", test_cameras(room)
    pose = cameras.camera_to_world.double().numpy()
    place = (pose[:, :, 3] - shift) @ turn / scale
    moved = np.concatenate([turn.T @ pose[:, :, :3], place[..., None]], -1)
    moved = replace(cameras, camera_to_world=torch.from_numpy(moved).float())
    names = [render.name_of(v) for v in range(TESTS)]
    (work / "test" / "gt").mkdir(parents=True, exist_ok=True)
    write_cameras(work, "test", moved, names)
    for name in names:
        with np.load(truth / "test" / "gt" / f"{name}.npz") as arrays:
            kept = {key: arrays[key] for key in ("alpha", "albedo", "roughness")}
        np.savez_compressed(work / "test" / "gt" / f"{name}.npz", **kept)
    for path in [*truth.glob("test/*.exr"), *truth.glob("relight/*/*.exr")]:
        target = work / path.relative_to(truth)
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(path.read_bytes())
    (work / "envmaps").mkdir(exist_ok=True)
    for name in RELIGHT:
        map = EnvMap(read_image(truth / "envmaps" / f"{name}.exr"))
        direction = torch.from_numpy(scenes.directions_of_map(lights.MAP_HEIGHT, False) @ turn.T)
        seen = lookup(map, direction.float().reshape(-1, 3)).reshape(direction.shape)
        render.write_picture(work / "envmaps" / f"{name}.exr", seen.numpy())
    found = univoxel.open_run(run).evaluate(data=work)["relit_psnr"]
    assert found is not None, f"{work}: expected relit views"
    return float(found)


def row_of(room: Room, folder: Path, width: int, masks: str) -> list[object]:
    """A value for each of COLUMNS; None if capture failed."""
    points = torch.from_numpy(np.load(folder / "truth" / "points.npz")["points"])
    best = folder / "best"
    if not (best / "trust.txt").exists():
        univoxel.train(true_data(room, folder, width), best, preset="draft", minutes=LONG)
    same = (1.0, np.eye(3), np.zeros(3))
    wanted, _ = surface_errors(best, points, same)
    wanted_db = relit(room, best, folder, same, folder / "best-tests")
    out = folder / f"capture-{masks}"
    row: list[object] = [room.name, room.family]
    try:
        capture(
            folder / "photographs",
            out,
            masks=masks,
            preset="draft",
            minutes=LONG,
            pictures=PicturesConfig(frames=1, resolution=128, samples=8),
        )
    except UserError as error:
        print(f"{room.name}: {error}", flush=True)
        nothing = [None, None, None, None, 100 * wanted, None, wanted_db, None]
        return [*row, *nothing, "no: failed"]
    run = out / "run"
    cut = out / "cut" if (out / "cut").exists() else out / "scene"
    found, into = overlaps(cut, folder), aligned(room, run)
    chamfer, share = surface_errors(run, points, into)
    db = relit(room, run, folder, into, folder / f"capture-{masks}-tests")
    row += [f"{len(found)} of {VIEWS}", sum(found) / len(found), min(found)]
    row += [100 * chamfer, 100 * wanted, db, wanted_db, db - wanted_db]
    return [*row, "yes" if share > WHOLE else f"no: {share:.0%}"]


def rendered(room: Room, folder: Path, width: int) -> None:
    """Render a room in a process of its own, with the first variant of Mitsuba that works."""
    folder.mkdir(parents=True, exist_ok=True)
    for variant in VARIANTS:
        command = [
            sys.executable,
            __file__,
            "--process",
            room.name,
            str(folder),
            str(width),
            variant,
        ]
        if subprocess.run(command, check=False).returncode == 0:
            return
    raise SystemExit(f"{folder}: Mitsuba could not render it")


def main() -> None:
    """Render, or measure and write the table."""
    if sys.argv[1:2] == ["--process"]:
        name, folder, width, variant = sys.argv[2:]
        room = next(r for r in ROOMS if r.name == name)
        return render_room(room, Path(folder), int(width), variant)
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--render", action="store_true", help="only photographs and truth")
    names = [room.name for room in ROOMS]
    parser.add_argument("--only", nargs="+", choices=names, default=names)
    parser.add_argument("--width", type=int, default=FULL, help="of the photographs, pixels")
    parser.add_argument("--masks", default="auto", help="as of capture")
    parser.add_argument("--work", type=Path, default=Path.home() / ".cache/univoxel/rooms")
    parser.add_argument("--out", type=Path, default=HERE / "results/preparation/rooms.json")
    args = parser.parse_args()
    rows = []
    for room in (r for r in ROOMS if r.name in args.only):
        folder = args.work / (room.name if args.width == FULL else f"{room.name}-{args.width}")
        rendered(room, folder, args.width)
        if not args.render:
            rows.append(row_of(room, folder, args.width, args.masks))
            print(rows[-1], flush=True)
    if args.render:
        return None
    title = "`capture` from bare photographs in furnished rooms, `draft`"
    record = {"title": title, **made(), "columns": COLUMNS, "rows": rows}
    args.out.parent.mkdir(parents=True, exist_ok=True)
    args.out.write_text(result_text(record), encoding="utf-8")
    return None


if __name__ == "__main__":
    main()
