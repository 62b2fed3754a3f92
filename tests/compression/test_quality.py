"""What is lost, and the search for the last candidate that loses little."""

import pytest
from spare_scene import feature_scene, reference_of_two_views

from univoxel.compression.quality import last_within_limit


@pytest.mark.parametrize("wanted", range(6))
def test_the_last_that_costs_no_more_than_the_limit(wanted):
    candidates = [9, 7, 5, 4, 2, 1]
    seen = []

    def cost(x):
        seen.append(x)
        return 0.01 if x >= candidates[wanted] else 0.03

    assert last_within_limit(candidates, cost, 0.02) == candidates[wanted]
    assert 9 not in seen
    assert len(seen) <= 3


def test_moved_materials_are_a_cost():
    held_out, _ = reference_of_two_views()
    before = held_out.decoded(feature_scene())
    moved = before._replace(material=before.material + 0.1)
    assert held_out.loss_db(before, before) == 0
    assert held_out.loss_db(before, moved) > 0.02
