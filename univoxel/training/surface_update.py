"""How fields are descended on: what every stage that moves a surface does beside its losses."""

from __future__ import annotations

from univoxel.config import StageConfig
from univoxel.fields.field import Field
from univoxel.optim import rows_of

SPREAD = 0.8  # share of the neighbours' mean that a node's gradient takes on in a pass
MOMENTS = (0.9, 0.99)
# Adam's epsilon for the grids. Far above 0 on purpose: a node's gradient is then scaled by the
# batch, not by its own history, and nodes that few rays see do not jump.
EPS_SDF, EPS_FEATURES = 1e-4, 1e-8


def smooth_sdf_gradient_(field: Field, passes: int) -> None:
    """Diffuse the sdf's gradient over the nodes that it touches, before Adam sees it: the surface
    then moves in large pieces, far and without the bumps that steps of single nodes leave. Nodes
    that are pinned get none."""
    grad = field.sdf.grad
    assert grad is not None
    rows, pinned = rows_of(grad), field.distances.pinned
    field.distances.diffuse_rows_(grad._values(), rows, SPREAD, passes)
    if pinned is not None:
        grad._values()[pinned.flatten()[rows]] = 0


def smooth_touched_(field: Field, stage: StageConfig, every: int) -> None:
    """Regularise the nodes that the step has touched, beside the optimiser and not inside it.

    Args:
        every: steps between two calls, for which each makes up.
    """
    sdf, features = field.sdf, field.features
    assert sdf.grad is not None
    assert features.grad is not None
    plate, diffusion = stage.plate * every, stage.diffusion * every
    field.distances.smooth_rows_(sdf.detach(), rows_of(sdf.grad), plate, order=2)
    field.encoding.smooth_(field.distances, rows_of(features.grad), diffusion)


def geometric(ends: tuple[float, float], done: float) -> float:
    """Geometric interpolation."""
    return ends[0] * (ends[1] / ends[0]) ** done
