"""The path of a MAVLink mission: which of its items a UAV flies along, and the items of a world's trajectory.

A trajectory of a world is flown for as long as the mission lasts, so the items end in a jump to the first waypoint.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from shared.world.scenario import Point

# MAV_CMD numbers, https://mavlink.io/en/messages/common.html
WAYPOINT, RETURN_TO_LAUNCH, LAND, TAKEOFF, JUMP = 16, 20, 21, 22, 177
_VTOL_TAKEOFF, _VTOL_LAND, DELAY = 84, 85, 93
# Commands up to this number make the vehicle fly somewhere; the ones above change speed, camera and the like.
_LAST_NAVIGATION = 95
_STARTS, _ENDS, _STAYS = {TAKEOFF, _VTOL_TAKEOFF}, {RETURN_TO_LAUNCH, LAND, _VTOL_LAND}, {DELAY}
# The repeats of a jump without an end. MAVLink's is -1, but PX4 stores the number as uint16 (mavlink_mission.cpp), and
# C++ leaves open what becomes of -1. ArduPilot, which stores it as int16, keeps this number, too.
FOREVER = 32767


@dataclass(frozen=True)
class MissionItem:
    """One item of a mission.

    Attributes:
        where: the item's place in its file or vehicle, for messages.
        number: the number by which a jump names it.
        command: a MAV_CMD.
        position: longitude and latitude, degrees; ``None`` without one.
        altitude_m: above the take-off place; ``None`` for another reference, or none.
        parameters: the first two of the command.
    """

    where: str
    number: int
    command: int
    position: Point | None = None
    altitude_m: float | None = None
    parameters: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class MissionPath:
    """The straight legs that a mission's waypoints make.

    Attributes:
        waypoints: longitudes and latitudes in the order flown, degrees; no two successive ones are equal.
        repeats: whether the vehicle flies from the last waypoint to the first one and begins again.
        altitudes_m: of the waypoints, as in :class:`MissionItem`.
    """

    waypoints: tuple[Point, ...]
    repeats: bool
    altitudes_m: tuple[float | None, ...] = ()

    @property
    def trajectory(self) -> tuple[Point, ...]:
        """The path as a world's trajectory: a ring is closed, and a way that is flown back again comes once."""
        first, *rest = self.waypoints
        if not self.repeats or first == rest[-1]:
            return self.waypoints
        if rest == rest[::-1]:
            return (first, *rest[: (len(rest) + 1) // 2])
        return (first, *rest, first)


def path_of(items: Sequence[MissionItem]) -> MissionPath:
    """The path that the items make.

    Raises:
        ValueError: an item is not flown along straight legs, or there are fewer than two waypoints; the text begins
            with the item's place.
    """
    waypoints: list[Point] = []
    altitudes: list[float | None] = []
    first_number = None
    repeats = False
    for index, item in enumerate(items):
        if item.command in _ENDS:
            _check_end(item, items[index + 1 :])
            break
        if item.command == JUMP:
            _check_jump(item, items, first_number)
            if not repeats_forever(item):
                _check_end(item, [after for after in items[index + 1 :] if after.command not in _ENDS])
            repeats = True
            break
        if item.command == WAYPOINT:
            position = _position(item)
            first_number = item.number if first_number is None else first_number
            if not waypoints or waypoints[-1] != position:
                waypoints.append(position)
                altitudes.append(item.altitude_m)
        elif item.command <= _LAST_NAVIGATION and item.command not in _STARTS | _STAYS:
            raise ValueError(
                f"{item.where}: command {item.command} is no straight leg; use waypoints (16), with take-off before "
                "them, and landing, return or a jump to the first one (177) after"
            )
    if len(set(waypoints)) < 2:
        raise ValueError(f"{len(set(waypoints))} waypoints; a path needs at least two that differ")
    return MissionPath(tuple(waypoints), repeats, tuple(altitudes))


def repeats_forever(jump: MissionItem) -> bool:
    """Whether a jump has no end that a flight reaches."""
    return jump.parameters[1] < 0 or jump.parameters[1] >= FOREVER


def items_of(trajectory: Sequence[Point], altitude_m: float) -> list[MissionItem]:
    """The items that fly a trajectory again and again: take-off, the waypoints, a jump to the first of them.

    Args:
        trajectory: longitudes and latitudes, degrees. It is flown there and back, in laps if the last is the first.
        altitude_m: above the take-off place.
    """
    ring = trajectory[0] == trajectory[-1]
    flown = trajectory[:-1] if ring else (*trajectory, *trajectory[-2:0:-1])
    items = [MissionItem("take-off", 1, TAKEOFF, trajectory[0], altitude_m)]
    for number, position in enumerate(flown, start=2):
        items.append(MissionItem(f"waypoint {number - 2}", number, WAYPOINT, position, altitude_m))
    items.append(MissionItem("jump", len(items) + 1, JUMP, parameters=(2.0, float(FOREVER))))
    return items


def _position(item: MissionItem) -> Point:
    if item.position is None or not all(math.isfinite(value) for value in item.position) or item.position == (0, 0):
        raise ValueError(f"{item.where}: the waypoint has no position; give it a latitude and a longitude")
    return item.position


def _check_end(end: MissionItem, after: Sequence[MissionItem]) -> None:
    """Raises ``ValueError`` where the vehicle flies on after the item that ends the path."""
    for item in after:
        if item.command <= _LAST_NAVIGATION or item.command == JUMP:
            raise ValueError(
                f"{item.where}: command {item.command} comes after {end.where} (command {end.command}), where the path "
                "ends; make a plan of its own of what is flown then, or take it out"
            )


def _check_jump(item: MissionItem, items: Sequence[MissionItem], first_number: int | None) -> None:
    """Raises ``ValueError`` for a jump that does not begin the whole path again."""
    target = int(item.parameters[0])
    before = [other.number for other in items if first_number is not None and other.number < first_number]
    # A jump to an item between take-off and the first waypoint also begins the path again.
    allowed = {other.number for other in items if other.number in before and other.command > _LAST_NAVIGATION}
    if first_number is None or target not in allowed | {first_number}:
        raise ValueError(f"{item.where}: it jumps to item {target}; only a jump to the first waypoint can be flown")
    if item.parameters[1] == 0:
        raise ValueError(f"{item.where}: it repeats 0 times; give -1 (for ever), or take it out")
