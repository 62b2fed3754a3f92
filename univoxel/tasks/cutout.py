"""Cut an object out of photographs without masks: the part of the scene that stands in its place.

A coarse surface within a box and a backdrop around it explain the photographs together. What
cameras all around agree on inside the box is the object, and its silhouettes are the masks.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numpy as np
import torch
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
from scipy import ndimage
from skimage.measure import label
from torch import Tensor

from univoxel import losses
from univoxel.camera import Cameras, looked_at, pixel_rays
from univoxel.color import linear_to_srgb
from univoxel.data import Photos, load_photos, splits_of
from univoxel.data.images import write_exr, write_png
from univoxel.data.transforms import write_cameras
from univoxel.errors import NothingFound
from univoxel.fields.backdrop import Backdrop
from univoxel.fields.field import Field, dense_field
from univoxel.grid import fit_grid
from univoxel.lights.sg import SGConfig
from univoxel.metrics import psnr
from univoxel.optim import RowAdam
from univoxel.render.pipeline import surface_at, surface_of_view
from univoxel.scene import Scene, SceneConfig
from univoxel.training.config import StageConfig
from univoxel.training.surface_update import (
    EPS_FEATURES,
    EPS_SDF,
    MOMENTS,
    REFRESH,
    SMOOTH_EVERY,
    between,
    smooth,
    spread_gradient,
)

STAGES = (
    StageConfig(0.25, 1500, 0.5, 1536, sharpness=(2.0, 0.7), lr_sdf=(1.0, 0.1), plate=0.02),
    StageConfig(1.0, 300, 0.5, 2048, sharpness=(0.7, 0.35), lr_sdf=(0.1, 0.01)),
)
# Of the box's half: radii of the balls that the object may be at first. A small one has to grow,
# and may end before the object does; a large one is carved, and may keep what is not object. The
# one from which the photographs are drawn better is kept
STARTS = 0.5, 0.65
LAST = 50  # steps whose mean error decides on that
LR_BACKDROP = 0.05, 0.01  # of logits
REDISTANCE = 50  # steps between turning the sdf back into distances, as far as the surface moved
NEAR = 1.5  # voxels from the surface within which the sdf is left as it is
# Weight of the mean opacity at begin and end: what object and backdrop draw alike goes to the
# backdrop, and the ball is carved before it grows. More at the begin loses what looks like the room
EMPTY = 0.02, 0.0005
LEAST = 0.02  # of the largest part's volume: smaller ones are taken for chaff
MARGIN = 0.05  # of the found box's diagonal, left free around it


def cutout(
    data: Path, out: Path, box: tuple[float, ...] | None = None, downscale: int = 0, seed: int = 0
) -> Path:
    """Write the photographs of a data set with masks as their alpha, and their cameras; return out.

    All splits are written, in the layout of NeRF-synthetic scenes, without lens distortion. The
    object is found from the training photographs alone.

    Args:
        out: folder to write.
        box: lower and upper corner of where the object is, world units; by default a cube around
            what the cameras look at, as large as their pictures.
        downscale: side of the squares of pixels that become one, 0 for 1.

    Raises:
        DataError: photographs that cannot be used.
        FileExistsError: out is there already.
        ValueError: the box is none, or, as NothingFound, no object is in it.
        OSError: a file cannot be written.
    """
    if out.exists():
        raise FileExistsError(f"{out} is there already: choose another --out")
    splits = {name: load_photos(data, name, downscale, masks=False) for name in splits_of(data)}
    photos = splits["train"]
    print(photos.about)
    lower, upper = corners(box) if box else surroundings(photos.cameras)
    torch.manual_seed(seed)
    with Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.percentage:3.0f} %  {task.fields[facts]}"),
        TimeRemainingColumn(),
    ) as bar:
        steps = len(STARTS) * STAGES[0].iterations + STAGES[1].iterations
        task = bar.add_task("object", total=steps, facts="")
        scene = find_object(
            photos, lower, upper, lambda db: bar.update(task, advance=1, facts=f"{db:.1f} dB")
        )
        task = bar.add_task("masks", total=sum(map(len, splits.values())), facts="")
        begun = out.with_name(f".{out.name}.begun")  # nothing half-written goes by the name of out
        shutil.rmtree(begun, ignore_errors=True)
        for name, split in splits.items():
            (begun / name).mkdir(parents=True)
            for view in range(len(split)):
                write_photo(begun / name / split.names[view], split, view, mask(scene, split, view))
                bar.advance(task)
            write_cameras(begun, name, split.cameras, split.names)
        begun.rename(out)
    return out


def corners(box: tuple[float, ...]) -> tuple[Tensor, Tensor]:
    """Lower and upper corner [3] of six numbers."""
    values = torch.tensor(box)
    if len(box) != 6 or not values.isfinite().all() or not (values[:3] < values[3:]).all():
        raise ValueError(
            "--box: expected X Y Z of the lower corner and then of the upper, which is above it in "
            f"all three, got {' '.join(f'{x:g}' for x in box)}"
        )
    return values[:3], values[3:]


def surroundings(cameras: Cameras) -> tuple[Tensor, Tensor]:
    """A cube around what the cameras look at, as large as half of their pictures show whole."""
    centre = looked_at(cameras)
    away = (cameras.camera_to_world[:, :, 3] - centre).norm(dim=1)
    tangent = min(cameras.width, cameras.height) / (2 * cameras.focal.max(1).values)
    half = float((away * tangent / (1 + tangent.square()).sqrt()).median())
    return centre - half, centre + half


def find_object(
    photos: Photos, lower: Tensor, upper: Tensor, watch: Callable[[float], None]
) -> Scene:
    """Surface and radiance of what stands in a box, told from what stands behind it.

    Args:
        photos: as they are; their alpha is not looked at.
        watch: called after each step with the PSNR of its rays.

    Raises:
        NothingFound: there is no object in the box.
    """
    coarse, fine = STAGES
    tried = []
    for start in STARTS:
        with suppress(NothingFound):
            tried.append(started(start, photos, lower, upper, coarse, watch))
    if not tried:
        raise NothingFound
    scene, field, backdrop, _ = max(tried, key=lambda found: found[-1])
    redistance(field, whole=True)
    grid = fit_grid(*bounds(field, lower, upper), round(1e6 * fine.voxels))
    scene.field = field = field.resized(grid)
    separate(scene, field, backdrop, fine, photos, watch)
    redistance(field, whole=True)
    scene.eval()
    return scene


def started(
    start: float,
    photos: Photos,
    lower: Tensor,
    upper: Tensor,
    stage: StageConfig,
    watch: Callable[[float], None],
) -> tuple[Scene, Field, Backdrop, float]:
    """Scene, its field and backdrop after a stage that begins with a ball, and the PSNR, dB."""
    centre, half = (lower + upper) / 2, (upper - lower) / 2
    backdrop = Backdrop(centre, float(half.norm()))
    grid = fit_grid(lower, upper, round(1e6 * stage.voxels))
    ball = (grid.nodes() - centre).norm(dim=-1) - start * float(half.min())
    sizes = SceneConfig(
        channels=8,
        material_channels=1,
        hidden=32,
        sky_nodes=0,
        mirrored=False,
        light=SGConfig(lobes=1),
    )
    field = dense_field(grid, sizes.channels, ball)
    scene = Scene(sizes, field)
    return scene, field, backdrop, separate(scene, field, backdrop, stage, photos, watch)


def separate(
    scene: Scene,
    field: Field,
    backdrop: Backdrop,
    stage: StageConfig,
    photos: Photos,
    watch: Callable[[float], None],
) -> float:
    """Fit the scene, whose field is `field`, and the backdrop to the photographs for a stage.

    Returns the mean PSNR of its last steps, dB.
    """
    quality = []
    optimizer = RowAdam(
        [
            {"params": [field.sdf], "eps": EPS_SDF},
            {"params": [field.features], "eps": EPS_FEATURES},
            {"params": list(scene.radiance.parameters())},
            {"params": list(backdrop.parameters())},
        ],
        betas=MOMENTS,
    )
    for step in range(stage.iterations):
        done = step / stage.iterations
        rates = (
            between(stage.lr_sdf, done) * field.voxel_size,
            between(stage.lr_features, done),
            between(stage.lr_networks, done),
            between(LR_BACKDROP, done),
        )
        for group, rate in zip(optimizer.param_groups, rates, strict=True):
            group["lr"] = rate
        scene.inv_s = 1 / (between(stage.sharpness, done) * field.voxel_size)
        if step % REDISTANCE == 0:
            redistance(field)
        if step % REFRESH == 0:
            field.refresh()
        view, row, column = (
            torch.randint(n, (stage.rays,)) for n in (len(photos), *photos.color.shape[1:3])
        )
        target = linear_to_srgb(photos.pixels(view, row, column)[0])
        rays = pixel_rays(photos.cameras, view, torch.stack([column, row], 1) + 0.5)
        surface = surface_at(scene, rays, torch.rand(stage.rays))
        opacity = surface.opacity[:, None]
        # The same from all directions: what looks different from each would pass for the backdrop
        front = scene.radiance(surface.features, surface.normal, surface.normal)
        drawn = front * opacity + backdrop(rays) * (1 - opacity)
        loss = losses.photometric(drawn, target) + between(EMPTY, done) * opacity.mean()
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        spread_gradient(field, stage.spread)
        optimizer.step()
        if step % SMOOTH_EVERY == 0:
            smooth(field, stage)
        quality.append(psnr(drawn.detach(), target))
        watch(quality[-1])
    return sum(quality[-LAST:]) / len(quality[-LAST:])


@torch.no_grad()
def redistance(field: Field, whole: bool = False) -> None:
    """Make the sdf a distance again, but for what is near the surface.

    Args:
        whole: also take away parts that are small against the largest.
    """
    sdf = field.sdf.detach().numpy()
    inside = sdf < 0
    if whole:
        parts = np.asarray(label(inside))
        volume = np.bincount(parts[inside], minlength=1)
        inside &= (volume >= LEAST * volume.max())[parts]
    if not inside.any():
        raise NothingFound
    outside, depth = (ndimage.distance_transform_edt(m) for m in (~inside, inside))
    distance = np.asarray(outside) - np.asarray(depth)
    distance = (distance - 0.5 * np.sign(distance)) * field.voxel_size
    keep = (np.abs(sdf) < NEAR * field.voxel_size) & (np.abs(distance) < NEAR * field.voxel_size)
    keep &= inside == (sdf < 0)
    field.sdf.copy_(torch.from_numpy(np.where(keep, sdf, distance)).float())
    field.refresh()


def bounds(field: Field, lower: Tensor, upper: Tensor) -> tuple[Tensor, Tensor]:
    """A box around the surface, within that of lower and upper."""
    vertices, _ = field.isosurface()
    low, high = vertices.amin(0), vertices.amax(0)
    margin = MARGIN * (high - low).norm()
    return torch.maximum(low - margin, lower), torch.minimum(high + margin, upper)


def mask(scene: Scene, photos: Photos, view: int) -> Tensor:
    """Coverage [H, W] of a photograph by the object, in [0, 1]."""
    surface, _ = surface_of_view(scene, photos.cameras, view)
    return surface.opacity.view(photos.color.shape[1:3])


def write_photo(stem: Path, photos: Photos, view: int, alpha: Tensor) -> None:
    """Write a photograph as STEM.png, or STEM.exr where it is linear, with that alpha."""
    color = photos.color[view]
    if color.dtype == torch.uint8:
        rgba = torch.cat([color, torch.round(255 * alpha)[..., None].byte()], -1)
        write_png(stem.with_name(f"{stem.name}.png"), rgba)
    else:
        planes = {c: color[..., i] * alpha for i, c in enumerate("RGB")}
        write_exr(stem.with_name(f"{stem.name}.exr"), {**planes, "A": alpha})
