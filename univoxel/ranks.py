"""One training in several processes, its ranks, as `torchrun` begins them.

Every rank holds the whole scene and does the same in the same order: it draws the same numbers and
takes the same steps. What is dear is shared out: `mine` is a rank's share of pieces of work, and
`gathered`, `total` and `messages` give every rank what all of them have made. Sums are the same
bits on all ranks. In a training of one process nothing is exchanged, and every function gives back
what it was given.
"""

from __future__ import annotations

import atexit
import logging
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import timedelta
from types import FrameType
from typing import Any, TypeAlias, TypeVar

import torch
from safetensors.torch import load, save
from torch import Tensor, distributed
from torch.distributed.rendezvous import rendezvous

from univoxel.errors import ProcessFailed

Item = TypeVar("Item")
Tensors: TypeAlias = "tuple[Tensor, ...]"

PATIENCE = timedelta(minutes=10)  # for a rank that does not answer; the first one writes meanwhile
STAY = 5.0  # s that the first rank is there for the others, after an error

ERRORS = "univoxel: errors"  # key of the store: how many ranks have met an error

log: logging.Logger = logging.getLogger("univoxel")


@dataclass
class _Group:
    """What a process knows of the others; none of it where there is one process alone."""

    store: Any = None  # of torch: keys that all ranks see
    now: float | None = None  # as of the last exchange, on the first rank's clock
    sent: int = 0  # bytes that all ranks together gave to the others in exchanges


_group = _Group()


def began_by_torchrun() -> bool:
    """Whether this process is one of several that `torchrun` began."""
    return "TORCHELASTIC_RUN_ID" in os.environ and int(os.environ.get("WORLD_SIZE", "1")) > 1


def leads() -> bool:
    """Whether this process writes what all have made, and speaks: the first rank, or the only
    process."""
    return not began_by_torchrun() or int(os.environ["RANK"]) == 0


def count() -> int:
    """How many ranks share the work, >= 1."""
    return 1 if _group.store is None else distributed.get_world_size()


def rank() -> int:
    """Number of this one, from 0."""
    return 0 if _group.store is None else distributed.get_rank()


@contextmanager
def joined() -> Iterator[None]:
    """A block in which the ranks that `torchrun` began work together; all have to enter it.

    All but the first are silent. Of an error only the rank says something that meets it first: the
    others fail of that.

    Raises:
        ProcessFailed: another rank has ended, or does not answer.
        SystemExit: the same, where that has been said already.
    """
    if not began_by_torchrun() or _group.store is not None:
        yield
        return
    for name in ("MASTER_ADDR", "MASTER_PORT"):
        if name not in os.environ:
            raise ProcessFailed(f"expected {name} in the environment, as torchrun sets it")
    with _lost():
        store, number, size = next(rendezvous("env://", timeout=PATIENCE))
    disabled, before = log.disabled, None
    try:
        with _lost():
            distributed.init_process_group(
                "gloo", store=store, rank=number, world_size=size, timeout=PATIENCE
            )
        _group.store, log.disabled = store, disabled or number > 0
        if threading.current_thread() is threading.main_thread():
            before = signal.signal(signal.SIGTERM, _ended)
        tick()
        yield
        tick()  # none ends before all are done: torchrun would take that for a failure
    except (Exception, KeyboardInterrupt):
        if number == 0:
            atexit.register(_stay, store, size)
        if _said_already(store):
            raise SystemExit(2) from None
        raise
    finally:
        if before is not None:
            signal.signal(signal.SIGTERM, before)
        log.disabled = disabled
        _group.store, _group.now = None, None
        if distributed.is_initialized():
            with suppress(RuntimeError):
                distributed.destroy_process_group()


@contextmanager
def alone() -> Iterator[None]:
    """A block that this rank works through by itself, as if there were one process: the others do
    something else meanwhile."""
    store, _group.store = _group.store, None
    try:
        yield
    finally:
        _group.store = store


@contextmanager
def in_turn() -> Iterator[None]:
    """A block that the first rank has to have left before the others enter: it makes files."""
    if rank() > 0:
        tick()
    yield
    if rank() == 0:
        tick()


def now() -> float:
    """Seconds on time.monotonic's clock; of several ranks on the first one's, as it was at the last
    exchange: what depends on time is decided alike."""
    return time.monotonic() if _group.now is None else _group.now


def tick() -> float:
    """`now` as it is now; all ranks have to ask."""
    if _group.store is None:
        return time.monotonic()
    clock = torch.tensor([time.monotonic()], dtype=torch.float64)
    with _lost():
        distributed.broadcast(clock, 0)
    _group.now = clock.item()
    return _group.now


def sent_bytes() -> int:
    """What all ranks together have sent so far in `messages` and `total`: each number counts once
    for every rank that it comes from."""
    return _group.sent


def mine(pieces: Sequence[Item]) -> Sequence[Item]:
    """This rank's share of pieces of work: every `count`-th."""
    return pieces[share()]


def share() -> slice:
    """Which of pieces of work are this rank's."""
    return slice(rank(), None, count())


def gathered(results: Sequence[Tensors]) -> list[Tensors]:
    """Of what each rank made of its `mine`, that of all pieces, in their order."""
    if _group.store is None:
        return list(results)
    named = {f"{i} {k}": t.contiguous() for i, ts in enumerate(results) for k, t in enumerate(ts)}
    packed = torch.frombuffer(bytearray(save(named)), dtype=torch.uint8)
    padded = torch.nn.functional.pad(packed, (0, -len(packed) % 4)).view(torch.int32)
    header = torch.tensor([len(packed), len(results)], dtype=torch.int32)
    of_ranks = [_unpacked(message) for message in messages(torch.cat([header, padded]))]
    whole: list[Tensors] = [()] * sum(map(len, of_ranks))
    for number, several in enumerate(of_ranks):
        whole[number :: count()] = several
    return whole


def _unpacked(message: Tensor) -> list[Tensors]:
    length, pieces = message[:2].tolist()
    found = load(message[2:].numpy().tobytes()[:length])
    widths = [sum(name.startswith(f"{i} ") for name in found) for i in range(pieces)]
    return [tuple(found[f"{i} {k}"] for k in range(width)) for i, width in enumerate(widths)]


def shared(call: Callable[[Item], Tensors], pieces: Sequence[Item]) -> list[Tensors]:
    """The results of `call`, in order; each rank makes its share of them."""
    return gathered([call(piece) for piece in mine(pieces)])


def spread_(results: Sequence[Tensor] | Tensor) -> None:
    """Of tensors that are pieces of work, of which each rank has filled its `mine`: fill the others
    with what their ranks have made."""
    if _group.store is None:
        return
    with _lost():
        for number, result in enumerate(results):
            distributed.broadcast(result, number % count())
            _group.sent += result.nbytes


def messages(message: Tensor) -> list[Tensor]:
    """What each rank tells all others, in the order of ranks; each int32 [N], N its own."""
    if _group.store is None:
        return [message]
    length = torch.tensor([len(message), 0], dtype=torch.float64)
    length[1] = time.monotonic()
    lengths = [torch.empty_like(length) for _ in range(count())]
    with _lost():
        distributed.all_gather(lengths, length)
        sizes = [int(each[0]) for each in lengths]
        padded = torch.nn.functional.pad(message, (0, max(sizes) - len(message)))
        told = [torch.empty_like(padded) for _ in sizes]
        distributed.all_gather(told, padded)
    _group.now = lengths[0][1].item()
    _group.sent += 4 * sum(sizes)
    return [each[:size] for each, size in zip(told, sizes, strict=True)]


def once(part: Tensor) -> Tensor:
    """What counts once in a `total`: the same on the first rank, zeros on the others."""
    return part if rank() == 0 else torch.zeros_like(part)


def total(part: Tensor) -> Tensor:
    """The sum of all ranks' parts, which have one shape."""
    if _group.store is None:
        return part
    summed = part.clone(memory_format=torch.contiguous_format)
    with _lost():
        distributed.all_reduce(summed)
    _group.sent += summed.nbytes * count()
    return summed


def as_first_(tensors: Sequence[Tensor]) -> None:
    """Give tensors, and torch's random numbers to come, the first rank's values."""
    if _group.store is None:
        return
    state = torch.get_rng_state()
    with _lost():
        for tensor in (*tensors, state):
            distributed.broadcast(tensor, 0)
    torch.set_rng_state(state)


@contextmanager
def _lost() -> Iterator[None]:
    """A block that fails where another rank is no more."""
    try:
        yield
    except RuntimeError as error:  # of gloo and of the store
        raise ProcessFailed(LOST, "resume") from error


LOST = (
    "another process of this training has ended, or does not answer: what was saved stays, pass "
    "resume to go on with it, in as many processes as you like"
)


def _ended(_signal: int, _frame: FrameType | None) -> None:
    """torchrun ends the ranks that are left, where one has ended."""
    signal.signal(signal.SIGTERM, signal.SIG_IGN)  # once is enough
    raise ProcessFailed(LOST, "resume")


def _said_already(store: Any) -> bool:
    """Whether another rank has met an error before; from now on one has."""
    try:
        return store.add(ERRORS, 1) > 1
    except RuntimeError:  # it has ended with the first one's machine
        return False


def _stay(store: Any, size: int) -> None:
    """Wait until all ranks have asked whether the error has been said: the store that they ask ends
    with this process."""
    end = time.monotonic() + STAY
    with suppress(RuntimeError):  # the store was another process's, which has ended
        while store.add(ERRORS, 0) < size and time.monotonic() < end:
            time.sleep(0.05)
