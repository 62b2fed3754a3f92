"""Distances near the surface, sides beyond: what comes back."""

import pytest
import torch

from univoxel.fields.distances import pack, unpack


def two_balls():
    axis = torch.arange(24.0)
    node = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1)
    centres = torch.tensor([[7.0, 7.0, 7.0], [17.0, 16.0, 15.0]])
    return torch.stack([(node - c).norm(dim=-1) for c in centres]).amin(0) - 5.2


def test_near_the_surface_nothing_changes_and_beyond_it_the_side_stays():
    sdf = two_balls()
    packed = pack(sdf, 2.0)
    again = unpack(packed, (24, 24, 24), 4.0)
    near = sdf.abs() < 2
    assert torch.equal(again[near], sdf[near])
    assert len(packed["rows"]) == near.sum()
    assert torch.equal(again[~near], 4 * sdf[~near].sign())
    assert len(packed["side"]) == 3  # outside, and the middle of each ball


def test_a_jump_between_the_sides_is_kept():
    sdf = torch.full((6, 6, 6), 9.0)
    sdf[2:4, 2:4, 2:4] = -9.0
    again = unpack(pack(sdf, 1.0), (6, 6, 6), 4.0)
    assert torch.equal(again.sign(), sdf.sign())
    assert torch.equal(again[1:5, 2:4, 2:4], sdf[1:5, 2:4, 2:4])  # next to the jump: as it was


def test_another_grid_is_refused():
    packed = pack(two_balls(), 2.0)
    with pytest.raises(ValueError, match="expected signs for"):
        unpack(packed | {"side": packed["side"][:1]}, (24, 24, 24), 4.0)
    with pytest.raises(IndexError):
        unpack(packed, (8, 8, 8), 4.0)
