"""What goes wrong between an object and its photographs: applied to a rendered scene."""

from __future__ import annotations

import io
import shutil
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from scipy import ndimage
from torch import Tensor

from lab.stress.render import SPEC
from lab.stress.rough import rough_masks, shifted
from univoxel.camera import Cameras, image_rays
from univoxel.color import linear_to_srgb
from univoxel.data import Photos, load_photos
from univoxel.data.images import read_image, write_exr, write_png
from univoxel.data.transforms import write_cameras
from univoxel.envmap import EnvMap, lookup
from univoxel.errors import UserError


@dataclass(frozen=True)
class Damage:
    """How photographs differ from a rendered scene; by default only in their 8 bits."""

    views: int = 40  # the first so many
    pose: float = 0.0  # standard deviation of a camera's turn about each of its axes, degrees
    stops: float = 0.0  # exposures differ by up to so many, from -stops to +stops
    light: float = 0.0  # largest share of the second light in a photograph, in [0, 1]
    dilation: float = 0.0  # of the masks, pixels
    rough: float = 0.0  # masks as people draw them, see rough.py: percent of the picture
    noise: float = 0.0  # standard deviation, of sRGB in [0, 1]
    exposure: float = 0.0  # stops, of all photographs and of the test views


def damaged(
    scene: Path,
    out: Path,
    damage: Damage,
    seed: int = 0,
    second: Path | None = None,
    jpeg: int | None = None,
    behind: np.ndarray | None = None,
) -> Path:
    """Write a data set with other photographs than a rendered scene; what tests them stays.

    Args:
        scene, second: folders of scenes of the same cameras, in two lights; `second` may be missing
            where damage.light is 0.
        out: folder to write; it is replaced.
        jpeg: quality that photographs are stored with on the way, in [1, 95]; None: they are not.
        behind: radians [V] that the light has turned by in each photograph of the scene, where what
            stands behind the object is shown; None: it is where masks are too wide or rough, and
            stands still.

    Raises:
        DataError: a scene cannot be read.
        ValueError: the scene has fewer photographs than asked for, or there is no second light.
        OSError: a file cannot be written.
    """
    photos = load_photos(scene, "train")
    if len(photos) < damage.views:
        raise UserError(f"{scene}: expected {damage.views} photographs, got {len(photos)}")
    random = np.random.default_rng(seed)
    photos = photos.of(torch.arange(damage.views))
    if damage.light:
        if second is None:
            raise ValueError("damaged: light above 0 needs a scene under a second light")
        share = torch.from_numpy(damage.light * random.uniform(size=damage.views)).float()
        other = load_photos(second, "train").color[: damage.views]
        photos = replace(photos, color=torch.lerp(photos.color, other, share[:, None, None, None]))
    if damage.rough:
        photos = shifted(photos, damage.rough, random)
    gain = exposures(damage.views, damage.stops, random) * 2**damage.exposure
    shutil.rmtree(out, ignore_errors=True)
    (out / "train").mkdir(parents=True)
    write_cameras(out, "train", turned(photos.cameras, damage.pose, random), photos.names)
    pictures, alphas = [], []
    for view in range(len(photos)):
        if damage.dilation or damage.rough or behind is not None:
            turn = 0.0 if behind is None else float(behind[view])
            shown, alpha = masked(photos, view, damage.dilation, turn)
        else:
            shown, alpha = photos.picture(view)
        picture = photographed(shown * gain[view], damage.noise, random)
        pictures.append(picture if jpeg is None else compressed(picture, jpeg))
        alphas.append(alpha)
    if damage.rough:
        alphas = torch.from_numpy(rough_masks(torch.stack(alphas).numpy(), damage.rough, random))
    for name, picture, alpha in zip(photos.names, pictures, alphas, strict=True):
        rgba = torch.cat([picture, torch.round(255 * alpha)[..., None].byte()], -1)
        write_png(out / "train" / f"{name}.png", rgba.numpy())
    _copy_tests(scene, out, 2**damage.exposure)
    return out


def turned(cameras: Cameras, degrees: float, random: np.random.Generator) -> Cameras:
    """Cameras turned about their own centres: a rotation vector of independent normal numbers."""
    vector = np.radians(degrees) * random.standard_normal((len(cameras), 3))
    angle = np.linalg.norm(vector, axis=1)
    x, y, z = (vector / np.maximum(angle, 1e-12)[:, None]).T
    zero = np.zeros_like(x)
    cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(-1, 3, 3)
    s, c = np.sin(angle)[:, None, None], np.cos(angle)[:, None, None]
    turn = np.eye(3) + s * cross + (1 - c) * cross @ cross  # Rodrigues
    pose = cameras.camera_to_world.double().numpy()
    found = np.concatenate([pose[:, :, :3] @ turn, pose[:, :, 3:]], -1)
    return replace(cameras, camera_to_world=torch.from_numpy(found.astype(np.float32)))


def exposures(views: int, stops: float, random: np.random.Generator) -> Tensor:
    """Factors [V] on radiance, evenly distributed in stops."""
    return torch.from_numpy(2.0 ** random.uniform(-stops, stops, views)).float()


def masked(photos: Photos, view: int, dilation: float, turn: float = 0.0) -> tuple[Tensor, Tensor]:
    """Linear colour [H, W, 3] before what is behind the object, and a mask [H, W] too large.

    The background is envmaps/train.exr, far away, turned about +Z by so many radians. A dilated
    pixel has the largest coverage within so many pixels.
    """
    color, alpha = photos.picture(view)
    rays = image_rays(photos.cameras, view)
    c, s = np.cos(turn), np.sin(turn)
    direction = rays.direction @ torch.tensor([[c, -s, 0], [s, c, 0], [0, 0, 1]]).float()
    behind = lookup(EnvMap(read_image(photos.folder / "envmaps" / "train.exr")), direction)
    behind = behind.reshape(color.shape)
    shown = alpha[..., None] * color + (1 - alpha[..., None]) * behind
    reach = int(dilation)
    y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    disc = np.hypot(x, y) <= dilation
    grown = ndimage.grey_dilation(alpha.numpy(), footprint=disc, mode="constant")
    return shown, torch.from_numpy(grown)


def photographed(linear: Tensor, noise: float, random: np.random.Generator) -> Tensor:
    """Linear radiance as 8-bit sRGB, uint8: noise is added before it is clipped and rounded."""
    encoded = linear_to_srgb(linear)  # clipped at 1
    if noise:
        encoded = encoded + noise * torch.from_numpy(random.standard_normal(linear.shape)).float()
    return torch.round(255 * encoded.clamp(0, 1)).byte()


def compressed(picture: Tensor, quality: int) -> Tensor:
    """An 8-bit picture [H, W, 3] after it was stored as JPEG."""
    stored = io.BytesIO()
    Image.fromarray(picture.numpy()).save(stored, "JPEG", quality=quality)
    return torch.from_numpy(np.array(Image.open(stored)))


def clipped(folder: Path) -> float:
    """Share of the object's pixels that have a channel at 255 in the photographs of a data set.

    The pictures are read as they are: a loader may refuse them.
    """
    rgba = np.stack([read_image(path).numpy() for path in sorted((folder / "train").glob("*.png"))])
    return float((rgba[..., :3] == 255).any(-1)[rgba[..., 3] > 127].mean())


def _copy_tests(scene: Path, out: Path, gain: float) -> None:
    """Copy all that a run is measured with; test views get the exposure of the photographs."""
    for path in sorted(scene.iterdir()):
        if path.name in ("train", "transforms_train.json", SPEC):
            continue
        if path.is_dir():
            shutil.copytree(path, out / path.name)
        else:
            shutil.copy(path, out / path.name)
    if gain == 1:
        return
    for path in sorted((out / "test").glob("*.exr")):
        picture = read_image(path).numpy() * np.array([gain, gain, gain, 1], np.float32)
        write_exr(path, dict(zip("RGBA", np.moveaxis(picture, -1, 0), strict=True)))
