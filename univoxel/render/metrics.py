"""Quality metrics and losses: plain functions of tensors."""

from __future__ import annotations

import numpy as np
import torch
from scipy.spatial import KDTree
from skimage.metrics import structural_similarity
from torch import Tensor

from univoxel.color import linear_to_srgb
from univoxel.core.records import Mesh
from univoxel.errors import UserError


def photometric(encoded: Tensor, target: Tensor, clipped: float = 0.99) -> Tensor:
    """L1 between sRGB-encoded colours [N, 3].

    A photograph's clipped pixel says only that the light was at least so bright: where the target
    is above `clipped`, overshoot costs nothing.
    """
    over = (target > clipped) & (encoded > target)
    return torch.where(over, 0.0, (encoded - target).abs()).mean(1).mean()


def silhouette(opacity: Tensor, alpha: Tensor) -> Tensor:
    """Squared difference of opacity and the photograph's alpha, [N]."""
    return (opacity - alpha).square().mean()


# How good a reconstruction is: plain functions, the definitions that `univoxel eval` prints.
#
# Pictures are sRGB in [0, 1], composited on black: linear_to_srgb(linear straight colour * alpha).
# Numbers of a set of views are means over the views.


BEST_PSNR = 100.0  # dB, where pictures are equal: keeps means finite
BLACK, BLACK_TRUTH = 1e-4, 1e-3  # linear: albedo below has no ratio, estimated and true
HALF_WINDOW = 5  # pixels from the middle of a window of SSIM to its side
ENOUGH = 0.01  # share of the pixels that have to have a ratio in a channel


def on_black(linear: Tensor, alpha: Tensor) -> Tensor:
    """What is compared: straight linear colour [..., 3] and alpha [...] -> sRGB [..., 3]."""
    return linear_to_srgb(linear * alpha[..., None])


def psnr(picture: Tensor, truth: Tensor, mask: Tensor | None = None) -> float:
    """Peak signal-to-noise ratio, dB: -10 log10 of the mean squared difference, at most 100.

    Args:
        picture, truth: [H, W, 3] in [0, 1].
        mask: [H, W] bool, the pixels that count; all when left out.

    Raises:
        ValueError: sizes differ, or no pixel counts.
    """
    _same_size("psnr", picture, truth)
    difference = (picture - truth).double()
    if mask is not None:
        difference = difference[mask]
    if not difference.numel():
        raise ValueError("psnr: expected pixels to compare, got none")
    return min(BEST_PSNR, -10 * float(difference.square().mean().clamp_min(1e-300).log10()))


def ssim(picture: Tensor, truth: Tensor) -> float:
    """Structural similarity of [H, W, 3] pictures in [0, 1], at least 11 pixels wide and high.

    Gaussian window of sigma 1.5 (11 x 11), K1 0.01, K2 0.03, mean over channels and pixels.
    Source: Wang et al. 2004.
    """
    _same_size("ssim", picture, truth)
    if min(picture.shape[:2]) < 11:
        raise UserError(f"ssim: expected at least 11x11 pixels, got {list(picture.shape[:2])}")
    differs = (picture != truth).any(-1)
    if not differs.any():
        return 1.0
    # Where all of a window is equal, pictures are similar by 1
    height, width = differs.shape
    top, left = (max(int(n.min()) - 2 * HALF_WINDOW, 0) for n in differs.nonzero(as_tuple=True))
    bottom, right = (int(n.max()) + 2 * HALF_WINDOW + 1 for n in differs.nonzero(as_tuple=True))
    found = structural_similarity(
        picture[top:bottom, left:right].double().numpy(),
        truth[top:bottom, left:right].double().numpy(),
        data_range=1.0,
        channel_axis=-1,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        full=True,
    )
    similarity = np.asarray(found[1])
    # Windows that reach beyond the pictures do not count
    rows = slice(max(HALF_WINDOW - top, 0), height - HALF_WINDOW - top)
    columns = slice(max(HALF_WINDOW - left, 0), width - HALF_WINDOW - left)
    counted = picture.shape[2] * (height - 2 * HALF_WINDOW) * (width - 2 * HALF_WINDOW)
    return 1 - float((1 - similarity[rows, columns]).sum()) / counted


def albedo_scale(truth: Tensor, albedo: Tensor, mask: Tensor, channels: int = 3) -> Tensor:
    """The scale [3] that albedo and light share and pictures cannot fix.

    The median of truth / albedo over the pixels of all test views inside the mask, in linear RGB:
    per channel (`channels` 3), or of the three channels together (1: three equal numbers).

    Black has no ratio: values below 1e-4 in the estimate or 1e-3 in the truth do not count. Blue
    cloth would else have the scale 0 in red, and its pictures no red at all. A channel of which
    less than a hundredth is left takes the scale of the others together, or 1 if there are none.

    Args:
        truth, albedo: [..., 3] linear.
        mask: [...] bool.
    """
    _same_size("albedo_scale", albedo, truth)
    if channels not in (1, 3):
        raise ValueError(f"albedo_scale: channels must be 1 or 3, got {channels}")
    above, below = truth[mask].double().numpy(), albedo[mask].double().numpy()
    if channels == 1:
        above, below = above.reshape(-1, 1), below.reshape(-1, 1)
    there = (below > BLACK) & (above > BLACK_TRUTH)
    ratio = np.divide(above, below, out=np.ones_like(above), where=there)
    enough = there.sum(0) >= max(1.0, ENOUGH * len(there))
    told = ratio[:, enough][there[:, enough]]
    others = float(np.median(told)) if len(told) else 1.0
    scales = [
        float(np.median(r[t])) if e else others
        for r, t, e in zip(ratio.T, there.T, enough, strict=True)
    ]
    return torch.tensor(scales, dtype=torch.float32).expand(3).clone()


def roughness_mse(roughness: Tensor, truth: Tensor, mask: Tensor) -> float:
    """Mean squared difference of perceptual roughness [...] over the mask [...]."""
    _same_size("roughness_mse", roughness, truth)
    return float((roughness - truth)[mask].double().square().mean())


def normal_mae(normal: Tensor, truth: Tensor, mask: Tensor) -> float:
    """Mean angle between normals [..., 3] over the mask [...], degrees.

    A normal of length 0, where nothing was found, is 90 degrees off.
    """
    _same_size("normal_mae", normal, truth)
    a = torch.nn.functional.normalize(normal[mask].double(), dim=-1)
    b = torch.nn.functional.normalize(truth[mask].double(), dim=-1)
    # exact at small angles too, where the arc cosine of a . b is not
    angle = 2 * torch.atan2((a - b).norm(dim=-1), (a + b).norm(dim=-1))
    return float(angle.rad2deg().mean())


def chamfer(points: Tensor, truth: Tensor) -> float:
    """Symmetric Chamfer distance of point sets [P, 3] and [Q, 3], world units.

    Half the sum of the mean distance from each point to the nearest of the other set, both ways.

    Raises:
        ValueError: a set is empty.
    """
    if not len(points) or not len(truth):
        raise ValueError(f"chamfer: both sets need points, got {len(points)} and {len(truth)}")
    a, b = points.double().numpy(), truth.double().numpy()
    there, _ = KDTree(b).query(a)
    back, _ = KDTree(a).query(b)
    return float(0.5 * (there.mean() + back.mean()))


def spearman(a: Tensor, b: Tensor) -> float | None:
    """Rank correlation of two sets of N numbers, in [-1, 1], with mean ranks for equal ones.

    None if one of the sets is all equal, or empty. Source: Spearman 1904.
    """
    _same_size("spearman", a, b)
    from scipy.stats import rankdata  # half a second, which every command would wait

    first, second = rankdata(a.numpy()), rankdata(b.numpy())
    if not len(first) or not first.std() or not second.std():
        return None
    return float(np.corrcoef(first, second)[0, 1])


def sample_mesh(mesh: Mesh, count: int, generator: torch.Generator) -> Tensor:
    """Points [count, 3] uniform over the area of a mesh.

    Raises:
        ValueError: the mesh has no area.
    """
    a, b, c = mesh.vertices.double()[mesh.faces.long()].unbind(1)
    area = torch.linalg.cross(b - a, c - a).norm(dim=1)
    total = area.cumsum(0)
    if not len(total) or not total[-1] > 0:
        raise ValueError(f"sample_mesh: expected a mesh with area > 0, got {len(area)} triangles")
    u = torch.rand(count, 3, generator=generator, dtype=torch.float64)
    face = torch.searchsorted(total, u[:, 0] * total[-1], right=True).clamp_max(len(area) - 1)
    root = u[:, 1:2].sqrt()  # Turk 1990, "Generating random points in triangles"
    v = u[:, 2:3]
    return ((1 - root) * a[face] + root * (1 - v) * b[face] + root * v * c[face]).float()


def _same_size(function: str, value: Tensor, truth: Tensor) -> None:
    if value.shape != truth.shape:
        raise ValueError(
            f"{function}: expected equal sizes, got {list(value.shape)} and {list(truth.shape)}"
        )
