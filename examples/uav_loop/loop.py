"""The loop of one real UAV: read telemetry, ask the edge, fly and collect as decided, report the outcome."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from examples.uav_loop.vehicle import Beacon, LocalFrame, Position, Vehicle, yaw_deg
from shared.channel import FloatArray
from shared.scenario import Point, Scenario
from shared.trajectory import trajectories
from shared.wire import DecideRequest, FeedbackRequest, MissionSpec, Outcome
from simulator.client import AsyncEdgeClient, EdgeError, EdgeRefused, Exchange
from simulator.client.observation_report import decide_request
from simulator.policies.registry import policy_named
from simulator.world import Observation

DEADLINE_MS = 3000
# Below this charge the UAV flies home, whatever the edge decides.
RESERVE_PERCENT = 20.0
FALLBACK = "eof"


@dataclass(frozen=True)
class Leg:
    """One flown step. ``decided_by`` is the edge's ``source``, or ``onboard``."""

    step: int
    position: Point
    sensor: int
    velocity: int
    decided_by: str
    packets: int
    cost: float


@dataclass
class Flown:
    """A flown mission: its legs, the number of outcomes that the edge has, and the last error of asking the edge."""

    legs: list[Leg] = field(default_factory=list)
    outcomes_told: int = 0
    last_error: str | None = None
    went_home: bool = False


class Loop:
    """Flies one UAV of a mission along its trajectory.

    Args:
        vehicle: already in the air.
        edge: the client of the edge that decides.
        scenario: the mission's world; layout ``surveyed``, so that the sensors' places are known.
        frame: the position of the scenario's plane on the globe.
        mission_id: the mission's ID at the edge.
        uav: the index of this UAV in the scenario.
        patience_s: after this time without an answer the UAV decides on board; the edge's own deadline is shorter.
        on_leg: called with every leg.
    """

    def __init__(
        self,
        vehicle: Vehicle,
        edge: AsyncEdgeClient,
        scenario: Scenario,
        frame: LocalFrame,
        mission_id: str,
        uav: int = 0,
        patience_s: float = 5.0,
        on_leg: Callable[[Leg], None] = lambda leg: None,
    ) -> None:
        self.flown = Flown()
        self._vehicle, self._edge, self._scenario, self._frame = vehicle, edge, scenario, frame
        self._mission_id, self._uav, self._patience_s, self._on_leg = mission_id, uav, patience_s, on_leg
        self._path = trajectories(scenario)[uav]
        self._sites = np.array(scenario.sites)
        self._known = _Known(len(self._sites))
        self._fallback = policy_named(FALLBACK)
        self._fallback.reset(scenario, 0)
        self._sent_m: tuple[float, float] | None = None
        self._owed: Outcome | None = None
        # Outcomes sent to an edge that could not store them.
        self._unsure: list[Outcome] = []

    async def fly(self) -> Flown:
        """Fly the whole mission, or until the battery is low."""
        await self._make_mission()
        await self._listen(0)
        for step in range(self._scenario.steps):
            position = await self._fix()
            if (await self._vehicle.telemetry.battery()).remaining_percent < RESERVE_PERCENT:
                await self._vehicle.action.return_to_launch()
                self.flown.went_home = True
                break
            await self._leg(step, position)
        await self._tell_the_last()
        return self.flown

    async def _leg(self, step: int, position: Position) -> None:
        """Decide, fly one step, collect, and keep the outcome for the next request."""
        here = self._frame.metres(position)
        progress = self._progress(here)
        observation = self._known.observation(step, here, progress, self._sites)
        sensor, velocity, decided_by, decision_id = await self._decide(observation)
        await self._fly_on(position, here, progress, velocity)
        collected = await self._vehicle.radio.collect(sensor)
        cost = float(collected.failed) + await self._listen(step + 1) / self._scenario.queue_capacity
        if decision_id is not None:
            self._owed = Outcome(decision_id=decision_id, cost=cost, failed=collected.failed)
        self.flown.legs.append(Leg(step, here, sensor, velocity, decided_by, collected.packets, cost))
        self._on_leg(self.flown.legs[-1])

    def _progress(self, here: Point) -> float:
        """Metres along the trajectory: the point nearest to the UAV between its last position and its target.

        Wind and turns keep a UAV from its exact target, and a route flown there and back passes every place twice.
        """
        if self._sent_m is None:
            return self._path.locate(here)[0]
        along = np.linspace(*self._sent_m, 200)
        return float(along[np.argmin(np.hypot(*(self._path.at(along) - here).T))])

    async def _fly_on(self, position: Position, here: Point, progress: float, velocity: int) -> None:
        """Fly one step along the trajectory, in a straight line to its end; at 0 m/s the UAV stays in place."""
        sent = progress + velocity * self._scenario.step_s
        self._sent_m = (progress, sent)
        if velocity > 0:
            x, y = self._path.at(sent).tolist()
            above_sea = position.absolute_altitude_m - position.relative_altitude_m + self._scenario.altitude_m
            await self._vehicle.action.set_current_speed(float(velocity))
            await self._vehicle.action.goto_location(*self._frame.degrees(x, y), above_sea, yaw_deg(here, (x, y)))
        await self._vehicle.clock.sleep(self._scenario.step_s)

    async def _make_mission(self) -> None:
        try:
            await self._edge.put_mission(self._mission_id, MissionSpec(scenario=self._scenario))
        except EdgeError as error:
            self.flown.last_error = str(error)

    async def _fix(self) -> Position:
        """Wait for a position: before the first fix MAVSDK returns NaN."""
        while True:
            position = await self._vehicle.telemetry.position()
            if math.isfinite(position.latitude_deg) and math.isfinite(position.absolute_altitude_m):
                return position
            await self._vehicle.clock.sleep(0.5)

    async def _listen(self, step: int) -> int:
        """Hear the sensors in range; returns the packets that they lost since their last beacons."""
        return self._known.hear(step, await self._vehicle.radio.beacons())

    async def _decide(self, observation: Observation) -> tuple[int, int, str, str | None]:
        """Sensor, velocity, the decider, and the decision's ID if the edge decided."""
        request = decide_request(self._uav, observation, self._mission_id, deadline_ms=DEADLINE_MS, outcome=self._owed)
        try:
            async with asyncio.timeout(self._patience_s):
                answer = (await self._ask(request)).response
        except (EdgeError, TimeoutError) as error:
            self.flown.last_error = str(error) or f"no answer within {self._patience_s:g} s"
            sensor, velocity = self._fallback.decide(self._uav, observation, frozenset())
            return int(sensor), int(velocity), "onboard", None
        if self._owed is not None:
            self.flown.outcomes_told += 1
            if not answer.stored:
                self._unsure.append(self._owed)
            self._owed = None
        return answer.sensor_id, min(answer.velocity, self._scenario.max_velocity), answer.source, answer.decision_id

    async def _ask(self, request: DecideRequest) -> Exchange:
        try:
            return await self._edge.decide(request)
        except EdgeRefused as refused:
            # An edge that lost its store knows neither the earlier decision nor the mission, but it can still decide.
            if request.outcome is None or not refused.blames("outcome"):
                raise
            self._owed = None
            await self._make_mission()
            return await self._edge.decide(request.model_copy(update={"outcome": None}))

    async def _tell_the_last(self) -> None:
        """Send the outcomes that no later request carried."""
        for outcome in (*self._unsure, *([self._owed] if self._owed is not None else [])):
            try:
                await self._edge.feedback(FeedbackRequest(mission_id=self._mission_id, **outcome.model_dump()))
            except EdgeError as error:
                self.flown.last_error = str(error)
                return
        self.flown.outcomes_told += self._owed is not None


class _Known:
    """The beacons that this UAV has heard of J sensors, in the form of :class:`simulator.world.Observation`."""

    def __init__(self, sensors: int) -> None:
        self._queue, self._battery, self._gain = np.zeros((3, sensors))
        self._last_heard = np.full(sensors, -1)
        self._lost: dict[int, int] = {}

    def hear(self, step: int, beacons: dict[int, Beacon]) -> int:
        """Store the beacons; returns the packets lost since these sensors were last heard."""
        lost = 0
        for sensor, beacon in beacons.items():
            self._queue[sensor] = beacon.queue
            self._battery[sensor] = beacon.battery_j
            self._gain[sensor] = beacon.channel_gain_db
            self._last_heard[sensor] = step
            lost += beacon.lost - self._lost.get(sensor, beacon.lost)
            self._lost[sensor] = beacon.lost
        return lost

    def observation(self, step: int, here: Point, progress: float, sites: FloatArray) -> Observation:
        """The observation that the edge and the policies on board decide from."""
        return Observation(
            step=np.array([step]),
            position=np.array(here),
            progress=np.array([progress]),
            sensor_position=sites,
            queue=self._queue.copy(),
            battery=self._battery.copy(),
            channel_gain=self._gain.copy(),
            last_heard=self._last_heard.copy(),
        )
