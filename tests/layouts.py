"""The same photographs and cameras written in every layout, each from its own description."""

import json
import math
import struct
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from analytic import look_at
from scipy.spatial.transform import Rotation

from univoxel.data.images import write_png

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
    for place in ("images", "masks"):
        (folder / place).mkdir(parents=True)
    frames = []
    for v, name in reversed(list(enumerate(scene.names))):
        write_png(folder / "images" / f"{name}.png", scene.pictures[v, ..., :3])
        write_png(folder / "masks" / f"{name}.png", scene.pictures[v, ..., 3])
        frames.append(
            {
                "file_path": f"images/{name}.png",
                "mask_path": f"masks/{name}.png",
                "transform_matrix": scene.poses[v].tolist(),
            }
        )
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
    for part in ("images", "masks", place):
        (folder / part).mkdir(parents=True, exist_ok=True)
    height, width = scene.pictures.shape[1:3]
    rows = []
    for v, name in reversed(list(enumerate(scene.names))):
        write_png(folder / "images" / f"{name}.png", scene.pictures[v, ..., :3])
        write_png(folder / "masks" / f"{name}.png.png", scene.pictures[v, ..., 3])
        # x right, y down, z forward; from the world to the camera
        to_world = scene.poses[v, :3, :3] * [1, -1, -1]
        x, y, z, w = Rotation.from_matrix(to_world.T).as_quat()
        rows.append((v + 5, (w, x, y, z), -to_world.T @ scene.poses[v, :3, 3], f"{name}.png"))
    if text:
        numbers = " ".join(map(str, parameters))
        (folder / place / "cameras.txt").write_text(
            f"# Camera list\n#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n"
            f"3 {model} {width} {height} {numbers}\n"
        )
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
    masks = place.replace("images", "masks")
    for part in (place, masks):
        (folder / part).mkdir(parents=True)
    height, width = scene.pictures.shape[1:3]
    rows = []
    for pose, name, picture in zip(scene.poses, scene.names, scene.pictures, strict=True):
        write_png(folder / place / f"{name}.png", picture[..., :3])
        write_png(folder / masks / f"{name}.png", picture[..., 3])
        right, up, back, position = pose[:3].T
        size_and_focal = original * np.array([height, width, FOCAL])
        camera = np.stack([-up, right, back, position, size_and_focal], 1)
        rows.append([*camera.ravel(), 1.0, 9.0])
    np.save(folder / "poses_bounds.npy", np.array(rows))
    return folder


def write_tensoir(folder: Path, scene: Scene) -> Path:
    for split in ("train", "test"):
        for i, v in enumerate(scene.split(split)):
            view = folder / f"{split}_{i:03d}"
            view.mkdir(parents=True)
            write_png(view / "rgba_sunset.png", scene.pictures[v])
            meta = {
                "cam_angle_x": angle(),
                "cam_transform_mat": ",".join(str(x) for x in scene.poses[v].ravel()),
                "imh": HEIGHT,
                "imw": WIDTH,
            }
            (view / "metadata.json").write_text(json.dumps(meta))
    return folder
