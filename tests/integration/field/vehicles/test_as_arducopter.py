"""`aicvds fly` against a vehicle that behaves as a real ArduCopter was seen to, and as PX4 where that differs.

The rows are those of table B in ../shared/REALITY.md; the vehicle is tests/support/pymavlink_peer.py.
"""

from __future__ import annotations

import asyncio
import math
from pathlib import Path

import pytest

from field.errors import VehicleError
from field.vehicles.field_run import check_uploaded, doubts_of, wait_for_missions
from field.vehicles.field_uav import MODE_LAG_S, NO_POSITION, NO_TELEMETRY, FieldUav
from field.vehicles.mavlink_vehicle import mavlink_vehicle
from simulator.records.summary import Summary
from simulator.sites.files.world_folder import site_from_folder
from simulator.sites.plans.mission_path import MissionItem
from tests.support.airframe import Item, without_repeats
from tests.support.edge_stub import free_port
from tests.support.flights import arguments, wait_for_reason
from tests.support.processes import output_until, started
from tests.support.pymavlink_peer import ARDUPILOT, PAUSE, POSITION, PX4, SPEED, pymavlink_peer
from tests.support.waiting import PATIENCE_S, Striding, soon
from tests.support.world_folders import EXAMPLE

BATTERY_STATUS, SET_MESSAGE_INTERVAL = 147, 511


@pytest.mark.parametrize("answers", [True, False], ids=["acknowledged", "not answered"])
async def test_an_ardupilot_is_asked_for_its_position_and_again_after_a_gap(
    missions: list[list[Item]], port: int, answers: bool
) -> None:
    with pymavlink_peer(missions[0], port, autopilot=ARDUPILOT) as peer:
        peer.answers_requests = answers
        async with mavlink_vehicle(f"udpin://127.0.0.1:{port}", PATIENCE_S) as vehicle:
            uav = FieldUav(0, vehicle, site_from_folder(EXAMPLE))
            await wait_for_reason(uav, None)
            # It has started anew, and sends heartbeats alone until it is asked again.
            peer.streams.clear()
            peer.obeys_requests = False
            await wait_for_reason(uav, "its heartbeat arrives, but no position, which was asked for")
            assert not uav.landed
            peer.obeys_requests = True
            await wait_for_reason(uav, None)


async def test_an_autopilot_that_streams_its_position_is_not_asked_for_it(
    missions: list[list[Item]], port: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    # The time stands still: no position is late, however busy the machine is.
    monkeypatch.setattr("field.vehicles.mavlink_vehicle.time", Striding(0.0))
    with pymavlink_peer(missions[0], port) as peer:

        def asked() -> list[float]:
            found = [m for _, m in list(peer.received) if m.get_type() == "COMMAND_LONG"]
            return [m.param1 for m in found if m.command == SET_MESSAGE_INTERVAL]

        async with mavlink_vehicle(f"udpin://127.0.0.1:{port}", PATIENCE_S) as vehicle:
            await wait_for_reason(FieldUav(0, vehicle, site_from_folder(EXAMPLE)), None)
            # It sends no battery, and is asked for that after a second; for a position it would be asked before.
            await soon(lambda: BATTERY_STATUS in asked())
            assert POSITION not in asked()


async def test_decisions_begin_at_the_height_of_the_path_or_on_the_way(missions: list[list[Item]], port: int) -> None:
    with pymavlink_peer(missions[0], port, autopilot=ARDUPILOT) as peer:
        peer.airframe.climbs_m = 0.0
        async with mavlink_vehicle(f"udpin://127.0.0.1:{port}", PATIENCE_S) as vehicle:
            uav = FieldUav(0, vehicle, site_from_folder(EXAMPLE), height_m=100.0)
            await wait_for_reason(uav, "it is on the ground")
            peer.airframe.climbs_m = 6.0
            await wait_for_reason(uav, "it climbs to 100 m")
            with pytest.raises(VehicleError, match="does not fly its mission: it climbs"):
                await wait_for_missions([uav], wait_s=0.3)
            peer.airframe.climbs_m = 92.0
            await wait_for_reason(uav, None)
            # A descent on the way is none to the ground.
            peer.airframe.climbs_m = 30.0
            await asyncio.sleep(0.2)
            await wait_for_reason(uav, None)
            low = FieldUav(0, vehicle, site_from_folder(EXAMPLE), height_m=math.inf)
            await wait_for_reason(low, "it climbs")
            peer.airframe.climbs_m, peer.airframe.speed = None, 50.0
            await wait_for_reason(low, None)


async def test_a_landed_state_says_who_is_in_the_air_and_a_height_only_where_there_is_none(
    missions: list[list[Item]], port: int
) -> None:
    """An autopilot's heights are above its home, which may be elsewhere: table B, row 9."""
    with pymavlink_peer(missions[0], port, autopilot=ARDUPILOT) as peer:
        peer.above_home_m = -99.0
        async with mavlink_vehicle(f"udpin://127.0.0.1:{port}", PATIENCE_S) as vehicle:
            uav = FieldUav(0, vehicle, site_from_folder(EXAMPLE), height_m=0.0)
            await wait_for_reason(uav, None)
            peer.airframe.climbs_m, peer.above_home_m = 0.0, 60.0
            await wait_for_reason(uav, "it is on the ground")
    with pymavlink_peer(missions[0], port, autopilot=ARDUPILOT) as peer:
        peer.says_landed, peer.airframe.climbs_m = False, 3.0
        async with mavlink_vehicle(f"udpin://127.0.0.1:{port}", PATIENCE_S) as vehicle:
            uav = FieldUav(0, vehicle, site_from_folder(EXAMPLE), height_m=0.0)
            await wait_for_reason(uav, "it is on the ground")
            peer.airframe.climbs_m = None
            await wait_for_reason(uav, None)


async def test_an_armed_vehicle_is_never_said_to_be_unarmed(missions: list[list[Item]], port: int) -> None:
    """A position may arrive before the first heartbeat that MAVSDK hands on."""
    with pymavlink_peer(missions[0], port):
        async with mavlink_vehicle(f"udpin://127.0.0.1:{port}", PATIENCE_S) as vehicle:
            assert (await vehicle.state()).armed is not False
            uav, reasons = FieldUav(0, vehicle, site_from_folder(EXAMPLE)), set()
            async with asyncio.timeout(PATIENCE_S):
                while uav.unavailable_reason is not None:
                    reasons.add(uav.unavailable_reason)
                    await uav.update(0.1)
                    await asyncio.sleep(0.01)
    assert reasons <= {NO_TELEMETRY, NO_POSITION}


@pytest.mark.parametrize("restarts", [0, 1])
async def test_an_arducopter_waits_in_its_mission_and_goes_on_where_it_was(
    missions: list[list[Item]], port: int, restarts: int
) -> None:
    """Mode AUTO begins a mission again with MIS_RESTART 1; a pause is no change of the mode: table B, row 5."""
    with pymavlink_peer(missions[0], port, autopilot=ARDUPILOT, start_m=900.0) as peer:
        peer.restarts = restarts
        async with mavlink_vehicle(f"udpin://127.0.0.1:{port}", PATIENCE_S) as vehicle:
            uav = FieldUav(0, vehicle, site_from_folder(EXAMPLE))
            await wait_for_reason(uav, None)
            await uav.command(0)
            assert (peer.airframe.paused, peer.airframe.mode) == (True, "mission")
            await asyncio.sleep(MODE_LAG_S)
            await uav.update(0.1)
            assert uav.waits and uav.unavailable_reason is None
            await uav.command(0)
            await uav.command(9)
            assert not peer.airframe.paused and not uav.waits and peer.airframe.flown_m >= 900.0
            reported = without_repeats(
                (m.command, m.param2 if m.command == SPEED else m.param1) for _, m in peer.commands()
            )
            assert reported == [(PAUSE, 0.0), (PAUSE, 1.0), (SPEED, pytest.approx(9.0, abs=0.2))]
            # It is taking off again, where ArduCopter refuses a pause.
            peer.airframe.climbs_m = 50.0
            with pytest.raises(VehicleError, match="did not hold: MAV_RESULT 4"):
                await vehicle.hold()


async def test_an_ardupilot_without_a_pause_is_sent_to_mode_hold_only_if_it_resumes(
    missions: list[list[Item]], port: int
) -> None:
    with pymavlink_peer(missions[0], port, autopilot=ARDUPILOT, start_m=900.0) as peer:
        peer.pauses = False
        async with mavlink_vehicle(f"udpin://127.0.0.1:{port}", PATIENCE_S) as vehicle:
            peer.restarts = 1
            with pytest.raises(VehicleError, match="did not hold: its MIS_RESTART begins the mission again; set it to"):
                await vehicle.hold()
            assert peer.airframe.mode == "mission"
            peer.restarts = 0
            uav = FieldUav(0, vehicle, site_from_folder(EXAMPLE))
            await wait_for_reason(uav, None)
            await uav.command(0)
            assert peer.airframe.mode == "hold"
            await asyncio.sleep(MODE_LAG_S)
            await uav.update(0.1)
            assert uav.waits and uav.unavailable_reason is None
            await uav.command(9)
            assert peer.airframe.mode == "mission" and peer.airframe.flown_m >= 900.0


@pytest.mark.parametrize("autopilot", [PX4, ARDUPILOT])
async def test_system_ids_are_the_vehicles_unless_another_is_asked_for(
    missions: list[list[Item]], port: int, autopilot: int
) -> None:
    with pymavlink_peer(missions[0], port, system_id=6, autopilot=autopilot) as peer:
        peer.enforces_ids = True
        async with mavlink_vehicle(f"udpin://127.0.0.1:{port}", PATIENCE_S) as vehicle:
            check_uploaded(await vehicle.mission(), site_from_folder(EXAMPLE), 0, vehicle.name)
        assert 6 in {m.get_srcSystem() for _, m in peer.received}
        async with mavlink_vehicle(f"udpin://127.0.0.1:{port}", PATIENCE_S, 77) as vehicle:
            with pytest.raises(VehicleError, match="did not give its mission: TIMEOUT"):
                await vehicle.mission()
        assert 77 in {m.get_srcSystem() for _, m in peer.received}


async def test_the_top_speed_of_an_airframe_is_seen_though_every_speed_is_acknowledged(
    missions: list[list[Item]], port: int
) -> None:
    with pymavlink_peer(missions[0], port, autopilot=ARDUPILOT, speedup=4.0, top=11.0, accelerates=2.5) as peer:
        async with mavlink_vehicle(f"udpin://127.0.0.1:{port}", PATIENCE_S) as vehicle:
            uav = FieldUav(0, vehicle, site_from_folder(EXAMPLE))
            await wait_for_reason(uav, None)
            await uav.command(9)
            for _ in range(12):
                await asyncio.sleep(0.25)
                await uav.update(1.0)
            assert uav.top_speed_m_s is None, "it flies what is commanded"
            await uav.command(14)
            assert peer.airframe.speed > 13.0, "the autopilot acknowledges what the airframe cannot fly"
            async with asyncio.timeout(PATIENCE_S):
                while uav.top_speed_m_s is None:
                    await asyncio.sleep(0.25)
                    await uav.update(1.0)
    assert uav.top_speed_m_s == pytest.approx(11.0, abs=0.05)


@pytest.mark.parametrize("autopilot", [PX4, ARDUPILOT])
async def test_the_endless_jump_of_an_exported_plan_is_kept(
    missions: list[list[Item]], port: int, autopilot: int
) -> None:
    """PX4 stores -1 as an uint16, ArduPilot 40000 as an int16: table B, row 3."""
    with pymavlink_peer(missions[0], port, autopilot=autopilot):
        async with mavlink_vehicle(f"udpin://127.0.0.1:{port}", PATIENCE_S) as vehicle:
            items = await vehicle.mission()
    assert doubts_of(items, site_from_folder(EXAMPLE)) == [] and items[-1].parameters[1] == 32767


def test_what_a_mission_has_that_the_world_has_not_is_said() -> None:
    site = site_from_folder(EXAMPLE)

    def doubts(height_m: float | None, waits_s: float = 0.0, repeats: float | None = -1.0) -> str:
        first = MissionItem("item 1", 1, 16, (41.5, 39.9), height_m, (waits_s, 0.0))
        items = [first, MissionItem("item 2", 2, 16, (41.6, 39.9), height_m)]
        if repeats is not None:
            items.append(MissionItem("item 3", 3, 177, parameters=(1.0, repeats)))
        return "; ".join(doubts_of(items, site))

    assert doubts(100.0) == doubts(104.0, repeats=65535.0) == ""
    assert doubts(10.0).startswith(
        "its waypoints are 10 to 10 m above the take-off place, the world's UAVs fly at 100 m"
    )
    assert doubts(None).startswith("2 waypoints' heights are not above the take-off place")
    assert doubts(100.0, waits_s=5.0).startswith("it waits 5 s at its waypoints")
    assert doubts(100.0, repeats=3.0).startswith("it flies its path 4 times, and ends then")
    assert doubts(100.0, repeats=None).startswith("it flies its path once, and ends then")


def test_a_flight_that_ends_early_says_why(missions: list[list[Item]], port: int, tmp_path: Path) -> None:
    nobody = f"http://127.0.0.1:{free_port()}"
    with (
        pymavlink_peer(missions[1], port, speedup=20.0, autopilot=ARDUPILOT) as peer,
        started(*arguments(port, nobody, tmp_path, "--uav", "1", "--steps", "60")) as process,
    ):
        output_until(process, r"step 2, UAV 1")
        peer.airframe.mode = "return"
        output_until(process, r"UAV 1: it returns to where it took off")
        output_until(process, r"UAV 1 did not fly its mission at the end: it returns to where it took off\.")
        assert process.wait(60) == 0
    real = Summary.model_validate_json((tmp_path / "summary.json").read_bytes()).real_uavs
    assert real is not None and real.ended == {1: "it returns to where it took off"}
    assert "at the end: it returns to where it took off." in (tmp_path / "report.html").read_text(encoding="utf-8")


async def test_the_home_of_ardupilot_is_no_part_of_the_mission(missions: list[list[Item]], port: int) -> None:
    with pymavlink_peer(missions[0], port, autopilot=ARDUPILOT):
        async with mavlink_vehicle(f"udpin://127.0.0.1:{port}", PATIENCE_S) as vehicle:
            check_uploaded(await vehicle.mission(), site_from_folder(EXAMPLE), 0, vehicle.name)
