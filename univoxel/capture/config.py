"""Sizes and thresholds of finding cameras."""

from __future__ import annotations

from dataclasses import dataclass

from univoxel.names import FEATURE_SIZE
from univoxel.validation import check_fields


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
    coarse_features: int = 512  # largest features that pairs are chosen by, >= 16
    # Photographs up to which so many are compared, >= 2: beyond, fewer of each, for the time of the
    # comparison grows with the square of photographs and of features
    coarse_photographs: int = 150
    ratio: float = 0.8  # of the distances to the best and second best feature, in (0, 1)
    partners: int = 16  # best ones of each photograph that are matched in full, >= 1
    neighbours: int = 3  # next ones by name, which are matched as well, >= 0
    mask_margin: float = 0.006  # that masks grow by before features are sought, of the longer side
    # Share of pairs whose match is a shift alone, from where on the background stands still while
    # the object turns: on a turntable it was .6, elsewhere 0, with poor masks .04
    still_share: float = 0.2
    weak_share: float = 0.2  # of the median number of points, below which a pose is not trusted
    # below which it is not trusted in any case, >= 0; and matches below which nothing is said of it
    weak_points: int = 50
    # It is trusted in spite of that with so many trusted partners at least, >= 1, and so large a
    # share of matches that fit, in (0, 1]: on a head placed right it was .95 and more, on the same
    # head before a still background .05 to .4
    weak_partners: int = 3
    fitting_share: float = 0.9
    fitting_pixels: float = 3.0  # up to which a match fits, > 0
    weak_doubt: float = 0.3  # degrees of its direction that its points may leave open, > 0
    contradicted_share: float = 0.5  # of matches that fit, below which no pose is trusted, [0, 1]
    placed_share: float = 0.8  # of the photographs, below which the capture is no use, in (0, 1]
    gap: float = 60.0  # degrees between neighbouring directions that are worth a word, > 0
    base_seconds: float = 120.0  # limit of one step, > 0; and for each photograph, > 0
    photograph_seconds: float = 30.0

    def __post_init__(self) -> None:
        check_fields(self, "at least 64", lambda x: x >= 64, "size", "features")
        check_fields(self, "at least -1", lambda x: x >= -1, "first_octave")
        check_fields(self, "at least 2", lambda x: x >= 2, "exhaustive", "coarse_photographs")
        check_fields(self, "at least 16", lambda x: x >= 16, "coarse_features")
        check_fields(self, "at least 1", lambda x: x >= 1, "partners", "weak_partners")
        check_fields(self, "at least 0", lambda x: x >= 0, "neighbours", "weak_points", "seed")
        check_fields(self, "in (0, 1)", lambda x: 0 < x < 1, "ratio")
        check_fields(
            self, "in (0, 1]", lambda x: 0 < x <= 1, "still_share", "placed_share", "fitting_share"
        )
        check_fields(self, "in [0, 1]", lambda x: 0 <= x <= 1, "contradicted_share")
        check_fields(self, "above 0", lambda x: x > 0, "fitting_pixels", "weak_doubt")
        check_fields(self, "in [0, 0.5)", lambda x: 0 <= x < 0.5, "mask_margin", "weak_share")
        check_fields(self, "above 0", lambda x: x > 0, "gap", "base_seconds", "photograph_seconds")


DEFAULTS = CaptureConfig()
FAST = CaptureConfig(features=2048, first_octave=0)
