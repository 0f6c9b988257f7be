"""QGroundControl's ``.plan`` files: a mission as one UAV's path, and geofences.

The format: https://docs.qgroundcontrol.com/master/en/qgc-dev-guide/file_formats/plan.html
"""

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from shared.kit.validation_messages import problem_of
from shared.world.scenario import Point
from simulator.errors import UsageError
from simulator.sites.fence import Fence
from simulator.sites.files.reading import quoted, text_of
from simulator.sites.plans.mission_path import JUMP, MissionItem, MissionPath, items_of, path_of

MAX_BYTES = 20_000_000
MAX_ITEMS = 10_000
# MAV_FRAME_GLOBAL_RELATIVE_ALT, and the same as _INT.
_RELATIVE = {3, 6}


class _PlanPart(BaseModel):
    model_config = ConfigDict(strict=True, extra="ignore", allow_inf_nan=False)


_Latitude = Annotated[float, Field(ge=-90, le=90)]
_Longitude = Annotated[float, Field(ge=-180, le=180)]
# A tuple comes from JSON as a list.
_Place = Annotated[tuple[_Latitude, _Longitude], Field(strict=False)]


class _SimpleItem(_PlanPart):
    type: Literal["SimpleItem"]
    command: int
    frame: int = 3
    doJumpId: int | None = None
    params: list[float | None] = Field(min_length=7, max_length=7)


class _Transect(_PlanPart):
    Items: list[_SimpleItem] = Field(max_length=MAX_ITEMS)


class _ComplexItem(_PlanPart):
    type: Literal["ComplexItem"]
    complexItemType: str = ""
    TransectStyleComplexItem: _Transect | None = None


class _Mission(_PlanPart):
    items: list[Annotated[_SimpleItem | _ComplexItem, Field(discriminator="type")]] = Field(max_length=MAX_ITEMS)


class _FencePart(_PlanPart):
    # A key that is not known may be an area.
    model_config = ConfigDict(extra="forbid")


class _FencePolygon(_FencePart):
    version: int = 1
    inclusion: bool
    polygon: list[_Place] = Field(min_length=3, max_length=1000)


class _Circle(_FencePart):
    center: _Place
    radius: float = Field(gt=0, le=1e6)


class _FenceCircle(_FencePart):
    version: int = 1
    inclusion: bool
    circle: _Circle


class _GeoFence(_FencePart):
    version: Literal[2] = 2
    # Where a UAV goes that has left the fence.
    breachReturn: Any = None
    circles: list[_FenceCircle] = Field([], max_length=100)
    polygons: list[_FencePolygon] = Field([], max_length=100)


class _Plan(_PlanPart):
    fileType: Literal["Plan"]
    mission: _Mission
    geoFence: _GeoFence = _GeoFence()


@dataclass(frozen=True)
class FlightPlan:
    """One UAV's plan: its path, and its fences in degrees (longitude, latitude), with the radius of a circle in m."""

    path: MissionPath
    fences: tuple[Fence, ...] = ()


def read_plan(path: Path) -> FlightPlan:
    """The flight plan in a ``.plan`` file.

    Raises:
        UsageError: the file cannot be read, is no plan, or its mission is no path of straight legs; the text names the
            field.
    """
    text = text_of(path, MAX_BYTES)
    try:
        plan = _Plan.model_validate_json(text)
    except ValidationError as error:
        raise UsageError(f"{path}: {_error_text(error)}") from None
    except RecursionError:
        raise UsageError(f"{path} is no plan: it is nested too deep") from None
    try:
        flown = path_of(list(_items(plan.mission)))
    except ValueError as error:
        raise UsageError(f"{path}, {error}") from None
    return FlightPlan(flown, tuple(_fences(plan.geoFence)))


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
            if item.TransectStyleComplexItem is None:
                kind = quoted(item.complexItemType)
                raise ValueError(f"{where}: a complex item {kind} has no path here; use waypoints, or a corridor scan")
            for within, simple in enumerate(item.TransectStyleComplexItem.Items):
                count += 1
                yield _item(f"{where}.TransectStyleComplexItem.Items[{within}]", simple, count)
        else:
            count += 1
            yield _item(where, item, count)


def _item(where: str, item: _SimpleItem, count: int) -> MissionItem:
    latitude, longitude, altitude = item.params[4:]
    position = None if latitude is None or longitude is None else (longitude, latitude)
    if position is not None and item.command != JUMP and (abs(position[0]) > 180 or abs(position[1]) > 90):
        raise ValueError(f"{where}.params: {position[1]:g}, {position[0]:g} is no latitude and longitude in degrees")
    number = count if item.doJumpId is None else item.doJumpId
    relative = altitude if item.frame in _RELATIVE else None
    return MissionItem(where, number, item.command, position, relative, (item.params[0] or 0.0, item.params[1] or 0.0))


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


def _error_text(error: ValidationError) -> str:
    """A validation error as a message with the field's name."""
    first = error.errors(include_url=False)[0]
    where = "".join(f"[{at}]" if isinstance(at, int) else f".{at}" for at in first["loc"]).lstrip(".")
    for kind in ("SimpleItem", "ComplexItem"):
        where = where.replace(f".{kind}", "", 1)
    if first["type"] == "json_invalid":
        return f"no JSON: {first['ctx']['error']}"
    if where == "fileType" or not where:
        return 'no plan of QGroundControl: its top level needs "fileType": "Plan"'
    if first["type"] == "extra_forbidden" or where == "geoFence.version":
        fault = f"is {first['input']}" if where == "geoFence.version" else "is not known"
        return f"{where} {fault}; a geofence of version 2 is read: open the plan in QGroundControl and save it again"
    shown = "" if first["type"] == "missing" else f", not {quoted(first['input'])}"
    return f"{where}: {problem_of(first)}{shown}"
