"""A sparse grid of signed distances: bricks around the surface, far distances elsewhere."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch
from scipy.spatial import KDTree
from skimage.measure import marching_cubes
from torch import Tensor, nn

from univoxel.core.records import Bricks
from univoxel.errors import NoSurface
from univoxel.fields.distances import BAND, CAP, AbstractDistances
from univoxel.fields.grid import GridShape

SLAB = 64  # planes of the grid whose surface is found at once; whole bricks
SPARE = 0.05  # share of the bricks that may come without moving the others in memory
BRICKS_AT_ONCE = 4096


class BrickDistances(AbstractDistances):
    """SDF [R] as a parameter, R the rows of `bricks`.

    The sdf is cut off at BAND voxels; bricks in which it is so everywhere are missing. Memory and
    time grow with the surface. `refresh` adds bricks where the surface comes near.
    """

    bricks: Bricks

    def __init__(self, grid: GridShape, bricks: Bricks) -> None:
        far = BAND * grid.voxel_size
        sdf = torch.full((Bricks.NODES * len(bricks.place),), far)
        sdf[Bricks.NODES : 2 * Bricks.NODES] = -far
        super().__init__(grid, sdf, bricks)

    @property
    def far(self) -> float:
        """Distance beyond which nothing is stored, world units."""
        return BAND * self.voxel_size

    @property
    def count(self) -> int:
        """Bricks that are in use: the first ones."""
        return Bricks.MISSING + int((self.bricks.place >= 0).sum())

    @classmethod
    @torch.no_grad()
    def around(cls, source: AbstractDistances, grid: GridShape) -> BrickDistances:
        """What other distances are near their surface, on another grid."""
        far = BAND * grid.voxel_size
        shape = [-(-n // Bricks.SIDE) for n in grid.size]
        near_source = _overlapped(source, grid, far).flatten()
        node_offsets = torch.cartesian_prod(*[torch.arange(Bricks.SIDE)] * 3)
        stored = []
        for part in near_source.nonzero()[:, 0].split(BRICKS_AT_ONCE):
            sdf = source.sample(_nodes(grid, part, node_offsets)).sdf.view(-1, Bricks.NODES)
            stored.append(part[(sdf.abs() < far).any(1)])
        stored = torch.cat(stored) if stored else near_source.nonzero()[:, 0]
        table = torch.empty(len(near_source), dtype=torch.int32)
        for part in torch.arange(len(near_source)).split(Bricks.NODES * BRICKS_AT_ONCE):
            table[part] = (source.sample(_nodes(grid, part, node_offsets[:1])).sdf < 0).int()
        table[stored] = Bricks.MISSING + torch.arange(len(stored), dtype=torch.int32)
        used = Bricks.MISSING + len(stored)
        place = torch.full((round((1 + SPARE) * used),), -1, dtype=torch.int32)
        place[Bricks.MISSING : used] = stored.int()

        distances = cls(grid, Bricks(table.view(shape), place, grid.size))
        for rows, points in distances._stored_nodes():
            distances.sdf[rows] = source.sample(points).sdf.clamp(-far, far)
        return distances

    def _stored_nodes(self) -> Iterator[tuple[slice, Tensor]]:
        """Rows of bricks, some at a time, and the world positions [K, 3] of their nodes."""
        node_offsets = torch.cartesian_prod(*[torch.arange(Bricks.SIDE)] * 3)
        begin = Bricks.MISSING * Bricks.NODES
        for part in self.bricks.place[Bricks.MISSING : self.count].long().split(BRICKS_AT_ONCE):
            end = begin + len(part) * Bricks.NODES
            yield slice(begin, end), _nodes(self.grid, part, node_offsets)
            begin = end

    def blocks(self, far: float) -> Tensor:
        stored = torch.nn.functional.pad(self.bricks.table >= Bricks.MISSING, (0, 1) * 3)
        for axis in range(3):  # nodes at the upper faces of a block are the next one's
            n = stored.shape[axis] - 1
            stored = stored.narrow(axis, 0, n) | stored.narrow(axis, 1, n)
        return stored

    def on_grid(self, values: Tensor, begin: int = 0, end: int | None = None) -> Tensor:
        """Values [R, ...] of the rows at all nodes from plane `begin` to before `end`:
        [end - begin, Y, Z, ...]; begin is where a brick begins."""
        channels, (x, y, z) = values.shape[1:], self.grid.size
        pool = values.view(-1, *[Bricks.SIDE] * 3, *channels)
        order = 2, 0, 3, 1, 4, *range(5, 5 + len(channels))
        end = x if end is None else min(end, x)
        slab = values.new_empty(end - begin, y, z, *channels)
        for first in range(begin, end, Bricks.SIDE):
            plane = self.bricks.table[first // Bricks.SIDE].long()
            part = pool[plane].permute(order).flatten(3, 4).flatten(1, 2)
            offset = first - begin
            slab[offset : offset + Bricks.SIDE] = part[: end - first, :y, :z]
        return slab

    def isosurface(self, closed: bool = False) -> tuple[Tensor, Tensor]:
        values, (planes, *_) = self.sdf.detach(), self.grid.size
        if self.count == Bricks.MISSING or not values.min() < 0 < values.max():
            raise NoSurface("the field has no surface: its sdf does not change sign")
        parts = []
        for begin in range(0, planes - 1, SLAB):  # the whole grid would take much memory
            slab = self.on_grid(values, begin, begin + SLAB + 1).numpy()
            start = np.array([begin, 0, 0], np.float32)
            if closed:  # slabs meet inside the grid: the first has a rim before it, the last after
                ends = int(begin == 0), int(begin + SLAB + 1 >= planes)
                slab = np.pad(slab, (ends, (1, 1), (1, 1)), constant_values=CAP * self.voxel_size)
                start -= np.array([ends[0], 1, 1], np.float32)
            if slab.min() < 0 < slab.max():
                vertices, faces, _, _ = marching_cubes(slab, 0.0, gradient_direction="descent")
                parts.append((vertices + start, faces))
        vertices, faces = _sewn(parts)
        world = torch.tensor(self.grid.origin) + self.voxel_size * torch.from_numpy(vertices)
        return world.float(), torch.from_numpy(faces.astype("int32"))

    def resized(self, grid: GridShape) -> BrickDistances:
        return BrickDistances.around(self, grid)

    @torch.no_grad()
    def values_from(self, source: AbstractDistances, values: Tensor) -> Tensor:
        result = values.new_zeros(len(self.sdf), values.shape[-1])
        for rows, points in self._stored_nodes():
            result[rows] = source.interpolate(values, points)
        return result

    def _grow(self) -> bool:
        """Store every brick beside one that the surface comes within a voxel of; False: there is
        none to store."""
        bricks, count = self.bricks, self.count
        low, high = torch.aminmax(self.sdf.detach()[: count * Bricks.NODES].view(count, -1), dim=1)
        reached = (low < self.voxel_size) & (high > -self.voxel_size)
        reached[: Bricks.MISSING] = False
        neighbour_offsets = torch.cartesian_prod(*[torch.arange(-1, 2)] * 3)
        shape = torch.tensor(bricks.table.shape)
        corner = bricks.corners(reached.nonzero()[:, 0])[:, None]
        cell = (corner // Bricks.SIDE + neighbour_offsets).reshape(-1, 3)
        cell = torch.minimum(cell.clamp_min(0), shape - 1)
        flat_cell = (cell[:, 0] * shape[1] + cell[:, 1]) * shape[2] + cell[:, 2]
        new = flat_cell[bricks.table.flatten()[flat_cell] < Bricks.MISSING].unique()
        if not len(new):
            return False
        table, place = bricks.table.flatten().clone(), bricks.place
        extra_bricks = count + len(new) - len(place)
        if extra_bricks > 0:  # make room, and some more
            extra_bricks += round(SPARE * len(place))
            place = torch.cat([place, place.new_full((extra_bricks,), -1)])
            extra_rows = extra_bricks * Bricks.NODES
            sdf = self.sdf.detach()
            sdf = torch.cat([sdf, sdf.new_full((extra_rows,), self.far)])
            self.sdf: nn.Parameter = nn.Parameter(sdf, self.sdf.requires_grad)
        else:
            place = place.clone()
        sign = 1 - 2 * table[new].float()  # before there was a brick
        number = torch.arange(count, count + len(new))
        table[new], place[number] = number.int(), new.int()
        self.bricks = Bricks(table.view(bricks.table.shape), place, bricks.size)
        rows = (Bricks.NODES * number[:, None] + torch.arange(Bricks.NODES)).flatten()
        self.sdf[rows] = self.far * sign.repeat_interleave(Bricks.NODES)
        parts = zip(number.split(BRICKS_AT_ONCE), sign.split(BRICKS_AT_ONCE), strict=True)
        carried = torch.cat([self._carried(*part) for part in parts])
        self.sdf.view(-1, Bricks.NODES)[number] = carried
        return True

    def _carried(self, number: Tensor, sign: Tensor) -> Tensor:
        """Distances [N, 64] carried on into new bricks [N], whose nodes have lain at sign [N] times
        far."""
        node_offsets = torch.cartesian_prod(*[torch.arange(-1, Bricks.SIDE + 1)] * 3)
        node = self.bricks.corners(number)[:, None] + node_offsets
        node = torch.minimum(node.clamp_min(0), torch.tensor(self.grid.size) - 1)
        # In front of the surface seen from here: what is across it is below 0
        signed = sign[:, None] * self.sdf.detach()[self.bricks.rows(node)]
        signed = signed.view(-1, *[Bricks.SIDE + 2] * 3)
        inner = signed[:, 1:-1, 1:-1, 1:-1]
        for _ in range(Bricks.SIDE):  # a voxel at a time
            for axis in range(1, 4):
                for begin in (0, 2):
                    neighbours = signed.narrow(axis, begin, Bricks.SIDE)
                    for other_axis in {1, 2, 3} - {axis}:
                        neighbours = neighbours.narrow(other_axis, 1, Bricks.SIDE)
                    torch.minimum(inner, neighbours + self.voxel_size, out=inner)
        return sign[:, None] * inner.reshape(len(number), -1)


def _nodes(grid: GridShape, flat: Tensor, node_offsets: Tensor) -> Tensor:
    """World positions [N K, 3] of nodes of bricks: those at offsets [K, 3] int64 in each of the
    bricks with the numbers [N] among all places of the grid."""
    shape = tuple(-(-n // Bricks.SIDE) for n in grid.size)
    node = torch.stack(torch.unravel_index(flat, shape), -1) * Bricks.SIDE
    node = (node[:, None] + node_offsets).reshape(-1, 3)
    origin = torch.tensor(grid.origin, dtype=torch.float64)
    return (origin + grid.voxel_size * node.double()).float()


def _sewn(parts: list[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
    """Meshes of slabs along x in one: vertices of two in the plane between them become one.

    Args:
        parts: vertices [P, 3] in voxels and faces [F, 3]; slabs meet where x is a multiple of SLAB.
    """
    vertices = np.concatenate([v for v, _ in parts])
    counts = np.cumsum([0, *(len(v) for v, _ in parts)])
    faces = np.concatenate([f + n for (_, f), n in zip(parts, counts, strict=False)])
    number = np.arange(len(vertices))
    on_seam = np.flatnonzero(vertices[:, 0] % SLAB == 0)
    if len(on_seam):
        # By rounding they lie some 1e-6 apart; others in the plane, where an edge meets none, 1e-3
        pairs = KDTree(vertices[on_seam]).query_pairs(1e-5, output_type="ndarray")
        first, second = np.sort(on_seam[pairs], axis=1).T
        number[second] = first
    kept, number = np.unique(number, return_inverse=True)
    faces = number[faces]
    intact = (faces != np.roll(faces, 1, axis=1)).all(1)
    return vertices[kept], faces[intact]


def _overlapped(source: AbstractDistances, grid: GridShape, far: float) -> Tensor:
    """Which bricks of a grid meet blocks of the source that have something nearer than far."""
    near = source.blocks(far)
    for axis in range(3):
        brick = torch.arange(-(-grid.size[axis] // Bricks.SIDE)) * Bricks.SIDE
        start = (grid.origin[axis] - source.grid.origin[axis]) / source.voxel_size
        scale = grid.voxel_size / source.voxel_size
        last_block = near.shape[axis] - 1
        low, high = (
            ((start + scale * (brick + offset)) / Bricks.SIDE).floor().long().clamp(0, last_block)
            for offset in (-0.01, Bricks.SIDE - 0.99)  # rounding may not lose a neighbour
        )
        count = torch.nn.functional.pad(
            near.movedim(axis, -1).to(torch.int32).cumsum(-1, dtype=torch.int32), (1, 0)
        )
        near = (count[..., high + 1] > count[..., low]).movedim(-1, axis)
    return near


def pack_bricks(distances: BrickDistances) -> dict[str, Tensor]:
    """What of the bricks a file needs: where they stand, and bits of what is inside."""
    inside = (distances.bricks.table == 1).flatten()
    bits = np.packbits(inside.numpy(), bitorder="little")
    place = distances.bricks.place[: distances.count].clone()
    return {"place": place, "inside": torch.from_numpy(bits)}


def unpack_bricks(place: Tensor, inside: Tensor, size: tuple[int, int, int]) -> Bricks:
    """The bricks that `pack_bricks` told of; a ValueError or IndexError if they do not fit the
    grid."""
    shape = [-(-n // Bricks.SIDE) for n in size]
    bits = inside[:, None] >> torch.arange(8, dtype=torch.uint8) & 1
    table = bits.flatten()[: shape[0] * shape[1] * shape[2]].to(torch.int32)
    stored = place[Bricks.MISSING :].long()
    table[stored] = Bricks.MISSING + torch.arange(len(stored), dtype=torch.int32)
    return Bricks(table.view(shape), place, size)
