"""Ray tracing against a triangle mesh: occlusion between a point and the light."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from univoxel.ops import native
from univoxel.ops.differentiable import check


@dataclass(frozen=True)
class Hit:
    """The nearest triangle along each of N rays."""

    t: Tensor  # [N] float32, along the ray in units of its direction; infinity: nothing is hit
    face: Tensor  # [N] int64; -1: nothing is hit
    barycentric: Tensor  # [N, 2] float32 (u, v): the point is (1 - u - v) p0 + u p1 + v p2


class VisibilityScene:
    """A triangle mesh for ray tracing: an Embree hierarchy, built once.

    Args:
        vertices: [P, 3] float32, world; on the CPU.
        faces: [F, 3] int32 or int64 rows of vertex indices. If F is 0, nothing is hit.

    Raises:
        TypeError, ValueError: an argument is no tensor, or of another size, dtype or device than
            above; a vertex is not finite; a face has the index of a vertex that does not exist.
        RuntimeError: the compiled extension is missing or was built without Embree; within
            ``use_backend("reference")`` neither is needed.

    The triangles are copied: changing the tensors later does not move the mesh. Queries run on
    torch.get_num_threads() threads and carry no gradients.
    Source: Wald et al. 2014, "Embree: a kernel framework for efficient CPU ray tracing".
    """

    def __init__(self, vertices: Tensor, faces: Tensor) -> None:
        if isinstance(faces, Tensor) and faces.dtype == torch.int64:
            _check_indices(faces, vertices)  # before narrowing wraps them around
            faces = faces.int()
        check(
            "VisibilityScene",
            vertices=(vertices, "P 3", torch.float32),
            faces=(faces, "F 3", torch.int32),
        )
        if vertices.device.type != "cpu":
            raise ValueError(f"VisibilityScene: vertices must be on the cpu, got {vertices.device}")
        if not bool(vertices.isfinite().all()):
            row = int((~vertices.isfinite().all(1)).nonzero()[0])
            raise ValueError(
                f"VisibilityScene: vertices must be finite, got {vertices[row].tolist()} in row "
                f"{row}"
            )
        _check_indices(faces, vertices)
        self.vertices: Tensor = vertices.detach().clone().contiguous()  # [P, 3]
        self.faces: Tensor = faces.detach().clone().contiguous()  # [F, 3]
        self._native = None
        self.native()

    def occluded(
        self,
        origin: Tensor,  # [N, 3]
        direction: Tensor,  # [N, 3]
        t_min: float = 0.0,
        t_max: float = float("inf"),
    ) -> Tensor:
        """Whether a triangle lies along each ray at t in [t_min, t_max].

        Args:
            origin: [N, 3] float32, world.
            direction: [N, 3] float32, whose length is the unit of t. A ray that is not finite hits
                nothing.
            t_min, t_max: nearer and farther triangles are ignored; 0 <= t_min <= t_max.

        Returns:
            [N] bool.

        Raises:
            TypeError, ValueError: an argument is no tensor, or of another size, dtype or device;
                t_min and t_max are out of order.
        """
        _check_rays("occluded", origin, direction, t_min, t_max)
        scene = self.native()
        if scene is None:
            return occluded_reference(self.vertices, self.faces, origin, direction, t_min, t_max)
        out = torch.empty(len(origin), dtype=torch.bool)
        native.call(scene.occluded, origin.contiguous(), direction.contiguous(), out, t_min, t_max)
        return out

    def closest_hit(
        self,
        origin: Tensor,  # [N, 3]
        direction: Tensor,  # [N, 3]
        t_min: float = 0.0,
        t_max: float = float("inf"),
    ) -> Hit:
        """The nearest triangle along each ray; arguments and errors as in `occluded`."""
        _check_rays("closest_hit", origin, direction, t_min, t_max)
        scene = self.native()
        if scene is None:
            return closest_hit_reference(self.vertices, self.faces, origin, direction, t_min, t_max)
        hit = Hit(
            origin.new_empty(len(origin)),
            torch.empty(len(origin), dtype=torch.int64),
            origin.new_empty(len(origin), 2),
        )
        rays, filled = (origin, direction), (hit.t, hit.face, hit.barycentric)
        native.call(scene.closest_hit, *(r.contiguous() for r in rays), *filled, t_min, t_max)
        return hit

    def native(self) -> Any:
        """The native scene, for ops that trace rays; None within use_backend("reference")."""
        if native.reference_asked():
            return None
        if self._native is None:
            core = native.require_embree('VisibilityScene outside of use_backend("reference")')
            self._native = native.call(core.VisibilityScene, self.vertices, self.faces)
        return self._native


def occluded_reference(
    vertices: Tensor,
    faces: Tensor,
    origin: Tensor,
    direction: Tensor,
    t_min: float = 0.0,
    t_max: float = float("inf"),
) -> Tensor:
    """`VisibilityScene.occluded` in eager torch: every ray against every triangle."""
    return closest_hit_reference(vertices, faces, origin, direction, t_min, t_max).face >= 0


def closest_hit_reference(
    vertices: Tensor,
    faces: Tensor,
    origin: Tensor,
    direction: Tensor,
    t_min: float = 0.0,
    t_max: float = float("inf"),
) -> Hit:
    """`VisibilityScene.closest_hit` in eager torch.

    Source: Moeller and Trumbore 1997, "Fast, minimum storage ray/triangle intersection".
    """
    n = len(origin)
    t = origin.new_full((n,), float("inf"))
    face = torch.full((n,), -1)
    barycentric = origin.new_zeros(n, 2)
    if not len(faces) or not n:
        return Hit(t, face, barycentric)
    p0, p1, p2 = vertices[faces.long()].unbind(1)
    e1, e2 = p1 - p0, p2 - p0
    rays = max(1, 2_000_000 // len(faces))  # pairs held at a time, some 100 MB
    for s in (slice(i, i + rays) for i in range(0, n, rays)):
        o, d = origin[s, None], direction[s, None]
        q = torch.linalg.cross(d.expand(-1, len(e2), -1), e2.expand(len(d), -1, -1))
        det = (q * e1).sum(-1)
        r = torch.linalg.cross(o - p0, e1.expand(len(o), -1, -1))
        u = ((o - p0) * q).sum(-1) / det
        v = (d * r).sum(-1) / det
        at = (e2 * r).sum(-1) / det
        # Comparisons with NaN are false: a degenerate triangle or ray meets nothing.
        met = (det != 0) & (u >= 0) & (v >= 0) & (u + v <= 1) & (at >= t_min) & (at <= t_max)
        at = torch.where(met, at, torch.inf)
        t[s], nearest = at.min(1)
        row = torch.arange(len(nearest))
        hit = met[row, nearest]
        face[s] = torch.where(hit, nearest, -1)
        uv = torch.stack([u[row, nearest], v[row, nearest]], -1)
        barycentric[s] = torch.where(hit[:, None], uv, 0.0)
    return Hit(t, face, barycentric)


def _check_indices(faces: Tensor, vertices: Tensor) -> None:
    if faces.numel() and (int(faces.min()) < 0 or int(faces.max()) >= len(vertices)):
        raise ValueError(
            f"VisibilityScene: faces must index the {len(vertices)} vertices, got indices "
            f"{int(faces.min())} to {int(faces.max())}"
        )


def _check_rays(op: str, origin: Tensor, direction: Tensor, t_min: float, t_max: float) -> None:
    check(op, origin=(origin, "N 3", torch.float32), direction=(direction, "N 3", torch.float32))
    if origin.device.type != "cpu":
        raise ValueError(f"{op}: rays must be on the cpu, got {origin.device}")
    if not 0 <= t_min <= t_max:
        raise ValueError(f"{op}: 0 <= t_min <= t_max must hold, got {t_min} and {t_max}")
