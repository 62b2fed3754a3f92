"""Short trainings of the bundled scene end in the pictures that they should."""

import json

import net
import pytest

# Rounding that differs grows in training. Builds of the extension and instruction sets of torch
# make pictures that are 31 dB and more apart; a training whose light or materials are broken falls
# below this.
ALIKE_DB = 25.0


@pytest.mark.parametrize("name", net.CASES)
def test_training_ends_in_the_held_pictures(name, tmp_path):
    held, found = json.loads(net.HELD.read_text())[name], net.made(name, tmp_path)["pictures"]
    for of, copy in found.items():
        assert net.distance_db(copy, held[of]) > ALIKE_DB, of


def test_a_picture_that_differs_is_seen():
    assert net.distance_db("00ff", "00ff") == 90
    assert net.distance_db("00ff", "0f0f") < ALIKE_DB
