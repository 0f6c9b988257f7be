"""The missions of one service: those in memory, and those that are only in the store."""

import asyncio
from collections.abc import Callable
from typing import TypeVar

from service.config.settings import Settings
from service.deciding.decision_task import RESERVE_S
from service.deciding.stopwatch import Deadline
from service.edge.ownership import LeasedOwnership, SoleOwnership
from service.edge.stored_missions import StoredMissions
from service.errors import Conflict, NotFound, Unavailable
from service.mission.mission import Mission
from service.observability.metrics import Metrics
from service.storage.journal import Journal, NullJournal
from service.storage.store import Store
from shared.wire.schemas import BatchRequest, DecideRequest, MissionSpec

AnyRequest = TypeVar("AnyRequest", DecideRequest, BatchRequest)

# The longest wait for a mission to load from the store; a decision waits no longer than its deadline.
_LOAD_S = 10.0


class MissionRegistry:
    """Missions by ID, bounded in number; a refused request makes no mission.

    A stored mission is loaded by its first request, so that many missions do not slow down a restart. In a store that
    several edges share, this edge takes the mission's lease first.

    Args:
        on_load: called with each mission that was loaded from the store.
        on_drop: called with the ID of each mission that another edge has taken over.
    """

    def __init__(
        self,
        settings: Settings,
        metrics: Metrics,
        journal: Journal | NullJournal,
        store: Store | None,
        on_load: Callable[[Mission], None],
        on_drop: Callable[[str], None],
    ) -> None:
        self._settings = settings
        self._metrics = metrics
        self._journal = journal
        self._missions: dict[str, Mission] = {}
        self._store: StoredMissions | None = None
        self._ownership: LeasedOwnership | SoleOwnership = SoleOwnership()
        if store is not None and isinstance(journal, Journal):
            self._store = StoredMissions(settings, metrics, journal, store, self._missions, on_load, on_drop)
            self._ownership = self._store.ownership
        self._count()

    @property
    def loaded(self) -> list[Mission]:
        """The missions in memory."""
        return list(self._missions.values())

    @property
    def stored(self) -> list[str]:
        """IDs of the missions that are only in the store, without those of other edges."""
        return sorted(self._listed)

    @property
    def fault(self) -> str | None:
        """Why this edge can own no missions until someone acts: its SQLite file, or leases that it cannot renew."""
        return self._journal.fault if self._ownership.intact else "the store cannot be reached"

    async def get(self, mission_id: str) -> Mission:
        """The mission, loaded from the store where it is not in memory.

        Raises:
            NotFound: there is no such mission.
            Misdirected: another edge has it.
            Unavailable: the store cannot be read, or loading takes too long.
            Conflict: the stored mission is damaged.
        """
        mission = await self.find(mission_id, _LOAD_S)
        if mission is None:
            raise NotFound("mission_id", f"there is no mission {mission_id}")
        return mission

    async def of_decision(self, decision_id: str, may_know: Callable[[str], bool]) -> Mission:
        """The mission that knows the decision: one in memory, or mission ``default`` from the store.

        Args:
            may_know: whether a mission may be looked at.

        Raises:
            NotFound: no mission knows it; the decision may belong to another mission that is only in the store.
            Misdirected, Unavailable, Conflict: as :meth:`get`.
        """
        for mission in self.loaded:
            if may_know(mission.mission_id) and mission.pending.knows(decision_id):
                return await self.get(mission.mission_id)
        listed = "default" in self._listed and may_know("default")
        if listed and (mission := await self.get("default")).pending.knows(decision_id):
            return mission
        detail = f"no mission in memory knows decision {decision_id}, or it is forgotten; name its mission_id"
        raise NotFound("decision_id", detail)

    async def resolve(
        self, request: AnyRequest, *, may_make: bool, key: str | None, deadline: Deadline
    ) -> tuple[Mission, AnyRequest]:
        """The mission of a request, and the complete request.

        Mission ``default`` is made on first use, with scenario ``paper``, if ``may_make`` allows it; any other only if
        the settings do too, so that a mistyped name is an error.

        Args:
            key: the idempotency key; a request whose answer is remembered or in progress is returned unchanged.
            deadline: ends the wait for a mission that must be loaded.

        Raises:
            NotFound: there is no such mission, and none may be made.
            Misdirected, Unavailable, Conflict: as :meth:`get`.
            Refused: as :meth:`Reports.complete`; nothing is recorded.
        """
        mission_id = request.mission_id
        mission = self._missions.get(mission_id)
        if mission is not None and not self._ownership.owns(mission_id):
            mission = None
        within = Deadline(deadline.at - RESERVE_S)
        if mission is None:
            mission = await self.find(mission_id, within.left())
        if mission is not None and key is not None and mission.idempotent_answers.knows(key):
            return mission, request
        if mission is None:
            self._refuse_to_make(mission_id, may_make)
            new = Mission(mission_id, MissionSpec(), self._settings)
            # A request that does not fit is refused before anything is recorded.
            full = _complete(new, request)
            mission = await self._claim(mission_id, within.left())
            if mission is None:
                self._add(new)
                return new, full
        return mission, _complete(mission, request)

    async def put(self, mission_id: str, spec: MissionSpec) -> Mission:
        """Make a mission, or return the one that was made with the same spec.

        Raises:
            Conflict: the mission has another spec.
            Misdirected: another edge has it.
            Unavailable: the store fails.
        """
        mission = await self.find(mission_id, _LOAD_S)
        if mission is None:
            self.refuse_if_failing("mission_id")
            new = Mission(mission_id, spec, self._settings)
            mission = await self._claim(mission_id, _LOAD_S)
            if mission is None:
                self._add(new)
                return new
        if mission.requested_spec != spec:
            raise Conflict("mission_id", f"mission {mission_id} has another spec: DELETE it or choose another ID")
        return mission

    async def delete(self, mission_id: str) -> int:
        """Forget a mission; returns the epoch of its lease.

        Raises:
            NotFound: there is no such mission.
            Misdirected: another edge has it.
            Unavailable: the store fails.
        """
        self.refuse_if_failing("mission_id")
        if self._store is not None:
            await self._store.claim_to_delete(mission_id)
        if mission_id not in self._missions and mission_id not in self._listed:
            raise NotFound("mission_id", f"there is no mission {mission_id}")
        epoch = self._ownership.epoch(mission_id)
        self._missions.pop(mission_id, None)
        self._listed.discard(mission_id)
        self._journal.end(mission_id, epoch)
        self._ownership.forget(mission_id)
        self._count()
        return epoch

    def refuse_if_failing(self, field: str) -> None:
        """Raises :class:`Unavailable` while the store fails, before anything is recorded."""
        if self._journal.failing:
            raise Unavailable(field, "the store fails: nothing was recorded, send it again")

    def close(self) -> None:
        """Load no more missions."""
        if self._store is not None:
            self._store.close()

    async def release(self) -> None:
        """Release the leases of the missions."""
        await asyncio.to_thread(self._ownership.close)

    @property
    def _listed(self) -> set[str]:
        return set() if self._store is None else self._store.listed

    async def find(self, mission_id: str, within_s: float) -> Mission | None:
        """The mission, loaded where it is not in memory or where this edge does not have its lease."""
        if mission_id in self._missions and self._ownership.owns(mission_id):
            return self._missions[mission_id]
        if self._store is not None:
            await self._store.load(mission_id, within_s)
        return self._missions.get(mission_id)

    async def _claim(self, mission_id: str, within_s: float) -> Mission | None:
        """Take the lease of a new mission; returns the mission if another request has made it meanwhile.

        There is no await after the look-up, so no other request can make it before the caller adds it.
        """
        self._refuse_if_full()
        if self._store is not None:
            await self._store.claim(mission_id, within_s)
        return self._missions.get(mission_id)

    def _add(self, mission: Mission) -> None:
        """Add a mission. There is no await since the look-up, so its ID is still free."""
        self._refuse_if_full()
        self._missions[mission.mission_id] = mission
        self._journal.begin(mission, self._ownership.epoch(mission.mission_id))
        self._count()

    def _refuse_to_make(self, mission_id: str, may_make: bool) -> None:
        """Raises :class:`NotFound` where a decision may not make this mission."""
        detail = f"there is no mission {mission_id}: check the name, or make it by PUT /missions/{mission_id}"
        if not may_make:
            raise NotFound("mission_id", f"{detail} with a key of scope admin")
        if mission_id != "default" and self._settings.create_on_decide == "off":
            raise NotFound("mission_id", f"{detail}; AICVDS_CREATE_ON_DECIDE=on lets decisions make missions")

    def _refuse_if_full(self) -> None:
        if len(self._missions) + len(self._listed) >= self._settings.max_missions:
            limit = self._settings.max_missions
            raise Conflict(
                "mission_id", f"the edge has {limit} missions of all keys: DELETE one, or raise AICVDS_MAX_MISSIONS"
            )

    def _count(self) -> None:
        self._metrics.missions.set(len(self._missions) + len(self._listed))


def _complete(mission: Mission, request: AnyRequest) -> AnyRequest:
    """The request, completed from the mission's reference reports; raises as :meth:`Reports.complete`."""
    if isinstance(request, DecideRequest):
        return mission.reports.complete(request, request.step)
    uavs = [mission.reports.complete(u, request.step, f"uavs[{index}].") for index, u in enumerate(request.uavs)]
    return request.model_copy(update={"uavs": uavs})
