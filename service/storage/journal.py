"""The journal: what changes missions is on disk before it is acknowledged, many changes to a commit.

It is written when somebody waits for it, so that what a decision changes is one commit. What comes while that is
written gathers for the next, so that under load a commit, and its fsync, serves many answers. Where the store fails,
nothing that waits is lost: it is tried again, and meanwhile decisions go on while what must be on disk is refused.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections import deque
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from itertools import islice
from typing import Any
from zlib import crc32

from service.mission.events import Decided, Event, unheard
from service.mission.mission import Mission
from service.observability.metrics import Metrics
from service.storage.operations import Change, Checkpoint, Deleted, Entry, Made
from service.storage.serialization import pack
from service.storage.store import Store, cause

log = logging.getLogger(__name__)

# A mission is checkpointed after so many events, so that it is read back in a fraction of a second. A decision about
# many sensors takes longer to play again: it counts for one more every hundred of them.
_EVENTS = 256
_SENSORS = 100
# With so many sensors a checkpoint takes up to a second to pack.
_LARGE = 1000
# Changes to a commit, and bytes of checkpoints: networks of 10,000 sensors have megabytes each.
_MOST_AT_ONCE, _MOST_BYTES = 1000, 16_000_000
_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 0.25, 5.0
# The longest that what nobody waits for stays unwritten.
_LINGER_S = 0.25


class MissionLog:
    """A mission's place in the journal.

    Attributes:
        seq: its newest event's.
        since: what it would take to read it back, in events, since its last checkpoint.
        over: it was deleted; what still happens to it is nobody's business, and another may have its ID.
    """

    def __init__(self, mission: Mission, seq: int, since: int) -> None:
        self.mission = mission
        self.seq = seq
        self.since = since
        self.over = False


class NullJournal:
    """Keeps nothing: missions live as long as the process."""

    failing = False

    def begin(self, mission: Mission) -> None:
        """Nothing is kept."""

    def end(self, mission_id: str) -> None:
        """Nothing was kept."""

    async def stored(self, within_s: float) -> bool:
        """Nobody waits for what nobody keeps."""
        return True

    async def close(self, within_s: float) -> bool:
        """Nobody writes."""
        return True


class Journal:
    """Writes to a store; on the event loop."""

    def __init__(self, store: Store, metrics: Metrics) -> None:
        self._writer = store.writer()
        self._metrics = metrics
        self._loop = asyncio.get_running_loop()
        self._tracks: dict[str, MissionLog] = {}
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
        self._packing = ThreadPoolExecutor(max_workers=1, thread_name_prefix="checkpoints")
        self._packed: set[asyncio.Future[bytes]] = set()

    @property
    def failing(self) -> bool:
        """Whether the last attempt to write failed."""
        return self._failing

    def begin(self, mission: Mission) -> None:
        """A mission is made, and its events are heard from now on."""
        self._add(Made(mission.mission_id, mission.asked_for, mission.spec))
        # Missions that begin together, and fly alike, are not to be checkpointed all at once.
        self._follow(mission, 0, crc32(mission.mission_id.encode()) % _EVENTS)

    def follow(self, mission: Mission, seq: int, played: Sequence[Event]) -> None:
        """Hear a mission's events, of which so many are in the store, these since its last checkpoint."""
        self._follow(mission, seq, sum(map(_weight, played)))

    def _follow(self, mission: Mission, seq: int, since: int) -> None:
        track = MissionLog(mission, seq, since)
        self._tracks[mission.mission_id] = track

        def record(event: Event) -> None:
            if track.over:
                return
            track.seq += 1
            track.since += _weight(event)
            self._add(Entry(mission.mission_id, track.seq, event))

        mission.record = record

    def end(self, mission_id: str) -> None:
        """A mission is deleted."""
        if (track := self._tracks.pop(mission_id, None)) is not None:
            track.over = True
            # Mission and hearer hold each other: all of it would stay in memory until a collection finds it.
            track.mission.record = unheard
        self._add(Deleted(mission_id))

    def due(self, mission: Mission, least: int = _EVENTS) -> MissionLog | None:
        """The mission's track, where it has so many events since its last checkpoint; they are counted anew then."""
        track = self._tracks.get(mission.mission_id)
        if track is None or track.mission is not mission or track.since < least:
            return None
        track.since = 0
        return track

    def checkpoint(self, track: MissionLog, state: dict[str, Any]) -> None:
        """Keep a mission's state as it is now in place of the events until now.

        While the store fails events would gather without end, so those that the checkpoint stands for leave the queue.
        It takes the place of the last of them: what comes after is written no sooner than it.
        """
        if track.mission.scenario.sensors >= _LARGE:
            # Beside the decisions, one after the other; meanwhile the journal has the events that it stands for.
            packing = self._loop.run_in_executor(self._packing, pack, state)
            self._packed.add(packing)
            packing.add_done_callback(partial(self._take_packed, track, track.seq))
        else:
            # Packed at once: as it is, it would take the memory of a thousand small objects until it is written.
            self._take(track, track.seq, pack(state))

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

    async def close(self, within_s: float) -> bool:
        """Write what waits, once more; returns whether that has ended, and the store may be closed."""
        ends = self._loop.time() + within_s
        if self._packed:
            await asyncio.wait(self._packed, timeout=within_s)
        self._packing.shutdown(wait=False, cancel_futures=True)
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

    def _take_packed(self, track: MissionLog, seq: int, packing: asyncio.Future[bytes]) -> None:
        self._packed.discard(packing)
        if packing.cancelled():
            return
        if (error := packing.exception()) is not None:
            log.error("a checkpoint could not be made, the journal has its events: %r", error)
            return
        self._take(track, seq, packing.result())

    def _take(self, track: MissionLog, seq: int, packed: bytes) -> None:
        if track.over:
            return
        taken = Checkpoint(track.mission.mission_id, seq, packed)
        covered = [ticket for ticket, change in self._queue if _covered(change, taken)]
        if not covered:
            self._add(taken)
            return
        kept = [(ticket, change) for ticket, change in self._queue if not _covered(change, taken)]
        self._queue = deque(sorted([*kept, (covered[-1], taken)], key=lambda entry: entry[0]))

    def _add(self, change: Change) -> None:
        self._added += 1
        self._queue.append((self._added, change))
        if self._later is None and not self._batch:
            self._later = self._loop.call_later(_LINGER_S, self._write)

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


def _weight(event: Event) -> int:
    """What it takes to play an event again, in events of a small network: a lesson grows with the sensors."""
    if isinstance(event, Decided) and event.decision.sample is not None:
        return 1 + len(event.decision.sample.features) // _SENSORS
    return 1


def _covered(change: Change, by: Checkpoint) -> bool:
    return isinstance(change, Entry | Checkpoint) and change.mission_id == by.mission_id and change.seq <= by.seq
