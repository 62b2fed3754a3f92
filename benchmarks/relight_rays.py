"""Shadow rays of relight.py: their rate within the integrator, and of bare Embree on the same rays.

The integrator is run with the map's samples only and without bounces: then all its rays are shadow
rays. Its rate is the number of rays over all its time: numbers drawn, directions, BRDF, lookups of
the map, tracing and sums. Rays that it leaves out, as they would carry no light, count for none.

Bare Embree traces the very same rays in the same order, from an array, and does nothing else: one
after the other by rtcOccluded1, and by packets of 8, the fastest of its calls on such rays. That
they are the same is checked: shaded here, with the answers of bare Embree, they give the
integrator's picture.

All on one thread, by its processor time: other programs then slow what is compared alike.
"""

from __future__ import annotations

import math
import time

import numpy as np
import torch
from peers import bare_embree
from relight_scenes import Scene
from torch import Tensor

from univoxel import brdf
from univoxel import envmap as env
from univoxel.ops import EnvTables, relight

OFFSET = 1e-3


def sample(tables: EnvTables, uniform: Tensor) -> tuple[Tensor, Tensor]:
    """Draw directions [N, 3] and give their density [N] per steradian.

    Args:
        uniform: [N, 2] in [0, 1): across and down the map.

    Source: Pharr, Jakob and Humphreys 2023, section A.5.
    """
    row, down = _invert(tables.row_cdf.expand(len(uniform), -1), uniform[:, 1])
    column, across = _invert(tables.column_cdf[row], uniform[:, 0])
    height, width, _ = tables.radiance.shape
    top, bottom = (torch.cos(math.pi * (row + i) / height) for i in (0, 1))
    z = top + down * (bottom - top)
    phi = math.pi - 2 * math.pi * (column + across) / width + tables.rotation
    radius = (1 - z * z).clamp_min(0).sqrt()
    direction = torch.stack([radius * phi.cos(), radius * phi.sin(), z], -1)
    return direction, tables.texel[row, column, 3]


def _invert(cdf: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
    """The interval of each row of cdf [N, n + 1] that holds u [N], and the place within it."""
    i = torch.searchsorted(cdf.contiguous(), u[:, None].contiguous(), right=True) - 1
    i = i.clamp(0, cdf.shape[1] - 2)
    low, high = cdf.gather(1, i)[:, 0], cdf.gather(1, i + 1)[:, 0]
    return i[:, 0], ((u - low) / (high - low).clamp_min(1e-30)).clamp_max(1 - 2**-24)


def ray_rates(scene: Scene, samples: int = 64, repeat: int = 9) -> dict:
    """Rays a second of one thread, in all and as a share of what bare Embree does."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    visibility, _, light, position, normal, wo, albedo, roughness = scene.ours
    direction, density = sample(light, _sobol(len(position), samples))
    direction = direction.view(-1, samples, 3)
    radiance = env.background(light, direction.reshape(-1, 3)).view_as(direction)
    above = ((direction * normal[:, None]).sum(-1) > 0) & (radiance.sum(-1) > 0)
    start = (position + OFFSET * normal)[:, None].expand_as(direction)[above]
    rays = (start + OFFSET * direction[above]).contiguous(), direction[above].contiguous()
    options = {"offset": OFFSET, "samples": samples, "bounces": 0, "strategy": "map"}

    def whole() -> Tensor:
        return relight(*scene.ours, **options)

    seen = torch.zeros(above.shape)
    seen[above] = 1 - visibility.occluded(*rays, 0.0).float()
    density = density.view_as(seen)
    f = torch.stack(
        [
            brdf.evaluate(n, o, wi, a, r.expand(samples))
            for n, o, wi, a, r in zip(normal, wo, direction, albedo, roughness, strict=True)
        ]
    )
    cosine = (direction * normal[:, None]).sum(-1).clamp_min(0)
    shaded = (f * radiance * (seen * cosine / density)[..., None]).mean(1)
    # Of tens of thousands of rays some fall on the other side of an edge by rounding.
    apart = float((shaded - whole()).norm() / shaded.norm())
    assert apart < 1e-2, f"these are not the integrator's rays: shading differs by {apart}"

    mesh = visibility.vertices, visibility.faces
    works = {
        "integrator": whole,
        "bare": bare_embree(*mesh, *rays, robust=True),
        "bare_packets": bare_embree(*mesh, *rays, robust=True, name="bare_occluded_8"),
    }
    times: dict[str, list[float]] = {name: [] for name in works}
    for _ in range(repeat):  # in turns: the machine's speed drifts
        for name, work in works.items():
            begin = time.process_time()
            work()
            times[name].append(time.process_time() - begin)
    torch.set_num_threads(threads)
    rates = {name: len(rays[0]) / sorted(t)[repeat // 2] for name, t in times.items()}
    return {
        "rays": len(rays[0]),
        "draws": above.numel(),
        "difference": apart,
        **rates,
        **{
            f"ratio_to_{name}": rates["integrator"] / rate
            for name, rate in rates.items()
            if name != "integrator"
        },
    }


def _sobol(points: int, samples: int) -> Tensor:
    """The integrator's numbers for the map at first vertices: [points * samples, 2], as sobol.h."""
    seed = _hash(np.arange(points, dtype=np.uint32), np.uint32(0))
    own = _hash(_hash(seed, np.uint32(0)), np.uint32(0))
    own = np.repeat(own, samples)
    index = np.tile(np.arange(samples, dtype=np.uint32), points)
    i = _reversed(_scrambled(_reversed(index), own))
    pascal = i.copy()
    for shift, mask in ((1, 0x55555555), (2, 0x33333333), (4, 0x0F0F0F0F), (8, 0x00FF00FF)):
        pascal ^= (pascal >> np.uint32(shift)) & np.uint32(mask)
    pascal ^= pascal >> np.uint32(16)
    both = [_reversed(_scrambled(x, _hash(own, np.uint32(k)))) for x, k in ((i, 1), (pascal, 2))]
    return torch.from_numpy(
        np.stack([(x >> np.uint32(8)).astype(np.float32) * np.float32(2**-24) for x in both], 1)
    )


def _hash(x: np.ndarray, y: np.uint32 | None = None) -> np.ndarray:
    if y is not None:
        x = x ^ _hash(np.array([(int(y) + 0x9E3779B9) % 2**32], np.uint32))
    for shift, factor in ((16, 0x7FEB352D), (15, 0x846CA68B)):
        x = (x ^ (x >> np.uint32(shift))) * np.uint32(factor)
    return x ^ (x >> np.uint32(16))


def _scrambled(x: np.ndarray, seed: np.ndarray) -> np.ndarray:
    x = x + seed
    for factor in (0x6C50B47C, 0xB82F1E52, 0xC7AFE638, 0x8D22F6E6):
        x = x ^ (x * np.uint32(factor))
    return x


def _reversed(x: np.ndarray) -> np.ndarray:
    """The bits in the other order."""
    bits = np.unpackbits(x.astype(">u4").view(np.uint8)).reshape(-1, 32)[:, ::-1]
    return np.packbits(np.ascontiguousarray(bits)).view(">u4").astype(np.uint32)
