"""What may be chosen of finding cameras."""

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
        FEATURE_SIZE, "along the longer side in which features are sought", unit="pixels", least=64
    )
    features: int = setting(4096, "largest number of a photograph", least=64)
    first_octave: int = setting(
        -1,
        "octave of the scale space that features begin in: -1 doubles the picture first. 0 costs a "
        "quarter and loses photographs of smooth objects",
        least=-1,
    )
    seed: int = setting(0, "of all random choices", least=0)
    exhaustive: int = setting(
        24,
        "up to so many photographs all pairs are matched; beyond, those chosen by a coarse look",
        least=2,
    )
    partners: int = setting(16, "best ones of each photograph that are matched in full", least=1)

    __post_init__ = check_settings


DEFAULTS = CaptureConfig()
FAST = CaptureConfig(features=2048, first_octave=0)
