"""Volume rendering of packed rays: opacity from signed distances, compositing, and a fused op that
samples and composites a field."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, TypeAlias

import torch
from torch import Tensor
from torch.nn.functional import logsigmoid

from univoxel.core.records import Bricks, Samples
from univoxel.ops import grid as grid_sampling
from univoxel.ops import hash_grid, native
from univoxel.ops.differentiable import check, check_numbers, differentiable
from univoxel.ops.grid import (
    SparseGrad,
    check_place,
    sample_dense_reference,
    sample_sparse_reference,
)
from univoxel.ops.hash_grid import check_levels, encode_hash_reference


def section_alpha(sdf: Tensor, connected: Tensor, inv_s: float) -> Tensor:
    """Opacity of the sections that start at packed samples.

        alpha_i = max(0, 1 - sigmoid(f_{i+1} / s) / sigmoid(f_i / s))

    from the sdf at both ends of the section, without an assumption on the slope in between. It is
    computed from a difference of logarithms, which neither cancels nor divides by zero deep inside.

    Args:
        sdf: [M] world units.
        connected: [M] bool, whether sample i + 1 ends the section that starts at i.
        inv_s: 1 / s, 1 / world units.

    Returns:
        [M] in [0, 1]; 0 where no section starts.

    Source: Wang et al. 2021 (NeuS), eq. 13.
    """
    log_phi = logsigmoid(sdf * inv_s)
    fall = (log_phi.roll(-1) - log_phi).clamp_max(0)
    return torch.where(connected, -torch.expm1(fall), 0.0)


# Volume-render compositing of packed rays.


def composite(
    alpha: Tensor,  # [M]
    value: Tensor,  # [M, C]
    offsets: Tensor,  # [N + 1]
    early_stop: float = 0.0,
) -> tuple[Tensor, Tensor]:
    """Composite values along packed rays, front to back.

        T_i = prod_{j < i} (1 - alpha_j),   weight_i = alpha_i T_i,   out_n = sum_i weight_i value_i

    with i over the samples offsets[n] .. offsets[n + 1] of ray n.

    Args:
        alpha: [M] opacity of each sample, in [0, 1].
        value: [M, C] values to composite, with any number of channels.
        offsets: [N + 1] int64, rising from 0 to M; ray n owns samples offsets[n] .. offsets[n + 1].
        early_stop: a ray ends where its transmittance falls below this, in [0, 1]; later samples
            have weight 0 and get no gradient. 0 never ends a ray early.

    Returns:
        out [N, C] and weight [M]. The opacity of a ray is the sum of its weights.

    Raises:
        TypeError, ValueError: an argument is no tensor, or of another size, dtype or device than
            above; offsets do not rise from 0 to M; early_stop outside [0, 1].

    Differentiable in: alpha, value. Second order raises.
    Source: Max 1995, "Optical models for direct volume rendering", in the discrete form of
    Mildenhall et al. 2020 (NeRF), eq. 3.
    """
    check(
        "composite", alpha=(alpha, "M"), value=(value, "M C"), offsets=(offsets, "N+1", torch.int64)
    )
    check_numbers("composite", "in [0, 1]", early_stop=early_stop)
    if native.serves(alpha):
        return _composite(
            alpha.contiguous(), value.contiguous(), offsets.contiguous(), float(early_stop)
        )
    return composite_reference(alpha, value, offsets, early_stop)


def composite_reference(
    alpha: Tensor, value: Tensor, offsets: Tensor, early_stop: float = 0.0
) -> tuple[Tensor, Tensor]:
    """Reference in eager PyTorch: rays padded to the longest, autograd gives the backward."""
    counts = offsets.diff()
    ray = torch.repeat_interleave(counts)
    slot = torch.arange(len(alpha), device=alpha.device) - offsets[ray]
    longest = int(counts.max()) if len(counts) else 0
    padded = alpha.new_zeros(len(counts), longest).index_put((ray, slot), alpha)
    through = torch.cumprod(1 - padded, 1)
    trans = torch.cat([torch.ones_like(through[:, :1]), through[:, :-1]], 1)[ray, slot]
    weight = torch.where(trans < early_stop, 0.0, trans * alpha)
    out = value.new_zeros(len(counts), value.shape[1]).index_add(0, ray, weight[:, None] * value)
    return out, weight


@differentiable("alpha* value* offsets", "float early_stop", outputs=2)
def _composite(alpha, value, offsets, early_stop):
    return value.new_empty(len(offsets) - 1, value.shape[1]), torch.empty_like(alpha)


# A field composited along packed rays: sampling, opacity and compositing in one pass.


# Lower and upper corner and voxel sizes of a hash table's levels, as in `encode_hash`
Lattices: TypeAlias = "tuple[Sequence[float], Sequence[float], Sequence[float]]"
RAY_NUMBERS = 5  # of a ray before its features: opacity, t, gradient
SAMPLE_NUMBERS = 4  # of a held sample before its features: sdf, gradient


class FieldAlongRays(NamedTuple):
    """Weighted sums over the sections of each ray."""

    opacity: Tensor  # [N] of the weights themselves
    t: Tensor  # [N] world units
    gradient: Tensor  # [N, 3] of the sdf
    features: Tensor  # [N, C]


def composite_field(
    sdf: Tensor,  # [X, Y, Z]
    features: Tensor,  # [X, Y, Z, C]
    origin: Tensor,  # [N, 3]
    direction: Tensor,  # [N, 3]
    samples: Samples,
    grid_origin: Sequence[float],
    voxel_size: float,
    inv_s: float,
    *,
    bricks: Bricks | None = None,
    levels: Lattices | None = None,
    min_share: float = 0.0,
    sparse_grad: bool = False,
) -> FieldAlongRays:
    """Sample a field along packed rays and composite it, front to back.

    At the samples x_i = origin + t_i direction of a ray, the field has distances f_i, gradients and
    features as `sample_dense` (with bricks `sample_sparse`) and `encode_hash` define them. If i and
    i + 1 are connected, a section joins them. With sigmoid S, its opacity and weight are

        alpha_i = max(0, 1 - S(inv_s f_{i+1}) / S(inv_s f_i))
        w_i = alpha_i prod_{j < i} (1 - alpha_j)

    and its value is the mean of v at its ends. A sample's share is c_i = (w_{i-1} + w_i) / 2, so

        sum_i w_i (v_i + v_{i+1}) / 2 = sum_i c_i v_i

    This computes `composite` and `section_alpha` on the outputs of the sampling ops, without
    storing tensors in between.

    Args:
        sdf: [X, Y, Z] world units, negative inside; with bricks [R].
        features: [X, Y, Z, C], with bricks [R, C]; with levels [L * rows, F] as in `encode_hash`,
            and then C = L F.
        origin, direction: [N, 3] rays in the world.
        samples: packed along them, as in `march`.
        grid_origin: world position of node (0, 0, 0).
        voxel_size: world units, above 0.
        inv_s: 1 / s, sharpness of the density, 1 / world units, above 0.
        bricks: of a sparse grid.
        levels: lower and upper corner and voxel sizes of a hash table, as in `encode_hash`.
        min_share: in [0, 1), relative to the largest share of the ray. Of samples with less, only
            the distance is read; features and gradients are the mean of the others, times opacity.
        sparse_grad: return gradients of sdf and features as coalesced ``sparse_coo`` tensors of
            touched rows. Eager only: under torch.compile, use dense gradients.

    Raises:
        TypeError, ValueError: an argument is no tensor, or of another size, dtype, device or range
            than above; offsets do not rise from 0 to the number of samples.

    Differentiable in: sdf, features, origin, direction; the choice of samples by min_share is
    treated as constant. Second order raises.
    Source: Wang et al. 2021 (NeuS), eq. 13; Max 1995 for the sums.
    """
    nodes = "X Y Z" if bricks is None else "R"
    sizes = check(
        "composite_field",
        bricks,
        sdf=(sdf, nodes),
        features=(features, "T F" if levels is not None else f"{nodes} C"),
        origin=(origin, "N 3"),
        direction=(direction, "N 3"),
        t=(samples.t, "M"),
        connected=(samples.connected, "M", torch.bool),
        offsets=(samples.offsets, "N+1", torch.int64),
    )
    if not sdf.numel():
        raise ValueError(f"composite_field: sdf must not be empty, got {list(sdf.shape)}")
    if levels is not None:
        check_levels("composite_field", sizes["T"], *levels)
    check_place("composite_field", len(samples.t), grid_origin, voxel_size)
    check_numbers("composite_field", "above 0", inv_s=inv_s)
    check_numbers("composite_field", "in [0, 1)", min_share=min_share)
    start = [float(x) for x in grid_origin]
    if native.serves(sdf):
        table = grid_sampling.no_table(sdf) if bricks is None else bricks.table
        corners = [[float(x) for x in part] for part in levels or ((), (), ())]
        total, _ = _composite_field(
            *(x.contiguous() for x in (sdf, features, table, origin, direction)),
            *(x.contiguous() for x in (samples.t, samples.connected, samples.offsets)),
            list(sdf.shape if bricks is None else bricks.size),
            *(start, float(voxel_size)),
            *corners,
            *(float(inv_s), float(min_share), sparse_grad),
        )
    else:
        if sparse_grad:
            sdf = SparseGrad.apply(sdf, sdf.dim())
            features = SparseGrad.apply(features, features.dim() - 1)
        place = start, float(voxel_size), float(inv_s)
        options = {"bricks": bricks, "levels": levels, "min_share": min_share}
        rays = origin, direction, samples
        total = composite_field_reference(sdf, features, *rays, *place, **options)
    opacity, t, gradient, composited = total.split([1, 1, 3, total.shape[1] - RAY_NUMBERS], 1)
    return FieldAlongRays(opacity[:, 0], t[:, 0], gradient, composited)


def composite_field_reference(
    sdf: Tensor,
    features: Tensor,
    origin: Tensor,
    direction: Tensor,
    samples: Samples,
    grid_origin: Sequence[float],
    voxel_size: float,
    inv_s: float,
    *,
    bricks: Bricks | None = None,
    levels: Lattices | None = None,
    min_share: float = 0.0,
) -> Tensor:
    """Reference in eager PyTorch, op by op: opacity, t, gradient and features, [N, 5 + C]."""
    ray = torch.repeat_interleave(samples.offsets.diff())
    points = origin[ray] + samples.t[:, None] * direction[ray]
    of_nodes = features if levels is None else sdf.new_empty(*sdf.shape, 0)
    if bricks is None:
        value, gradient, feature = sample_dense_reference(
            sdf, of_nodes, points, grid_origin, voxel_size
        )
    else:
        value, gradient, feature = sample_sparse_reference(
            sdf, of_nodes, bricks, points, grid_origin, voxel_size
        )
    if levels is not None:
        feature = encode_hash_reference(features, points, *levels)
    alpha = section_alpha(value, samples.connected, inv_s)
    _, weight = composite_reference(alpha, value[:, None], samples.offsets)
    share = (weight + weight.roll(1)) / 2  # the last sample of a ray starts no section
    n = len(samples.offsets) - 1
    most = share.new_zeros(n).scatter_reduce(0, ray, share.detach(), "amax")
    read = torch.where(share.detach() >= min_share * most[ray], share, 0.0)

    def summed(values: Tensor) -> Tensor:
        return values.new_zeros(n, values.shape[1]).index_add(0, ray, values)

    opacity = summed(share[:, None])
    scale = opacity / summed(read[:, None]).clamp_min(torch.finfo(share.dtype).tiny)
    sums = summed(read[:, None] * torch.cat([gradient, feature], 1))
    return torch.cat([opacity, summed((share * samples.t)[:, None]), scale * sums], 1)


def _forward(tensors: Sequence, options: Sequence, outputs: Sequence[Tensor]) -> None:
    sdf, features, table, *rays = tensors
    *place, lower, upper, voxel_sizes, inv_s, min_share, _ = options
    grid = grid_sampling.grid_of(table, *place)
    levels = hash_grid.place_of(lower, upper, voxel_sizes)
    read = sdf, features, *levels, *rays, inv_s, min_share
    native.call("composite_field_forward", grid, *read, *outputs)


def _backward(
    saved: Sequence[Tensor], grads: Sequence[Tensor], options: Sequence, needs: list[bool]
) -> list[Tensor | None]:
    """Back to samples, from there to nodes, or to the hash table, and to rays."""
    sdf, features, table, *rays, held = saved
    _, direction, t, _, offsets = rays
    *place, lower, upper, voxel_sizes, inv_s, min_share, sparse = options
    grid = grid_sampling.grid_of(table, *place)
    levels = hash_grid.place_of(lower, upper, voxel_sizes)
    # Where samples lie, NaN where no features were read; and derivatives to what was read of them
    points, feature_points, of_gradient = (t.new_empty(len(t), 3) for _ in range(3))
    of_value, of_feature = torch.empty_like(t), t.new_empty(len(t), held.shape[1] - SAMPLE_NUMBERS)
    read = sdf, features, *levels, *rays, inv_s, min_share
    filled = points, feature_points, of_value, of_gradient, of_feature
    native.call("composite_field_pulls", grid, *read, held, grads[0], *filled)
    hashed, moved = bool(voxel_sizes), needs[2] or needs[3]
    of_nodes = sdf.new_empty(*sdf.shape, 0) if hashed else features
    node_feature = of_feature[:, :0] if hashed else of_feature
    order = torch.empty(len(t), dtype=torch.int32)
    native.call("sort_by_tile", grid, points, order)
    of_sdf, of_features, of_points = grid_sampling.gradients(
        grid,
        (sdf, of_nodes, points, order),
        (of_value, of_gradient, node_feature.contiguous()),
        [needs[0], needs[1] and not hashed, moved],
        sparse,
    )
    of_hash = None
    if hashed:
        hash_needs, count = [needs[1], moved], len(voxel_sizes)
        of_features, of_hash = hash_grid.gradients(
            features, feature_points, of_feature, levels, count, hash_needs, sparse
        )
    of_origin = of_direction = None
    if of_points is not None:
        of_points = of_points if of_hash is None else of_points + of_hash
        ray = torch.repeat_interleave(offsets.diff())
        of_origin = torch.zeros_like(direction).index_add(0, ray, of_points)
        of_direction = torch.zeros_like(direction).index_add(0, ray, t[:, None] * of_points)
    return [of_sdf, of_features, of_origin, of_direction]


@differentiable(
    "sdf* features* table origin* direction* t connected offsets",
    "int[] size, float[] grid_origin, float voxel_size, float[] lower, float[] upper, "
    "float[] voxel_sizes, float inv_s, float min_share, bool sparse_grad",
    outputs=2,
    forward=_forward,
    backward=_backward,
    held=1,
)
def _composite_field(sdf, features, table, origin, direction, t, connected, offsets, *options):
    """What rays sum up to, and what is held of samples for the way back."""
    *_, voxel_sizes, _, _, _ = options
    channels = features.shape[-1] * max(len(voxel_sizes), 1)
    return (
        t.new_empty(len(offsets) - 1, RAY_NUMBERS + channels),
        t.new_empty(len(t), SAMPLE_NUMBERS + channels),
    )
