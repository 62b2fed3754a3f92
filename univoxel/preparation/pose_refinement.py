"""Silhouette-based pose refinement, and the choice between wrong cameras and wrong masks."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from univoxel.camera import Cameras, PoseSteps, pixel_rays
from univoxel.core import log, memmap
from univoxel.core.choices import CamerasFrom, MasksFrom
from univoxel.core.records import Rays
from univoxel.data import Photos
from univoxel.errors import UserError
from univoxel.optim import RowAdam
from univoxel.preparation.hull import estimate_bounds, votes_needed
from univoxel.preparation.matches import Agreement, agreement, find_matches

# Pixels to the silhouette, negative inside and rising, that count as its edge
EDGE = (-1.6, -0.5)
# Points along a ray, where silhouettes are looked up; twice, the second time closer
RAY_SAMPLES = 48
# Rays through edges that the contradiction is measured with
TEST_RAYS = 1000
# Share of these rays that miss by less than the contradiction
QUANTILE = 0.95
# Pixels above which cameras are refined. Exact ones contradict by -0.3 or less: measured -0.7 to
# -0.4 in 19 of 20 scenes
MAX_CONTRADICTION = 0.25
# Steps of Adam
STEPS = 150
# Learning rate at the start and the end, radians and radii of the object
LR = (5e-3, 2.5e-4)
# Rays of a step
RAYS = 256
# Silhouettes that the rays of a step are held against
VIEWS = 32


class Edges:
    """Rays through the edges of V silhouettes, and how near all silhouettes let them come.

    The edge of a silhouette is where rays graze the object: on each of them lies a point that every
    other silhouette contains too. Where there is none, cameras or masks are wrong.

    Source: Hernandez, Schmitt, Cipolla 2007, "Silhouette Coherence for Camera Calibration under
    Circular Motion".
    """

    def __init__(
        self,
        distance: Tensor,
        box: tuple[Tensor, Tensor],
        doubted: Tensor | None = None,
    ) -> None:
        """
        Args:
            distance: [V, H, W] from `hull.mask_distances`, pixels; infinite beyond a picture.
            box: corners [3], [3] around the object.
            doubted: [V, H, W] bool, where an edge is none.
        """
        low, high = EDGE
        self.ray_samples: int = RAY_SAMPLES
        self.distance = distance
        self.extended: Tensor = _extended(distance)
        edges = [((d > low) & (d < high)).nonzero() for d in distance]
        view = torch.repeat_interleave(torch.tensor([len(e) for e in edges]))
        self.pixels: Tensor = torch.cat(
            [view[:, None], torch.cat(edges)], 1
        )  # [K, 3] with row, column
        if doubted is not None:
            self.pixels = self.pixels[~doubted[self.pixels.unbind(1)]]
        self.middle: Tensor = (box[0] + box[1]) / 2
        self.reach: float = float((box[1] - box[0]).norm()) / 2

    def sample(self, count: int, generator: torch.Generator) -> Tensor:
        """So many edge pixels [count, 3], drawn with replacement."""
        return self.pixels[torch.randint(len(self.pixels), (count,), generator=generator)]

    def missed(self, cameras: Cameras, pixels: Tensor, others: Tensor) -> Tensor:
        """Pixels [N] that rays through edges miss other silhouettes by: below 0 where a point on
        the ray lies in all of them. Differentiable in the cameras.

        Args:
            others: [K] views to hold them against.
        """
        view, row, column = pixels.unbind(1)
        centre = torch.stack([column, row], 1) + 0.5
        rays = pixel_rays(cameras, view, centre)
        with torch.no_grad():
            nearest, other = self._nearest(cameras, rays, others)
        pixel, _ = _seen(cameras, rays.origin + nearest[:, None] * rays.direction, other)
        uv = pixel * torch.tensor([2 / cameras.width, 2 / cameras.height]) - 1
        # Views are the slices of a volume, of which each point takes its own
        slice_ = (2 * other + 1) / len(self.distance) - 1
        where = torch.cat([uv, slice_[:, None].to(uv)], 1)[None, None, None]
        volume = self.extended[None, None]
        missed = grid_sample(volume, where, align_corners=False, padding_mode="border")
        return missed[0, 0, 0, 0]

    def _nearest(self, cameras: Cameras, rays: Rays, others: Tensor) -> tuple[Tensor, Tensor]:
        """Distance [N] along each ray where it is least outside, and the view [N] that says so."""
        middle = ((self.middle - rays.origin) * rays.direction).sum(1)
        reach = self.reach
        for _ in range(2):  # again, closer, around what was found
            share = torch.linspace(-1, 1, self.ray_samples)
            t = middle[:, None] + reach * share
            points = rays.origin[:, None] + t[..., None] * rays.direction[:, None]
            outside, view = self._outside(cameras, points.reshape(-1, 3), others)
            best = outside.view(t.shape).argmin(1, keepdim=True)
            middle, reach = t.gather(1, best)[:, 0], 2 * reach / self.ray_samples
        return middle, view.view(t.shape).gather(1, best)[:, 0]

    def _outside(self, cameras: Cameras, points: Tensor, others: Tensor) -> tuple[Tensor, Tensor]:
        """Most pixels [P] that points lie outside of a silhouette, and of whose [P]."""
        most = torch.full((len(points),), -torch.inf)
        worst = torch.full((len(points),), int(others[0]))
        for v in others.tolist():
            pixel, depth = _seen(cameras, points, torch.tensor(v))
            uv = pixel * (2 / torch.tensor(cameras.size(v))) - 1
            shown = cameras.cut(v, self.distance[v])
            d = grid_sample(shown[None, None], uv[None, None], align_corners=False)[0, 0, 0]
            seen = (depth > 0) & (uv.abs() <= 1).all(1)  # beyond its picture a view says nothing
            further = seen & (d > most)
            most[further], worst[further] = d[further], v
        return torch.where(most.isinf(), torch.inf, most), worst  # unseen places are outside


def contradiction(
    distance: Tensor,
    cameras: Cameras,
    box: tuple[Tensor, Tensor],
    doubted: Tensor | None = None,
) -> float:
    """Pixels that a QUANTILE of the rays through silhouettes' edges miss the others by, at
    most: -0.3 or less where cameras and masks are exact, about their error where they are not.

    Args:
        distance, box, doubted: see `Edges`.
    """
    edges, generator = Edges(distance, box, doubted), torch.Generator().manual_seed(0)
    if not len(edges.pixels):
        return 0.0
    pixels, views = edges.sample(TEST_RAYS, generator), torch.arange(len(cameras))
    missed = edges.missed(cameras, pixels, views)
    return float(missed.quantile(QUANTILE))


def align_(
    poses: PoseSteps,
    distance: Tensor,
    cameras: Cameras,
    box: tuple[Tensor, Tensor],
) -> None:
    """Move the cameras, by steps of `poses`, to where their silhouettes agree.

    What silhouettes do not show - how a ball is turned - stays as it is.

    Args:
        distance, box: see `Edges`.
    """
    edges, generator = Edges(distance, box), torch.Generator().manual_seed(0)
    if not len(edges.pixels):
        return
    begin, end = LR
    optimizer = RowAdam(poses.parameters(), betas=(0.9, 0.99))
    poses.train()
    for k in range(STEPS):
        optimizer.param_groups[0]["lr"] = begin * (end / begin) ** (k / STEPS)
        now = poses.corrected(cameras)
        others = torch.randperm(len(cameras), generator=generator)[:VIEWS]
        missed = edges.missed(now, edges.sample(RAYS, generator), others)
        # An edge pixel's own silhouette contains it by some 1: only more than that contradicts
        off = (missed - sum(EDGE) / 2).clamp_min(0)
        optimizer.zero_grad()
        (off.square() / (1 + off)).mean().backward()  # robust: some masks are wrong, not cameras
        optimizer.step()


def _extended(distance: Tensor) -> Tensor:
    """Distances [V, H, W] with what is at the border of a picture beyond it too."""
    if all(bool(d.isfinite().all()) for d in distance):
        return distance
    extended = memmap.zeros(distance.shape, distance.dtype)
    for picture, given in zip(extended, distance, strict=True):
        picture.copy_(given)
        there = given.isfinite()
        height, width = int(there[:, 0].sum()), int(there[0].sum())
        picture[:height, width:] = picture[:height, width - 1 : width]
        picture[height:] = picture[height - 1]
    return extended


def _seen(cameras: Cameras, points: Tensor, view: Tensor) -> tuple[Tensor, Tensor]:
    """Where a view, or views [N], see points [N, 3]: in pixels [N, 2], and depth [N]."""
    pose = cameras.camera_to_world[view]
    x, y, z = ((points - pose[..., 3])[:, None] @ pose[..., :3])[:, 0].unbind(1)
    return torch.stack([x, -y], 1) / -z[:, None] * cameras.focal[view] + cameras.centre[view], -z


def registered_poses(distance: Tensor, cameras: Cameras, box: tuple[Tensor, Tensor]) -> PoseSteps:
    """Steps to cameras whose silhouettes agree, as far as these tell; logs how far they went.

    Args:
        distance, box: see `Edges`.
    """
    poses, rest = aligned_poses(distance, cameras, box)
    moved = poses.moved(cameras).square().mean().sqrt()
    result = "agree"
    if rest > MAX_CONTRADICTION:
        result = f"are still inconsistent by {rest:.1f} pixels"
    log.info("camera poses refined by %.1f pixels on average; the silhouettes %s", moved, result)
    return poses


def aligned_poses(
    distance: Tensor, cameras: Cameras, box: tuple[Tensor, Tensor]
) -> tuple[PoseSteps, float]:
    """Steps to cameras whose silhouettes agree, and what they still contradict one another by."""
    half = (box[1] - box[0]) / 2
    poses = PoseSteps(len(cameras))
    poses.about(cameras, box[0] + half, float(half.max()))
    align_(poses, distance, cameras, box)
    return poses, contradiction(distance, poses.eval().corrected(cameras), box)


# Cameras or masks: which are believed where silhouettes are inconsistent.


# Pixels of the median match, up to which cameras can be right: those of structure from motion are
# off by 0.2 to 0.8, those that are off by more are worth refining
MAX_DISTANCE = 1.0
# How many times further silhouettes are inconsistent where masks are to blame: cameras
# that are off make both large, the contradiction up to twice as much as the distance
DOUBT = 4.0
# Share of the contradiction that cameras which are refined leave at most, if it was their fault:
# then silhouettes agree to the pixel, of rough masks half of it and more is left
MENDED = 0.25


@dataclass(frozen=True)
class Belief:
    """What is made of cameras and masks."""

    box: tuple[Tensor, Tensor]  # corners [3], [3] around the object
    refined: bool  # whether the cameras are refined
    votes: int = 1  # views that have to carve a node, >= 1; more than one where masks are doubted
    off: float = 0.0  # pixels, >= 0, that doubted masks are inconsistent by; may be infinite


def choose_masks_or_poses(
    photos: Photos,
    distance: Tensor,
    wanted: CamerasFrom,
    masks: MasksFrom,
) -> Belief:
    """The box around the object, and which of cameras and masks are believed.

    Where silhouettes are inconsistent, points matched between photographs are asked. If they
    lie much nearer to where the cameras put them than the contradiction is large, it is the masks
    that are wrong. Of plain objects no points are matched: then cameras are to blame if silhouettes
    agree once they are refined.

    Args:
        distance: [V, H, W] from `hull.mask_distances`.
        wanted, masks: as in the configuration.

    Raises:
        UserError: the silhouettes share no volume.
    """
    cameras = photos.cameras
    try:
        box, none_shared = estimate_bounds(distance, cameras), None
        off = contradiction(distance, cameras, box)
    except UserError as error:
        box, none_shared, off = None, error, math.inf
    if off <= MAX_CONTRADICTION and box is not None:
        return Belief(
            _widened(box, distance, cameras, off, wanted == "refined"), wanted == "refined"
        )
    seen = agreement(cameras, find_matches(photos, distance))
    believed = right(seen, off)
    if seen is None and box is not None and (wanted, masks) == ("auto", "auto"):
        wide = _widened(box, distance, cameras, off, True)
        believed = aligned_poses(distance, cameras, wide)[1] > MENDED * off
    refined = wanted == "refined" or (wanted == "auto" and not believed)
    if believed or box is not None:
        _say(seen, off, believed, refined)
    if believed and masks == "auto":
        votes = votes_needed(len(cameras))
        return Belief(estimate_bounds(distance, cameras, votes), refined, votes, off)
    if box is None:
        assert none_shared is not None
        raise none_shared
    return Belief(_widened(box, distance, cameras, off, refined), refined)


def masks_or_poses_as_told(photos: Photos, distance: Tensor, wanted: CamerasFrom) -> Belief:
    """`choose_masks_or_poses` if there is no time to ask: single masks may be wrong, cameras are
    right.

    Raises:
        UserError: the silhouettes share no volume.
    """
    votes = votes_needed(len(photos))
    box = estimate_bounds(distance, photos.cameras, votes)
    return Belief(box, wanted == "refined", votes)


def right(seen: Agreement | None, off: float) -> bool:
    """Whether cameras are right and it is the masks that make silhouettes contradict one another by
    so many pixels."""
    if seen is None:
        return False
    return seen.median <= min(MAX_DISTANCE, off / DOUBT)


def _widened(
    box: tuple[Tensor, Tensor],
    distance: Tensor,
    cameras: Cameras,
    off: float,
    refined: bool,
) -> tuple[Tensor, Tensor]:
    """The box, or that of wider silhouettes: what wrong cameras share is too small."""
    if not (refined and off > 0):
        return box
    return estimate_bounds(distance, cameras, wider=off)


def _say(seen: Agreement | None, off: float, believed: bool, refined: bool) -> None:
    contradicting = f"silhouettes are inconsistent by {off:.1f} pixels"
    if math.isinf(off):
        contradicting = "silhouettes have no common volume"
    if seen is None and believed:
        contradicting += ", and pose refinement does not help"
    if seen is not None:
        lie = f"the epipolar error is {seen.median:.2f} pixels"
        contradicting = f"{contradicting}, and {lie}"
    if believed and not refined:
        then = "the masks are assumed to be rough; better masks would improve the result"
    else:
        then = "camera poses are refined" if refined else "try cameras=refined"
    log.info("%s: %s", contradicting, then, extra={"arguments": ("cameras",)})
