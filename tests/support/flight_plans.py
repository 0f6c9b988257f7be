"""Flight plans for tests, as QGroundControl writes them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

Json = dict[str, Any]


def item(command: int, *params: float | None, number: int = 0, frame: int = 3) -> Json:
    return {
        "type": "SimpleItem",
        "command": command,
        "doJumpId": number,
        "frame": frame,
        "autoContinue": True,
        "params": [*params, *([0] * (7 - len(params)))],
    }


def waypoint(latitude: float | None, longitude: float | None, number: int, altitude: float = 60) -> Json:
    return item(16, 0, 0, 0, None, latitude, longitude, altitude, number=number)


A, B, C = (39.95, 41.5), (39.955, 41.51), (39.96, 41.505)
TRIANGLE = [waypoint(*place, number=number) for number, place in enumerate((A, B, C), start=2)]
TAKE_OFF = item(22, 15, 0, 0, None, *A, 60, number=1)
AGAIN = item(177, 2, -1, number=5, frame=2)


def plan(*items: Json, **members: Any) -> Json:
    return {
        "fileType": "Plan",
        "version": 1,
        "groundStation": "QGroundControl",
        "mission": {"version": 2, "items": list(items), "plannedHomePosition": [*A, 0], "cruiseSpeed": 15},
        "geoFence": {"circles": [], "polygons": [], "version": 2},
        "rallyPoints": {"points": [], "version": 2},
        **members,
    }


def write(path: Path, document: Any) -> Path:
    path.write_text(json.dumps(document), encoding="utf-8")
    return path
