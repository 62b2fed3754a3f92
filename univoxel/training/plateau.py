"""When held-out rays do not improve any more."""

from __future__ import annotations

CHECK = 0.05  # of a stage's schedule, between looks
WINDOW = 3  # looks over which they must improve


class Plateau:
    """Held-out quality along the schedule of a stage.

    Args:
        patience: dB that held-out rays must gain over WINDOW looks, >= 0; 0: nothing is looked at.
    """

    def __init__(self, patience: float) -> None:
        self.patience = patience
        self._seen: list[float] = []  # dB, of one kind
        self._kind, self._next, self._over = False, CHECK, patience == 0

    def due(self, done: float) -> bool:
        """Whether it is time to look, at this progress in [0, 1)."""
        return not self._over and done >= self._next

    def flat(self, done: float, psnr: float, physical: bool) -> bool:
        """Note a look; say, once, that there was too little gain.

        Args:
            physical: whether it is of the physically based render; what was seen of the other
                kind says nothing of it.
        """
        if physical != self._kind:
            self._kind, self._seen = physical, []
        self._next = done + CHECK
        self._seen.append(psnr)
        seen = self._seen
        self._over = len(seen) > WINDOW and seen[-1] - seen[-1 - WINDOW] < self.patience
        return self._over
