"""Independent pieces of work, side by side."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Protocol, TypeVar

import torch

Item = TypeVar("Item")
Result = TypeVar("Result")


def side_by_side(call: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
    """The results of `call`, in order; as many are made at once as torch has threads.

    torch's own threads share out single operations. Where many small ones follow one another, a
    thread for each piece, whose numbers stay in its core's cache, is several times as fast.
    """
    threads = torch.get_num_threads()
    if threads == 1:
        return [call(item) for item in items]
    with ThreadPoolExecutor(threads) as pool:
        return list(pool.map(call, items))


class Team(Protocol):
    """Threads that work on independent pieces, again and again."""

    def __call__(self, call: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
        """The results of `call`, in order."""
        ...


@contextmanager
def team(size: int) -> Iterator[Team]:
    """A team of `size` threads, or as many as torch has, that share torch's threads out among
    them; a single one is the caller."""
    threads = torch.get_num_threads()
    size = min(size, threads)
    if size == 1:
        yield lambda call, items: [call(item) for item in items]
        return
    each = threads // size

    def work(call: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
        # The number is each thread's own for some of torch's parts, and everybody's for others
        torch.set_num_threads(each)
        try:
            return list(pool.map(call, items))
        finally:
            torch.set_num_threads(threads)

    with ThreadPoolExecutor(size, initializer=torch.set_num_threads, initargs=(each,)) as pool:
        yield work
