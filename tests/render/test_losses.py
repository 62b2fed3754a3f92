"""Losses: what they measure and where they must not push."""

import pytest
import torch

from univoxel.render import metrics


def test_clipped_pixels_cost_nothing_when_overshot():
    target = torch.tensor([[1.0, 0.5, 1.0]])
    drawn = torch.tensor([[1.7, 0.6, 0.9]], requires_grad=True)
    loss = metrics.photometric(drawn, target)
    assert loss.item() == pytest.approx((0.0 + 0.1 + 0.1) / 3)
    loss.backward()
    torch.testing.assert_close(drawn.grad, torch.tensor([[0.0, 1 / 3, -1 / 3]]))


def test_silhouette_vanishes_where_equal():
    a = torch.rand(5)
    assert metrics.silhouette(a, a) == 0
    assert metrics.silhouette(a + 0.5, a).item() == pytest.approx(0.25)
