"""One UAV of a flight: its vehicle, its path, what it heard, and whether it can be commanded now."""

import math
import time

import numpy as np

from field.errors import Unanswered, VehicleError
from field.vehicles.mavlink_vehicle import FlightMode, Vehicle, VehicleState
from field.vehicles.radio import HeardBeacons, Spot
from shared.world.scenario import Point
from shared.world.trajectory import Trajectory, trajectories
from simulator.sites.site import Site
from simulator.world.observation import Observation

# A UAV may be this far from where its speed would have brought it, metres: wind, turns, the error of a position.
SLACK_M = 50.0
_SAMPLE_M = 1.0
_MOST_SAMPLES = 5000


class PathFollower:
    """Follows one UAV along its trajectory.

    A trajectory may pass a place twice, on the ways there and back for instance. So a position is looked for between
    the last one and the farthest that the UAV can have come, and on the whole trajectory only if it is not near that.

    Args:
        trajectory: of the UAV.
        top_speed_m_s: of the UAV.

    Attributes:
        progress_m: arc length from the trajectory's beginning; ``None`` before the first position.
        flown_m: the way along the trajectory since the first position.
    """

    def __init__(self, trajectory: Trajectory, top_speed_m_s: float) -> None:
        self._trajectory, self._top_speed_m_s = trajectory, top_speed_m_s
        self.progress_m: float | None = None
        self.flown_m = 0.0

    def follow(self, position: Point, seconds: float) -> float:
        """Take a position that many seconds after the last one; returns its distance from the trajectory, metres."""
        before, gap = self.progress_m, self._locate(position, seconds)
        if before is not None and self.progress_m is not None:
            # Progress may restart with every lap.
            self.flown_m += math.remainder(self.progress_m - before, self._trajectory.length_m)
        return gap

    def _locate(self, position: Point, seconds: float) -> float:
        if self.progress_m is not None:
            first = max(0.0, self.progress_m - SLACK_M)
            last = self.progress_m + self._top_speed_m_s * seconds + SLACK_M
            count = min(_MOST_SAMPLES, int((last - first) / _SAMPLE_M) + 2)
            at, gap = self._nearest(position, first, last, count)
            if gap <= SLACK_M:
                # Exact to a centimetre, because the next speed follows from the metres that are left.
                apart_m = (last - first) / (count - 1)
                self.progress_m, gap = self._nearest(position, max(0.0, at - apart_m), at + apart_m, int(200 * apart_m))
                return gap
        self.progress_m, gap = self._trajectory.locate(position)
        return gap

    def _nearest(self, position: Point, first_m: float, last_m: float, count: int) -> tuple[float, float]:
        """Of so many points between two arc lengths, the arc length of the nearest one, and its distance."""
        along = np.linspace(first_m, last_m, max(count, 2))
        gaps = np.hypot(*(self._trajectory.at(along) - position).T)
        nearest = int(np.argmin(gaps))
        return float(along[nearest]), float(gaps[nearest])

    def ahead(self, metres: float) -> Point:
        """The point of the trajectory that many metres ahead."""
        x, y = self._trajectory.at((self.progress_m or 0.0) + metres).tolist()
        return x, y


# Farther from its trajectory than this a UAV gets no command.
OFF_PATH_M = 100.0
# Below this height above its home a UAV that does not say whether it is in the air is on the ground.
AIRBORNE_M = 5.0
# A UAV has begun its path at this share of its height, or so far from where it climbs, metres. On ArduPilot the
# take-off is a part of mode AUTO already, in which it climbs without a way forward.
_BEGUN_SHARE, _BEGUN_M = 0.9, 20.0
NO_TELEMETRY, LINK_LOST = "no telemetry yet", "the link is lost"
NO_POSITION = "its heartbeat arrives, but no position, which was asked for"
_ENDS: dict[FlightMode, str] = {"landing": "it lands", "returning": "it returns to where it took off"}
# Below this speed a UAV waits in place instead, m/s. A change below the second is not worth a command on the way.
LEAST_SPEED_M_S, _CHANGE_M_S = 0.5, 0.2
# A UAV that flies within half a metre a second of its fastest for so long, and is commanded more, has reached its top.
_AT_TOP_S, _NEAR_TOP_M_S = 3.0, 0.5
# The mode comes with the heartbeat, once a second: so long after its own command the flight still reads the old mode.
MODE_LAG_S = 2.5


class FieldUav:
    """A UAV on its mission.

    A UAV gets no command while a pilot, a failsafe or a landing has control of it, while its link is lost, while it is
    off its path or outside the fence, and until it has climbed to the height of its path.

    Args:
        height_m: of its lowest waypoint above the take-off place; infinite where that is unknown.

    Attributes:
        index: among the world's trajectories.
        top_speed_m_s: the ground speed that it does not exceed however much it is commanded; ``None`` until it is seen.
        waits: whether this flight commanded it to wait in place.
        unavailable_reason: why it gets no command now; ``None`` while it flies its mission.
        landed: whether it has ended its mission for good.
    """

    def __init__(self, index: int, vehicle: Vehicle, site: Site, height_m: float = AIRBORNE_M) -> None:
        self.index, self.vehicle = index, vehicle
        self.top_speed_m_s: float | None = None
        self.waits = False
        self.landed = False
        self.unavailable_reason: str | None = NO_TELEMETRY
        self._site = site
        self._follower = PathFollower(trajectories(site.scenario)[index], float(site.scenario.max_velocity))
        self._here: Point = (0.0, 0.0)
        self._degrees: Point = (0.0, 0.0)
        self._height_m = height_m
        # Where it was first seen in the air; whether it has begun its path since.
        self._climbs_at: Point | None = None
        self._begun = False
        # Since the last position that was near its trajectory.
        self._since_located_s = 0.0
        self._mode_changed_s = -math.inf
        # The last commanded ground speed, m/s; unknown before the first command. The autopilot may forget it.
        self._speed: float | None = None
        self._forgets = False
        # Where the decision that it flies ends, as a way flown; none while it flies none.
        self._goal_m: float | None = None
        self._fastest_m_s, self._at_top_s = 1.0, 0.0
        self._mode: FlightMode = "other"
        self._state: VehicleState | None = None
        self.heard = HeardBeacons(np.array(site.scenario.sites))

    async def update(self, seconds: float) -> None:
        """Read the newest telemetry, that many seconds after the last."""
        self._since_located_s += seconds
        try:
            state = await self.vehicle.state()
        except VehicleError:
            self.unavailable_reason = LINK_LOST
            return
        self._mode, self._state = state.mode, state
        self.unavailable_reason = (
            self._control_fault(state) or self._position_fault(state.position) or self._climb_fault(state.height_m)
        )
        if self.unavailable_reason is None and state.mode == "mission" and not self._mode_is_old:
            # The pilot may have resumed the mission too.
            self.waits = self.waits and self.vehicle.waits_in_mission
        self._watch_speed(state.speed_m_s, seconds)

    def spot(self, step: int) -> Spot:
        """Where it is, as far as its telemetry goes."""
        return Spot(self.index, step, self._here, self._degrees)

    def observation(self, step: int) -> Observation:
        """The observation from the beacons that it heard."""
        return self.heard.observation(step, self._here, self._follower.progress_m or 0.0)

    def of_itself(self) -> dict[str, float]:
        """The fields of its report about itself, as far as they are known."""
        state = self._state
        known = {
            "top_speed_mps": self.top_speed_m_s,
            "battery_percent": None if state is None else state.battery_percent,
            "height_m": None if state is None or state.position is None else state.height_m,
        }
        return {name: round(value, 2) for name, value in known.items() if value is not None}

    @property
    def flown_m(self) -> float:
        """The way along its trajectory since its first position, metres."""
        return self._follower.flown_m

    def dead_reckon(self, flown_m: float) -> None:
        """Assume the position where it has flown so many metres; for a UAV whose telemetry has stopped."""
        assert self._site.frame is not None, "a site with vehicles has a place on the globe"
        self._here = self._follower.ahead(max(0.0, flown_m - self.flown_m))
        longitude, latitude = self._site.frame.degrees([self._here])[0].tolist()
        self._degrees = longitude, latitude

    async def command(self, velocity: int, decided_s: float = 0.0) -> None:
        """Be ``velocity x step_s`` metres past the waypoint at the next one, as far as the speed limit allows.

        Args:
            velocity: decided, m/s.
            decided_s: seconds since the waypoint. What the UAV has flown meanwhile counts: the commanded speed brings
                it the rest of the way. A speed below ``LEAST_SPEED_M_S`` is a wait in place.

        Raises:
            VehicleError: the vehicle did not carry it out, or a pilot or failsafe took control during the decision.
        """
        left_s = self._site.scenario.step_s - decided_s
        goal_m, self._goal_m = self.flown_m + velocity * self._site.scenario.step_s, None
        await self.update(decided_s)
        speed = float(velocity) if velocity == 0 or left_s <= 0 else self._speed_to(goal_m, left_s)
        if self.unavailable_reason is not None:
            raise VehicleError(f"{self.vehicle.name} got no command to fly at {speed:g} m/s: {self.unavailable_reason}")
        if speed < LEAST_SPEED_M_S:
            # Where it cannot wait, the corrections slow it down.
            self._goal_m = goal_m
            if not self.waits:
                # Before it answers: the answer may be lost, or the flight cancelled.
                self.waits, self._mode_changed_s = True, time.monotonic()
                try:
                    await self.vehicle.hold()
                except VehicleError as error:
                    self.waits = isinstance(error, Unanswered)
                    raise
            return
        await self.resume_mission()
        await self._set_speed(speed)
        self._goal_m = goal_m if left_s > 0 else None

    async def correct(self, seconds: float, left_s: float) -> None:
        """Set the speed that brings it the rest of its decided way, where the last one no longer does.

        Airframes need time for a new speed, and PX4 forgets the speed as the mission goes on, after it has said so.

        Args:
            seconds: since the last telemetry that was read.
            left_s: until the next waypoint.

        Raises:
            VehicleError: the vehicle did not carry it out.
        """
        await self.update(seconds)
        if self.unavailable_reason is not None or self.waits or self._goal_m is None:
            return
        speed = max(LEAST_SPEED_M_S, self._speed_to(self._goal_m, left_s))
        forgotten = self._forgets and self._mode == "mission"
        if forgotten or abs(speed - (self._speed or 0.0)) >= _CHANGE_M_S:
            self._forgets = self._forgets and not forgotten
            goal_m, self._goal_m = self._goal_m, None
            await self._set_speed(speed)
            self._goal_m = goal_m

    def _speed_to(self, goal_m: float, left_s: float) -> float:
        """The speed that brings it to that way flown in time, rounded to cm/s."""
        return round(min(max((goal_m - self.flown_m) / left_s, 0.0), float(self._site.scenario.max_velocity)), 2)

    async def _set_speed(self, speed: float) -> None:
        await self.vehicle.set_speed(speed)
        self._speed = speed

    async def resume_mission(self) -> None:
        """Let it go on with its mission if this flight made it wait; raises :class:`VehicleError`."""
        if self.waits:
            await self.vehicle.resume()
            self.waits, self._mode_changed_s, self._forgets = False, time.monotonic(), True

    def _watch_speed(self, speed_m_s: float | None, seconds: float) -> None:
        """Take a ground speed; an acknowledged command is no speed, and an airframe has a fastest one."""
        if speed_m_s is None or self._speed is None or self.waits or self.unavailable_reason is not None:
            return
        near = speed_m_s >= self._fastest_m_s - _NEAR_TOP_M_S
        if speed_m_s > self._fastest_m_s + 0.1:
            self._at_top_s = 0.0
        elif near and self._speed > self._fastest_m_s + _NEAR_TOP_M_S:
            self._at_top_s += seconds
        self._fastest_m_s = max(self._fastest_m_s, speed_m_s)
        if self._at_top_s >= _AT_TOP_S or self.top_speed_m_s is not None:
            self.top_speed_m_s = self._fastest_m_s

    @property
    def _mode_is_old(self) -> bool:
        return time.monotonic() - self._mode_changed_s < MODE_LAG_S

    def _control_fault(self, state: VehicleState) -> str | None:
        """Why the UAV gets no command, whatever its position, or ``None``."""
        if not state.connected:
            return LINK_LOST
        if state.position is None:
            return NO_POSITION
        if state.armed is None:
            return NO_TELEMETRY
        self.landed = not state.armed or state.mode in _ENDS
        if self.landed:
            return _ENDS[state.mode] if state.armed else "it is not armed"
        if state.mode != "mission" and not (state.mode == "hold" and (self.waits or self._mode_is_old)):
            # The pilot who flies it now decides when its mission goes on.
            self.waits = False
            return "it does not fly its mission"
        if not (state.height_m >= AIRBORNE_M if state.in_air is None else state.in_air):
            self._begun, self._climbs_at = False, None
            return "it is on the ground"
        return None

    def _climb_fault(self, height_m: float) -> str | None:
        """Why the UAV gets no command before it flies along its path, or ``None``; its position is known."""
        self._climbs_at = self._climbs_at or self._here
        moved_m = math.dist(self._here, self._climbs_at)
        self._begun = self._begun or height_m >= _BEGUN_SHARE * self._height_m or moved_m >= _BEGUN_M
        if self._begun:
            return None
        return f"it climbs to {self._height_m:.0f} m" if math.isfinite(self._height_m) else "it climbs"

    def _position_fault(self, degrees: Point | None) -> str | None:
        """Why the UAV gets no command at this position, or ``None``."""
        assert self._site.frame is not None, "a site with vehicles has a place on the globe"
        assert degrees is not None, "without a position the link counts as lost"
        x, y = self._site.frame.metres([degrees])[0].tolist()
        self._here, self._degrees = (x, y), degrees
        if not all(fence.allows(self._here) for fence in self._site.fences):
            return "it is outside the fence"
        gap = self._follower.follow(self._here, self._since_located_s)
        if gap > OFF_PATH_M:
            return "it is off its path"
        self._since_located_s = 0.0
        return None
