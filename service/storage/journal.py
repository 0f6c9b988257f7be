"""The journal: an event that changes a mission is durable before it is acknowledged.

The events of each mission are numbered. From time to time a checkpoint of the mission's whole state replaces them.
"""

import asyncio
import logging
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any
from weakref import WeakKeyDictionary
from zlib import crc32

from service.mission.events import Decided, Event, ignore_event
from service.mission.mission import Mission
from service.observability.metrics import Metrics
from service.storage.group_commit import GroupCommit
from service.storage.operations import Checkpoint, Deleted, Entry, Made
from service.storage.rows import pack
from service.storage.store import Store
from shared.kit.bounded import BoundedDict

log = logging.getLogger(__name__)

# Events between two checkpoints of a mission: replaying them takes a fraction of a second. A decision about many
# sensors takes longer to replay, and counts for one more event every hundred sensors.
EVENTS = 512
_SENSORS = 100
# From this number of sensors on, packing a checkpoint takes up to a second.
_LARGE = 1000
# Lost leases that are remembered for requests in progress.
_MOST_LOST = 10_000


class MissionLog:
    """A mission's position in the journal.

    Attributes:
        seq: number of the newest event.
        since_checkpoint: weight of the events since the last checkpoint, in events of a small network.
        epoch: of the mission's lease; 0 in a store that is exclusive to this edge.
        ended: the mission was deleted, or another edge has taken it over. Its late events are dropped: another mission
            may have its ID.
    """

    def __init__(self, mission: Mission, seq: int, since_checkpoint: int, epoch: int) -> None:
        self.mission = mission
        self.seq = seq
        self.since_checkpoint = since_checkpoint
        self.epoch = epoch
        self.ended = False


class NullJournal:
    """The journal of an edge without a store: missions live as long as the process."""

    failing, fault = False, None
    on_recovery: Callable[[], None]

    def begin(self, mission: Mission, epoch: int = 0) -> None:
        """Ignore a new mission."""

    def end(self, mission_id: str, epoch: int = 0) -> None:
        """Ignore a deleted mission."""

    def lost(self, mission: Mission) -> bool:
        """Return False: there is no other edge."""
        return False

    def lost_epoch(self, mission_id: str, epoch: int) -> bool:
        """Return False."""
        return False

    async def stored(self, within_s: float) -> bool:
        """Return True: there is nothing to wait for."""
        return True

    async def close(self, within_s: float) -> bool:
        """Return True: there is nothing to write."""
        return True


class Journal:
    """The journal of the missions of one store; used on the event loop only.

    Attributes:
        stored, deleting: as those of :class:`GroupCommit`. After ``stored``, :meth:`lost` says whether the changes
            were dropped instead.
        on_lost: called with the ID of a mission that another edge has taken over.
        on_recovery: called when a checkpoint of every mission is due, because the database may have gone back.
    """

    def __init__(self, store: Store, metrics: Metrics) -> None:
        self._commits = GroupCommit(store.writer(), metrics, self._lose, self.recovered)
        self.stored, self.deleting = self._commits.stored, self._commits.deleting
        self.on_lost: Callable[[str], None] = lambda _: None
        self.on_recovery: Callable[[], None] = lambda: None
        self._loop = asyncio.get_running_loop()
        self._logs: dict[str, MissionLog] = {}
        self._lost = BoundedDict[tuple[str, int], bool](_MOST_LOST)
        self._epochs = WeakKeyDictionary[Mission, int]()
        self._packing = ThreadPoolExecutor(max_workers=1, thread_name_prefix="checkpoints")
        self._packed: set[asyncio.Future[bytes]] = set()

    @property
    def failing(self) -> bool:
        """Whether the last transaction failed."""
        return self._commits.failing

    @property
    def fault(self) -> str | None:
        """As :attr:`GroupCommit.fault`."""
        return self._commits.fault

    def begin(self, mission: Mission, epoch: int = 0) -> None:
        """Record a new mission, and every event of it from now on."""
        self._commits.add(Made(mission.mission_id, mission.requested_spec, mission.spec, epoch))
        # Similar missions that start together must not all need a checkpoint at the same time.
        self._record(MissionLog(mission, 0, crc32(mission.mission_id.encode()) % EVENTS, epoch))

    def resume(self, mission: Mission, seq: int, replayed: Sequence[Event], epoch: int = 0) -> None:
        """Record every event of a restored mission from now on.

        Args:
            seq: number of its newest event in the store.
            replayed: its events since its last checkpoint.
            epoch: of its lease.
        """
        self._record(MissionLog(mission, seq, sum(map(_weight, replayed)), epoch))

    def _record(self, mission_log: MissionLog) -> None:
        mission, epoch = mission_log.mission, mission_log.epoch
        self._logs[mission.mission_id] = mission_log
        self._epochs[mission] = epoch

        def record(event: Event) -> None:
            if mission_log.ended:
                return
            mission_log.seq += 1
            mission_log.since_checkpoint += 1 if mission.scenario.sensors < _SENSORS else _weight(event)
            self._commits.add(Entry(mission.mission_id, mission_log.seq, event, epoch))

        mission.record = record

    def end(self, mission_id: str, epoch: int = 0) -> None:
        """Record that a mission is deleted."""
        self._close_log(mission_id)
        self._commits.add(Deleted(mission_id, epoch))

    def drop(self, mission_id: str) -> None:
        """Record no more events of a mission, which another edge has taken over."""
        mission_log = self._close_log(mission_id)
        if mission_log is not None:
            self._lost[mission_id, mission_log.epoch] = True

    def lost(self, mission: Mission) -> bool:
        """Whether another edge has taken over the mission: changes that were not durable by then are lost."""
        return (mission.mission_id, self._epochs.get(mission, 0)) in self._lost

    def lost_epoch(self, mission_id: str, epoch: int) -> bool:
        """As :meth:`lost`, of a mission that need not be in memory."""
        return (mission_id, epoch) in self._lost

    def epoch(self, mission_id: str) -> int | None:
        """The epoch under which a mission's events are recorded; None if they are not."""
        mission_log = self._logs.get(mission_id)
        return None if mission_log is None else mission_log.epoch

    def _close_log(self, mission_id: str) -> MissionLog | None:
        mission_log = self._logs.pop(mission_id, None)
        if mission_log is not None:
            mission_log.ended = True
            # The mission and `record` refer to each other: the mission would stay in memory until a collection.
            mission_log.mission.record = ignore_event
        return mission_log

    def _lose(self, mission_id: str, epoch: int) -> None:
        """The store has refused a mission's changes, because another edge has the mission."""
        self._lost[mission_id, epoch] = True
        if self.epoch(mission_id) == epoch:
            self.on_lost(mission_id)

    def recovered(self) -> None:
        """The store works again. It may be another, which lacks transactions: all that is in memory becomes due."""
        for mission_log in self._logs.values():
            mission, mission_log.since_checkpoint = mission_log.mission, EVENTS
            self._commits.add(Made(mission.mission_id, mission.requested_spec, mission.spec, mission_log.epoch))
        self.on_recovery()

    def due(self, mission: Mission, least: int = EVENTS) -> MissionLog | None:
        """The log of a mission with at least this many events since its last checkpoint; resets the count."""
        mission_log = self._logs.get(mission.mission_id)
        if mission_log is None or mission_log.mission is not mission or mission_log.since_checkpoint < least:
            return None
        mission_log.since_checkpoint = 0
        return mission_log

    def checkpoint(self, mission_log: MissionLog, state: dict[str, Any]) -> None:
        """Replace a mission's events so far by its state; those still in the queue are not written."""
        if mission_log.mission.scenario.sensors >= _LARGE:
            # A thread packs checkpoints one at a time, so that no decision waits. Until then the journal keeps the
            # events that the checkpoint replaces.
            packing = self._loop.run_in_executor(self._packing, pack, state)
            self._packed.add(packing)
            packing.add_done_callback(partial(self._take_packed, mission_log, mission_log.seq))
        else:
            # Packed immediately: until it is written, the unpacked state would take the memory of a thousand small
            # objects.
            self._take(mission_log, mission_log.seq, pack(state))

    async def close(self, within_s: float) -> bool:
        """Write the queue once more; returns whether that has ended, so that the store may be closed."""
        ends = self._loop.time() + within_s
        self.on_recovery = lambda: None  # Nothing can be packed any more.
        if self._packed:
            await asyncio.wait(self._packed, timeout=within_s)
        self._packing.shutdown(wait=False, cancel_futures=True)
        return await self._commits.close(ends)

    def _take_packed(self, mission_log: MissionLog, seq: int, packing: asyncio.Future[bytes]) -> None:
        self._packed.discard(packing)
        if packing.cancelled():
            return
        if (error := packing.exception()) is not None:
            log.error("a checkpoint could not be packed, the journal keeps its events: %r", error)
            return
        self._take(mission_log, seq, packing.result())

    def _take(self, mission_log: MissionLog, seq: int, packed: bytes) -> None:
        if not mission_log.ended:
            mission_id, epoch, newest = mission_log.mission.mission_id, mission_log.epoch, mission_log.seq
            self._commits.supersede(Checkpoint(mission_id, seq, packed, epoch, newest))


def _weight(event: Event) -> int:
    """The work of replaying an event, in events of a small network: training grows with the number of sensors."""
    if isinstance(event, Decided) and event.decision.sample is not None:
        return 1 + len(event.decision.sample.features) // _SENSORS
    return 1
