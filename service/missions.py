"""The missions that one service holds."""

from __future__ import annotations

from service.metrics import Metrics
from service.mission import Mission
from service.problems import Conflict, NotFound
from service.settings import Settings
from shared.wire import BatchRequest, DecideRequest, MissionSpec


class Missions:
    """Missions by ID, bounded in number; a request that is refused leaves no mission behind."""

    def __init__(self, settings: Settings, metrics: Metrics) -> None:
        self._settings = settings
        self._metrics = metrics
        self._missions: dict[str, Mission] = {}

    def get(self, mission_id: str) -> Mission:
        """A mission; raises :class:`NotFound`."""
        try:
            return self._missions[mission_id]
        except KeyError:
            raise NotFound("mission_id", f"there is no mission {mission_id}") from None

    def checked(self, request: DecideRequest | BatchRequest, *, may_make: bool = True) -> Mission:
        """The mission for a request that fits it; one with scenario ``paper`` is made on first use, where one may.

        Raises:
            NotFound: there is no such mission, and none may be made.
            Refused: a UAV's report does not fit the mission's world; nothing was recorded.
        """
        mission_id = request.mission_id
        mission = self._missions.get(mission_id)
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

    def put(self, mission_id: str, spec: MissionSpec) -> Mission:
        """Make a mission, or find it made by the same spec.

        Raises:
            Conflict: the mission flies with another spec.
        """
        mission = self._missions.get(mission_id)
        if mission is None:
            mission = Mission(mission_id, spec, self._settings)
            self._add(mission)
        elif mission.spec != spec:
            raise Conflict("mission_id", f"mission {mission_id} has another spec: DELETE it or choose another ID")
        return mission

    def delete(self, mission_id: str) -> None:
        """Forget a mission; raises :class:`NotFound`."""
        self.get(mission_id)
        del self._missions[mission_id]
        self._metrics.missions.set(len(self._missions))

    def _add(self, mission: Mission) -> None:
        if mission.mission_id not in self._missions and len(self._missions) >= self._settings.max_missions:
            limit = self._settings.max_missions
            raise Conflict("mission_id", f"{limit} missions are held already: DELETE one, or raise AICVDS_MAX_MISSIONS")
        self._missions[mission.mission_id] = mission
        self._metrics.missions.set(len(self._missions))
