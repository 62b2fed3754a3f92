"""Differentiable PyTorch ops with native CPU kernels and an eager reference for each."""

from univoxel.ops.compositing import (
    FieldAlongRays,
    composite,
    composite_field,
    composite_field_reference,
    composite_reference,
    section_alpha,
)
from univoxel.ops.grid import (
    sample_dense,
    sample_dense_reference,
    sample_sparse,
    sample_sparse_reference,
)
from univoxel.ops.hash_grid import encode_hash, encode_hash_reference
from univoxel.ops.integrator import EnvTables, PointLight, Sun, relight
from univoxel.ops.march import brick_minimum, march, march_reference
from univoxel.ops.native import NativeStatus, native_status, use_backend
from univoxel.ops.networks import mlp, mlp_reference
from univoxel.ops.patches import (
    match_cost,
    match_cost_reference,
    patch_correlation,
    patch_correlation_reference,
    semi_global,
    semi_global_reference,
)
from univoxel.ops.rows import adam_rows_, adam_rows_reference_, sum_rows, sum_rows_reference
from univoxel.ops.sg import decode_lobes, decode_lobes_reference, shade_sg, shade_sg_reference
from univoxel.ops.shade import (
    shade_map,
    shade_map_reference,
    shade_radiance,
    shade_radiance_reference,
    specular_response,
    specular_response_reference,
)
from univoxel.ops.smooth import (
    diffuse_rows_,
    diffuse_rows_reference_,
    smooth_rows_,
    smooth_rows_reference_,
)
from univoxel.ops.visibility import Hit, VisibilityScene, closest_hit_reference, occluded_reference

# fmt: off
__all__ = [
    "EnvTables", "FieldAlongRays", "Hit", "NativeStatus", "PointLight", "Sun", "VisibilityScene",
    "adam_rows_", "adam_rows_reference_", "brick_minimum", "closest_hit_reference", "composite",
    "composite_field", "composite_field_reference", "composite_reference", "decode_lobes",
    "decode_lobes_reference", "diffuse_rows_", "diffuse_rows_reference_", "encode_hash",
    "encode_hash_reference", "march", "march_reference", "match_cost", "match_cost_reference",
    "mlp", "mlp_reference", "native_status", "occluded_reference", "patch_correlation",
    "patch_correlation_reference", "relight", "sample_dense", "sample_dense_reference",
    "sample_sparse", "sample_sparse_reference", "section_alpha", "semi_global",
    "semi_global_reference", "shade_map", "shade_map_reference", "shade_radiance",
    "shade_radiance_reference", "shade_sg", "shade_sg_reference", "smooth_rows_",
    "smooth_rows_reference_", "specular_response", "specular_response_reference", "sum_rows",
    "sum_rows_reference", "use_backend",
]
# fmt: on
