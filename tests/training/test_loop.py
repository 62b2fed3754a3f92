"""The training loop's losses."""

from dataclasses import fields

import torch

from univoxel.lights.base import Regularisation
from univoxel.training.config import LossConfig
from univoxel.training.loop import weighted


def test_every_term_of_a_light_has_its_own_weight():
    names = [f.name for f in fields(Regularisation)]
    weight = LossConfig(**{name: float(2 + i) for i, name in enumerate(names)})
    prior = Regularisation(**{name: torch.tensor(10.0) for name in names})
    assert weighted(prior, weight) == {name: 10.0 * (2 + i) for i, name in enumerate(names)}
    assert weighted(Regularisation(white_light=torch.tensor(1.0)), weight).keys() == {"white_light"}
