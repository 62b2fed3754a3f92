"""Comparison of photographs: correlation of surface patches, and stereo matching along rays."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from univoxel.ops import native
from univoxel.ops.differentiable import check, check_numbers, differentiable

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
    """Correlate patches of a surface between one view and others.

    The pixels of a patch look along d = direction_0 + c direction_1 + r direction_2, with c and r
    the columns and rows from its middle. They meet the plane through position with the normal at
    the depth t = normal.(position - origin) / normal.d. The brightness at origin + t d is read from
    another view, bilinearly. With the brightness a there and b here, both minus their means,

        correlation = mean(a b) / sqrt((mean(a^2) + noise^2) (mean(b^2) + noise^2))

    Args:
        brightness: [V, H, W] of all views, of any scale; below 0 where there is nothing to compare.
            H and W at least 2. Of the dtype of the others, or float16.
        projection: [V, 3, 4] world to (x z, y z, z), with x and y in pixels: 0.5 is the middle of
            the first pixel, as in `univoxel.camera.projection_matrices`.
        origin: [N, 3] eye of the view in which a patch is a square of pixels.
        direction: [N, 3, 3] as above.
        own: [N, M] brightness of these pixels, row by row; M the square of an odd number.
        views: [N, K] indices of the other views.
        position: [N, 3] a point on a patch's plane, world units.
        normal: [N, 3] of the plane, of any length.
        noise: brightness below which variation counts little, above 0.

    Returns:
        correlation [N, K] in [-1, 1], and whether the whole patch shows brightness of at least 0 in
        the other view, [N, K] bool.

    Raises:
        TypeError, ValueError: an argument has another size or dtype than above, or out of range.

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
            f"patch_correlation: own must have n x n pixels per patch, with an odd n, "
            f"got {sizes['M']}"
        )
    if min(sizes["H"], sizes["W"]) < 2:
        raise ValueError(
            f"patch_correlation: brightness must have at least 2 rows and columns, "
            f"got {list(brightness.shape)}"
        )
    check_numbers("patch_correlation", "above 0", noise=noise)
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
    """Reference in eager PyTorch."""
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
    filled = correlation, seen.view(torch.uint8), slopes
    native.call("patch_correlation", *tensors, *filled, *options)


def _backward(
    saved: Sequence, grads: Sequence[Tensor], options: Sequence, needs: list[bool]
) -> Sequence[Tensor]:
    return (grads[0][..., None] * saved[0]).sum(1).split(3, 1)


@differentiable(
    "brightness projection origin direction own views position* normal*",
    "float noise",
    outputs=3,
    forward=_forward,
    backward=_backward,
    held=1,
    traced=True,
)
def _patch_correlation(brightness, projection, origin, direction, own, views, position, *_):
    """Correlation, whether all is seen, and the derivative to position and normal."""
    n, k = views.shape
    seen = torch.empty(n, k, dtype=torch.bool, device=position.device)
    return position.new_empty(n, k), seen, position.new_empty(n, k, 6)


# Depth from photographs: how well pixels agree along rays, and which depths neighbours share.


@torch.no_grad()
def match_cost(
    pictures: Tensor,  # [V, H, W, 4]
    matrix: Tensor,  # [V, 3, 4]
    origin: Tensor,  # [N, 3]
    direction: Tensor,  # [N, 3]
    start: Tensor,  # [N]
    color: Tensor,  # [N, 3]
    rows: Tensor,  # [H, W]
    others: Tensor,  # [M]
    step: float,
    steps: int,
    *,
    most: float = 0.2,
    radius: int = 1,
    best: int = 4,
) -> Tensor:
    """Matching cost between photographs for candidate points along the rays of pixels.

    The colours of points start + k step are read from other views (bilinear). Their mean absolute
    difference, which is limited to `most` and equals `most` where a view shows no object, is
    averaged over a window of pixels of one k, and over the `best` views that agree most, because
    the point may be hidden in others.

    Args:
        pictures: [V, H, W, 4] uint8 colours times coverage, and coverage.
        matrix: [V, 3, 4] float32 world to (x z, y z, z): pixels from the top left corner, depth.
        origin, direction: [N, 3] float32 rays of the pixels.
        start: [N] float32 distance at which the points start.
        color: [N, 3] float32 straight colours of the pixels, in [0, 1].
        rows: [H, W] int64 index of the ray of each pixel; -1: none.
        others: [M] int64 views to compare with.
        step: distance between points, world units if directions are unit.
        steps: K, number of points on a ray.
        radius: of the window, pixels; 0: only the pixel itself.
        best: number of views, 1 to M.

    Returns:
        [N, K] float32 in [0, most].

    Raises:
        TypeError, ValueError: an argument has another size, dtype, device or range than above.
    """
    sizes = check(
        "match_cost",
        pictures=(pictures, "V H W 4", torch.uint8),
        matrix=(matrix, "V 3 4", torch.float32),
        origin=(origin, "N 3", torch.float32),
        direction=(direction, "N 3", torch.float32),
        start=(start, "N", torch.float32),
        color=(color, "N 3", torch.float32),
        rows=(rows, "H W", torch.int64),
        others=(others, "M", torch.int64),
    )
    _check_rows("match_cost", rows, sizes["N"])
    if sizes["M"] and not 0 <= int(others.min()) <= int(others.max()) < sizes["V"]:
        raise ValueError(f"match_cost: others must lie in [0, {sizes['V']}), got {others.tolist()}")
    if not 1 <= best <= sizes["M"]:
        raise ValueError(f"match_cost: best must lie in [1, {sizes['M']}], got {best}")
    if steps < 1 or radius < 0:
        raise ValueError(
            f"match_cost: expected steps >= 1 and radius >= 0, got {steps=} and {radius=}"
        )
    rays = (origin, direction, start, color, rows, others)
    if not native.serves(start):
        return match_cost_reference(pictures, matrix, *rays, step, steps, most, radius, best)
    cost = start.new_empty(sizes["N"], steps)
    aligned = pictures.clone() if pictures.storage_offset() % 4 else pictures
    pixels = aligned.contiguous().view(torch.int32)[..., 0]  # four bytes are looked up at once
    tensors = [t.contiguous() for t in (pixels, matrix, *rays)]
    native.call("match_cost", *tensors, cost, step, most, radius, best)
    return cost


def match_cost_reference(
    pictures: Tensor,
    matrix: Tensor,
    origin: Tensor,
    direction: Tensor,
    start: Tensor,
    color: Tensor,
    rows: Tensor,
    others: Tensor,
    step: float,
    steps: int,
    most: float,
    radius: int,
    best: int,
) -> Tensor:
    """Reference in eager PyTorch."""
    height, width = rows.shape
    t = start[:, None] + step * torch.arange(steps, dtype=start.dtype, device=start.device)
    point = origin[:, None] + t[..., None] * direction[:, None]  # [N, K, 3]
    differences = []
    for view in others.tolist():
        x, y, z = (point @ matrix[view, :, :3].T + matrix[view, :, 3]).unbind(-1)
        at = torch.stack([x / z / width, y / z / height], -1) * 2 - 1
        texel = torch.nn.functional.grid_sample(
            pictures[view].permute(2, 0, 1)[None].to(at) / 255, at[None], align_corners=False
        )[0].permute(1, 2, 0)
        off = (texel[..., :3] / texel[..., 3:] - color[:, None]).abs().mean(-1)
        half = at.new_tensor([1 / width, 1 / height])  # of a pixel: pictures are 2 wide
        inside = ((at >= half - 1) & (at < 1 - half)).all(-1) & (z > 0)
        visible = inside & (texel[..., 3] >= 0.5)
        differences.append(torch.where(visible, off.clamp_max(most), most))
    pixel = (rows.flatten() >= 0).nonzero()[:, 0]
    spread = start.new_zeros(len(differences) * steps + 1, height * width)
    values = torch.stack(differences).permute(0, 2, 1).reshape(-1, len(start))
    spread[:-1, pixel], spread[-1, pixel] = values[:, rows.flatten()[pixel]], 1.0
    mean = torch.nn.functional.avg_pool2d(
        spread.view(-1, height, width), 2 * radius + 1, 1, radius, count_include_pad=True
    ).flatten(1)[:, pixel]
    cost = (mean[:-1] / mean[-1]).view(len(differences), steps, -1).sort(0).values[:best].mean(0).T
    return torch.empty_like(cost).index_copy_(0, rows.flatten()[pixel], cost)


@torch.no_grad()
def semi_global(cost: Tensor, rows: Tensor, small: float, large: float) -> Tensor:
    """Semi-global matching: sums of costs along the four straight paths to each pixel.

        L(p, k) = C(p, k) + min(L(q, k), L(q, k -+ 1) + small, m + large) - m,   m = min_i L(q, i)

    with q the pixel before p on the path; a pixel without a ray ends the path. Each pixel should
    take the k with the smallest sum.
    Source: Hirschmueller 2005, "Accurate and efficient stereo processing by semi-global matching",
    equation 13.

    Args:
        cost: [N, K] float32.
        rows: [H, W] int64 index of the row of cost of each pixel; -1: none.
        small: penalty for a step of 1 between neighbours.
        large: penalty for a larger step; at least small.

    Returns:
        [N, K] float32.

    Raises:
        TypeError, ValueError: an argument has another size, dtype, device or range than above.
    """
    sizes = check("semi_global", cost=(cost, "N K", torch.float32), rows=(rows, "H W", torch.int64))
    _check_rows("semi_global", rows, sizes["N"])
    if not 0 <= small <= large:
        raise ValueError(f"semi_global: 0 <= small <= large must hold, got {small} and {large}")
    if not native.serves(cost):
        return semi_global_reference(cost, rows, small, large)
    cost, rows = cost.contiguous(), rows.contiguous()
    total = torch.empty_like(cost)
    native.call("semi_global", cost, rows, total, small, large)
    return total


def semi_global_reference(cost: Tensor, rows: Tensor, small: float, large: float) -> Tensor:
    """Reference in eager PyTorch, line after line."""
    has_ray = rows >= 0
    volume = cost.new_zeros(*rows.shape, cost.shape[1])
    volume[has_ray] = cost[rows[has_ray]]
    total = torch.zeros_like(volume)
    for across in (False, True):
        for back in (False, True):
            turn = (lambda v: v.transpose(0, 1)) if across else (lambda v: v)
            c, s, t = (turn(v) for v in (volume, has_ray[..., None].to(cost.dtype), total))
            before, continues = torch.zeros_like(c[0]), torch.zeros_like(s[0])
            for i in range(len(c))[:: -1 if back else 1]:
                wide = torch.nn.functional.pad(before, (1, 1), value=torch.inf)
                neighbor = torch.minimum(wide[:, :-2], wide[:, 2:]) + small
                least = before.amin(1, keepdim=True)
                transition = torch.minimum(torch.minimum(before, neighbor), least + large) - least
                before, continues = c[i] + continues * transition, s[i]
                t[i] += before * s[i]
    result = torch.zeros_like(cost)
    result[rows[has_ray]] = total[has_ray]
    return result


def _check_rows(op: str, rows: Tensor, count: int) -> None:
    """Each of the N rays is the ray of one pixel."""
    named = rows[rows >= 0].sort().values
    if not torch.equal(named, torch.arange(count, device=rows.device)):
        raise ValueError(f"{op}: rows must contain each of the {count} rays once, and -1 elsewhere")
