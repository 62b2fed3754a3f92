"""Small networks: their op, the builder of layers and first weights, tables of directions."""

import pytest
import torch
from op_cases import CASES, doubled, flat, fresh, function, unit
from torch import nn
from torch.nn.functional import normalize

from univoxel.ops import use_backend
from univoxel.ops.networks import FEWEST_ROWS, MLP, DirectionTable


@pytest.mark.parametrize("wanted", [["x"], ["weights"], ["biases"], []])
def test_gradients_of_some_arguments(wanted):
    given, _ = fresh("mlp", doubled(CASES["mlp"](6)))
    for name in given.keys() - {*wanted}:
        value = given[name]
        given[name] = [t.detach() for t in value] if isinstance(value, list) else value.detach()
    out = function("mlp")(**given)
    assert out.requires_grad == bool(wanted)
    leaves = flat([given[name] for name in wanted])
    if leaves:
        found = torch.autograd.grad(out.square().sum(), leaves)
        with use_backend("reference"):
            out = function("mlp")(**given)
            torch.testing.assert_close(found, torch.autograd.grad(out.square().sum(), leaves))


def test_layers_end_linear():
    net = MLP([5, 7, 7, 2])
    assert [type(layer) for layer in net] == [nn.Linear, nn.ReLU, nn.Linear, nn.ReLU, nn.Linear]
    assert [(x.in_features, x.out_features) for x in net.linear] == [(5, 7), (7, 7), (7, 2)]
    assert net(torch.randn(3, 5)).shape == (3, 2)


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


@pytest.mark.parametrize("levels", [0, 1, 5])
def test_a_table_of_directions_is_zero_at_first(levels):
    table = DirectionTable(levels)
    assert table.levels == levels
    found = table(unit(9))
    assert found.shape == (9, table.channels) == (9, 2 * levels)
    assert not found.any()


@pytest.mark.parametrize("level", range(6))
def test_directions_meet_no_more_rows_than_a_table_says(level):
    table = DirectionTable(level + 1)
    table(unit(100_000)).sum().backward()
    met = table.table.grad.view(level + 1, -1, 2)[level].any(1).sum()
    most = table.rows_used(level)
    # the lattice has 5^3 nodes, 9^3, ...; most lie off the sphere, until nodes share rows
    assert 0.1 * most < met <= most


def test_a_table_learns_a_lamp_that_a_network_alone_blurs():
    """A lamp of 4 degrees on black: from the direction alone a network makes a glow of it."""

    def error(levels):
        torch.manual_seed(0)
        table = DirectionTable(levels)
        net = MLP([3 + table.channels, 32, 32, 1])
        lamp = normalize(torch.tensor([0.3, -0.5, 0.8]), dim=0)
        optimizer = torch.optim.Adam([*table.parameters(), *net.parameters()], lr=1e-2)
        for k in range(150):
            way = unit(2048, seed=k)
            way[:512] = normalize(lamp + 0.3 * way[:512], dim=1)  # look at it more often
            wanted = (way @ lamp > 0.9976).float()
            miss = (net(torch.cat([way, table(way)], 1))[:, 0] - wanted).square().mean()
            optimizer.zero_grad()
            miss.backward()
            optimizer.step()
        return miss.item()

    assert error(5) < 0.3 * error(0)  # 0.11 here


def test_a_direction_feels_the_coarsest_levels_alone():
    table, way = DirectionTable(5), unit(50).requires_grad_()
    fine = table.felt * table.rows
    with torch.no_grad():
        table.table[fine:].normal_()
    table(way).sum().backward()
    assert not way.grad.any()
    assert table.table.grad.view(5, -1, 2).any(2).any(1).all()  # all levels learn
    with torch.no_grad():
        table.table[:fine].normal_()
    table(way).sum().backward()
    assert way.grad.any(1).all()
