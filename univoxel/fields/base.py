"""What every field of the scene's geometry and appearance offers."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar

from torch import Tensor, nn

from univoxel.grid import GridShape
from univoxel.records import FieldSample, Rays, Samples

BAND = 4.0  # voxels from the surface beyond which density is nothing: 8 s at a sharpness of 0.5


class AbstractField(nn.Module, ABC):
    """A signed distance and C features everywhere in a box.

    Gradients to sdf and features are sparse: only the nodes around samples are in them, and
    `RowAdam` updates only those. Their rows are the numbers of these nodes.
    """

    kind: ClassVar[str]  # its name in configurations and files
    grid: GridShape
    channels: int  # C
    voxel_size: float  # finest resolution, world units
    by_node: ClassVar[bool] = True  # whether each row of the features is a node's
    sdf: nn.Parameter
    features: nn.Parameter  # as the sdf, and C; or a table of its own

    @property
    def distances(self) -> AbstractField:
        """What keeps the distances: this field, or one within."""
        return self

    @abstractmethod
    def sample(self, points: Tensor) -> FieldSample:
        """SDF, its spatial gradient and features at world points [M, 3]."""

    @abstractmethod
    def features_at(self, points: Tensor) -> Tensor:
        """The features [M, C] alone: no gradient to the sdf, not even one of zeros."""

    @abstractmethod
    def march(self, rays: Rays, jitter: Tensor, inv_s: float) -> Samples:
        """The samples along rays that matter under density sharpness 1 / s; no gradients."""

    @abstractmethod
    def refresh(self) -> bool:
        """Look again which bricks are empty, after the sdf has moved; True: nodes were added.

        Where a field needs room for that, sdf and features are new parameters afterwards, with
        more rows at the end: `RowAdam.follow` takes the optimiser along.
        """

    @abstractmethod
    def smooth_rows_(self, values: Tensor, rows: Tensor, amount: float, order: int) -> None:
        """`ops.smooth_rows_` of something that has a value, or C, where the sdf has one."""

    @abstractmethod
    def diffuse_rows_(self, values: Tensor, rows: Tensor, amount: float, passes: int) -> None:
        """`ops.diffuse_rows_` of values [K] of nodes of the sdf."""

    def smooth_features_(self, rows: Tensor, amount: float) -> None:
        """`smooth_rows_` of the features of these rows, where rows are nodes."""
        self.smooth_rows_(self.features.data, rows, amount, order=1)

    def keep_channels(self, keep: Tensor) -> None:
        """Have only the channels of these numbers [K], increasing; features are a new parameter.
        Of fields whose rows are nodes."""
        assert self.by_node
        self.features = nn.Parameter(self.features.data[..., keep].contiguous())
        self.channels = len(keep)

    def hold_channels_(self, count: int) -> None:
        """Drop the gradient to the first channels, which then stay as they are."""
        assert self.features.grad is not None
        self.features.grad._values()[:, :count] = 0

    @abstractmethod
    def occupied(self) -> Tensor:
        """Which nodes of the grid have features: [X, Y, Z] bool."""

    @abstractmethod
    def within(self, far: float) -> Tensor:
        """Which nodes of the grid have an sdf nearer to 0 than far: [X, Y, Z] bool."""

    def rows_near(self, far: float) -> Tensor:
        """Which rows of the features are read where the sdf is nearer to 0 than far: [R] bool."""
        return self.sdf.detach().abs().flatten() < far

    @abstractmethod
    def blocks(self, far: float) -> Tensor:
        """Whether the sdf can be nearer to 0 than far in each block of 4^3 voxels: [A, B, C]."""

    @abstractmethod
    def isosurface(self) -> tuple[Tensor, Tensor]:
        """Vertices [P, 3] float32 and faces [F, 3] int32 of the zero level (marching cubes,
        Lewiner et al. 2003), counter-clockwise seen from outside.

        Raises:
            ValueError: the sdf has no zero level.
        """

    @abstractmethod
    def resized(self, grid: GridShape) -> AbstractField:
        """The same field on another grid, by trilinear interpolation."""

    @abstractmethod
    def bounds(self) -> tuple[Tensor, Tensor]:
        """Lower and upper corner [3], [3] of the box, world units."""
