"""Vehicles whose answers are lost, whose missions end without notice, and whose radios answer nonsense."""

from __future__ import annotations

import asyncio
from dataclasses import replace
from typing import Any

import pytest

from field.errors import Unanswered, VehicleError
from field.vehicles.field_run import doubts_of, flown_on
from field.vehicles.field_uav import LINK_LOST, FieldUav
from field.vehicles.mavlink_vehicle import VehicleState, mavlink_vehicle
from field.vehicles.radio import Beacon, Collected, Spot
from shared.world.trajectory import trajectories
from simulator.sites.files.world_folder import site_from_folder
from simulator.sites.plans.mission_path import DELAY, TAKEOFF, WAYPOINT, MissionItem, path_of
from tests.integration.field.vehicles.test_field_flight import Counting, Trial, nobody
from tests.support.airframe import Item
from tests.support.edge_stub import stub_edge
from tests.support.flights import wait_for_reason
from tests.support.pymavlink_peer import ARDUPILOT, pymavlink_peer
from tests.support.stub_vehicle import StubVehicle
from tests.support.waiting import PATIENCE_S, soon
from tests.support.world_folders import EXAMPLE

BATTERY_STATUS = 147


async def test_a_pause_whose_answer_is_lost_is_ended_all_the_same(missions: list[list[Item]], port: int) -> None:
    with pymavlink_peer(missions[0], port, autopilot=ARDUPILOT, start_m=900.0) as peer:
        async with mavlink_vehicle(f"udpin://127.0.0.1:{port}", PATIENCE_S) as vehicle:
            uav = FieldUav(0, vehicle, site_from_folder(EXAMPLE))
            await wait_for_reason(uav, None)
            peer.answers_pauses = False
            with pytest.raises(Unanswered, match="did not hold: TIMEOUT"):
                await uav.command(0)
            assert peer.airframe.paused and uav.waits
            peer.answers_pauses = True
            await uav.command(9)
            assert not peer.airframe.paused and not uav.waits


async def test_an_ardupilot_is_asked_for_its_battery(missions: list[list[Item]], port: int) -> None:
    with pymavlink_peer(missions[0], port, autopilot=ARDUPILOT) as peer:
        async with mavlink_vehicle(f"udpin://127.0.0.1:{port}", PATIENCE_S) as vehicle:
            await wait_for_reason(FieldUav(0, vehicle, site_from_folder(EXAMPLE)), None)
            async with asyncio.timeout(PATIENCE_S):
                while BATTERY_STATUS not in peer.streams:
                    await asyncio.sleep(0.05)


class Unheard(StubVehicle):
    """It obeys, but its answer to `hold` is lost, or comes only when the flight has ended."""

    hangs = False

    async def hold(self) -> None:
        await super().hold()
        if self.hangs:
            await asyncio.Event().wait()
        raise Unanswered(f"{self.name} did not hold: TIMEOUT")


def unheard(trial: Trial, hangs: bool) -> Unheard:
    vehicle = Unheard(trial.site, 0, trial.clock)
    vehicle.hangs = hangs
    trial.uavs[0] = FieldUav(0, vehicle, trial.site)
    return vehicle


async def test_a_uav_that_waits_without_an_answer_goes_on_with_its_next_decision() -> None:
    trial = Trial()
    vehicle = unheard(trial, hangs=False)
    await trial.uavs[0].update(0.0)
    with pytest.raises(Unanswered):
        await trial.uavs[0].command(0)
    await trial.uavs[0].update(1.0)
    assert trial.uavs[0].unavailable_reason is None
    await trial.uavs[0].command(8)
    assert vehicle.commands == ["hold", "resume", 8.0]


async def test_a_flight_that_is_cancelled_while_a_uav_is_told_to_hold_lets_all_go_on() -> None:
    trial = Trial()
    vehicle = unheard(trial, hangs=True)
    with stub_edge() as edge:
        edge.velocity = 0
        flying = asyncio.create_task(trial.fly(edge.url))
        await soon(lambda: {one.mode for one in (vehicle, *trial.vehicles[1:])} == {"hold"})
        flying.cancel()
        with pytest.raises(asyncio.CancelledError):
            await flying
    for one in (vehicle, *trial.vehicles[1:]):
        assert (one.commands, one.mode) == (["hold", "resume"], "mission")


async def test_a_uav_that_stays_in_place_in_its_mission_is_named() -> None:
    """ArduCopter loiters in mode AUTO after a last item that is a waypoint."""
    trial = Trial(steps=3)
    trial.vehicles[1].top = 0.0
    await trial.fly(nobody(), attempts=1)
    assert {uav for uav, text in trial.events if text.startswith("it stays in place in mode mission")} == {1}


async def test_a_vehicle_whose_state_cannot_be_read_ends_no_flight() -> None:
    class Mute(StubVehicle):
        read = 0

        async def state(self) -> VehicleState:
            self.read += 1
            if 5 < self.read < 15:
                raise VehicleError("no answer")
            return await super().state()

    trial = Trial(steps=6)
    trial.uavs[2] = FieldUav(2, Mute(trial.site, 2, trial.clock), trial.site)
    flown = await trial.fly(nobody(), attempts=1)
    assert flown.steps_flown == 6 and (2, LINK_LOST) in trial.events
    assert len([d for d in flown.decisions if d.uav_id != 2]) == 12


@pytest.mark.parametrize("stops_s", [10.0, 12.5, 15.0, 19.0])
async def test_a_uav_whose_telemetry_stops_collects_a_step_further_along_its_path(stops_s: float) -> None:
    class Lost(StubVehicle):
        async def state(self) -> VehicleState:
            if self._clock.now() > stops_s:
                raise VehicleError("no answer")
            return await super().state()

    class Noting(Counting):
        async def collect(self, spot: Spot, sensor: int) -> Collected:
            places[spot.uav, spot.step] = spot.position
            return await super().collect(spot, sensor)

    places: dict[tuple[int, int], tuple[float, float]] = {}
    trial = Trial(steps=2)
    trial.radio = Noting([(0, 0)] * 3)
    trial.uavs[0] = FieldUav(0, Lost(trial.site, 0, trial.clock), trial.site)
    flown = await trial.fly(nobody(), attempts=1)
    assert flown.ended == {0: LINK_LOST}
    path = trajectories(trial.site.scenario)[0]
    assert [path.locate(places[0, step])[0] for step in range(2)] == pytest.approx([70.0, 140.0], abs=0.1)


async def test_a_flight_ends_once_every_uav_has_landed() -> None:
    trial = Trial()
    for vehicle in trial.vehicles:
        vehicle.lands_at_s = 35.0
    flown = await trial.fly(nobody(), attempts=1)
    assert flown.steps_flown == 4 and flown.ended == dict.fromkeys(range(3), "it lands") and not flown.undecided


class Nonsense(Counting):
    def __init__(self, heard: Any, got: Any) -> None:
        super().__init__([])
        self._heard, self._got = heard, got

    async def beacons(self, spot: Spot) -> dict[int, Beacon]:
        found: dict[int, Beacon] = self._heard
        return found

    async def collect(self, spot: Spot, sensor: int) -> Collected:
        found: Collected = self._got
        return found


FAIR = {0: Beacon(30, 40.0, -90.0, 0)}


@pytest.mark.parametrize(
    ("heard", "got"),
    [
        (None, Collected(5, failed=False)),
        ({99: Beacon(30, 40.0, -90.0, 0)}, Collected(5, failed=False)),
        ({-1: Beacon(30, 40.0, -90.0, 0)}, Collected(5, failed=False)),
        ({0: Beacon(-1, 40.0, -90.0, 0)}, Collected(5, failed=False)),
        ({0: Beacon(30, 40.0, -90.0, -1)}, Collected(5, failed=False)),
        ({0: Beacon(30, 40.0, -90.0, None)}, Collected(5, failed=False)),  # type: ignore[arg-type]
        (FAIR, None),
        (FAIR, Collected(-3, failed=False)),
        (FAIR, Collected(2.5, failed=False)),  # type: ignore[arg-type]
    ],
)
async def test_a_radio_that_answers_nonsense_ends_no_flight(heard: Any, got: Any) -> None:
    trial = Trial(steps=2)
    trial.radio = Nonsense(heard, got)
    flown = await trial.fly(nobody(), attempts=1)
    assert flown.steps_flown == 2 and any(text.startswith("its radio fails") for _, text in trial.events)
    assert all(0 <= decision.collected <= 5 for decision in flown.decisions)


def test_a_full_disk_costs_lines_of_the_log(capsys: pytest.CaptureFixture[str]) -> None:
    written: list[int] = []

    def full(entry: int) -> None:
        if entry > 1:
            raise OSError(28, "No space left on device")
        written.append(entry)

    for entry in range(3):
        flown_on(full)(entry)
    assert written == [0, 1] and "the log lacks a line: [Errno 28] No space left" in capsys.readouterr().err


def test_what_stops_an_autopilot_in_its_mission_is_said() -> None:
    first = MissionItem("item 1", 1, WAYPOINT, (41.5, 39.9), 100.0)
    second = MissionItem("item 2", 2, WAYPOINT, (41.6, 39.9), 100.0)
    jump = MissionItem("item 3", 3, 177, parameters=(1.0, -1.0))
    site = site_from_folder(EXAMPLE)
    assert doubts_of([first, second, jump], site) == []
    assert doubts_of([first, replace(second, autocontinue=False), jump], site) == [
        "autocontinue is off at items [2]: the autopilot may stop there"
    ]
    clock = MissionItem("item 4", 4, DELAY, parameters=(-1.0, 8.0))
    assert doubts_of([first, clock, second, jump], site) == [
        "it waits until a time of day, which no decision counts on"
    ]


def test_a_take_off_is_no_part_of_the_path_only_before_it() -> None:
    takes_off = MissionItem("item 0", 0, TAKEOFF, (30.0, 30.0))
    ways = [MissionItem(f"item {n}", n, WAYPOINT, (41.5 + n / 100, 39.9), 100.0) for n in (1, 2)]
    assert len(path_of([takes_off, *ways]).waypoints) == 2
    with pytest.raises(ValueError, match="item 0: command 22 is no straight leg"):
        path_of([ways[0], takes_off, ways[1]])
