"""The training loop's losses, and the sharpness that it ends with."""

import math
from dataclasses import fields
from types import SimpleNamespace

import pytest
import torch

from univoxel.lights.base import Regularisation
from univoxel.training import loop
from univoxel.training.config import LossConfig
from univoxel.training.loop import weighted


def test_every_term_of_a_light_has_its_own_weight():
    names = [f.name for f in fields(Regularisation)]
    weight = LossConfig(**{name: float(2 + i) for i, name in enumerate(names)})
    prior = Regularisation(**{name: torch.tensor(10.0) for name in names})
    assert weighted(prior, weight) == {name: 10.0 * (2 + i) for i, name in enumerate(names)}
    assert weighted(Regularisation(white_light=torch.tensor(1.0)), weight).keys() == {"white_light"}


@pytest.mark.parametrize("best", [0.7, 1.0, 1.4])
def test_the_density_ends_as_sharp_as_held_out_pixels_want_it(monkeypatch, best):
    scene, asked = SimpleNamespace(inv_s=10.0), []

    def quality(scene, photos, pixels, physical):
        assert physical
        asked.append(scene.inv_s)
        return -abs(math.log(scene.inv_s / (10.0 * best)))

    monkeypatch.setattr(loop, "held_out_psnr", quality)
    loop.fit_sharpness_(scene, SimpleNamespace(photos=None, held_out=None))
    assert scene.inv_s == pytest.approx(10.0 * best)
    assert min(asked) < 10 < max(asked)
