"""Differentiable torch ops over native CPU kernels, each beside its eager reference."""

from univoxel.ops.composite import composite, composite_reference
from univoxel.ops.native import use_backend

__all__ = ["composite", "composite_reference", "use_backend"]
