"""Group commit: all waiting changes are written in one transaction, so that one fsync serves many of them.

A transaction begins as soon as a request waits for its changes; without one, a quarter of a second after the first
change. Changes that arrive while a transaction runs form the next one, so that under load a commit serves many answers.
A failed transaction loses nothing: its changes stay in the queue and are tried again after a pause. Meanwhile decisions
continue, and requests whose changes must be durable are refused. Only the changes of missions that other edges have
taken over are dropped.
"""

import asyncio
import logging
import time
from collections import deque
from collections.abc import Callable
from enum import Enum
from itertools import islice

from service.observability.metrics import Metrics
from service.storage.leases import LeaseLost
from service.storage.operations import Change, Checkpoint, Deleted, Entry, WriteFailed, Writer
from service.storage.store import cause

log = logging.getLogger(__name__)

# Changes in a transaction, and bytes of checkpoints: those of large networks have megabytes.
_MOST_CHANGES, MOST_BYTES = 1000, 16_000_000
_FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.25, 5.0
# The longest wait of a change for others if no request waits for it.
_LINGER_S = 0.25


class _CommitState(Enum):
    """The states of the queue."""

    # The queue is empty. The next change begins LINGERING.
    IDLE = "idle"
    # A timer, or the first waiting request, begins a transaction.
    LINGERING = "lingering"
    # A transaction runs.
    WRITING = "writing"
    # The last transaction failed. A timer begins the next one.
    PAUSING = "pausing"
    # The first transaction since `close` was called, or the one that ran then. If it fails, it is tried once more.
    DRAINING = "draining"
    # A later transaction runs. If it fails, the queue is abandoned.
    FINISHING = "finishing"
    # No further transaction begins.
    CLOSED = "closed"


class GroupCommit:
    """A queue of changes in front of a writer; used on the event loop only.

    Every change has a ticket, a number that grows. All changes up to the ticket ``_written`` are durable or dropped.

    Args:
        on_lost: called with the ID and lost epoch of a mission that another edge has taken over, before any request
            that waits for its changes is answered.
        on_recovery: called after the first success that follows failures.
    """

    def __init__(
        self, writer: Writer, metrics: Metrics, on_lost: Callable[[str, int], None], on_recovery: Callable[[], None]
    ) -> None:
        self._writer = writer
        self._on_lost = on_lost
        self._on_recovery = on_recovery
        self._metrics = metrics
        self._loop = asyncio.get_running_loop()
        self._state = _CommitState.IDLE
        # A change leaves the queue once it is durable.
        self._queue: deque[tuple[int, Change]] = deque()
        self._added = self._written = 0
        # The changes of the transaction that runs, and its beginning.
        self._batch: list[tuple[int, Change]] = []
        self._started_at = 0.0
        # Ends LINGERING or PAUSING.
        self._timer: asyncio.TimerHandle | None = None
        self._pause_s = _FIRST_PAUSE_S
        # Why the last transaction failed, if it did.
        self._failure: str | None = None
        # Whether it will fail until someone acts.
        self._lasting = False
        # Requests that wait: the ticket that each needs, and whether it was reached.
        self._requests: list[tuple[int, asyncio.Future[bool]]] = []
        # Made by `close`; done once the state is CLOSED, cancelled where `close` ran out of time.
        self._closed: asyncio.Future[None] | None = None

    @property
    def failing(self) -> bool:
        """Whether the last transaction failed."""
        return self._failure is not None

    @property
    def fault(self) -> str | None:
        """Why every transaction will fail until someone acts; None if there is no such reason."""
        return self._failure if self._lasting else None

    def add(self, change: Change) -> None:
        """Queue a change behind all others."""
        self._added += 1
        self._queue.append((self._added, change))
        if self._state is _CommitState.IDLE:
            self._linger()

    def deleting(self, mission_id: str) -> bool:
        """Whether a deletion of the mission is not durable yet."""
        return any(isinstance(change, Deleted) and change.mission_id == mission_id for _, change in self._queue)

    def supersede(self, checkpoint: Checkpoint) -> None:
        """Queue a checkpoint in place of the mission's queued events that it covers, at the last one's position.

        While the store fails, the queue would otherwise grow without bound. Later changes are still written after it.
        """
        covered = [ticket for ticket, change in self._queue if _covers(checkpoint, change)]
        if not covered:
            self.add(checkpoint)
            return
        others = [(ticket, change) for ticket, change in self._queue if not _covers(checkpoint, change)]
        self._queue = deque(sorted([*others, (covered[-1], checkpoint)], key=lambda entry: entry[0]))

    async def stored(self, within_s: float) -> bool:
        """Wait until every change so far is durable; False if that takes longer, or if the store fails."""
        if self._written >= self._added:
            return True
        if self._failure is not None:
            return False
        reached: asyncio.Future[bool] = self._loop.create_future()
        request = self._added, reached
        self._requests.append(request)
        if self._state is _CommitState.LINGERING:
            self._begin(_CommitState.WRITING)
        expiry = self._loop.call_later(max(0.0, within_s), _answer_late, reached)
        try:
            return await reached
        finally:
            expiry.cancel()
            if request in self._requests:
                self._requests.remove(request)

    async def close(self, ends: float) -> bool:
        """Try once more to write the queue; returns whether that ended before ``ends``, a time of the event loop."""
        closed = self._closed = self._loop.create_future()
        match self._state:
            case _CommitState.WRITING:
                self._state = _CommitState.DRAINING
            case _CommitState.LINGERING | _CommitState.PAUSING:
                self._begin(_CommitState.DRAINING)
            case _CommitState.IDLE | _CommitState.CLOSED:
                self._end()
        try:
            async with asyncio.timeout_at(ends):
                await closed
        except TimeoutError:
            return False
        self._writer.close()
        return True

    def _linger(self) -> None:
        self._state = _CommitState.LINGERING
        self._timer = self._loop.call_later(_LINGER_S, self._begin, _CommitState.WRITING)

    def _begin(self, state: _CommitState) -> None:
        """Begin a transaction of the first changes of the queue."""
        self._stop_timer()
        self._state = state
        checkpoint_bytes = 0
        for entry in islice(self._queue, _MOST_CHANGES):
            self._batch.append(entry)
            checkpoint_bytes += len(entry[1].state) if isinstance(entry[1], Checkpoint) else 0
            if checkpoint_bytes > MOST_BYTES:
                break
        self._started_at = time.perf_counter()
        try:
            self._writer.write([change for _, change in self._batch], self._written_or_failed)
        except Exception as error:
            self._loop.call_soon(self._written_or_failed, error)

    def _written_or_failed(self, error: Exception | None) -> None:
        """After a transaction: answer the requests that waited for it, and go to the next state."""
        if error is None:
            self._succeed()
        elif isinstance(error, LeaseLost):
            self._drop(error)
        else:
            self._fail(error)
        self._batch = []
        for ticket, reached in self._requests:
            if not reached.done() and (ticket <= self._written or self._failure is not None):
                reached.set_result(ticket <= self._written)
        if self._state is _CommitState.WRITING:
            self._go_on()
        else:
            self._go_on_closing()

    def _go_on(self) -> None:
        if self._failure is not None:
            self._state = _CommitState.PAUSING
            self._timer = self._loop.call_later(self._pause_s, self._begin, _CommitState.WRITING)
            self._pause_s = min(2 * self._pause_s, LONGEST_PAUSE_S)
        elif not self._queue:
            self._state = _CommitState.IDLE
        elif any(not reached.done() for _, reached in self._requests):
            self._begin(_CommitState.WRITING)
        else:
            self._linger()

    def _go_on_closing(self) -> None:
        assert self._closed is not None
        abandoned = self._failure is not None and self._state is _CommitState.FINISHING
        if abandoned and self._queue:
            log.error(
                "the last write to the store failed: %d changes are not on disk, no acknowledged outcome among them",
                len(self._queue),
            )
        if abandoned or not self._queue or self._closed.done():
            self._end()
        else:
            self._begin(_CommitState.FINISHING)

    def _end(self) -> None:
        self._state = _CommitState.CLOSED
        self._stop_timer()
        if self._closed is not None and not self._closed.done():
            self._closed.set_result(None)

    def _stop_timer(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _succeed(self) -> None:
        """Take the durable changes from the queue."""
        self._metrics.store_seconds.observe(time.perf_counter() - self._started_at)
        last = self._batch[-1][0]
        # `supersede` may have inserted a checkpoint among them, which is not durable yet.
        durable = {id(change) for _, change in self._batch}
        while self._queue and id(self._queue[0][1]) in durable:
            self._queue.popleft()
        if self._queue and self._queue[0][0] <= last:
            self._queue = deque(entry for entry in self._queue if id(entry[1]) not in durable)
        if self._failure is not None:
            self._recover()
        self._written = max(self._written, last)

    def _drop(self, error: LeaseLost) -> None:
        """Take the changes of lost missions from the queue; nothing of the transaction was written."""
        if self._failure is not None:
            self._recover()
        self._queue = deque(e for e in self._queue if (e[1].mission_id, e[1].epoch) not in error.lost)
        self._written = max(self._written, self._queue[0][0] - 1 if self._queue else self._added)
        for mission_id, epoch in error.lost:
            self._on_lost(mission_id, epoch)

    def _recover(self) -> None:
        log.warning("the store works again")
        self._failure, self._lasting, self._pause_s = None, False, _FIRST_PAUSE_S
        self._on_recovery()

    def _fail(self, error: Exception) -> None:
        self._metrics.store_failures.inc()
        failure = cause(error)
        # Consecutive failures of one cause are logged once.
        if failure != self._failure:
            log.error("the store fails, queued changes are tried again: %s", failure)
        self._failure, self._lasting = failure, isinstance(error, WriteFailed) and error.lasting


def _answer_late(reached: asyncio.Future[bool]) -> None:
    """End a request's wait: its changes are not durable yet."""
    if not reached.done():
        reached.set_result(False)


def _covers(checkpoint: Checkpoint, change: Change) -> bool:
    """Whether a change is an event, or an older checkpoint, that the checkpoint makes unnecessary."""
    if not isinstance(change, Entry | Checkpoint):
        return False
    return change.mission_id == checkpoint.mission_id and change.seq <= checkpoint.seq
