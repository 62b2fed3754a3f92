"""Pinhole cameras, rays through their pixels, circles of cameras, and learned corrections of their
poses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn
from torch.nn.functional import normalize

from univoxel.core.records import Rays
from univoxel.errors import UserError


@dataclass(frozen=True)
class Cameras:
    """V pinhole cameras. Camera axes: +X right, +Y up, looking along -Z.

    Pictures of differing sizes are stored in one tensor [V, H, W, ...], as wide as the widest and
    as high as the highest of them: each from the top left corner on, `beyond` which is no picture.
    """

    camera_to_world: Tensor  # [V, 3, 4] float32, rigid
    focal: Tensor  # [V, 2] pixels, along x and y
    centre: Tensor  # [V, 2] principal point, pixels from the top left corner
    width: int  # pixels, of the widest picture
    height: int  # of the highest one
    sizes: Tensor | None = None  # [V, 2] int64 width and height of each; None: all are alike

    def __len__(self) -> int:
        return len(self.camera_to_world)

    def size(self, view: int) -> tuple[int, int]:
        """Width and height of a view's picture."""
        if self.sizes is None:
            return self.width, self.height
        width, height = self.sizes[view].tolist()
        return width, height

    def size_of_each(self) -> Tensor:
        """Width and height of all pictures, [V, 2] int64."""
        if self.sizes is None:
            return torch.tensor([[self.width, self.height]]).expand(len(self), 2)
        return self.sizes

    def cut(self, view: int, stored: Tensor) -> Tensor:
        """What is a view's of its stored picture: [H, W, ...] -> [its height, its width, ...]."""
        width, height = self.size(view)
        return stored[:height, :width]

    def of(self, views: Tensor) -> Cameras:
        """Those of some views [K], stored as before."""
        sizes = None if self.sizes is None else self.sizes[views]
        pose, focal, centre = self.camera_to_world[views], self.focal[views], self.centre[views]
        return Cameras(pose, focal, centre, self.width, self.height, sizes)


def stacked(pictures: Sequence[Tensor], beyond: float = 0) -> Tensor:
    """Pictures [h, w, ...] of any sizes as `Cameras` has them stored: [V, H, W, ...]."""
    first = pictures[0]
    if all(picture.shape == first.shape for picture in pictures):
        return torch.stack(list(pictures))
    height, width = (max(picture.shape[i] for picture in pictures) for i in (0, 1))
    stored = first.new_full((len(pictures), height, width, *first.shape[2:]), beyond)
    for view, picture in enumerate(pictures):
        stored[view, : picture.shape[0], : picture.shape[1]] = picture
    return stored


def sizes_of(sizes: Sequence[tuple[int, int]]) -> tuple[int, int, Tensor | None]:
    """Widths and heights of pictures as the last three fields of `Cameras`."""
    width, height = (max(size[i] for size in sizes) for i in (0, 1))
    alike = all(size == (width, height) for size in sizes)
    return width, height, None if alike else torch.tensor(sizes)


def pixel_rays(cameras: Cameras, view: Tensor, pixel: Tensor) -> Rays:
    """Rays through points of the pictures.

    Args:
        view: [N] int64, which camera; or [], one for all.
        pixel: [N, 2] x to the right and y down in pixels; pixel (column i, row j) has its centre at
            (i + 0.5, j + 0.5).
    """
    pose, focal, centre = cameras.camera_to_world[view], cameras.focal[view], cameras.centre[view]
    x, y = ((pixel - centre) / focal).unbind(-1)
    local = torch.stack([x, -y, -torch.ones_like(x)], -1)
    direction = torch.einsum("...ij,...j->...i", pose[..., :3], local)
    origin = pose[..., 3].expand_as(direction)
    return Rays(origin, torch.nn.functional.normalize(direction, dim=-1))


def image_rays(cameras: Cameras, view: int) -> Rays:
    """Rays through all pixel centres of one view, row by row: N = its height * its width."""
    width, height = cameras.size(view)
    row, column = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    pixel = torch.stack([column, row], -1).reshape(-1, 2) + 0.5
    return pixel_rays(cameras, torch.tensor(view), pixel)


def project(cameras: Cameras, view: int, points: Tensor) -> tuple[Tensor, Tensor]:
    """Pixel coordinates [P, 2] of world points [P, 3] in one view, and their depth along -Z [P].

    Coordinates mean nothing where the depth is not positive.
    """
    pose = cameras.camera_to_world[view]
    local = (points - pose[:, 3]) @ pose[:, :3]
    depth = -local[:, 2]
    xy = torch.stack([local[:, 0], -local[:, 1]], -1) / depth[:, None]
    return xy * cameras.focal[view] + cameras.centre[view], depth


def looked_at(cameras: Cameras) -> Tensor:
    """The point [3] nearest to all optical axes."""
    position, axis = cameras.camera_to_world[:, :, 3], -cameras.camera_to_world[:, :, 2]
    across = torch.eye(3) - axis[:, :, None] * axis[:, None]
    system = across.mean(0) + 1e-6 * torch.eye(3)
    return torch.linalg.solve(system, (across @ position[:, :, None]).mean(0)[:, 0])


def resize(cameras: Cameras, width: int) -> Cameras:
    """The same views in pictures of another width, in pixels: that of the widest of them."""
    if cameras.sizes is None:
        height = max(1, round(cameras.height * width / cameras.width))
        scale = torch.tensor([width / cameras.width, height / cameras.height])
        sizes = width, height, None
    else:
        share = width / cameras.width
        rounded = (cameras.sizes * share).round().long().clamp_min(1)
        scale = rounded / cameras.sizes
        sizes = sizes_of([(w, h) for w, h in rounded.tolist()])
    return Cameras(cameras.camera_to_world, cameras.focal * scale, cameras.centre * scale, *sizes)


def pixel_width(cameras: Cameras, point: Tensor) -> float:
    """How wide a pixel is at a point [3], in world units: the median over the cameras."""
    distance = (cameras.camera_to_world[:, :, 3] - point).norm(dim=1)
    return float((distance / cameras.focal.mean(1)).median())


def projection_matrices(cameras: Cameras) -> Tensor:
    """World to (x z, y z, z) of pixels: [V, 3, 4]."""
    pose = cameras.camera_to_world
    turn = pose[:, :, :3].transpose(1, 2) * torch.tensor([1.0, -1.0, -1.0])[:, None]
    local = torch.cat([turn, -turn @ pose[:, :, 3:]], 2)  # x right, y down, z away
    lens = torch.zeros(len(pose), 3, 3)
    lens[:, 0, 0], lens[:, 1, 1] = cameras.focal.unbind(1)
    lens[:, :2, 2], lens[:, 2, 2] = cameras.centre, 1.0
    return lens @ local


# The circle that cameras stand on, where they do: an object turned before a camera.


FEWEST = 8  # cameras, of which three say where a circle is and the others whether it is one
TRIPLES = 500  # through which circles are tried
# Median distance from the circle over its radius, at most. Of a head on a turntable 0.2 %, by two
# programs of structure from motion; by hand it is several per cent
ON = 0.005
# Of that median, beyond which a camera does not stand with the others: normal errors pass it once
# in five thousand times
STRAY = 3.5
LEAST = 0.007  # of the radius: below it nobody minds, 0.4 degrees
MOST = 0.1  # of the radius: what is further away was put there
MAJORITY = 0.75  # share of the cameras, on the circle at least
AROUND = 0.3  # narrower over wider spread in the circle's plane, at least: a short arc has any axis


@dataclass(frozen=True)
class Circle:
    """A circle, and how far V cameras stand off it."""

    centre: Tensor  # [3] world
    axis: Tensor  # [3] unit, across its plane
    radius: float  # world units, > 0
    off: Tensor  # [V] distances from it over its radius

    def strays(self) -> Tensor:
        """Which of the cameras [V] do not stand with the others, but as if they were meant to."""
        least = max(STRAY * float(self.off.median()), LEAST)
        return (self.off > least) & (self.off < MOST)


def circle_of(cameras: Cameras) -> Circle | None:
    """The circle on which most of the cameras stand, all around; None: they stand on none.

    Circles through three of them are tried, and least squares over those on the best one place it:
    a minority that stands elsewhere has no say.

    Source: Torr and Zisserman 2000, "MLESAC", for the cost of a circle that is tried.
    """
    place = cameras.camera_to_world[:, :, 3].double()
    if len(place) < FEWEST:
        return None
    generator = torch.Generator().manual_seed(0)
    tried = (
        _through(place[torch.randperm(len(place), generator=generator)[:3]], place)
        for _ in range(TRIPLES)
    )
    best = min(filter(None, tried), key=_cost, default=None)
    for within in (2 * ON, LEAST, LEAST):  # again, closer
        if best is None or best.off.median() > 2 * ON:
            return None
        best = _through(place[best.off < max(STRAY * float(best.off.median()), within)], place)
    if best is None or best.off.median() > ON:
        return None
    on = ~best.strays() & (best.off < MOST)
    spread = torch.linalg.svdvals(place[on] - place[on].mean(0))
    if on.double().mean() < MAJORITY or spread[1] < AROUND * spread[0]:
        return None
    return best


def _cost(circle: Circle) -> float:
    """Of how far cameras are off it; those that are far off cost all the same."""
    return float(circle.off.square().clamp_max((2 * ON) ** 2).sum())


def _through(chosen: Tensor, place: Tensor) -> Circle | None:
    """The circle nearest to some places [K, 3], and how far places [V, 3] are off it."""
    middle = chosen.mean(0)
    directions = torch.linalg.svd(chosen - middle, full_matrices=True)[2]
    flat = (chosen - middle) @ directions[:2].T
    system = torch.cat([2 * flat, torch.ones_like(flat[:, :1])], 1)
    found = torch.linalg.lstsq(system, flat.square().sum(1, keepdim=True), driver="gelsd")
    x, y, rest = found.solution[:, 0]
    radius = float((rest + x.square() + y.square()).clamp_min(0).sqrt())
    if not 0 < radius < float("inf"):
        return None
    axis, centre = normalize(directions[2], dim=0), middle + x * directions[0] + y * directions[1]
    away = place - centre
    height = away @ axis
    across = (away - height[:, None] * axis).norm(dim=1)
    return Circle(centre, axis, radius, torch.hypot(height, across - radius) / radius)


# Pose errors of the cameras, learned together with the scene.


class PoseSteps(nn.Module):
    """A small rotation and translation for each of V cameras, about a point of the object.

    Camera to world becomes x -> E (x - pivot) + pivot + radius u, E the rotation by the vector r.
    About the object, not about the camera: there turning and shifting a camera look alike, here
    each moves the picture in its own way, and by about as much. What all cameras have in common -
    a rotation, a translation, a scale of the whole world - is taken out, to first order: no
    photograph shows it, and test views would not follow.

    Source: Lin et al. 2021 (BARF) for poses learned with the scene; the gauge as in bundle
    adjustment.
    """

    pivot: Tensor  # [3] world
    radius: Tensor  # [] world units
    away: Tensor  # [V, 3] what a scale of the world would do to u, of length 1 in all

    def __init__(self, count: int) -> None:
        """For so many cameras, V; `about` says where the object is."""
        super().__init__()
        self.steps: nn.Parameter = nn.Parameter(torch.zeros(count, 6))  # r in radians, u
        self.register_buffer("pivot", torch.zeros(3))
        self.register_buffer("radius", torch.tensor(1.0))
        self.register_buffer("away", torch.zeros(count, 3))

    def about(self, cameras: Cameras, pivot: Tensor, radius: float) -> None:
        """Say where cameras are said to be, the middle [3] of the object and its radius, > 0."""
        self.pivot, self.radius = pivot.clone(), torch.tensor(radius)
        away = _centred(cameras.camera_to_world[:, :, 3] - pivot)
        self.away = away / away.norm().clamp_min(1e-12)

    def __len__(self) -> int:
        return len(self.steps)

    def corrected(self, cameras: Cameras) -> Cameras:
        """The cameras where they are believed to be, differentiable in training; a UserError for
        another number of cameras."""
        if len(cameras) != len(self):
            raise UserError(
                f"expected the {len(self)} photographs whose camera poses the run refined, got "
                f"{len(cameras)} photographs"
            )
        steps = self.steps if self.training else self.steps.detach()
        turn, shift = _centred(steps).split(3, 1)
        shift = shift - self.away * (shift * self.away).sum()
        pose = cameras.camera_to_world
        rotation = torch.linalg.matrix_exp(_cross(turn))
        place = rotation @ (pose[:, :, 3] - self.pivot)[:, :, None]
        place = place + (self.pivot + self.radius * shift)[:, :, None]
        return replace(cameras, camera_to_world=torch.cat([rotation @ pose[:, :, :3], place], 2))

    @torch.no_grad()
    def moved(self, cameras: Cameras) -> Tensor:
        """How far the object's middle and six points around it move in each picture: [V] pixels,
        root mean square."""
        around = torch.cat([torch.zeros(1, 3), torch.eye(3), -torch.eye(3)])
        points, after = self.pivot + self.radius * around, self.corrected(cameras)
        pairs = (
            project(after, v, points)[0] - project(cameras, v, points)[0] for v in range(len(self))
        )
        return torch.stack([d.square().sum(1).mean().sqrt() for d in pairs])


def _centred(values: Tensor) -> Tensor:
    return values - values.mean(0)


def _cross(vector: Tensor) -> Tensor:
    """Matrices [V, 3, 3] that multiply by vectors [V, 3] as the cross product does."""
    return torch.linalg.cross(vector[:, None], torch.eye(3).to(vector)[None]).mT
