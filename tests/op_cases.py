"""Arguments that each op takes, of any number of rows, and everything that comes of a call."""

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Any

import torch
from analytic import cameras_at
from bricks import cut
from torch import Tensor
from torch.nn.functional import normalize

from univoxel import ops, sphere
from univoxel.camera import Cameras, projection_matrices
from univoxel.core.records import Mesh, Samples
from univoxel.envmap import EnvMap, tables
from univoxel.ops import native

ORIGIN, H, SHAPE = (-1.0, -1.0, -1.0), 0.25, (9, 10, 11)
# Corners and voxel sizes of a hash table of two levels
LEVELS = ((-1.0, -1.0, -1.0), (1.0, 1.25, 1.5), (0.5, 0.2))
RAYS = native.core is None or native.core.embree_version()


def uniform(*shape: int, seed: int = 0) -> Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed))


def normal(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def unit(*shape: int, seed: int = 0) -> Tensor:
    return normalize(normal(*shape, 3, seed=seed), dim=-1)


def slanted(shape: tuple[int, ...] = SHAPE) -> Tensor:
    """Distances [X, Y, Z] of a bumpy plane through the middle of the grid."""
    nodes = torch.stack(torch.meshgrid(*map(torch.arange, shape), indexing="ij"), -1).float()
    plane = (nodes - torch.tensor(shape) / 2) @ torch.tensor([0.2, 0.3, 0.9])
    return H * plane + 0.05 * normal(*shape)


def grid(
    n: int, shape: tuple[int, ...] = SHAPE, channels: int = 3, margin: float = 0.1, **more
) -> dict:
    """Points lie outside by up to a share of the grid's sides."""
    extent = H * (torch.tensor(shape) - 1)
    points = ORIGIN[0] + extent * ((1 + 2 * margin) * uniform(n, 3) - margin)
    place = {"origin": ORIGIN, "voxel_size": H}
    features = normal(*shape, channels)
    return {"sdf": slanted(shape), "features": features, "points": points, **place, **more}


def sparse_grid(n: int, shape: tuple[int, ...] = SHAPE, channels: int = 3, **more) -> dict:
    _, pool, bricks = cut(slanted(shape), far=0.3)
    change = {"sdf": pool, "features": normal(len(pool), channels), "bricks": bricks}
    return grid(n, shape, channels, **more) | change


def hash_grid(
    n: int, voxel_sizes: tuple[float, ...] = LEVELS[2], rows: int = 64, features: int = 2
) -> dict:
    place = {"lower": LEVELS[0], "upper": LEVELS[1], "voxel_sizes": voxel_sizes}
    table = normal(rows * len(voxel_sizes), features)
    return {"table": table, "points": grid(n)["points"], **place}


def field(n: int, hashed: bool = False, **more) -> dict:
    """Rays through the plane, of which one in three has no samples, and one has two runs."""
    origin = torch.cat([1.6 * uniform(n, 2) - 0.8, torch.full((n, 1), -0.9)], 1)
    direction = normalize(torch.tensor([0.0, 0.0, 1.0]) + 0.1 * normal(n, 3), dim=1)
    counts = torch.where(torch.arange(n) % 3 == 1, 0, 6 + torch.arange(n) % 4)
    offsets = torch.cat([torch.zeros(1, dtype=torch.int64), counts.cumsum(0)])
    ray = counts.repeat_interleave(counts)
    t = 0.23 * (torch.arange(len(ray)) - offsets[:-1].repeat_interleave(counts)) + 0.03
    connected = torch.ones(len(t), dtype=torch.bool)
    connected[offsets[1:][counts > 0] - 1] = False
    connected[1:2] = False
    samples = Samples(t, connected, offsets)
    rays = {"origin": origin, "direction": direction, "samples": samples}
    place = {"grid_origin": ORIGIN, "voxel_size": H, "inv_s": 6.0}
    features = {"features": normal(2 * 64, 2), "levels": LEVELS} if hashed else {}
    return {"sdf": -slanted(), "features": normal(*SHAPE, 3), **rays, **place, **features, **more}


def field_of_bricks(n: int, hashed: bool = True, min_share: float = 0.1) -> dict:
    _, pool, bricks = cut(-slanted(), far=0.8)
    change = {"sdf": pool, "bricks": bricks, "min_share": min_share}
    features = {} if hashed else {"features": normal(len(pool), 3)}
    return field(n, hashed) | change | features


def marched(n: int) -> dict:
    sdf = slanted()
    ray = {"origin": 2 * unit(n), "jitter": uniform(n)}
    ray["direction"] = normalize(0.5 * unit(n, seed=1) - ray["origin"], dim=1)
    place = {"grid_origin": ORIGIN, "voxel_size": H, "step": 0.1, "inv_s": 10.0}
    return {"sdf": sdf, "brick_min": ops.brick_minimum(sdf), **ray, **place}


def marched_bricks(n: int) -> dict:
    _, pool, bricks = cut(slanted(), far=0.8)
    least = ops.brick_minimum(pool, bricks)
    return marched(n) | {"sdf": pool, "brick_min": least, "bricks": bricks}


def composed(n: int, counts: Sequence[int] | None = None, channels: int = 5, **more) -> dict:
    counts = n * [3] if counts is None else counts
    offsets = torch.tensor([0, *counts]).cumsum(0)
    alpha, value = uniform(int(offsets[-1])), normal(int(offsets[-1]), channels)
    return {"alpha": alpha, "value": value, "offsets": offsets, **more}


def surface(n: int, smooth: float = 0.2, rough: float = 0.9, behind: bool = False) -> dict:
    """Roughness between two values; the eyes look at the surface or from behind it."""
    around, f0 = unit(n), uniform(n, 3, seed=1)
    f0[:1, 0], f0[:1, 1] = 0, 1
    wo = normalize(around + 0.8 * unit(n, seed=1), dim=1)
    return {
        "normal": around,
        "wo": -wo if behind else wo,
        "albedo": uniform(n, 3),
        "roughness": smooth + (rough - smooth) * uniform(n),
        "f0": f0,
    }


def around(directions: int) -> dict:
    solid_angle = 4 * math.pi / directions
    return {"directions": sphere.fibonacci_sphere(directions), "solid_angle": solid_angle}


def under_sg(n: int, lobes: int = 4, directions: int = 16, **of_surface) -> dict:
    light = {"axis": unit(n, lobes), "sharpness": 30 * uniform(n, lobes)}
    light["amplitude"] = uniform(n, lobes, 3)
    half = not of_surface.get("behind")  # light from below the horizon, too
    directions = (sphere.fibonacci_hemisphere if half else sphere.fibonacci_sphere)(directions)
    frame = {"directions": directions, "rotation": 6 * uniform(n)}
    return light | surface(n, **of_surface) | frame


def under_radiance(n: int, directions: int = 16, **of_surface) -> dict:
    radiance = uniform(n, directions, 3)
    return {"radiance": radiance, **surface(n, **of_surface), **around(directions)}


def under_map(n: int, directions: int = 16, stored: bool = False, **of_surface) -> dict:
    """As scenes store it: visibility in bytes, what is occluded in halves."""
    visibility, indirect = uniform(5, directions), uniform(5, directions, 3)
    if stored:
        visibility, indirect = (255 * visibility).byte(), indirect.half()
    seen = {"visibility": visibility, "indirect": indirect, "index": torch.arange(n) % 5}
    light = {"map": uniform(directions, 3), **seen}
    return light | surface(n, **of_surface) | around(directions)


def of_dielectrics(make: Callable[..., dict], f0: float = 0.04) -> Callable[..., dict]:
    return lambda n, f0=f0, **sizes: make(n, **sizes) | {"f0": f0}


def response(n: int, f0: float = 0.04, **of_surface) -> dict:
    return {k: v for k, v in under_radiance(n, **of_surface).items()
            if k not in ("radiance", "albedo")} | {"f0": f0}  # fmt: skip


def network(n: int, sizes: tuple[int, ...] = (6, 8, 3)) -> dict:
    weights = [normal(o, i) for o, i in zip(sizes[1:], sizes[:-1], strict=True)]
    return {"x": normal(n, sizes[0]), "weights": weights, "biases": [normal(o) for o in sizes[1:]]}


PICTURE, FOCAL = 48, 60.0  # of patches, pixels


def eyes(views: int = 4) -> Cameras:
    """On a circle about the origin, 3 away, looking at it."""
    angle = 0.35 * torch.arange(views)
    away = torch.stack([angle.cos(), angle.sin(), torch.full_like(angle, 0.3)], 1)
    return cameras_at(3 * normalize(away, dim=1), PICTURE, FOCAL)


def patch_rays(cameras: Cameras, view: Tensor, row: Tensor, column: Tensor) -> dict:
    """Origins, and directions through pixels with what columns and rows add to them."""
    pose = cameras.camera_to_world[view]
    local = torch.stack([column + 0.5 - PICTURE / 2, PICTURE / 2 - row - 0.5], 1) / FOCAL
    right, up, back = pose[:, :, :3].unbind(2)
    middle = local[:, :1] * right + local[:, 1:] * up - back
    direction = torch.stack([middle, right / FOCAL, -up / FOCAL], 1)
    return {"origin": pose[:, :, 3].contiguous(), "direction": direction}


def patches(n: int, others: int = 2, side: int = 3, noise: float = 0.05) -> dict:
    """Of a surface near the origin."""
    g = torch.Generator().manual_seed(0)
    cameras, view = eyes(), torch.randint(0, 4, (n,), generator=g)
    rays = patch_rays(cameras, view, *torch.randint(10, PICTURE - 10, (2, n), generator=g))
    middle = rays["direction"][:, 0]
    # Smooth, or coordinates in float32 lie in other cells than in float64, with other slopes
    x, phase = torch.arange(PICTURE) / PICTURE, uniform(4, 1, 1)
    picture = 2 + torch.sin(9 * x + 6 * phase) * torch.cos(7 * x[:, None] - 3 * phase)
    return rays | {
        "brightness": picture,
        "projection": projection_matrices(cameras),
        "own": uniform(n, side * side),
        "views": torch.randint(0, 4, (n, others), generator=g),
        "position": rays["origin"] + (2.9 + 0.2 * uniform(n, 1)) * middle,
        "normal": normalize(-middle + 0.3 * normal(n, 3), dim=1),
        "noise": noise,
    }


def sweep(n: int) -> dict:
    rows = torch.where(torch.arange(2 * n) < n, torch.arange(2 * n), -1).view(2, n)
    rays = {"origin": normal(n, 3), "direction": unit(n), "start": uniform(n)}
    pictures = (255 * uniform(5, 2, n, 4)).byte()
    views = {"pictures": pictures, "matrix": normal(5, 3, 4), "others": torch.arange(1, 5)}
    return views | rays | {"color": uniform(n, 3), "rows": rows, "step": 0.1, "steps": 7}


def matched(n: int, small: float = 0.05, large: float = 0.2) -> dict:
    return {"cost": uniform(n, 7), "rows": sweep(n)["rows"], "small": small, "large": large}


def smoothed(
    n: int, shape: tuple[int, ...] = (5, 6), channels: int = 3, first: int = 3, **more
) -> dict:
    """All nodes of a grid but the first."""
    values = normal(n, *shape, channels)
    rows = torch.arange(first, n * math.prod(shape))
    return {"grid": values, "rows": rows, "amount": 0.3, "order": 2, **more}


def smoothed_bricks(n: int, **more) -> dict:
    _, pool, bricks = cut(slanted(), far=0.3)
    rows = bricks.grid_rows().flatten().sort().values
    change = {"grid": pool[:, None].clone(), "rows": rows[rows >= 128]}
    return smoothed(n, **more) | change | {"bricks": bricks}


def diffused(n: int, shape: tuple[int, ...] = (5, 6), every: int = 1) -> dict:
    rows = torch.arange(3, n * math.prod(shape), every)
    return {"values": normal(len(rows)), "rows": rows, "size": (n, *shape), "amount": 0.8,
            "passes": 3}  # fmt: skip


def adam(n: int, channels: int = 4, table: int | None = None) -> dict:
    """Every second row of a table, unless it is said how many there are."""
    count = 2 * n if table is None else table
    moments = {"exp_avg": normal(count, channels, seed=1), "exp_avg_sq": uniform(count, channels)}
    rows = torch.randperm(count, generator=torch.Generator().manual_seed(0))[:n].sort().values
    rows = {"rows": rows, "grad": normal(n, channels, seed=2)}
    numbers = {"lr": 0.1, "beta1": 0.9, "beta2": 0.99, "eps": 1e-3, "step": 3}
    return {"param": normal(count, channels), **moments, **rows, **numbers}


def lists(n: int, shape: tuple[int, ...] | None = None, counts=(1.0, 0.5), channels=2) -> dict:
    """Of lists with such shares of the table's rows."""
    shape = (n, 2) if shape is None else shape
    count, g = math.prod(shape), torch.Generator().manual_seed(0)
    rows = [torch.randperm(count, generator=g)[: int(s * count)].sort().values for s in counts]
    values = [normal(len(r), channels, seed=i) for i, r in enumerate(rows)]
    return {"rows": rows, "values": values, "shape": shape}


def soup(n: int) -> tuple[Tensor, Tensor]:
    """Vertices and faces of n loose triangles in the unit cube."""
    corner = uniform(n, 1, 3) + 0.2 * normal(n, 3, 3)
    return corner.reshape(-1, 3), torch.arange(3 * n, dtype=torch.int32).reshape(n, 3)


def triangles(n: int) -> dict:
    return dict(zip(("vertices", "faces"), soup(n), strict=True))


def through_triangles(n: int) -> dict:
    return {"origin": uniform(n, 3, seed=1), "direction": unit(n, seed=2)}


def occluded(**arguments) -> Tensor:
    return ops.VisibilityScene(*soup(50)).occluded(**arguments)


def closest_hit(**arguments) -> ops.Hit:
    return ops.VisibilityScene(*soup(50)).closest_hit(**arguments)


def relit(n: int) -> dict:
    vertices, faces = soup(50)
    rows = surface(len(vertices))
    mesh = Mesh(vertices, faces, rows["normal"], rows["albedo"], rows["roughness"])
    lit = {"scene": ops.VisibilityScene(vertices, faces), "mesh": mesh, "mesh_f0": rows["f0"]}
    lit["tables"] = tables(EnvMap(uniform(4, 8, 3)))
    numbers = {"offset": 0.01, "samples": 2, "bounces": 1}
    return lit | {"position": uniform(n, 3, seed=3)} | surface(n) | numbers


# By name of the op, and of what else is told apart: arguments of n rows
CASES: dict[str, Callable[..., dict]] = {
    "composite": composed,
    "sample_dense": grid,
    "sample_sparse": sparse_grid,
    "encode_hash": hash_grid,
    "composite_field": field,
    "composite_field of bricks": field_of_bricks,
    "brick_minimum": lambda n, shape=(9, 10): {"sdf": normal(n, *shape)},
    "march": marched,
    "march of bricks": marched_bricks,
    "shade_sg": under_sg,
    "shade_sg of dielectrics": of_dielectrics(under_sg),
    "shade_radiance": under_radiance,
    "shade_radiance of dielectrics": of_dielectrics(under_radiance),
    "shade_map": under_map,
    "shade_map of dielectrics": of_dielectrics(under_map),
    "specular_response": response,
    "decode_lobes": lambda n, size=1.0: {
        "parameters": size * normal(6 * n, 7), "min_sharpness": 0.1, "max_sharpness": 30.0
    },
    "mlp": network,
    "patch_correlation": patches,
    "match_cost": sweep,
    "semi_global": matched,
    "smooth_rows_": smoothed,
    "smooth_rows_ of bricks": smoothed_bricks,
    "diffuse_rows_": diffused,
    "adam_rows_": adam,
    "sum_rows": lists,
}  # fmt: skip
if RAYS:
    CASES |= {
        "VisibilityScene": triangles,
        "occluded": through_triangles,
        "closest_hit": through_triangles,
        "relight": relit,
    }
# What has a gradient
LEAVES = {
    "composite": "alpha value",
    "sample_dense": "sdf features points",
    "sample_sparse": "sdf features points",
    "encode_hash": "table points",
    "composite_field": "sdf features origin direction",
    "shade_sg": "axis sharpness amplitude normal wo albedo roughness f0",
    "shade_radiance": "radiance normal albedo roughness f0",
    "shade_map": "map normal albedo roughness f0",
    "decode_lobes": "parameters",
    "mlp": "x weights biases",
    "patch_correlation": "position normal",
}
# What is changed in place
CHANGED = {
    "smooth_rows_": ["grid"],
    "diffuse_rows_": ["values"],
    "adam_rows_": ["param", "exp_avg", "exp_avg_sq"],
}
DIFFERENTIABLE = [case for case in CASES if case.split()[0] in LEAVES]


def function(case: str):
    """The op of a case."""
    name = case.split()[0]
    return globals()[name] if name in ("occluded", "closest_hit") else getattr(ops, name)


def flat(values: Any) -> list[Tensor]:
    """The tensors among outputs or arguments: single, in lists, or in records."""
    if isinstance(values, Tensor):
        return [values]
    if dataclasses.is_dataclass(values):
        values = [*vars(values).values()]
    return [t for v in values for t in flat(v)] if isinstance(values, list | tuple) else []


# What is of unit length, in float32 to its rounding
UNIT = ("axis", "normal", "wo", "directions")


def doubled(values: Any, name: str = "") -> Any:
    """Arguments in double precision, but for halves; directions are then of unit length in it."""
    if isinstance(values, Tensor):
        floats = values.is_floating_point() and values.dtype != torch.float16
        values = values.double() if floats else values
        return normalize(values, dim=-1) if name in UNIT else values
    if isinstance(values, dict):
        return {k: doubled(v, k) for k, v in values.items()}
    if isinstance(values, list):
        return [doubled(v) for v in values]
    is_samples = dataclasses.is_dataclass(values) and hasattr(values, "connected")
    return dataclasses.replace(values, t=values.t.double()) if is_samples else values


def leaves_of(case: str) -> list[str]:
    return LEAVES.get(case.split()[0], "").split()


def fresh(case: str, arguments: dict, **options) -> tuple[dict, list[Tensor]]:
    """Arguments of their own memory, and those that ask for a gradient."""
    leaves, arguments = [], dict(arguments)
    for key in CHANGED.get(case.split()[0], ()):
        arguments[key] = arguments[key].clone()
    for key in leaves_of(case):
        value = arguments[key]
        if isinstance(value, list):
            arguments[key] = [t.detach().requires_grad_() for t in value]
        elif isinstance(value, Tensor):
            arguments[key] = value.detach().requires_grad_()
        leaves += flat(arguments[key])
    return arguments | options, leaves


def results(case: str, arguments: dict, **options) -> list[Tensor]:
    """Outputs, gradients of a projection of them, and what was changed in place."""
    arguments, leaves = fresh(case, arguments, **options)
    out = flat(function(case)(**arguments))
    grads = torch.autograd.grad(projection(out), leaves) if leaves else ()
    changed = [arguments[key] for key in CHANGED.get(case.split()[0], ())]
    return [*(o.detach() for o in out), *(g.to_dense() for g in grads), *changed]


def projection(out: list[Tensor]) -> Tensor:
    """A number that every output has its own part in."""
    through = [o for o in out if o.requires_grad]
    weighted = [(o * torch.cos(torch.arange(o.numel())).view(o.shape)).sum() for o in through]
    return torch.stack(weighted).sum()


def same_on_threads(
    run: Callable[[], Sequence[Tensor]], counts: Sequence[int] = (1, 2, 3)
) -> list[Tensor]:
    """What a function returns: the same bits on each of these numbers of threads."""
    before, found = torch.get_num_threads(), []
    try:
        for count in counts:
            torch.set_num_threads(count)
            found.append(list(run()))
    finally:
        torch.set_num_threads(before)
    for other in found[1:]:
        for a, b in zip(found[0], other, strict=True):
            assert torch.equal(a, b), "another number of threads gives other bits"
    return found[0]
