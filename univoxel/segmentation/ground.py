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
from univoxel.camera import Cameras, image_rays, looked_at, pixel_rays, pixel_width, project, resize
from univoxel.grid import GridShape, fit_grid

# Pixels of the widest picture that is compared
PIXELS = 480
# Pictures that plane and its picture are found from, about
VIEWS = 40
# Heights that are tried in the search for the plane
HEIGHTS = 61
# Half width of the square looked at, in those of what is looked at
SEARCHED = 1.5
# Points along its sides
POINTS = 48
# Pixels of blur, from coarse to fine
BLURS = (4.0, 2.0, 1.0)
# Trials of planes at each of them
TRIALS = 60
# Pictures in which a point has to be
SEEN = 4
# Share of the pictures, and of the points
SEEN_SHARE = 0.25
# Quantile of the points that counts: the object hides others
HIDDEN = 0.4
# sRGB, of what plain surfaces differ by
NOISE = 0.02
# Share of the median's over all heights that the least disagreement may have: .1 on a patterned
# floor
CLEARLY = 0.4
# Disagreement between pictures over that between points, at most: .07 on that floor
AGREE = 0.35
# Half of the places of the plane's picture are within so many half widths of what is looked at;
# the others are the wider, the farther away
NEAR = 2.0
# Places along it
SIDE = 512
# Pixels of blur, of pictures that are compared with it
BLUR = 1.0
# Pictures whose colour others are asked to share, about
CANDIDATES = 20
# sRGB, within which colours are alike
TOLERANCE = 0.08
# Share of the pictures that see a place: so many share its colour
ALIKE = 0.3
# Half widths of what is looked at, by which a place is lifted
ABOVE = 0.15
# Times as many pictures share its colour as then: what has one colour has no height
BETTER = 1.25
# Pixels along a square whose majority decides
PATCH = 5
# Voxels along the sides of the box of the object's hull, about
VOXELS = 64
# Pixels of the longer side of the pictures that make it
ROUGH = 96
# Share of the pictures that see no floor behind a node: from FIRST on what hangs together is
# the object, and the silhouettes that agree best are of one in between
FIRST = 0.9
LOWEST = 0.7
HIGHEST = 0.98
# Share from which on it is the object's whatever a picture shows
CERTAIN = 0.96
# Pixels of ROUGH beside the first silhouette that are compared
BAND = 4
# Median IoU with the hull from which on masks are believed
OVERLAP = 0.85
# Share of the mask's area: smaller parts and holes are none
SPECK = 0.005


log: logging.Logger = logging.getLogger("univoxel")

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


def find_ground(photographs: Sequence[Tensor], cameras: Cameras) -> Ground | None:
    """What an object stands on, in photographs [H, W, 3] uint8 of a world with +Z up.

    None where there is no plane on which photographs agree, or no object on it.
    """
    small = resize(cameras, min(cameras.width, PIXELS))
    sharp = [_small(one, small.size(v)) for v, one in enumerate(photographs)]
    plane = find_plane(sharp, small)
    if plane is None:
        return None
    box = surroundings(small)
    soft = [_blurred(one, BLUR) for one in sharp]
    floor = _floor(plane, NEAR * float((box[1] - box[0]).max()) / 2, soft, small)
    seen = [_seen(floor, one, small, v) for v, one in enumerate(soft)]
    return _carved(floor, seen, small, box)


def ground_mask(ground: Ground, photograph: Tensor, cameras: Cameras, view: int) -> Tensor:
    """The mask [H, W], 0 or 1, of a photograph [H, W, 3] uint8 by what stands on the ground."""
    small = resize(cameras, min(cameras.width, PIXELS))
    picture = _blurred(_small(photograph, small.size(view)), BLUR)
    found = _object(ground, *_seen(ground.floor, picture, small, view), small, view)
    whole = interpolate(found[None, None], photograph.shape[:2], mode="bilinear")[0, 0]
    return (whole >= 0.5).float()


def find_plane(pictures: Sequence[Tensor], cameras: Cameras) -> Plane | None:
    """The plane on which pictures [3, H, W] agree best; None where they agree on no one clearly.

    It may lean by a few degrees from the horizontal, and is below the cameras.
    """
    lower, upper = surroundings(cameras)
    middle, half = (lower + upper) / 2, float((upper - lower).max()) / 2
    chosen = torch.arange(0, len(cameras), max(1, len(cameras) // VIEWS))
    some, cams = [pictures[v] for v in chosen.tolist()], cameras.of(chosen)
    side = SEARCHED * half * _places(POINTS)

    def disagreement(values: Sequence[float], blurred: Sequence[Tensor]) -> float:
        plane = Plane(middle[:2], float(values[0]), (float(values[1]), float(values[2])))
        return _disagreement(plane.points(side), blurred, cams)

    coarse = [_blurred(one, BLURS[0]) for one in some]
    top = min(float(middle[2]) + half, float(cameras.camera_to_world[:, 2, 3].min()))
    heights = np.linspace(float(middle[2]) - 2 * half, top, HEIGHTS).tolist()
    found = [disagreement((z, 0, 0), coarse) for z in track(heights, "looking for the ground")]
    best = int(np.argmin(found))
    if found[best] > CLEARLY * float(np.median(found)):
        return None
    values = np.array([heights[best], 0.0, 0.0])
    for blur in BLURS:
        blurred = [_blurred(one, blur) for one in some]
        step = blur * pixel_width(cameras, middle) * np.array([1, 1 / half, 1 / half])
        simplex = np.concatenate([values[None], values + np.diag(step)])
        options = {"initial_simplex": simplex, "maxfev": TRIALS, "xatol": 1e-5, "fatol": 1e-4}
        result = minimize(disagreement, values, (blurred,), "Nelder-Mead", options=options)
        values = result.x
    if result.fun > AGREE:
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


def _disagreement(points: Tensor, pictures: Sequence[Tensor], cameras: Cameras) -> float:
    """How much colours of a point differ between pictures, over how much they do between points.

    Large where too few points are seen, or all look alike: that says nothing.
    """
    colors, seen = _looked_up(pictures, cameras, points)
    colors = torch.where(seen[..., None], colors, torch.nan)
    usual = colors.nanmedian(0).values
    differs = (colors - usual).abs().sum(2).nanmedian(0).values
    enough = seen.sum(0) >= max(SEEN, SEEN_SHARE * len(pictures))
    if enough.float().mean() < SEEN_SHARE:
        return torch.inf
    usual = usual[enough]
    spread = (usual - usual.median(0).values).abs().sum(1).median()
    # Half of the points may be hidden by the object from half of the cameras
    return float(differs[enough].quantile(HIDDEN) / (spread + NOISE))


def _floor(plane: Plane, near: float, pictures: Sequence[Tensor], cameras: Cameras) -> Floor:
    """A plane with what most pictures show at each place of it."""
    chosen = torch.arange(0, len(cameras), max(1, len(cameras) // VIEWS))
    some, cams = [pictures[v] for v in chosen.tolist()], cameras.of(chosen)
    side = _places(SIDE)
    points = plane.points(near * side / (1 - side.abs()))
    above = ABOVE * near / NEAR
    value, known = torch.zeros(len(points), 3), torch.zeros(len(points))
    parts = list(torch.arange(len(points)).split(1 << 14))
    for part in track(parts, "drawing the ground"):
        value[part], known[part] = _agreed(points[part], above, some, cams)
    shape = SIDE, SIDE
    known = known.reshape(shape)
    within = torch.from_numpy(ndimage.binary_fill_holes(known.numpy() > 0)).float()
    return Floor(plane, near, value.T.reshape(3, *shape), known, within)


def _agreed(
    points: Tensor, above: float, pictures: Sequence[Tensor], cameras: Cameras
) -> tuple[Tensor, Tensor]:
    """The colour [N, 3] that pictures share at points [N, 3], and whether it is of the floor [N].

    An object of one colour has it at any height: what counts is how many pictures more show a
    colour here than do that far above. Few may see the floor beneath an object.
    """
    found, seen = _looked_up(pictures, cameras, points)
    higher, _ = _looked_up(pictures, cameras, points + torch.tensor([0, 0, above]))
    enough = torch.clamp_min(ALIKE * seen.sum(0), SEEN)
    best, color, floor = (torch.zeros(len(points), *shape) for shape in ((), (3,), ()))
    for v in range(0, len(pictures), max(1, len(pictures) // CANDIDATES)):
        here, there = (
            ((one - found[v]).abs().amax(2) < TOLERANCE) & seen & seen[v] for one in (found, higher)
        )
        number = here.sum(0)
        more = number - BETTER * there.sum(0)
        better = (more > best) & (number >= enough)
        mean = (found * here[..., None]).sum(0) / number.clamp_min(1)[:, None]
        color = torch.where(better[:, None], mean, color)
        floor = torch.where(better, 1.0, floor)
        best = torch.where(better, more, best)
    return color, floor


def _seen(floor: Floor, picture: Tensor, cameras: Cameras, view: int) -> tuple[Tensor, Tensor]:
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
    alike = ((differs < TOLERANCE) & (known > 0.5)).float().numpy()
    shown = torch.from_numpy(ndimage.uniform_filter(alike, PATCH)) < 0.5
    return shown.float(), (within > 0.5).float()


def _carved(
    floor: Floor,
    seen: Sequence[tuple[Tensor, Tensor]],
    cameras: Cameras,
    box: tuple[Tensor, Tensor],
) -> Ground | None:
    """The ground with the hull of what hides it; None where that is not one object within the box.

    Args:
        seen: as `_seen` has them.
    """
    lower, upper = box
    lower = torch.cat([lower[:2], lower.new_tensor([floor.plane.height])])
    grid = fit_grid(lower, upper, VOXELS**3)
    shown, within = ([shrunk(one[i], ROUGH).round() for one in seen] for i in (0, 1))
    vote = votes(shown, cameras, grid)
    part = _largest_part(vote >= FIRST)
    if part is None:
        return None
    around = max_pool3d(part[None].float(), 3, 1, 1)[0]
    vote = torch.where(around > 0, vote, 0.0)
    levels = torch.linspace(LOWEST, HIGHEST, THRESHOLDS)
    agreed = []
    for view, (one, behind) in enumerate(zip(shown, within, strict=True)):
        largest = largest_votes(grid, vote, cameras, view, one.shape)
        beside = behind * one * _grown(largest >= FIRST, BAND)
        agreed.append(overlaps(largest * behind, beside, levels))
    medians = torch.stack(agreed).quantile(0.5, 0)
    log.debug("the hull on the ground agrees to %.3f", float(medians.max()))
    if medians.max() < OVERLAP:
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


def _object(ground: Ground, shown: Tensor, within: Tensor, cameras: Cameras, view: int) -> Tensor:
    """Of pixels that do not show the floor [H, W] those of the object: 0 or 1.

    Before the floor they are believed; elsewhere the silhouette is, and where hardly any picture
    sees floor behind: what looks like it by chance does in one picture.
    """
    small = shrunk(shown, ROUGH).shape
    largest = largest_votes(ground.grid, ground.vote, cameras, view, small)
    hidden = largest < CERTAIN
    parts = largest, _grown(largest >= ground.threshold, 1), _grown(hidden, 1)
    largest, grown, hidden = (
        interpolate(one[None, None], shown.shape, mode="bilinear")[0, 0] for one in parts
    )
    silhouette = torch.where(within > 0, grown >= 0.5, largest >= ground.threshold)
    found = ((silhouette & (shown > 0)) | (hidden < 0.5)).numpy()
    return torch.from_numpy(_without_specks(found, SPECK)).float()


def _without_specks(found: np.ndarray, share: float) -> np.ndarray:
    """A mask [H, W] without parts, and without holes, that are small against the whole."""
    least = share * found.sum()
    for value in (True, False):
        parts = np.asarray(label(found == value, connectivity=1))
        size = np.bincount(parts.ravel())
        size[0] = found.size
        found = np.where(size[parts] < least, not value, found)
    return found


SEEN_BY = 0.25
SAMPLES = 1 << 20


def surroundings(cameras: Cameras) -> tuple[Tensor, Tensor]:
    """A cube around what the cameras look at, as large as half of their pictures show whole."""
    centre = looked_at(cameras)
    away = (cameras.camera_to_world[:, :, 3] - centre).norm(dim=1)
    tangent = cameras.size_of_each().amin(1) / (2 * cameras.focal.max(1).values)
    half = float((away * tangent / (1 + tangent.square()).sqrt()).median())
    return centre - half, centre + half


def votes(masks: Sequence[Tensor], cameras: Cameras, grid: GridShape) -> Tensor:
    """Mean of the masks [H, W] over the cameras that see a node: [X, Y, Z] in [0, 1].

    It is 0 where fewer than their share see it.
    """
    nodes = grid.nodes().reshape(-1, 3)
    total, seen_by = torch.zeros(len(nodes)), torch.zeros(len(nodes))
    for view, mask in enumerate(track(masks, "masks vote")):
        pixel, depth = project(cameras, view, nodes)
        uv = pixel * (2 / torch.tensor(cameras.size(view))) - 1
        seen = (depth > 0) & (uv.abs() <= 1).all(1)
        found = grid_sample(
            mask[None, None], uv[None, None], align_corners=False, padding_mode="border"
        )
        total += torch.where(seen, found[0, 0, 0], 0.0)
        seen_by += seen
    enough = seen_by >= max(SEEN_BY * len(masks), 1)
    return torch.where(enough, total / seen_by.clamp_min(1), 0.0).reshape(grid.size)


def largest_votes(
    grid: GridShape, vote: Tensor, cameras: Cameras, view: int, shape: tuple[int, ...]
) -> Tensor:
    """The largest vote along the rays of a picture [H, W] of this shape; 0 beside the grid."""
    width, height = cameras.size(view)
    row, column = (torch.arange(n) + 0.5 for n in shape)
    y, x = torch.meshgrid(row * (height / shape[0]), column * (width / shape[1]), indexing="ij")
    rays = pixel_rays(cameras, torch.tensor(view), torch.stack([x, y], -1).reshape(-1, 2))
    lower, upper = grid.bounds()
    # Where a ray is within the slabs of the three axes
    away = torch.where(rays.direction.abs() < 1e-9, 1e-9, rays.direction)
    ends = torch.stack([(lower - rays.origin) / away, (upper - rays.origin) / away])
    enters = ends.amin(0).amax(1).clamp_min(0)
    leaves = ends.amax(0).amin(1)
    meets = (leaves > enters).nonzero()[:, 0]
    result = torch.zeros(len(away))
    if not len(meets):
        return result.reshape(shape)
    steps = max(2, round(float((leaves - enters)[meets].max()) / grid.voxel_size))
    along = (torch.arange(steps) + 0.5) / steps
    volume = vote.permute(2, 1, 0)[None, None]  # grid_sample's x is the last axis
    for some in meets.split(max(1, SAMPLES // steps)):
        begin, length = enters[some, None], (leaves - enters)[some, None]
        t = begin + length * along
        points = rays.origin[some, None] + t[..., None] * rays.direction[some, None]
        where = 2 * (points - lower) / (upper - lower) - 1
        found = grid_sample(volume, where[None, None], align_corners=True)
        result[some] = found[0, 0, 0].amax(1)
    return result.reshape(shape)


def overlaps(largest: Tensor, mask: Tensor, levels: Tensor) -> Tensor:
    """IoU of a mask [H, W] with what has a vote [H, W] of at least each level [K]: [K].

    1 where both are empty.
    """
    shown = mask >= 0.5
    # Counted from the highest vote down, so that each level is one look-up
    order, known = largest.flatten().sort()
    first = torch.searchsorted(order, levels)
    after = torch.cat([shown.flatten()[known].flip(0).cumsum(0).flip(0), torch.zeros(1).long()])
    both, hull = after[first], len(order) - first
    either = hull + shown.sum() - both
    return torch.where(either > 0, both / either.clamp_min(1), 1.0)


def shrunk(mask: Tensor, pixels: int) -> Tensor:
    """A mask [H, W] whose longer side has at most so many pixels: means of its pixels."""
    share = min(1.0, pixels / max(mask.shape))
    height, width = (max(1, round(share * n)) for n in mask.shape)
    return interpolate(mask[None, None], (height, width), mode="area")[0, 0]
