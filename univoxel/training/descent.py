"""The optimiser of every stage: smoothed gradients, recovery from failed steps, early stopping."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

import torch
from torch import Tensor

from univoxel.config import StageConfig
from univoxel.fields.field import Field
from univoxel.optim import parameters_of, rows_of
from univoxel.training.progress import Listener

SPREAD = 0.8  # share of the neighbours' mean that a node's gradient takes on in a pass
MOMENTS = (0.9, 0.99)
# Adam's epsilon for the grids. Far above 0 on purpose: a node's gradient is then scaled by the
# batch, not by its own history, and nodes that few rays see do not jump.
EPS_SDF, EPS_FEATURES = 1e-4, 1e-8


def smooth_sdf_gradient_(field: Field, passes: int) -> None:
    """Diffuse the sdf's gradient over the nodes that it touches, before Adam sees it: the surface
    then moves in large pieces, far and without the bumps that steps of single nodes leave. Nodes
    that are frozen get none."""
    grad = field.sdf.grad
    assert grad is not None
    rows, pinned = rows_of(grad), field.distances.pinned
    field.distances.diffuse_rows_(grad._values(), rows, SPREAD, passes)
    if pinned is not None:
        grad._values()[pinned.flatten()[rows]] = 0


def smooth_touched_(field: Field, stage: StageConfig, every: int) -> None:
    """Regularise the nodes that the step has touched, beside the optimiser and not inside it.

    Args:
        every: steps between two calls, for which each makes up.
    """
    sdf, features = field.sdf, field.features
    assert sdf.grad is not None
    assert features.grad is not None
    plate, diffusion = stage.plate * every, stage.diffusion * every
    field.distances.smooth_rows_(sdf.detach(), rows_of(sdf.grad), plate, order=2)
    field.smooth_features_(rows_of(features.grad), diffusion)


# Holds a training where its numbers fail: drops the step, goes back to a good state, says so.


FAR = 6.0  # dB below its best at which validation PSNR has collapsed: four times the error
ENOUGH = 40.0  # dB; a best beyond counts as this: falls from there are no collapse
LIMIT = 3  # failures in a row that are repaired; the next one ends the stage
PROOF = 50  # sound steps after which a failure is over
COPYING = 0.002  # share of the time that copies of the parameters may take


class Guard:
    """Watches one stage: no step is taken on a loss or gradient that is not finite.

    The first failure drops its step: the parameters are as good as before it. One that follows
    within PROOF steps, and quality that collapses, goes back to the copy that was last found good,
    with fresh moments. Each failure halves the step size, `scale`; after LIMIT in a row the stage
    ends with what is good.

    Args:
        progress: that is told, and ends the stage.
        restored: called when parameters have gone back, for what is derived from them.
    """

    def __init__(self, progress: Listener, restored: Callable[[], None] = lambda: None) -> None:
        self.scale: float = 1.0  # on the step size
        self._progress, self._restored = progress, restored
        self._best, self._kind = -math.inf, False
        self._failures, self._sound = 0, 0  # in a row; steps since the last
        self._optimizer: torch.optim.Optimizer | None = None
        self._copy: list[Tensor] = []
        self._next = -math.inf  # when to copy again

    def follow(self, optimizer: torch.optim.Optimizer) -> None:
        """Watch the parameters of this optimizer, which are good as they are."""
        self._optimizer, self._next = optimizer, -math.inf
        self.keep()

    def forget(self) -> None:
        """Do not go back to the copy: what the parameters stand for has changed since."""
        self._copy, self._next = [], -math.inf

    @torch.no_grad()
    def keep(self) -> None:
        """Copy the parameters as a good state, unless copies would take too long.

        They may have other sizes than before.
        """
        begin = time.monotonic()
        if begin < self._next:
            return
        parameters = self._parameters()
        if not self._fits(parameters):
            self._copy = [torch.empty_like(p) for p in parameters]
        for copy, parameter in zip(self._copy, parameters, strict=True):
            copy.copy_(parameter)
        end = time.monotonic()
        self._next = end + (end - begin) / COPYING

    def sound(self, loss: Tensor) -> bool:
        """Whether the step may be taken, after backward; if not, what is needed has been done.

        Args:
            loss: [] what was differentiated.
        """
        gradients = [p.grad for p in self._parameters() if p.grad is not None]
        values = [g._values() if g.is_sparse else g for g in gradients]
        # The root of the sum of squares: Adam's moments must not overflow either
        norms = [torch.linalg.vector_norm(v) for v in values]
        if bool(torch.isfinite(torch.stack([loss.detach(), *norms]).sum())):
            self._sound += 1
            if self._sound >= PROOF:
                self._failures = 0
            return True
        value = loss.item()
        what = "a gradient is not finite" if math.isfinite(value) else f"the loss is {value}"
        self._fail(what, self._failures > 0, "dropped this step")
        return False

    def judge(self, psnr: float, kind: bool) -> None:
        """Note quality on validation pixels, dB; go back if it has collapsed, else keep the state.

        Args:
            kind: what the quality is of; that of the other kind says nothing of it.
        """
        if kind != self._kind:
            self._best, self._kind = -math.inf, kind
        if not psnr > self._best - FAR:  # NaN too
            best = f" (best: {self._best:.1f} dB)" if math.isfinite(self._best) else ""
            self._fail(f"validation PSNR is {psnr:.1f} dB{best}", True, "found no earlier state")
            return
        self._best = min(max(self._best, psnr), ENOUGH)
        if psnr > self._best - FAR / 2:
            self.keep()

    def _parameters(self) -> list[Tensor]:
        assert self._optimizer is not None
        return parameters_of(self._optimizer)

    def _fits(self, parameters: list[Tensor]) -> bool:
        return [p.shape for p in parameters] == [c.shape for c in self._copy]

    @torch.no_grad()
    def _fail(self, what: str, back: bool, otherwise: str) -> None:
        self._failures, self._sound = self._failures + 1, 0
        self.scale /= 2
        parameters = self._parameters()
        back = back and self._fits(parameters)  # else the copy is of a grid that is no more
        if back:
            assert self._optimizer is not None
            for parameter, copy in zip(parameters, self._copy, strict=True):
                parameter.copy_(copy)
            self._optimizer.state.clear()
            self._restored()
        where = f"stage {self._progress.clock.stage + 1}, step {self._progress.clock.step}: {what}"
        if self._failures > LIMIT:
            self._progress.trouble(
                f"{where}; {LIMIT} smaller step sizes did not help: the stage ends with the last "
                "good state"
            )
            self._progress.clock.abandon()
            return
        done = "returned to the last good state" if back else otherwise
        self._progress.trouble(f"{where}; {done}; the step size was multiplied by {self.scale:g}")


# When validation pixels do not improve any more.


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
