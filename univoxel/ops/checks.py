"""One check for the arguments of every op: sizes by letter, dtype, device."""

from __future__ import annotations

import torch
from torch import Tensor

from univoxel.records import Bricks


def check(
    op: str, **arguments: tuple[Tensor, str] | tuple[Tensor, str, torch.dtype]
) -> dict[str, int]:
    """Check the tensors of an op and return the size behind each letter.

    An argument is (tensor, sizes) or (tensor, sizes, dtype). Sizes are words: a letter binds a size
    the first time and must match afterwards ("M C"), a number must be met ("M 3"), a letter with an
    offset follows another ("N+1", bound by "N" elsewhere). Without a dtype the tensor is floating,
    of the same dtype as the other floating ones. All share one device.

    Raises:
        TypeError: an argument is no tensor.
        ValueError: a size, dtype or device is off; the message says what was wanted and what came.
    """
    sizes: dict[str, int] = {}
    floating: torch.dtype | None = None
    device: torch.device | None = None
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


def check_bricks(op: str, bricks: Bricks, **pools: tuple[Tensor, str]) -> None:
    """Check that pools of values have a row for each node of the bricks, or one for each brick.

    Args:
        pools: (tensor, sizes) as in `check`, the first size "R" for rows and "n" for bricks.

    Raises:
        TypeError, ValueError: as `check`; bricks is none, or of another size.
    """
    if not isinstance(bricks, Bricks):
        raise TypeError(f"{op}: bricks must be Bricks, got {type(bricks).__name__}")
    n = len(bricks.place)
    wanted = {"R": Bricks.NODES * n, "n": n}
    for name, (tensor, words) in pools.items():
        letter, *rest = words.split()
        check(op, **{name: (tensor, " ".join([str(wanted[letter]), *rest]))})
        if tensor.device != bricks.table.device:
            raise ValueError(f"{op}: bricks must be on {tensor.device}, got {bricks.table.device}")


def _matches(word: str, size: int, sizes: dict[str, int]) -> bool:
    """Hold one size against its word, binding the letter when it is new."""
    if word.isdigit():
        return size == int(word)
    letter, _, more = word.partition("+")
    size = size - int(more or 0)
    if size < 0:
        return False
    return sizes.setdefault(letter, size) == size
