"""The decoding networks: ranges, the start of training, what each may and may not see."""

import pytest
import torch
from torch import nn

from univoxel.fields.field import MaterialHead, RadianceHead


@pytest.fixture(autouse=True)
def seed():
    torch.manual_seed(0)


def directions(n):
    return nn.functional.normalize(torch.randn(n, 3), dim=1)


@pytest.mark.parametrize("size", [1.0, 1e4])  # of the features: sigmoids saturate, ranges hold
def test_materials_stay_in_their_ranges(size):
    albedo, roughness, metallic = MaterialHead(4, 8)(size * torch.randn(200, 6))
    assert albedo.shape == (200, 3)
    assert roughness.shape == (200,)
    assert ((albedo >= 0) & (albedo <= 1)).all()
    assert ((roughness >= MaterialHead.min_roughness) & (roughness <= 1)).all()
    assert metallic.shape == (200,)
    assert ((metallic >= 0) & (metallic <= 1)).all()


def test_materials_start_mid_grey_glossy_and_no_metal():
    albedo, roughness, metallic = MaterialHead(8, 64)(torch.zeros(1, 8))
    # The last layer's weights start at a tenth: what its hidden units give is small.
    torch.testing.assert_close(albedo, torch.full((1, 3), 0.5), atol=0.05, rtol=0)
    assert 0.2 < roughness < 0.35
    assert metallic < 0.1


def test_albedo_shifts_as_a_whole():
    head, features = MaterialHead(4, 8), torch.randn(101, 6)
    before, median = head(features), torch.tensor([0.1, 0.5, 0.9])
    head.shift_albedo(features, median)
    after = head(features)
    torch.testing.assert_close(after[0].median(0).values, median)
    order = before[0].argsort(0)
    assert (after[0].gather(0, order).diff(dim=0) > -1e-6).all()
    for a, b in zip(after[1:], before[1:], strict=True):
        assert torch.equal(a, b)


def test_roughness_shifts_as_a_whole():
    head, features = MaterialHead(4, 8), torch.randn(101, 6)
    before = head(features)
    head.shift_roughness(features, 0.7)
    after = head(features)
    torch.testing.assert_close(after[1].median(), torch.tensor(0.7))
    assert (after[1][before[1].argsort()].diff() > -1e-6).all()
    assert torch.equal(after[0], before[0])
    assert torch.equal(after[2], before[2])
    known = MaterialHead(4, 8, roughness=0.4)
    known.shift_roughness(features, 0.7)
    assert (known(features)[1] == 0.4).all()


def test_materials_see_their_channels_only():
    head, features = MaterialHead(4, 8), torch.randn(10, 6)
    others = torch.cat([features[:, :4], torch.randn(10, 2)], 1)
    for a, b in zip(head(features), head(others), strict=True):
        assert torch.equal(a, b)
    features.requires_grad_()
    head(features)[0].sum().backward()
    assert features.grad[:, :4].any()
    assert not features.grad[:, 4:].any()


def test_radiance_reads_its_table_in_the_mirrored_direction():
    head, n = RadianceHead(2, 8, levels=3), 40
    features, normal, wo = torch.randn(n, 2), directions(n), directions(n)
    before = head(features, normal, wo)
    mirrored = 2 * (normal * wo).sum(1, keepdim=True) * normal - wo
    with torch.no_grad():
        head.directions.table.normal_()
        said = head.directions(mirrored)
        changed = head(features, normal, wo)
        plain = [features, normal, mirrored, (2 * mirrored).sin(), (2 * mirrored).cos()]
        cosine = (normal * wo).sum(1, keepdim=True)
        wanted = torch.sigmoid(head.net(torch.cat([*plain, cosine, said], 1)))
    torch.testing.assert_close(changed, wanted)
    assert (changed - before).abs().max() > 1e-3
