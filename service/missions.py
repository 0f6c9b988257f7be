"""The missions that one service holds: those in memory, and those that the store has from before."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable

from sqlalchemy.exc import SQLAlchemyError

from service.journal import Journal, Unkept
from service.metrics import Metrics
from service.mission import Mission
from service.problems import Conflict, NotFound, Unavailable
from service.replaying import revived
from service.settings import Settings
from service.store import Store
from shared.wire import BatchRequest, DecideRequest, MissionSpec

log = logging.getLogger(__name__)


class Missions:
    """Missions by ID, bounded in number; a request that is refused leaves no mission behind.

    One that the store has is read back when it is first asked about, so that a restart takes no longer for many.
    """

    def __init__(
        self,
        settings: Settings,
        metrics: Metrics,
        keeper: Journal | Unkept,
        store: Store | None,
        on_wake: Callable[[Mission], None],
    ) -> None:
        self._settings = settings
        self._metrics = metrics
        self._keeper = keeper
        self._store = store
        self._on_wake = on_wake
        self._missions: dict[str, Mission] = {}
        self._asleep = set[str]() if store is None else set(store.missions())
        self._waking: dict[str, asyncio.Task[Mission]] = {}
        self._count()

    @property
    def awake(self) -> list[Mission]:
        """Those in memory."""
        return list(self._missions.values())

    async def get(self, mission_id: str) -> Mission:
        """A mission.

        Raises:
            NotFound: there is none.
            Unavailable: the store cannot be read.
            Conflict: what the store has of it is damaged.
        """
        mission = await self._find(mission_id)
        if mission is None:
            raise NotFound("mission_id", f"there is no mission {mission_id}")
        return mission

    async def checked(self, request: DecideRequest | BatchRequest, *, may_make: bool = True) -> Mission:
        """The mission for a request that fits it; one with scenario ``paper`` is made on first use, where one may.

        Raises:
            NotFound: there is no such mission, and none may be made.
            Refused: a UAV's report does not fit the mission's world; nothing was recorded.
        """
        mission_id = request.mission_id
        mission = await self._find(mission_id)
        if mission is None and not may_make:
            raise NotFound("mission_id", f"there is no mission {mission_id}: a key with the scope admin makes it")
        mission = mission or Mission(mission_id, MissionSpec(), self._settings)
        if isinstance(request, DecideRequest):
            mission.check(request, request.step)
        else:
            for index, uav in enumerate(request.uavs):
                mission.check(uav, request.step, f"uavs[{index}].")
        self._add(mission)
        return mission

    async def put(self, mission_id: str, spec: MissionSpec) -> Mission:
        """Make a mission, or find it made by the same spec.

        Raises:
            Conflict: the mission flies with another spec.
        """
        mission = await self._find(mission_id)
        if mission is None:
            mission = Mission(mission_id, spec, self._settings)
            self._add(mission)
        elif mission.asked_for != spec:
            raise Conflict("mission_id", f"mission {mission_id} has another spec: DELETE it or choose another ID")
        return mission

    async def delete(self, mission_id: str) -> None:
        """Forget a mission; raises :class:`NotFound`."""
        if (waking := self._waking.get(mission_id)) is not None:
            await asyncio.wait({waking})
        if mission_id not in self._missions and mission_id not in self._asleep:
            raise NotFound("mission_id", f"there is no mission {mission_id}")
        self._missions.pop(mission_id, None)
        self._asleep.discard(mission_id)
        self._keeper.end(mission_id)
        self._count()

    async def _find(self, mission_id: str) -> Mission | None:
        if mission_id in self._asleep:
            waking = self._waking.get(mission_id)
            if waking is None:
                waking = self._waking[mission_id] = asyncio.create_task(self._wake(mission_id), name="wake-mission")
                waking.add_done_callback(lambda _: self._waking.pop(mission_id, None))
            return await asyncio.shield(waking)
        return self._missions.get(mission_id)

    async def _wake(self, mission_id: str) -> Mission:
        """Read a mission back, beside the decisions for others."""
        assert self._store is not None and isinstance(self._keeper, Journal)
        store = self._store
        try:
            kept = await asyncio.to_thread(store.load, mission_id)
            if kept is None:
                raise ValueError("it is gone from the store")
            mission = await asyncio.to_thread(revived, mission_id, kept, self._settings)
        except SQLAlchemyError as error:
            log.error("mission %s: the store cannot be read: %s", mission_id, str(error).splitlines()[0])
            raise Unavailable("mission_id", "the store cannot be read; its log says more") from None
        except ValueError as error:
            log.error("mission %s is damaged: %s", mission_id, error)
            raise Conflict("mission_id", f"what the store has of {mission_id} is damaged: DELETE it") from None
        self._keeper.follow(mission, kept.seq)
        self._missions[mission_id] = mission
        self._asleep.discard(mission_id)
        self._on_wake(mission)
        return mission

    def _add(self, mission: Mission) -> None:
        """Hold it, unless it is held; no other of its ID can have come between, for nothing was waited for."""
        if mission.mission_id in self._missions:
            return
        if len(self._missions) + len(self._asleep) >= self._settings.max_missions:
            limit = self._settings.max_missions
            raise Conflict("mission_id", f"{limit} missions are held already: DELETE one, or raise AICVDS_MAX_MISSIONS")
        self._missions[mission.mission_id] = mission
        self._keeper.begin(mission)
        self._count()

    def _count(self) -> None:
        self._metrics.missions.set(len(self._missions) + len(self._asleep))
