"""The shape of the object from the masks and depth maps of all photographs."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy import ndimage
from skimage.measure import label
from torch import Tensor
from torch.nn.functional import interpolate

from univoxel.camera import Cameras, image_rays, looked_at, project, projection_matrices
from univoxel.core.memmap import parallel_map
from univoxel.core.progress_bar import track
from univoxel.errors import UserError
from univoxel.fields.distances import DenseDistances
from univoxel.fields.grid import GridShape, fit_grid, resample
from univoxel.ops import VisibilityScene, native
from univoxel.preparation.hull import votes_needed
from univoxel.preparation.stereo import DepthMaps, pixels_of, reach

# Gaps that few masks see through, taken out of a hull that the others filled.
#
# Between cups on a tray, or under an arch, only pictures from the side see what is behind. They
# are outvoted, although they are right. A mask that lost a part of the object looks the same in its
# own picture, but not in those of others: without that part they have something that nothing
# covers.


# Voxels, of the pixels in which masks are compared with nodes: each then has one
GAP_PIXEL = 1.5
# Share of the silhouette's area that a gap has at least
SMALLEST_GAP = 0.002
# Rounds through all photographs, at most; one gap may open the next
GAP_ROUNDS = 3


@dataclass(frozen=True)
class _Sight:
    """What a picture sees of the hull's nodes, in pixels that are wider than a voxel."""

    shown: np.ndarray  # [H, W] the mask
    pixel: np.ndarray  # [N] uint32, of each node: row W + column; H W beside the picture
    nodes: np.ndarray  # [H W + 1] how many nodes each pixel has; the last is for those beside


def carve_gaps_(
    vote: Tensor,
    threshold: float,
    masks: Sequence[Tensor],
    cameras: Cameras,
    grid: GridShape,
) -> int:
    """Take votes [X, Y, Z] away where a mask [H, W] sees through; return of how many nodes.

    The hull, nodes of at least the threshold, loses what lies behind a gap of a mask if masks and
    silhouettes of all pictures together then differ in fewer pixels than before.
    """
    inside = vote >= threshold
    nodes = grid.nodes()[inside]
    sights = [_sight(nodes, cameras, v, mask, grid) for v, mask in enumerate(masks)]
    kept = np.ones(len(nodes), bool)
    for _ in range(GAP_ROUNDS):
        before = kept.sum()
        for one in track(sights, "seen through gaps"):
            for gap in _gaps(one):
                gone = kept & gap[one.pixel]
                if gone.any() and _agrees(sights, gone):
                    kept &= ~gone
                    for other in sights:
                        other.nodes[:] -= _count(other, gone)
        if kept.sum() == before:
            break
    vote[inside] = torch.where(torch.from_numpy(kept), vote[inside], 0.0)
    return int((~kept).sum())


def _sight(nodes: Tensor, cameras: Cameras, view: int, mask: Tensor, grid: GridShape) -> _Sight:
    where, depth = project(cameras, view, nodes)
    near = depth[depth > 0].median() if (depth > 0).any() else torch.ones(())
    wide = GAP_PIXEL * grid.voxel_size * float(cameras.focal[view].max() / near)
    size = cameras.size(view)
    width, height = (
        min(of_mask, max(1, round(n / wide)))
        for n, of_mask in zip(size, reversed(mask.shape), strict=True)
    )
    column, row = (where * torch.tensor([width / size[0], height / size[1]])).floor().unbind(1)
    seen = (depth > 0) & (row >= 0) & (row < height) & (column >= 0) & (column < width)
    pixel = torch.where(seen, row * width + column, height * width).numpy().astype(np.uint32)
    small = interpolate(mask[None, None], (height, width), mode="area")[0, 0]
    return _Sight(small.numpy() >= 0.5, pixel, np.bincount(pixel, minlength=height * width + 1))


def _gaps(sight: _Sight) -> list[np.ndarray]:
    """Parts of the silhouette [H W + 1], largest first, that the mask sees through."""
    silhouette = sight.nodes[:-1].reshape(sight.shown.shape) > 0
    through = silhouette & ~np.asarray(ndimage.binary_dilation(sight.shown), bool)
    parts = np.asarray(label(through, connectivity=1))
    area = np.bincount(parts.ravel())
    area[0] = 0
    order = np.argsort(-area)
    large = order[area[order] >= max(1, SMALLEST_GAP * silhouette.sum())]
    flat = np.append(parts.ravel(), 0)
    return [flat == part for part in large]


def _count(sight: _Sight, some: np.ndarray) -> np.ndarray:
    """How many of some nodes [N] each pixel has: [H W + 1]."""
    return np.bincount(sight.pixel[some], minlength=len(sight.nodes))


def _agrees(sights: Sequence[_Sight], gone: np.ndarray) -> bool:
    """Whether masks and silhouettes differ in fewer pixels without some nodes [N]."""
    better = 0
    for one in sights:
        count = _count(one, gone)
        empty = ((count > 0) & (count == one.nodes))[:-1]
        shown = one.shown.ravel()[empty]
        better += len(shown) - 2 * int(shown.sum())
    return better > 0


# The object told in 3D: what masks of all photographs and their depth maps say of each place.
#
# A place is free where views see a surface behind it. On a surface, masks of the views that see it
# say whose it is; a view from which something else hides it says nothing. Where no view finds a
# depth, as on smooth or mirroring things, all masks that show a place vote. So a mask that lost a
# part of the object, or kept what it stands on, is outvoted.


# Voxels along a side of the grid, and of the one that only looks where the object is
VOXELS, FIRST_VOXELS = 96, 48
# Half the side of that first grid, over `reach`
ROOM = 1.6
# Share of its largest vote: what may be the object
AROUND = 0.5
# Voxels around it that the grid takes in
MARGIN = 1
# Share of the photographs that have to see a place: what few see, few decide on
SEEN_BY = 0.25
# Voxels before and behind a depth in which a surface may lie
BAND = 2.0
# Views that have to see a surface before it counts
SURE = 3
# Share of the views with a depth there or behind it that have to see through a free place
FREE = 0.5
# Share of the masks that see a surface which take it for the object's
SHOWN = 0.5
# Thresholds for places without a surface: the one is taken whose silhouettes fit the masks best
THRESHOLDS = torch.linspace(0.3, 0.98, 35)


@dataclass(frozen=True)
class ObjectShape:
    """Where the object is, as far as photographs and masks say."""

    grid: GridShape
    inside: Tensor  # [X, Y, Z] above 0 inside of the object, in no unit
    surface: float  # share of its surface, in [0, 1], that depth maps show


@dataclass(frozen=True)
class Votes:
    """What views say of each node of a grid: all [X, Y, Z] float32, counts of views or sums."""

    seen: Tensor  # views whose picture shows it
    masks: Tensor  # of them, the sum of the masks
    free: Tensor  # views that see a surface behind it
    near: Tensor  # views that see a surface there
    behind: Tensor  # of these, the sum of how far it lies behind the surface, in [-1, 1]
    open: Tensor  # views from which no surface hides it
    open_masks: Tensor  # of them, the sum of the masks


def box_corners(box: Sequence[float]) -> Tensor:
    """The lower and the upper corner [2, 3] of a box, of X0 Y0 Z0 X1 Y1 Z1.

    Raises:
        UserError: these are no box.
    """
    values = [float(value) for value in box]
    sides = list(zip(values[:3], values[3:], strict=False))
    if len(values) != 6 or not all(-math.inf < a < b < math.inf for a, b in sides):
        raise UserError(
            "box: expected X0 Y0 Z0 X1 Y1 Z1 with X0 < X1, Y0 < Y1 and Z0 < Z1, got "
            f"{words_of(values)}",
            "box",
        )
    return torch.tensor(values).view(2, 3)


def words_of(values: Sequence[float]) -> str:
    return " ".join(f"{value:.4g}" for value in values)


def depth_in(grid: GridShape, box: Tensor) -> Tensor:
    """How far nodes [X, Y, Z] lie inside of a box [2, 3], world units, negative outside."""
    nodes = grid.nodes()
    return torch.minimum(nodes - box[0], box[1] - nodes).amin(-1)


def in_box(share: Tensor, grid: GridShape, box: Tensor | None) -> Tensor:
    """Values [X, Y, Z] of nodes, 0 outside of a box [2, 3] if there is one."""
    return share if box is None else torch.where(depth_in(grid, box) >= 0, share, 0.0)


def box_shown(cameras: Cameras, view: int, box: Tensor) -> Tensor:
    """Which pixels of a view see a box [2, 3]: [h, w] bool."""
    width, height = cameras.size(view)
    rays = image_rays(cameras, view)
    direction = torch.where(rays.direction == 0, 1e-9, rays.direction)
    hits = (box[:, None] - rays.origin) / direction
    near, far = hits.amin(0).amax(1), hits.amax(0).amin(1)
    return (far > near.clamp_min(0)).view(height, width)


def nothing_inside(box: Tensor, what: str, cameras: Cameras) -> UserError:
    """What to raise where the box [2, 3] is in the wrong place."""
    return UserError(
        f"box: expected a box around the object, got {words_of(box.flatten().tolist())}, "
        f"where {what}. The cameras look at {words_of(looked_at(cameras).tolist())}, and at least "
        f"half of them see the cube that extends {reach(cameras):.4g} from there in each direction",
        "box",
    )


def find_object(
    masks: Sequence[Tensor], maps: DepthMaps, voxels: int = VOXELS, box: Tensor | None = None
) -> ObjectShape:
    """The object that masks and depth maps agree on.

    Args:
        masks: V, [H, W] in [0, 1] of pictures of any size.
        voxels: along a side of its grid, on average.
        box: [2, 3] lower and upper corner, outside of which there is no object; masks show nothing
            beside it.

    Raises:
        UserError: the masks have nothing in common, or too little, or nothing in the box.
    """
    cameras = maps.cameras
    shown = [shrunk(m, *cameras.size(v)) for v, m in enumerate(masks)]
    centre, half = looked_at(cameras), ROOM * reach(cameras)
    corners = (centre - half, centre + half) if box is None else (box[0], box[1])
    first = fit_grid(*corners, FIRST_VOXELS**3)
    share = in_box(share_of(votes(shown, maps, first), len(masks)), first, box)
    if box is not None and share.max() < AROUND:
        raise nothing_inside(box, "most masks do not overlap", cameras)
    if not float(share.max()):
        raise UserError("the masks do not overlap anywhere in space: check masks and cameras")
    coarse = around(first, share >= AROUND * share.max(), FIRST_VOXELS**3, 0)
    found = votes(shown, maps, coarse)
    share = in_box(share_of(found, len(masks)), coarse, box)
    threshold = best_threshold(share, shown, maps, coarse)
    likely = largest_part(evidence(found, threshold, shown, maps, coarse, box)[0]) > 0
    grid = around(coarse, likely, voxels**3) if likely.any() else coarse
    inside, surface = evidence(votes(shown, maps, grid), threshold, shown, maps, grid, box)
    if not (inside > 0).any() and box is not None:
        raise nothing_inside(box, "masks and depth agree on no shape", cameras)
    if not (inside > 0).any():
        raise UserError(
            "the masks of the photographs are too faint or too few to determine the object's shape"
        )
    return ObjectShape(grid, largest_part(inside), surface)


def evidence(
    found: Votes,
    threshold: float,
    masks: Sequence[Tensor],
    maps: DepthMaps,
    grid: GridShape,
    box: Tensor | None = None,
) -> tuple[Tensor, float]:
    """Values [X, Y, Z] above 0 inside, and the share of their surface that depth maps show."""
    share = in_box(share_of(found, len(masks)), grid, box)
    carve_gaps_(share, threshold, masks, maps.cameras, grid)
    free, surface = free_and_surface(found)
    # Next to a surface its own views decide, blurred by a voxel
    votes_here = blurred(torch.where(surface, found.open, 0.0))
    whose = blurred(torch.where(surface, found.open_masks, 0.0)) / votes_here.clamp_min(1e-6)
    sure = (votes_here / SURE).clamp(0, 1)
    inside = sure * (whose - SHOWN) + (1 - sure) * (share - threshold)
    depth = found.behind / found.near.clamp_min(1)
    inside = torch.where(surface, torch.minimum(inside, SHOWN * depth), inside)
    inside = torch.where(free, inside.clamp_max(-0.5 * SHOWN), inside)
    inside = torch.where(found.seen < SEEN_BY * len(masks), -SHOWN, inside)
    if box is not None:
        inside = torch.minimum(inside, SHOWN * depth_in(grid, box) / grid.voxel_size)
    border = (inside > 0) & torch.from_numpy(ndimage.binary_dilation((inside <= 0).numpy()))
    return inside, float((border & surface).sum() / border.sum().clamp_min(1))


def votes(masks: Sequence[Tensor], maps: DepthMaps, grid: GridShape) -> Votes:
    """What views say of the nodes of a grid.

    Args:
        masks: V, [H, W] in [0, 1] of the sizes of the depth maps.
    """
    nodes, band = grid.nodes().reshape(-1, 3), BAND * grid.voxel_size
    if native.serves(nodes):
        sums, cameras = nodes.new_empty(7, len(nodes)), maps.cameras
        shown = torch.zeros_like(maps.distance)
        for view, mask in enumerate(masks):
            cameras.cut(view, shown[view]).copy_(mask)
        eye, sizes = cameras.camera_to_world[:, :, 3], cameras.size_of_each().int()
        known = maps.known.view(torch.uint8)
        views = nodes, projection_matrices(cameras), sizes, shown, maps.distance, known, eye
        arrays = native.arrays(*(t.contiguous() for t in views), sums)
        native.require().count_votes(*arrays, band, native.threads())
    else:
        sums = votes_reference(masks, maps, nodes, band)
    return Votes(*sums.view(-1, *grid.size))


def votes_reference(masks: Sequence[Tensor], maps: DepthMaps, nodes: Tensor, band: float) -> Tensor:
    """Reference in eager PyTorch: the fields of `Votes` at nodes [N, 3], [7, N]."""
    total = torch.zeros(7, len(nodes))
    for view, mask in enumerate(masks):
        row, column, seen = pixels_of(maps.cameras, view, nodes)
        eye = maps.cameras.camera_to_world[view, :, 3]
        clear = maps.distance[view][row, column] - (nodes - eye).norm(dim=1)
        known = maps.known[view][row, column] & seen
        near = known & (clear.abs() <= band)
        shown = torch.where(seen, mask[row, column], 0.0)
        hidden = known & (clear < -band)
        total += torch.stack(
            [
                seen,
                shown,
                known & (clear > band),
                near,
                torch.where(near, -clear / band, 0.0),
                seen & ~hidden,
                torch.where(hidden, 0.0, shown),
            ]
        )
    return total


def free_and_surface(found: Votes) -> tuple[Tensor, Tensor]:
    """Which nodes views see through, and which they see a surface at: [X, Y, Z] bool each."""
    free = (found.free >= SURE) & (found.free > FREE * (found.free + found.near))
    return free, (found.near >= SURE) & ~free


def share_of(found: Votes, views: int) -> Tensor:
    """Mean of the masks of the views that show a node; 0 where few do: [X, Y, Z]."""
    enough = found.seen >= max(SEEN_BY * views, 1)
    return torch.where(enough, found.masks / found.seen.clamp_min(1), 0.0)


def around(grid: GridShape, inside: Tensor, voxels: int, margin: int = MARGIN) -> GridShape:
    """A grid over the nodes [X, Y, Z] that are inside, and some voxels around them."""
    nodes, room = grid.nodes()[inside], (1 + margin) * grid.voxel_size
    return fit_grid(nodes.amin(0) - room, nodes.amax(0) + room, voxels)


def best_threshold(
    share: Tensor, masks: Sequence[Tensor], maps: DepthMaps, grid: GridShape
) -> float:
    """The share from which on a node belongs to the hull whose silhouettes fit the masks best, in
    the median of their IoU; low enough that as many masks as `votes_needed` outvote fewer."""
    nodes, values = grid.nodes().reshape(-1, 3), share.reshape(-1)
    agreed = torch.stack(
        parallel_map(
            lambda view: overlaps(nodes, values, masks[view], maps.cameras, view, grid),
            range(len(masks)),
        )
    )
    highest = 1 - (votes_needed(len(masks)) - 0.5) / len(masks)
    return min(float(THRESHOLDS[int(agreed.quantile(0.5, 0).argmax())]), highest)


def overlaps(
    nodes: Tensor, values: Tensor, mask: Tensor, cameras: Cameras, view: int, grid: GridShape
) -> Tensor:
    """IoU of a mask [H, W] with the nodes [P, 3] whose values [P] reach each threshold: [K]; in
    the pixels of `_sight`. 1 where both are empty."""
    sight = _sight(nodes, cameras, view, mask, grid)
    pixel, shown = (
        torch.from_numpy(sight.pixel.astype(np.int64)),
        torch.from_numpy(sight.shown).flatten(),
    )
    highest = torch.zeros(len(shown) + 1).scatter_reduce_(0, pixel, values, "amax")[:-1]
    covered = highest >= THRESHOLDS[:, None]
    both, either = (covered & shown).sum(1), (covered | shown).sum(1)
    return torch.where(either > 0, both / either.clamp_min(1), 1.0)


def largest_part(inside: Tensor) -> Tensor:
    """The same values [X, Y, Z], below 0 in all but the largest connected part inside."""
    parts = np.asarray(label((inside > 0).numpy(), connectivity=1))
    if parts.max() <= 1:
        return inside
    counts = np.bincount(parts.ravel())
    counts[0] = 0
    other = torch.from_numpy((parts > 0) & (parts != counts.argmax()))
    return torch.where(other, -inside, inside)


def silhouettes(shape: ObjectShape, cameras: Cameras) -> Iterator[Tensor]:
    """Which pixels of each view show the object: [h, w] bool, view after view."""
    scene = VisibilityScene(*DenseDistances(shape.grid, -shape.inside).isosurface())
    for view in range(len(cameras)):
        width, height = cameras.size(view)
        rays = image_rays(cameras, view)
        yield scene.closest_hit(rays.origin, rays.direction).t.isfinite().view(height, width)


def inside_bounds(shape: ObjectShape) -> tuple[Tensor, Tensor]:
    """Lower and upper corner [3] of the nodes inside."""
    nodes = shape.grid.nodes()[shape.inside > 0]
    return nodes.amin(0), nodes.amax(0)


def signed_distance(shape: ObjectShape, grid: GridShape) -> Tensor:
    """Distance [X, Y, Z] to the object's surface on another grid, world units, negative inside."""
    inside = resample(shape.inside, shape.grid, grid).numpy() > 0
    outer, inner = (np.asarray(ndimage.distance_transform_edt(side)) for side in (~inside, inside))
    # The surface lies halfway between nodes; a blur takes the steps off
    distance = ndimage.gaussian_filter(np.where(inside, 0.5 - inner, outer - 0.5), 1.0)
    return torch.from_numpy(distance).float() * grid.voxel_size


def shrunk(mask: Tensor, width: int, height: int) -> Tensor:
    """A mask [H, W] of another size, of means of its pixels: [height, width]."""
    return interpolate(mask[None, None], (height, width), mode="area")[0, 0]


def blurred(values: Tensor) -> Tensor:
    return torch.from_numpy(ndimage.gaussian_filter(values.numpy(), 1.0))
