"""A field composited along rays: against the ops it stands for."""

from dataclasses import replace

import pytest
import torch
from bricks import cut
from check_op import check_op

from univoxel import ops
from univoxel.core.records import Samples
from univoxel.ops import composite_field, composite_field_reference

SHAPE, ORIGIN, H = (7, 8, 9), [0.125, -0.25, 0.375], 0.25
LEVELS = ([0.125, -0.25, 0.375], [1.625, 1.5, 2.375], [0.7, 0.3])
INV_S = 6.0


def place(rays=6, seed=0):
    """Rays that cross a bumpy plane, and samples on them: some rays have none, one has two runs."""
    g = torch.Generator().manual_seed(seed)
    nodes = torch.stack(
        torch.meshgrid(*[torch.arange(float(n)).double() for n in SHAPE], indexing="ij"), -1
    )
    sdf = (nodes @ torch.tensor([0.2, 0.3, 0.9]).double() - 5.2) * -H
    sdf = sdf + 0.05 * torch.randn(SHAPE, generator=g, dtype=torch.float64)
    xy = torch.rand(rays, 2, generator=g, dtype=torch.float64)
    origin = torch.cat([xy * torch.tensor([1.4, 1.6]) + torch.tensor([0.15, -0.2]),
                        torch.full((rays, 1), 0.2).double()], 1).float().double()  # fmt: skip
    slant = torch.randn(rays, 3, generator=g, dtype=torch.float64)
    direction = torch.tensor([0.0, 0.0, 1.0]) + 0.1 * slant
    direction = torch.nn.functional.normalize(direction, dim=1).float().double()
    counts = [0 if i % 3 == 1 else 5 + i % 4 for i in range(rays)]
    t = torch.cat([0.6 + 0.23 * torch.arange(n).double() for n in counts]).float().double()
    connected = torch.ones(len(t), dtype=torch.bool)
    offsets = torch.tensor([0, *counts]).cumsum(0)
    connected[offsets[1:][torch.tensor(counts) > 0] - 1] = False
    connected[1] = False
    return sdf, origin, direction, Samples(t, connected, offsets), g


def case(kind, hashed=False, channels=3, **more):
    """Leaves, and a function of them that is an op or its reference."""
    sdf, origin, direction, samples, g = place(**more)
    options = {"levels": LEVELS} if hashed else {}
    if kind == "bricks":
        _, sdf, bricks = cut(sdf, far=0.8)
        options["bricks"] = bricks
    shape = (2 * 64, 2) if hashed else (*sdf.shape, channels)
    features = torch.randn(shape, generator=g, dtype=torch.float64)
    if kind == "bricks" and not hashed:
        features[:128] = 0
    leaves = [x.requires_grad_() for x in (sdf.clone(), features, origin, direction)]
    return leaves, samples, options


def function(op, samples, options, min_share, fixed=None):
    def call(sdf, features, origin, direction):
        if fixed is not None:  # rows of missing bricks get no gradient
            sdf = torch.cat([fixed.to(sdf.dtype), sdf])
            features = (
                features
                if "levels" in options
                else torch.cat([features.new_zeros(128, features.shape[1]), features])
            )
        along = replace(samples, t=samples.t.to(sdf.dtype))
        found = op(sdf, features, origin, direction, along, ORIGIN, H, INV_S,
                   min_share=min_share, **options)  # fmt: skip
        return (
            found
            if isinstance(found, torch.Tensor)
            else torch.cat(
                [found.opacity[:, None], found.t[:, None], found.gradient, found.features], 1
            )
        )

    return call


@pytest.mark.parametrize("min_share", [0.0, 0.3])
@pytest.mark.parametrize("hashed", [False, True])
@pytest.mark.parametrize("kind", ["dense", "bricks"])
def test_native_equals_reference(kind, hashed, min_share):
    leaves, samples, options = case(kind, hashed)
    fixed = None
    if kind == "bricks":
        fixed = leaves[0].detach()[:128]
        leaves[:2] = [
            (x.detach()[128:] if x is leaves[0] or not hashed else x.detach()).requires_grad_()
            for x in leaves[:2]
        ]
    calls = [
        function(op, samples, options, min_share, fixed)
        for op in (composite_field, composite_field_reference)
    ]
    check_op(*calls, [tuple(leaves)])


@pytest.mark.parametrize("hashed", [False, True])
def test_it_is_the_chain_of_the_ops(hashed):
    """march, sample, encode, section_alpha and composite, each the native one."""
    leaves, samples, options = case("dense", hashed)
    got = composite_field(*leaves, samples, ORIGIN, H, INV_S, **options)
    sdf, features, origin, direction = leaves
    ray = torch.repeat_interleave(samples.offsets.diff())
    points = origin[ray] + samples.t[:, None] * direction[ray]
    none = sdf.new_empty(*sdf.shape, 0)
    value, gradient, feature = ops.sample_dense(
        sdf, none if hashed else features, points, ORIGIN, H
    )
    if hashed:
        feature = ops.encode_hash(features, points, *LEVELS)
    alpha = ops.section_alpha(value, samples.connected, INV_S)
    ends = torch.cat([torch.ones_like(value)[:, None], samples.t[:, None], gradient, feature], 1)
    wanted, _ = ops.composite(alpha, 0.5 * (ends + ends.roll(-1, 0)), samples.offsets)
    torch.testing.assert_close(
        torch.cat([got.opacity[:, None], got.t[:, None], *got[2:]], 1), wanted
    )


def test_light_samples_lend_only_their_distance():
    """Features of a sample below the share do not matter; those of the heaviest do."""
    leaves, samples, options = case("dense", hashed=True)
    points = leaves[2][0] + samples.t[: samples.offsets[1], None] * leaves[3][0]
    _, weight = ops.composite(
        ops.section_alpha(
            ops.sample_dense(leaves[0], leaves[0].new_empty(*SHAPE, 0), points, ORIGIN, H)[0],
            samples.connected[: len(points)],
            INV_S,
        ),
        points,
        torch.tensor([0, len(points)]),
    )
    share = (weight + weight.roll(1)) / 2
    assert (share < 0.5 * share.max()).any()
    one = composite_field(*leaves, samples, ORIGIN, H, INV_S, min_share=0.99, **options)
    heaviest = points[share.argmax()][None]
    wanted = ops.encode_hash(leaves[1], heaviest, *LEVELS) * one.opacity[0]
    torch.testing.assert_close(one.features[0], wanted[0])
    all_of_t = composite_field(*leaves, samples, ORIGIN, H, INV_S, **options).t
    torch.testing.assert_close(one.t, all_of_t)


def test_rays_that_are_nowhere():
    """NaN in one ray stays there, and gives no gradient to the field."""
    leaves, samples, options = case("dense", hashed=True)
    leaves[2] = leaves[2].detach().clone()
    leaves[2][2] = torch.nan
    got = composite_field(*leaves, samples, ORIGIN, H, INV_S, **options)
    good = torch.arange(len(leaves[2])) != 2
    assert got.opacity[2].isnan()
    assert all(x[good].isfinite().all() for x in got)
    grad, _ = torch.autograd.grad(got.features[good].sum(), leaves[:2])
    assert grad.isfinite().all()


@pytest.mark.parametrize(
    "offsets", [[0, 5, 3, 9, 9, 9, 9], [0, 1, 2, 3, 4, 5, 6], [1, 2, 2, 2, 2, 2, 2]]
)
def test_offsets_that_do_not_fit(offsets):
    leaves, samples, _ = case("dense")
    with pytest.raises(ValueError, match="offsets must rise from 0"):
        composite_field(*leaves, replace(samples, offsets=torch.tensor(offsets)), ORIGIN, H, INV_S)
