"""The constants of compression: their ranges, --set, and config.json."""

import json
from dataclasses import asdict

import pytest

from univoxel.checkpoint import SHELL
from univoxel.compression.config import CompressionConfig
from univoxel.config import save_config
from univoxel.overrides import changed
from univoxel.presets import preset


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("fewest_voxels", 7, "at least 8, got 7"),
        ("grid_stride", 1.0, r"in \(0, 1\), got 1"),
        ("rehearsal_share", 0.0, r"in \(0, 1\), got 0"),
        ("tolerance_db", -0.1, "at least 0, got -0.1"),
        ("least_head_share", 1.5, r"in \[0, 1\], got 1.5"),
        ("calibration_rays", 0, "at least 1, got 0"),
        ("settle_rate", 0.0, "above 0, got 0"),
        ("table_share", 0.0, r"in \(0, 1\], got 0"),
        ("size_shares", (), "fall from 1 and stay above 0"),
        ("size_shares", (0.5, 0.25), "fall from 1 and stay above 0"),
        ("size_shares", (1.0, 0.5, 0.75), "fall from 1 and stay above 0"),
        ("reaches", (SHELL, 2.0), r"in \(0, 4\) that fall"),
        ("reaches", (2.0, 0.0), r"in \(0, 4\) that fall"),
        ("dropped_row_shares", (0.5, 0.75), "rise from 0 and stay below 1"),
        ("dropped_row_shares", (0.0, 0.5, 1.0), "rise from 0 and stay below 1"),
    ],
)
def test_values_out_of_range_are_refused(name, value, message):
    with pytest.raises(ValueError, match=f"CompressionConfig: {name} must be .*{message}"):
        CompressionConfig(**{name: value})


def test_constants_are_set_by_their_path_and_recorded(tmp_path):
    changes = ["compression.tolerance_db=0.1", "compression.reaches=(2.0, 1.0)"]
    cfg = changed(preset("draft", tmp_path, tmp_path / "run"), changes)
    assert cfg.compression == CompressionConfig(tolerance_db=0.1, reaches=(2.0, 1.0))
    cfg.out.mkdir()
    save_config(cfg)
    recorded = json.loads((cfg.out / "config.json").read_text())["compression"]
    assert recorded == asdict(cfg.compression) | {
        name: list(getattr(cfg.compression, name))
        for name in ("reaches", "size_shares", "dropped_row_shares")
    }
