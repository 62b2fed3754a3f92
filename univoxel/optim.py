"""Adam that updates only the rows of a grid that received a gradient."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch import Tensor
from torch.optim.adam import adam

from univoxel.ops import adam_rows_


class RowAdam(torch.optim.Optimizer):
    """Adam for sparse and dense gradients side by side.

    A parameter whose gradient is a ``sparse_coo`` tensor (``sample_dense(sparse_grad=True)``) is a
    table: each index of the sparse dimensions is a row. Rows without gradient keep their values
    and moments bit for bit; see ``adam_rows_`` for the step of the others. A parameter whose
    gradient is dense takes the step of ``torch.optim.Adam``. The gradient's layout may change from
    step to step: the state is the same.

    Args:
        params: parameters or groups of them, as for any optimizer.
        lr: learning rate, at least 0.
        betas: decay of the first and second moment, each in [0, 1).
        eps: added to the root of the corrected second moment, at least 0, in the unit of the
            gradient. A grid should have its own: with 1e-3 to 1e-2 of the mean over a batch, voxels
            that are rarely seen do not take full steps on noise.

    Raises:
        ValueError: a number out of range; a sparse gradient of a parameter that is not contiguous.
    """

    def __init__(
        self,
        params: Iterable[Tensor] | Iterable[dict[str, Any]],
        lr: float = 1e-3,
        betas: tuple[float, float] = (0.9, 0.999),
        eps: float = 1e-8,
    ) -> None:
        super().__init__(params, {"lr": lr, "betas": betas, "eps": eps})

    def add_param_group(self, param_group: dict[str, Any]) -> None:
        """Add a group; lr, betas and eps that it lacks are those of the optimizer."""
        group = self.defaults | param_group
        for name in ("lr", "eps"):
            if not group[name] >= 0:
                raise ValueError(f"RowAdam: {name} must be at least 0, got {group[name]}")
        if not all(0 <= beta < 1 for beta in group["betas"]):
            raise ValueError(f"RowAdam: betas must be in [0, 1), got {group['betas']}")
        _plain(torch.optim.Optimizer.add_param_group)(self, param_group)

    def zero_grad(self, set_to_none: bool = True) -> None:
        """As in any optimizer."""
        _plain(torch.optim.Optimizer.zero_grad)(self, set_to_none)

    @torch.no_grad()
    def follow(self, old: Tensor, new: Tensor) -> None:
        """Replace a tensor by another: the same, or one with more rows at its end, which start
        without moments."""
        if new is old:
            return
        for group in self.param_groups:
            group["params"] = [new if p is old else p for p in group["params"]]
        state = self.state.pop(old, None)
        if state:
            none = new.new_zeros(len(new) - len(old), *new.shape[1:])
            for name in ("exp_avg", "exp_avg_sq"):
                state[name] = torch.cat([state[name], none])
            self.state[new] = state

    @torch.no_grad()
    def step(self, closure: Callable[[], Tensor] | None = None) -> Tensor | None:
        """Take one step on every parameter that has a gradient; return the closure's loss."""
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        for group in self.param_groups:
            dense = []
            for param in group["params"]:
                if param.grad is None:
                    continue
                if param.grad.layout == torch.sparse_coo:
                    self._step_rows(param, group)
                else:
                    dense.append(param)
            self._step_dense(dense, group)
        return loss

    def _step_rows(self, param: Tensor, group: dict[str, Any]) -> None:
        if not param.is_contiguous():
            raise ValueError(
                "RowAdam: a parameter with a sparse gradient must be contiguous, got strides "
                f"{param.stride()}"
            )
        state = self._state_of(param)
        state["step"] += 1
        assert param.grad is not None
        grad = param.grad
        rows = rows_of(grad)
        # Autograd forgets that a gradient is coalesced when it stores it; sorting again is dear.
        if not grad.is_coalesced() and not (rows[1:] > rows[:-1]).all():
            grad = grad.coalesce()
            rows = rows_of(grad)
        values = grad._values()
        dims = grad.sparse_dim()
        table = (param.shape[:dims].numel(), param.shape[dims:].numel())  # no -1: it may be empty
        beta1, beta2 = group["betas"]
        adam_rows_(
            param.view(table),
            state["exp_avg"].view(table),
            state["exp_avg_sq"].view(table),
            rows,
            values.reshape(len(rows), table[1]),
            lr=group["lr"],
            beta1=beta1,
            beta2=beta2,
            eps=group["eps"],
            step=int(state["step"]),
        )

    def _step_dense(self, params: list[Tensor], group: dict[str, Any]) -> None:
        beta1, beta2 = group["betas"]
        # Fused, it takes all memory to be in order, and reads at wrong places what is laid out
        # otherwise: gradients are put in order, and parameters that are not take its other step
        for fused in (True, False):
            own = [p for p in params if p.is_contiguous() == fused]
            if not own:
                continue
            states = [self._state_of(p) for p in own]
            adam(
                own,
                [p.grad.contiguous() for p in own if p.grad is not None],
                [s["exp_avg"] for s in states],
                [s["exp_avg_sq"] for s in states],
                [],
                [s["step"] for s in states],
                amsgrad=False,
                beta1=beta1,
                beta2=beta2,
                lr=group["lr"],
                weight_decay=0.0,
                eps=group["eps"],
                maximize=False,
                fused=fused,
            )

    def _state_of(self, param: Tensor) -> dict[str, Any]:
        """Step and moments, zero at first; in torch.optim.Adam's names and types."""
        state = self.state[param]
        if not state:
            state["step"] = torch.tensor(0.0)
            state["exp_avg"] = torch.zeros_like(param)
            state["exp_avg_sq"] = torch.zeros_like(param)
        return state


def _plain(method: Callable[..., None]) -> Callable[..., None]:
    """A method of torch's optimizers without what hides it from the compiler: that imports the
    compiler when first called, a second and 70 MB."""
    return getattr(method, "__wrapped__", method)


def parameters_of(optimizer: torch.optim.Optimizer) -> list[Tensor]:
    """All that it optimises, group after group."""
    return [p for group in optimizer.param_groups for p in group["params"]]


def rows_of(grad: Tensor) -> Tensor:
    """Number of each index of a sparse tensor among all, the sparse dimensions flattened."""
    indices = grad._indices()
    rows = indices[0]
    for index, size in zip(indices[1:], grad.shape[1:], strict=False):
        rows = torch.add(index, rows, alpha=size)
    return rows


def geometric(ends: tuple[float, float], done: float) -> float:
    """Geometric interpolation."""
    return ends[0] * (ends[1] / ends[0]) ** done
