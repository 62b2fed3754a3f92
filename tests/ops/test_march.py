"""Marching: native against reference, and against what geometry says."""

import pytest
import torch
from bricks import cut

from univoxel.ops import brick_minimum, march, march_reference, use_backend


def sphere(n=24, radius=0.6, dtype=torch.float64):
    """SDF of a sphere on the grid over [-1, 1]^3, and its voxel size."""
    x = torch.linspace(-1, 1, n, dtype=dtype)
    grid = torch.stack(torch.meshgrid(x, x, x, indexing="ij"), -1)
    return grid.norm(dim=-1) - radius, 2 / (n - 1)


def random_rays(n, dtype=torch.float64, seed=0):
    g = torch.Generator().manual_seed(seed)
    origin = 2.5 * torch.nn.functional.normalize(torch.randn(n, 3, generator=g, dtype=dtype), dim=1)
    target = torch.rand(n, 3, generator=g, dtype=dtype) * 1.6 - 0.8
    direction = torch.nn.functional.normalize(target - origin, dim=1)
    return origin, direction, torch.rand(n, generator=g, dtype=dtype)


def marched(sdf, voxel, rays, inv_s, **options):
    least, place = brick_minimum(sdf), ((-1.0,) * 3, voxel)
    return march(sdf, least, *rays, *place, step=voxel, inv_s=inv_s, **options)


@pytest.mark.parametrize("inv_s", [10.0, 60.0])
def test_native_equals_reference(inv_s):
    sdf, voxel = sphere()
    rays = random_rays(500)
    # Skipping leaves out transmittance above sigmoid(8), so weights at the threshold may differ.
    # A threshold that no section is near to makes the comparison exact.
    options = {"inv_s": inv_s, "min_weight": 1e-3}
    got = marched(sdf, voxel, rays, **options)
    want = march_reference(sdf, *rays, (-1.0,) * 3, voxel, step=voxel, **options)
    assert torch.equal(got.offsets, want.offsets)
    torch.testing.assert_close(got.t, want.t)
    assert torch.equal(got.connected, want.connected)


@pytest.mark.parametrize("size", [41, 48])
def test_a_sparse_grid_is_marched_as_the_dense_one(size):
    sdf, voxel = sphere(size)
    dense, pool, bricks = cut(sdf, far=4 * voxel)
    assert (bricks.table == 0).any()
    assert (bricks.table == 1).any()
    rays, place = random_rays(500), ((-1.0,) * 3, voxel)
    options = {"step": voxel, "inv_s": 2.1 / voxel, "min_weight": 1e-3}  # 8 s below 4 voxels
    want = march(dense, brick_minimum(dense), *rays, *place, **options)
    for backend in ("native", "reference"):
        with use_backend(backend):
            least = brick_minimum(pool, bricks)
            got = march(pool, least, *rays, *place, **options, bricks=bricks)
        assert torch.equal(got.offsets, want.offsets)
        torch.testing.assert_close(got.t, want.t)
        assert torch.equal(got.connected, want.connected)
    assert got.offsets[-1] > 500


def test_brick_minimum_of_a_sparse_grid():
    dense, pool, bricks = cut(sphere(22, dtype=torch.float32)[0], far=0.3)
    least = brick_minimum(pool, bricks)
    with use_backend("reference"):
        assert torch.equal(brick_minimum(pool, bricks), least)
    whole, table = brick_minimum(dense), bricks.table
    assert whole.shape == table.shape
    assert torch.equal(least[table[table >= 2].long()], whole[table >= 2])
    assert least[[0, 1, -1]].tolist() == [torch.inf, -torch.inf, torch.inf]
    # Of another grid
    _, pool, bricks = cut(sphere(8)[0], far=0.3)
    with pytest.raises(ValueError, match="brick_minimum: sdf must be"):
        brick_minimum(pool[:64], bricks)
    rays, least = random_rays(3), brick_minimum(pool, bricks)
    options = {"step": 0.1, "inv_s": 10.0}
    with pytest.raises(ValueError, match="march: brick_min must be"):
        march(pool, least[1:], *rays, (-1.0,) * 3, 0.1, **options, bricks=bricks)


def test_samples_stand_around_the_surface():
    sdf, voxel = sphere(48)
    origin, direction, jitter = random_rays(200)
    samples = marched(sdf, voxel, (origin, direction, jitter), inv_s=4 / voxel)
    # Distance along the ray to the analytic sphere
    b = (origin * direction).sum(1)
    disc = b**2 - (origin.square().sum(1) - 0.36)
    hits = disc > 0.01
    counts = samples.offsets.diff()
    assert (counts[hits] >= 2).all()
    assert (counts[disc < -0.3] == 0).all()
    first = samples.t[samples.offsets[:-1][hits]]
    # the first sample lies before the surface, by no more than the 8 s of the band and one step
    gap = (-b[hits] - disc[hits].sqrt()) - first
    assert (gap > -voxel).all()
    assert (gap < 24 * voxel).all()


def test_last_sample_of_a_ray_starts_no_section():
    sdf, voxel = sphere()
    s = marched(sdf, voxel, random_rays(100), inv_s=30.0)
    ends = s.offsets[1:][s.offsets.diff() > 0] - 1
    assert not s.connected[ends].any()
    gaps = s.t.diff()[s.connected[:-1]]
    torch.testing.assert_close(gaps, torch.full_like(gaps, voxel))


def test_rays_that_miss_or_are_not_numbers_have_no_samples():
    sdf, voxel = sphere(dtype=torch.float32)
    origin = torch.tensor([[5.0, 5.0, 5.0], [0.0, 0.0, 3.0], [float("nan"), 0.1, 0.0]])
    direction = torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, 1.0], [0.6, 0.0, 0.8]])
    s = marched(sdf, voxel, (origin, direction, torch.zeros(3)), inv_s=30.0)
    assert s.offsets.tolist() == [0, 0, 0, 0]
