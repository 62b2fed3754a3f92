"""The visual hull: bounds and a first SDF from silhouettes, and colours of its points."""

from __future__ import annotations

import numpy as np
import torch
from scipy import ndimage
from torch import Tensor
from torch.nn.functional import interpolate, normalize

from univoxel.camera import Cameras, looked_at, project, projection_matrices
from univoxel.core import memmap
from univoxel.core.memmap import parallel_map
from univoxel.core.records import Mesh
from univoxel.data import Photos
from univoxel.data.photos import coverage_of
from univoxel.errors import UserError
from univoxel.fields.distances import DenseDistances
from univoxel.fields.grid import GridShape, fit_coarse, fit_grid, resample
from univoxel.ops import VisibilityScene, native
from univoxel.render.observations import Observations, observe, surface_points

# The half of the first box over what the widest view shows at its distance
FIRST_BOX = 1.2
# Nodes of the grids that find the box, each around what the one before found, and so finer. With a
# coarser first one the box is wider by a hundredth, and so are the voxels of all grids
BOX_NODES = (64**3, 64**3)
# Pixels of the longer side that a picture keeps at least where distances to edges are found in a
# smaller one, in a quarter of the time. Of a disk in twice as many, those near its edge are .2
# pixels off in the median and .9 at most; in the picture itself .17 and .5
SMALLER = 500
# Share of the box's diagonal, left free around the hull
MARGIN = 0.03
# Nodes at which the hull is evaluated, about; finer grids are interpolated, for time
NODES = 1e6
# Share of the views that have to carve a node where masks are doubted: one in ten may lack a
# part, hardly ever the same part. Two views at least
DOUBTED_VOTES = 0.07
# Share of the views that have to see a node where masks are doubted. Orbits have the whole object
# in nearly all of their pictures
DOUBTED_SEEN = 0.25


def mask_distances(alpha: Tensor, cameras: Cameras | None = None) -> Tensor:
    """Signed distance to the silhouette in pixels, negative inside, of coverage [V, H, W] that is
    stored as in `Photos`: [V, H, W] float32, in a file where they are large.

    Sub-pixel: a half-covered pixel lies on the silhouette. Infinite beyond a picture. Where the
    object leaves the picture there is no silhouette: the picture's edge is none. Of pictures of
    twice SMALLER pixels and more the distances are those of smaller ones, interpolated.

    Args:
        cameras: V, which know the sizes of the pictures, where these differ.
    """
    distances = memmap.zeros(alpha.shape, torch.float32)
    result = distances.numpy()

    def fill_(view: int) -> None:
        covered = coverage_of(alpha[view])
        a = covered if cameras is None else cameras.cut(view, covered)
        result[view] = np.inf
        result[view, : a.shape[0], : a.shape[1]] = _mask_distance_of_any(a)

    parallel_map(fill_, range(len(alpha)))
    return distances


def _mask_distance_of_any(alpha: Tensor) -> np.ndarray | float:
    """That of one picture [H, W], or of all its pixels."""
    factor = max(1, max(alpha.shape) // SMALLER)
    if factor == 1:
        return _mask_distance(alpha.numpy())
    size = [max(1, round(n / factor)) for n in alpha.shape]
    small = interpolate(alpha[None, None], size, mode="area")[0, 0]
    distance = torch.as_tensor(_mask_distance(small.numpy()), dtype=torch.float32)
    distance = factor * distance.expand(small.shape)
    return interpolate(distance[None, None], alpha.shape, mode="bilinear")[0, 0].numpy()


def _mask_distance(alpha: np.ndarray) -> np.ndarray | float:
    """That of one picture [H, W], or of all its pixels."""
    inside = alpha >= 0.5
    if not inside.any():
        return max(alpha.shape)  # nothing seen: everything is far outside
    if inside.all():
        return -max(alpha.shape)  # it ends beyond the picture, nobody knows where
    outside, depth = (ndimage.distance_transform_edt(m) for m in (~inside, inside))
    d = np.asarray(outside) - np.asarray(depth)
    # Next to the edge the distance to pixel centres is 1; coverage says where in between.
    edge = np.abs(d) <= 1
    d = d - np.sign(d) * 0.5
    return np.where(edge & (alpha > 0) & (alpha < 1), 0.5 - alpha, d)


def hull_sdf(
    distance: Tensor,
    cameras: Cameras,
    points: Tensor,
    votes: int = 1,
    seen_by: int = 1,
    wider: float = 0.0,
) -> Tensor:
    """Signed distance to the visual hull, a lower bound of the object's: [P, 3] -> [P].

    The largest over views of the silhouette's distance times depth / focal length. Outside a
    picture there is nothing where its silhouette stays clear of the border; where the silhouette
    is cut off by it, the view says nothing.

    Args:
        distance: [V, H, W] from `mask_distances`.
        votes: views, >= 1, that have to say so before a point is outside, or half of those that
            can say anything of it, if these are fewer; with more than one the hull is somewhat too
            large, and wrong masks of fewer views do not bite into it.
        seen_by: views, >= 1, that have to be able to say anything of a point; others are outside.
        wider: pixels that silhouettes are taken to be wider by.
    """
    if not native.serves(points):
        return hull_sdf_reference(distance, cameras, points, votes, seen_by, wider)
    sdf, uncut = points.new_empty(len(points)), torch.zeros(len(cameras), dtype=torch.uint8)
    for v in range(len(cameras)):
        uncut[v] = _uncut(cameras.cut(v, distance[v]), wider)
    sizes, focal = cameras.size_of_each().int(), cameras.focal.mean(1)
    views = points, projection_matrices(cameras), sizes, distance, uncut, focal
    arrays = native.arrays(*(t.contiguous() for t in views), sdf)
    native.require().hull_sdf(*arrays, votes, seen_by, wider, native.threads())
    return sdf


def _uncut(shown: Tensor, wider: float) -> bool:
    """Whether a silhouette stays clear of the border of its picture [H, W] of distances."""
    border = [shown[0], shown[-1], shown[:, 0], shown[:, -1]]
    return all(float(b.amin()) > wider for b in border)


def hull_sdf_reference(
    distance: Tensor, cameras: Cameras, points: Tensor, votes: int, seen_by: int, wider: float
) -> Tensor:
    """Reference in eager PyTorch."""
    highest = torch.full((votes, len(points)), -torch.inf)  # of the views so far, the largest first
    voters = torch.zeros(len(points), dtype=torch.int64)
    for v in range(len(cameras)):
        pixel, depth = project(cameras, v, points)
        uv = pixel * (2 / torch.tensor(cameras.size(v))) - 1
        shown = cameras.cut(v, distance[v])
        uncut = _uncut(shown, wider)
        d = torch.nn.functional.grid_sample(
            shown[None, None], uv[None, None], align_corners=False, padding_mode="border"
        )
        d = d[0, 0, 0] - wider
        seen = (depth > 0) & (uv.abs() <= 1).all(1)
        bound = d.clamp_min(0.5) if uncut else torch.full_like(d, -torch.inf)
        bound = torch.where(seen, d, bound) * depth.abs() / cameras.focal[v].mean()
        voters += bound > -torch.inf
        for rank in range(votes):
            highest[rank], bound = (
                torch.maximum(highest[rank], bound),
                torch.minimum(highest[rank], bound),
            )
    enough = ((voters + 1) // 2).clamp(1, votes)
    sdf = highest.gather(0, enough[None] - 1)[0]
    return torch.where(voters < seen_by, torch.inf, sdf)


def votes_needed(views: int) -> int:
    """How many of so many views have to carve a point where their masks are doubted."""
    return max(1, min(max(2, round(DOUBTED_VOTES * views)), views // 3))


def views_needed(views: int, votes: int) -> int:
    """How many of so many views have to see a point of the object.

    Where masks are doubted, some end where the pictures do, or each at another place of what the
    object stands on: what lies out there is seen by few, and these are no proof.

    Args:
        votes: see `hull_sdf`; with one, masks are believed.
    """
    return 1 if votes == 1 else max(1, min(round(DOUBTED_SEEN * views), views))


def estimate_bounds(
    distance: Tensor,
    cameras: Cameras,
    votes: int = 1,
    wider: float = 0.0,
) -> tuple[Tensor, Tensor]:
    """Corners [3], [3] of a box around the visual hull, with a margin.

    Args:
        votes, wider: see `hull_sdf`.

    Raises:
        UserError: the silhouettes share no volume.
    """
    centre = looked_at(cameras)
    eye_distance = (cameras.camera_to_world[:, :, 3] - centre).norm(dim=1)
    longer_side = cameras.size_of_each().amax(1)
    field_of_view = longer_side / (2 * cameras.focal.min(1).values)
    half = float((eye_distance * field_of_view).max()) * FIRST_BOX
    lower, upper = centre - half, centre + half
    for count in BOX_NODES:
        grid = fit_grid(lower, upper, count)
        nodes = grid.nodes().reshape(-1, 3)
        seen_by = views_needed(len(cameras), votes)
        sdf = hull_sdf(distance, cameras, nodes, votes, seen_by, wider)
        inside = nodes[sdf < grid.voxel_size]
        if not len(inside):
            raise UserError(
                "the silhouettes of the photographs have no common volume: check masks and cameras"
            )
        lower, upper = inside.amin(0), inside.amax(0)
        margin = MARGIN * (upper - lower).norm() + grid.voxel_size
        lower, upper = lower - margin, upper + margin
    return lower, upper


def visual_hull(distance: Tensor, cameras: Cameras, grid: GridShape, votes: int = 1) -> Tensor:
    """SDF of the visual hull on a grid: [X, Y, Z], world units; at about NODES evaluated.

    Args:
        votes: see `hull_sdf`.
    """
    stride = max(1, round((np.prod(grid.size) / NODES) ** (1 / 3)))
    coarse = fit_coarse(grid, stride)
    seen_by = views_needed(len(cameras), votes)
    sdf = hull_sdf(distance, cameras, coarse.nodes().reshape(-1, 3), votes, seen_by)
    sdf = sdf.reshape(coarse.size)
    far = sum(n * n for n in grid.size) ** 0.5 * grid.voxel_size
    return resample(sdf.clamp(-far, far), coarse, grid)


# What the photographs show of points of the visual hull.


@torch.no_grad()
def observe_hull(photos: Photos, sdf: Tensor, grid: GridShape, points: int) -> Observations | None:
    """Observations of points spread over the hull; None: it has no surface.

    Args:
        photos: their cameras where they are believed to be.
        sdf: [X, Y, Z] of the hull on the grid, world units.
    """
    if not sdf.min() < 0 < sdf.max():
        return None
    field = DenseDistances(grid, sdf)
    vertices, faces = field.isosurface()
    normals = normalize(field.sample(vertices).gradient, dim=1, eps=1e-6)
    mesh = Mesh(vertices, faces, normals)
    spread = surface_points(mesh, points, torch.Generator().manual_seed(0))
    return observe(*spread, photos, VisibilityScene(vertices, faces), grid.voxel_size)
