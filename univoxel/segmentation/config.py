"""Thresholds and lengths of telling an object from its surroundings."""

from __future__ import annotations

from dataclasses import dataclass

from univoxel.validation import check_fields


@dataclass(frozen=True)
class VoteConfig:
    """How masks vote for a hull, and which of them it mends.

    Raises:
        ConfigError: a field is out of range.
    """

    photographs: int = 12  # at least, for a vote; fewer do not outvote one another
    pixels: int = 192  # of the longer side of the pictures that are compared, >= 16
    voxels: int = 96  # along a side of the grid, >= 8; finer ones cost more and mend no better
    first_voxels: int = 40  # of the grid that only looks where the object is, >= 8
    room: float = 1.6  # sides of that grid, in those of what half of the pictures show whole, > 0
    around: float = 0.5  # of its largest vote: what may be the object, in (0, 1)
    # Share of the photographs that have to see a voxel, in (0, 1]: what few see, few decide on
    seen_by: float = 0.25
    # Votes from which on a voxel may belong to the hull, both in (0, 1). The best depends on how
    # many masks are wrong: it is searched
    lowest: float = 0.3
    highest: float = 0.99
    # IoU below the median's, from where on a mask is wrong, in (0, 1). As much of it has to be more
    # than a pixel off
    below: float = 0.08
    # IoU with its silhouette below which a mask is wrong whatever the others have, in (0, 1). If
    # more than half are, it is the hull that is wrong
    least: float = 0.75
    # Gaps that few masks see through, and a vote fills
    gap_pixel: float = 1.5  # voxels, of the pixels in which they are looked for, >= 1
    smallest_gap: float = 0.002  # of the silhouette's area, in [0, 1]
    gap_rounds: int = 3  # through all photographs, at most, >= 0; one gap may open the next
    band: float = 1.5  # voxels beside the silhouette within which a mended mask is kept, > 0

    def __post_init__(self) -> None:
        check_fields(self, "at least 2", lambda x: x >= 2, "photographs")
        check_fields(self, "at least 16", lambda x: x >= 16, "pixels")
        check_fields(self, "at least 8", lambda x: x >= 8, "voxels", "first_voxels")
        check_fields(self, "at least 1", lambda x: x >= 1, "gap_pixel")
        check_fields(self, "at least 0", lambda x: x >= 0, "gap_rounds")
        check_fields(self, "in [0, 1]", lambda x: 0 <= x <= 1, "smallest_gap")
        check_fields(self, "above 0", lambda x: x > 0, "room", "band")
        check_fields(self, "in (0, 1]", lambda x: 0 < x <= 1, "seen_by")
        open_ones = ("around", "lowest", "highest", "below", "least")
        check_fields(self, "in (0, 1)", lambda x: 0 < x < 1, *open_ones)


@dataclass(frozen=True)
class GroundConfig:
    """How the plane under an object is found, and taken off.

    Raises:
        ConfigError: a field is out of range.
    """

    pixels: int = 480  # of the widest picture that is compared, >= 16
    views: int = 40  # pictures that plane and its picture are found from, about; >= 2
    # The search for the plane
    heights: int = 61  # that are tried, >= 2
    searched: float = 1.5  # half width of the square looked at, in those of what is looked at, > 0
    points: int = 48  # along its sides, >= 2
    blurs: tuple[float, ...] = (4.0, 2.0, 1.0)  # pixels, from coarse to fine, > 0
    trials: int = 60  # of planes at each of them, >= 1
    seen: int = 4  # pictures in which a point has to be, >= 1
    seen_share: float = 0.25  # of the pictures, and of the points; in (0, 1)
    hidden: float = 0.4  # quantile of the points that counts, in (0, 1): the object hides others
    noise: float = 0.02  # sRGB, of what plain surfaces differ by, > 0
    # Of the median's over all heights, that the least disagreement may have, in (0, 1): .1 on a
    # patterned floor
    clearly: float = 0.4
    # Disagreement between pictures over that between points, at most, > 0: .07 on that floor
    agree: float = 0.35
    # Its picture
    # Half of the picture's places are within so many half widths of what is looked at, > 0; the
    # others are the wider, the farther away
    near: float = 2.0
    side: int = 512  # places along it, >= 2
    blur: float = 1.0  # pixels, of pictures that are compared with it, > 0
    candidates: int = 20  # pictures whose colour others are asked to share, about; >= 1
    tolerance: float = 0.08  # sRGB, within which colours are alike, > 0
    alike: float = 0.3  # of the pictures that see a place: so many share its colour, in (0, 1)
    above: float = 0.15  # half widths of what is looked at, by which a place is lifted, > 0
    # Times as many pictures share its colour as then, >= 1: what has one colour has no height
    better: float = 1.25
    patch: int = 5  # pixels along a square whose majority decides, odd, >= 1
    # The object on it
    voxels: int = 64  # along the sides of the hull's box, about; >= 8
    rough: int = 96  # pixels of the longer side of the pictures that make it, >= 8
    # Share of the pictures that see no floor behind a node, all in (0, 1): from `first` on what
    # hangs together is the object, and the silhouettes that agree best are of one in between
    first: float = 0.9
    lowest: float = 0.7
    highest: float = 0.98
    certain: float = 0.96  # from which on it is the object's whatever a picture shows
    band: int = 4  # of those pixels, beside the first silhouette, that are compared; >= 1
    overlap: float = 0.85  # median IoU with the hull from which on masks are believed, in (0, 1)
    speck: float = 0.005  # of the mask's area, >= 0: smaller parts and holes are none

    def __post_init__(self) -> None:
        check_fields(self, "at least 16", lambda x: x >= 16, "pixels")
        check_fields(self, "at least 8", lambda x: x >= 8, "voxels", "rough")
        check_fields(self, "at least 2", lambda x: x >= 2, "views", "heights", "points", "side")
        check_fields(
            self, "at least 1", lambda x: x >= 1, "trials", "seen", "candidates", "band", "better"
        )
        check_fields(self, "odd and at least 1", lambda x: x >= 1 and x % 2 == 1, "patch")
        positive = ("searched", "noise", "agree", "near", "blur", "tolerance", "above")
        check_fields(self, "above 0", lambda x: x > 0, *positive)
        check_fields(self, "at least 0", lambda x: x >= 0, "speck")
        shares = ("seen_share", "hidden", "clearly", "alike", "overlap")
        shares += ("first", "lowest", "highest", "certain")
        check_fields(self, "in (0, 1)", lambda x: 0 < x < 1, *shares)
        check_fields(
            self, "one or more numbers above 0", lambda x: len(x) > 0 and min(x) > 0, "blurs"
        )
