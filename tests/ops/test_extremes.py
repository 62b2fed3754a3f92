"""Values at the edge of float32: finite where the reference in float64 is, and NaN stays at home.

Every op must survive any numbers of any size. What a float64 run of the reference finds within the
reach of float32 must come out finite; a NaN may only touch the ray, point or row that it came with.
"""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from op_cases import CASES, LEAVES, doubled, flat, fresh, function

from univoxel import ops
from univoxel.core.records import Mesh
from univoxel.envmap import EnvMap, tables
from univoxel.ops import PointLight, Sun, VisibilityScene, native, relight

few = settings(max_examples=40, deadline=None, derandomize=True)

REACH = 1e36  # of a float32 result: sums of some tens of these stay below 3.4e38
WILD = (0.0, -0.0, 1e-45, -1e-40, 1.2e-38, 1e-7, 0.5, 1.0, -1.0, 1e4, 1e30, -1e30)
seeds = st.integers(0, 2**31)
channels = st.sampled_from([0, 1, 3, 12, 17])


def pick(generator, values, *size):
    """Numbers drawn from a list, and as many from a normal distribution."""
    values = torch.tensor(values, dtype=torch.float64)
    drawn = values[torch.randint(len(values), size, generator=generator)]
    usual = torch.randn(size, generator=generator, dtype=torch.float64)
    return torch.where(torch.rand(size, generator=generator) < 0.5, drawn, usual).float()


def same(a, b):
    """Equal numbers, NaN equal to NaN."""
    return torch.equal(torch.nan_to_num(a, 12345.0), torch.nan_to_num(b, 12345.0)) and torch.equal(
        a.isnan(), b.isnan()
    )


def unit_or_pole(generator, *shape):
    """[..., 3]: directions, poles, and what has no length or almost none."""
    odd = torch.tensor([[0.0, 0, 1], [0, 0, -1], [0, -0.0, -0.0], [1, 0, 0], [1e-20, 0, 0]])
    usual = torch.nn.functional.normalize(torch.randn(*shape, 3, generator=generator), dim=-1)
    chosen = odd[torch.randint(len(odd), shape, generator=generator)]
    return torch.where(torch.rand(*shape, 1, generator=generator) < 0.4, chosen, usual)


pytestmark = pytest.mark.skipif(native.core is None, reason="without the extension")
RAYS = pytest.mark.skipif(
    native.core is None or not native.core.embree_version(), reason="built without Embree"
)


# Numbers on and beyond the edges of what an argument may hold; others take any
SHARES = (0.0, 1.0, 1e-45, 1e-8, 1 - 6e-8, 0.03)
LIGHT = (0.0, 1e-45, 1.0, 1e6)
VALUES = {
    **dict.fromkeys(("alpha", "albedo", "roughness", "f0", "visibility"), SHARES),
    **dict.fromkeys(("amplitude", "radiance", "map", "indirect"), LIGHT),
    "sharpness": (0.0, 1e-45, 1e-3, 30.0, 1e6, 1e30),
    "rotation": (0.0, 6.2831853, -1e4),
    "points": (*WILD, math.inf, -math.inf, 2.0, 3.0),
    # Sums on the way to a small result may leave float32, here as in torch: nothing above 1e7
    **dict.fromkeys(
        ("x", "weights", "biases"), (0.0, -0.0, 1e-45, -1e-40, 1.2e-38, 1e-7, 1.0, -1.0, 1e4, -1e7)
    ),
}
FIELDS = ["sample_dense", "sample_sparse", "encode_hash"]
SHADING = [case for case in CASES if case.startswith("shade")]
ROWS = ["composite", "mlp", "decode_lobes", *SHADING]  # a row of arguments is one of results


def wild(case, n, seed):
    """The arguments of a case with wild numbers in all that lies in a range."""
    g, arguments = torch.Generator().manual_seed(seed), CASES[case](n)
    known = {*VALUES, *LEAVES[case.split()[0]].split()}

    def drawn(name, like):
        values = VALUES.get(name, WILD)
        found = pick(g, values, *like.shape)
        found = found.abs() if min(values) >= 0 else found
        return found.clamp(0, 1) if values is SHARES else found

    for name, value in arguments.items():
        if name in ("axis", "normal", "wo"):
            arguments[name] = unit_or_pole(g, *value.shape[:-1])
        elif name in known and isinstance(value, list):
            arguments[name] = [drawn(name, t) for t in value]
        elif name in known and isinstance(value, torch.Tensor):
            arguments[name] = drawn(name, value)
    if "wo" in arguments:  # the eye on the normal, or behind it
        n, wo = arguments["normal"], arguments["wo"]
        along = n * torch.tensor([1.0, -1.0])[torch.randint(2, (len(n), 1), generator=g)]
        arguments["wo"] = torch.where(torch.rand(len(n), 1, generator=g) < 0.3, along, wo)
    return arguments


def everything(case, arguments):
    """Outputs, then gradients of their sum."""
    arguments, leaves = fresh(case, arguments)
    out = [o for o in flat(function(case)(**arguments)) if o.requires_grad]
    grads = torch.autograd.grad(out, leaves, [torch.ones_like(o) for o in out])
    return [*(o.detach() for o in out), *(g.to_dense() for g in grads)]


@few
@given(seeds, st.integers(0, 6), st.booleans())
@pytest.mark.parametrize("case", [*ROWS, *FIELDS])
def test_results_are_finite_where_double_precision_has_them(case, seed, n, sparse):
    given = wild(case, n, seed) | ({"sparse_grad": sparse} if case in FIELDS else {})
    with ops.use_backend("reference"):
        wanted = everything(case, doubled(given))
    for got, want in zip(everything(case, given), wanted, strict=True):
        assert got.shape == want.shape
        lost = want.isfinite() & (want.abs() < REACH) & ~got.isfinite()
        assert not lost.any(), f"{got[lost][:4]}, in float64 {want[lost][:4]}"


@few
@given(seeds, st.integers(0, 6))
@pytest.mark.parametrize("case", ROWS)
def test_what_is_no_number_stays_in_its_row(case, seed, row):
    n = 7  # no size of what all rows share
    given = wild(case, n, seed)

    def others(tensor):
        return torch.arange(len(tensor)) // max(len(tensor) // n, 1) != row

    def of_rows(tensors):
        return [t for t in tensors if len(t) and len(t) % n == 0]

    before = of_rows(everything(case, given))
    for name in LEAVES[case.split()[0]].split():
        value = given[name]
        if not isinstance(value, torch.Tensor) or len(value) % n:
            continue
        broken = value.clone()
        broken[~others(broken)] = math.nan
        after = of_rows(everything(case, given | {name: broken}))
        assert len(before) == len(after) >= 2
        for a, b in zip(before, after, strict=True):
            assert same(a[others(a)], b[others(b)]), name


# --- sample_dense


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


# --- visibility


@RAYS
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


EDGES = (0.0, -0.0, 1e-45, 1.0)  # of what lies in [0, 1]
heights = st.sampled_from([1, 2, 5, 40])  # of a map; 40: rows of several blocks, the last not full


def wild_map(g, height):
    radiance = pick(g, (0.0, 1e-45, 1e-30, 1.0, 1e6, 1e20), height, 2 * height, 3).abs()
    dark = torch.rand(height, 2 * height, 1, generator=g) < 0.5
    return tables(
        EnvMap(radiance.masked_fill(dark, 0.0), rotation=float(pick(g, (-1e4, 359.0), 1)))
    )


def points(g, n, height, faces=6):
    """Keyword arguments of `relight`: n points, a mesh of loose triangles and a map, all wild."""
    corners = pick(g, (0.0, 1e-20, 1.0, 1e4), 3 * faces, 3)
    mesh = Mesh(
        corners,
        torch.arange(3 * faces, dtype=torch.int32).reshape(-1, 3),
        unit_or_pole(g, 3 * faces),
        pick(g, EDGES, 3 * faces, 3).clamp(0, 1),
        pick(g, EDGES, 3 * faces).clamp(0, 1),
    )
    return {
        "scene": VisibilityScene(mesh.vertices, mesh.faces),
        "mesh": mesh,
        "tables": wild_map(g, height),
        "position": pick(g, (0.0, 1e-20, 1.0, 1e4, 1e17), n, 3),
        "normal": unit_or_pole(g, n),
        "wo": unit_or_pole(g, n),
        "albedo": pick(g, EDGES, n, 3).clamp(0, 1),
        "roughness": pick(g, EDGES, n).clamp(0, 1),
        "f0": pick(g, EDGES, n, 3).clamp(0, 1),
        "mesh_f0": pick(g, EDGES, 3 * faces, 3).clamp(0, 1),
        "offset": 1e-3,
        "samples": 5,
        "bounces": 2,
        "suns": (Sun((0.3, 0, 1), (1e6, 1, 0)), Sun((0, 0, -1), (1, 1, 1), 179.0)),
        "point_lights": (
            PointLight((0, 0, 0), (1, 1e-30, 1)),
            PointLight((0, 0, 1e4), (1e6, 1, 1)),
        ),
    }


@RAYS
@few
@given(seeds, st.integers(0, 40), heights, st.sampled_from(["mis", "map", "brdf"]))
def test_light_is_finite_and_not_negative(seed, n, height, strategy):
    given = points(torch.Generator().manual_seed(seed), n, height)
    rgb = relight(**given, strategy=strategy)
    assert rgb.isfinite().all()
    assert rgb.ge(0).all()
    dead = given["normal"].square().sum(1) < 0.5
    assert rgb[dead].eq(0).all()


@RAYS
@few
@given(
    seeds,
    st.integers(0, 19),
    st.sampled_from(["position", "normal", "wo", "albedo", "roughness", "f0"]),
    st.sampled_from([math.nan, math.inf, -math.inf]),
)
def test_what_is_not_finite_stays_at_its_point(seed, point, name, value):
    given = points(torch.Generator().manual_seed(seed), 20, 5) | {"bounces": 0}
    before = relight(**given)
    broken = given[name].clone()
    broken[point] = value
    after = relight(**(given | {name: broken}))
    others = torch.arange(20) != point
    # Its neighbours move up one place in the vectors that they are computed in: other rounding.
    torch.testing.assert_close(after[others], before[others], rtol=1e-4, atol=0)
    assert after[point].eq(0).all()


@RAYS
@few
@given(seeds, st.integers(0, 3))
def test_without_triangles_there_is_nothing_to_bounce_off(seed, bounces):
    given = points(torch.Generator().manual_seed(seed), 9, 2, faces=0)
    direct, bounced = (relight(**(given | {"bounces": b, "strategy": "map"})) for b in (0, bounces))
    assert same(direct, bounced)
