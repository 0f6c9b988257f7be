"""The flight of real UAVs: telemetry in, decisions out as speeds along their missions' paths, outcomes back.

All UAVs of a flight are at the same waypoint: every ``step_s`` seconds of the mission each reports, decides, and gets
the speed that brings it to its next waypoint in time, which is corrected on the way. There it collects from the decided
sensor.
"""

import asyncio
import time
from collections import Counter
from collections.abc import Awaitable, Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TypeVar

import numpy as np

from field.errors import VehicleError
from field.vehicles.field_pilot import FieldPilot
from field.vehicles.field_uav import LINK_LOST, NO_POSITION, FieldUav
from field.vehicles.radio import Beacon, Collected, LossCounters, Radio, Spot
from shared.wire.schemas import Mode
from simulator.flying.pilots import PilotChoice
from simulator.records.decision import Decision
from simulator.records.flight import Flight
from simulator.sites.site import Site
from simulator.world.observation import StepTally

# Parts of a step in which the speed is corrected; in the last one a new speed would take effect too late.
_PARTS = 5
# A UAV that was to fly and came less far in a step stays in place, metres.
_IN_PLACE_M = 1.0

T = TypeVar("T")


class MissionClock:
    """Seconds since some instant, by the machine's clock, ``speedup`` times as fast."""

    def __init__(self, speedup: float = 1.0) -> None:
        self._speedup = speedup

    def now(self) -> float:
        """The present time, seconds."""
        return time.monotonic() * self._speedup

    async def until(self, time_s: float) -> None:
        """Wait until then; not at all if it is over."""
        await asyncio.sleep(max(0.0, time_s - self.now()) / self._speedup)


@dataclass
class RealFlight(Flight):
    """A flight so far; its ``tally`` counts a sensor's losses once, when a beacon reports them, and ``track`` is empty.

    Attributes:
        mode: the mission's at the edge; ``None`` where neither the command nor the edge gave it.
        late: decisions that came after their step.
        undecided: waypoints at which a UAV got no command, by the reason.
        not_carried_out: texts of the commands that a vehicle did not carry out.
        ended: by UAV, why it did not fly its mission at the end.
        metres: by UAV, the ways decided and flown, of the decisions at whose start and end its position was known.
        warnings: texts on missions that may not be flown as the world says.
    """

    mode: Mode | None = None
    late: int = 0
    undecided: Counter[str] = field(default_factory=Counter)
    not_carried_out: list[str] = field(default_factory=list)
    ended: dict[int, str] = field(default_factory=dict)
    metres: dict[int, tuple[float, float]] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class _Leg:
    """A decision that is being flown, from a way flown of ``start_m``."""

    uav: FieldUav
    choice: PilotChoice
    spot: Spot
    start_m: float


class FieldFlight:
    """Flies UAVs on their missions for a world's steps.

    Args:
        site: a world on the globe.
        uavs: in the air, on their missions.
        radio: of all of them.
        pilot: decides for them.
        clock: of the mission.
        on_decision: called with each decision once its outcome is known.
        on_event: called with a UAV's index and a text when commands to it stop, resume or fail.
    """

    def __init__(
        self,
        site: Site,
        uavs: Sequence[FieldUav],
        radio: Radio,
        pilot: FieldPilot,
        clock: MissionClock | None = None,
        on_decision: Callable[[Decision], None] = lambda decision: None,
        on_event: Callable[[int, str], None] = lambda uav, text: None,
    ) -> None:
        self.result = RealFlight(site.scenario, None, sensor_xy=np.array(site.scenario.sites))
        self._scenario, self._uavs, self._radio, self._pilot = site.scenario, uavs, radio, pilot
        self._clock = clock or MissionClock()
        self._on_decision, self._on_event = on_decision, on_event
        self._unavailable_reasons: dict[int, str | None] = {}
        self._counters = LossCounters()
        # When the newest telemetry was read.
        self._read_s = self._clock.now()

    async def fly(self) -> RealFlight:
        """Fly the steps, or until every UAV has landed. A cancelled flight ends like a flown one, and then raises."""
        legs: list[_Leg] = []
        took_off = time.monotonic()
        step_s, began = self._scenario.step_s, self._clock.now()
        try:
            await self._update_uavs()
            for step in range(self._scenario.steps):
                if step == 0:
                    await self._listen(0)
                legs = await self._decide(step, began + step * step_s)
                if self._clock.now() > began + (step + 1) * step_s:
                    self.result.late += len(legs)
                await self._correct(legs, began + (step + 1) * step_s)
                await self._clock.until(began + (step + 1) * step_s)
                await self._update_uavs()
                await self._collect(legs, step)
                legs = []
                if all(uav.landed for uav in self._uavs):
                    break
        finally:
            # If the flight is cut short, the outcomes of its last decisions stay unknown.
            await self._finish()
            reasons = {uav.index: uav.unavailable_reason for uav in self._uavs}
            self.result.ended = {index: reason for index, reason in reasons.items() if reason is not None}
            self.result.mode = self._pilot.mode
            self.result.duration_s = time.monotonic() - took_off
        return self.result

    async def _update_uavs(self) -> None:
        seconds = self._since_read_s()
        await asyncio.gather(*(uav.update(seconds) for uav in self._uavs))
        for uav in self._uavs:
            if uav.unavailable_reason != self._unavailable_reasons.get(uav.index):
                self._on_event(uav.index, uav.unavailable_reason or "it flies its mission")
            self._unavailable_reasons[uav.index] = uav.unavailable_reason

    def _since_read_s(self) -> float:
        before, self._read_s = self._read_s, self._clock.now()
        return self._read_s - before

    async def _correct(self, legs: Sequence[_Leg], ends_s: float) -> None:
        """Correct the speeds until the last part of the step that ends then."""
        part_s = self._scenario.step_s / _PARTS
        while self._clock.now() < ends_s - 1.5 * part_s:
            await self._clock.until(self._clock.now() + part_s)
            seconds, left_s = self._since_read_s(), ends_s - self._read_s
            await asyncio.gather(*(self._carry_out(leg.uav, leg.uav.correct(seconds, left_s)) for leg in legs))

    async def _decide(self, step: int, since_s: float) -> list[_Leg]:
        """Decide for the UAVs that fly their missions, and command them; their waypoint was at ``since_s``."""
        flying = {uav.index: uav for uav in self._uavs if uav.unavailable_reason is None}
        for uav in self._uavs:
            if uav.unavailable_reason is not None:
                self.result.undecided[uav.unavailable_reason] += 1
        choices = await self._pilot.decide(
            {index: uav.observation(step) for index, uav in flying.items()},
            {index: uav.of_itself() for index, uav in flying.items()},
        )
        legs = [
            _Leg(flying[index], choice, flying[index].spot(step), flying[index].flown_m)
            for index, choice in choices.items()
        ]
        self._read_s = self._clock.now()
        decided_s = self._read_s - since_s
        await asyncio.gather(
            *(self._carry_out(leg.uav, leg.uav.command(leg.choice.velocity, decided_s)) for leg in legs)
        )
        return legs

    async def _carry_out(self, uav: FieldUav, command: Awaitable[None]) -> None:
        try:
            await command
        except VehicleError as error:
            self.result.not_carried_out.append(str(error))
            self._on_event(uav.index, str(error))

    async def _received(self, uav: FieldUav, receiving: Awaitable[T], nothing: T) -> T:
        """What a radio receives; nothing where it fails, whatever it raises, or takes longer than a step."""
        try:
            return await asyncio.wait_for(receiving, self._scenario.step_s)
        except Exception as error:
            self._on_event(uav.index, f"its radio fails: {type(error).__name__}: {error}".removesuffix(": "))
            return nothing

    async def _beacons(self, spot: Spot) -> Mapping[int, Beacon]:
        """The radio's beacons; raises ``ValueError`` where they are none."""
        found = await self._radio.beacons(spot)
        for sensor, beacon in found.items():
            if not (sensor in range(self._scenario.sensors) and beacon.queue >= 0 and beacon.lost >= 0):
                raise ValueError(f"sensor {sensor}: {beacon}")
        return found

    async def _collected(self, spot: Spot, sensor: int) -> Collected:
        """The radio's packets; raises ``ValueError`` where they are none."""
        found = await self._radio.collect(spot, sensor)
        if found.packets < 0 or found.packets != int(found.packets):
            raise ValueError(f"sensor {sensor}: {found}")
        return Collected(int(found.packets), bool(found.failed))

    async def _collect(self, legs: Sequence[_Leg], step: int) -> None:
        """Collect in the order of the UAVs, hear the sensors at the next waypoint, and record the outcomes."""
        collected = {}
        for leg in legs:
            if leg.uav.unavailable_reason in (LINK_LOST, NO_POSITION):
                leg.uav.dead_reckon(leg.start_m + leg.choice.velocity * self._scenario.step_s)
            else:
                decided_m, flown_m = self.result.metres.get(leg.uav.index, (0.0, 0.0))
                decided_m += leg.choice.velocity * self._scenario.step_s
                flew_m = leg.uav.flown_m - leg.start_m
                self.result.metres[leg.uav.index] = decided_m, flown_m + flew_m
                if leg.choice.velocity and abs(flew_m) < _IN_PLACE_M and leg.uav.unavailable_reason is None:
                    self._on_event(leg.uav.index, "it stays in place in mode mission: its mission may have ended")
            collecting = self._collected(leg.uav.spot(step), leg.choice.sensor)
            collected[leg.uav.index] = await self._received(leg.uav, collecting, Collected(0, failed=True))
        lost, grown = await self._listen(step + 1)
        for leg in legs:
            got, index = collected[leg.uav.index], leg.uav.index
            cost = float(got.failed) + lost[index] / self._scenario.queue_capacity
            self._pilot.learn(index, leg.choice, cost, got.failed)
            decision = Decision(
                step=step,
                uav_id=index,
                position=leg.spot.position,
                failed=got.failed,
                collected=got.packets,
                lost_packets=lost[index],
                cost=cost,
                **leg.choice.recorded(),
            )
            self.result.decisions.append(decision)
            self._on_decision(decision)
        self.result.tally.append(self._tally(step, legs, collected, grown))

    def _tally(
        self, step: int, legs: Sequence[_Leg], collected: Mapping[int, Collected], lost: Mapping[int, int]
    ) -> StepTally:
        packets = np.zeros(self._scenario.sensors, dtype=np.int64)
        for leg in legs:
            packets[leg.choice.sensor] += collected[leg.uav.index].packets
        return StepTally(
            step=step,
            failures=sum(got.failed for got in collected.values()),
            overflows=sum(count > 0 for count in lost.values()),
            lost_packets=sum(lost.values()),
            collected=packets,
        )

    async def _listen(self, step: int) -> tuple[dict[int, int], dict[int, int]]:
        """Hear the sensors in range of each UAV.

        Returns the packets that they lost: by UAV, since that UAV last heard them; by sensor, since any UAV did.
        """
        heard = {uav.index: await self._received(uav, self._beacons(uav.spot(step)), {}) for uav in self._uavs}
        counters: dict[int, int] = {}
        for beacons in heard.values():
            for sensor, beacon in beacons.items():
                counters[sensor] = max(beacon.lost, counters.get(sensor, 0))
        own = {uav.index: uav.heard.hear(step, heard[uav.index]) for uav in self._uavs}
        return own, self._counters.grow(counters)

    async def _finish(self) -> None:
        """Let the UAVs go on with their missions, and send the last outcomes."""
        for uav in self._uavs:
            if uav.unavailable_reason is None:
                try:
                    await uav.resume_mission()
                except VehicleError as error:
                    self.result.not_carried_out.append(str(error))
        await self._pilot.land()
