"""Fields that configurations had, which files of earlier versions hold still and nothing reads."""

from __future__ import annotations

from typing import Any

# By class. What they said is a constant now, beside the code that uses it, or gone with that code
RETIRED: dict[str, frozenset[str]] = {
    "TrainConfig": frozenset({"compression", "confidence", "hollows", "preparation"}),
    "LossConfig": frozenset({"albedo_smoothness", "roughness_smoothness"}),
    "StageConfig": frozenset({"lr_poses"}),
    "JointConfig": frozenset(
        "adam albedo_smoothness metallic newton roughness_smoothness surface trials".split()
    ),
    "MetalConfig": frozenset(
        (
            "alike base max_evidence metallic_before near neighbours only_metal_albedo roughness "
            "steps threshold"
        ).split()
    ),
    "MirrorConfig": frozenset(
        (
            "alike around change darkest flat min_cosine min_reflectance min_views neighbours "
            "reflected reflected_at_most sharp turn turns views voters weight"
        ).split()
    ),
    "EntropyConfig": frozenset(
        (
            "albedo albedo_views cell degree min_color min_gain min_paint min_points min_reach "
            "min_sky min_views points steps sun_gain sun_shares sweeps teaching_weight"
        ).split()
    ),
}


def without_retired(kind: Any, values: dict[str, Any]) -> dict[str, Any]:
    """What a file holds of a configuration, but for fields that its class no longer has."""
    gone = RETIRED.get(kind.__name__, frozenset())
    return {name: value for name, value in values.items() if name not in gone}
