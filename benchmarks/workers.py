"""A contender in a process of its own: what breaks there cannot reach the others.

Compiled code of a peer has written past its buffers: torch.compile of a reference ended the whole
run with a corrupted heap. The processes still take turns, so that a noisy machine treats all alike.
"""

from __future__ import annotations

import multiprocessing
import time
from collections.abc import Callable
from multiprocessing.connection import Connection

import torch


class Worker:
    """Builds `make(*arguments)` elsewhere and runs it on demand."""

    def __init__(self, make: Callable[..., Callable[[], object]], *arguments) -> None:
        context = multiprocessing.get_context("spawn")  # fork would copy a stopped OpenMP team
        self._pipe, theirs = context.Pipe()
        threads = torch.get_num_threads()
        self._process = context.Process(
            target=_serve, args=(theirs, threads, make, arguments), daemon=True
        )
        self._process.start()
        theirs.close()
        self._answer()

    def __call__(self) -> float:
        """Run once; milliseconds.

        Raises:
            RuntimeError: it failed, or its process is gone.
        """
        self._pipe.send(True)
        return self._answer()

    def close(self) -> None:
        self._pipe.close()
        self._process.join(timeout=10)
        self._process.kill()

    def _answer(self):
        try:
            answer = self._pipe.recv()
        except EOFError:
            self._process.join()
            raise RuntimeError(f"its process ended with {self._process.exitcode}") from None
        if isinstance(answer, str):
            raise RuntimeError(answer)
        return answer


def milliseconds(run: Callable[[], object]) -> float:
    start = time.perf_counter()
    run()
    return 1e3 * (time.perf_counter() - start)


def _serve(pipe: Connection, threads: int, make: Callable, arguments: tuple) -> None:
    torch.set_num_threads(threads)
    try:
        run = make(*arguments)
        run()
        run()
        pipe.send(None)
        while pipe.recv():
            pipe.send(milliseconds(run))
    except EOFError:  # no more turns
        pass
    except Exception as error:
        pipe.send(str(error).splitlines()[0] if str(error) else type(error).__name__)
