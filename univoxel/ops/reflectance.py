"""F0 as the shading kernels take it: one tensor, a colour a point or a number for all."""

from __future__ import annotations

from torch import Tensor


def sizes_of_f0(f0: Tensor | float) -> dict[str, tuple[Tensor, str]]:
    """What ops.checks.check needs to know of it: nothing of a number."""
    return {"f0": (f0, "N 3")} if isinstance(f0, Tensor) else {}


def stored_f0(op: str, f0: Tensor | float, like: Tensor) -> Tensor:
    """[N, 3] as it came, or a number as a tensor [] of the dtype of ``like``.

    Raises:
        TypeError: neither a tensor nor a number.
        ValueError: a number outside [0, 1].
    """
    if isinstance(f0, Tensor):
        return f0
    if not isinstance(f0, int | float):
        raise TypeError(f"{op}: f0 must be a number or a tensor, got {type(f0).__name__}")
    if not 0.0 <= f0 <= 1.0:
        raise ValueError(f"{op}: f0 must be in [0, 1], got {f0}")
    return like.new_full((), f0)
