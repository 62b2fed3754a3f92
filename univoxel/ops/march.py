"""Ray marching through an SDF grid: finds the samples with visible density."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from univoxel.core.records import Bricks, Samples
from univoxel.ops import native
from univoxel.ops.differentiable import check, check_numbers

BRICK = 4  # voxels along the side of a brick that is skipped as a whole; as kBrick in csrc/nodes.h


def brick_minimum(sdf: Tensor, bricks: Bricks | None = None) -> Tensor:
    """The smallest sdf in each brick of 4^3 voxels (5^3 nodes; neighbours share their faces).

    Args:
        sdf: [X, Y, Z] world units; with bricks [64 n].
        bricks: of a sparse grid.

    Returns:
        [ceil((X - 1) / 4), ...] at least 1 along each axis; with bricks [n]: infinity for bricks
        that are missing outside or unused, minus infinity for those that are missing inside.

    Raises:
        TypeError, ValueError: an argument has another size, dtype or device than above.
    """
    if bricks is not None:
        return _sparse_brick_minimum(sdf, bricks)
    check("brick_minimum", sdf=(sdf, "X Y Z"))
    if native.serves(sdf):
        out = sdf.new_empty([max(1, (n - 2) // BRICK + 1) for n in sdf.shape])
        native.call("brick_minimum", sdf.contiguous(), out)
        return out
    for axis in range(3):
        n = sdf.shape[axis]
        sdf = torch.stack(
            [
                sdf.narrow(axis, i, min(BRICK + 1, n - i)).amin(axis)
                for i in range(0, max(n - 1, 1), BRICK)
            ],
            axis,
        )
    return sdf


def _sparse_brick_minimum(sdf: Tensor, bricks: Bricks) -> Tensor:
    check("brick_minimum", bricks, sdf=(sdf, "R"))
    n = len(bricks.place)
    if native.serves(sdf):
        out = sdf.new_empty(n)
        where = bricks.table, bricks.place, bricks.size
        native.call("sparse_brick_minimum", sdf.contiguous(), *where, out)
        return out
    out = sdf.new_full((n,), torch.inf)
    out[1] = -torch.inf
    stored = (bricks.place >= 0).nonzero()[:, 0]
    face = torch.cartesian_prod(*[torch.arange(BRICK + 1, device=sdf.device)] * 3)
    last = torch.tensor(bricks.size, device=sdf.device) - 1
    nodes = torch.minimum(bricks.corners(stored)[:, None] + face, last)
    out[stored] = sdf[bricks.rows(nodes)].amin(1)
    return out


def march(
    sdf: Tensor,  # [X, Y, Z]
    brick_min: Tensor,
    origin: Tensor,  # [N, 3]
    direction: Tensor,  # [N, 3]
    jitter: Tensor,  # [N]
    grid_origin: Sequence[float],
    voxel_size: float,
    *,
    step: float,
    inv_s: float,
    min_weight: float = 1e-4,
    early_stop: float = 1e-3,
    bricks: Bricks | None = None,
) -> Samples:
    """Samples along rays where the NeuS density of an SDF grid is visible.

    Samples are at t = near + (k + jitter) step inside the grid's box. A section between two of them
    is kept if its weight is above min_weight, with

        alpha = max(0, 1 - sigmoid(f_end / s) / sigmoid(f_start / s))

    from the trilinear sdf f at its ends; the samples at the ends of kept sections are returned.
    Bricks whose sdf stays above 8 s are skipped as a whole. A ray that is not finite, or whose
    direction is shorter than 1e-3, gets no samples.

    Args:
        sdf: [X, Y, Z] world units, negative inside; with bricks [64 n].
        brick_min: `brick_minimum(sdf, bricks)`; may be a few optimisation steps old.
        origin, direction: [N, 3] rays in the world, direction unit.
        jitter: [N] in [0, 1): the point within its first step at which a ray starts.
        grid_origin: world position of node (0, 0, 0).
        voxel_size: world units.
        step: distance between samples, world units, > 0.
        inv_s: 1 / s, sharpness of the density, 1 / world units, > 0.
        min_weight: in [0, 1].
        early_stop: a ray ends where its transmittance falls below this, in [0, 1].
        bricks: of a sparse grid. Those that are missing outside are skipped.

    Raises:
        TypeError, ValueError: an argument has another size, dtype, device or range than above.

    Not differentiable. Source: Wang et al. 2021 (NeuS), eq. 13.
    """
    check(
        "march",
        bricks,
        sdf=(sdf, "X Y Z" if bricks is None else "R"),
        brick_min=(brick_min, "A B C" if bricks is None else "n"),
        origin=(origin, "N 3"),
        direction=(direction, "N 3"),
        jitter=(jitter, "N"),
    )
    check_numbers("march", "above 0", voxel_size=voxel_size, step=step, inv_s=inv_s)
    check_numbers("march", "in [0, 1]", min_weight=min_weight, early_stop=early_stop)
    if not native.serves(sdf):
        return march_reference(
            sdf if bricks is None else sdf[bricks.grid_rows()],
            origin,
            direction,
            jitter,
            grid_origin,
            voxel_size,
            step=step,
            inv_s=inv_s,
            min_weight=min_weight,
            early_stop=early_stop,
        )
    tensors = [t.contiguous() for t in (sdf, brick_min, origin, direction, jitter)]
    t, connected, offsets = native.call(
        "march",
        *tensors,
        tuple(map(float, grid_origin)),
        *map(float, (voxel_size, step, inv_s, min_weight, early_stop)),
        None if bricks is None else bricks.table,
        sdf.shape if bricks is None else bricks.size,
    )
    return Samples(
        torch.from_numpy(t), torch.from_numpy(connected).bool(), torch.from_numpy(offsets)
    )


def march_reference(
    sdf: Tensor,
    origin: Tensor,
    direction: Tensor,
    jitter: Tensor,
    grid_origin: Sequence[float],
    voxel_size: float,
    *,
    step: float,
    inv_s: float,
    min_weight: float = 1e-4,
    early_stop: float = 1e-3,
) -> Samples:
    """Reference in eager PyTorch, without skipping: every sample of every ray at once."""
    start = origin.new_tensor(grid_origin)
    size = torch.tensor(sdf.shape, device=sdf.device, dtype=sdf.dtype) - 1
    o, d = (origin - start) / voxel_size, direction / voxel_size
    ends = torch.stack([-o / d, (size - o) / d])
    near = ends.amin(0).amax(1).clamp_min(0)
    far = ends.amax(0).amin(1)
    count = torch.where(near < far, (far - near - jitter * step) / step, -1.0).floor() + 1
    k = torch.arange(max(int(count.max()), 0) if len(count) else 0, device=sdf.device)
    t = near[:, None] + (jitter[:, None] + k) * step
    valid = k < count[:, None]
    g = (o[:, None] + t[..., None] * d[:, None]).clamp(torch.zeros_like(size), size)
    f = torch.nn.functional.grid_sample(
        sdf[None, None], (2 * g / size - 1).flip(-1)[None, None], align_corners=True
    )[0, 0, 0]
    log_phi = torch.nn.functional.logsigmoid(f * inv_s)
    alpha = -torch.expm1(log_phi[:, 1:] - log_phi[:, :-1]).clamp_max(0)
    alpha = torch.where(valid[:, 1:], alpha, 0.0)
    trans = torch.cumprod(1 - alpha, 1)
    trans = torch.cat([torch.ones_like(trans[:, :1]), trans[:, :-1]], 1)
    kept = (alpha * trans > min_weight) & (trans >= early_stop)
    none = torch.zeros_like(kept[:, :1])
    starts, stops = torch.cat([kept, none], 1), torch.cat([none, kept], 1)
    used = starts | stops
    offsets = torch.cat([none[:1, 0].long(), used.sum(1).cumsum(0)])
    return Samples(t[used], starts[used], offsets)
