"""What a budget of bytes has room for."""

import pytest
from analytic import sphere_scene

from univoxel.compression import sizes
from univoxel.compression.config import CompressionConfig
from univoxel.fields.features import FEWEST_ROWS, ROWS
from univoxel.scene import SceneConfig

CFG = CompressionConfig()


def test_a_budget_too_small_for_anything():
    with pytest.raises(ValueError, match=r"budget_mb: 0.001 is too small for anything: .* need 0"):
        sizes.check_budget(sphere_scene(16), 0.001, CFG)
    sizes.check_budget(sphere_scene(16), 1.0, CFG)


@pytest.mark.parametrize(
    ("megabytes", "levels"), [(None, 5), (40.0, 5), (1.0, 3), (0.3, 2), (0.02, 1)]
)
def test_a_budget_leaves_room_for_some_mirror_levels(megabytes, levels):
    assert sizes.mirror_levels(SceneConfig(), megabytes, CFG) == levels
    assert sizes.mirror_levels(SceneConfig(mirror_levels=1), megabytes, CFG) == 1


@pytest.mark.parametrize(
    ("megabytes", "rows"), [(None, 128), (40.0, 128), (1.0, 64), (0.3, 32), (0.02, 0)]
)
def test_a_budget_leaves_room_for_some_rows_of_the_map(megabytes, rows):
    assert sizes.sky_rows(128, megabytes, CFG) == rows
    assert sizes.sky_rows(32, megabytes, CFG) == min(rows, 32)
    assert sizes.sky_rows(0, megabytes, CFG) == 0


def test_a_budget_decides_on_the_rows_of_a_hash_table():
    scene = SceneConfig()  # 16 channels: 8 levels
    assert sizes.table_rows(scene, None, CFG) == ROWS
    assert sizes.table_rows(scene, 100.0, CFG) == ROWS
    assert sizes.table_rows(scene, 1.0, CFG) == 2**12  # 8 levels of 8 bytes a row: half of 0.5 MB
    assert sizes.table_rows(scene, 1e-3, CFG) == FEWEST_ROWS
