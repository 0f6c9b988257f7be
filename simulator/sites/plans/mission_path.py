"""The path of a MAVLink mission: which of its items a UAV flies along, and the items of a world's trajectory.

A trajectory of a world is flown for as long as the mission lasts, so the items end in a jump to the first waypoint.
"""

import math
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.resources import files

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
        frame: a MAV_FRAME.
        height_m: above what the frame says.
        autocontinue: whether the vehicle goes on by itself after it.
    """

    where: str
    number: int
    command: int
    position: Point | None = None
    altitude_m: float | None = None
    parameters: tuple[float, float] = (0.0, 0.0)
    frame: int = 3
    height_m: float | None = None
    autocontinue: bool = True


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


# Begins a landing: the items to the next landing are its approach.
_LAND_START = 189
# Commands that leave the path as it is. Any other may change it, such as DO_JUMP_TAG.
_TABLE = tomllib.loads(files("simulator.sites.plans").joinpath("mission_commands.toml").read_text(encoding="utf-8"))
_LEAVES_PATH = {kind: set(commands) for kind, commands in _TABLE["leaves_path"].items()}
_PASSED_OVER = {"take-off": _STARTS, "landing": _ENDS | {_LAND_START}, "delay": _STAYS} | _LEAVES_PATH
_HARMLESS = frozenset().union(*_LEAVES_PATH.values())
# MAV_FRAME numbers of latitudes and longitudes, by what their heights are above.
_ABOVE = {0: "mean sea level", 5: "mean sea level", 3: "take-off", 6: "take-off", 10: "the terrain", 11: "the terrain"}


def item_of(where: str, number: int, command: int, frame: int, parameters: Sequence[float | None]) -> MissionItem:
    """The item of the seven parameters that files write."""
    first, second, _, _, latitude, longitude, height = parameters
    position = None if latitude is None or longitude is None else (longitude, latitude)
    relative = height if _ABOVE.get(frame) == "take-off" else None
    return MissionItem(where, number, command, position, relative, (first or 0.0, second or 0.0), frame, height)


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
        if item.command == _LAND_START:
            lands = next((at for at in range(index, len(items)) if items[at].command in _ENDS), index)
            _check_end(item, [after for after in items[index + 1 : lands] if after.command > _LAST_NAVIGATION])
            _check_end(item, items[lands + 1 :])
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
        elif item.command not in _HARMLESS | _STAYS and (waypoints or item.command not in _STARTS):
            fault = "is no straight leg" if item.command <= _LAST_NAVIGATION else "may change the path"
            raise ValueError(
                f"{item.where}: command {item.command} {fault}; use waypoints (16), with take-off before them, and "
                "landing, return or a jump to the first one (177) after"
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
    flown = trajectory[:-1] if trajectory[0] == trajectory[-1] else (*trajectory, *trajectory[-2:0:-1])
    items = [MissionItem("take-off", 1, TAKEOFF, trajectory[0], altitude_m)]
    for number, position in enumerate(flown, start=2):
        items.append(MissionItem(f"waypoint {number - 2}", number, WAYPOINT, position, altitude_m))
    items.append(MissionItem("jump", len(items) + 1, JUMP, parameters=(2.0, float(FOREVER))))
    return items


def notes_on(items: Sequence[MissionItem]) -> list[str]:
    """What the items have and a world's trajectory has not, a sentence each."""
    notes = []
    kinds = {kind: sum(item.command in commands for item in items) for kind, commands in _PASSED_OVER.items()}
    if any(kinds.values()):
        passed = ", ".join(f"{kind} ({count})" for kind, count in kinds.items() if count)
        notes.append(f"passed over, for they are not the path's: {passed}.")
    waypoints = [item for item in items if item.command == WAYPOINT]
    if waits := [item for item in waypoints if item.parameters[0] > 0]:
        notes.append(f"waits at {len(waits)} waypoints, the first at {waits[0].where}; a world's UAVs fly on.")
    jump = next((item for item in items if item.command == JUMP), None)
    if jump is not None and jump.parameters[1] > 0 and not repeats_forever(jump):
        notes.append(f"flies {jump.parameters[1] + 1:g} laps; a world's UAVs fly on.")
    elif jump is not None and (unreached := items[items.index(jump) + 1 :]):
        notes.append(f"{len(unreached)} items from {unreached[0].where} on are never reached, after an endless jump.")
    heights: dict[str, list[float]] = {}
    for item in waypoints:
        if item.height_m is not None:
            heights.setdefault(_ABOVE.get(item.frame, "something else"), []).append(item.height_m)
    if heights:
        ranges = (
            f"{min(of):g}{f' to {max(of):g}' if max(of) > min(of) else ''} m above {above}"
            for above, of in heights.items()
        )
        notes.append(f"waypoints at {' and at '.join(ranges)}; a world has one height: altitude_m in scenario.toml.")
    return notes


def _position(item: MissionItem) -> Point:
    if item.position is None or not all(math.isfinite(value) for value in item.position) or item.position == (0, 0):
        raise ValueError(f"{item.where}: the waypoint has no position; give it a latitude and a longitude")
    if item.frame not in _ABOVE:
        raise ValueError(f"{item.where}: frame {item.frame} is not global; give a latitude and a longitude (frame 3)")
    longitude, latitude = item.position
    if abs(longitude) > 180 or abs(latitude) > 90:
        raise ValueError(f"{item.where}: {latitude:g}, {longitude:g} is no latitude and longitude in degrees")
    return item.position


def _check_end(end: MissionItem, after: Sequence[MissionItem]) -> None:
    """Raises ``ValueError`` where the vehicle flies on after the item that ends the path."""
    for item in after:
        if item.command not in _HARMLESS:
            raise ValueError(
                f"{item.where}: command {item.command} comes after {end.where} (command {end.command}), where the path "
                "ends; make a plan of its own of what is flown then, or take it out"
            )


def _check_jump(item: MissionItem, items: Sequence[MissionItem], first_number: int | None) -> None:
    """Raises ``ValueError`` for a jump that does not begin the whole path again."""
    target = int(item.parameters[0])
    before = [other.number for other in items if first_number is not None and other.number < first_number]
    # A jump to an item between take-off and the first waypoint also begins the path again.
    allowed = {other.number for other in items if other.number in before and other.command in _HARMLESS}
    if first_number is None or target not in allowed | {first_number}:
        raise ValueError(f"{item.where}: it jumps to item {target}; only a jump to the first waypoint can be flown")
    if item.parameters[1] == 0:
        raise ValueError(f"{item.where}: it repeats 0 times; give -1 (for ever), or take it out")
