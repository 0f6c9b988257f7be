"""The missions of one service: those in memory, and those that are only in the store."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

from sqlalchemy.exc import SQLAlchemyError

from service.config.settings import Settings
from service.deciding.decision_task import RESERVE_S
from service.deciding.decision_time import Deadline
from service.errors import Conflict, NotFound, Unavailable
from service.mission.mission import Mission
from service.observability.metrics import Metrics
from service.storage.journal import Journal, NullJournal
from service.storage.recovery import restore_mission
from service.storage.store import Store
from shared.wire import BatchRequest, DecideRequest, MissionSpec

log = logging.getLogger(__name__)

AnyRequest = TypeVar("AnyRequest", DecideRequest, BatchRequest)

# The longest wait for a mission to load from the store; a decision waits no longer than its deadline.
_LOAD_S = 10.0


class MissionRegistry:
    """Missions by ID, bounded in number; a refused request makes no mission.

    A stored mission is loaded by its first request, so that many missions do not slow down a restart.
    """

    def __init__(
        self,
        settings: Settings,
        metrics: Metrics,
        journal: Journal | NullJournal,
        store: Store | None,
        on_load: Callable[[Mission], None],
    ) -> None:
        self._settings = settings
        self._metrics = metrics
        self._journal = journal
        self._store = store
        self._on_load = on_load
        self._missions: dict[str, Mission] = {}
        self._stored = set[str]() if store is None else set(store.missions())
        self._loading: dict[str, asyncio.Task[Mission]] = {}
        # A single thread of its own, so that a store that hangs delays no decision, and because torch draws initial
        # weights from one generator.
        self._reading = ThreadPoolExecutor(max_workers=1, thread_name_prefix="reader")
        self._count()

    @property
    def loaded(self) -> list[Mission]:
        """The missions in memory."""
        return list(self._missions.values())

    @property
    def stored(self) -> list[str]:
        """IDs of the missions that are only in the store."""
        return sorted(self._stored)

    async def get(self, mission_id: str) -> Mission:
        """The mission, loaded from the store where it is not in memory.

        Raises:
            NotFound: there is no such mission.
            Unavailable: the store cannot be read, or loading takes too long.
            Conflict: the stored mission is damaged.
        """
        mission = await self._find(mission_id, _LOAD_S)
        if mission is None:
            raise NotFound("mission_id", f"there is no mission {mission_id}")
        return mission

    async def of_decision(self, decision_id: str) -> Mission:
        """The mission that knows the decision: one in memory, or mission ``default`` from the store.

        Raises:
            NotFound: none does; the decision may be of another mission that is only in the store.
            Unavailable, Conflict: as :meth:`get`.
        """
        for mission in self.loaded:
            if mission.pending.knows(decision_id):
                return mission
        if "default" in self._stored and (mission := await self.get("default")).pending.knows(decision_id):
            return mission
        detail = f"no mission in memory knows decision {decision_id}, or it is forgotten; name its mission_id"
        raise NotFound("decision_id", detail)

    async def resolve(
        self, request: AnyRequest, *, may_make: bool, key: str | None, deadline: Deadline
    ) -> tuple[Mission, AnyRequest]:
        """The mission of a request that fits it, and the request in full.

        A mission with scenario ``paper`` is made on first use, where ``may_make`` allows it.

        Args:
            key: the idempotency key; a request whose answer is remembered or in progress is returned unchanged.
            deadline: ends the wait for a mission that must be loaded.

        Raises:
            NotFound: there is no such mission, and none may be made.
            Unavailable, Conflict: as :meth:`get`.
            Refused: as :meth:`Reports.complete`; nothing is recorded.
        """
        mission_id = request.mission_id
        mission = self._missions.get(mission_id)
        if mission is None:
            mission = await self._find(mission_id, Deadline(deadline.at - RESERVE_S).left())
        if mission is not None and key is not None and mission.idempotent_answers.knows(key):
            return mission, request
        if mission is None and not may_make:
            raise NotFound("mission_id", f"there is no mission {mission_id}: a key with the scope admin makes it")
        mission = mission or Mission(mission_id, MissionSpec(), self._settings)
        if isinstance(request, DecideRequest):
            full = mission.reports.complete(request, request.step)
        else:
            uavs = [
                mission.reports.complete(u, request.step, f"uavs[{index}].") for index, u in enumerate(request.uavs)
            ]
            full = request.model_copy(update={"uavs": uavs})
        if mission_id not in self._missions:
            self._add(mission)
        return mission, full

    async def put(self, mission_id: str, spec: MissionSpec) -> Mission:
        """Make a mission, or return the one that was made with the same spec.

        Raises:
            Conflict: the mission has another spec.
            Unavailable: the store fails.
        """
        mission = await self._find(mission_id, _LOAD_S)
        if mission is None:
            self.refuse_if_failing("mission_id")
            mission = Mission(mission_id, spec, self._settings)
            self._add(mission)
        elif mission.requested_spec != spec:
            raise Conflict("mission_id", f"mission {mission_id} has another spec: DELETE it or choose another ID")
        return mission

    async def delete(self, mission_id: str) -> None:
        """Forget a mission; raises :class:`NotFound`, or :class:`Unavailable` while the store fails."""
        self.refuse_if_failing("mission_id")
        if (loading := self._loading.get(mission_id)) is not None:
            await asyncio.wait({loading})
        if mission_id not in self._missions and mission_id not in self._stored:
            raise NotFound("mission_id", f"there is no mission {mission_id}")
        self._missions.pop(mission_id, None)
        self._stored.discard(mission_id)
        self._journal.end(mission_id)
        self._count()

    def refuse_if_failing(self, field: str) -> None:
        """Raises :class:`Unavailable` while the store fails, before anything is recorded."""
        if self._journal.failing:
            raise Unavailable(field, "the store fails: nothing was recorded, send it again")

    def close(self) -> None:
        """Load no more missions."""
        self._reading.shutdown(wait=False, cancel_futures=True)

    async def _find(self, mission_id: str, within_s: float) -> Mission | None:
        if mission_id in self._stored:
            loading = self._loading.get(mission_id)
            if loading is None:
                loading = self._loading[mission_id] = asyncio.create_task(self._load(mission_id), name="load-mission")
                loading.add_done_callback(lambda _: self._loading.pop(mission_id, None))
            await asyncio.wait({loading}, timeout=max(0.0, within_s))
            if not loading.done():
                raise Unavailable("mission_id", f"mission {mission_id} is being loaded from the store")
            # Raises the errors of loading. The mission may be deleted since.
            loading.result()
        return self._missions.get(mission_id)

    async def _load(self, mission_id: str) -> Mission:
        """Load a mission in the reader's thread, while decisions for others continue."""
        assert self._store is not None and isinstance(self._journal, Journal)
        store = self._store
        try:
            loop = asyncio.get_running_loop()
            stored = await loop.run_in_executor(self._reading, store.load, mission_id)
            if stored is None:
                raise ValueError("it is no longer in the store")
            mission = await loop.run_in_executor(self._reading, restore_mission, mission_id, stored, self._settings)
        except SQLAlchemyError as error:
            log.error("mission %s: the store cannot be read: %s", mission_id, str(error).splitlines()[0])
            raise Unavailable("mission_id", "the store cannot be read; the log has the details") from None
        except ValueError as error:
            log.error("mission %s is damaged: %s", mission_id, error)
            raise Conflict("mission_id", f"the stored mission {mission_id} is damaged: DELETE it") from None
        if not mission.prompt_fits:
            limit = self._settings.llm_context
            log.warning(
                "mission %s: its prompt may exceed AICVDS_LLM_CONTEXT (%d); it continues without the LLM",
                mission_id,
                limit,
            )
        self._journal.resume(mission, stored.seq, stored.events)
        self._missions[mission_id] = mission
        self._stored.discard(mission_id)
        self._on_load(mission)
        return mission

    def _add(self, mission: Mission) -> None:
        """Add a mission. There is no await since the look-up, so no other can have its ID."""
        if len(self._missions) + len(self._stored) >= self._settings.max_missions:
            limit = self._settings.max_missions
            raise Conflict(
                "mission_id", f"there are already {limit} missions: DELETE one, or raise AICVDS_MAX_MISSIONS"
            )
        self._missions[mission.mission_id] = mission
        self._journal.begin(mission)
        self._count()

    def _count(self) -> None:
        self._metrics.missions.set(len(self._missions) + len(self._stored))
