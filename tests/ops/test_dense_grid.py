"""Sampling of a dense grid: native against reference, definitions."""

import pytest
import torch
from check_op import check_op, grads_of, same_on_threads

from univoxel.ops import sample_dense, sample_dense_reference

ORIGIN = [0.125, -0.25, 0.375]
H = 0.25


def case(shape=(5, 6, 7), channels=3, m=40, seed=0, margin=0.2, needs=(True, True, True)):
    """A random grid, and points of which some fall outside it."""
    g = torch.Generator().manual_seed(seed)
    sdf = torch.randn(shape, generator=g, dtype=torch.float64)
    features = torch.randn(*shape, channels, generator=g, dtype=torch.float64)
    extent = (torch.tensor(shape) - 1) * H
    points = torch.rand(m, 3, generator=g, dtype=torch.float64) * (1 + 2 * margin) - margin
    # On a float32 lattice, so that both precisions see the same points.
    points = (points * extent + torch.tensor(ORIGIN)).float().double()
    leaves = [t.requires_grad_(n) for t, n in zip((sdf, features, points), needs, strict=True)]
    return (*leaves, ORIGIN, H)


def test_native_equals_reference():
    cases = [
        case(),
        case((1, 1, 1), channels=1, m=5),
        case((2, 1, 9), channels=0),
        case((1, 4, 3), channels=8),
        case((3, 3, 3), channels=12, needs=(True, True, False)),
        case((3, 4, 3), channels=16),
        case(m=0),
        case((3, 3, 3), channels=2, m=20, margin=30.0),
    ]
    check_op(sample_dense, sample_dense_reference, cases)


@pytest.mark.parametrize("shape", [(40, 35, 70), (17, 9, 10), (26, 3, 130), (9, 33, 2)])
def test_many_points_cross_slabs_and_chunks(shape):
    # 5000 points: several chunks, and a team of threads in backward. Gradcheck would take minutes.
    arguments = case(shape, channels=8, m=5000)
    torch.testing.assert_close(sample_dense(*arguments), sample_dense_reference(*arguments))
    wanted = grads_of(sample_dense_reference, arguments)
    for options in ({}, {"sparse_grad": True}):
        got = same_on_threads(
            lambda o=options: [g.to_dense() for g in grads_of(sample_dense, arguments, **o)]
        )
        torch.testing.assert_close(got, list(wanted))


def test_definition():
    """Value is linear, gradient the central difference of the interpolant, borders clamped."""
    sdf, features, points, *place = case((4, 5, 6), channels=2, m=200, margin=0.3)
    value, gradient, feature = sample_dense(sdf, features, points, *place)
    low = torch.tensor(ORIGIN).double()
    high = low + (torch.tensor(sdf.shape) - 1) * H
    inside = torch.minimum(torch.maximum(points, low), high)

    def interpolant(p):
        grid = sdf[None, None].detach()
        at = ((p - low) / (high - low) * 2 - 1).flip(-1)[None, None, None]
        options = {"align_corners": True, "padding_mode": "border"}
        return torch.nn.functional.grid_sample(grid, at, **options).flatten()

    torch.testing.assert_close(value, interpolant(points))
    for axis in range(3):
        step = torch.zeros(3).double()
        step[axis] = H
        central = (interpolant(inside + step) - interpolant(inside - step)) / (2 * H)
        torch.testing.assert_close(gradient[:, axis], central)
    torch.testing.assert_close(
        feature[:, 1], sample_dense(features[..., 1], features, points, *place)[0]
    )


def test_linear_field():
    """Inside a linear field value and gradient are exact; at the border the slope is halved."""
    slope = torch.tensor([0.5, -1.0, 2.0])
    nodes = torch.stack(torch.meshgrid(*[torch.arange(6.0)] * 3, indexing="ij"), -1)
    sdf, none = nodes @ slope, torch.empty(6, 6, 6, 0)
    points = torch.tensor([[2.3, 1.9, 3.3], [0.0, 2.0, 2.0], [5.0, 2.5, 2.5], [-4.0, 2.0, 2.0]])
    value, gradient, _ = sample_dense(sdf, none, points, (0, 0, 0), 1.0)
    torch.testing.assert_close(
        value, torch.cat([points[:3], torch.zeros(1, 3)]) @ slope + torch.tensor([0, 0, 0, 2.0])
    )
    halved = slope * torch.tensor([0.5, 1, 1])
    torch.testing.assert_close(gradient, torch.stack([slope, halved, halved, halved]))


def test_derivative_to_a_clamped_axis_is_zero():
    arguments = case((4, 4, 4), m=1)
    points = torch.tensor([[ORIGIN[0] - 1, ORIGIN[1] + 0.3, ORIGIN[2] + 9]]).double()
    *_, grad = grads_of(sample_dense, (*arguments[:2], points.requires_grad_(), ORIGIN, H))
    assert grad[0, 0] == 0
    assert grad[0, 1] != 0
    assert grad[0, 2] == 0


def test_sparse_rows_are_the_touched_ones():
    """One point in the middle: 8 rows of features, 32 of the sdf, none of the far grid."""
    sdf, features = case((30, 30, 30))[:2]
    points = torch.tensor([[12.5, 7.5, 15.5]], dtype=torch.float64)  # across three brick borders
    g_sdf, g_features = grads_of(
        sample_dense, (sdf, features, points, (0, 0, 0), 1.0), sparse_grad=True
    )
    assert g_sdf._nnz() == 32
    assert g_features._nnz() == 8
    assert g_features.indices().T.tolist() == [
        [x, y, z] for x in (12, 13) for y in (7, 8) for z in (15, 16)
    ]


def test_far_origin_keeps_the_fraction_of_a_float32_point():
    sdf, features, points, *_ = case((6, 6, 6), needs=(False, False, False))
    far = (points.float() + 100).double()
    value = sample_dense(sdf.float(), features.float(), far.float(), [100.0] * 3, H)[0]
    expected = sample_dense_reference(sdf, features, far, [100.0] * 3, H)[0]
    torch.testing.assert_close(value.double(), expected, rtol=1e-5, atol=1e-6)
