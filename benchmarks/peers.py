"""The same work in other packages, where they are installed: forward and backward.

A package is imported by the function that sets its work up, which runs in a process of its own.
"""

from __future__ import annotations

import ctypes
import importlib.metadata
import importlib.util
from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor

from univoxel import ops
from univoxel.core.records import Samples

Peers = dict[str, Callable[[], Callable[[], object]]]  # by name: sets up and returns the work


def _there(package: str) -> bool:
    return importlib.util.find_spec(package) is not None


def versions() -> dict[str, str]:
    """Of the peers that are there."""
    return {name: importlib.metadata.version(name) for name in ("jax", "drjit") if _there(name)}


# Built by `make bench`: CMake's option UNIVOXEL_BENCHMARKS.
BARE_EMBREE = Path(__file__).parent.parent / "build" / "libbare_embree.so"


def occluded(vertices: Tensor, faces: Tensor, origin: Tensor, direction: Tensor) -> Peers:
    """rtcOccluded1 in a bare loop, on the same kind of scene and without its ROBUST flag, which
    lets rays through between triangles."""
    if not BARE_EMBREE.exists():
        return {}
    rays = (vertices, faces, origin, direction)
    return {
        "bare rtcOccluded1": lambda: bare_embree(*rays, robust=True),
        "bare rtcOccluded1, not robust": lambda: bare_embree(*rays, robust=False),
    }


def bare_embree(
    vertices: Tensor,  # [P, 3] float32
    faces: Tensor,  # [F, 3] int32
    origin: Tensor,  # [N, 3] float32, contiguous
    direction: Tensor,  # [N, 3]
    robust: bool,
    name: str = "bare_occluded",
) -> Callable[[], object]:
    """Work that asks which rays meet something, by a function of bare_embree.cpp."""
    library = ctypes.CDLL(str(BARE_EMBREE))
    library.bare_scene.restype = ctypes.c_void_p
    out = torch.empty(len(origin), dtype=torch.bool)

    def pointer(tensor: Tensor) -> ctypes.c_void_p:
        return ctypes.c_void_p(tensor.data_ptr())

    scene = ctypes.c_void_p(
        library.bare_scene(
            pointer(vertices),
            ctypes.c_int64(len(vertices)),
            pointer(faces),
            ctypes.c_int64(len(faces)),
            ctypes.c_int(robust),
        )
    )
    rays = (pointer(origin), pointer(direction), ctypes.c_int64(len(origin)), pointer(out))
    threads = ctypes.c_int(torch.get_num_threads())
    kept = (origin, direction, out)  # pointers keep nothing alive
    return lambda: (getattr(library, name)(scene, *rays, threads), kept)


def composite(alpha: Tensor, value: Tensor, n_rays: int) -> Peers:
    """Rays of one length: JAX gets the dense form, which suits it best."""
    return {"JAX": lambda: _jax_composite(alpha, value, n_rays)} if _there("jax") else {}


def _jax_composite(alpha: Tensor, value: Tensor, n_rays: int):
    import jax
    import jax.numpy as jnp

    a = jnp.asarray(alpha.detach().numpy()).reshape(n_rays, -1)
    v = jnp.asarray(value.detach().numpy()).reshape(*a.shape, -1)

    def loss(a, v, seed, weight_seed):
        trans = jnp.cumprod(1 - a, 1)
        weight = a * jnp.concatenate([jnp.ones_like(a[:, :1]), trans[:, :-1]], 1)
        out = (weight[..., None] * v).sum(1)
        return (out * seed).sum() + (weight * weight_seed).sum()

    run = jax.jit(jax.grad(loss, (0, 1)))
    seeds = jnp.ones((n_rays, v.shape[-1])), jnp.ones_like(a)
    return lambda: jax.block_until_ready(run(a, v, *seeds))


def composite_field(
    tensors: tuple[Tensor, ...], samples: Samples, start: list[float], h: float, inv_s: float
) -> Callable[[], object]:
    """Distances, gradients and features composited by ops of this package, one after the other."""
    sdf, features, origin, direction = tensors

    def work() -> object:
        ray = torch.repeat_interleave(samples.offsets.diff())
        points = origin[ray] + samples.t[:, None] * direction[ray]
        value, gradient, feature = ops.sample_dense(
            sdf, features, points, start, h, sparse_grad=True
        )
        alpha = ops.section_alpha(value, samples.connected, inv_s)
        read = torch.cat([samples.t[:, None], gradient, feature], 1)
        between = (read + read.roll(-1, 0)) / 2  # the last section of a ray has no weight
        total, weight = ops.composite(alpha, between, samples.offsets)
        return torch.autograd.grad(total.sum() + weight.sum(), tensors)

    return work


def sample_dense(sdf: Tensor, features: Tensor, points: Tensor, h: float) -> Peers:
    """Value, central differences over one voxel and features, with dense gradients."""
    found: Peers = {}
    if _there("jax"):
        found["JAX"] = lambda: _jax_sample_dense(sdf, features, points, h)
    if _there("drjit"):
        found["Dr.Jit"] = lambda: _drjit_sample_dense(sdf, features, points, h)
    return found


def _jax_sample_dense(sdf: Tensor, features: Tensor, points: Tensor, h: float):
    import jax
    import jax.numpy as jnp

    f, c = (jnp.asarray(t.detach().numpy()) for t in (sdf, features))
    p = jnp.asarray(points.numpy())

    def lookup(grid, x):
        x = jnp.clip(x / h, 0, grid.shape[0] - 1)
        i = jnp.minimum(x.astype(jnp.int32), grid.shape[0] - 2)
        t = (x - i).reshape(len(x), 3, *[1] * (grid.ndim - 3))
        total = 0.0
        for corner in range(8):
            d = [(corner >> k) & 1 for k in range(3)]
            w = 1.0
            for k in range(3):
                w = w * (t[:, k] if d[k] else 1 - t[:, k])
            total += w * grid[i[:, 0] + d[0], i[:, 1] + d[1], i[:, 2] + d[2]]
        return total

    def loss(f, c):
        total = lookup(f, p).sum() + lookup(c, p).sum()
        for k in range(3):
            e = h * jnp.eye(3)[k]
            total += (k + 1) * (lookup(f, p + e) - lookup(f, p - e)).sum()
        return total

    run = jax.jit(jax.grad(loss, (0, 1)))
    return lambda: jax.block_until_ready(run(f, c))


def _drjit_sample_dense(sdf: Tensor, features: Tensor, points: Tensor, h: float):
    import drjit
    from drjit.auto import ad

    drjit.set_thread_count(torch.get_num_threads())
    n = sdf.shape[0]
    f = ad.TensorXf(sdf.detach().numpy()[..., None])
    c = ad.TensorXf(features.detach().numpy())
    p = ad.Array3f(*points.numpy().T)
    # Texel centres stand at half texels, and Dr.Jit's x is the fastest axis.
    to_texture = [(p[2 - k] / h + 0.5) / n for k in range(3)]

    def run():
        drjit.enable_grad(f)
        drjit.enable_grad(c)
        values = ad.Texture3f(f, migrate=False, use_accel=False)
        colors = ad.Texture3f(c, migrate=False, use_accel=False)
        place = ad.Array3f(*to_texture)
        total = drjit.sum(values.eval(place)[0])
        for channel in colors.eval(place):
            total += drjit.sum(channel)
        for k in range(3):
            e = ad.Array3f(0)
            e[k] = 1 / n
            total += (k + 1) * drjit.sum(values.eval(place + e)[0] - values.eval(place - e)[0])
        drjit.backward(total)
        drjit.eval(drjit.grad(f), drjit.grad(c))
        drjit.sync_thread()
        drjit.disable_grad(f)
        drjit.disable_grad(c)

    return run
