"""Losses: what they measure and where they must not push."""

import pytest
import torch

from univoxel import losses
from univoxel.color import linear_to_srgb


def test_encode_is_srgb_and_goes_on_above_one():
    x = torch.tensor([0.0, 0.001, 0.2, 1.0])
    torch.testing.assert_close(losses.encode(x), linear_to_srgb(x))
    bright = torch.tensor([3.0], requires_grad=True)
    losses.encode(bright).sum().backward()
    assert losses.encode(bright).item() > 1
    assert bright.grad.item() > 0


def test_clipped_pixels_cost_nothing_when_overshot():
    target = torch.tensor([[1.0, 0.5, 1.0]])
    drawn = torch.tensor([[1.7, 0.6, 0.9]], requires_grad=True)
    loss = losses.photometric(drawn, target)
    assert loss.item() == pytest.approx((0.0 + 0.1 + 0.1) / 3)
    loss.backward()
    torch.testing.assert_close(drawn.grad, torch.tensor([[0.0, 1 / 3, -1 / 3]]))


def test_silhouette_vanishes_where_equal():
    a = torch.rand(5)
    assert losses.silhouette(a, a) == 0
    assert losses.silhouette(a + 0.5, a).item() == pytest.approx(0.25)
