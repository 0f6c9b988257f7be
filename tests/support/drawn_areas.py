"""Areas of a ``world.geojson`` by RFC 7946, computed in degrees, independently of the product."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import numpy as np
from pyproj import Geod

from shared.world.trajectory import trajectories
from simulator.sites.site import Site
from tests.support.world_folders import Json

_EARTH = Geod(ellps="WGS84")
_METRES_A_DEGREE = 111_300.0


def breach_m(site: Site, features: list[Json], samples: int = 97) -> float:
    """The largest distance by which trajectories leave the fences or enter the no_fly areas, metres; 0 if none does."""
    assert site.frame is not None
    worst = 0.0
    for path in trajectories(site.scenario):
        flown = path.at(np.linspace(0.0, path.length_m, samples))
        for longitude, latitude in site.frame.degrees(flown).tolist():
            for feature in features:
                role = feature["properties"]["role"]
                if role in ("fence", "no_fly"):
                    depth = _depth_m(feature, longitude, latitude)
                    worst = max(worst, depth if role == "no_fly" else -depth)
    return worst


def _depth_m(feature: Json, longitude: float, latitude: float) -> float:
    """The distance of a place from the area's boundary, metres; negative outside."""
    kind, drawn = feature["geometry"]["type"], feature["geometry"]["coordinates"]
    if kind.startswith("Multi"):
        kind, drawn = kind.removeprefix("Multi"), drawn[0]
    if kind == "Point":
        return float(feature["properties"]["radius_m"] - _EARTH.inv(longitude, latitude, *drawn)[2])
    across = math.cos(math.radians(latitude))
    # The place is the origin, so that areas may cross the antimeridian.
    ring = [(((x - longitude + 180) % 360 - 180) * across, y - latitude) for x, y in drawn[0]]
    inside, nearest = False, math.inf
    for (x1, y1), (x2, y2) in pairwise(ring):
        if (y1 > 0) != (y2 > 0) and x1 - y1 * (x2 - x1) / (y2 - y1) > 0:
            inside = not inside
        nearest = min(nearest, _from_origin((x1, y1), (x2, y2)))
    return nearest * _METRES_A_DEGREE * (1 if inside else -1)


def _from_origin(start: tuple[float, float], end: tuple[float, float]) -> float:
    way = np.subtract(end, start)
    along = np.clip(-np.dot(start, way) / max(float(way @ way), 1e-300), 0.0, 1.0)
    foot: Any = start + along * way
    return math.hypot(*foot)
