"""One UAV by its telemetry: when it may be commanded, and what it says of itself."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from field.errors import VehicleError
from field.vehicles.field_uav import NO_POSITION, FieldUav
from field.vehicles.mavlink_vehicle import VehicleState
from simulator.sites.files.world_folder import site_from_folder
from simulator.sites.site import Site
from tests.support.stub_vehicle import SimulatedClock, StubVehicle
from tests.support.world_folders import EXAMPLE


class Told(StubVehicle):
    """Reports what it is told to."""

    def __init__(self, site: Site) -> None:
        super().__init__(site, 0, SimulatedClock())
        self.reported: dict[str, Any] = {}

    async def state(self) -> VehicleState:
        return replace(await super().state(), **self.reported)


def told_uav(height_m: float = 50.0) -> tuple[FieldUav, Told]:
    site = site_from_folder(EXAMPLE, 12)
    vehicle = Told(site)
    return FieldUav(0, vehicle, site, height_m), vehicle


async def reasons(uav: FieldUav, vehicle: Told, *reported: dict[str, Any]) -> list[str | None]:
    """Why it gets no command after each of these reports."""
    found = []
    for vehicle.reported in reported:
        await uav.update(1.0)
        found.append(uav.unavailable_reason)
    return found


async def test_a_uav_that_was_on_the_ground_again_climbs_to_its_path_before_it_is_commanded() -> None:
    uav, vehicle = told_uav()
    assert await reasons(
        uav,
        vehicle,
        {"height_m": 44.0, "in_air": True},
        {"height_m": 45.0, "in_air": True},
        {"height_m": 10.0, "in_air": True},
        {"height_m": 0.0, "in_air": False},
        {"height_m": 10.0, "in_air": True},
        {"height_m": 45.0, "in_air": True},
    ) == ["it climbs to 50 m", None, None, "it is on the ground", "it climbs to 50 m", None]


async def test_a_uav_that_flies_low_along_its_path_is_commanded_after_20_metres() -> None:
    uav, vehicle = told_uav()
    found = []
    for vehicle.flown_m in (0.0, 19.0, 21.0):
        found += await reasons(uav, vehicle, {"height_m": 10.0})
    assert found == ["it climbs to 50 m", "it climbs to 50 m", None]


async def test_an_airframe_that_still_grows_faster_has_not_reached_its_top_speed() -> None:
    uav, vehicle = told_uav()
    await uav.update(1.0)
    await uav.command(14)
    seen = []
    for speed in (7.0, 7.0, 9.0, 9.0, 9.0):
        vehicle.reported = {"speed_m_s": speed}
        await uav.update(2.0)
        seen.append(uav.top_speed_m_s)
    assert seen == [None, None, None, None, 9.0]


async def test_a_uav_without_a_position_reports_no_height() -> None:
    uav, vehicle = told_uav()
    assert await reasons(uav, vehicle, {"battery_percent": 80.0}) == [None]
    assert uav.of_itself() == {"battery_percent": 80.0, "height_m": 100.0}
    assert await reasons(uav, vehicle, {"battery_percent": 79.0, "position": None}) == [NO_POSITION]
    assert uav.of_itself() == {"battery_percent": 79.0}


async def test_a_uav_that_refused_to_wait_does_not_count_as_waiting_and_is_told_again() -> None:
    uav, vehicle = told_uav()
    await uav.update(1.0)
    vehicle.deaf = True
    for _ in range(2):
        with pytest.raises(VehicleError, match="stub 0 did not do hold"):
            await uav.command(0)
        assert not uav.waits
    await uav.resume_mission()
    assert vehicle.commands == ["hold", "hold"]
