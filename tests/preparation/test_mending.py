"""Rough masks of a ball whose outline is known: what is doubted, what is moved, what is left."""

import math
from dataclasses import replace

import pytest
import torch
from analytic import RADIUS, photos_of

from univoxel.data import Photos
from univoxel.errors import DataError, UserError
from univoxel.preparation import belief, mending, prepare, registration
from univoxel.preparation.belief import Belief
from univoxel.preparation.hull import hull_sdf, mask_distances
from univoxel.preparation.mending import mended
from univoxel.preparation.registration import MAX_CONTRADICTION, contradiction
from univoxel.presets import preset

VIEWS, SIZE = 24, 96
BOX = torch.full((3,), -0.7), torch.full((3,), 0.7)
ROUGH = Belief(BOX, False, 2, 5.0)


@pytest.fixture(scope="module")
def photos():
    """Before a wall of a colour that the ball has nowhere, and that is never twice the same."""
    found = photos_of(VIEWS, SIZE)
    wall = torch.tensor([0.1, 0.5, 0.1]) + 0.02 * torch.rand(
        found.color.shape, generator=torch.Generator().manual_seed(0)
    )
    shown = found.alpha[..., None].bool()
    return replace(found, color=torch.where(shown, found.color, wall))


def without_a_part(photos: Photos, views: tuple[int, ...]) -> Photos:
    """Masks of some views that lack what lies above 0.2."""
    alpha = photos.alpha.clone()
    for view in views:
        alpha[view, : SIZE // 2 - 10] = 0
    return replace(photos, alpha=alpha)


def wavering(photos: Photos, pixels: float) -> Photos:
    """Masks whose edge is off by so many pixels, up to 2 standard deviations."""
    y, x = torch.meshgrid(*[torch.arange(SIZE) + 0.5 - SIZE / 2] * 2, indexing="ij")
    angle, distance = torch.atan2(y, x), mask_distances(photos.alpha)
    waves = torch.stack([torch.sin(5 * angle + 2.4 * view) for view in range(VIEWS)])
    return replace(photos, alpha=(distance + 2**0.5 * pixels * waves < 0).float())


def agreement(one: torch.Tensor, other: torch.Tensor) -> float:
    """IoU of masks."""
    one, other = one > 0.5, other > 0.5
    return float((one & other).sum() / (one | other).sum())


def on_the_ball(radius: float) -> torch.Tensor:
    points = torch.randn(2000, 3, generator=torch.Generator().manual_seed(0))
    return radius * points / points.norm(dim=1, keepdim=True)


def test_exact_masks_beside_wrong_ones_stay_and_carve_alone(photos):
    """Edges of masks that agree are not moved, and one view is enough to carve again."""
    spoilt = without_a_part(photos, (3,))
    found = mended(spoilt, mask_distances(spoilt.alpha), ROUGH)
    assert torch.equal(found.photos.alpha, spoilt.alpha)
    assert found.belief.votes == 1
    assert found.belief.off <= MAX_CONTRADICTION
    lost = (photos.alpha > 0.5) & (spoilt.alpha < 0.5)
    assert found.doubted[lost].float().mean() > 0.9
    assert found.doubted[~lost].float().mean() < 1e-3
    pixel = 2 * 1.8 / SIZE / 2  # world units, at the ball
    held = hull_sdf(found.distance, photos.cameras, on_the_ball(RADIUS))
    exact = hull_sdf(mask_distances(photos.alpha), photos.cameras, on_the_ball(RADIUS))
    assert (held - exact).abs().quantile(0.99) < pixel
    assert held.max() < pixel  # nothing is bitten off


def test_what_two_masks_lack_together_comes_back(photos):
    """As many as the votes: either is doubted where the other does not lack what lies behind."""
    alpha = photos.alpha.clone()
    alpha[11:13, :, : SIZE // 2 - 5] = 0  # seen from directions that are 137 degrees apart
    spoilt, distance = replace(photos, alpha=alpha), mask_distances(alpha)
    found = mended(spoilt, distance, ROUGH)
    bitten, whole = (
        hull_sdf(d, photos.cameras, on_the_ball(0.9 * RADIUS), votes=2)
        for d in (distance, found.distance)
    )
    assert bitten.max() > 0.1 * RADIUS
    assert whole.max() < 0


def test_ground_that_a_mask_keeps_is_doubted_and_no_edge(photos, monkeypatch):
    alpha = photos.alpha.clone()
    alpha[5, -30:, 20:60] = 1
    spoilt = replace(photos, alpha=alpha)
    found = mended(spoilt, mask_distances(alpha), ROUGH)
    kept = (alpha > 0.5) & (photos.alpha < 0.5)
    assert found.doubted[kept].float().mean() > 0.9
    # The outline of what it keeps is no edge that others would have to show
    monkeypatch.setattr(registration, "QUANTILE", 0.99)  # they are one in forty
    all_edges, edges = (
        contradiction(found.distance, photos.cameras, BOX, doubted)
        for doubted in (None, found.doubted)
    )
    assert edges <= MAX_CONTRADICTION < all_edges
    assert found.belief.votes == 1


def test_edges_that_waver_are_moved_by_colours(photos):
    rough = wavering(photos, 1.5)
    distance = mask_distances(rough.alpha)
    belief = replace(ROUGH, off=contradiction(distance, photos.cameras, BOX))
    assert belief.off > 2 * MAX_CONTRADICTION
    found = mended(rough, distance, belief)
    sure = ~found.doubted
    before = agreement(rough.alpha[sure], photos.alpha[sure])
    after = agreement(found.photos.alpha[sure], photos.alpha[sure])
    assert 1 - after < 0.4 * (1 - before)
    assert found.belief.off < belief.off


def test_most_masks_know_better_than_each_of_them(photos, monkeypatch):
    """Edges are drawn once more from the hull's silhouettes, unless it is too coarse."""
    rough, draw, once = wavering(photos, 1.5), mending._drawn_from_hull, []

    def watched(found, *rest):
        once.append(found)
        return draw(found, *rest)

    monkeypatch.setattr(mending, "_drawn_from_hull", watched)
    again = mended(rough, mask_distances(rough.alpha), ROUGH).photos.alpha
    left = 1 - agreement(once[0].photos.alpha, photos.alpha)
    assert 1 - agreement(again, photos.alpha) < 0.8 * left
    assert draw(once[0], 0.01, ROUGH) is once[0]  # a hundredth of a pixel


@pytest.mark.parametrize(("lacking", "votes"), [((), 1), ((5,), ROUGH.votes)])
def test_edges_that_move_for_nothing_go_back(photos, caplog, monkeypatch, lacking, votes):
    """Where pictures are shifted, masks are right as they are, and cameras or lenses wrong. One
    view carves, unless another lacks a part."""
    shifts = [round(3 * math.sin(2.4 * view)) for view in range(VIEWS)]
    alpha, color = (
        torch.stack([x.roll(shift, 1) for x, shift in zip(of_all, shifts, strict=True)])
        for of_all in (photos.alpha, photos.color)
    )
    shifted = without_a_part(replace(photos, alpha=alpha, color=color), lacking)
    monkeypatch.setattr(belief, "ROUGH_PIXELS", 4.0)
    with caplog.at_level("INFO", "univoxel"):
        found = mended(shifted, mask_distances(shifted.alpha), ROUGH)
    assert torch.equal(found.photos.alpha, shifted.alpha)
    assert found.doubted.any() == bool(lacking)
    assert found.belief.votes == votes
    assert "edges of masks stay" in caplog.text


def test_edges_move_as_far_as_the_rest_contradicts_itself(photos, monkeypatch):
    """Not as far as the worst masks do, which are doubted."""
    reaches, draw = [], mending.drawn_again

    def watched(photos, distance, reach, *rest):
        reaches.append(reach)
        return draw(photos, distance, reach, *rest)

    monkeypatch.setattr(mending, "drawn_again", watched)
    rough = wavering(photos, 1.5)
    distance = mask_distances(rough.alpha)
    first = mending._doubted_again(
        rough,
        distance,
        mending.doubted_pixels(distance, rough.cameras, ROUGH),
        ROUGH,
    )
    mended(rough, distance, replace(ROUGH, off=50.0))
    wanted = max(mending.FURTHER * first.belief.off, mending.LEAST)
    assert reaches == [wanted, wanted]
    assert wanted < 10


def test_what_was_doubted_stays_so(photos):
    """Edges that are drawn once more tell nothing of parts that a mask lacks."""
    rough = wavering(photos, 1.5)
    distance = mask_distances(rough.alpha)
    doubted = torch.zeros(rough.alpha.shape, dtype=torch.bool)
    doubted[3, 20:30, 20:30] = True
    found = mending.Mended(rough, doubted, distance, ROUGH)
    assert mending._drawn_from_hull(found, 2.0, ROUGH).doubted[doubted].all()


def test_photographs_of_the_object_alone_keep_their_masks():
    """What is cut away tells no colours: a hull's silhouette would claim what is not there."""
    cut = wavering(photos_of(VIEWS, SIZE), 1.5)
    cut = replace(cut, color=cut.color * (cut.alpha[..., None] > 0))
    found = mended(cut, mask_distances(cut.alpha), ROUGH)
    assert torch.equal(found.photos.alpha, cut.alpha)


def test_masks_that_were_mended_no_longer_end_where_they_were_given_to(
    photos, tmp_path, monkeypatch
):
    cfg = replace(preset("draft", tmp_path / "mug", tmp_path), cameras="given")
    assert prepare.find_silhouettes(photos, cfg).edges_given
    monkeypatch.setattr(prepare, "weighed", lambda *_: ROUGH)
    assert not prepare.find_silhouettes(photos, cfg).edges_given


def test_masks_that_share_no_volume_once_mended_are_named(photos, tmp_path, monkeypatch):
    def fails(*_):
        raise UserError("the silhouettes share no volume")

    monkeypatch.setattr(prepare, "weighed", lambda *_: ROUGH)
    monkeypatch.setattr(prepare, "mended", fails)
    cfg = replace(preset("draft", tmp_path / "mug", tmp_path), cameras="given")
    with pytest.raises(DataError, match="mug: the silhouettes share no volume"):
        prepare.find_silhouettes(photos, cfg)
