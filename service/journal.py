"""The journal: what changes missions is on disk before it is acknowledged, many changes to a commit.

One thread writes, when somebody waits for it, so that what a decision changes is one commit. What comes while it
commits gathers for the next, so that under load a commit, and its fsync, serves many answers. Where the store fails,
nothing that waits is lost: it is tried again, and meanwhile decisions go on while what must be on disk is refused.
"""

from __future__ import annotations

import asyncio
import logging
import threading
import time
from collections import deque
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from typing import Any
from zlib import crc32

from service.events import Decided, Event, unheard
from service.metrics import Metrics
from service.mission import Mission
from service.packing import pack
from service.store import Checkpoint, Deleted, Entry, Item, Made, Store, cause

log = logging.getLogger(__name__)

# A mission is checkpointed after so many events, so that it is read back in a fraction of a second. A decision about
# many sensors takes longer to play again: it counts for one more every hundred of them.
_EVENTS = 256
_SENSORS = 100
# With so many sensors a checkpoint takes up to a second to pack.
_LARGE = 1000
_MOST_AT_ONCE = 1000
_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 0.25, 5.0
# The longest that what nobody waits for stays unwritten.
_LINGER_S = 0.25


class Track:
    """A mission's place in the journal.

    Attributes:
        seq: its newest event's.
        checkpointed: the newest event that a checkpoint stands for, -1 for none.
        since: what it would take to read it back, in events, since its last checkpoint.
        over: it was deleted; what still happens to it is nobody's business, and another may have its ID.
    """

    def __init__(self, mission: Mission, seq: int, since: int) -> None:
        self.mission = mission
        self.seq = seq
        self.checkpointed = -1
        self.since = since
        self.over = False


class Unkept:
    """Keeps nothing: missions live as long as the process."""

    failing = False

    def begin(self, mission: Mission) -> None:
        """Nothing is kept."""

    def end(self, mission_id: str) -> None:
        """Nothing was kept."""

    async def stored(self, within_s: float) -> bool:
        """Nobody waits for what nobody keeps."""
        return True

    def close(self, within_s: float) -> bool:
        """Nobody writes."""
        return True


class Journal:
    """Writes to a store. Called from the event loop, or when that has ended."""

    def __init__(self, store: Store, metrics: Metrics) -> None:
        self._store = store
        self._metrics = metrics
        self._loop = asyncio.get_running_loop()
        self._tracks: dict[str, Track] = {}
        self._queue: deque[tuple[int, Item]] = deque()
        self._changed = threading.Condition()
        self._added = self._wanted = self._written = 0
        self._failing = self._closing = False
        self._why = ""
        self._waiting: list[tuple[int, asyncio.Future[bool]]] = []
        self._packing = ThreadPoolExecutor(max_workers=1, thread_name_prefix="checkpoints")
        self._thread = threading.Thread(target=self._write, name="journal", daemon=True)
        self._thread.start()

    @property
    def failing(self) -> bool:
        """Whether the last attempt to write failed."""
        return self._failing

    def begin(self, mission: Mission) -> None:
        """A mission is made, and its events are heard from now on."""
        with self._changed:
            self._add(Made(mission.mission_id, mission.asked_for, mission.spec))
        # Missions that begin together, and fly alike, are not to be checkpointed all at once.
        self._follow(mission, 0, crc32(mission.mission_id.encode()) % _EVENTS)

    def follow(self, mission: Mission, seq: int, played: Sequence[Event]) -> None:
        """Hear a mission's events, of which so many are in the store, these since its last checkpoint."""
        self._follow(mission, seq, sum(map(_weight, played)))

    def _follow(self, mission: Mission, seq: int, since: int) -> None:
        track = Track(mission, seq, since)
        self._tracks[mission.mission_id] = track

        def record(event: Event) -> None:
            with self._changed:
                if track.over:
                    return
                track.seq += 1
                track.since += _weight(event)
                self._add(Entry(mission.mission_id, track.seq, event))

        mission.record = record

    def end(self, mission_id: str) -> None:
        """A mission is deleted."""
        with self._changed:
            if (track := self._tracks.pop(mission_id, None)) is not None:
                track.over = True
                # Mission and hearer hold each other: all of it would stay in memory until a collection finds it.
                track.mission.record = unheard
            self._add(Deleted(mission_id))

    def due(self, mission: Mission, least: int = _EVENTS) -> Track | None:
        """The mission's track, where it has so many events since its last checkpoint; they are counted anew then."""
        track = self._tracks.get(mission.mission_id)
        if track is None or track.mission is not mission or track.since < least:
            return None
        track.since = 0
        return track

    def checkpoint(self, track: Track, seq: int, state: dict[str, Any]) -> None:
        """Keep a mission's state after event ``seq`` in place of the events until then.

        While the store fails events would gather without end, so those that the checkpoint stands for leave the queue.
        It takes the place of the last of them: what comes after is written no sooner than it.
        """
        if track.mission.scenario.sensors >= _LARGE and _on_a_loop():
            # Beside the decisions, one after the other; meanwhile the journal has the events that it stands for.
            self._packing.submit(self._take, track, seq, state).add_done_callback(_tell_failure)
        else:
            # Packed at once: as it is, it would take the memory of a thousand small objects until it is written.
            self._take(track, seq, state)

    def _take(self, track: Track, seq: int, state: dict[str, Any]) -> None:
        taken = Checkpoint(track.mission.mission_id, seq, pack(state))
        with self._changed:
            if track.over or seq <= track.checkpointed:
                return
            track.checkpointed = seq
            covered = [ticket for ticket, item in self._queue if _covered(item, taken)]
            if not covered:
                self._add(taken)
                return
            kept = [(ticket, item) for ticket, item in self._queue if not _covered(item, taken)]
            self._queue = deque(sorted([*kept, (covered[-1], taken)], key=lambda entry: entry[0]))

    async def stored(self, within_s: float) -> bool:
        """Wait until all that happened so far is on disk; False where it is not in time, or the store fails."""
        if self._written >= self._added:
            return True
        if self._failing:
            return False
        mine = self._added, self._loop.create_future()
        self._waiting.append(mine)
        with self._changed:
            self._wanted = self._added
            self._changed.notify()
        try:
            async with asyncio.timeout(max(0.0, within_s)):
                return bool(await mine[1])
        except TimeoutError:
            return False
        finally:
            if mine in self._waiting:
                self._waiting.remove(mine)

    def close(self, within_s: float) -> bool:
        """Write what waits, once more; returns whether that has ended, and the store may be closed."""
        self._packing.shutdown(wait=True, cancel_futures=True)
        with self._changed:
            self._closing = True
            self._changed.notify()
        self._thread.join(within_s)
        return not self._thread.is_alive()

    def _add(self, item: Item) -> None:
        """The caller holds the lock."""
        self._added += 1
        self._queue.append((self._added, item))

    def _write(self) -> None:
        pause_s = _FIRST_PAUSE_S
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._wanted > self._written or self._closing, timeout=_LINGER_S)
                if not self._queue and self._closing:
                    return
                if not self._queue:
                    continue
                batch = [self._queue[i] for i in range(min(len(self._queue), _MOST_AT_ONCE))]
            begun = time.perf_counter()
            try:
                self._store.write([item for _, item in batch])
            except Exception as error:
                self._fail(error)
                with self._changed:
                    if self._closing or self._changed.wait_for(lambda: self._closing, timeout=pause_s):
                        # Once more: the last attempt.
                        self._give_up()
                        return
                pause_s = min(2 * pause_s, _LONGEST_PAUSE_S)
                continue
            pause_s = _FIRST_PAUSE_S
            self._metrics.store_seconds.observe(time.perf_counter() - begun)
            self._done(batch)

    def _done(self, batch: list[tuple[int, Item]]) -> None:
        last = batch[-1][0]
        with self._changed:
            # A checkpoint may have come into their midst meanwhile.
            done = {id(item) for _, item in batch}
            while self._queue and id(self._queue[0][1]) in done:
                self._queue.popleft()
            if self._queue and self._queue[0][0] <= last:
                self._queue = deque(entry for entry in self._queue if id(entry[1]) not in done)
        if self._failing:
            log.warning("the store works again")
        self._failing = False
        self._written = max(self._written, last)
        self._tell()

    def _fail(self, error: Exception) -> None:
        self._metrics.store_failures.inc()
        why = cause(error)
        # Once each: where the database is away a while, and then another edge's, both are told.
        if not self._failing or why != self._why:
            log.error("the store fails, what waits is tried again: %s", why)
        self._failing, self._why = True, why
        self._tell()

    def _give_up(self) -> None:
        try:
            self._store.write([item for _, item in self._queue])
            self._queue.clear()
        except Exception:
            log.error(
                "the store failed to the end: %d changes are not on disk, no outcome among them was acknowledged",
                len(self._queue),
            )

    def _tell(self) -> None:
        if not self._loop.is_closed():
            self._loop.call_soon_threadsafe(self._settle)

    def _settle(self) -> None:
        for ticket, waiting in self._waiting:
            if not waiting.done() and (ticket <= self._written or self._failing):
                waiting.set_result(ticket <= self._written)


def _on_a_loop() -> bool:
    """Whether others wait for the thread that this runs in; when the service ends, nobody does."""
    with suppress(RuntimeError):
        asyncio.get_running_loop()
        return True
    return False


def _tell_failure(packed: Future[None]) -> None:
    if not packed.cancelled() and (error := packed.exception()) is not None:
        log.error("a checkpoint could not be made, the journal has its events: %r", error)


def _weight(event: Event) -> int:
    """What it takes to play an event again, in events of a small network: a lesson grows with the sensors."""
    if isinstance(event, Decided) and event.decision.sample is not None:
        return 1 + len(event.decision.sample.features) // _SENSORS
    return 1


def _covered(item: Item, by: Checkpoint) -> bool:
    return isinstance(item, Entry | Checkpoint) and item.mission_id == by.mission_id and item.seq <= by.seq
