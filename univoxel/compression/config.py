"""The constants of compression: what is tried, on how many rays, and what it may cost."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

from univoxel.validation import check_fields


@dataclass(frozen=True)
class CompressionConfig:
    """How a scene's sizes follow the scene, where TrainConfig.capacity is adaptive.

    dB count what held-out rays lose, see `quality.ReferenceRays.loss_db`.
    """

    # --- The grid of a dense field, chosen by rehearsals of the next stage

    # Voxels of the coarsest grid that is tried, >= 8. 16^3: below, no object keeps its parts
    fewest_voxels: int = 16**3
    # dB that a coarser grid may end below the best rehearsal, >= 0. Short rehearsals scatter so far
    grid_tolerance_db: float = 0.1
    # Voxels of a grid over those of the next finer one that is tried, in (0, 1). Wide strides:
    # rehearsals are too short to tell close sizes apart
    grid_stride: float = 1 / 9
    # Voxels of the last grid that is tried over those of the chosen one, in (0, 1). In the middle
    # of a stride, in the logarithm
    grid_step: float = 1 / 3
    # Share of the next stage's steps in a rehearsal, in (0, 1). Steps of the chosen one count as
    # made, the others cost that much time each
    rehearsal_share: float = 0.05
    # Steps of a rehearsal at least, >= 1: fewer do not tell grids apart
    rehearsal_steps: int = 8

    # --- Channels, lobes, hidden units and mirror levels, after the first stage with light

    # dB that one kind of saving may cost, >= 0. Below what is visible, even a few of them together
    tolerance_db: float = 0.02
    # dB that fewer channels may cost where training goes on, >= 0: it regains most of that
    regained_db: float = 0.1
    # Sizes that are tried, over the present one: from 1 falling, above 0. Steps of an eighth: finer
    # ones save next to nothing
    size_shares: tuple[float, ...] = (1.0, 7 / 8, 3 / 4, 5 / 8, 1 / 2, 3 / 8, 1 / 4, 1 / 8)
    # Share of the parameters, in [0, 1], above which networks are made smaller and settle. Below,
    # the time buys nothing
    least_head_share: float = 0.1
    # Rays of the training photographs that networks settle on, >= 1: some for each of their weights
    calibration_rays: int = 1024
    # Steps of Adam in which smaller networks learn what the larger ones gave, >= 0. A trial of one
    # size takes about a second
    settle_steps: int = 20
    # First learning rate of these steps, > 0; it falls to 0. That of networks at the begin of
    # training / 3
    settle_rate: float = 1e-3
    # Random mixtures of the outputs whose gradients weigh channels, >= 1: the mean of squares
    # needs no more
    channel_probes: int = 8
    # Damping, over the mean square, of the fit of dropped hidden units by kept ones, > 0. Units
    # that say nearly the same must not get huge weights
    ridge: float = 1e-4

    # --- What the file of a finished scene stores

    # dB that leaving out nodes far from the surface may cost, >= 0
    reach_tolerance_db: float = 0.05
    # Distances from the surface, voxels, up to which nodes are stored: falling, in (0, 4); the
    # first that is tried is checkpoint.SHELL, 4. Below 1 the surface's own cells lose nodes
    reaches: tuple[float, ...] = (3.5, 3.0, 2.75, 2.5, 2.25, 2.0, 1.75, 1.5, 1.25, 1.0)
    # Shares of a hash table's rows that are dropped on trial: from 0 rising, below 1. Finer where
    # more is gone, as costs rise faster there
    dropped_row_shares: tuple[float, ...] = (
        *(0.0, 1 / 4, 3 / 8, 1 / 2, 5 / 8, 11 / 16, 3 / 4, 13 / 16, 7 / 8, 29 / 32, 15 / 16),
    )
    # Rays of the training photographs in a batch whose gradients weigh rows, >= 1: what memory of
    # one backward pass bounds
    row_probe_rays: int = 4096
    # Batches of row_probe_rays, >= 0. A row that none of them meets is kept, so few batches drop
    # fewer rows
    row_probes: int = 8

    # --- Under a budget of bytes

    # Share of the budget that bounds the rows of the hash table, in (0, 1]: the grid needs the rest
    table_share: float = 0.5
    # Share of the budget that the table of mirrored directions may have, in (0, 1]: it matters for
    # gloss alone
    mirror_share: float = 0.1
    # Nodes of the next grid over those of the last, in (0, 1), until a finished scene fits. Each
    # try loses detail: small steps come closest to the budget
    budget_step: float = 0.8

    def __post_init__(self) -> None:
        shares = ("grid_stride", "grid_step", "rehearsal_share", "budget_step")
        check_fields(self, "in (0, 1)", lambda x: 0 < x < 1, *shares)
        check_fields(self, "in (0, 1]", lambda x: 0 < x <= 1, "table_share", "mirror_share")
        check_fields(self, "in [0, 1]", lambda x: 0 <= x <= 1, "least_head_share")
        losses = ("grid_tolerance_db", "tolerance_db", "regained_db", "reach_tolerance_db")
        not_negative = (*losses, "settle_steps", "row_probes")
        check_fields(self, "at least 0", lambda x: 0 <= x < math.inf, *not_negative)
        check_fields(self, "above 0", lambda x: 0 < x < math.inf, "settle_rate", "ridge")
        counts = ("rehearsal_steps", "calibration_rays", "channel_probes", "row_probe_rays")
        check_fields(self, "at least 1", lambda x: x >= 1, *counts)
        check_fields(self, "at least 8", lambda x: x >= 8, "fewest_voxels")
        falling, rising = _in_order(lambda a, b: a > b), _in_order(lambda a, b: a < b)
        check_fields(
            self,
            "numbers that fall from 1 and stay above 0",
            lambda x: falling(x) and x[0] == 1 and x[-1] > 0,
            "size_shares",
        )
        check_fields(
            self,
            "numbers in (0, 4) that fall",
            lambda x: falling(x) and x[0] < 4 and x[-1] > 0,
            "reaches",
        )
        check_fields(
            self,
            "numbers that rise from 0 and stay below 1",
            lambda x: rising(x) and x[0] == 0 and x[-1] < 1,
            "dropped_row_shares",
        )


def _in_order(follow: Callable[[float, float], bool]) -> Callable[[tuple[float, ...]], bool]:
    return lambda numbers: len(numbers) > 0 and all(follow(a, b) for a, b in pairwise(numbers))
