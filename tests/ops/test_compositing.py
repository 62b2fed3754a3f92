"""Compositing, opacity of sections, and fields composited along rays: closed forms, and the ops
that these stand for."""

from dataclasses import replace

import pytest
import torch
from op_cases import LEVELS, ORIGIN, H, doubled, field, fresh

from univoxel import ops
from univoxel.ops import composite, composite_field, section_alpha


def test_compositing_in_closed_form():
    """alpha = 1 hides what is behind it, and dividing by 1 - alpha would give NaN."""
    alpha = torch.tensor([0.5, 1.0, 0.3], dtype=torch.float64, requires_grad=True)
    value = torch.tensor([[1.0], [2.0], [4.0]], dtype=torch.float64)
    out, _ = composite(alpha, value, torch.tensor([0, 3]))
    (grad,) = torch.autograd.grad(out.sum(), alpha)
    # out = a0 v0 + (1 - a0)(a1 v1 + (1 - a1) a2 v2)
    assert grad.tolist() == pytest.approx([1 - 2, 0.5 * (2 - 0.3 * 4), 0.0])
    alpha = torch.tensor([0.9, 0.9, 0.9])
    _, weight = composite(alpha, torch.ones(3, 1), torch.tensor([0, 3]), early_stop=0.05)
    assert weight.tolist() == pytest.approx([0.9, 0.09, 0.0])


def test_opacity_matches_the_formula_of_the_paper():
    sdf = torch.tensor([0.3, 0.1, -0.05, -0.3, 0.2, 0.1], dtype=torch.float64)
    connected = torch.tensor([True, True, True, False, True, False])
    phi = torch.sigmoid(sdf * 10)
    expected = torch.where(connected[:-1], (1 - phi[1:] / phi[:-1]).clamp(0, 1), 0.0)
    alpha = section_alpha(sdf, connected, 10.0)
    torch.testing.assert_close(alpha[:5], expected)
    assert alpha[5] == 0
    rising = section_alpha(torch.tensor([-0.1, 0.2]), torch.tensor([True, False]), 50.0)
    assert rising[0] == 0


def test_weights_do_not_depend_on_the_number_of_sections():
    """1 - prod (1 - alpha) telescopes to 1 - Phi_last / Phi_first: finer steps change nothing."""
    coarse, fine = torch.linspace(0.5, -0.5, 5), torch.linspace(0.5, -0.5, 65)
    through = [
        (1 - section_alpha(f, torch.arange(len(f)) < len(f) - 1, 8.0)).prod()
        for f in (coarse, fine)
    ]
    torch.testing.assert_close(through[0], through[1])


def test_extreme_values_stay_finite_in_value_and_gradient():
    sdf = torch.tensor([1e30, -1e30, -1e30, 0.0, 1e-38, -5.0], requires_grad=True)
    alpha = section_alpha(sdf, torch.tensor([True] * 5 + [False]), 1e4)
    assert ((alpha >= 0) & (alpha <= 1)).all()
    (grad,) = torch.autograd.grad(alpha.sum(), sdf)
    assert grad.isfinite().all()


PLACE = ORIGIN, H


def case(hashed, **more):
    return fresh("composite_field", doubled(field(6, hashed, **more)))[0]


def sampled(given, points):
    """Distances, gradients and features at points, by the ops of one grid each."""
    sdf, features = given["sdf"], given["features"]
    if "levels" not in given:
        return ops.sample_dense(sdf, features, points, *PLACE)
    none = sdf.new_empty(*sdf.shape, 0)
    return (
        *ops.sample_dense(sdf, none, points, *PLACE)[:2],
        ops.encode_hash(features, points, *LEVELS),
    )


@pytest.mark.parametrize("hashed", [False, True])
def test_it_is_the_chain_of_the_ops(hashed):
    """march, sample, encode, section_alpha and composite, each the native one."""
    given = case(hashed)
    got, samples = composite_field(**given), given["samples"]
    ray = torch.repeat_interleave(samples.offsets.diff())
    points = given["origin"][ray] + samples.t[:, None] * given["direction"][ray]
    value, gradient, feature = sampled(given, points)
    alpha = ops.section_alpha(value, samples.connected, given["inv_s"])
    ends = torch.cat([torch.ones_like(value)[:, None], samples.t[:, None], gradient, feature], 1)
    wanted, _ = ops.composite(alpha, 0.5 * (ends + ends.roll(-1, 0)), samples.offsets)
    torch.testing.assert_close(
        torch.cat([got.opacity[:, None], got.t[:, None], *got[2:]], 1), wanted
    )


def test_light_samples_lend_only_their_distance():
    """Features of a sample below the share do not matter; those of the heaviest do."""
    given = case(True)
    samples = given["samples"]
    t = samples.t[: samples.offsets[1]]
    points = given["origin"][0] + t[:, None] * given["direction"][0]
    alpha = ops.section_alpha(sampled(given, points)[0], samples.connected[: len(t)], 6.0)
    _, weight = ops.composite(alpha, points, torch.tensor([0, len(points)]))
    share = (weight + weight.roll(1)) / 2
    assert (share < 0.5 * share.max()).any()
    one = composite_field(**given | {"min_share": 0.99})
    heaviest = points[share.argmax()][None]
    wanted = ops.encode_hash(given["features"], heaviest, *LEVELS) * one.opacity[0]
    torch.testing.assert_close(one.features[0], wanted[0])
    torch.testing.assert_close(one.t, composite_field(**given).t)


def test_rays_that_are_nowhere():
    """NaN in one ray stays there, and gives no gradient to the field."""
    given = case(True)
    given["origin"] = given["origin"].detach().clone()
    given["origin"][2] = torch.nan
    got = composite_field(**given)
    good = torch.arange(6) != 2
    assert got.opacity[2].isnan()
    assert all(x[good].isfinite().all() for x in got)
    grad, _ = torch.autograd.grad(got.features[good].sum(), [given["sdf"], given["features"]])
    assert grad.isfinite().all()


@pytest.mark.parametrize(
    "offsets", [[0, 6, 3, 9, 9, 9, 9], [0, 1, 2, 3, 4, 5, 6], [1, 2, 2, 2, 2, 2, 2]]
)
def test_offsets_that_do_not_fit(offsets):
    given = case(False)
    samples = replace(given["samples"], offsets=torch.tensor(offsets))
    with pytest.raises(ValueError, match="offsets must rise from 0"):
        composite_field(**given | {"samples": samples})
