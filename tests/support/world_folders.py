"""World folders for tests."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from tests.support.places import ROOT

EXAMPLE = ROOT / "examples" / "pipeline_world"
Json = dict[str, Any]


def feature(role: str | None, kind: str, coordinates: Any, **properties: Any) -> Json:
    role_too = {} if role is None else {"role": role}
    return {
        "type": "Feature",
        "properties": {**role_too, **properties},
        "geometry": {"type": kind, "coordinates": coordinates},
    }


def sensor(name: str, longitude: float = 41.5, latitude: float = 39.95) -> Json:
    return feature("sensor", "Point", [longitude, latitude], id=name)


def there_and_back(*points: list[float]) -> Json:
    return feature("trajectory", "LineString", list(points) or [[41.5, 39.95], [41.51, 39.955]], name="north")


RING = [[41.5, 39.95], [41.51, 39.95], [41.51, 39.96], [41.5, 39.95]]
GOOD = (sensor("a"), sensor("b", 41.505), there_and_back())


def write(
    folder: Path,
    *features: Json,
    toml: str | None = None,
    trace: str | None = None,
    gains: str | None = None,
    **members: Any,
) -> Path:
    """Write a world's files into a folder; ``members`` are further members of the feature collection."""
    collection = {"type": "FeatureCollection", "features": list(features), **members}
    (folder / "world.geojson").write_text(json.dumps(collection), encoding="utf-8")
    if toml is not None:
        (folder / "scenario.toml").write_text(toml, encoding="utf-8")
    if trace is not None:
        (folder / "arrivals.csv").write_text(trace, encoding="utf-8")
    if gains is not None:
        (folder / "gains.csv").write_text(gains, encoding="utf-8")
    return folder


def traced(steps: int, header: str = "step,a,b", row: str = "1,2") -> str:
    return "\n".join([header, *(f"{t},{row}" for t in range(steps))]) + "\n"
