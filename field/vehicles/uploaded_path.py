"""Whether the mission on a vehicle is its trajectory in the world that the edge knows."""

from __future__ import annotations

import math
from collections.abc import Sequence

from simulator.errors import UsageError
from simulator.sites.plans.mission_path import MissionItem, path_of
from simulator.sites.site import Site

# MAVLink sends positions to the centimetre, and a plan may have been drawn on a map again.
TOLERANCE_M = 2.0


def check_uploaded(items: Sequence[MissionItem], site: Site, uav: int, vehicle: str) -> float:
    """Compare a vehicle's mission with the trajectory of a UAV.

    Returns:
        The height of the lowest waypoint above the take-off place, m; infinite where none has one above that.

    Raises:
        UsageError: the mission is no path of straight legs, or another path; the text names the waypoint.
    """
    assert site.frame is not None, "a site with vehicles has a place on the globe"
    remedy = "upload the plan that `aicvds world export --plan` writes, or take this one over by `aicvds world import`"
    try:
        path = path_of(items)
    except ValueError as error:
        raise UsageError(f"{vehicle}: its mission cannot be flown: {error}") from None
    flown, route = site.frame.metres(path.trajectory).tolist(), site.scenario.routes[uav]
    for index, (here, there) in enumerate(zip(flown, route, strict=False)):
        gap = math.dist(here, there)
        if not gap <= TOLERANCE_M:
            raise UsageError(
                f"{vehicle}: waypoint {index} of its mission is {gap:,.0f} m from that of trajectory {uav} in the "
                f"world; {remedy}"
            )
    if len(flown) != len(route):
        raise UsageError(
            f"{vehicle}: its mission's path has {len(flown)} waypoints, trajectory {uav} of the world has "
            f"{len(route)}; {remedy}"
        )
    return min((height for height in path.altitudes_m if height is not None), default=math.inf)
