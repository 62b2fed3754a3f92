"""Small patches of the surface, compared between photographs.

Colours of one point tell little of how deep it lies where everything beside it looks alike. A patch
tells more: seen from two sides, its pattern fits only where the surface is right. What is compared
is the correlation, which neither exposure nor even shading change.
"""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor
from torch.nn.functional import normalize

from univoxel.camera import Cameras, projection_matrices
from univoxel.color import linear_to_srgb
from univoxel.core import memmap
from univoxel.core.records import Surface
from univoxel.data import Photos
from univoxel.data.photos import coverage_of
from univoxel.ops import patch_correlation
from univoxel.scene import Scene

HALF = 2  # pixels from a patch's middle to its side
RAYS = 256  # of a part that are compared, at most
NEAR = 8  # views that are nearest to the ray's own, of which
OTHERS = 4  # so many that see the point are compared with, at most
FEWEST = 2  # and at least: of one alone nobody knows whether it sees something else
MAX_COSINE = 0.996  # between two views' directions: closer together they do not tell depths
MIN_COSINE = 0.3  # of a view's direction and the normal: a flatter patch is smeared
MIN_OPACITY = 0.95  # of rays, which otherwise meet no surface, but a silhouette's fringe
MIN_ALPHA = 0.99  # of all pixels of a patch
MIN_TEXTURE = 0.004  # standard deviation of brightness: about that of rounding to bytes
NOISE = 0.001  # brightness; patches that vary less correlate less
# Of what correlation lacks to 1, above which a view pulls no more: something else is seen there, a
# highlight or what is before it
MOST = 0.3


BACKGROUND = -1.0  # stands for the brightness of pixels that show it


def comparable(photos: Photos) -> Tensor:
    """Brightness of all pixels [V, H, W], float16; BACKGROUND where they are not opaque.

    It spreads dark colours, as `univoxel.preparation.carving.log_colors` does.
    """
    result = memmap.zeros(photos.alpha.shape, torch.float16)
    result[:] = BACKGROUND
    for view in range(len(photos)):
        color, alpha = photos.stored(view)
        if color.dtype == torch.uint8:
            mean = color.float().mean(-1) / 255
        else:
            mean = linear_to_srgb(color).mean(-1)
        curve = (mean + 2 * torch.log1p(40 * mean) / math.log(41)) / 3
        photos.cameras.cut(view, result[view])[:] = torch.where(
            coverage_of(alpha) > MIN_ALPHA, curve, BACKGROUND
        )
    return result


def disagreement(
    scene: Scene, brightness: Tensor, cameras: Cameras, surface: Surface, wo: Tensor, pixels: Tensor
) -> Tensor:
    """How much the surface's patches differ between photographs: mean over rays, in [0, MOST].

    It has gradients to the surface's depth and normal. 0 where nothing can be compared.

    Args:
        scene: whose surface hides points from views.
        brightness: of the photographs, as in `comparable`.
        cameras: of them; they get no gradient.
        surface: [N] what rays of the photographs' pixels meet.
        wo: [N, 3] unit, towards the eye.
        pixels: [N, 3 and more] int: view, row and column of the rays.
    """
    cameras = replace(cameras, camera_to_world=cameras.camera_to_world.detach())
    view, row, column = pixels[:, :3].long().unbind(1)
    with torch.no_grad():
        facing = (surface.normal * wo).sum(1) > MIN_COSINE
        index = (facing & (surface.opacity > MIN_OPACITY)).nonzero()[: 2 * RAYS, 0]
        own, alike = own_patches(brightness, view[index], row[index], column[index])
        own, index = own[alike][:RAYS], index[alike][:RAYS]
        if not len(index):
            return torch.zeros(())
        matrices = projection_matrices(cameras)
        others, seen = views_beside(
            scene, cameras, matrices, surface.position[index], surface.normal[index], view[index]
        )
        enough = seen.sum(1) >= FEWEST
        own, index, others, seen = own[enough], index[enough], others[enough], seen[enough]
        if not len(index):
            return torch.zeros(())
        view, row, column, wo = view[index], row[index], column[index], wo.detach()[index]
        eye = cameras.camera_to_world[view, :, 3]
    correlation, shown = patch_correlation(
        brightness,
        matrices,
        eye,
        patch_directions(cameras, view, row, column),
        own,
        others,
        eye - surface.depth[index, None] * wo,
        surface.normal[index],
        NOISE,
    )
    seen = seen & shown
    missing = torch.where(seen, 1 - correlation, 2.0)
    # The better half of the views: one that sees something else has no say
    best = torch.arange(missing.shape[1]) < (seen.sum(1, keepdim=True) + 1) // 2
    missing = missing.sort(1).values.clamp_max(MOST)
    return (missing * best).sum() / best.sum().clamp_min(1)


def own_patches(
    brightness: Tensor, view: Tensor, row: Tensor, column: Tensor
) -> tuple[Tensor, Tensor]:
    """Brightness [N, M] of the pixels around pixels [N], and whether they can be compared [N]."""
    height, width = brightness.shape[1:]
    step = torch.arange(-HALF, HALF + 1)
    down, right = (t.flatten() for t in torch.meshgrid(step, step, indexing="ij"))
    rows, columns = row[:, None] + down, column[:, None] + right
    inside = ((rows >= 0) & (columns >= 0) & (rows < height) & (columns < width)).all(1)
    rows, columns = rows.clamp(0, height - 1), columns.clamp(0, width - 1)
    own = brightness.view(-1)[(view[:, None] * height + rows) * width + columns].float()
    textured = (own - own.mean(1, keepdim=True)).square().mean(1).sqrt() > MIN_TEXTURE
    return own, inside & textured & (own >= 0).all(1)


def views_beside(
    scene: Scene, cameras: Cameras, matrices: Tensor, position: Tensor, normal: Tensor, view: Tensor
) -> tuple[Tensor, Tensor]:
    """Views beside those that points [N, 3] are seen in: numbers [N, K], and whether they see the
    points too [N, K] bool; those that do come first.

    Args:
        matrices: [V, 3, 4] as in `projection_matrices`.
    """
    towards = normalize(cameras.camera_to_world[:, :, 3] - position[:, None], dim=-1)  # [N, V, 3]
    turned = (towards * towards[torch.arange(len(view)), view][:, None]).sum(-1)
    turned = turned.masked_fill(turned > MAX_COSINE, -2.0)
    near, others = turned.topk(min(NEAR, len(cameras)), dim=1)
    towards = towards.gather(1, others[..., None].expand(-1, -1, 3))
    homogeneous = torch.cat([position, torch.ones_like(position[:, :1])], 1)
    x, y, z = (matrices[others] @ homogeneous[:, None, :, None])[..., 0].unbind(2)
    row, column = (y / z).floor().long(), (x / z).floor().long()
    width, height = cameras.size_of_each().expand(len(cameras), 2)[others].unbind(-1)
    seen = (near > -2) & (z > 0) & ((normal[:, None] * towards).sum(-1) > MIN_COSINE)
    seen &= (row > HALF) & (column > HALF) & (row < height - HALF - 1) & (column < width - HALF - 1)
    n, k = seen.nonzero().unbind(1)
    start = position[n] + scene.field.voxel_size * (normal[n] + towards[n, k])
    eye = cameras.camera_to_world[others[n, k], :, 3]
    reach = (eye - start).norm(dim=1).max().item() if len(n) else 0.0
    seen[n, k] = ~scene.occluder().occluded(start, towards[n, k], 0.0, reach)
    first = torch.argsort((~seen).byte(), dim=1, stable=True)[:, :OTHERS]
    return others.gather(1, first), seen.gather(1, first)


def patch_directions(cameras: Cameras, view: Tensor, row: Tensor, column: Tensor) -> Tensor:
    """Directions [N, 3, 3] through the middles of patches, 1 along the camera's axis, and what a
    column and a row add to them."""
    right, up, back = cameras.camera_to_world[view, :, :3].unbind(2)
    by_column, by_row = (
        turn / f[:, None]
        for turn, f in zip((right, -up), cameras.focal[view].unbind(1), strict=True)
    )
    away = torch.stack([column, row], 1) + 0.5 - cameras.centre[view]
    middle = away[:, :1] * by_column + away[:, 1:] * by_row - back
    return torch.stack([middle, by_column, by_row], 1)
