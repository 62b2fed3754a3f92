"""Values at the edge of float32: finite where the reference in float64 is, and NaN stays at home.

Every op must survive any numbers of any size. What a float64 run of the reference finds within the
reach of float32 must come out finite; a NaN may only touch the ray, point or row that it came with.
"""

import math

import pytest
import torch
from extremes import WILD, channels, check_finite, few, pick, run, same, seeds
from hypothesis import given
from hypothesis import strategies as st

from univoxel import ops
from univoxel.ops import native

pytestmark = pytest.mark.skipif(native.core is None, reason="without the extension")


# --- composite


def packed_rays(seed, counts, n_channels):
    g = torch.Generator().manual_seed(seed)
    offsets = torch.tensor([0, *counts]).cumsum(0)
    m = int(offsets[-1])
    alpha = pick(g, (0.0, 1.0, 1e-45, 1e-8, 1 - 6e-8, 0.5), m).abs().clamp(0, 1)
    value = pick(g, WILD, m, n_channels)
    return alpha.requires_grad_(), value.requires_grad_(), offsets


counts = st.lists(st.integers(0, 6), max_size=5)


@few
@given(seeds, counts, channels, st.sampled_from([0.0, 1e-3, 1.0]))
def test_composite_is_finite(seed, counts, n_channels, early_stop):
    arguments = (*packed_rays(seed, counts, n_channels), early_stop)
    check_finite(ops.composite, ops.composite_reference, arguments)


@few
@given(seeds, channels, st.integers(0, 2), st.booleans())
def test_composite_keeps_nan_in_its_ray(seed, n_channels, sample, in_alpha):
    alpha, value, offsets = packed_rays(seed, [2, 0, 3, 2], n_channels)
    before = run(ops.composite, (alpha, value, offsets))
    with torch.no_grad():
        (alpha if in_alpha else value)[2 + sample] = math.nan  # of the third ray
    after = run(ops.composite, (alpha, value, offsets))
    others = torch.tensor([0, 1, 5, 6])
    assert same(before[0][[0, 1, 3]], after[0][[0, 1, 3]])
    for a, b in zip(before[1:], after[1:], strict=True):
        assert same(a[others], b[others])


# --- sample_dense


def lattice(seed, shape, n_channels, n_points):
    g = torch.Generator().manual_seed(seed)
    sdf, features = pick(g, WILD, *shape), pick(g, WILD, *shape, n_channels)
    points = pick(g, (*WILD, math.inf, -math.inf, 2.0, 3.0), n_points, 3)
    return sdf.requires_grad_(), features.requires_grad_(), points.requires_grad_()


@few
@given(seeds, st.tuples(*[st.integers(1, 11)] * 3), channels, st.integers(0, 40), st.booleans())
def test_sample_dense_is_finite(seed, shape, n_channels, n_points, sparse):
    sdf, features, points = lattice(seed, shape, n_channels, n_points)
    place = ((-0.5, 0.0, 1e-3), 1.0)

    def op(*arguments):
        return ops.sample_dense(*arguments, *place, sparse_grad=sparse)

    def reference(*arguments):
        return ops.sample_dense_reference(*arguments, *place)

    check_finite(op, reference, (sdf, features, points))


@few
@given(seeds, st.integers(0, 30), st.integers(1, 4), st.booleans())
def test_encode_hash_is_finite(seed, n_points, n_features, sparse):
    g = torch.Generator().manual_seed(seed)
    table = pick(g, WILD, 2 * 32, n_features).requires_grad_()
    points = pick(g, (*WILD, math.inf, -math.inf, 2.0, 3.0), n_points, 3).requires_grad_()
    place = ((-0.5, 0.0, 1e-3), (2.5, 3.0, 3.0), (1.0, 0.3))

    def op(*arguments):
        return ops.encode_hash(*arguments, *place, sparse_grad=sparse)

    def reference(*arguments):
        return ops.encode_hash_reference(*arguments, *place)

    check_finite(op, reference, (table, points))


@few
@given(seeds, st.integers(0, 29), st.integers(0, 2), st.booleans())
def test_sample_dense_keeps_nan_at_its_point(seed, lost, axis, sparse):
    def op(sdf, features, points):
        return ops.sample_dense(sdf, features, points, (0.0, 0.0, 0.0), 1.0, sparse_grad=sparse)

    sdf, features, points = lattice(seed, (9, 3, 12), 3, 30)
    kept = torch.arange(30) != lost
    without = run(op, (sdf, features, points.detach()[kept].requires_grad_()))
    with torch.no_grad():
        points[lost, axis] = math.nan
    found = run(op, (sdf, features, points))
    for i in (0, 1, 2, 5):  # value, gradient, feature, gradient to the points
        assert same(found[i][kept], without[i])
    assert found[0][lost].isnan()
    # Its gradient reaches no node: the grid's are what the other points alone give.
    assert same(found[3], without[3])
    assert same(found[4], without[4])


@few
@given(seeds, st.booleans())
def test_sample_dense_keeps_a_nan_gradient_near_its_point(seed, sparse):
    g = torch.Generator().manual_seed(seed)
    sdf = torch.randn(9, 3, 12, generator=g).requires_grad_()
    features = torch.randn(9, 3, 12, 2, generator=g).requires_grad_()
    points = torch.rand(30, 3, generator=g) * torch.tensor([8.0, 2.0, 11.0])
    value, _, feature = ops.sample_dense(
        sdf, features, points, (0.0, 0.0, 0.0), 1.0, sparse_grad=sparse
    )
    (value[0] * math.nan + value.sum() + feature[0, 0] * math.nan + feature.sum()).backward()
    node = torch.cartesian_prod(*[torch.arange(n) for n in sdf.shape])
    far = ((node - points[0]).abs() >= 2).any(1)  # value and slope reach less than two nodes
    for leaf in (sdf, features):
        grad = leaf.grad.to_dense() if sparse else leaf.grad
        assert grad.flatten(0, 2)[far].isfinite().all()


# --- march


def rays_and_ball(seed, n):
    g = torch.Generator().manual_seed(seed)
    axes = [torch.arange(float(s)) for s in (14, 9, 11)]
    x, y, z = torch.meshgrid(*axes, indexing="ij")
    sdf = ((x - 6.5) ** 2 + (y - 4) ** 2 + (z - 5) ** 2).sqrt() - 3
    origin = pick(g, (*WILD, math.inf, math.nan, 4.0), n, 3)
    direction = torch.nn.functional.normalize(torch.randn(n, 3, generator=g), dim=1)
    odd = pick(g, (*WILD, math.inf, math.nan), n, 3)
    direction = torch.where(torch.rand(n, 1, generator=g) < 0.3, odd, direction)
    jitter = torch.rand(n, generator=g)
    return sdf, origin, direction, jitter


def march(sdf, origin, direction, jitter, **more):
    options = {"step": 0.5, "inv_s": 2.0} | more
    least = ops.brick_minimum(sdf)
    return ops.march(sdf, least, origin, direction, jitter, (0.0, 0.0, 0.0), 1.0, **options)


@few
@given(seeds, st.integers(0, 60), st.sampled_from([1e-30, 1e-3, 2.0, 1e6, 1e30]))
def test_march_survives(seed, n, inv_s):
    samples = march(*rays_and_ball(seed, n), inv_s=inv_s)
    assert samples.t.isfinite().all()
    assert (samples.t >= 0).all()
    assert samples.offsets[0] == 0
    assert (samples.offsets.diff() >= 0).all()
    assert samples.offsets[-1] == len(samples.t) == len(samples.connected)


def test_march_refuses_rays_that_never_arrive():
    sdf, *_ = rays_and_ball(0, 1)
    origin = torch.tensor([[-1.0, 4.0, 5.0]]).expand(5, 3)
    length = torch.tensor([1.0, 1e-12, 0.0, 1e-30, 1.0])
    direction = length[:, None] * torch.tensor([1.0, 0.0, 0.0])
    samples = march(sdf, origin, direction, torch.zeros(5))
    counts = samples.offsets.diff()
    assert counts[0] == counts[4] > 0
    assert counts[1:4].tolist() == [0, 0, 0]


@few
@given(seeds, st.integers(0, 3))
def test_march_keeps_nan_in_its_ray(seed, argument):
    sdf, origin, direction, jitter = rays_and_ball(seed, 20)
    before = march(sdf, origin, direction, jitter)
    for tensor in (origin, direction, jitter)[: 1 + argument % 3]:
        tensor[7] = math.nan
    after = march(sdf, origin, direction, jitter)
    counts = after.offsets.diff()
    assert counts[7] == 0
    kept = torch.repeat_interleave(before.offsets.diff()) != 7
    assert torch.equal(before.t[kept], after.t)
    assert torch.equal(before.connected[kept], after.connected)


def test_march_takes_rays_past_a_nan_node_as_before():
    sdf, *_ = rays_and_ball(0, 1)
    y, z = torch.meshgrid(torch.arange(8) + 0.5, torch.arange(10) + 0.5, indexing="ij")
    origin = torch.stack([torch.full_like(y, -1.0), y, z], -1).reshape(-1, 3)
    direction = torch.tensor([1.0, 0.0, 0.0]).expand(80, 3)
    jitter = torch.zeros(80)
    before = march(sdf, origin, direction, jitter)
    sdf[4, 4, 5] = math.nan
    after = march(sdf, origin, direction, jitter)
    near = ((origin[:, 1:] - torch.tensor([4.0, 5.0])).abs() < 1).all(1)

    def far(samples):
        return samples.t[~near[torch.repeat_interleave(samples.offsets.diff())]]

    assert near.sum() == 4
    assert torch.equal(far(before), far(after))


# --- smooth_rows_, adam_rows_


@few
@given(seeds, st.tuples(*[st.integers(1, 9)] * 3), channels, st.sampled_from([1, 2]))
def test_smooth_rows_is_finite(seed, shape, n_channels, order):
    g = torch.Generator().manual_seed(seed)
    grid = pick(g, WILD, *shape, n_channels)
    rows = torch.randperm(math.prod(shape), generator=g)[: int(torch.randint(99, (), generator=g))]
    assert ops.smooth_rows_(grid.clone(), rows, 0.5, order).isfinite().all()
    holed = grid.clone()
    holed[0, 0, 0] = math.nan
    got = ops.smooth_rows_(holed, rows, 0.5, order)
    node = torch.cartesian_prod(*[torch.arange(n) for n in shape]).sum(1)
    want = ops.smooth_rows_(grid.clone(), rows, 0.5, order)
    far = node > order  # in steps from the hole
    assert same(got.flatten(0, 2)[far], want.flatten(0, 2)[far])


@few
@given(seeds, st.integers(1, 9), channels, st.sampled_from([0.0, 1e-12, 1.0]))
def test_adam_rows_keeps_nan_in_its_row(seed, n, n_channels, eps):
    # Squares of gradients above 1.8e19 leave float32, here as in torch.optim.Adam.
    g = torch.Generator().manual_seed(seed)
    values = (0.0, 1e-45, 1e-30, 1.0, 1e18)
    state = [pick(g, values, 12, n_channels), pick(g, values, 12, n_channels)]
    state.append(pick(g, (0.0, 1e-45, 1.0, 1e36), 12, n_channels).abs())
    rows = torch.randperm(12, generator=g)[:n]
    grad = pick(g, values, n, n_channels)

    def step(grad):
        now = [t.clone() for t in state]
        ops.adam_rows_(*now, rows, grad, 0.1, 0.9, 0.99, eps, 3)
        return now

    clean = step(grad)
    wanted = [t.double() for t in state]
    ops.adam_rows_reference_(*wanted, rows, grad.double(), 0.1, 0.9, 0.99, eps, 3)
    if eps:  # without it a row that never met a gradient is 0 / 0
        for got, want in zip(clean, wanted, strict=True):
            assert (got.isfinite() | ~want.isfinite()).all()
    grad[0] = math.nan
    others = torch.arange(12) != rows[0]
    for a, b in zip(clean, step(grad), strict=True):
        assert same(a[others], b[others])


# --- mlp


def network(seed, n, *sizes, values=WILD):
    g = torch.Generator().manual_seed(seed)
    layers = list(zip(sizes[1:], sizes[:-1], strict=True))
    tensors = [pick(g, values, n, sizes[0])]
    tensors += [pick(g, values, o, i) for o, i in layers] + [pick(g, values, o) for o, _ in layers]
    return [t.requires_grad_() for t in tensors]


def flat(op):
    return lambda x, *layers: op(x, layers[: len(layers) // 2], layers[len(layers) // 2 :])


sizes = st.lists(st.integers(1, 40), min_size=2, max_size=4)


@few
@given(seeds, st.integers(0, 20), sizes)
def test_mlp_is_finite(seed, n, sizes):
    # Sums on the way to a small result may leave float32, here as in torch: nothing above 1e7.
    values = (0.0, -0.0, 1e-45, -1e-40, 1.2e-38, 1e-7, 1.0, -1.0, 1e4, -1e7)
    arguments = network(seed, n, *sizes, values=values)
    check_finite(flat(ops.mlp), flat(ops.mlp_reference), arguments)


@few
@given(seeds, st.integers(0, 14), sizes)
def test_mlp_keeps_nan_in_its_row(seed, row, sizes):
    arguments = network(seed, 15, *sizes)
    before = run(flat(ops.mlp), arguments)
    with torch.no_grad():
        arguments[0][row, 0] = math.nan
    after = run(flat(ops.mlp), arguments)
    others = torch.arange(15) != row
    for a, b in zip(before[:2], after[:2], strict=True):  # value, gradient to x
        assert same(a[others], b[others])
    assert after[0][row].isnan().any()


# --- visibility


@pytest.mark.skipif(
    native.core is None or not native.core.embree_version(), reason="built without Embree"
)
@few
@given(seeds, st.integers(0, 40))
def test_rays_at_the_edge_meet_what_they_should(seed, n):
    g = torch.Generator().manual_seed(seed)
    vertices = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1e-40, 0, 0], [1e15, 0, 0]])
    faces = torch.tensor([[0, 1, 2], [0, 0, 0], [0, 3, 1], [0, 4, 1]])  # three without area
    scene = ops.VisibilityScene(vertices, faces)
    values = (*WILD, math.inf, -math.inf, math.nan)
    origin, direction = pick(g, values, n + 1, 3), pick(g, values, n + 1, 3)
    origin[n], direction[n] = torch.tensor([0.2, 0.2, 1.0]), torch.tensor([0.0, 0.0, -1.0])
    hit = scene.closest_hit(origin, direction)
    assert not hit.t.isnan().any()
    assert ((hit.face >= -1) & (hit.face < 4)).all()
    assert scene.occluded(origin, direction).shape == (n + 1,)
    assert hit.face[n] == 0
    # Rounding: where there is no AVX-512, Embree divides by a refined estimate
    torch.testing.assert_close(hit.t[n], torch.tensor(1.0))


# --- strides
