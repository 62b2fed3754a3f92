"""Pictures that a data set lists and does not have: left out, as long as enough remain."""

from __future__ import annotations

import logging
from collections.abc import Sequence

from univoxel.errors import DataError

FEWEST = 3  # photographs that must be there where one is missing: a shape needs that many views
SHARE = 0.5  # of those listed that must be there: with less, it is the names that are wrong
NAMED = 3  # missing pictures that messages name, at most

log: logging.Logger = logging.getLogger("univoxel")


def left_out(where: str, missing: Sequence[object], listed: int, note: str = "") -> list[str]:
    """What is to be said of pictures that are not there; a warning in the log says which.

    Args:
        where: what lists them, for messages.
        missing: their names or paths.
        listed: pictures, those that are there and those that are not.
        note: where they were looked for, for the error.

    Raises:
        DataError: fewer than FEWEST of the pictures are there, or than SHARE of them.
    """
    if not missing:
        return []
    names = ", ".join(map(str, missing[:NAMED])) + (", ..." if len(missing) > NAMED else "")
    count = f"{len(missing)} of {listed}"
    if listed - len(missing) < max(FEWEST, SHARE * listed):
        raise DataError(
            f"{where}: no picture {names}: {count} are missing, expected half of them at least, "
            f"and {FEWEST}{note}"
        )
    log.warning("%s: no picture %s: %s left out", where, names, count)
    return [f"{count} listed left out: no such pictures"]
