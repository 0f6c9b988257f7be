"""QGroundControl's ``.plan`` files: a mission as one UAV's path, and geofences; ``.waypoints`` files: a mission.

The formats: https://docs.qgroundcontrol.com/master/en/qgc-dev-guide/file_formats/plan.html and
https://mavlink.io/en/file_formats/#mission_plain_text_file
"""

import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from shared.kit.text_files import text_of
from shared.kit.validation_messages import problem_of
from shared.world.scenario import Point
from simulator.errors import UsageError
from simulator.sites.fence import Fence
from simulator.sites.files.reading import json_fault, quoted
from simulator.sites.files.survey import MAX_WAYPOINTS
from simulator.sites.plans.mission_path import (
    LAND,
    WAYPOINT,
    MissionItem,
    MissionPath,
    item_of,
    items_of,
    notes_on,
    path_of,
)

MAX_BYTES = 20_000_000
MAX_ITEMS = 10_000
# Members that say nothing of the path, or the same again.
_UNUSED = {"groundStation", "plannedHomePosition", "cruiseSpeed", "hoverSpeed", "firmwareType"} | {
    "globalPlanAltitudeMode", "Altitude", "AltitudeMode", "AMSLAltAboveTerrain", "MISSION_ITEM_ID"
}  # fmt: skip
_LANDING_PATTERNS = {"fwlandingpattern", "vtollandingpattern"}
# Members of MAV_TYPE that do not fly: https://mavlink.io/en/messages/common.html#MAV_TYPE
_GROUNDED: dict[float | None, str] = {10: "a ground rover", 11: "a boat", 12: "a submarine"}


class _PlanPart(BaseModel):
    model_config = ConfigDict(strict=True, extra="allow", allow_inf_nan=False)

    @property
    def unread(self) -> set[str]:
        """The names of members that are not known."""
        return set(self.model_extra or ()) - _UNUSED


_Latitude = Annotated[float, Field(ge=-90, le=90)]
_Longitude = Annotated[float, Field(ge=-180, le=180)]
# A tuple comes from JSON as a list.
_Place = Annotated[tuple[_Latitude, _Longitude], Field(strict=False)]


class _SimpleItem(_PlanPart):
    type: Literal["SimpleItem"]
    command: int
    frame: int = 3
    doJumpId: int | None = None
    autoContinue: bool = True
    params: list[float | None] = Field(min_length=7, max_length=7)


class _Transect(_PlanPart):
    Items: list[_SimpleItem] = Field(max_length=MAX_ITEMS)


class _ComplexItem(_PlanPart):
    type: Literal["ComplexItem"]
    complexItemType: str = ""
    TransectStyleComplexItem: _Transect | None = None


class _Mission(_PlanPart):
    version: Literal[2] = 2
    vehicleType: float | None = None
    items: list[Annotated[_SimpleItem | _ComplexItem, Field(discriminator="type")]] = Field(max_length=MAX_ITEMS)


class _FencePart(_PlanPart):
    # A key that is not known may be an area.
    model_config = ConfigDict(extra="forbid")


class _FencePolygon(_FencePart):
    version: Literal[1] = 1
    inclusion: bool
    polygon: list[_Place] = Field(min_length=3, max_length=1000)


class _Circle(_FencePart):
    center: _Place
    radius: float = Field(gt=0, le=1e6)


class _FenceCircle(_FencePart):
    version: Literal[1] = 1
    inclusion: bool
    circle: _Circle


class _GeoFence(_FencePart):
    version: Literal[2] = 2
    # Where a UAV goes that has left the fence.
    breachReturn: Any = None
    circles: list[_FenceCircle] = Field([], max_length=100)
    polygons: list[_FencePolygon] = Field([], max_length=100)


class _RallyPoints(_PlanPart):
    version: int = 2
    points: list[Any] = []


class _Plan(_PlanPart):
    fileType: Literal["Plan"]
    version: Literal[1] = 1
    mission: _Mission
    geoFence: _GeoFence = _GeoFence()
    rallyPoints: _RallyPoints = _RallyPoints()


@dataclass(frozen=True)
class FlightPlan:
    """One UAV's plan.

    Attributes:
        path: with at most as many waypoints as a world's trajectory may have.
        fences: in degrees (longitude, latitude), the radius of a circle in m.
        notes: what else the plan has, a sentence each.
    """

    path: MissionPath
    fences: tuple[Fence, ...] = ()
    notes: tuple[str, ...] = ()


def read_plan(path: Path) -> FlightPlan:
    """The flight plan in a ``.plan`` or a ``.waypoints`` file.

    Raises:
        UsageError: the file cannot be read, is no plan, or its mission is no path of straight legs; the text names the
            field or line.
    """
    if path.suffix.lower() in (".kml", ".kmz"):
        raise UsageError(f"{path} is no flight plan, but a map; {_REMEDY}")
    text = text_of(path, MAX_BYTES, UsageError)
    try:
        if text.startswith("QGC WPL"):
            plan, items, notes = _Plan(fileType="Plan", mission=_Mission(items=[])), *_text_items(text)
        else:
            plan = _Plan.model_validate_json(text)
            items, notes = list(_items(plan.mission)), _notes(plan)
        flown = path_of(items)
        if len(flown.trajectory) > MAX_WAYPOINTS:
            raise ValueError(f"mission.items: {len(flown.trajectory):,} waypoints, a trajectory has at most 1,000")
    except ValidationError as error:
        raise UsageError(f"{path}: {_error_text(error, text)}") from None
    except RecursionError:
        raise UsageError(f"{path} is no plan: it is nested too deep") from None
    except ValueError as error:
        raise UsageError(f"{path}, {error}") from None
    return FlightPlan(flown, tuple(_fences(plan.geoFence)), (*notes_on(items), *notes))


_REMEDY = "open it in QGroundControl's plan view, draw the waypoints, and save them as a .plan file"


def plan_text(trajectory: Sequence[Point], fences: Sequence[Fence], altitude_m: float, speed_m_s: float) -> str:
    """The text of a ``.plan`` file that flies a trajectory again and again.

    Args:
        trajectory: longitudes and latitudes, degrees, as in :func:`simulator.sites.plans.mission_path.items_of`.
        fences: in degrees too, as in :class:`FlightPlan`.
        altitude_m: above the take-off place.
        speed_m_s: until a command changes it.
    """
    longitude, latitude = trajectory[0]
    document = {
        "fileType": "Plan",
        "geoFence": {
            "circles": [_circle_json(fence) for fence in fences if fence.radius],
            "polygons": [_polygon_json(fence) for fence in fences if not fence.radius],
            "version": 2,
        },
        "groundStation": "QGroundControl",
        "mission": {
            "cruiseSpeed": speed_m_s,
            "firmwareType": 12,
            "globalPlanAltitudeMode": 1,
            "hoverSpeed": speed_m_s,
            "items": [_item_json(item) for item in items_of(trajectory, altitude_m)],
            "plannedHomePosition": [*_latitude_first((longitude, latitude)), 0],
            "vehicleType": 2,
            "version": 2,
        },
        "rallyPoints": {"points": [], "version": 2},
        "version": 1,
    }
    return json.dumps(document, indent=2) + "\n"


def _items(mission: _Mission) -> Iterator[MissionItem]:
    """The items with those of surveys and corridor scans in their places."""
    count = 0
    for index, item in enumerate(mission.items):
        where = f"mission.items[{index}]"
        if isinstance(item, _ComplexItem):
            if item.complexItemType.lower() in _LANDING_PATTERNS:
                count += 1
                yield MissionItem(where, count, LAND)
            elif item.TransectStyleComplexItem is None:
                kind = quoted(item.complexItemType)
                raise ValueError(f"{where}: a complex item {kind} has no path here; use waypoints, or a corridor scan")
            else:
                for within, simple in enumerate(item.TransectStyleComplexItem.Items):
                    count += 1
                    yield _item(f"{where}.TransectStyleComplexItem.Items[{within}]", simple, count)
        else:
            count += 1
            yield _item(where, item, count)


def _item(where: str, item: _SimpleItem, count: int) -> MissionItem:
    return item_of(where, count if item.doJumpId is None else item.doJumpId, item.command, item.frame, item.params)


def _notes(plan: _Plan) -> list[str]:
    """What a plan has beside its path and its fences."""
    simple = [item for item in plan.mission.items if isinstance(item, _SimpleItem)]
    unread = plan.unread.union(plan.mission.unread, *(item.unread for item in simple))
    notes = [f"not read, for it is not known: {quoted(name)}." for name in sorted(unread)]
    if grounded := _GROUNDED.get(plan.mission.vehicleType):
        notes.append(f"mission.vehicleType: the plan is for {grounded}; its path is a UAV's here.")
    if plan.rallyPoints.points:
        notes.append(f"passed over: {len(plan.rallyPoints.points)} rally points, which are the autopilot's.")
    if plan.geoFence.breachReturn is not None:
        notes.append("passed over: the geofence's breachReturn, which is the autopilot's.")
    return notes + _stops(sum(not item.autoContinue for item in simple))


def _stops(count: int) -> list[str]:
    return [f"autoContinue is off at {count} items: the autopilot may stop there."] if count else []


def _text_items(text: str) -> tuple[list[MissionItem], list[str]]:
    """The items of a plain-text mission, and notes on it; raises ``ValueError`` with the line."""
    header, *lines = text.splitlines()
    if header.split()[2:] not in (["110"], ["120"]):
        raise ValueError(f"line 1: {quoted(header)}; QGC WPL 110 is read: open the file in QGroundControl and save it")
    items: list[MissionItem] = []
    stops = 0
    for number, line in enumerate(lines, start=2):
        if not (cells := line.split()):
            continue
        where = f"line {number}"
        if len(cells) != 12:
            raise ValueError(f"{where}: {len(cells)} values, a mission's line has 12")
        try:
            index, _, frame, command, goes_on = (int(cells[column]) for column in (0, 1, 2, 3, 11))
            parameters = [value if math.isfinite(value := float(cell)) else None for cell in cells[4:11]]
        except ValueError:
            raise ValueError(f"{where}: a value is no number: {quoted(line.strip())}") from None
        if index != len(items):
            raise ValueError(f"{where}: item {index}, expected {len(items)}; items are counted from 0")
        items.append(item_of(where, index, command, frame, parameters))
        stops += not goes_on
    notes = _stops(stops)
    if header.split()[2] == "110" and items:
        # Version 120 has no home.
        home = items.pop(0)
        if (home.command, home.frame) != (WAYPOINT, 0):
            raise ValueError(f"{home.where}: a QGC WPL 110 file begins with the home position (command 16, frame 0)")
        notes.append(f"{home.where} is the home position, which is not flown to.")
    return items, notes


def _fences(drawn: _GeoFence) -> Iterator[Fence]:
    for polygon in drawn.polygons:
        corners = [(longitude, latitude) for latitude, longitude in polygon.polygon]
        closed = corners if corners[0] == corners[-1] else [*corners, corners[0]]
        yield Fence("fence" if polygon.inclusion else "no_fly", tuple(closed))
    for circle in drawn.circles:
        latitude, longitude = circle.circle.center
        yield Fence("fence" if circle.inclusion else "no_fly", ((longitude, latitude),), circle.circle.radius)


def _item_json(item: MissionItem) -> dict[str, Any]:
    latitude, longitude = (0, 0) if item.position is None else _latitude_first(item.position)
    first, second = item.parameters
    return {
        "AMSLAltAboveTerrain": None,
        "Altitude": item.altitude_m or 0,
        "AltitudeMode": 1,
        "autoContinue": True,
        "command": item.command,
        "doJumpId": item.number,
        "frame": 2 if item.position is None else 3,
        "params": [first, second, 0, None if item.position else 0, latitude, longitude, item.altitude_m or 0],
        "type": "SimpleItem",
    }


def _circle_json(fence: Fence) -> dict[str, Any]:
    area = {"center": _latitude_first(fence.points[0]), "radius": fence.radius}
    return {"circle": area, "inclusion": fence.role == "fence", "version": 1}


def _polygon_json(fence: Fence) -> dict[str, Any]:
    corners = [_latitude_first(point) for point in fence.points[:-1]]
    return {"inclusion": fence.role == "fence", "polygon": corners, "version": 1}


def _latitude_first(point: Point) -> list[float]:
    # As fine as MAVLink sends it, a centimetre.
    return [round(point[1], 7), round(point[0], 7)]


def _error_text(error: ValidationError, text: str) -> str:
    """A validation error as a message with the field's name."""
    first = error.errors(include_url=False)[0]
    where = "".join(f"[{at}]" if isinstance(at, int) else f".{at}" for at in first["loc"]).lstrip(".")
    for kind in ("SimpleItem", "ComplexItem"):
        where = where.replace(f".{kind}", "", 1)
    if first["type"] == "json_invalid":
        return f"no JSON: {json_fault(text, first['ctx']['error'])}"
    if where == "fileType" or not where:
        return f'no plan of QGroundControl: its top level needs "fileType": "Plan"; {_REMEDY}'
    if first["type"] == "extra_forbidden" or where.endswith("version"):
        fault = f"is {quoted(first['input'])}, which is not read" if where.endswith("version") else "is not known"
        return f"{where} {fault}; open the plan in a current QGroundControl and save it again"
    shown = "" if first["type"] in ("missing", "too_long", "too_short") else f", not {quoted(first['input'])}"
    return f"{where}: {problem_of(first)}{shown}"
