"""The journal: what changes missions is on disk before it is acknowledged.

The events of each mission are numbered, and now and then a checkpoint of its whole state takes their place.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any
from zlib import crc32

from service.mission.events import Decided, Event, ignore_event
from service.mission.mission import Mission
from service.observability.metrics import Metrics
from service.storage.group_commit import GroupCommit
from service.storage.operations import Checkpoint, Deleted, Entry, Made
from service.storage.serialization import pack
from service.storage.store import Store

log = logging.getLogger(__name__)

# A mission is checkpointed after so many events, so that it is read back in a fraction of a second. A decision about
# many sensors takes longer to play again: it counts for one more every hundred of them.
_EVENTS = 256
_SENSORS = 100
# With so many sensors a checkpoint takes up to a second to pack.
_LARGE = 1000


class MissionLog:
    """A mission's place in the journal.

    Attributes:
        seq: its newest event's.
        since_checkpoint: what it would take to read it back, in events, since its last checkpoint.
        deleted: it was deleted; what still happens to it is nobody's business, and another may have its ID.
    """

    def __init__(self, mission: Mission, seq: int, since: int) -> None:
        self.mission = mission
        self.seq = seq
        self.since_checkpoint = since
        self.deleted = False


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
        self._commits = GroupCommit(store.writer(), metrics)
        self._loop = asyncio.get_running_loop()
        self._logs: dict[str, MissionLog] = {}
        self._packing = ThreadPoolExecutor(max_workers=1, thread_name_prefix="checkpoints")
        self._packed: set[asyncio.Future[bytes]] = set()

    @property
    def failing(self) -> bool:
        """Whether the last attempt to write failed."""
        return self._commits.failing

    def begin(self, mission: Mission) -> None:
        """A mission is made, and its events are heard from now on."""
        self._commits.add(Made(mission.mission_id, mission.requested_spec, mission.spec))
        # Missions that begin together, and fly alike, are not to be checkpointed all at once.
        self._follow(mission, 0, crc32(mission.mission_id.encode()) % _EVENTS)

    def follow(self, mission: Mission, seq: int, played: Sequence[Event]) -> None:
        """Hear a mission's events, of which so many are in the store, these since its last checkpoint."""
        self._follow(mission, seq, sum(map(_weight, played)))

    def _follow(self, mission: Mission, seq: int, since: int) -> None:
        mission_log = MissionLog(mission, seq, since)
        self._logs[mission.mission_id] = mission_log

        def record(event: Event) -> None:
            if mission_log.deleted:
                return
            mission_log.seq += 1
            mission_log.since_checkpoint += _weight(event)
            self._commits.add(Entry(mission.mission_id, mission_log.seq, event))

        mission.record = record

    def end(self, mission_id: str) -> None:
        """A mission is deleted."""
        if (mission_log := self._logs.pop(mission_id, None)) is not None:
            mission_log.deleted = True
            # Mission and hearer hold each other: all of it would stay in memory until a collection finds it.
            mission_log.mission.record = ignore_event
        self._commits.add(Deleted(mission_id))

    def due(self, mission: Mission, least: int = _EVENTS) -> MissionLog | None:
        """The mission's log, where it has so many events since its last checkpoint; they are counted anew then."""
        mission_log = self._logs.get(mission.mission_id)
        if mission_log is None or mission_log.mission is not mission or mission_log.since_checkpoint < least:
            return None
        mission_log.since_checkpoint = 0
        return mission_log

    def checkpoint(self, mission_log: MissionLog, state: dict[str, Any]) -> None:
        """Keep a mission's state as it is now in place of the events until now.

        Those that still wait to be written need not be.
        """
        if mission_log.mission.scenario.sensors >= _LARGE:
            # Beside the decisions, one after the other; meanwhile the journal has the events that it stands for.
            packing = self._loop.run_in_executor(self._packing, pack, state)
            self._packed.add(packing)
            packing.add_done_callback(partial(self._take_packed, mission_log, mission_log.seq))
        else:
            # Packed at once: as it is, it would take the memory of a thousand small objects until it is written.
            self._take(mission_log, mission_log.seq, pack(state))

    async def stored(self, within_s: float) -> bool:
        """Wait until all that happened so far is on disk; False where it is not in time, or the store fails."""
        return await self._commits.stored(within_s)

    async def close(self, within_s: float) -> bool:
        """Write what waits, once more; returns whether that has ended, and the store may be closed."""
        ends = self._loop.time() + within_s
        if self._packed:
            await asyncio.wait(self._packed, timeout=within_s)
        self._packing.shutdown(wait=False, cancel_futures=True)
        return await self._commits.close(ends)

    def _take_packed(self, mission_log: MissionLog, seq: int, packing: asyncio.Future[bytes]) -> None:
        self._packed.discard(packing)
        if packing.cancelled():
            return
        if (error := packing.exception()) is not None:
            log.error("a checkpoint could not be made, the journal has its events: %r", error)
            return
        self._take(mission_log, seq, packing.result())

    def _take(self, mission_log: MissionLog, seq: int, packed: bytes) -> None:
        if not mission_log.deleted:
            self._commits.supersede(Checkpoint(mission_log.mission.mission_id, seq, packed))


def _weight(event: Event) -> int:
    """What it takes to play an event again, in events of a small network: a lesson grows with the sensors."""
    if isinstance(event, Decided) and event.decision.sample is not None:
        return 1 + len(event.decision.sample.features) // _SENSORS
    return 1
