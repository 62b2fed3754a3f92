"""One helper for the tests of every op: native against reference, gradcheck, opcheck, compile."""

from collections.abc import Callable, Sequence
from itertools import chain

import torch
from torch import Tensor
from torch.nn.functional import normalize

from univoxel.ops.native import Operator

# Largest relative L2 error of a float32 op against the reference in float64, value and gradient.
# float32 carries 6e-8 per operation; sums of some hundred terms and one division keep below these.
RTOL = {torch.float32: 1e-5, torch.float64: 1e-12}
# Of shading: sums of a few hundred directions, through exp of -60 .. 0 whose argument is a
# difference of terms up to 30, and D's denominator at low roughness.
SHADING_RTOL = {torch.float32: 1e-4, torch.float64: 1e-12}

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


def same_on_threads(
    run: Callable[[], Sequence[Tensor]], counts: Sequence[int] = (1, 2, 3)
) -> list[Tensor]:
    """What a function returns: the same bits on each of these numbers of threads."""
    before, found = torch.get_num_threads(), []
    try:
        for count in counts:
            torch.set_num_threads(count)
            found.append(list(run()))
    finally:
        torch.set_num_threads(before)
    for other in found[1:]:
        for a, b in zip(found[0], other, strict=True):
            assert torch.equal(a, b), "another number of threads gives other bits"
    return found[0]


def unit(g: torch.Generator, *shape: int) -> Tensor:
    """Random directions [..., 3] in double."""
    return normalize(torch.randn(*shape, 3, generator=g, dtype=torch.float64), dim=-1)


def uniform(g: torch.Generator, low: float, high: float, *shape: int) -> Tensor:
    return low + (high - low) * torch.rand(*shape, generator=g, dtype=torch.float64)


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
        values, grads = _run(reference, case, torch.float64)
        for dtype in (torch.float32, torch.float64):
            found = same_on_threads(lambda c=case, d=dtype: chain(*_run(op, c, d)), (1, 2))
            for i, (x, y) in enumerate(zip(found, [*values, *grads], strict=True)):
                what = f"{i} of {len(values)} values and {len(grads)} gradients"
                assert x.shape == y.shape, f"{what}: {x.shape} against {y.shape}"
                assert x.dtype == (dtype if y.is_floating_point() else y.dtype)
                error = (x.double() - y).norm() / y.double().norm().clamp_min(1e-30)
                small = (x.double() - y).abs().max() < 1e-30 if x.numel() else True
                assert small or error < rtol[dtype], f"{what}, {dtype}: {error:.2e}"
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
