"""Parts of the visual hull that are kept because they explain reflections.

What a mirror shows lies behind it for all photographs, so colours pull its surface there, and bend
it. Yet silhouettes give the shape of most polished things to a fraction of a voxel. Whether they do
can be seen: in a smooth surface under distant light, photographs that are mirrored to the same
direction show the same, wherever on the surface and however it is turned there. Where the hull is
wrong, its normals mirror them elsewhere, and nothing agrees.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from scipy.spatial import KDTree
from torch import Tensor

from univoxel import sphere
from univoxel.camera import Cameras
from univoxel.color import linear_to_srgb
from univoxel.data import Photos
from univoxel.fields.distances import DenseDistances
from univoxel.fields.field import Field
from univoxel.fields.grid import GridShape
from univoxel.ops import VisibilityScene
from univoxel.preparation.hull import observe_hull, visual_hull
from univoxel.render.observations import Observations

# Points of the hull that are looked at
POINTS = 8000
# Cosine of normal and direction to the camera below which sightings are left out
MIN_COSINE = 0.25
# Sightings that a point has at least
MIN_VIEWS = 8
# Voxels off the surface at which mirrored rays start
OFF_SURFACE = 2.0
# Rows, and twice as many columns, of the table of what directions send
ROWS = 24
# Sightings that have to tell what a direction sends
LEAST = 3.0
# Share of a neighbourhood's sightings that have to be told so
SHARE = 0.3
# Classes of normals, spread over the sphere
CLASSES = 64
# Degrees by which normals differ that are compared with one another
TURN = 20.0
# Points of a neighbourhood, over which sums are taken
NEIGHBOURS = 32
# Voxels that count in the search for neighbours as much as `bend`
NEAR = 3.0
# Difference of unit normals
BEND = 0.5
# Rounds in which points leave the table
ROUNDS = 8
# Root mean square, in sRGB, by which a neighbourhood changes from view to view at least
CHANGE = 0.18
# Times that points which stay in the table show its changes
GAIN = 0.6
# Share of all points that the table is made of at least: some agree by chance
LEAST_SHARE = 0.05
# Correlation of their changes with those of the table
CORRELATION = 0.5
# Change of points of the table from which regions grow that are frozen. Half of the chrome of a
# scene changed by 0.30 to 0.43, half of its rough copper by 0.18 to 0.31: that is trained better
# than it is frozen
STRONG_CHANGE = 0.33
# Change of points that they take in
WEAK_CHANGE = 0.26
# Correlation of such points
WEAK_CORRELATION = 0.2
# Voxels around the surface within which nodes stay
BAND = 3.0


# Shares of a point's neighbours that take it into a region, or, some, if it is weak; and rounds
MOST, SOME = 0.5, 0.3
GROWTHS, TRIMS = 4, 3


@dataclass(frozen=True)
class PinnedHull:
    """Points of the visual hull, and which of them get no gradient."""

    position: Tensor  # [P, 3] world
    pinned: Tensor  # [P] bool
    distance: Tensor  # of masks, as in `visual_hull`
    cameras: Cameras

    def nodes(self, sdf: Tensor, grid: GridShape) -> Tensor:
        """Which nodes of a grid stay, by the point next to each: [X, Y, Z] bool.

        Args:
            sdf: [X, Y, Z] of the visual hull, world units.
        """
        near = sdf.abs() < BAND * grid.voxel_size
        point = _nearest(grid.nodes()[near], self.position, 1)[:, 0]
        return torch.zeros_like(near).masked_scatter(near, self.pinned[point])

    @torch.no_grad()
    def pin_(self, field: Field) -> None:
        """Put the hull back where it is frozen, and give its nodes there no gradient from now on.

        A field in bricks, which are finer than the hull is right, stays as it is.
        """
        distances = field.distances
        if not isinstance(distances, DenseDistances) or distances.pinned is not None:
            return
        hull = visual_hull(self.distance, self.cameras, field.grid)
        distances.pinned = self.nodes(hull, field.grid)
        distances.sdf[distances.pinned] = hull[distances.pinned]
        field.refresh()


@torch.no_grad()
def pinned_hull(
    photos: Photos,
    distance: Tensor,
    hull: Tensor,
    grid: GridShape,
) -> PinnedHull | None:
    """Where training leaves the visual hull as it is; None: nowhere.

    Args:
        photos: in one light and exposure, their cameras where they are believed to be.
        distance: of masks, as in `visual_hull`.
        hull: [X, Y, Z] sdf of the visual hull on the grid, world units.
    """
    seen = observe_hull(photos, hull, grid, POINTS)
    if seen is None:
        return None
    pinned = mirroring(seen, hull, grid)
    if not pinned.any():
        return None
    return PinnedHull(seen.position, pinned, distance, photos.cameras)


def mirroring(seen: Observations, hull: Tensor, grid: GridShape) -> Tensor:
    """Which of N points change as others do that mirror the same direction: [N] bool.

    A table of what each direction sends is the mean of what points show that mirror it. A point is
    compared with what points say whose normals differ from its own by `turn`: neighbours on a plane
    would agree whatever they show. Points that change least as the table does leave it, round by
    round.
    """
    sightings = open_observations(seen, hull, grid)
    if sightings is None:
        return torch.zeros(len(seen.position), dtype=torch.bool)
    total, count = sightings.total, sightings.count
    change = sightings.centred(sightings.color, torch.ones(len(sightings.point)))
    rms = (sightings.around(total(change.square().sum(1))) / sightings.around(count)).sqrt()
    in_table = rms > CHANGE
    for i in range(ROUNDS):
        gain, correlation = sightings.explained(in_table)
        strictness = min(1.0, (i + 1) / (ROUNDS / 2))
        in_table = rms > CHANGE
        in_table &= (gain > strictness * GAIN) & (correlation > strictness * CORRELATION)
        if in_table.sum() < LEAST_SHARE * len(in_table):
            return torch.zeros_like(in_table)
    place = torch.cat([seen.position / (NEAR * grid.voxel_size), seen.normal], 1)
    weak = (rms > WEAK_CHANGE) & (correlation > WEAK_CORRELATION)
    nearest = _nearest(place, place, NEIGHBOURS)
    return grown(in_table & (rms > STRONG_CHANGE), weak, nearest)


def grown(strong: Tensor, weak: Tensor, nearest: Tensor) -> Tensor:
    """Regions that begin where most points are strong, and take in weak ones and holes: [N] bool.

    Some of a mirror shows what is beside it, or is not seen often enough.

    Args:
        strong, weak: [N] bool.
        nearest: [N, K] int64, neighbours of each.
    """

    def share(region: Tensor) -> Tensor:
        return region[nearest].float().mean(1)

    region = strong & (share(strong) > MOST)
    for _ in range(GROWTHS):
        region = region | (weak & (share(region) > SOME)) | (share(region) > MOST)
    for _ in range(TRIMS):
        region = region & (share(region) > SOME)
    return region


@dataclass(frozen=True)
class MirrorObservations:
    """What S photographs show of N points, where nothing of the object is mirrored."""

    point: Tensor  # [S] int64
    color: Tensor  # [S, 3] sRGB
    bin: Tensor  # [S] int64, of the reflected direction
    turned: Tensor  # [N] int64, class of the normal
    apart: Tensor  # [K, K] float 0 or 1, whether classes of normals differ by `turn`
    neighbours: Tensor  # [N, M] int64, points around each that were seen often enough
    least: float  # sightings that tell what a direction sends
    share: float  # of the sightings that have to be told

    @property
    def count(self) -> Tensor:
        """[N] sightings of each point."""
        return torch.bincount(self.point, minlength=len(self.turned)).float()

    def total(self, values: Tensor) -> Tensor:
        """Sums of values [S, ...] over each point: [N, ...]."""
        return values.new_zeros(len(self.turned), *values.shape[1:]).index_add(
            0, self.point, values
        )

    def around(self, values: Tensor) -> Tensor:
        """Sums of values [N] over each point's neighbours: [N]."""
        return values[self.neighbours].sum(1)

    def centred(self, values: Tensor, weight: Tensor) -> Tensor:
        """Values [S, 3] less their mean over each point, times weights [S] of 0 and 1."""
        mean = self.total(weight[:, None] * values) / self.total(weight).clamp_min(1)[:, None]
        return weight[:, None] * (values - mean[self.point])

    def explained(self, in_table: Tensor) -> tuple[Tensor, Tensor]:
        """Around each point, how many times the changes of the table it shows, and how alike both
        are: gain and correlation [N]; 0 where the table says too little.

        Args:
            in_table: [N] bool, points that it is made of.
        """
        classes, bins = len(self.apart), int(self.bin.max()) + 1
        cell, weight = self.bin * classes + self.turned[self.point], in_table[self.point].float()
        sums = self.color.new_zeros(bins * classes, 4)
        sums.index_add_(
            0, cell, weight[:, None] * torch.nn.functional.pad(self.color, (0, 1), value=1)
        )
        others = torch.einsum("bkc,kj->bjc", sums.view(bins, classes, 4), self.apart)
        color, weight = others.reshape(-1, 4)[cell].split([3, 1], 1)
        told = (weight[:, 0] >= self.least).float()
        shown = self.centred(self.color, told)
        sent = self.centred(color / weight.clamp_min(1), told)
        products = (shown * sent, shown * shown, sent * sent)
        both, of_shown, of_sent = (self.around(self.total(p.sum(1))) for p in products)
        enough = self.around(self.total(told)) > self.share * self.around(self.count)
        gain = torch.where(enough, both / of_sent.clamp_min(1e-9), 0.0)
        return gain, torch.where(enough, both / (of_shown * of_sent).clamp_min(1e-12).sqrt(), 0.0)


def open_observations(
    seen: Observations, hull: Tensor, grid: GridShape
) -> MirrorObservations | None:
    """The sightings that can be compared; None: too few points have any."""
    point = torch.repeat_interleave(seen.offsets.diff())
    normal = seen.normal[point]
    cosine = (normal * seen.wo).sum(1)
    mirrored = 2 * cosine[:, None] * normal - seen.wo
    occluder = VisibilityScene(*DenseDistances(grid, hull).isosurface())
    start = seen.position[point] + OFF_SURFACE * grid.voxel_size * normal
    usable = (cosine > MIN_COSINE) & ~occluder.occluded(start, mirrored)
    point, mirrored = point[usable], mirrored[usable]
    decided = torch.bincount(point, minlength=len(seen.normal)) >= MIN_VIEWS
    decided = decided.nonzero()[:, 0]
    if len(decided) < NEIGHBOURS:
        return None
    place = torch.cat([seen.position / (NEAR * grid.voxel_size), seen.normal / BEND], 1)
    u, v = sphere.direction_to_latlong(mirrored).unbind(1)
    column = (u * 2 * ROWS).long() % (2 * ROWS)
    classes = sphere.fibonacci_sphere(CLASSES)
    return MirrorObservations(
        point,
        linear_to_srgb(seen.color[usable].clamp(0, 1)),
        (v * ROWS).long().clamp_max(ROWS - 1) * 2 * ROWS + column,
        (seen.normal @ classes.T).argmax(1),
        (classes @ classes.T < math.cos(math.radians(TURN))).float(),
        decided[_nearest(place, place[decided], NEIGHBOURS)],
        LEAST,
        SHARE,
    )


def _nearest(place: Tensor, among: Tensor, count: int) -> Tensor:
    """Index [N, count] of those among [P, D] that are nearest to each place [N, D]."""
    index = KDTree(among.numpy()).query(place.numpy(), k=count, workers=-1)[1]
    return torch.from_numpy(index).reshape(len(place), count)
