"""The missions that one service holds: those in memory, and those that the store has from before."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

from sqlalchemy.exc import SQLAlchemyError

from service.config.settings import Settings
from service.errors import Conflict, NotFound, Unavailable
from service.mission.mission import Mission
from service.mission.report_checks import complete_report
from service.observability.metrics import Metrics
from service.storage.journal import Journal, NullJournal
from service.storage.recovery import restore_mission
from service.storage.store import Store
from shared.wire import BatchRequest, DecideRequest, MissionSpec

log = logging.getLogger(__name__)

AnyRequest = TypeVar("AnyRequest", DecideRequest, BatchRequest)

# The longest that who asks about a mission waits for its being read back; a decision no longer than its deadline.
_LOAD_S = 10.0


class MissionRegistry:
    """Missions by ID, bounded in number; a request that is refused leaves no mission behind.

    One that the store has is read back when it is first asked about, so that a restart takes no longer for many.
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
        # One after another, and apart from what decisions need: a store that hangs must not keep these waiting, and
        # torch draws initial weights from one generator.
        self._reading = ThreadPoolExecutor(max_workers=1, thread_name_prefix="reader")
        self._count()

    @property
    def loaded(self) -> list[Mission]:
        """Those in memory."""
        return list(self._missions.values())

    @property
    def stored(self) -> list[str]:
        """Names of those that are only in the store."""
        return sorted(self._stored)

    async def get(self, mission_id: str) -> Mission:
        """A mission, waited for where the store must be read.

        Raises:
            NotFound: there is none.
            Unavailable: the store cannot be read, or takes longer.
            Conflict: what the store has of it is damaged.
        """
        mission = await self._find(mission_id, _LOAD_S)
        if mission is None:
            raise NotFound("mission_id", f"there is no mission {mission_id}")
        return mission

    async def checked(
        self, request: AnyRequest, *, may_make: bool, key: str | None, within_s: float
    ) -> tuple[Mission, AnyRequest]:
        """The mission for a request that fits it, and the request with what it leaves out.

        One with scenario ``paper`` is made on first use, where one may.

        Args:
            key: a request that was answered under it, or is being, fits already, and is left as it is.
            within_s: to wait, at most, for a mission that must be read back.

        Raises:
            NotFound: there is no such mission, and none may be made.
            Unavailable, Conflict: as :meth:`get`.
            Refused: a UAV's report does not fit the mission's world, or leaves out what is not held; nothing was
                recorded.
        """
        mission_id = request.mission_id
        mission = await self._find(mission_id, within_s)
        if mission is not None and key is not None and mission.idempotent_answers.knows(key):
            return mission, request
        if mission is None and not may_make:
            raise NotFound("mission_id", f"there is no mission {mission_id}: a key with the scope admin makes it")
        mission = mission or Mission(mission_id, MissionSpec(), self._settings)
        if isinstance(request, DecideRequest):
            whole = complete_report(mission, request, request.step)
        else:
            uavs = [
                complete_report(mission, u, request.step, f"uavs[{index}].") for index, u in enumerate(request.uavs)
            ]
            whole = request.model_copy(update={"uavs": uavs})
        self._add(mission)
        return mission, whole

    async def put(self, mission_id: str, spec: MissionSpec) -> Mission:
        """Make a mission, or find it made by the same spec.

        Raises:
            Conflict: the mission flies with another spec.
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
        """Read no more."""
        self._reading.shutdown(wait=False, cancel_futures=True)

    async def _find(self, mission_id: str, within_s: float) -> Mission | None:
        if mission_id in self._stored:
            loading = self._loading.get(mission_id)
            if loading is None:
                loading = self._loading[mission_id] = asyncio.create_task(self._load(mission_id), name="load-mission")
                loading.add_done_callback(lambda _: self._loading.pop(mission_id, None))
            await asyncio.wait({loading}, timeout=max(0.0, within_s))
            if not loading.done():
                raise Unavailable("mission_id", f"mission {mission_id} is being read back from the store")
            # Raises what it raised. It may have been deleted since.
            loading.result()
        return self._missions.get(mission_id)

    async def _load(self, mission_id: str) -> Mission:
        """Read a mission back, beside the decisions for others."""
        assert self._store is not None and isinstance(self._journal, Journal)
        store = self._store
        try:
            loop = asyncio.get_running_loop()
            kept = await loop.run_in_executor(self._reading, store.load, mission_id)
            if kept is None:
                raise ValueError("it is gone from the store")
            mission = await loop.run_in_executor(self._reading, restore_mission, mission_id, kept, self._settings)
        except SQLAlchemyError as error:
            log.error("mission %s: the store cannot be read: %s", mission_id, str(error).splitlines()[0])
            raise Unavailable("mission_id", "the store cannot be read; its log says more") from None
        except ValueError as error:
            log.error("mission %s is damaged: %s", mission_id, error)
            raise Conflict("mission_id", f"what the store has of {mission_id} is damaged: DELETE it") from None
        if not mission.prompt_fits:
            limit = self._settings.llm_context
            log.warning(
                "mission %s: its prompt may need more than AICVDS_LLM_CONTEXT (%d): it flies on without the LLM",
                mission_id,
                limit,
            )
        self._journal.follow(mission, kept.seq, kept.events)
        self._missions[mission_id] = mission
        self._stored.discard(mission_id)
        self._on_load(mission)
        return mission

    def _add(self, mission: Mission) -> None:
        """Hold it, unless it is held; no other of its ID can have come between, for nothing was waited for."""
        if mission.mission_id in self._missions:
            return
        if len(self._missions) + len(self._stored) >= self._settings.max_missions:
            limit = self._settings.max_missions
            raise Conflict("mission_id", f"{limit} missions are held already: DELETE one, or raise AICVDS_MAX_MISSIONS")
        self._missions[mission.mission_id] = mission
        self._journal.begin(mission)
        self._count()

    def _count(self) -> None:
        self._metrics.missions.set(len(self._missions) + len(self._stored))
