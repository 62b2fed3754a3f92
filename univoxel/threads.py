"""Independent pieces of work, side by side."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

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
