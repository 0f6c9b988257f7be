"""Group commit: what waits is written in one transaction, many changes to an fsync.

It is written when somebody waits for it, so that what a decision changes is one commit. What comes while that is
written gathers for the next, so that under load a commit serves many answers. Where the store fails, nothing that waits
is lost: it is tried again, and meanwhile decisions go on while what must be on disk is refused.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections import deque
from itertools import islice

from service.observability.metrics import Metrics
from service.storage.operations import Change, Checkpoint, Entry
from service.storage.store import cause
from service.storage.writer import Writer

log = logging.getLogger(__name__)

# Changes to a commit, and bytes of checkpoints: networks of 10,000 sensors have megabytes each.
_MOST_AT_ONCE, _MOST_BYTES = 1000, 16_000_000
_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 0.25, 5.0
# The longest that what nobody waits for stays unwritten.
_LINGER_S = 0.25


class GroupCommit:
    """Has a writer write what is added, in order, and tells who waits when it is on disk; on the event loop."""

    def __init__(self, writer: Writer, metrics: Metrics) -> None:
        self._writer = writer
        self._metrics = metrics
        self._loop = asyncio.get_running_loop()
        self._queue: deque[tuple[int, Change]] = deque()
        self._added = self._written = 0
        # What is being written, since when, and whether it is the last attempt.
        self._batch: list[tuple[int, Change]] = []
        self._begun, self._last = 0.0, False
        # When it is written without being waited for, or tried again.
        self._later: asyncio.TimerHandle | None = None
        self._pause_s = _FIRST_PAUSE_S
        self._failing = False
        self._why = ""
        self._waiting: list[tuple[int, asyncio.Future[bool]]] = []
        self._over: asyncio.Future[None] | None = None

    @property
    def failing(self) -> bool:
        """Whether the last attempt to write failed."""
        return self._failing

    def add(self, change: Change) -> None:
        """To be written, in its turn."""
        self._added += 1
        self._queue.append((self._added, change))
        if self._later is None and not self._batch:
            self._later = self._loop.call_later(_LINGER_S, self._write)

    def supersede(self, taken: Checkpoint) -> None:
        """Add a checkpoint in the place of the last of the events that it stands for, which leave the queue.

        While the store fails events would gather without end. What comes after them is written no sooner than it.
        """
        covered = [ticket for ticket, change in self._queue if _covered(change, taken)]
        if not covered:
            self.add(taken)
            return
        kept = [(ticket, change) for ticket, change in self._queue if not _covered(change, taken)]
        self._queue = deque(sorted([*kept, (covered[-1], taken)], key=lambda entry: entry[0]))

    async def stored(self, within_s: float) -> bool:
        """Wait until all that happened so far is on disk; False where it is not in time, or the store fails."""
        if self._written >= self._added:
            return True
        if self._failing:
            return False
        written: asyncio.Future[bool] = self._loop.create_future()
        mine = self._added, written
        self._waiting.append(mine)
        self._write()
        try:
            async with asyncio.timeout(max(0.0, within_s)):
                return await written
        except TimeoutError:
            return False
        finally:
            if mine in self._waiting:
                self._waiting.remove(mine)

    async def close(self, ends: float) -> bool:
        """Write what waits, once more; returns whether that has ended by then, the loop's time."""
        over = self._over = self._loop.create_future()
        if not self._batch:
            self._go_on()
        try:
            async with asyncio.timeout_at(ends):
                await over
        except TimeoutError:
            return False
        self._writer.close()
        return True

    def _write(self) -> None:
        """Write what waits, unless some is being written: what is left follows when that has ended."""
        over = self._over is not None and self._over.done()
        if self._batch or not self._queue or over:
            return
        self._stop_waiting()
        packed = 0
        for entry in islice(self._queue, _MOST_AT_ONCE):
            self._batch.append(entry)
            packed += len(entry[1].state) if isinstance(entry[1], Checkpoint) else 0
            if packed > _MOST_BYTES:
                break
        self._begun, self._last = time.perf_counter(), self._over is not None
        try:
            self._writer.write([change for _, change in self._batch], self._ended)
        except Exception as error:
            self._loop.call_soon(self._ended, error)

    def _ended(self, error: Exception | None) -> None:
        if error is None:
            self._metrics.store_seconds.observe(time.perf_counter() - self._begun)
            self._done()
        else:
            self._fail(error)
        self._batch = []
        for ticket, waiting in self._waiting:
            if not waiting.done() and (ticket <= self._written or self._failing):
                waiting.set_result(ticket <= self._written)
        self._go_on()

    def _go_on(self) -> None:
        """What comes after an attempt, or at the end."""
        if self._over is not None and (not self._queue or (self._failing and self._last)):
            if self._queue:
                log.error(
                    "the store failed to the end: %d changes are not on disk, no outcome among them was acknowledged",
                    len(self._queue),
                )
            if not self._over.done():
                self._over.set_result(None)
        elif self._over is not None:
            self._write()
        elif self._failing:
            self._later = self._loop.call_later(self._pause_s, self._write)
            self._pause_s = min(2 * self._pause_s, _LONGEST_PAUSE_S)
        elif any(not waiting.done() for _, waiting in self._waiting):
            self._write()
        elif self._queue:
            self._later = self._loop.call_later(_LINGER_S, self._write)

    def _stop_waiting(self) -> None:
        if self._later is not None:
            self._later.cancel()
            self._later = None

    def _done(self) -> None:
        last = self._batch[-1][0]
        # A checkpoint may have come into their midst meanwhile.
        done = {id(change) for _, change in self._batch}
        while self._queue and id(self._queue[0][1]) in done:
            self._queue.popleft()
        if self._queue and self._queue[0][0] <= last:
            self._queue = deque(entry for entry in self._queue if id(entry[1]) not in done)
        if self._failing:
            log.warning("the store works again")
        self._failing, self._pause_s = False, _FIRST_PAUSE_S
        self._written = max(self._written, last)

    def _fail(self, error: Exception) -> None:
        self._metrics.store_failures.inc()
        why = cause(error)
        # Once each: where the database is away a while, and then another edge's, both are told.
        if not self._failing or why != self._why:
            log.error("the store fails, what waits is tried again: %s", why)
        self._failing, self._why = True, why


def _covered(change: Change, by: Checkpoint) -> bool:
    return isinstance(change, Entry | Checkpoint) and change.mission_id == by.mission_id and change.seq <= by.seq
