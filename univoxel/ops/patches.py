"""Small patches of a surface, correlated between photographs."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from univoxel.ops import native
from univoxel.ops.checks import check
from univoxel.ops.differentiable import differentiable

NEAREST = 1e-6  # along the axis of a view: what lies before it is not seen


def patch_correlation(
    brightness: Tensor,  # [V, H, W]
    projection: Tensor,  # [V, 3, 4]
    origin: Tensor,  # [N, 3]
    direction: Tensor,  # [N, 3, 3]
    own: Tensor,  # [N, M]
    views: Tensor,  # [N, K] int64
    position: Tensor,  # [N, 3]
    normal: Tensor,  # [N, 3]
    noise: float = 1e-3,
) -> tuple[Tensor, Tensor]:
    """Correlate what patches of a surface show in one view with what others show there.

    The pixels of a patch look along d = direction_0 + c direction_1 + r direction_2, with c and r
    the columns and rows from its middle. They meet the plane through position with the normal at
    the depth t = normal.(position - origin) / normal.d; origin + t d is looked up in another view,
    bilinearly. Of brightness a there, b here, both without their means,

        correlation = mean(a b) / sqrt((mean(a^2) + noise^2) (mean(b^2) + noise^2))

    Args:
        brightness: [V, H, W] of all views, of any scale; below 0 where there is nothing to compare.
            H and W at least 2. Of the dtype of the others, or float16.
        projection: [V, 3, 4] world to (x z, y z, z), with x and y in pixels: 0.5 is the middle of
            the first, as of `univoxel.camera.projection_matrices`.
        origin: [N, 3] eye of the view that a patch is a square of pixels in.
        direction: [N, 3, 3] as above.
        own: [N, M] brightness of the pixels there, row by row; M the square of an odd number.
        views: [N, K] numbers of the others.
        position: [N, 3] a point of a patch's plane, world units.
        normal: [N, 3] of the plane, of any length.
        noise: brightness below which variation counts little, above 0.

    Returns:
        correlation [N, K] in [-1, 1], and whether the whole patch shows brightness of at least 0 in
        the other view, [N, K] bool.

    Raises:
        TypeError, ValueError: an argument of another size or dtype than above, or out of range.

    Differentiable in: position, normal. Second order raises.
    """
    halves = isinstance(brightness, Tensor) and brightness.dtype == torch.float16
    sizes = check(
        "patch_correlation",
        position=(position, "N 3"),
        normal=(normal, "N 3"),
        origin=(origin, "N 3"),
        direction=(direction, "N 3 3"),
        own=(own, "N M"),
        views=(views, "N K", torch.int64),
        brightness=(brightness, "V H W", torch.float16) if halves else (brightness, "V H W"),
        projection=(projection, "V 3 4"),
    )
    side = math.isqrt(sizes["M"])
    if side * side != sizes["M"] or side % 2 == 0:
        raise ValueError(
            f"patch_correlation: own must have the square of an odd number of pixels, "
            f"got {sizes['M']}"
        )
    if min(sizes["H"], sizes["W"]) < 2:
        raise ValueError(
            f"patch_correlation: brightness must have at least 2 rows and columns, "
            f"got {list(brightness.shape)}"
        )
    if not 0 < noise < math.inf:
        raise ValueError(f"patch_correlation: noise must be above 0, got {noise}")
    tensors = (brightness, projection, origin, direction, own, views, position, normal)
    if not native.serves(position):
        return patch_correlation_reference(*tensors, noise)
    correlation, seen, _ = _patch_correlation(*(t.contiguous() for t in tensors), float(noise))
    return correlation, seen


def patch_correlation_reference(
    brightness: Tensor,
    projection: Tensor,
    origin: Tensor,
    direction: Tensor,
    own: Tensor,
    views: Tensor,
    position: Tensor,
    normal: Tensor,
    noise: float = 1e-3,
) -> tuple[Tensor, Tensor]:
    """The same in eager torch."""
    rays = _rays(direction, own.shape[1])  # [N, M, 3]
    away = (normal * (position - origin)).sum(1, keepdim=True)
    nearness = (normal[:, None] * rays).sum(2) / away
    matrix = projection[views]  # [N, K, 3, 4]
    eye = (matrix[..., :3] @ origin[:, None, :, None]) + matrix[..., 3:]
    x, y, z = (eye * nearness[:, None, None] + matrix[..., :3] @ rays.mT[:, None]).unbind(2)
    z = torch.where(z > NEAREST, z, torch.inf)  # behind the camera: a pixel in the corner
    other, least = _looked_up(brightness, views, x / z - 0.5, y / z - 0.5)
    a, b = own - own.mean(1, keepdim=True), other - other.mean(2, keepdim=True)
    power = (a.square().mean(1)[:, None] + noise**2) * (b.square().mean(2) + noise**2)
    return (a[:, None] * b).mean(2) / power.sqrt(), (least >= 0).all(2)


def _rays(direction: Tensor, pixels: int) -> Tensor:
    """Directions [N, M, 3] of all pixels of patches."""
    half = math.isqrt(pixels) // 2
    step = torch.arange(-half, half + 1, dtype=direction.dtype, device=direction.device)
    row, column = (s.flatten()[:, None] for s in torch.meshgrid(step, step, indexing="ij"))
    middle, by_column, by_row = direction[:, :, None].unbind(1)
    return middle + column * by_column + row * by_row


def _looked_up(brightness: Tensor, views: Tensor, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    """Brightness at places x, y [N, K, M], counted from the middle of the first pixel, and the
    least of the pixels around."""
    height, width = brightness.shape[1:]
    with torch.no_grad():
        column, row = (
            t.nan_to_num(0.0).floor().clamp(0, n - 2) for t, n in ((x, width), (y, height))
        )
        first = (views[..., None] * height + row.long()) * width + column.long()
        flat = brightness.reshape(-1)
        a, b, c, d = (flat[first + n].to(x.dtype) for n in (0, 1, width, width + 1))
        least = torch.stack([a, b, c, d]).amin(0)
    u, v = x - column, y - row
    return a + u * (b - a) + v * (c - a) + u * v * (a - b - c + d), least


def _forward(tensors: Sequence, options: Sequence, outputs: Sequence[Tensor]) -> None:
    correlation, seen, slopes = outputs
    native.require().patch_correlation(
        *native.arrays(*tensors, correlation, seen.view(torch.uint8), slopes),
        *options,
        native.threads(),
    )


def _backward(
    saved: Sequence, grads: Sequence[Tensor], options: Sequence, needs: list[bool]
) -> Sequence[Tensor]:
    return (grads[0][..., None] * saved[0]).sum(1).split(3, 1)


@differentiable(to="position normal", forward=_forward, backward=_backward, held=1, traced=True)
def _patch_correlation(
    brightness: Tensor,
    projection: Tensor,
    origin: Tensor,
    direction: Tensor,
    own: Tensor,
    views: Tensor,
    position: Tensor,
    normal: Tensor,
    noise: float,
) -> tuple[Tensor, Tensor, Tensor]:
    """Correlation, whether all is seen, and the derivative to position and normal."""
    n, k = views.shape
    seen = torch.empty(n, k, dtype=torch.bool, device=position.device)
    return position.new_empty(n, k), seen, position.new_empty(n, k, 6)
