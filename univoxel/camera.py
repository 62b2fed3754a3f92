"""Pinhole cameras and the rays through their pixels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from univoxel.records import Rays


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
    """Pictures [h, w, ...] of any sizes as `Cameras` has them stored: [V, H, W, ...].

    Args:
        beyond: what stands where there is no picture.
    """
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
