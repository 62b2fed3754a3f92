"""What may be chosen of finding cameras."""

from __future__ import annotations

from dataclasses import dataclass

from univoxel.core.choices import FEATURE_SIZE
from univoxel.core.validation import check_fields


@dataclass(frozen=True)
class CaptureConfig:
    """How cameras are found from photographs.

    Raises:
        ConfigError: a field is out of range.
    """

    size: int = FEATURE_SIZE  # pixels along the longer side in which features are sought, >= 64
    features: int = 4096  # largest number of a photograph, >= 64
    # Octave of the scale space that features begin in: -1 doubles the picture first. 0 costs a
    # quarter and loses photographs of smooth objects
    first_octave: int = -1
    seed: int = 0  # of all random choices
    # Up to so many photographs all pairs are matched, >= 2; beyond, those chosen by a coarse look
    exhaustive: int = 24
    partners: int = 16  # best ones of each photograph that are matched in full, >= 1

    def __post_init__(self) -> None:
        check_fields(self, "at least 64", lambda x: x >= 64, "size", "features")
        check_fields(self, "at least -1", lambda x: x >= -1, "first_octave")
        check_fields(self, "at least 0", lambda x: x >= 0, "seed")
        check_fields(self, "at least 2", lambda x: x >= 2, "exhaustive")
        check_fields(self, "at least 1", lambda x: x >= 1, "partners")


DEFAULTS = CaptureConfig()
FAST = CaptureConfig(features=2048, first_octave=0)
