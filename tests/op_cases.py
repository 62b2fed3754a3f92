"""Arguments that each op takes, of any number of rows, and everything that comes of a call."""

import dataclasses
import math
from typing import Any

import torch
from bricks import cut
from torch import Tensor
from torch.nn.functional import normalize

from univoxel import ops, sphere
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


def slanted() -> Tensor:
    """Distances [X, Y, Z] of a bumpy plane through the middle of the grid."""
    nodes = torch.stack(torch.meshgrid(*map(torch.arange, SHAPE), indexing="ij"), -1).float()
    plane = (nodes - torch.tensor(SHAPE) / 2) @ torch.tensor([0.2, 0.3, 0.9])
    return H * plane + 0.05 * normal(*SHAPE)


def grid(n: int) -> dict:
    points = 2.4 * uniform(n, 3) - 1.1
    features = normal(*SHAPE, 3)
    place = {"origin": ORIGIN, "voxel_size": H}
    return {"sdf": slanted(), "features": features, "points": points, **place}


def sparse_grid(n: int) -> dict:
    _, pool, bricks = cut(slanted(), far=0.3)
    return grid(n) | {"sdf": pool, "features": normal(len(pool), 3), "bricks": bricks}


def hash_grid(n: int) -> dict:
    place = dict(zip(("lower", "upper", "voxel_sizes"), LEVELS, strict=True))
    return {"table": normal(2 * 64, 2), "points": grid(n)["points"], **place}


def field(n: int) -> dict:
    origin = torch.cat([1.6 * uniform(n, 2) - 0.8, torch.full((n, 1), -0.9)], 1)
    direction = normalize(torch.tensor([0.0, 0.0, 1.0]) + 0.1 * normal(n, 3), dim=1)
    t = 0.25 * torch.arange(8.0).repeat(n)
    connected = torch.arange(8 * n) % 8 != 7
    samples = Samples(t, connected, torch.arange(0, 8 * n + 1, 8))
    rays = {"origin": origin, "direction": direction, "samples": samples}
    place = {"grid_origin": ORIGIN, "voxel_size": H, "inv_s": 6.0}
    return {"sdf": -slanted(), "features": normal(*SHAPE, 3), **rays, **place}  # they enter it


def hashed_field_of_bricks(n: int) -> dict:
    _, pool, bricks = cut(-slanted(), far=0.8)
    change = {"sdf": pool, "features": normal(2 * 64, 2), "bricks": bricks, "levels": LEVELS}
    return field(n) | change | {"min_share": 0.1}


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


def surface(n: int) -> dict:
    return {
        "normal": unit(n),
        "wo": unit(n, seed=1),
        "albedo": uniform(n, 3),
        "roughness": 0.2 + 0.7 * uniform(n),
        "f0": uniform(n, 3, seed=1),
    }


def under_sg(n: int) -> dict:
    lobes = {"axis": unit(n, 4), "sharpness": 20 * uniform(n, 4), "amplitude": uniform(n, 4, 3)}
    frame = {"directions": sphere.fibonacci_hemisphere(16), "rotation": 6 * uniform(n)}
    return lobes | surface(n) | frame


AROUND = {"directions": sphere.fibonacci_sphere(16), "solid_angle": math.pi / 4}


def under_radiance(n: int) -> dict:
    return {"radiance": uniform(n, 16, 3), **surface(n), **AROUND}


def under_map(n: int) -> dict:
    seen = {"visibility": uniform(5, 16), "indirect": uniform(5, 16, 3)}
    return {"map": uniform(16, 3), **seen, "index": torch.arange(n) % 5, **surface(n), **AROUND}


def response(n: int) -> dict:
    return {k: v for k, v in (surface(n) | AROUND).items() if k not in ("albedo", "f0")}


def network(n: int) -> dict:
    weights, biases = [normal(8, 6), normal(3, 8)], [normal(8), normal(3)]
    return {"x": normal(n, 6), "weights": weights, "biases": biases}


def patches(n: int) -> dict:
    views = torch.randint(0, 3, (n, 2), generator=torch.Generator().manual_seed(2))
    rays = {"origin": normal(n, 3), "direction": normal(n, 3, 3), "own": uniform(n, 9)}
    plane = {"position": normal(n, 3, seed=1), "normal": unit(n)}
    pictures = {"brightness": uniform(3, 30, 40), "projection": normal(3, 3, 4)}
    return pictures | rays | {"views": views} | plane


def sweep(n: int) -> dict:
    rows = torch.where(torch.arange(2 * n) < n, torch.arange(2 * n), -1).view(2, n)
    rays = {"origin": normal(n, 3), "direction": unit(n), "start": uniform(n)}
    pictures = (255 * uniform(5, 2, n, 4)).byte()
    views = {"pictures": pictures, "matrix": normal(5, 3, 4), "others": torch.arange(1, 5)}
    return views | rays | {"color": uniform(n, 3), "rows": rows, "step": 0.1, "steps": 7}


def matched(n: int) -> dict:
    return {"cost": uniform(n, 7), "rows": sweep(n)["rows"], "small": 0.05, "large": 0.2}


def smoothed(n: int) -> dict:
    return {"grid": normal(n, 5, 6, 3), "rows": torch.arange(3, 30 * n), "amount": 0.3, "order": 2}


def smoothed_bricks(n: int) -> dict:
    _, pool, bricks = cut(slanted(), far=0.3)
    change = {"grid": pool[:, None].clone(), "rows": torch.arange(128, len(pool) - 64)}
    return smoothed(n) | change | {"bricks": bricks}


def diffused(n: int) -> dict:
    rows = torch.arange(3, 30 * n)
    return {"values": normal(len(rows)), "rows": rows, "size": (n, 5, 6), "amount": 0.8,
            "passes": 3}  # fmt: skip


def adam(n: int) -> dict:
    moments = {"exp_avg": normal(2 * n, 4, seed=1), "exp_avg_sq": uniform(2 * n, 4)}
    rows = {"rows": torch.arange(0, 2 * n, 2), "grad": normal(n, 4, seed=2)}
    numbers = {"lr": 0.1, "beta1": 0.9, "beta2": 0.99, "eps": 1e-3, "step": 3}
    return {"param": normal(2 * n, 4), **moments, **rows, **numbers}


def lists(n: int) -> dict:
    rows = [torch.arange(0, 2 * n, 2), torch.arange(n)]
    return {"rows": rows, "values": [normal(n, 2), normal(n, 2, seed=1)], "shape": (n, 2)}


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
CASES = {
    "composite": lambda n: {
        "alpha": uniform(3 * n), "value": normal(3 * n, 5), "offsets": torch.arange(0, 3 * n + 1, 3)
    },
    "sample_dense": grid,
    "sample_sparse": sparse_grid,
    "encode_hash": hash_grid,
    "composite_field": field,
    "composite_field of bricks": hashed_field_of_bricks,
    "brick_minimum": lambda n: {"sdf": normal(n, 9, 10)},
    "march": marched,
    "march of bricks": marched_bricks,
    "shade_sg": under_sg,
    "shade_sg of dielectrics": lambda n: under_sg(n) | {"f0": 0.04},
    "shade_radiance": under_radiance,
    "shade_radiance of dielectrics": lambda n: under_radiance(n) | {"f0": 0.04},
    "shade_map": under_map,
    "shade_map of dielectrics": lambda n: under_map(n) | {"f0": 0.04},
    "specular_response": response,
    "decode_lobes": lambda n: {
        "parameters": normal(6 * n, 7), "min_sharpness": 0.1, "max_sharpness": 30.0
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


def doubled(values: Any) -> Any:
    """Arguments in double precision."""
    if isinstance(values, Tensor):
        return values.double() if values.is_floating_point() else values
    if isinstance(values, dict):
        return {k: doubled(v) for k, v in values.items()}
    if isinstance(values, list):
        return [doubled(v) for v in values]
    is_samples = dataclasses.is_dataclass(values) and hasattr(values, "connected")
    return dataclasses.replace(values, t=values.t.double()) if is_samples else values


def fresh(case: str, arguments: dict, **options) -> tuple[dict, list[Tensor]]:
    """Arguments of their own memory, and those that ask for a gradient."""
    name, leaves = case.split()[0], []
    arguments = dict(arguments)
    for key in CHANGED.get(name, ()):
        arguments[key] = arguments[key].clone()
    for key in LEAVES.get(name, "").split():
        value = arguments[key]
        if isinstance(value, list):
            arguments[key] = [t.detach().requires_grad_() for t in value]
        elif isinstance(value, Tensor):
            arguments[key] = value.detach().requires_grad_()
        leaves += flat(arguments[key])
    return arguments | options, leaves


def results(case: str, arguments: dict) -> list[Tensor]:
    """Outputs, gradients of a projection of them, and what was changed in place."""
    arguments, leaves = fresh(case, arguments)
    out = flat(function(case)(**arguments))
    grads = torch.autograd.grad(projection(out), leaves) if leaves else ()
    changed = [arguments[key] for key in CHANGED.get(case.split()[0], ())]
    return [*(o.detach() for o in out), *grads, *changed]


def projection(out: list[Tensor]) -> Tensor:
    """A number that every output has its own part in."""
    through = [o for o in out if o.requires_grad]
    weighted = [(o * torch.cos(torch.arange(o.numel())).view(o.shape)).sum() for o in through]
    return torch.stack(weighted).sum()
