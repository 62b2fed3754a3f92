"""What photographs show at places, and of the albedo at texels: kernels are as the references."""

import pytest
import torch

from univoxel.color import srgb_to_linear
from univoxel.ops.charts import (
    add_photograph_,
    add_photograph_reference_,
    sampled,
    sampled_reference,
)


def texels(halves: bool):
    """A fan of faces before a camera; some hidden, clipped, shiny, beyond the mask or the photo."""
    g = torch.Generator().manual_seed(0)
    count, faces, points = 4000, 40, 60
    values = torch.rand(points, 13, generator=g)
    values[:, 3:6] *= torch.rand(points, 1, generator=g)  # reflections, weak and strong
    values[:, 6:8] = 2.4 * values[:, 6:8] - 1.2
    values[:, 8] = -2 - values[:, 8]
    values[::7, 12] = 0
    matrix = torch.tensor([[30.0, 0, -20, 0], [0, -30, -15, 0], [0, 0, -1, 0]])
    mask = torch.ones(30, 40)
    mask[10:14, 5:20] = 0.5
    picture = torch.randint(0, 256, (60, 80, 3), generator=g).to(torch.uint8)
    weights = torch.rand(count, 2, generator=g) * 0.5
    return (
        torch.randint(0, faces, (count,), generator=g).int(),
        weights.half(),
        torch.randint(0, points, (faces, 3), generator=g).int(),
        torch.rand(faces, generator=g) > 0.2,
        values,
        matrix,
        mask,
        picture.float() / 200 if halves else picture,
        2.0,
    )


@pytest.mark.parametrize("linear", [False, True])
def test_the_kernel_is_as_the_reference(linear):
    given = texels(linear)
    sums = []
    for add in (add_photograph_, add_photograph_reference_):
        total, weights = torch.full((4000, 3), 0.5), torch.full((4000,), 0.25)
        add(total, weights, *given)
        sums.append((total, weights))
    for one, two in zip(*sums, strict=True):
        torch.testing.assert_close(one, two, rtol=1e-4, atol=1e-5)  # the order of float32 sums
    changed = (sums[0][1] != 0.25).float().mean()
    assert 0.2 < changed < 0.8  # some are hidden or beyond the mask


def test_sizes_and_rows_are_checked():
    total, weights, (face, *rest) = torch.zeros(4000, 3), torch.zeros(4000), texels(False)
    with pytest.raises(ValueError, match="rows that exist"):
        add_photograph_(total, weights, face + 1, *rest)
    with pytest.raises(ValueError, match="face must be"):
        add_photograph_(total, weights, face.long(), *rest)


@pytest.mark.parametrize("linear", [False, True])
def test_pictures_are_sampled_as_by_the_reference(linear):
    g = torch.Generator().manual_seed(0)
    picture = torch.randint(0, 256, (23, 17, 3), generator=g).to(torch.uint8)
    picture = picture.float() / 200 if linear else picture
    place = torch.rand(500, 2, generator=g) * torch.tensor([25.0, 31.0]) - 4  # some are beyond
    torch.testing.assert_close(
        sampled(picture, place), sampled_reference(picture, place), rtol=1e-4, atol=1e-5
    )
    middle = torch.tensor([[5.5, 7.5]])
    same = picture[7, 5] if linear else srgb_to_linear(picture[7, 5] / 255)
    torch.testing.assert_close(sampled(picture, middle)[0], same)
    assert sampled(picture, place[:0]).shape == (0, 3)
    turned = picture.transpose(0, 1)  # not contiguous
    torch.testing.assert_close(sampled(turned, middle), sampled(turned.contiguous(), middle))
