"""The builder of small networks: layers, first weights, the op behind it."""

import pytest
import torch
from torch import nn

from univoxel.networks import FEWEST_ROWS, MLP
from univoxel.ops import use_backend


def test_layers_end_linear():
    net = MLP([5, 7, 7, 2])
    assert [type(layer) for layer in net] == [nn.Linear, nn.ReLU, nn.Linear, nn.ReLU, nn.Linear]
    assert [(x.in_features, x.out_features) for x in net.linear] == [(5, 7), (7, 7), (7, 2)]
    assert net(torch.randn(3, 5)).shape == (3, 2)


def test_one_layer_is_linear():
    net, x = MLP([3, 2]), torch.randn(4, 3)
    torch.testing.assert_close(net(x), net.linear[0](x))


@pytest.mark.parametrize("rows", [0, 50, FEWEST_ROWS])
@pytest.mark.parametrize("backend", ["auto", "reference"])
def test_equals_its_layers_one_by_one(backend, rows):
    net, x = MLP([6, 9, 9, 4]), torch.randn(rows, 6)
    wanted = x
    for layer in net:
        wanted = layer(wanted)
    with use_backend(backend):
        torch.testing.assert_close(net(x), wanted)


def test_a_generator_draws_the_first_weights():
    def draw(seed):
        return MLP([4, 300, 2], torch.Generator().manual_seed(seed))

    a, b, c = draw(0), draw(0), draw(1)
    for p, q in zip(a.parameters(), b.parameters(), strict=True):
        assert torch.equal(p, q)
    assert not torch.equal(a.linear[0].weight, c.linear[0].weight)
    for layer in a.linear:
        assert not layer.bias.any()
        # He et al. 2015, uniform: within sqrt(6 / inputs)
        bound = (6 / layer.in_features) ** 0.5
        assert 0.9 * bound < layer.weight.abs().max() <= bound
