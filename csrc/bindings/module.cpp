#include "bindings/common.h"

PYBIND11_MODULE(_core, m) {
    m.doc() = "Native kernels of univoxel: plain functions over contiguous buffers.";
    univoxel::bind_chart_ops(m);
    univoxel::bind_composite_ops(m);
    univoxel::bind_grid_ops(m);
    univoxel::bind_composite_field_ops(m);  // takes grids
    univoxel::bind_hash_grid_ops(m);
    univoxel::bind_march_ops(m);
    univoxel::bind_mlp_ops(m);
    univoxel::bind_rows_ops(m);
    univoxel::bind_sg_ops(m);
    univoxel::bind_shade_ops(m);
    univoxel::bind_stereo_ops(m);
    univoxel::bind_visibility_ops(m);
}
