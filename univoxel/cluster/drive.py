"""Pieces of work, handed out to workers until each is done or has failed."""

from __future__ import annotations

import dataclasses
import logging
import queue
import time
import uuid
from collections import Counter
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

from univoxel.cluster.piece import Ended, Piece, Told
from univoxel.cluster.shown import Shown
from univoxel.cluster.work import Unwanted, on_worker
from univoxel.errors import ProcessFailed

if TYPE_CHECKING:
    from distributed import Client

TICK_SECONDS = 0.5
AGAIN_SECONDS = 3.0  # until a piece is asked for again that others are at work on
LOST_SECONDS = 10.0  # that a scheduler may be away

log: logging.Logger = logging.getLogger("univoxel")


class Drive:
    """The pieces that are not done yet, and what is known of them."""

    def __init__(self, client: Client, pieces: Sequence[Piece], tries: int) -> None:
        self.pieces: dict[str, Piece] = {piece.name: piece for piece in pieces}
        self.topic: str = f"univoxel-{uuid.uuid4().hex}"
        self.told: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
        self._client, self._tries = client, tries
        self._ended: queue.SimpleQueue[Any] = queue.SimpleQueue()  # futures
        self._names: dict[Any, str] = {}  # of pieces, by keys of futures
        self._later: dict[str, float] = {}  # when a piece is asked for again, by name
        self._died: Counter[str] = Counter()
        self._asked = 0
        self._lost: float | None = None  # since when the scheduler is away
        client.subscribe_topic(self.topic, lambda event: self.told.put(event[1]))

    def ask(self, name: str) -> None:
        """Hand a piece to the workers."""
        self._asked += 1
        key = (self.topic, name, self._asked)
        future = self._client.submit(on_worker, self.pieces[name], self.topic, key=key, pure=False)
        self._names[future.key] = name
        future.add_done_callback(self._ended.put)

    def ended(self) -> Iterator[Ended]:
        """The pieces that have come to an end since the last call, after at most a tick.

        Raises:
            ProcessFailed: the scheduler is gone.
        """
        self._check_scheduler()
        for name in [n for n, when in self._later.items() if when <= time.monotonic()]:
            del self._later[name]
            self.ask(name)
        try:
            future = self._ended.get(timeout=TICK_SECONDS)
        except queue.Empty:
            return
        found = self._found(future)
        if found.state == "taken":
            self._later[found.name] = time.monotonic() + AGAIN_SECONDS
        elif found.state == "died" and self._died[found.name] + 1 < self._tries:
            self._died[found.name] += 1
            log.info("%s: %s, is tried again", found.name, _line(found))
            self.ask(found.name)
        else:
            yield self._last(found)

    def close(self) -> None:
        """Listen no more."""
        if self._client.status == "running":
            self._client.unsubscribe_topic(self.topic)

    def _check_scheduler(self) -> None:
        if self._client.status == "running":
            self._lost = None
            return
        self._lost = time.monotonic() if self._lost is None else self._lost
        if self._client.status == "closed" or time.monotonic() - self._lost > LOST_SECONDS:
            raise ProcessFailed("the scheduler is gone: the same command goes on")

    def _found(self, future: Any) -> Ended:
        """What a task returned, or what its end says.

        Raises:
            ProcessFailed: the scheduler is gone, or a worker cannot do it.
        """
        from distributed import KilledWorker

        name = self._names.pop(future.key)
        if future.cancelled() or future.status == "lost":
            raise ProcessFailed("the scheduler is gone: the same command goes on")
        error = future.exception()
        if error is None:
            return future.result()
        match error:
            case KilledWorker():
                return Ended(name, "failed", {"worker": "every worker that took it died"})
            case Unwanted():  # by a worker that is closing
                return Ended(name, "taken")
            case ImportError():
                raise ProcessFailed(f"a worker has another univoxel than this, or none: {error}")
        raise error

    def _last(self, found: Ended) -> Ended:
        """The end of a piece, where one that died has failed."""
        if found.state != "died":
            return found
        times = f", {self._tries} times" if self._tries > 1 else ""
        hint = "; the system does so where memory is short" if "KILL" in _line(found) else ""
        errors = {step: f"{said}{times}{hint}" for step, said in found.errors.items()}
        return dataclasses.replace(found, state="failed", errors=errors)


def drive(client: Client, pieces: Sequence[Piece], total: int, tries: int = 3) -> Iterator[Ended]:
    """Let workers do pieces; give each as it ends, done or failed.

    Args:
        total: pieces with those that were done before, for the bar.
        tries: processes of a piece that may be killed until it counts as failed, >= 1.

    Raises:
        ProcessFailed: the scheduler is gone.
    """
    if not pieces:
        return
    work = Drive(client, pieces, tries)
    left = set(work.pieces)
    try:
        with Shown(pieces, total) as shown:
            for name in work.pieces:
                work.ask(name)
            while left:
                for found in work.ended():
                    left.discard(found.name)
                    shown.ended(found)
                    yield found
                while not work.told.empty():
                    shown.now(Told(**_own(work.told.get())))
                shown.refresh(_slots(client))
    finally:
        work.close()


def _own(event: dict[str, Any]) -> dict[str, Any]:
    """An event without what Dask adds."""
    names = {field.name for field in dataclasses.fields(Told)}
    return {name: value for name, value in event.items() if name in names}


def _slots(client: Any) -> int:
    """Pieces that workers take at once."""
    try:
        return sum(client.nthreads().values()) if client.status == "running" else 0
    except OSError:  # it has gone this moment
        return 0


def _line(found: Ended) -> str:
    return "; ".join(found.errors.values())
