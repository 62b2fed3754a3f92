"""Objects found where there are no masks: a sphere in a room."""

import numpy as np
import pytest
import torch
from analytic import photograph
from sphere_in_room import VIEWS, overlap, photographs, short

from univoxel.errors import NothingFound
from univoxel.segmentation import separation
from univoxel.segmentation.config import SegmentationConfig
from univoxel.segmentation.distances import surroundings


def test_a_sphere_is_told_from_what_is_behind(tmp_path):
    photos = photographs(tmp_path, room=4.0)
    true = torch.stack([photograph(photos.cameras, v)[1] for v in range(VIEWS)])

    def masks(scene):
        return torch.stack([separation.mask(scene, photos, v) for v in range(VIEWS)])

    torch.manual_seed(0)
    box, seen = (torch.tensor([-0.9, -0.6, -0.7]), torch.tensor([0.6, 0.9, 0.8])), []
    found = separation.find_object(photos, *box, seen.append, short(300))
    # Balls in the middle of that box have 0.5 and 0.6
    assert overlap(masks(found), true) > 0.85
    assert len(seen) == 2 * 300 + 60
    assert np.mean(seen[-20:]) > np.mean(seen[:20]) + 3


def test_a_start_that_vanishes_is_none(tmp_path, monkeypatch):
    """The others count; where all vanish, nothing was found."""
    photos, asked = photographs(tmp_path), []
    box = surroundings(photos.cameras)

    def separate_(parts, *_):
        asked.append(parts)
        if len(asked) < 2 or len(asked) > 3:
            raise NothingFound
        return 20.0

    monkeypatch.setattr(separation, "separate_", separate_)
    separation.find_object(photos, *box, lambda _: None, short(20))
    assert len(asked) == 3
    with pytest.raises(ValueError, match=r"no object was found .* box"):
        separation.find_object(photos, *box, lambda _: None, short(20))


@pytest.mark.parametrize("quality", [(30.0, 20.0), (20.0, 30.0)])
def test_the_start_that_draws_the_photographs_better_is_kept(tmp_path, monkeypatch, quality):
    photos, left = photographs(tmp_path), [*quality, 25.0]
    monkeypatch.setattr(separation, "separate_", lambda *_: left.pop(0))
    lower, upper = surroundings(photos.cameras)
    found = separation.find_object(photos, lower, upper, lambda _: None, short(20))
    radius = found.field.isosurface()[0].norm(dim=1).mean()  # nothing was fitted: a ball is left
    kept = SegmentationConfig().radii[quality.index(30.0)] * float(upper[0] - lower[0]) / 2
    assert radius == pytest.approx(kept, rel=0.05)  # of the two, which differ by 0.3


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("radii", ()),
        ("radii", (1.5,)),
    ],
)
def test_fields_out_of_range(field, value):
    with pytest.raises(ValueError, match=f"SegmentationConfig: {field} must be"):
        SegmentationConfig(**{field: value})
