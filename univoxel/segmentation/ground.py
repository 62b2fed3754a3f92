"""Objects on a patterned floor or table: what lies in its plane looks alike from everywhere.

Seen through any two cameras, points of a plane have one colour where nothing stands on it. So the
plane is found as the one on which photographs agree best, its picture as what most of them show,
and a pixel that shows something else than the picture is of what stands on the plane, or beyond its
edge. A hull tells those apart.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy import ndimage
from scipy.optimize import minimize
from skimage.measure import label
from torch import Tensor
from torch.nn.functional import grid_sample, interpolate, max_pool2d, max_pool3d, pad

from univoxel.bars import track
from univoxel.camera import Cameras, image_rays, pixel_width, project, resize
from univoxel.grid import GridShape, fit_grid
from univoxel.segmentation.config import GroundConfig
from univoxel.segmentation.vote import largest_votes, overlaps, shrunk, surroundings, votes

log: logging.Logger = logging.getLogger("univoxel")

GROUND = GroundConfig()
THRESHOLDS = 40  # that are tried


@dataclass(frozen=True)
class Plane:
    """z = height + slope (x, y) around a middle."""

    middle: Tensor  # [2] x, y
    height: float  # there
    slope: tuple[float, float]

    def points(self, side: Tensor) -> Tensor:
        """A grid [K K, 3] of K places along x and along y, from the middle."""
        x, y = torch.meshgrid(side, side, indexing="ij")
        z = self.height + self.slope[0] * x + self.slope[1] * y
        return torch.stack([x + self.middle[0], y + self.middle[1], z], -1).reshape(-1, 3)

    def met(self, origin: Tensor, direction: Tensor) -> tuple[Tensor, Tensor]:
        """Where rays [N, 3] meet it: x, y from the middle [N, 2], and whether they do [N]."""
        normal = torch.tensor([-self.slope[0], -self.slope[1], 1.0])
        begin = origin - torch.cat([self.middle, torch.tensor([self.height])])
        away = -(begin @ normal) / (direction @ normal)
        place = begin + away[:, None] * direction
        return place[:, :2], (away > 0) & place.isfinite().all(1)


@dataclass(frozen=True)
class Floor:
    """A plane with its picture."""

    plane: Plane
    near: float  # from the middle, world units: a quarter of the picture's width, see `warped`
    picture: Tensor  # [3, N, N] sRGB in [0, 1], along x and y
    known: Tensor  # [N, N] 1 where photographs agree on it, else 0
    within: Tensor  # [N, N] 1 there and where only the object hides it


@dataclass(frozen=True)
class Ground:
    """A floor, and the hull of what stands on it."""

    floor: Floor
    grid: GridShape
    vote: Tensor  # [X, Y, Z] share of the photographs that see no floor behind a node; 0 far off
    threshold: float  # the vote from which on a node belongs to the object


def find_ground(
    photographs: Sequence[Tensor], cameras: Cameras, cfg: GroundConfig = GROUND
) -> Ground | None:
    """What an object stands on, in photographs [H, W, 3] uint8 of a world with +Z up.

    None where there is no plane on which photographs agree, or no object on it.
    """
    small = resize(cameras, min(cameras.width, cfg.pixels))
    sharp = [_small(one, small.size(v)) for v, one in enumerate(photographs)]
    plane = find_plane(sharp, small, cfg)
    if plane is None:
        return None
    box = surroundings(small)
    soft = [_blurred(one, cfg.blur) for one in sharp]
    floor = _floor(plane, cfg.near * float((box[1] - box[0]).max()) / 2, soft, small, cfg)
    seen = [_seen(floor, one, small, v, cfg) for v, one in enumerate(soft)]
    return _carved(floor, seen, small, box, cfg)


def ground_mask(
    ground: Ground, photograph: Tensor, cameras: Cameras, view: int, cfg: GroundConfig = GROUND
) -> Tensor:
    """The mask [H, W], 0 or 1, of a photograph [H, W, 3] uint8 by what stands on the ground."""
    small = resize(cameras, min(cameras.width, cfg.pixels))
    picture = _blurred(_small(photograph, small.size(view)), cfg.blur)
    found = _object(ground, *_seen(ground.floor, picture, small, view, cfg), small, view, cfg)
    whole = interpolate(found[None, None], photograph.shape[:2], mode="bilinear")[0, 0]
    return (whole >= 0.5).float()


def find_plane(
    pictures: Sequence[Tensor], cameras: Cameras, cfg: GroundConfig = GROUND
) -> Plane | None:
    """The plane on which pictures [3, H, W] agree best; None where they agree on no one clearly.

    It may lean by a few degrees from the horizontal, and is below the cameras.
    """
    lower, upper = surroundings(cameras)
    middle, half = (lower + upper) / 2, float((upper - lower).max()) / 2
    chosen = torch.arange(0, len(cameras), max(1, len(cameras) // cfg.views))
    some, cams = [pictures[v] for v in chosen.tolist()], cameras.of(chosen)
    side = cfg.searched * half * _places(cfg.points)

    def disagreement(values: Sequence[float], blurred: Sequence[Tensor]) -> float:
        plane = Plane(middle[:2], float(values[0]), (float(values[1]), float(values[2])))
        return _disagreement(plane.points(side), blurred, cams, cfg)

    coarse = [_blurred(one, cfg.blurs[0]) for one in some]
    top = min(float(middle[2]) + half, float(cameras.camera_to_world[:, 2, 3].min()))
    heights = np.linspace(float(middle[2]) - 2 * half, top, cfg.heights).tolist()
    found = [disagreement((z, 0, 0), coarse) for z in track(heights, "looking for the ground")]
    best = int(np.argmin(found))
    if found[best] > cfg.clearly * float(np.median(found)):
        return None
    values = np.array([heights[best], 0.0, 0.0])
    for blur in cfg.blurs:
        blurred = [_blurred(one, blur) for one in some]
        step = blur * pixel_width(cameras, middle) * np.array([1, 1 / half, 1 / half])
        simplex = np.concatenate([values[None], values + np.diag(step)])
        options = {"initial_simplex": simplex, "maxfev": cfg.trials, "xatol": 1e-5, "fatol": 1e-4}
        result = minimize(disagreement, values, (blurred,), "Nelder-Mead", options=options)
        values = result.x
    if result.fun > cfg.agree:
        return None
    return Plane(middle[:2], float(values[0]), (float(values[1]), float(values[2])))


def warped(place: Tensor, near: float) -> Tensor:
    """Where places [N, 2] are in the picture of the ground, which holds all of it: in (-1, 1)."""
    return place / (near + place.abs())


def _places(count: int) -> Tensor:
    """So many, evenly, in (-1, 1)."""
    return (torch.arange(count) + 0.5) / count * 2 - 1


def _small(photograph: Tensor, size: tuple[int, int]) -> Tensor:
    """A photograph [H, W, 3] uint8 as [3, h, w] in [0, 1]."""
    whole = photograph.permute(2, 0, 1)[None].float() / 255
    return interpolate(whole, (size[1], size[0]), mode="area")[0]


def _blurred(picture: Tensor, sigma: float) -> Tensor:
    return torch.from_numpy(ndimage.gaussian_filter(picture.numpy(), (0, sigma, sigma)))


def _looked_up(
    pictures: Sequence[Tensor], cameras: Cameras, points: Tensor
) -> tuple[Tensor, Tensor]:
    """Values [V, N, C] of points [N, 3] in each picture, and whether they are in it [V, N]."""
    colors, seen = [], []
    for view, picture in enumerate(pictures):
        pixel, depth = project(cameras, view, points)
        uv = pixel * (2 / torch.tensor(cameras.size(view))) - 1
        found = grid_sample(picture[None], uv[None, None], align_corners=False)
        colors.append(found[0, :, 0].T)
        seen.append((depth > 0) & (uv.abs() <= 1).all(1))
    return torch.stack(colors), torch.stack(seen)


def _disagreement(
    points: Tensor, pictures: Sequence[Tensor], cameras: Cameras, cfg: GroundConfig
) -> float:
    """How much colours of a point differ between pictures, over how much they do between points.

    Large where too few points are seen, or all look alike: that says nothing.
    """
    colors, seen = _looked_up(pictures, cameras, points)
    colors = torch.where(seen[..., None], colors, torch.nan)
    usual = colors.nanmedian(0).values
    differs = (colors - usual).abs().sum(2).nanmedian(0).values
    enough = seen.sum(0) >= max(cfg.seen, cfg.seen_share * len(pictures))
    if enough.float().mean() < cfg.seen_share:
        return torch.inf
    usual = usual[enough]
    spread = (usual - usual.median(0).values).abs().sum(1).median()
    # Half of the points may be hidden by the object from half of the cameras
    return float(differs[enough].quantile(cfg.hidden) / (spread + cfg.noise))


def _floor(
    plane: Plane, near: float, pictures: Sequence[Tensor], cameras: Cameras, cfg: GroundConfig
) -> Floor:
    """A plane with what most pictures show at each place of it."""
    chosen = torch.arange(0, len(cameras), max(1, len(cameras) // cfg.views))
    some, cams = [pictures[v] for v in chosen.tolist()], cameras.of(chosen)
    side = _places(cfg.side)
    points = plane.points(near * side / (1 - side.abs()))
    above = cfg.above * near / cfg.near
    value, known = torch.zeros(len(points), 3), torch.zeros(len(points))
    parts = list(torch.arange(len(points)).split(1 << 14))
    for part in track(parts, "drawing the ground"):
        value[part], known[part] = _agreed(points[part], above, some, cams, cfg)
    shape = cfg.side, cfg.side
    known = known.reshape(shape)
    within = torch.from_numpy(ndimage.binary_fill_holes(known.numpy() > 0)).float()
    return Floor(plane, near, value.T.reshape(3, *shape), known, within)


def _agreed(
    points: Tensor, above: float, pictures: Sequence[Tensor], cameras: Cameras, cfg: GroundConfig
) -> tuple[Tensor, Tensor]:
    """The colour [N, 3] that pictures share at points [N, 3], and whether it is of the floor [N].

    An object of one colour has it at any height: what counts is how many pictures more show a
    colour here than do that far above. Few may see the floor beneath an object.
    """
    found, seen = _looked_up(pictures, cameras, points)
    higher, _ = _looked_up(pictures, cameras, points + torch.tensor([0, 0, above]))
    enough = torch.clamp_min(cfg.alike * seen.sum(0), cfg.seen)
    best, color, floor = (torch.zeros(len(points), *shape) for shape in ((), (3,), ()))
    for v in range(0, len(pictures), max(1, len(pictures) // cfg.candidates)):
        here, there = (
            ((one - found[v]).abs().amax(2) < cfg.tolerance) & seen & seen[v]
            for one in (found, higher)
        )
        number = here.sum(0)
        more = number - cfg.better * there.sum(0)
        better = (more > best) & (number >= enough)
        mean = (found * here[..., None]).sum(0) / number.clamp_min(1)[:, None]
        color = torch.where(better[:, None], mean, color)
        floor = torch.where(better, 1.0, floor)
        best = torch.where(better, more, best)
    return color, floor


def _seen(
    floor: Floor, picture: Tensor, cameras: Cameras, view: int, cfg: GroundConfig
) -> tuple[Tensor, Tensor]:
    """Pixels [H, W] of a blurred picture [3, H, W] that do not show the floor, and those before it:
    0 or 1."""
    width, height = cameras.size(view)
    rays = image_rays(cameras, view)
    place, meets = floor.plane.met(rays.origin, rays.direction)
    where = warped(place, floor.near).flip(1)
    where = torch.where(meets[:, None], where, 2.0)[None, None]
    layers = torch.cat([floor.picture, floor.known[None], floor.within[None]])[None]
    found = grid_sample(layers, where, align_corners=False)[0].reshape(5, height, width)
    *colors, known, within = found
    around = pad(torch.stack(colors)[None], (1, 1, 1, 1), mode="replicate")[0]
    # A pixel's width of error is forgiven: cameras and plane are not exact
    differs = torch.stack(
        [
            (picture - around[:, i : i + height, j : j + width]).abs().amax(0)
            for i in range(3)
            for j in range(3)
        ]
    ).amin(0)
    alike = ((differs < cfg.tolerance) & (known > 0.5)).float().numpy()
    shown = torch.from_numpy(ndimage.uniform_filter(alike, cfg.patch)) < 0.5
    return shown.float(), (within > 0.5).float()


def _carved(
    floor: Floor,
    seen: Sequence[tuple[Tensor, Tensor]],
    cameras: Cameras,
    box: tuple[Tensor, Tensor],
    cfg: GroundConfig,
) -> Ground | None:
    """The ground with the hull of what hides it; None where that is not one object within the box.

    Args:
        seen: as `_seen` has them.
    """
    lower, upper = box
    lower = torch.cat([lower[:2], lower.new_tensor([floor.plane.height])])
    grid = fit_grid(lower, upper, cfg.voxels**3)
    shown, within = ([shrunk(one[i], cfg.rough).round() for one in seen] for i in (0, 1))
    vote = votes(shown, cameras, grid)
    part = _largest_part(vote >= cfg.first)
    if part is None:
        return None
    around = max_pool3d(part[None].float(), 3, 1, 1)[0]
    vote = torch.where(around > 0, vote, 0.0)
    levels = torch.linspace(cfg.lowest, cfg.highest, THRESHOLDS)
    agreed = []
    for view, (one, behind) in enumerate(zip(shown, within, strict=True)):
        largest = largest_votes(grid, vote, cameras, view, one.shape)
        beside = behind * one * _grown(largest >= cfg.first, cfg.band)
        agreed.append(overlaps(largest * behind, beside, levels))
    medians = torch.stack(agreed).quantile(0.5, 0)
    log.debug("the hull on the ground agrees to %.3f", float(medians.max()))
    if medians.max() < cfg.overlap:
        return None
    return Ground(floor, grid, vote, float(levels[medians.argmax()]))


def _largest_part(inside: Tensor) -> Tensor | None:
    """The part of nodes [X, Y, Z] that has most of them; None where it ends at the box's sides."""
    parts = np.asarray(label(inside.numpy(), connectivity=1))
    size = np.bincount(parts.ravel())
    size[0] = 0
    part = parts == size.argmax()
    sides = (part[0], part[-1], part[:, 0], part[:, -1])
    return None if not size.any() or any(one.any() for one in sides) else torch.from_numpy(part)


def _grown(mask: Tensor, pixels: int) -> Tensor:
    """A mask [H, W] grown by pixels: 0 or 1."""
    return max_pool2d(mask[None].float(), 2 * pixels + 1, 1, pixels)[0]


def _object(
    ground: Ground, shown: Tensor, within: Tensor, cameras: Cameras, view: int, cfg: GroundConfig
) -> Tensor:
    """Of pixels that do not show the floor [H, W] those of the object: 0 or 1.

    Before the floor they are believed; elsewhere the silhouette is, and where hardly any picture
    sees floor behind: what looks like it by chance does in one picture.
    """
    small = shrunk(shown, cfg.rough).shape
    largest = largest_votes(ground.grid, ground.vote, cameras, view, small)
    hidden = largest < cfg.certain
    parts = largest, _grown(largest >= ground.threshold, 1), _grown(hidden, 1)
    largest, grown, hidden = (
        interpolate(one[None, None], shown.shape, mode="bilinear")[0, 0] for one in parts
    )
    silhouette = torch.where(within > 0, grown >= 0.5, largest >= ground.threshold)
    found = ((silhouette & (shown > 0)) | (hidden < 0.5)).numpy()
    return torch.from_numpy(_without_specks(found, cfg.speck)).float()


def _without_specks(found: np.ndarray, share: float) -> np.ndarray:
    """A mask [H, W] without parts, and without holes, that are small against the whole."""
    least = share * found.sum()
    for value in (True, False):
        parts = np.asarray(label(found == value, connectivity=1))
        size = np.bincount(parts.ravel())
        size[0] = found.size
        found = np.where(size[parts] < least, not value, found)
    return found
