"""The same photographs and cameras written in every layout, each from its own description."""

import json
import math
import struct
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from analytic import look_at
from PIL import ExifTags, Image
from scipy.spatial.transform import Rotation

from univoxel.data import load_photos
from univoxel.data.images import write_png
from univoxel.errors import DataError

WIDTH, HEIGHT, FOCAL = 12, 8, 11.0
MODELS = {"SIMPLE_PINHOLE": 0, "PINHOLE": 1, "SIMPLE_RADIAL": 2, "RADIAL": 3, "OPENCV": 4}


@dataclass(frozen=True)
class Scene:
    poses: np.ndarray  # [V, 4, 4] camera-to-world, OpenGL axes
    pictures: np.ndarray  # [V, H, W, 4] uint8

    @property
    def names(self) -> list[str]:
        return [f"p_{v:03d}" for v in range(len(self.poses))]

    def split(self, split: str) -> list[int]:
        return [v for v in range(len(self.poses)) if (v % 8 == 0) == (split == "test")]

    def turned(self, rotation: Rotation) -> "Scene":
        """The same in a world that is turned."""
        turn = np.eye(4)
        turn[:3, :3] = rotation.as_matrix()
        return replace(self, poses=turn @ self.poses)


def scene(views: int = 10, width: int = WIDTH, height: int = HEIGHT) -> Scene:
    """Level cameras around the origin, random pictures."""
    generator = np.random.default_rng(0)
    poses = np.tile(np.eye(4), (views, 1, 1))
    for v in range(views):
        phi, up = 2.4 * v, 0.2 + 0.1 * (v % 4)
        place = [math.cos(phi), math.sin(phi), math.tan(up)]
        poses[v, :3] = look_at(3 * torch.tensor(place)).numpy()
    pictures = generator.integers(1, 256, (views, height, width, 4), dtype=np.uint8)
    return Scene(poses, pictures)


def angle(focal: float = FOCAL, width: int = WIDTH) -> float:
    return 2 * math.atan(width / 2 / focal)


def write_nerf(folder: Path, scene: Scene) -> Path:
    for split in ("train", "test"):
        (folder / split).mkdir(parents=True)
        frames = []
        for v in scene.split(split):
            name = f"{split}/{scene.names[v]}"
            write_png(folder / f"{name}.png", scene.pictures[v])
            frames.append({"file_path": f"./{name}", "transform_matrix": scene.poses[v].tolist()})
        text = json.dumps({"camera_angle_x": angle(), "frames": frames})
        (folder / f"transforms_{split}.json").write_text(text)
    return folder


def write_nerfstudio(folder: Path, scene: Scene, **root) -> Path:
    """Photographs without alpha and masks by mask_path; frames in no order."""
    write_pictures(folder, scene, "images", "masks")
    frames = []
    for v, name in reversed(list(enumerate(scene.names))):
        files = {"file_path": f"images/{name}.png", "mask_path": f"masks/{name}.png"}
        frames.append({**files, "transform_matrix": scene.poses[v].tolist()})
    height, width = scene.pictures.shape[1:3]
    camera = {"camera_model": "OPENCV", "fl_x": FOCAL, "fl_y": FOCAL, "w": width, "h": height}
    camera |= {"cx": width / 2, "cy": height / 2, "k1": 0.0, "p2": 0.0, "aabb_scale": 16}
    text = json.dumps(camera | {"frames": frames} | root)
    (folder / "transforms.json").write_text(text)
    return folder


def write_colmap(
    folder: Path,
    scene: Scene,
    place: str = "sparse/0",
    text: bool = False,
    model: str = "SIMPLE_PINHOLE",
    parameters: tuple[float, ...] = (FOCAL, WIDTH / 2, HEIGHT / 2),
) -> Path:
    """Photographs without alpha, masks by COLMAP's naming, images in no order."""
    write_pictures(folder, scene, "images", "masks", pad=".png")
    (folder / place).mkdir(parents=True, exist_ok=True)
    height, width = scene.pictures.shape[1:3]
    rows = []
    for v, name in reversed(list(enumerate(scene.names))):
        # x right, y down, z forward; from the world to the camera
        to_world = scene.poses[v, :3, :3] * [1, -1, -1]
        x, y, z, w = Rotation.from_matrix(to_world.T).as_quat()
        rows.append((v + 5, (w, x, y, z), -to_world.T @ scene.poses[v, :3, 3], f"{name}.png"))
    if text:
        numbers = " ".join(map(str, parameters))
        head = "# Camera list\n#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n"
        camera = f"3 {model} {width} {height} {numbers}\n"
        (folder / place / "cameras.txt").write_text(head + camera)
        lines = ["# Image list with two lines of data per image:"]
        for i, (number, q, t, name) in enumerate(rows):
            values = " ".join(repr(float(value)) for value in (*q, *t))
            lines += [f"{number} {values} 3 {name}", "1.5 2.5 -1 3.5 4.5 7" if i % 2 else ""]
        (folder / place / "images.txt").write_text("\n".join(lines) + "\n")
        return folder
    data = struct.pack("<Q", 1) + struct.pack("<iiQQ", 3, MODELS[model], width, height)
    data += struct.pack(f"<{len(parameters)}d", *parameters)
    (folder / place / "cameras.bin").write_bytes(data)
    data = struct.pack("<Q", len(rows))
    for i, (number, q, t, name) in enumerate(rows):
        data += struct.pack("<I", number) + struct.pack("<7d", *q, *t) + struct.pack("<I", 3)
        data += name.encode() + b"\0" + struct.pack("<Q", i % 2) + bytes(24 * (i % 2))
    (folder / place / "images.bin").write_bytes(data)
    return folder


def write_llff(folder: Path, scene: Scene, original: int = 1, place: str = "images") -> Path:
    """Photographs without alpha; rows that describe originals `original` times as large."""
    write_pictures(folder, scene, place, place.replace("images", "masks"))
    height, width = scene.pictures.shape[1:3]
    rows = []
    for pose in scene.poses:
        right, up, back, position = pose[:3].T
        size_and_focal = original * np.array([height, width, FOCAL])
        camera = np.stack([-up, right, back, position, size_and_focal], 1)
        rows.append([*camera.ravel(), 1.0, 9.0])
    np.save(folder / "poses_bounds.npy", np.array(rows))
    return folder


def to_camera(pose: np.ndarray) -> np.ndarray:
    """From the world to a camera with the axes x right, y down, z forward: [4, 4]."""
    right, up, back, position = pose[:3].T
    rotation = np.stack([right, -up, -back])
    return np.block([[rotation, -rotation @ position[:, None]], [0, 0, 0, 1]])


def write_pictures(folder: Path, scene: Scene, images: str, masks: str, pad: str = "") -> None:
    for place in (images, masks):
        (folder / place).mkdir(parents=True, exist_ok=True)
    for name, picture in zip(scene.names, scene.pictures, strict=True):
        write_png(folder / images / f"{name}.png", picture[..., :3])
        write_png(folder / masks / f"{name}{pad}.png", picture[..., 3])


def write_idr(
    folder: Path, scene: Scene, file: str = "cameras_sphere.npz", factor: float = 1.0
) -> Path:
    """Projections of any scale and sign, and the sphere that they are scaled to."""
    write_pictures(folder, scene, "image", "mask")
    height, width = scene.pictures.shape[1:3]
    intrinsics = np.array([[FOCAL, 0, width / 2, 0], [0, FOCAL, height / 2, 0], [0, 0, 1, 0]])
    arrays = {}
    for v, pose in enumerate(scene.poses):
        matrix = np.eye(4)
        matrix[:3] = factor * intrinsics @ to_camera(pose)
        arrays |= {f"world_mat_{v}": matrix, f"scale_mat_{v}": np.diag([2.0, 2.0, 2.0, 1.0])}
        arrays[f"world_mat_inv_{v}"] = np.linalg.inv(matrix)
    np.savez(folder / file, **arrays)
    return folder


def write_neilf(folder: Path, scene: Scene, original: int = 1) -> Path:
    write_pictures(folder, scene, "inputs/images", "inputs/masks")
    height, width = (original * n for n in scene.pictures.shape[1:3])
    intrinsic = {"focal": [original * FOCAL] * 2, "ppt": [width / 2, height / 2]}
    images = {
        str(v): {
            "size": [width, height],
            "flg": 2,
            "camera": {"intrinsic": intrinsic, "extrinsic": to_camera(pose).ravel().tolist()},
        }
        for v, pose in enumerate(scene.poses)
    }
    # From the computer where it was made, and of another ending
    names = {str(v): f"C:\\shots\\{name}.exr" for v, name in enumerate(scene.names)}
    root = {"image_path": {"file_paths": names}, "camera_track_map": {"images": images}}
    root["bbox"] = {"transform": np.eye(4).ravel().tolist()}
    (folder / "inputs" / "sfm_scene.json").write_text(json.dumps(root))
    return folder


def write_polycam(folder: Path, scene: Scene, place: str = "keyframes/corrected_") -> Path:
    """ARKit's world has +Y up."""
    masks = "keyframes/masks" if place.startswith("keyframes") else "masks"
    write_pictures(folder, scene, f"{place}images", masks)
    (folder / f"{place}cameras").mkdir(parents=True)
    height, width = scene.pictures.shape[1:3]
    for pose, name in zip(scene.poses, scene.names, strict=True):
        x, y, z = pose[:3]
        values = {"fx": FOCAL, "fy": FOCAL, "cx": width / 2, "cy": height / 2, "blur_score": 80.0}
        values |= {"width": width, "height": height, "timestamp": 7, "neighbors": []}
        for row, numbers in enumerate((x, z, -y)):
            values |= {f"t_{row}{column}": value for column, value in enumerate(numbers)}
        (folder / f"{place}cameras" / f"{name}.json").write_text(json.dumps(values))
    return folder


def write_metashape(folder: Path, scene: Scene, calibration: str = "", original: int = 1) -> Path:
    """Labels without endings; a component that is turned, scaled and moved against the world."""
    write_pictures(folder, scene, "images", "masks", pad="_mask")
    height, width = (original * n for n in scene.pictures.shape[1:3])
    shift = np.array([0.5, -1.0, 0.25])
    turn, scale = Rotation.from_rotvec([0.3, -1.0, 0.6]).as_matrix(), 2.5
    cameras = []
    for v, (pose, name) in enumerate(zip(scene.poses, scene.names, strict=True)):
        right, up, back, position = pose[:3].T
        local = np.eye(4)
        local[:3, :3] = turn.T @ np.stack([right, -up, -back], 1)
        local[:3, 3] = turn.T @ (position - shift) / scale
        text = " ".join(map(repr, local.ravel().tolist()))
        cameras.append(
            f'<camera id="{v}" sensor_id="3" component_id="0" label="{name}">'
            f"<transform>{text}</transform><orientation>1</orientation></camera>"
        )
    cameras.append('<camera id="90" sensor_id="3" label="not_placed"/>')
    numbers = [" ".join(map(repr, a)) for a in (turn.ravel().tolist(), shift.tolist())]
    half = len(cameras) // 2
    (folder / "cameras.xml").write_text(
        f"""<?xml version="1.0" encoding="UTF-8"?>
<document version="2.0.0"><chunk label="Chunk 1" enabled="true">
<sensors next_id="4"><sensor id="3" label="unknown" type="frame">
<resolution width="{width}" height="{height}"/>
<calibration type="frame" class="initial"><f>1</f></calibration>
<calibration type="frame" class="adjusted"><resolution width="{width}" height="{height}"/>
<f>{original * FOCAL}</f>{calibration}</calibration></sensor></sensors>
<components><component id="0"><transform><rotation>{numbers[0]}</rotation>
<translation>{numbers[1]}</translation><scale>{scale}</scale></transform></component></components>
<cameras>{"".join(cameras[:half])}<group>{"".join(cameras[half:])}</group></cameras>
</chunk></document>"""
    )
    return folder


def write_realitycapture(
    folder: Path,
    scene: Scene,
    head: str = "#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2",
    lens: str = "0,0,0,0,0,0,0,0",
) -> Path:
    """Angles by the vendor's matrix from the world to the camera, y = pitch, x = roll, z = heading:

    ( .. .. -cy sx ) ( -cy sz -cy cz -sy ) ( .. .. -cx cy )
    """
    write_pictures(folder, scene, "images", "masks")
    side = max(scene.pictures.shape[1:3])
    lines = [head]
    for pose, name in zip(scene.poses, scene.names, strict=True):
        m = to_camera(pose)
        pitch = math.asin(-m[1, 2])
        heading, roll = math.atan2(-m[1, 0], -m[1, 1]), math.atan2(-m[0, 2], -m[2, 2])
        values = [*pose[:3, 3], *map(math.degrees, (heading, pitch, roll))]
        values.append(FOCAL / side * 36)
        lines.append(",".join([f"{name}.png", *(repr(float(x)) for x in values), lens]).rstrip(","))
    (folder / "cameras.csv").write_text("\n".join(lines) + "\n")
    return folder


def write_tensoir(folder: Path, scene: Scene) -> Path:
    for split in ("train", "test"):
        for i, v in enumerate(scene.split(split)):
            view = folder / f"{split}_{i:03d}"
            view.mkdir(parents=True)
            write_png(view / "rgba_sunset.png", scene.pictures[v])
            meta = {"cam_angle_x": angle(), "imh": HEIGHT, "imw": WIDTH}
            meta["cam_transform_mat"] = ",".join(str(x) for x in scene.poses[v].ravel())
            (view / "metadata.json").write_text(json.dumps(meta))
    return folder


def save_turned(path: Path, picture: np.ndarray, tag: int) -> None:
    """A JPEG file whose EXIF says how it is to be turned."""
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = tag
    Image.fromarray(picture).save(path, exif=exif, quality=100, subsampling=0)


Damage = Callable[[Path], object]  # to a data set in a folder


def replaced(file: str, *changes: tuple[str, str]) -> Damage:
    """Pieces of a text file, each by another."""

    def apply(folder: Path) -> None:
        text = (folder / file).read_text()
        for old, new in changes:
            assert old in text
            text = text.replace(old, new)
        (folder / file).write_text(text)

    return apply


def edited(file: str, change: Callable[[Any], object]) -> Damage:
    """A change of what a JSON file holds."""

    def apply(folder: Path) -> None:
        root = json.loads((folder / file).read_text())
        change(root)
        (folder / file).write_text(json.dumps(root))

    return apply


def rewritten(file: str, content: bytes) -> Damage:
    return lambda folder: (folder / file).write_bytes(content)


def renamed(old: str, new: str) -> Damage:
    return lambda folder: (folder / old).rename(folder / new)


def without(*files: str) -> Damage:
    return lambda folder: [(folder / file).unlink() for file in files]


def repainted(file: str, picture: np.ndarray) -> Damage:
    return lambda folder: write_png(folder / file, picture)


def refused(folder: Path, damage: Damage, message: str, split: str = "train") -> None:
    """A data set that is sound can be read; damaged, one line says where, and what."""
    load_photos(folder, split)
    damage(folder)
    with pytest.raises(DataError, match=message) as caught:
        load_photos(folder, split)
    assert "\n" not in str(caught.value)
    assert str(folder) in str(caught.value)
