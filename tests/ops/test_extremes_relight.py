"""Values at the edge of float32 in the path tracer, see test_extremes.py."""

import math

import pytest
import torch
from extremes import few, pick, same, seeds
from hypothesis import given
from hypothesis import strategies as st

from univoxel.core.records import Mesh
from univoxel.envmap import EnvMap, tables
from univoxel.ops import PointLight, Sun, VisibilityScene, native, relight

pytestmark = pytest.mark.skipif(
    native.core is None or not native.core.embree_version(), reason="without rays"
)
EDGES = (0.0, -0.0, 1e-45, 1.0)  # of what lies in [0, 1]
heights = st.sampled_from([1, 2, 5, 40])  # of a map; 40: rows of several blocks, the last not full


def unit_or_not(g, n):
    """[n, 3]: directions, poles, and what has no length."""
    v = torch.nn.functional.normalize(torch.randn(n, 3, generator=g), dim=1)
    odd = torch.tensor([[0.0, 0, 1], [0, 0, -1], [0, -0.0, 0], [1, 0, 0], [1e-20, 0, 0]])
    chosen = odd[torch.randint(len(odd), (n,), generator=g)]
    return torch.where(torch.rand(n, 1, generator=g) < 0.4, chosen, v)


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
        unit_or_not(g, 3 * faces),
        pick(g, EDGES, 3 * faces, 3).clamp(0, 1),
        pick(g, EDGES, 3 * faces).clamp(0, 1),
    )
    return {
        "scene": VisibilityScene(mesh.vertices, mesh.faces),
        "mesh": mesh,
        "tables": wild_map(g, height),
        "position": pick(g, (0.0, 1e-20, 1.0, 1e4, 1e17), n, 3),
        "normal": unit_or_not(g, n),
        "wo": unit_or_not(g, n),
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


@few
@given(seeds, st.integers(0, 40), heights, st.sampled_from(["mis", "map", "brdf"]))
def test_light_is_finite_and_not_negative(seed, n, height, strategy):
    given = points(torch.Generator().manual_seed(seed), n, height)
    rgb = relight(**given, strategy=strategy)
    assert rgb.isfinite().all()
    assert rgb.ge(0).all()
    dead = given["normal"].square().sum(1) < 0.5
    assert rgb[dead].eq(0).all()


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


@few
@given(seeds, st.integers(0, 3))
def test_without_triangles_there_is_nothing_to_bounce_off(seed, bounces):
    given = points(torch.Generator().manual_seed(seed), 9, 2, faces=0)
    direct, bounced = (relight(**(given | {"bounces": b, "strategy": "map"})) for b in (0, bounces))
    assert same(direct, bounced)
