"""Metrics and losses against cases small enough to compute by hand."""

import math

import pytest
import torch
from skimage.metrics import structural_similarity

from univoxel.core.records import Mesh
from univoxel.render import metrics


def gray(value, size=4):
    return torch.full((size, size, 3), float(value))


def test_psnr():
    assert metrics.psnr(gray(0.5), gray(0.6)) == pytest.approx(20.0, abs=1e-5)  # 0.1^2
    assert metrics.psnr(gray(0.5), gray(0.5)) == 100.0
    picture, mask = gray(0.5), torch.zeros(4, 4, dtype=torch.bool)
    picture[0, 0], mask[0, 0] = 1.0, True
    assert metrics.psnr(picture, gray(0.5)) == pytest.approx(-10 * math.log10(0.25 / 16))
    assert metrics.psnr(picture, gray(0.5), mask) == pytest.approx(-10 * math.log10(0.25))


def test_on_black_encodes_the_product():
    """Half-covered white is 0.5 linear, 0.7354 in sRGB; not half of the encoded white."""
    picture = metrics.on_black(torch.ones(1, 1, 3), torch.full((1, 1), 0.5))
    assert picture.flatten().tolist() == pytest.approx([0.735357] * 3, abs=1e-6)


def test_ssim():
    a, b, c1 = 0.5, 0.6, 0.01**2
    expected = (2 * a * b + c1) / (a * a + b * b + c1)
    assert metrics.ssim(gray(a, 16), gray(b, 16)) == pytest.approx(expected, rel=1e-6)
    noise = torch.rand(16, 16, 3, generator=torch.Generator().manual_seed(0))
    assert metrics.ssim(noise, noise) == pytest.approx(1.0)
    assert metrics.ssim(noise, 1 - noise) < 0


def test_albedo_scale_is_the_median_ratio_in_the_mask():
    albedo = torch.tensor([[0.1, 0.2, 0.5]]).repeat(5, 1)
    truth = albedo * torch.tensor([2.0, 0.5, 1.0])
    truth[0] *= 100  # the median does not care
    mask = torch.tensor([True, True, True, True, False])
    truth[4] = 7.0  # outside
    assert metrics.albedo_scale(truth, albedo, mask).tolist() == pytest.approx([2.0, 0.5, 1.0])
    # 12 ratios: 200, 100, 50, 2 x 3, 1 x 3, 0.5 x 3 -> between 1 and 2
    assert metrics.albedo_scale(truth, albedo, mask, 1).tolist() == pytest.approx([1.5] * 3)


def test_albedo_scale_without_ratios():
    albedo = torch.tensor([[0.0, 0.2, 0.0], [0.1, 0.2, 0.0], [0.1, 0.2, 0.0]])
    scale = metrics.albedo_scale(2 * albedo + 0.1, albedo, torch.ones(3, dtype=torch.bool))
    assert scale.tolist() == pytest.approx([3.0, 2.5, 2.5])  # of 3, 3, 2.5, 2.5, 2.5
    black = torch.zeros(3, 3)
    assert metrics.albedo_scale(black, albedo, torch.ones(3).bool()).tolist() == [1.0] * 3
    assert metrics.albedo_scale(albedo, black, torch.ones(3).bool()).tolist() == [1.0] * 3


@pytest.mark.parametrize("red", [0.0, 0.0005])
def test_a_channel_that_is_black_in_the_truth_keeps_what_was_found_in_it(red):
    """Blue cloth with a little of a red seam: not its scale, and not of all ratios the median."""
    truth = torch.tensor([[red, 0.1, 0.6]]).repeat(1000, 1)
    truth[:5, 0] = 0.5
    albedo = torch.tensor([[0.01, 0.2, 0.4]]).repeat(1000, 1)
    everywhere = torch.ones(1000, dtype=torch.bool)
    assert metrics.albedo_scale(truth, albedo, everywhere).tolist() == [1.0, 0.5, 1.5]
    truth[:20, 0] = 0.5  # enough of it
    assert metrics.albedo_scale(truth, albedo, everywhere).tolist() == [50.0, 0.5, 1.5]
    # 20 ratios of 50, 1000 each of 0.5 and 1.5
    assert metrics.albedo_scale(truth, albedo, everywhere, 1).tolist() == [1.5] * 3


def test_only_the_mask_counts_and_no_normal_is_a_right_angle():
    roughness = torch.tensor([[0.5, 0.9]])
    truth, mask = torch.tensor([[0.3, 0.0]]), torch.tensor([[True, False]])
    assert metrics.roughness_mse(roughness, truth, mask) == pytest.approx(0.04)
    mask = torch.ones(1, dtype=torch.bool)
    assert metrics.normal_mae(torch.zeros(1, 3), torch.tensor([[0.0, 0.0, 1.0]]), mask) == 90.0


@pytest.mark.parametrize("degrees", [0.0, 0.001, 30.0, 90.0, 180.0])
def test_normal_mae_of_known_angles(degrees):
    angle = math.radians(degrees)
    a = torch.tensor([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0]], dtype=torch.float64)
    b = torch.tensor([[math.sin(angle), 0.0, math.cos(angle)], [0.0, 1.0, 0.0]]).double()
    mask = torch.tensor([True, False])
    # truth comes in half precision, so its length is off
    assert metrics.normal_mae(a, 1.001 * b, mask) == pytest.approx(degrees, abs=1e-6)


def test_chamfer_of_shifted_points():
    truth = torch.tensor([[0.0, 0.0, 0.0], [10.0, 0.0, 0.0]])
    points = torch.tensor([[0.0, 0.0, 1.0]])
    # there 1; back 1 and sqrt(101)
    expected = 0.5 * (1 + 0.5 * (1 + math.sqrt(101)))
    assert metrics.chamfer(points, truth) == pytest.approx(expected)
    assert metrics.chamfer(truth, points) == pytest.approx(expected)


def test_samples_are_uniform_over_the_area():
    vertices = torch.tensor(
        [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 5.0], [3, 0, 5], [0, 1, 5]]
    )
    mesh = Mesh(vertices, torch.tensor([[0, 1, 2], [3, 4, 5]], dtype=torch.int32))
    points = metrics.sample_mesh(mesh, 20000, torch.Generator().manual_seed(0))
    upper = points[points[:, 2] > 2]
    # three quarters of the area; sigma is 0.003
    assert len(upper) / len(points) == pytest.approx(0.75, abs=0.012)
    # the mean of uniform points is the centroid; sigma is below 0.006
    assert upper.mean(0).tolist() == pytest.approx([1.0, 1 / 3, 5.0], abs=0.025)
    assert bool((points[:, 0] / 3 + points[:, 1] < 1 + 1e-6).all())


def test_rank_correlation():
    x = torch.tensor([0.1, 5.0, -2.0, 3.0])
    assert metrics.spearman(x, x.exp()) == pytest.approx(1)
    assert metrics.spearman(x, -x) == pytest.approx(-1)
    # ranks 1 2 3 4 against 1 3.5 2 3.5: 1 - 6 sum d^2 / (n (n^2 - 1)) holds only without ties
    with_ties = metrics.spearman(torch.arange(4.0), torch.tensor([0.0, 7.0, 3.0, 7.0]))
    assert with_ties == pytest.approx(3 / 22.5**0.5)
    assert metrics.spearman(x, torch.ones(4)) is None
    assert metrics.spearman(torch.empty(0), torch.empty(0)) is None


NOTHING, FLAT = torch.zeros(0, 3), torch.tensor([[0, 1, 2]]).int()
DIFFER = r"equal sizes, got \[4, 4, 3\] and \[5, 5, 3\]"


@pytest.mark.parametrize(
    ("measure", "arguments", "message"),
    [
        (metrics.psnr, (gray(0), gray(0), torch.zeros(4, 4).bool()), "got none"),
        (metrics.psnr, (gray(0), gray(0, 5)), DIFFER),
        (metrics.ssim, (gray(0), gray(0, 5)), DIFFER),
        (metrics.ssim, (gray(0), gray(0)), "at least 11x11"),
        (metrics.albedo_scale, (*2 * [gray(1)], gray(1)[..., 0] > 0, 2), "must be 1 or 3, got 2"),
        (metrics.chamfer, (NOTHING, torch.zeros(1, 3)), "got 0 and 1"),
        (metrics.sample_mesh, (Mesh(torch.zeros(3, 3), FLAT), 9, None), "got 1 triangles"),
        (metrics.sample_mesh, (Mesh(NOTHING, FLAT[:0]), 9, None), "area > 0, got 0 triangles"),
        (metrics.spearman, (torch.ones(4), torch.ones(2)), "spearman: expected equal sizes"),
    ],
)
def test_what_cannot_be_measured(measure, arguments, message):
    with pytest.raises(ValueError, match=message):
        measure(*arguments)


@pytest.mark.parametrize("place", [(0, 0), (-1, -1), (3, -4), (20, 15)])
@pytest.mark.parametrize("size", [(40, 31), (11, 11)])
def test_ssim_where_little_differs_is_that_of_the_whole(size, place):
    """Only what is around the differing pixels is looked at."""
    picture = torch.rand(*size, 3, generator=torch.Generator().manual_seed(0))
    other = picture.clone()
    row, column = (min(at, n - 1) for at, n in zip(place, size, strict=True))
    other[row, column] = 1 - other[row, column]
    whole = structural_similarity(
        picture.double().numpy(),
        other.double().numpy(),
        data_range=1.0,
        channel_axis=-1,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
    )
    assert metrics.ssim(picture, other) == pytest.approx(whole, abs=1e-9)


def test_losses():
    target = torch.tensor([[1.0, 0.5, 1.0]])
    drawn = torch.tensor([[1.7, 0.6, 0.9]], requires_grad=True)
    loss = metrics.photometric(drawn, target)
    assert loss.item() == pytest.approx((0.0 + 0.1 + 0.1) / 3)
    loss.backward()
    torch.testing.assert_close(drawn.grad, torch.tensor([[0.0, 1 / 3, -1 / 3]]))
    a = torch.rand(5)
    assert metrics.silhouette(a, a) == 0
    assert metrics.silhouette(a + 0.5, a).item() == pytest.approx(0.25)
