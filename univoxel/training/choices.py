"""Records of what compression chose, and their form in a run's state."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

# Runs of version 0.2 and before may have channels, lobes and hidden units too
Kind: TypeAlias = Literal["voxels", "mirror levels", "reach", "rows"]


@dataclass(frozen=True)
class CapacityChoice:
    """The size that was chosen for one kind of capacity."""

    kind: Kind
    before: float  # size; of a reach in voxels, else a count
    after: float
    cost: float  # dB that held-out rays lost; below 0 they gained
    why: str

    @property
    def sentence(self) -> str:
        """The choice in words, for people."""
        return f"{self.kind} {self.before:,.9g} -> {self.after:,.9g}: {self.why}"

    def as_json(self) -> dict[str, Any]:
        """The choice as an entry of a run's state."""
        return {
            "what": self.kind,
            "before": self.before,
            "after": self.after,
            "cost": self.cost,
            "why": self.why,
            "said": self.sentence,
        }

    @staticmethod
    def from_json(entry: dict[str, Any]) -> CapacityChoice:
        """The choice that `as_json` wrote."""
        names = ("what", "before", "after", "cost", "why")
        return CapacityChoice(*(entry[name] for name in names))


def chosen_voxels(choices: Iterable[CapacityChoice]) -> int | None:
    """Voxels of the coarsest grid that was chosen; None where none was."""
    counts = [round(choice.after) for choice in choices if choice.kind == "voxels"]
    return min(counts, default=None)


def chosen_reach(choices: Iterable[CapacityChoice]) -> float | None:
    """Voxels from the surface up to which nodes are stored, as chosen last; None where it was
    not."""
    reaches = [choice.after for choice in choices if choice.kind == "reach"]
    return reaches[-1] if reaches else None
