"""Settings of the search for cameras."""

from __future__ import annotations

from dataclasses import dataclass

from univoxel.core.choices import FEATURE_SIZE
from univoxel.core.validation import check_settings, setting


@dataclass(frozen=True)
class CaptureConfig:
    """How cameras are found from photographs.

    Raises:
        ConfigError: a field is out of range.
    """

    size: int = setting(
        FEATURE_SIZE, "longer side of the images for feature detection", unit="pixels", least=64
    )
    features: int = setting(4096, "maximum number of features per photograph", least=64)
    first_octave: int = setting(
        -1,
        "first octave of the scale space; -1: images are enlarged twofold first; 0: this takes a "
        "quarter of the time, but may lose photographs of smooth objects",
        least=-1,
    )
    seed: int = setting(0, "random seed", least=0)
    exhaustive: int = setting(
        24,
        "up to this number of photographs, match all pairs; with more, match only similar pairs",
        least=2,
    )
    partners: int = setting(16, "number of similar photographs to match with each one", least=1)

    __post_init__ = check_settings


DEFAULTS = CaptureConfig()
FAST = CaptureConfig(features=2048, first_octave=0)
