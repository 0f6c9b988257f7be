"""The missions of the store: claimed where other edges may have them, loaded into memory, and listed."""

import asyncio
import logging
from collections.abc import Callable, Coroutine
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

from sqlalchemy.exc import SQLAlchemyError

from service.config.settings import Settings
from service.edge.ownership import LeasedOwnership, SoleOwnership
from service.errors import Conflict, Misdirected, Refused, Unavailable
from service.mission.events import Decided, Event, GuidanceChanged, ReadingsMerged, Reported, Settled
from service.mission.idempotency import Answered
from service.mission.mission import Mission
from service.observability.metrics import Metrics
from service.storage.journal import Journal
from service.storage.store import Store, StoredMission, cause

log = logging.getLogger(__name__)

T = TypeVar("T")


class StoredMissions:
    """Moves missions from the store into memory; used on the event loop only.

    Args:
        missions: those in memory, by ID.
        on_load: called with each mission that was loaded from the store.
        on_drop: called with the ID of each mission that another edge has taken over.

    Attributes:
        ownership: which missions this edge may decide for.
        listed: IDs of missions that are only in the store. In a shared store, those that no other edge owned at the
            last renewal: it may have others since, and other edges may have taken these.
    """

    def __init__(
        self,
        settings: Settings,
        metrics: Metrics,
        journal: Journal,
        store: Store,
        missions: dict[str, Mission],
        on_load: Callable[[Mission], None],
        on_drop: Callable[[str], None],
    ) -> None:
        self._settings = settings
        self._metrics = metrics
        self._journal = journal
        self._store = store
        self._missions = missions
        self._on_load = on_load
        self._on_drop = on_drop
        self._under_way: dict[str, asyncio.Task[None]] = {}
        # A separate thread, so that a hanging store delays no decision.
        self._reading = ThreadPoolExecutor(max_workers=1, thread_name_prefix="reader")
        self.ownership: LeasedOwnership | SoleOwnership = SoleOwnership()
        if store.leases is None:
            self.listed = set(store.missions())
        else:
            self.listed = set(store.leases.unowned())
            address = settings.advertise_url or ""
            self.ownership = LeasedOwnership(store.leases, address, settings.lease_s, metrics, self._reconcile)
        journal.on_lost = self.drop

    async def load(self, mission_id: str, within_s: float) -> None:
        """Load a mission, if it is in the store; decisions for other missions continue.

        Raises:
            Misdirected: another edge has it.
            Unavailable: the store cannot be read, or loading takes too long.
            Conflict: the stored mission is damaged.
        """
        if self.ownership.shared or mission_id in self.listed:
            await self.share(mission_id, self._load, within_s)

    async def claim(self, mission_id: str, within_s: float) -> None:
        """Take the lease of a new mission; load the mission if another edge has made it meanwhile.

        Raises: as :meth:`load`.
        """
        while not self.ownership.owns(mission_id):
            await self.share(mission_id, self._take, within_s)

    async def claim_to_delete(self, mission_id: str) -> None:
        """Take the lease of a mission in memory or in the store, without loading it; raises as :meth:`load`."""
        if (other := self._under_way.get(mission_id)) is not None:
            await asyncio.wait({other})
        if not self.ownership.owns(mission_id):
            await self._claim_existing(mission_id)

    def drop(self, mission_id: str) -> None:
        """Forget a mission that another edge has taken over."""
        self.ownership.forget(mission_id)
        self._unload(mission_id)

    def close(self) -> None:
        """Load no more missions."""
        self._reading.shutdown(wait=False, cancel_futures=True)

    async def share(self, mission_id: str, work: Callable[[str], Coroutine[Any, Any, None]], within_s: float) -> None:
        """Start work on a mission, or join the work in progress; concurrent requests share its result."""
        task = self._under_way.get(mission_id)
        if task is None:
            task = self._under_way[mission_id] = asyncio.create_task(work(mission_id), name="load-mission")
            task.add_done_callback(lambda _: self._under_way.pop(mission_id, None))
        await asyncio.wait({task}, timeout=max(0.0, within_s))
        if not task.done():
            raise Unavailable("mission_id", f"mission {mission_id} is being loaded from the store")
        # Raises the errors of loading. The mission may have been deleted since.
        task.result()

    async def _load(self, mission_id: str) -> None:
        if await self._claim_existing(mission_id):
            await self._restore(mission_id)

    async def _take(self, mission_id: str) -> None:
        await self._claim(mission_id)
        await self._restore(mission_id)

    async def _claim_existing(self, mission_id: str) -> bool:
        """Take the lease of a mission that is in memory or in the store; returns whether it is."""
        if mission_id not in self._missions:
            await self._journal.stored(1.0)  # Of a deletion that is not committed yet the row is still there.
            if self._journal.deleting(mission_id):
                raise Unavailable("mission_id", f"mission {mission_id} is being deleted")
        if mission_id not in self._missions and not await self._read(self._store.has, mission_id):
            self.listed.discard(mission_id)
            await self._unless_misdirected(self.ownership.check_free, mission_id)
            return False
        await self._claim(mission_id)
        if mission_id not in self._missions:
            self.listed.add(mission_id)
        return True

    async def _claim(self, mission_id: str) -> None:
        """Take a mission's lease, if it is free. The mission stays in memory only if no other edge has had it since."""
        epoch = await self._unless_misdirected(self.ownership.claim, mission_id)
        if mission_id in self._missions and self._journal.epoch(mission_id) != epoch:
            self._unload(mission_id)

    async def _unless_misdirected(self, function: Callable[[str], T], mission_id: str) -> T:
        """Run a function of the ownership; drop the mission if another edge has it."""
        try:
            return await self._read(function, mission_id)
        except Misdirected as other:
            self.drop(mission_id)
            if other.owner is not None and other.owner == self._settings.advertise_url:
                # The owner has ended: a client redirected to its address would come back here.
                raise Unavailable("mission_id", "its owner at this address has ended: send it again") from None
            raise

    async def _restore(self, mission_id: str) -> None:
        """Load the mission from the store in the reader's thread, unless it is in memory."""
        if mission_id in self._missions:
            return
        epoch = self.ownership.epoch(mission_id)
        try:
            stored = await self._read(self._store.load, mission_id)
            if stored is None:
                self.listed.discard(mission_id)
                return
            mission = await self._read(restore_mission, mission_id, stored, self._settings)
        except ValueError as error:
            log.error("mission %s is damaged: %s", mission_id, error)
            raise Conflict("mission_id", f"the stored mission {mission_id} is damaged: DELETE it") from None
        if not mission.prompt_fits:
            try:
                mission.prompt_fit.check()
            except Refused as why:
                log.warning("mission %s continues without the LLM: %s; or DELETE it, and make it anew", mission_id, why)
        self._journal.resume(mission, stored.seq, stored.events, epoch)
        self._missions[mission_id] = mission
        self.listed.discard(mission_id)
        self._on_load(mission)

    def _unload(self, mission_id: str) -> None:
        if self._missions.pop(mission_id, None) is None:
            return
        self._journal.drop(mission_id)
        self._on_drop(mission_id)
        self._metrics.leases_lost.inc()
        log.warning("mission %s: another edge has taken it over", mission_id)

    async def _read(self, function: Callable[..., T], *args: Any) -> T:
        """Run a function in the reader's thread; raises ``Unavailable`` if the store fails."""
        try:
            return await asyncio.get_running_loop().run_in_executor(self._reading, function, *args)
        except SQLAlchemyError as error:
            log.error("the store cannot be read: %s", cause(error))
            raise Unavailable("mission_id", "the store cannot be read; the log has the details") from None

    def _reconcile(self, taken: set[str], unowned: list[str], anew: bool) -> None:
        """After a renewal: drop the missions that other edges have taken over, and list those that none owns."""
        if anew:
            self._journal.recovered()
        for mission_id in taken:
            self.drop(mission_id)
        self.listed = set(unowned) - self._missions.keys()
        self._metrics.missions.set(len(self._missions) + len(self.listed))


def restore_mission(mission_id: str, stored: StoredMission, settings: Settings) -> Mission:
    """The mission after its last stored event, except for its plan, which is made again.

    Raises:
        ValueError: the stored state and events do not fit together.
    """
    mission = Mission(mission_id, stored.asked_for, settings, stored.spec)
    try:
        if stored.state is not None:
            mission.load_state_dict(stored.state)
            mission.learner.load_state_dict(stored.state["learner"])
        for event in stored.events:
            _replay(mission, event)
    except (AttributeError, IndexError, KeyError, RuntimeError, TypeError) as error:
        raise ValueError(f"mission {mission_id} cannot be restored: {error!r}") from error
    return mission


def _replay(mission: Mission, event: Event) -> None:
    match event:
        case Reported(step, uav):
            mission.observe(uav, step)
        case Decided(decision, attempt, report):
            mission.commit(decision, attempt, report)
        case Settled(outcome, used_for_training):
            sample = mission.apply(outcome, for_training=used_for_training)
            if sample is not None and used_for_training:
                mission.learn(sample, outcome.cost)
        case GuidanceChanged(state):
            mission.restore_guidance(state)
        case Answered():
            mission.idempotent_answers.remember(event)
        case ReadingsMerged(readings):
            mission.take_readings(readings)
