"""Differentiable torch ops over native CPU kernels, each beside its eager reference."""

from univoxel.ops.adam import adam_rows_, adam_rows_reference_
from univoxel.ops.composite import composite, composite_reference
from univoxel.ops.dense_grid import sample_dense, sample_dense_reference
from univoxel.ops.native import use_backend

__all__ = [
    "adam_rows_",
    "adam_rows_reference_",
    "composite",
    "composite_reference",
    "sample_dense",
    "sample_dense_reference",
    "use_backend",
]
