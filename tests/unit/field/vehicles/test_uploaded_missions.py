"""The check of a vehicle's mission against the world."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from field.vehicles.field_run import check_uploaded
from simulator.errors import UsageError
from simulator.sites.files.world_folder import site_from_folder
from simulator.sites.plans.mission_path import items_of
from tests.support.world_folders import feature, sensor, write


def test_a_long_leg_on_board_is_the_worlds(tmp_path: Path) -> None:
    line = ((10.0, 50.0), (10.5, 50.0))
    trajectory = feature("trajectory", "LineString", [list(place) for place in line])
    site = site_from_folder(write(tmp_path, sensor("a", 10.0, 50.0), trajectory))
    assert len(site.scenario.routes[0]) > 2
    assert check_uploaded(items_of(line, 60.0), site, 0, "UAV") == 60.0


def test_a_mission_within_the_tolerance_may_break_no_fence(tmp_path: Path) -> None:
    """The world's line is 1 m from the area, the vehicle's 1 m in it."""
    trajectory = feature("trajectory", "LineString", [[41.5, 39.95], [41.51, 39.95]])
    ring = [[41.5, 39.950009], [41.51, 39.950009], [41.51, 39.96], [41.5, 39.950009]]
    site = site_from_folder(write(tmp_path, sensor("a"), trajectory, feature("no_fly", "Polygon", [ring])))
    assert check_uploaded(items_of(((41.5, 39.95), (41.51, 39.95)), 60.0), site, 0, "UAV") == 60.0
    with pytest.raises(UsageError, match="UAV: its mission leaves the world's fence, or enters a no_fly area"):
        check_uploaded(items_of(((41.5, 39.950014), (41.51, 39.950014)), 60.0), site, 0, "UAV")


@pytest.mark.parametrize(("frame", "fault"), [(1, "frame 1 is not global"), (8, "frame 8 is not global")])
def test_a_local_mission_is_refused(tmp_path: Path, frame: int, fault: str) -> None:
    trajectory = feature("trajectory", "LineString", [[41.5, 39.95], [41.51, 39.95]])
    site = site_from_folder(write(tmp_path, sensor("a"), trajectory))
    items = [replace(item, frame=frame) for item in items_of(((41.5, 39.95), (41.51, 39.95)), 60.0)]
    with pytest.raises(UsageError, match=fault):
        check_uploaded(items, site, 0, "UAV")


@pytest.mark.parametrize(
    "line",
    [
        [[10.0, 50.0], [10.002, 50.0], [10.002, 50.0], [10.004, 50.001]],
        [[10.0, 50.0], [10.002, 50.0], [10.004, 50.001], [10.002, 50.0], [10.0, 50.0]],
        [[10.0, 50.0], [10.002, 50.0], [10.002, 50.002], [10.0, 50.0]],
    ],
    ids=["a waypoint twice", "a way back that is drawn out", "a ring"],
)
def test_a_worlds_own_line_is_accepted(tmp_path: Path, line: list[list[float]]) -> None:
    site = site_from_folder(write(tmp_path, sensor("a", 10.0, 50.0), feature("trajectory", "LineString", line)))
    assert check_uploaded(items_of([(lon, lat) for lon, lat in line], 60.0), site, 0, "UAV") == 60.0
