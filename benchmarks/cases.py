"""What is timed: one function per op, at the sizes of a training step."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any

import peers
import torch
from torch import Tensor

from univoxel import ops, sphere

RAYS, SAMPLES = 4096, 64  # per ray: 262,144 samples
POINTS, LOBES, DIRECTIONS = 4096, 16, 256


@dataclass(frozen=True)
class Case:
    """One op at one size. Tensors of `arguments` that require a gradient are differentiated."""

    op: str
    size: str
    ours: Callable
    reference: Callable | None  # None: too slow to be timed; then `error` says how right ours is
    arguments: tuple  # float32
    work: dict[str, float]  # least work, forward and backward, in the units of limits.measure
    peers: peers.Peers = field(default_factory=dict)
    tolerance: float = 1e-4  # relative L2 error against float64: sums of hundreds in float32
    error: Callable[[], float] | None = None


def composite(channels: int = 12) -> Case:
    g = torch.Generator().manual_seed(0)
    m = RAYS * SAMPLES
    alpha = (torch.rand(m, generator=g) * 0.1).requires_grad_()
    value = torch.randn(m, channels, generator=g).requires_grad_()
    offsets = torch.arange(0, m + 1, SAMPLES)
    return Case(
        "composite",
        f"{m:,} samples, {channels} channels",
        ops.composite,
        ops.composite_reference,
        (alpha, value, offsets),
        # alpha and value read twice, weight and both gradients written
        {"read": 4.0 * m * (2 * (1 + channels) + 1 + 1 + channels)},
        peers.composite(alpha, value, RAYS),
    )


def _points_on_rays(generator: torch.Generator) -> Tensor:
    """Points in [0, 1]^3 in the order a ray march gives: sections of neighbouring rays."""
    side = int(RAYS**0.5)
    uv = torch.cartesian_prod(torch.arange(side), torch.arange(side)) / side * 0.6 + 0.2
    depth = torch.linspace(0.35, 0.65, SAMPLES) + 0.3 / SAMPLES * torch.rand(
        RAYS, 1, generator=generator
    )
    xy = uv[:, None].expand(-1, SAMPLES, -1)
    return torch.cat([xy, depth[..., None]], -1).reshape(-1, 3).contiguous()


def sample_dense(resolution: int, channels: int = 16) -> Case:
    g = torch.Generator().manual_seed(0)
    shape = (resolution,) * 3
    sdf = torch.randn(*shape, generator=g).requires_grad_()
    features = torch.randn(*shape, channels, generator=g).requires_grad_()
    points = _points_on_rays(g)
    h = 1.0 / (resolution - 1)

    def ours(*arguments):
        return ops.sample_dense(*arguments, sparse_grad=True)

    m = len(points)
    cell = (points / h).long()
    corners = torch.cartesian_prod(*[torch.arange(2)] * 3)
    nodes = (cell[:, None] + corners).clamp(max=resolution - 1) @ torch.tensor(
        [resolution**2, resolution, 1]
    )
    return Case(
        "sample_dense",
        f"{m:,} points, {channels} channels, {resolution}^3",
        ours,
        ops.sample_dense_reference,
        (sdf, features, points, (0.0, 0.0, 0.0), h),
        # each node that some point touches: features read, gradient written; 8 weighted sums
        # forward and backward
        {
            "read": 4.0 * 2 * channels * len(nodes.unique()),
            "fma": 2.0 * 2 * 8 * m * (channels + 7),
        },
        peers.sample_dense(sdf, features, points, h),
    )


def encode_hash(levels: int = 8, rows: int = 2**17, features: int = 2) -> Case:
    g = torch.Generator().manual_seed(0)
    table = torch.randn(levels * rows, features, generator=g).requires_grad_()
    points = _points_on_rays(g)
    finest, coarsest = 1 / 160, 1 / 16
    sizes = [coarsest * (finest / coarsest) ** (i / (levels - 1)) for i in range(levels)]

    def ours(*arguments):
        return ops.encode_hash(*arguments, sparse_grad=True)

    m = len(points)
    return Case(
        "encode_hash",
        f"{m:,} points, {levels} levels of {rows:,} rows of {features}",
        ours,
        ops.encode_hash_reference,
        (table, points, (0.0,) * 3, (1.0,) * 3, sizes),
        # eight rows a level read forward and added to backward
        {"fma": 2.0 * 2 * 8 * m * levels * features},
    )


def shade_sg() -> Case:
    g = torch.Generator().manual_seed(0)

    def unit(*size):
        return torch.nn.functional.normalize(torch.randn(*size, 3, generator=g), dim=-1)

    normal = unit(POINTS)
    wo = torch.nn.functional.normalize(normal + 0.7 * unit(POINTS), dim=-1)
    parameters = [
        unit(POINTS, LOBES),
        torch.rand(POINTS, LOBES, generator=g) * 30 + 0.1,
        torch.rand(POINTS, LOBES, 3, generator=g),
        normal,
        wo,
        torch.rand(POINTS, 3, generator=g),
        torch.rand(POINTS, generator=g) * 0.8 + 0.1,
    ]
    i = torch.arange(DIRECTIONS) + 0.5  # Fibonacci half-sphere
    z, phi = 1 - i / DIRECTIONS, i * 2.399963229728653
    r = (1 - z * z).sqrt()
    directions = torch.stack([r * phi.cos(), r * phi.sin(), z], -1)
    rotation = torch.rand(POINTS, generator=g) * 6.2831853
    pairs = float(POINTS * LOBES * DIRECTIONS)
    return Case(
        "shade_sg",
        f"{POINTS:,} points, {LOBES} lobes, {DIRECTIONS} directions",
        ops.shade_sg,
        ops.shade_sg_reference,
        (*(p.requires_grad_() for p in parameters), directions, rotation, 0.04),
        # a dot product, an exponential and three sums forward; their gradients backward
        {"exp": pairs, "fma": 2 * pairs * (3 + 1 + 3 + 3 + 3 + 4)},
    )


def adam_rows(table: int = 256**3, rows: int = 256**3 // 50, channels: int = 8) -> Case:
    g = torch.Generator().manual_seed(0)
    chosen = torch.randperm(table, generator=g)[:rows].sort().values
    param, mean = torch.randn(2, table, channels, generator=g).unbind()
    square = torch.rand(table, channels, generator=g)
    grad = torch.randn(rows, channels, generator=g)
    numbers = (1e-3, 0.9, 0.99, 1e-8, 5)
    state = [t.clone() for t in (param, mean, square)]

    def step(function):
        def run(param, mean, square, chosen, grad):
            function(param, mean, square, chosen, grad, *numbers)
            return param, mean, square

        return run

    dense = torch.zeros(table, channels)

    def adam():  # what torch does with a dense gradient of the same table
        torch.optim._functional.adam(
            [state[0]],
            [dense],
            [state[1]],
            [state[2]],
            [],
            [torch.tensor(5.0)],
            amsgrad=False,
            beta1=0.9,
            beta2=0.99,
            lr=1e-3,
            weight_decay=0.0,
            eps=1e-8,
            maximize=False,
        )

    return Case(
        "adam_rows_",
        f"{rows:,} of {table:,} rows, {channels} channels",
        step(ops.adam_rows_),
        step(ops.adam_rows_reference_),
        (param, mean, square, chosen, grad),
        # three tables read and written, the gradient read
        {"read": 4.0 * 7 * rows * channels},
        {"torch.optim.Adam, dense gradient": lambda: adam},
    )


def mlp(rows: int, *sizes: int) -> Case:
    g = torch.Generator().manual_seed(0)
    layers = list(pairwise(sizes))
    x = torch.randn(rows, sizes[0], generator=g)
    weights = [torch.randn(o, i, generator=g) * (2 / i) ** 0.5 for i, o in layers]
    biases = [torch.randn(o, generator=g) for _, o in layers]

    def flat(op):
        def run(x, *parameters):
            return op(x, parameters[: len(layers)], parameters[len(layers) :])

        return run

    return Case(
        "mlp",
        f"{rows:,} rows, {'-'.join(map(str, sizes))}",
        flat(ops.mlp),
        flat(ops.mlp_reference),
        tuple(t.requires_grad_() for t in (x, *weights, *biases)),
        # each weight takes part in a product forward, and in two backward
        {"fma": 3 * 2.0 * rows * sum(i * o for i, o in layers)},
    )


def occluded(rays: int = 262_144, columns: int = 224) -> Case:
    """Half-sphere rays in random order from the vertices of a bumpy ball of 100,352 triangles."""
    g = torch.Generator().manual_seed(0)
    u, v = torch.meshgrid(
        torch.arange(columns + 1) / columns * 2 * math.pi,
        (torch.arange(columns + 1) + 0.5) / (columns + 1) * math.pi,
        indexing="ij",
    )
    outwards = torch.stack([v.sin() * u.cos(), v.sin() * u.sin(), v.cos()], -1)
    radius = 1 + 0.1 * (9 * u).sin() * (7 * v).sin() * v.sin()
    vertices = (radius[..., None] * outwards).reshape(-1, 3).contiguous()
    node = torch.arange(len(vertices)).view(columns + 1, columns + 1)
    a, b, c, d = node[:-1, :-1], node[1:, :-1], node[1:, 1:], node[:-1, 1:]
    faces = torch.stack([torch.stack([a, b, c], -1), torch.stack([a, c, d], -1)])
    faces = faces.reshape(-1, 3).int().contiguous()
    start = torch.randint(len(vertices), (rays,), generator=g)
    up = outwards.reshape(-1, 3)[start]
    origin = (vertices[start] + 1e-3 * up).contiguous()
    direction = torch.nn.functional.normalize(torch.randn(rays, 3, generator=g), dim=1)
    direction *= torch.where((direction * up).sum(1, keepdim=True) < 0, -1.0, 1.0)
    scene = ops.VisibilityScene(vertices, faces)

    def error() -> float:
        """Share of rays that the reference sees otherwise, of a few."""
        some = torch.arange(512)
        want = ops.occluded_reference(vertices, faces, origin[some], direction[some])
        return float((scene.occluded(origin[some], direction[some]) != want).float().mean())

    return Case(
        "occluded",
        f"{rays:,} half-sphere rays, {len(faces):,} triangles",
        scene.occluded,
        None,
        (origin, direction),
        {},
        peers.occluded(vertices, faces, origin, direction),
        tolerance=0.01,  # rays through edges, in float32 both
        error=error,
    )


def _ellipsoid(size: tuple[int, int, int]) -> tuple[Tensor, list[float], float]:
    """About the distance to one, on a grid whose first axis is 1 long: sdf, origin, voxel size."""
    h = 1.0 / (size[0] - 1)
    axes = [(torch.arange(n) - (n - 1) / 2) * h for n in size]
    x, y, z = torch.meshgrid(*axes, indexing="ij")
    sdf = (1.2 * x**2 + 2 * y**2 + 2.6 * z**2).sqrt() - 0.42
    return sdf, [float(a[0]) for a in axes], h


def _rays_to_ellipsoid(rays: int) -> tuple[Any, ...]:
    """Distances, brick minima; rays from all around and their jitter; place and voxel size."""
    g = torch.Generator().manual_seed(0)
    sdf, start, h = _ellipsoid((200, 155, 130))

    def unit(t):
        return torch.nn.functional.normalize(t, dim=1)

    origin = 1.5 * unit(torch.randn(rays, 3, generator=g))
    direction = unit(0.15 * torch.randn(rays, 3, generator=g) - origin)
    jitter = torch.rand(rays, generator=g)
    return sdf, ops.brick_minimum(sdf), origin, direction, jitter, start, h


def march(rays: int = 2048) -> Case:
    *tensors, start, h = _rays_to_ellipsoid(rays)

    def count(samples):  # rounding moves single samples in or out
        return samples.t.sum(), samples.t.new_tensor(len(samples.t))

    def ours(sdf, least, *rays):
        return count(ops.march(sdf, least, *rays, start, h, step=h, inv_s=2 / h))

    def reference(sdf, least, *rays):
        return count(ops.march_reference(sdf, *rays, start, h, step=h, inv_s=2 / h))

    return Case(
        "march",
        f"{rays:,} rays, {'x'.join(map(str, tensors[0].shape))}",
        ours,
        reference,
        tuple(tensors),
        {},
        tolerance=1e-3,
    )


def composite_field(rays: int = 2048, channels: int = 12, min_share: float = 0.05) -> Case:
    """What `march` above finds, composited; the chain is of the ops that do it one by one."""
    g = torch.Generator().manual_seed(0)
    sdf, least, origin, direction, jitter, start, h = _rays_to_ellipsoid(rays)
    samples = ops.march(sdf, least, origin, direction, jitter, start, h, step=h, inv_s=2 / h)
    features = torch.randn(*sdf.shape, channels, generator=g)
    place = start, h, 2 / h

    def ours(*tensors):
        options = {"min_share": min_share, "sparse_grad": True}
        opacity, t, *rest = ops.composite_field(*tensors, samples, *place, **options)
        return torch.cat([opacity[:, None], t[:, None], *rest], 1)

    def reference(*tensors):
        double = replace(samples, t=samples.t.to(tensors[0]))
        return ops.composite_field_reference(*tensors, double, *place, min_share=min_share)

    tensors = tuple(x.requires_grad_() for x in (sdf, features, origin, direction))
    m = len(samples.t)
    return Case(
        "composite_field",
        f"{rays:,} rays of {m:,} samples, {channels} channels",
        ours,
        reference,
        tensors,
        # eight corners of a distance and its gradient forward and backward
        {"fma": 2.0 * 2 * 8 * m * 7},
        {"chain of ops": lambda: peers.composite_field(tensors, samples, *place)},
        tolerance=1e-3,  # what is read where a share is just the least one
    )


def smooth_rows(rows: int = 130_000, channels: int = 1, order: int = 2) -> Case:
    sdf, *_ = _ellipsoid((200, 155, 130))
    grid = sdf[..., None].repeat(1, 1, 1, channels)
    near = sdf.abs().flatten().argsort()[:rows].sort().values
    return Case(
        "smooth_rows_",
        f"{rows:,} rows, {channels} channel{'s' * (channels > 1)}, order {order}",
        lambda grid: ops.smooth_rows_(grid, near, 0.1, order),
        lambda grid: ops.smooth_rows_reference_(grid, near, 0.1, order),
        (grid,),
        {"read": 4.0 * 3 * rows * channels},  # read, then read and written
    )


def diffuse_rows(rows: int = 130_000, passes: int = 4) -> Case:
    sdf, *_ = _ellipsoid((200, 155, 130))
    near = sdf.abs().flatten().argsort()[:rows].sort().values
    values = torch.randn(rows, generator=torch.Generator().manual_seed(0))
    return Case(
        "diffuse_rows_",
        f"{rows:,} rows, {passes} passes",
        lambda values: ops.diffuse_rows_(values, near, sdf.shape, 0.8, passes),
        lambda values: ops.diffuse_rows_reference_(values, near, sdf.shape, 0.8, passes),
        (values,),
        {"read": 4.0 * 3 * rows + 8.0 * rows},  # values as in smooth_rows_, and the rows
    )


def decode_lobes(points: int = 2048, lobes: int = 16) -> Case:
    raw = torch.randn(points * lobes, 7, generator=torch.Generator().manual_seed(0))
    return Case(
        "decode_lobes",
        f"{points:,} points, {lobes} lobes",
        lambda raw: ops.decode_lobes(raw, 0.1, 30.0),
        lambda raw: ops.decode_lobes_reference(raw, 0.1, 30.0),
        (raw.requires_grad_(),),
        # Forward and backward: the numbers of a lobe are read, and as many written, each way
        {"read": 4.0 * 4 * raw.numel()},
    )


def specular_response(sightings: int = 2048, directions: int = 512) -> Case:
    g = torch.Generator().manual_seed(0)
    normal, wo = torch.nn.functional.normalize(torch.randn(2, sightings, 3, generator=g), dim=-1)
    roughness = 0.2 + 0.7 * torch.rand(sightings, generator=g)
    inputs = normal, wo, roughness, sphere.fibonacci_sphere(directions)
    angle = 4 * math.pi / directions
    return Case(
        "specular_response",
        f"{sightings:,} sightings, {directions} directions",
        lambda *tensors: ops.specular_response(*tensors, angle),
        lambda *tensors: ops.specular_response_reference(*tensors, angle),
        inputs,
        {"read": 4.0 * sightings * directions},  # written
    )


def _table(views: int, side: int) -> tuple[Tensor, ...]:
    """Cameras beside one another that look down on a painted table at z = 0 from z = 2: pictures,
    matrices; origins, directions, starts, colours and rows of the first one's pixels; the others.
    """
    at = 0.2 * torch.randn(views, 2, generator=torch.Generator().manual_seed(0))
    at[0] = 0.0
    axis = (torch.arange(side) + 0.5) / side - 0.5  # focal length: one side
    y, x = torch.meshgrid(axis, axis, indexing="ij")
    ground = torch.stack([2 * x, -2 * y], -1) + at[:, None, None]
    color = 0.5 + 0.2 * (torch.sin(9 * ground[..., :1]) + torch.sin(7 * ground[..., 1:]))
    pictures = torch.cat([color.expand(-1, -1, -1, 3), torch.ones(views, side, side, 1)], -1)
    pictures = (255 * pictures).round().byte()
    f, c, matrix = side, side / 2, torch.zeros(views, 3, 4)
    matrix[:] = torch.tensor([[f, 0, -c, 2 * c], [0, -f, -c, 2 * c], [0, 0, -1, 2]])
    matrix[:, 0, 3] -= f * at[:, 0]
    matrix[:, 1, 3] += f * at[:, 1]
    count = side * side
    direction = torch.stack([x, -y, -torch.ones_like(x)], -1).reshape(-1, 3)
    origin = torch.tensor([0.0, 0.0, 2.0]).expand(count, 3).contiguous()
    start, seen = torch.full((count,), 1.8), pictures[0, ..., :3].reshape(-1, 3) / 255
    rows = torch.arange(count).view(side, side)
    return pictures, matrix, origin, direction, start, seen, rows, torch.arange(1, views)


def match_cost(side: int = 100, steps: int = 48) -> Case:
    pictures, *floating, rows, others = _table(9, side)

    def ours(*tensors):
        return ops.match_cost(pictures, *tensors, rows, others, 0.01, steps)

    def reference(*tensors):
        return ops.match_cost_reference(pictures, *tensors, rows, others, 0.01, steps, 0.2, 1, 4)

    return Case(
        "match_cost",
        f"{side * side:,} pixels, {steps} depths, {len(others)} views",
        ours,
        reference,
        tuple(floating),
        # Four corners of four numbers, and the window's sums, which neighbours could share
        {"fma": 2.0 * side * side * steps * len(others) * (4 * 4 + 9)},
        tolerance=1e-3,  # positions of 100 pixels, and views that just see a point
    )


def semi_global(side: int = 200, steps: int = 48) -> Case:
    cost = torch.rand(side * side, steps, generator=torch.Generator().manual_seed(0))
    rows = torch.arange(side * side).view(side, side)
    return Case(
        "semi_global",
        f"{side * side:,} pixels, {steps} depths",
        lambda cost: ops.semi_global(cost, rows, 0.01, 0.04),
        lambda cost: ops.semi_global_reference(cost, rows, 0.01, 0.04),
        (cost,),
        {"read": 4.0 * 2 * cost.numel()},  # read, and sums written
    )


def patch_correlation(patches: int = 256, others: int = 4, side: int = 5) -> Case:
    """Patches of the table, all around its middle."""
    size = 200
    pictures, matrix, origin, direction, *_ = _table(9, size)
    g = torch.Generator().manual_seed(0)
    row, column = torch.randint(size // 4, 3 * size // 4, (2, patches), generator=g)
    at = row * size + column
    steps = torch.tensor([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]).expand(patches, 2, 3) / size
    rays = torch.cat([direction[at, None], steps], 1)
    pixel = torch.arange(side) - side // 2
    down, right = (t.flatten() for t in torch.meshgrid(pixel, pixel, indexing="ij"))
    brightness = pictures[..., 0].float() / 255
    own = brightness[0, row[:, None] + down, column[:, None] + right]
    position = (origin[at] + 1.99 * direction[at]).requires_grad_()
    normal = torch.tensor([0.05, 0.0, 1.0]).repeat(patches, 1).requires_grad_()
    views = torch.randint(1, 9, (patches, others), generator=g)
    samples = patches * others * side * side
    return Case(
        "patch_correlation",
        f"{patches} patches of {side}x{side} pixels, {others} views",
        lambda *seen: ops.patch_correlation(*seen[:5], views, *seen[5:])[0],
        lambda *seen: ops.patch_correlation_reference(*seen[:5], views, *seen[5:])[0],
        (brightness, matrix, origin[at], rays, own, position, normal),
        # A pixel: its place, four corners, and its part in the sums, forward and backward
        {"fma": 2.0 * 30 * samples},
        tolerance=1e-3,  # positions of 100 pixels
    )


CASES: list[tuple[str, Callable[[], Case]]] = [
    ("composite", composite),
    ("sample_dense", lambda: sample_dense(160)),
    ("sample_dense", lambda: sample_dense(256)),
    ("encode_hash", encode_hash),
    ("shade_sg", shade_sg),
    ("mlp", lambda: mlp(65_536, 28, 128, 128, 4)),
    ("mlp", lambda: mlp(4096, 8, 64, 64, 4)),
    ("mlp", lambda: mlp(4096, 29, 64, 64, 3)),
    ("mlp", lambda: mlp(4096, 37, 64, 64, 112)),
    ("occluded", occluded),
    ("adam_rows_", adam_rows),
    ("march", march),
    ("composite_field", composite_field),
    ("smooth_rows_", smooth_rows),
    ("smooth_rows_", lambda: smooth_rows(channels=12, order=1)),
    ("diffuse_rows_", diffuse_rows),
    ("specular_response", specular_response),
    ("decode_lobes", decode_lobes),
    ("match_cost", match_cost),
    ("semi_global", semi_global),
    ("patch_correlation", patch_correlation),
]
