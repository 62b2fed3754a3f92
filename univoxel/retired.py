"""Fields that configurations had, which files of earlier versions hold still and nothing reads."""

from __future__ import annotations

from typing import Any

# By class. What they said is a constant now, beside the code that uses it, or gone with that code
RETIRED: dict[str, frozenset[str]] = {
    "TrainConfig": frozenset({"compression", "hollows", "preparation"}),
}


def without_retired(kind: Any, values: dict[str, Any]) -> dict[str, Any]:
    """What a file holds of a configuration, but for fields that its class no longer has."""
    gone = RETIRED.get(kind.__name__, frozenset())
    return {name: value for name, value in values.items() if name not in gone}
