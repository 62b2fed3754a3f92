"""One helper for the tests of every op: native against reference, gradcheck, opcheck, compile."""

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from univoxel.ops.native import Operator

# Largest relative L2 error of a float32 op against the reference in float64, value and gradient.
# float32 carries 6e-8 per operation; sums of some hundred terms and one division keep below these.
RTOL = {torch.float32: 1e-5, torch.float64: 1e-12}

Op = Callable[..., Tensor | tuple[Tensor, ...]]


def grads_of(op: Op, arguments: Sequence, seed: int = 0, **options) -> tuple[Tensor, ...]:
    """Gradients of a random projection of the outputs, to all leaves."""
    g = torch.Generator().manual_seed(seed)
    outputs = op(*arguments, **options)
    outputs = (outputs,) if isinstance(outputs, Tensor) else outputs
    pulls = [torch.randn(o.shape, generator=g, dtype=torch.float64).to(o.dtype) for o in outputs]
    leaves = [a for a in arguments if isinstance(a, Tensor) and a.requires_grad]
    pulled = [(o * p).sum() for o, p in zip(outputs, pulls, strict=True) if o.requires_grad]
    return torch.autograd.grad(sum(pulled), leaves)


def check_op(
    op: Op,
    reference: Op,
    cases: Sequence[tuple],
    rtol: dict[torch.dtype, float] = RTOL,
    custom_op: Operator | None = None,
) -> None:
    """Hold an op against its reference on every case (a tuple of float64 arguments).

    Values and gradients in float32 and float64, gradcheck in float64, the same bits on one and on
    two threads, and torch.library.opcheck of the custom op behind it. Tensors with requires_grad
    are differentiated.
    """
    for case in cases:
        wanted, wanted_grads = _run(reference, case, torch.float64)
        for dtype in (torch.float32, torch.float64):
            got, got_grads = _run(op, case, dtype)
            for kind, a, b in (("value", got, wanted), ("gradient", got_grads, wanted_grads)):
                for i, (x, y) in enumerate(zip(a, b, strict=True)):
                    assert x.shape == y.shape, f"{kind} {i}: {x.shape} against {y.shape}"
                    assert x.dtype == (dtype if y.is_floating_point() else y.dtype)
                    error = (x.double() - y).norm() / y.double().norm().clamp_min(1e-30)
                    small = (x.double() - y).abs().max() < 1e-30 if x.numel() else True
                    assert small or error < rtol[dtype], f"{kind} {i}, {dtype}: {error:.2e}"
            threads = torch.get_num_threads()
            torch.set_num_threads(1 if threads > 1 else 2)
            again, again_grads = _run(op, case, dtype)
            torch.set_num_threads(threads)
            for x, y in zip([*got, *got_grads], [*again, *again_grads], strict=True):
                assert torch.equal(x, y), "another number of threads gives other bits"
        inputs = _arguments(case, torch.float64)
        if any(isinstance(t, Tensor) and t.requires_grad and t.numel() for t in inputs):
            assert torch.autograd.gradcheck(op, inputs)
        if custom_op is not None:
            torch.library.opcheck(custom_op.defined, _arguments(case, torch.float32))


def _arguments(case: tuple, dtype: torch.dtype) -> tuple:
    """Fresh leaves of the case's tensors, floating ones in the dtype."""
    return tuple(
        a.detach().to(dtype).requires_grad_(a.requires_grad)
        if isinstance(a, Tensor) and a.is_floating_point()
        else a
        for a in case
    )


def _run(op: Op, case: tuple, dtype: torch.dtype) -> tuple[list[Tensor], list[Tensor]]:
    """Outputs, and gradients of a fixed random projection of the floating outputs."""
    inputs = _arguments(case, dtype)
    outputs = op(*inputs)
    outputs = [outputs] if isinstance(outputs, Tensor) else list(outputs)
    leaves = [a for a in inputs if isinstance(a, Tensor) and a.requires_grad]
    if not leaves:
        return outputs, []
    generator = torch.Generator().manual_seed(0)
    loss = sum(
        (o * torch.randn(o.shape, generator=generator, dtype=torch.float64).to(dtype)).sum()
        for o in outputs
        if o.is_floating_point() and o.requires_grad
    )
    return [o.detach() for o in outputs], list(torch.autograd.grad(loss, leaves))
