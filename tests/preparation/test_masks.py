"""Masks that are too wide are told from the outline that photographs show inside of them."""

import pytest
import torch
from scipy import ndimage

from univoxel.preparation import masks as task
from univoxel.preparation.hull import mask_distances
from univoxel.preparation.masks import eroded, mask_excess, repeats_edge

VIEWS, SIZE, RADIUS = 6, 96, 26


def depth() -> torch.Tensor:
    """Pixels inside the outline of a disc, elsewhere in each picture: [V, H, W]."""
    y, x = torch.meshgrid(torch.arange(SIZE), torch.arange(SIZE), indexing="ij")
    generator = torch.Generator().manual_seed(0)
    middle = SIZE / 2 + 8 * torch.rand(VIEWS, 2, 1, 1, generator=generator) - 4
    return RADIUS - ((x - middle[:, 0]) ** 2 + (y - middle[:, 1]) ** 2).sqrt()


def patterned(seed: int, low: float, high: float) -> torch.Tensor:
    """Blotches of some pixels: [V, H, W, 3] in [low, high]."""
    noise = torch.rand(VIEWS, SIZE, SIZE, 3, generator=torch.Generator().manual_seed(seed))
    smooth = torch.from_numpy(ndimage.gaussian_filter(noise.numpy(), (0, 3, 3, 0)))
    smooth = (smooth - smooth.min()) / (smooth.max() - smooth.min())
    return low + (high - low) * smooth


def coverage(pixels: float, sharp: bool = False) -> torch.Tensor:
    """Masks of the disc that are so many pixels too wide."""
    soft = (depth() + pixels + 0.5).clamp(0, 1)
    return (soft > 0.5).float() if sharp else soft


def before(surroundings: torch.Tensor, disc: torch.Tensor) -> torch.Tensor:
    inside = coverage(0)[..., None]
    return inside * disc + (1 - inside) * surroundings


def found(color: torch.Tensor, masks: torch.Tensor) -> int:
    return mask_excess(color, masks, mask_distances(masks))


@pytest.mark.parametrize("eight_bits", [False, True])
@pytest.mark.parametrize("sharp", [False, True])
@pytest.mark.parametrize("pixels", [0, 1, 2, 3, 6])
def test_how_much_too_wide(pixels, sharp, eight_bits):
    color = before(patterned(0, 0.0, 0.4), patterned(1, 0.3, 0.9))
    color = (255 * color).byte() if eight_bits else color
    assert found(color, coverage(pixels, sharp)) == pixels


@pytest.mark.parametrize(("pixels", "wanted"), [(0, 0), (1, 0), (2, 0), (3, 3), (6, 6)])
def test_of_objects_cut_out_only_the_inside_tells(pixels, wanted):
    """Where they were cut is no outline; and what is 1 or 2 pixels inside looks like shading."""
    masks = coverage(pixels)
    color = before(patterned(0, 0.0, 0.4), patterned(1, 0.3, 0.9)) * (masks[..., None] > 0)
    assert found(color, masks) == wanted


@pytest.mark.parametrize("spread", [True, False])
def test_colours_of_the_edge_that_go_on_outside_are_no_surroundings(spread):
    """Pictures for blending repeat the edge outwards; a rim that shades off is then no outline."""
    shade = (1 - 0.7 * (-depth().clamp_min(0) / 2).exp())[..., None]
    color, masks = shade * patterned(1, 0.3, 0.9), coverage(0)
    for picture, solid in zip(color, masks > 0.99, strict=True):
        nearest = ndimage.distance_transform_edt(
            ~solid.numpy(), return_distances=False, return_indices=True
        )
        y, x = torch.from_numpy(nearest)
        picture.copy_(picture[y, x])
    distance = mask_distances(masks)
    assert all(repeats_edge(c, d) for c, d in zip(color, distance, strict=True))
    if not spread:  # what stands behind
        color = before(patterned(0, 0.0, 0.4), color)
        assert not any(repeats_edge(c, d) for c, d in zip(color, distance, strict=True))
    assert found(color, masks) == 0


def test_a_pattern_inside_is_no_outline():
    """A white vase, painted in the middle, before a white wall."""
    white, paint = torch.full((VIEWS, SIZE, SIZE, 3), 0.9), patterned(1, 0.0, 0.9)
    painted = torch.lerp(white, paint, ((depth()[..., None] - 3) / 12).clamp(0, 1))
    color = before(white, painted)
    assert found(color, coverage(0)) == 0


@pytest.mark.parametrize("masks", [torch.zeros(2, 9, 9), torch.ones(2, 9, 9)])
def test_no_edge_says_nothing(masks):
    assert found(torch.rand(2, 9, 9, 3), masks) == 0


def test_wider_masks_than_are_looked_for_stay(monkeypatch):
    color = before(patterned(0, 0.0, 0.4), patterned(1, 0.3, 0.9))
    assert found(color, coverage(9)) == 0
    monkeypatch.setattr(task, "REACH_SHARE", 0.1)  # of 96 pixels
    assert found(color, coverage(9)) == 9


def test_of_many_photographs_some_are_looked_at(monkeypatch):
    monkeypatch.setattr(task, "VIEWS", 2)
    monkeypatch.setattr(task, "PIXELS", 0)
    color, alpha = before(patterned(0, 0.0, 0.4), patterned(1, 0.3, 0.9)), coverage(0)
    alpha[::3] = coverage(3)[::3]  # two of six
    assert found(color, alpha) == 3


def test_taken_in_masks_end_where_the_object_does():
    wide = mask_distances(coverage(3))
    inner = eroded(wide, 3)
    # Distances to pixels, not to the true edge: up to half a pixel off
    assert (inner - coverage(0)).abs().max() < 0.6
    assert (inner - coverage(0)).abs().mean() < 0.01
