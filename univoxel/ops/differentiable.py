"""Declaration of ops with gradients and their registration with torch; checks of arguments."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from itertools import islice
from typing import Any, TypeAlias

import torch
from torch import Tensor
from torch.autograd import forward_ad

from univoxel.core.records import Bricks
from univoxel.ops import native


def check(
    op: str,
    bricks: Bricks | None = None,
    /,
    **arguments: tuple[Tensor, str] | tuple[Tensor, str, torch.dtype],
) -> dict[str, int]:
    """Check the tensors of an op and return the size behind each letter.

    An argument is (tensor, sizes) or (tensor, sizes, dtype). Sizes are words: a letter binds a size
    the first time and must match afterwards ("M C"), a number must be met ("M 3"), a letter with an
    offset follows another ("N+1", bound by "N" elsewhere). Without a dtype the tensor is floating,
    of the same dtype as the other floating ones. All share one device.

    Args:
        bricks: of a sparse grid; "n" is the number of these bricks, and "R" that of their rows.

    Raises:
        TypeError: an argument is not a tensor, or bricks are of another type.
        ValueError: a size, dtype or device is off; the message says what was wanted and what came.
    """
    sizes: dict[str, int] = {}
    floating: torch.dtype | None = None
    device: torch.device | None = None
    if bricks is not None:
        if not isinstance(bricks, Bricks):
            raise TypeError(f"{op}: bricks must be of the type Bricks, got {type(bricks).__name__}")
        n, device = len(bricks.place), bricks.table.device
        sizes = {"n": n, "R": Bricks.NODES * n}
    for name, (tensor, wanted, *dtype) in arguments.items():
        if not isinstance(tensor, Tensor):
            raise TypeError(f"{op}: {name} must be a tensor, got {type(tensor).__name__}")
        device = device or tensor.device
        words = wanted.split()
        ok = tensor.dim() == len(words) and tensor.device == device
        if dtype:
            ok = ok and tensor.dtype == dtype[0]
        else:
            ok = ok and tensor.is_floating_point() and tensor.dtype == (floating or tensor.dtype)
            if tensor.is_floating_point():
                floating = floating or tensor.dtype
        if ok:
            ok = all(
                _matches(word, size, sizes) for word, size in zip(words, tensor.shape, strict=True)
            )
        if not ok:
            kind = str(dtype[0] if dtype else floating or "floating").removeprefix("torch.")
            bound = ", ".join(f"{k}={v}" for k, v in sizes.items())
            raise ValueError(
                f"{op}: {name} must be [{', '.join(words)}] {kind} on {device}"
                f"{f' with {bound}' if bound else ''}, got {list(tensor.shape)} "
                f"{str(tensor.dtype).removeprefix('torch.')} on {tensor.device}"
            )
    return sizes


RANGES: dict[str, Callable[[float], bool]] = {
    "in [0, 1]": lambda x: 0 <= x <= 1,
    "in [0, 1)": lambda x: 0 <= x < 1,
    "at least 0": lambda x: 0 <= x < math.inf,
    "at least 1": lambda x: 1 <= x < math.inf,
    "above 0": lambda x: 0 < x < math.inf,
}


def check_numbers(op: str, wanted: str, **numbers: float) -> None:
    """Check the numbers of an op, which must be in a range, and finite.

    Raises:
        ValueError: one is not; the message says what was wanted and what came.
    """
    for name, number in numbers.items():
        if not RANGES[wanted](number):
            raise ValueError(f"{op}: {name} must be {wanted}, got {number}")


def _matches(word: str, size: int, sizes: dict[str, int]) -> bool:
    """Hold one size against its word, binding the letter when it is new."""
    if word.isdigit():
        return size == int(word)
    letter, _, more = word.partition("+")
    size = size - int(more or 0)
    if size < 0:
        return False
    return sizes.setdefault(letter, size) == size


# Ops with gradients: declared once, and registered with torch in full.


Tensors: TypeAlias = Sequence[Any]  # or lists of tensors among them, as the op takes them
# Called with tensors, options and outputs; fills the outputs
Forward: TypeAlias = "Callable[[Tensors, Sequence, Sequence[Tensor]], None]"
# Called with what was saved, gradients of the outputs that are not held, options, and whether each
# gradient is needed; returns the gradients. In place of one not needed, anything may stand
Backward: TypeAlias = (
    "Callable[[Tensors, Sequence[Tensor], Sequence, list[bool]], Sequence[Tensor | None]]"
)


def differentiable(
    tensors: str, options: str = "", **settings: Any
) -> Callable[[Callable], Differentiable]:
    """Make an op with gradients of a function that allocates its outputs.

        @differentiable("alpha* value* offsets", "float early_stop", outputs=2)
        def _composite(alpha, value, offsets, early_stop):
            return value.new_empty(len(offsets) - 1, value.shape[1]), torch.empty_like(alpha)

        out, weight = _composite(alpha, value, offsets, 0.0)

    The op calls these kernels of the extension:

        composite_forward(alpha, value, offsets, out, weight, early_stop, threads)
        composite_backward(alpha, value, offsets, grad_out, grad_weight,
                           grad_alpha, grad_value, early_stop, threads)

    torch knows them as `univoxel::composite` and `univoxel::composite_backward`: what they take and
    return, the shapes of that without values, what is saved between them. Second order raises, and
    so do derivatives in forward mode.

    Args:
        tensors: names of the arguments, which must be contiguous; with a star of those that have
            gradients, in the order of the backward kernel. "[]" at the end: a list of tensors. If
            there are lists, all arguments have gradients.
        options: what follows, with types as in a schema of torch: numbers or lists of numbers.
        outputs: how many.
        forward: calls the kernel, where it takes its arguments in another order.
        backward: likewise. If the op has an option `sparse_grad` and it is true, backward is called
            without an op: sizes of gradients may then depend on values.
        held: how many outputs, the last ones, serve the backward pass only. They have no gradient
            and are saved after the tensors.
        optional: those whose gradient is an empty array where it is not needed. The kernel computes
            the others always.
        traced: backward is made of torch's operations and is no op. It takes what is held only.
    """
    return lambda allocate: Differentiable(allocate, tensors.split(), options, **settings)


class Differentiable(native.Operator):
    """What `differentiable` makes; `backward` is its second op."""

    def __init__(
        self,
        allocate: Callable,
        tensors: list[str],
        options: str,
        outputs: int = 1,
        forward: Forward | None = None,
        backward: Backward | None = None,
        held: int = 0,
        optional: str = "",
        traced: bool = False,
    ) -> None:
        name = allocate.__name__.removeprefix("_")
        names = [t.partition("*")[0] for t in tensors]
        arguments = [
            f"{'Tensor[]' if t.endswith('[]') else 'Tensor'} {n}"
            for t, n in zip(tensors, names, strict=True)
        ]
        listed = options.split(", ") if options else []
        n = len(tensors)
        self._to = [i for i, t in enumerate(tensors) if "*" in t]
        self._count, self._tensors = n + len(listed), n
        self._lists = any(t.endswith("[]") for t in tensors)
        assert not self._lists or len(self._to) == n, "with lists, all have gradients"
        self._held, self._shown = held, outputs - held
        sparse = "bool sparse_grad"
        self._sparse = listed.index(sparse) if sparse in listed else None
        self._traced = traced
        spared = [names[i] in optional.split() for i in self._to]
        self._find = backward or _backward_by_name(name, self._to, spared)
        kernel = f"{name}_forward"

        def run(tensors: Tensors, options: Sequence) -> Any:
            out = allocate(*tensors, *options)
            filled = out if outputs > 1 else (out,)
            if forward is None:
                native.call(kernel, *tensors, *filled, *options)
            else:
                forward(tensors, options, filled)
            return out

        returned = ", ".join(["Tensor"] * outputs)
        schema = f"({', '.join([*arguments, *listed])}) -> ({returned})"
        super().__init__(name, lambda *inputs: run(inputs[:n], inputs[n:]), schema, allocate)
        self._run = run
        self._function = self._register()
        if not traced:
            more = [f"Tensor held_{i}" for i in range(held)]
            more += [f"Tensor grad_{i}" for i in range(self._shown)]
            taken = ", ".join([*arguments, *more, *listed, "bool[] needs"])
            self.backward: native.Operator = native.Operator(
                f"{name}_backward",
                self._backward_kernel,
                f"({taken}) -> Tensor[]",
                self._backward_fake,
            )

    def __call__(self, *arguments: Any) -> Any:
        if forward_ad._current_level >= 0:
            self._refuse_tangents(arguments)
        if native.goes_by_library(arguments):
            return self.defined(*arguments)
        if torch.is_grad_enabled() and torch._C._any_requires_grad(*arguments):
            return self._function(*arguments)
        return self.kernel(*arguments)

    def _refuse_tangents(self, arguments: Sequence) -> None:
        """Raise where a derivative in forward mode is asked for, which torch would take for 0."""
        given = [t for t in _flat(arguments) if isinstance(t, Tensor) and t.is_floating_point()]
        if any(forward_ad.unpack_dual(t).tangent is not None for t in given):
            raise NotImplementedError(
                f"{self.name}: forward mode (jvp, jacfwd, dual numbers) is not supported: use "
                "torch.autograd.grad"
            )

    def _register(self) -> Callable:
        """Tell torch of the gradients; returns the short way, an autograd function."""
        run, n, lists = self._run, self._tensors, self._lists
        none = [None] * (self._count - n)

        def save(ctx: Any, inputs: Sequence, output: Any) -> None:
            tensors = _flat(inputs[:n]) if lists else inputs[:n]
            ctx.lengths = [len(t) if isinstance(t, list) else None for t in inputs[:n] if lists]
            self._save(ctx, tensors, inputs[n:], output)

        def gradients(ctx: Any, grads: Sequence[Tensor | None], needs: Sequence[bool]) -> list:
            """Of all tensors one by one."""
            result: list[Tensor | None] = [None] * len(needs)
            if grads[0] is not None:
                to = range(len(needs)) if lists else self._to
                wanted = [needs[i] for i in to]
                saved = _grouped(ctx.saved_tensors, ctx.lengths)
                found = self._gradients(saved, grads, ctx.options, wanted)
                for i, need, gradient in zip(to, wanted, found, strict=True):
                    if need:
                        result[i] = gradient
            return result

        def backward(ctx: Any, *grads: Tensor | None) -> tuple:
            needs = ctx.needs_input_grad[:n]
            found = gradients(ctx, grads, _flat(needs) if lists else needs)
            return *_grouped(found, ctx.lengths), *none

        # The short way. Autograd sees single tensors only; the kernel reads the same, as the op
        # takes it. With a setup_context torch would look up forward's signature in every call
        def forward(ctx: Any, inputs: Sequence, *_: Tensor) -> Any:
            output = run(inputs[:n], inputs[n:])
            save(ctx, inputs, output)
            return output

        def short_backward(ctx: Any, *grads: Tensor | None) -> tuple:
            return None, *gradients(ctx, grads, ctx.needs_input_grad[1:])

        self.defined.register_autograd(backward, setup_context=save)
        methods = {"forward": staticmethod(forward), "backward": staticmethod(short_backward)}
        function = type(self.name, (torch.autograd.Function,), methods)
        # Its own `apply` looks for functorch's transforms first, as `goes_by_library` has done
        beyond: Any = super(torch.autograd.Function, function)
        apply = beyond.apply
        if lists:
            return lambda *inputs: apply(inputs, *_flat(inputs[:n]))
        return lambda *inputs: apply(inputs, *inputs[:n])

    def _save(self, ctx: Any, tensors: Sequence, options: Sequence, output: Any) -> None:
        ctx.options = options
        if not self._held:
            ctx.save_for_backward(*tensors)
            return
        held = output[self._shown :]
        ctx.mark_non_differentiable(*held)
        saved = [tensors[i] for i in self._to] if self._traced else tensors
        ctx.save_for_backward(*saved, *held)
        if self._shown == 1:  # no zeros for what is held, which may be large
            ctx.set_materialize_grads(False)

    def _gradients(
        self, saved: Tensors, grads: Sequence[Any], options: Sequence, needs: list[bool]
    ) -> Sequence[Tensor | None]:
        """What backward finds. Where a graph of it is asked for, going through that raises."""
        if not torch.is_grad_enabled():
            return self._found(saved, grads, options, needs)
        with torch.no_grad():
            found = self._found(saved, grads, options, needs)
        there = [g for g in found if g is not None]
        # Of constant gradients, too, such as those of a sum: they depend on what was saved
        marked = iter(_Once.apply(self.name, len(there), *there, *_flat(saved), *grads))
        return [None if g is None else next(marked) for g in found]

    def _found(
        self, saved: Tensors, grads: Sequence[Any], options: Sequence, needs: list[bool]
    ) -> Sequence[Tensor | None]:
        """What backward finds, by the shortest way there is."""
        if self._traced:
            return self._find(saved[len(self._to) :], grads, options, needs)
        grads = [g.contiguous() for g in grads[: self._shown]]
        sparse = self._sparse is not None and options[self._sparse]
        if sparse or not native.goes_by_library((*saved, *grads)):
            return self._find(saved, grads, options, needs)
        return self.backward(*saved, *grads, *options, needs)

    def _backward_kernel(self, *arguments: Any) -> list[Tensor]:
        start = self._tensors + self._held
        stop = start + self._shown
        saved, grads, needs = arguments[:start], arguments[start:stop], arguments[-1]
        found = self._find(saved, grads, arguments[stop:-1], needs)
        # An op cannot return None
        return [
            g if need and g is not None else grads[0].new_empty(0)
            for g, need in zip(found, needs, strict=True)
        ]

    def _backward_fake(self, *arguments: Any) -> list[Tensor]:
        tensors = _flat(arguments[i] for i in self._to)
        return [
            torch.empty_like(x) if need else x.new_empty(0)
            for x, need in zip(tensors, arguments[-1], strict=True)
        ]


class _Once(torch.autograd.Function):
    """Gradients of an op as they are, which have none themselves."""

    @staticmethod
    def forward(ctx: Any, name: str, count: int, *tensors: Tensor) -> tuple[Tensor, ...]:
        ctx.name = name
        return tuple(t.detach() for t in tensors[:count])

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> Any:
        raise RuntimeError(
            f"{ctx.name}: cannot differentiate twice, because only the reference of the op has "
            'second derivatives: use univoxel.ops.use_backend("reference")'
        )


def _backward_by_name(name: str, to: list[int], optional: list[bool]) -> Backward:
    name = f"{name}_backward"

    def backward(
        saved: Tensors, grads: Sequence[Tensor], options: Sequence, needs: list[bool]
    ) -> list[Tensor]:
        found = [
            torch.empty_like(saved[i]) if need or not spared else saved[i].new_empty(0)
            for i, spared, need in zip(to, optional, needs, strict=True)
        ]
        native.call(name, *saved, *grads, *found, *options)
        return found

    return backward


def _flat(values: Iterable) -> list:
    """Values, those of lists one by one."""
    flat = []
    for value in values:
        if isinstance(value, (list, tuple)):
            flat += value
        else:
            flat.append(value)
    return flat


def _grouped(flat: Sequence, lengths: Sequence[int | None]) -> Sequence:
    """What `_flat` was made of, and what follows it.

    Args:
        lengths: of the lists; None stands for a single tensor. Nothing: there are no lists.
    """
    if not lengths:
        return flat
    rest = iter(flat)
    groups = [next(rest) if n is None else list(islice(rest, n)) for n in lengths]
    return [*groups, *rest]
